//! What every DICOM object that is written here says alike.

use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};

use super::sha256_bytes;

/// An element.
pub type Element = DataElement<InMemDicomObject>;

/// A unique identifier that is a hash of `content`: the same object has the same one. Under 2.25 (PS3.5 §B.2), 128 bits.
#[must_use]
pub fn uid_of(content: &[u8]) -> String {
    let number = sha256_bytes(content)[..32]
        .bytes()
        .fold(0u128, |number, digit| number << 4 | u128::from(char::from(digit).to_digit(16).unwrap_or_default()));
    format!("2.25.{number}")
}

/// Text.
#[must_use]
pub fn text(tag: Tag, vr: VR, value: &str) -> Element {
    DataElement::new(tag, vr, PrimitiveValue::from(value))
}

/// Grey pixels of 16 bits, larger ones brighter; `size` is columns and rows.
#[must_use]
pub fn grey_16(size: [usize; 2], values: Vec<u16>) -> [Element; 9] {
    let number = |tag: Tag, value: u16| DataElement::new(tag, VR::US, PrimitiveValue::from(value));
    [
        number(tags::SAMPLES_PER_PIXEL, 1),
        text(tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME2"),
        number(tags::ROWS, size[1] as u16),
        number(tags::COLUMNS, size[0] as u16),
        number(tags::BITS_ALLOCATED, 16),
        number(tags::BITS_STORED, 16),
        number(tags::HIGH_BIT, 15),
        number(tags::PIXEL_REPRESENTATION, 0),
        DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())),
    ]
}

/// The bytes of a file with these elements, uncompressed; `class` and `instance` are its identifiers.
///
/// # Errors
/// In words, when they cannot be encoded.
pub fn file_bytes(elements: impl IntoIterator<Item = Element>, class: &str, instance: &str) -> Result<Vec<u8>, String> {
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(uids::EXPLICIT_VR_LITTLE_ENDIAN)
        .media_storage_sop_class_uid(class)
        .media_storage_sop_instance_uid(instance);
    let object = InMemDicomObject::from_element_iter(elements).with_meta(meta).map_err(|error| error.to_string())?;
    let mut bytes = Vec::new();
    object.write_all(&mut bytes).map_err(|error| error.to_string())?;
    Ok(bytes)
}

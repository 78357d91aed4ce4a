//! Frames as a C-arm would store them: DICOM XA, linear 16-bit values, with a made-up name that must not leave the import.

use std::path::Path;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};

use crate::MockError;

/// What the file says besides its pixels.
#[derive(Clone, Debug)]
pub struct FrameTags {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Pixel size at the detector.
    pub pitch_mm: f64,
    /// Focal spot to detector.
    pub source_to_detector_mm: f64,
    /// Tube voltage.
    pub tube_kvp: f32,
    /// Exposure counter, if the arm stores it.
    pub exposure_counter: Option<u32>,
    /// Counts files of the session.
    pub instance: u32,
}

/// Bytes of a DICOM file with `values` (row by row).
///
/// # Errors
/// When the object cannot be encoded.
pub fn encode(tags_in: &FrameTags, values: &[u16]) -> Result<Vec<u8>, MockError> {
    let failed = |error: &dyn std::fmt::Display| MockError::Data { what: "DICOM".to_owned(), detail: error.to_string() };
    let uid = format!("2.25.1234567890.{}", tags_in.instance);
    let text = |tag, vr, value: &str| DataElement::new(tag, vr, PrimitiveValue::from(value));
    let number = |tag, value: u16| DataElement::new(tag, VR::US, PrimitiveValue::from(value));
    let decimal = |tag, value: f64| text(tag, VR::DS, &format!("{value}"));
    let mut object = InMemDicomObject::from_element_iter([
        text(tags::SOP_CLASS_UID, VR::UI, uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE),
        text(tags::SOP_INSTANCE_UID, VR::UI, &uid),
        text(tags::MODALITY, VR::CS, "XA"),
        text(tags::MANUFACTURER, VR::LO, "Mock Lab"),
        text(tags::PATIENT_NAME, VR::PN, "Mockpatient^Identity"),
        text(tags::PATIENT_ID, VR::LO, "MOCK-ID-4711"),
        text(tags::PATIENT_BIRTH_DATE, VR::DA, "19500101"),
        text(tags::PRESENTATION_INTENT_TYPE, VR::CS, "FOR PROCESSING"),
        decimal(tags::KVP, f64::from(tags_in.tube_kvp)),
        decimal(tags::DISTANCE_SOURCE_TO_DETECTOR, tags_in.source_to_detector_mm),
        text(tags::IMAGER_PIXEL_SPACING, VR::DS, &format!("{0}\\{0}", tags_in.pitch_mm)),
        text(tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, "LIN"),
        DataElement::new(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, VR::SS, PrimitiveValue::from(1i16)),
        text(tags::INSTANCE_NUMBER, VR::IS, &tags_in.instance.to_string()),
        number(tags::SAMPLES_PER_PIXEL, 1),
        text(tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME2"),
        number(tags::ROWS, tags_in.size_px[1] as u16),
        number(tags::COLUMNS, tags_in.size_px[0] as u16),
        number(tags::BITS_ALLOCATED, 16),
        number(tags::BITS_STORED, 16),
        number(tags::HIGH_BIT, 15),
        number(tags::PIXEL_REPRESENTATION, 0),
        DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.to_vec().into())),
    ]);
    if let Some(counter) = tags_in.exposure_counter {
        object.put(text(tags::ACQUISITION_NUMBER, VR::IS, &counter.to_string()));
    }
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(uids::EXPLICIT_VR_LITTLE_ENDIAN)
        .media_storage_sop_class_uid(uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE)
        .media_storage_sop_instance_uid(uid);
    let file = object.with_meta(meta).map_err(|error| failed(&error))?;
    let mut bytes = Vec::new();
    file.write_all(&mut bytes).map_err(|error| failed(&error))?;
    Ok(bytes)
}

/// Writes `bytes` so that a watcher never sees a part of them: beside, then renamed.
///
/// # Errors
/// When the folder is not writable.
pub fn deliver(path: &Path, bytes: &[u8]) -> Result<(), MockError> {
    let hidden = path.with_extension("part");
    std::fs::write(&hidden, bytes).and_then(|()| std::fs::rename(&hidden, path)).map_err(MockError::io(path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_reads_back() {
        let tags_in = FrameTags {
            size_px: [4, 3],
            pitch_mm: 0.388,
            source_to_detector_mm: 1020.0,
            tube_kvp: 90.0,
            exposure_counter: Some(7),
            instance: 3,
        };
        let values: Vec<u16> = (0..12).map(|i| i * 5000).collect();
        let object = dicom_object::from_reader(encode(&tags_in, &values).expect("encodes").as_slice()).expect("reads");
        let read = object.element(tags::PIXEL_DATA).expect("pixels").to_multi_int::<u16>().expect("u16");
        assert_eq!(read, values);
        assert_eq!(object.element(tags::ACQUISITION_NUMBER).expect("counter").to_int::<u32>().expect("int"), 7);
    }
}

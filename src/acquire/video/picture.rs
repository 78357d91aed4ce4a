//! A grabbed picture as a DICOM object: secondary capture with the time at which it began to stand, and with the meaning of its values.

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::InMemDicomObject;

use super::super::spool::{Spool, SpoolError};
use super::settings::VideoSettings;
use crate::image::Image;
use crate::image::dicom::{grey_16, text, uid_of};
use crate::time::rfc3339_from_us;

/// Stored values of full white.
const MOST: f64 = 65_535.0;

/// Writes `picture` (0 to 255), which has stood since `since_us` of the host's clock.
pub(super) fn write_picture(
    picture: &Image<f32>,
    since_us: i64,
    settings: &VideoSettings,
    spool: &Spool,
) -> Result<(), SpoolError> {
    let gamma = settings.gamma.unwrap_or(1.0);
    let stored = |grey: &f32| ((f64::from(*grey) / 255.0).powf(gamma) * MOST).round() as u16;
    let values: Vec<u16> = picture.pixels.iter().map(stored).collect();
    let stamp = rfc3339_from_us(since_us);
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).chain(stamp.bytes()).collect();
    let instance = uid_of(&bytes);
    let object = object(values, picture, &stamp, &instance, settings);
    let mut data_set = Vec::new();
    let syntax = dicom_transfer_syntax_registry::entries::EXPLICIT_VR_LITTLE_ENDIAN.erased();
    object.write_dataset_with_ts(&mut data_set, &syntax).map_err(|_| SpoolError::Head)?;
    let mut incoming = spool.begin(uids::SECONDARY_CAPTURE_IMAGE_STORAGE, &instance, uids::EXPLICIT_VR_LITTLE_ENDIAN)?;
    incoming.write(&data_set)?;
    incoming.finish(spool).map(drop)
}

fn object(values: Vec<u16>, picture: &Image<f32>, stamp: &str, instance: &str, settings: &VideoSettings) -> InMemDicomObject {
    // 2026-11-21T10:00:00.123456Z
    let digits = |part: &str| part.chars().filter(|digit| digit.is_ascii_digit() || *digit == '.').collect::<String>();
    let (date, time) = stamp.split_once('T').map_or_else(Default::default, |(date, time)| (digits(date), digits(time)));
    let (relationship, intent) = match settings.gamma {
        Some(_) => ("LIN", "FOR PROCESSING"),
        None => ("DISP", "FOR PRESENTATION"),
    };
    let sign: i16 = if settings.metal_white { -1 } else { 1 };
    let words = [
        text(tags::SOP_CLASS_UID, VR::UI, uids::SECONDARY_CAPTURE_IMAGE_STORAGE),
        text(tags::SOP_INSTANCE_UID, VR::UI, instance),
        text(tags::ACQUISITION_DATE, VR::DA, &date),
        text(tags::ACQUISITION_TIME, VR::TM, &time),
        text(tags::TIMEZONE_OFFSET_FROM_UTC, VR::SH, "+0000"),
        // The C-arm's own; the grabber is none.
        text(tags::MODALITY, VR::CS, "XA"),
        text(tags::CONVERSION_TYPE, VR::CS, "DV"),
        text(tags::PRESENTATION_INTENT_TYPE, VR::CS, intent),
        // What stands still on a monitor.
        text(tags::IMAGE_TYPE, VR::CS, "DERIVED\\SECONDARY\\LAST IMAGE HOLD"),
        text(tags::MANUFACTURER, VR::LO, "Sidecarm"),
        text(tags::MANUFACTURER_MODEL_NAME, VR::LO, "grabbed from video"),
        text(tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, relationship),
        DataElement::new(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, VR::SS, PrimitiveValue::from(sign)),
        text(tags::BURNED_IN_ANNOTATION, VR::CS, "YES"),
    ];
    InMemDicomObject::from_element_iter(words.into_iter().chain(grey_16([picture.width, picture.height], values)))
}

//! Frames as a C-arm would store them: DICOM XA, linear 16-bit values, with a made-up name that must not leave the import.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};

use crate::MockError;

/// What the file says besides its pixels.
#[derive(Clone, Copy, Debug)]
pub struct FrameTags {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Pixel size at the detector.
    pub pitch_mm: f64,
    /// Focal spot to detector.
    pub source_to_detector_mm: f64,
    /// Tube voltage.
    pub tube_kvp: f32,
    /// Tube current.
    pub tube_ma: f32,
    /// Beam on.
    pub exposure_ms: f64,
    /// When X-ray went on, by the console's clock (UTC, microseconds since 1970), if it is stored.
    pub acquired_us: Option<i64>,
    /// Exposure counter, if the arm stores it.
    pub exposure_counter: Option<u32>,
    /// Counts files of the session.
    pub instance: u32,
    /// Filter and collimator, if the console stores them.
    pub beam: Option<BeamTags>,
}

/// A frame that waits for its exposure.
#[derive(Clone, Debug)]
pub struct Drawn {
    /// Where its file appears.
    pub path: PathBuf,
    /// What the file says besides pixels; the time of acquisition is filled in when it is known.
    pub tags: FrameTags,
    /// Pixel values, row by row.
    pub values: Arc<[u16]>,
}

/// What a console knows of the beam besides its voltage and current.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BeamTags {
    /// Filters that are put in: aluminium and copper.
    pub filter_mm: [f64; 2],
    /// Left, top, right, bottom of the open field at the detector, from the panel's middle.
    pub field_mm: [f64; 4],
}

impl BeamTags {
    /// Type, materials and thicknesses of the filters that are in the beam (PS3.3 C.8.7.10), and the collimator's edges (C.8.7.3): the first
    /// and the last column and row that are open, counted from 1.
    fn texts(&self, [columns, rows]: [usize; 2], pitch_mm: f64) -> Vec<(Tag, VR, String)> {
        let materials = ["ALUMINUM", "COPPER"].into_iter().zip(self.filter_mm).filter(|(_, mm)| *mm > 0.0);
        let (names, thicknesses): (Vec<&str>, Vec<String>) = materials.map(|(name, mm)| (name, format!("{mm:.2}"))).unzip();
        let form = ["NONE", "FLAT", "MULTIPLE"][names.len()];
        let mut texts = vec![(tags::FILTER_TYPE, VR::SH, form.to_owned())];
        if !names.is_empty() {
            texts.push((tags::FILTER_MATERIAL, VR::CS, names.join("\\")));
            for tag in [tags::FILTER_THICKNESS_MINIMUM, tags::FILTER_THICKNESS_MAXIMUM] {
                texts.push((tag, VR::DS, thicknesses.join("\\")));
            }
        }
        let [left, top, right, bottom] = self.field_mm.map(|mm| mm / pitch_mm);
        let (half_width, half_height) = (0.5 * columns as f64, 0.5 * rows as f64);
        let edges = [
            (tags::COLLIMATOR_LEFT_VERTICAL_EDGE, left + half_width + 1.0),
            (tags::COLLIMATOR_RIGHT_VERTICAL_EDGE, right + half_width),
            (tags::COLLIMATOR_UPPER_HORIZONTAL_EDGE, top + half_height + 1.0),
            (tags::COLLIMATOR_LOWER_HORIZONTAL_EDGE, bottom + half_height),
        ];
        texts.push((tags::COLLIMATOR_SHAPE, VR::CS, "RECTANGULAR".to_owned()));
        texts.extend(edges.map(|(tag, edge)| (tag, VR::IS, format!("{edge:.0}"))));
        texts
    }
}

/// First of the mock's UIDs: 2.25 and a UUID (version 8), whose low 62 bits are counted.
pub(crate) const UID_BASE: u128 = 0x6d6f_636b_6c61_8b00_8000_0000_0000_0000;

/// `YYYYMMDD` and `HHMMSS.FFFFFF` of microseconds since 1970.
fn date_and_time(us: i64) -> (String, String) {
    let (seconds, micros) = (us.div_euclid(1_000_000), us.rem_euclid(1_000_000));
    let (mut days, second) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    let leap = |year: i64| year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
    let mut year = 1970;
    while days >= 365 + i64::from(leap(year)) {
        days -= 365 + i64::from(leap(year));
        year += 1;
    }
    let mut month = 0;
    let lengths = [31, 28 + i64::from(leap(year)), 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
    while days >= lengths[month] {
        days -= lengths[month];
        month += 1;
    }
    let date = format!("{year:04}{:02}{:02}", month + 1, days + 1);
    (date, format!("{:02}{:02}{:02}.{micros:06}", second / 3600, second / 60 % 60, second % 60))
}

/// Bytes of a DICOM file with `values` (row by row).
///
/// # Errors
/// When the object cannot be encoded.
pub fn encode(tags_in: &FrameTags, values: &[u16]) -> Result<Vec<u8>, MockError> {
    let failed = |error: &dyn std::fmt::Display| MockError::Data { what: "DICOM".to_owned(), detail: error.to_string() };
    let uid = |nth: u32| format!("2.25.{}", UID_BASE + 2 + ((tags_in.acquired_us.unwrap_or(0) as u128) << 10) + u128::from(nth));
    let text = |tag, vr, value: &str| DataElement::new(tag, vr, PrimitiveValue::from(value));
    let number = |tag, value: u16| DataElement::new(tag, VR::US, PrimitiveValue::from(value));
    let decimal = |tag, value: f64| text(tag, VR::DS, &format!("{value}"));
    let whole = |tag, value: f64| text(tag, VR::IS, &format!("{value:.0}"));
    let mut object = InMemDicomObject::from_element_iter([
        text(tags::SOP_CLASS_UID, VR::UI, uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE),
        text(tags::SOP_INSTANCE_UID, VR::UI, &uid(tags_in.instance)),
        text(tags::STUDY_INSTANCE_UID, VR::UI, &format!("2.25.{UID_BASE}")),
        text(tags::SERIES_INSTANCE_UID, VR::UI, &format!("2.25.{}", UID_BASE + 1)),
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
        whole(tags::EXPOSURE_TIME, tags_in.exposure_ms),
        decimal(tags::X_RAY_TUBE_CURRENT_INU_A, 1e3 * f64::from(tags_in.tube_ma)),
        whole(tags::EXPOSURE, f64::from(tags_in.tube_ma) * tags_in.exposure_ms * 1e-3),
        whole(tags::EXPOSURE_INU_AS, f64::from(tags_in.tube_ma) * tags_in.exposure_ms),
        text(tags::BURNED_IN_ANNOTATION, VR::CS, "NO"),
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
    for (tag, vr, value) in tags_in.beam.iter().flat_map(|beam| beam.texts(tags_in.size_px, tags_in.pitch_mm)) {
        object.put(text(tag, vr, &value));
    }
    if let Some((date, time)) = tags_in.acquired_us.map(date_and_time) {
        object.put(text(tags::ACQUISITION_DATE, VR::DA, &date));
        object.put(text(tags::ACQUISITION_TIME, VR::TM, &time));
        object.put(text(tags::TIMEZONE_OFFSET_FROM_UTC, VR::SH, "+0000"));
    }
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(uids::EXPLICIT_VR_LITTLE_ENDIAN)
        .media_storage_sop_class_uid(uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE)
        .media_storage_sop_instance_uid(uid(tags_in.instance));
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
            tube_ma: 3.5,
            exposure_ms: 300.0,
            acquired_us: Some(1_795_237_262_250_000),
            exposure_counter: Some(7),
            instance: 3,
            beam: Some(BeamTags { filter_mm: [4.3, 0.25], field_mm: [-0.388, -0.582, 0.776, 0.582] }),
        };
        let values: Vec<u16> = (0..12).map(|i| i * 5000).collect();
        let object = dicom_object::from_reader(encode(&tags_in, &values).expect("encodes").as_slice()).expect("reads");
        let read = object.element(tags::PIXEL_DATA).expect("pixels").to_multi_int::<u16>().expect("u16");
        assert_eq!(read, values);
        assert_eq!(object.element(tags::ACQUISITION_NUMBER).expect("counter").to_int::<u32>().expect("int"), 7);
        let word = |tag| object.element(tag).expect("there").to_str().expect("text").trim().to_owned();
        assert_eq!(
            (word(tags::ACQUISITION_DATE), word(tags::ACQUISITION_TIME)),
            ("20261121".to_owned(), "050102.250000".to_owned())
        );
        assert_eq!(
            (word(tags::EXPOSURE_INU_AS), word(tags::PIXEL_INTENSITY_RELATIONSHIP)),
            ("1050".to_owned(), "LIN".to_owned())
        );
        assert_eq!([tags::FILTER_TYPE, tags::COLLIMATOR_SHAPE].map(word), ["MULTIPLE", "RECTANGULAR"]);
        let words = |tag| -> Vec<String> {
            let texts = object.element(tag).expect("there").to_multi_str().expect("texts");
            texts.iter().map(|text| text.trim().to_owned()).collect()
        };
        assert_eq!(words(tags::FILTER_MATERIAL), ["ALUMINUM", "COPPER"]);
        assert_eq!([tags::FILTER_THICKNESS_MINIMUM, tags::FILTER_THICKNESS_MAXIMUM].map(words), [["4.30", "0.25"]; 2]);
        // The first column is shut; the blades above and below are out of the picture.
        let edges = [
            tags::COLLIMATOR_LEFT_VERTICAL_EDGE,
            tags::COLLIMATOR_RIGHT_VERTICAL_EDGE,
            tags::COLLIMATOR_UPPER_HORIZONTAL_EDGE,
            tags::COLLIMATOR_LOWER_HORIZONTAL_EDGE,
        ];
        assert_eq!(edges.map(word), ["2", "4", "1", "3"]);
    }

    #[test]
    fn a_filter_that_is_not_in_the_beam_has_no_material() {
        let open = BeamTags { filter_mm: [0.0; 2], field_mm: [-1.0, -1.0, 1.0, 1.0] };
        let texts = open.texts([4, 4], 0.5);
        assert_eq!(texts[0], (tags::FILTER_TYPE, VR::SH, "NONE".to_owned()));
        assert!(texts.iter().all(|(tag, ..)| *tag != tags::FILTER_MATERIAL), "{texts:?}");
    }

    #[test]
    fn dates_around_leap_days_are_right() {
        // Seconds as `date -u +%s` gives them.
        for (seconds, date, time) in [
            (0, "19700101", "000000.000000"),
            (951_782_399, "20000228", "235959.000000"),
            (951_782_400, "20000229", "000000.000000"),
            (1_709_251_200, "20240301", "000000.000000"),
            (1_798_761_599, "20261231", "235959.000000"),
        ] {
            assert_eq!(date_and_time(seconds * 1_000_000), (date.to_owned(), time.to_owned()));
        }
    }
}

//! What survives of a DICOM header: a whitelist of attributes and of terms, checked value by value, so that no free text passes.

use dicom_core::Tag;
use dicom_dictionary_std::tags;

use super::beam_tags::{CollimatorTags, FilterTags};

/// One attribute that is kept, and why it is needed.
#[derive(Clone, Copy, Debug)]
pub struct KeptTag {
    /// Group and element.
    pub tag: Tag,
    /// The field of [`FrameTags`] that holds it.
    pub field: &'static str,
    /// What it is needed for.
    pub reason: &'static str,
}

const fn kept(tag: Tag, field: &'static str, reason: &'static str) -> KeptTag {
    KeptTag { tag, field, reason }
}

/// The whitelist. Whatever is not here never leaves the import: names, identifiers, institutions, comments, private groups. Dates and
/// times of the acquisition itself are kept, because they bind a frame to telemetry; birth, study and series dates are not.
pub const KEPT_TAGS: [KeptTag; 61] = [
    kept(tags::MODALITY, "modality", "decides how a console presents the image"),
    kept(tags::IMAGE_TYPE, "image_type", "ORIGINAL or DERIVED: evidence of processing"),
    kept(tags::ACQUISITION_DATE, "acquired_date", "binds the frame to telemetry"),
    kept(tags::ACQUISITION_TIME, "acquired_time", "binds the frame to telemetry"),
    kept(tags::ACQUISITION_DATE_TIME, "acquired_date", "binds the frame to telemetry"),
    kept(tags::CONTENT_DATE, "acquired_date", "stands in for the acquisition date"),
    kept(tags::CONTENT_TIME, "acquired_time", "stands in for the acquisition time"),
    kept(tags::TIMEZONE_OFFSET_FROM_UTC, "timezone_offset_min", "turns the console's clock into UTC"),
    kept(tags::KVP, "kvp", "spectrum"),
    kept(tags::DISTANCE_SOURCE_TO_DETECTOR, "sid_mm", "focal length"),
    kept(tags::DISTANCE_SOURCE_TO_PATIENT, "sod_mm", "depth of the specimen, against the pose's"),
    kept(tags::ESTIMATED_RADIOGRAPHIC_MAGNIFICATION_FACTOR, "magnification", "depth of the specimen, against the pose's"),
    kept(tags::EXPOSURE_TIME, "exposure_ms", "length of the exposure interval"),
    kept(tags::RADIATION_SETTING, "radiation_setting", "SC or GR: fluoroscopy, whose last image is held, or a radiograph"),
    kept(tags::FRAME_TIME, "frame_time_ms", "from image to image of a run"),
    kept(tags::FRAME_TIME_VECTOR, "frame_times_ms", "the same, of each image"),
    kept(tags::X_RAY_TUBE_CURRENT, "tube_ma", "dose"),
    kept(tags::EXPOSURE, "exposure_uas", "dose, in mAs, when the finer attribute is missing"),
    kept(tags::EXPOSURE_INU_AS, "exposure_uas", "dose"),
    kept(tags::FILTER_TYPE, "filter", "spectrum, against telemetry's; a term or nothing, because any text may stand there"),
    kept(tags::FILTER_MATERIAL, "filter", "spectrum, against telemetry's"),
    kept(tags::FILTER_THICKNESS_MINIMUM, "filter", "spectrum, against telemetry's"),
    kept(tags::FILTER_THICKNESS_MAXIMUM, "filter", "spectrum, against telemetry's"),
    kept(tags::COLLIMATOR_SHAPE, "collimator", "which of the next six hold"),
    kept(tags::COLLIMATOR_LEFT_VERTICAL_EDGE, "collimator", "open field, against telemetry's"),
    kept(tags::COLLIMATOR_RIGHT_VERTICAL_EDGE, "collimator", "open field, against telemetry's"),
    kept(tags::COLLIMATOR_UPPER_HORIZONTAL_EDGE, "collimator", "open field, against telemetry's"),
    kept(tags::COLLIMATOR_LOWER_HORIZONTAL_EDGE, "collimator", "open field, against telemetry's"),
    kept(tags::CENTER_OF_CIRCULAR_COLLIMATOR, "collimator", "open field, against telemetry's"),
    kept(tags::RADIUS_OF_CIRCULAR_COLLIMATOR, "collimator", "open field, against telemetry's"),
    kept(tags::VERTICES_OF_THE_POLYGONAL_COLLIMATOR, "collimator", "open field, against the picture's"),
    kept(tags::SHUTTER_SHAPE, "display_shutter", "which of the next seven hold"),
    kept(tags::SHUTTER_LEFT_VERTICAL_EDGE, "display_shutter", "open field, against the picture's"),
    kept(tags::SHUTTER_RIGHT_VERTICAL_EDGE, "display_shutter", "open field, against the picture's"),
    kept(tags::SHUTTER_UPPER_HORIZONTAL_EDGE, "display_shutter", "open field, against the picture's"),
    kept(tags::SHUTTER_LOWER_HORIZONTAL_EDGE, "display_shutter", "open field, against the picture's"),
    kept(tags::CENTER_OF_CIRCULAR_SHUTTER, "display_shutter", "open field, against the picture's"),
    kept(tags::RADIUS_OF_CIRCULAR_SHUTTER, "display_shutter", "open field, against the picture's"),
    kept(tags::VERTICES_OF_THE_POLYGONAL_SHUTTER, "display_shutter", "open field, against the picture's"),
    kept(tags::FIELD_OF_VIEW_DIMENSIONS, "field_of_view_mm", "the part of the panel that is shown, against telemetry's field"),
    kept(tags::INTENSIFIER_SIZE, "intensifier_mm", "evidence of an image intensifier: distortion and processing"),
    kept(tags::X_RAY_RECEPTOR_TYPE, "receptor", "image intensifier or flat panel"),
    kept(tags::DETECTOR_TYPE, "detector_type", "that there is a flat panel, where an intensifier's size is given as well"),
    kept(tags::FIELD_OF_VIEW_SHAPE, "field_of_view_shape", "that of an intensifier is round"),
    kept(tags::IMAGER_PIXEL_SPACING, "pitch_mm", "pixel pitch at the detector"),
    kept(tags::PIXEL_SPACING, "pixel_spacing_mm", "pixel pitch at the object, where calibrated"),
    kept(tags::PIXEL_ASPECT_RATIO, "pixel_aspect", "whether pixels are square, against K"),
    kept(tags::POSITIONER_PRIMARY_ANGLE, "primary_deg", "pose prior, + is LAO"),
    kept(tags::POSITIONER_SECONDARY_ANGLE, "secondary_deg", "pose prior, + is cranial"),
    kept(tags::FIELD_OF_VIEW_ROTATION, "field_of_view_rotation_deg", "how the console turned the image"),
    kept(tags::FIELD_OF_VIEW_HORIZONTAL_FLIP, "field_of_view_flipped", "whether the console mirrored the image"),
    kept(tags::PRESENTATION_INTENT_TYPE, "presentation_intent", "FOR PROCESSING or FOR PRESENTATION"),
    kept(tags::ACQUISITION_NUMBER, "exposure_counter", "binds the frame to an exposure"),
    kept(tags::INSTANCE_NUMBER, "instance_number", "order of export"),
    kept(tags::STUDY_INSTANCE_UID, "study", "tells the session's pictures from others in its folder; only its hash is kept"),
    kept(tags::PHOTOMETRIC_INTERPRETATION, "photometric", "direction of the values"),
    kept(tags::BITS_STORED, "bits_stored", "ends of the scale"),
    kept(tags::BURNED_IN_ANNOTATION, "burned_in_annotation", "text in the pixels must be masked"),
    kept(tags::PIXEL_INTENSITY_RELATIONSHIP, "intensity_relationship", "LIN, LOG or DISP"),
    kept(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, "intensity_sign", "direction of the values"),
    kept(tags::WINDOW_CENTER, "window", "how a console shows the values (with the width)"),
];

/// The kept attributes of a frame; `None` where the file has none, or an unusable one.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct FrameTags {
    /// `XA`, `RF`, `DX`, `CR`, …; `None` for files that are not DICOM.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub modality: Option<String>,
    /// (0008,0008), such as `ORIGINAL`, `PRIMARY`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub image_type: Vec<String>,
    /// Pixel pitch at the detector along u (columns) and v (rows), from imager pixel spacing (0018,1164).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pitch_mm: Option<[f64; 2]>,
    /// Pixel spacing (0028,0030) along u and v: at the detector or calibrated at the object, the file does not always say.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pixel_spacing_mm: Option<[f64; 2]>,
    /// Sides of a pixel along u and v, each by the same unknown unit, from pixel aspect ratio (0028,0034).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pixel_aspect: Option<[f64; 2]>,
    /// Source to detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sid_mm: Option<f64>,
    /// Source to patient.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sod_mm: Option<f64>,
    /// Of the picture at the detector over the patient, as the console estimates it (0018,1114).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub magnification: Option<f64>,
    /// Tube voltage.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kvp: Option<f64>,
    /// Tube current.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tube_ma: Option<f64>,
    /// Exposure time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_ms: Option<f64>,
    /// `SC`, the low dose of fluoroscopy, or `GR`, that of a radiograph (0018,1155).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radiation_setting: Option<String>,
    /// From image to image of a run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frame_time_ms: Option<f64>,
    /// The same, from the image before each, of a file of so few images that it may be a series; the first is 0.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub frame_times_ms: Vec<f64>,
    /// Exposure in µAs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_uas: Option<f64>,
    /// Acquisition number (0020,0012).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_counter: Option<u32>,
    /// Instance number (0020,0013).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub instance_number: Option<u32>,
    /// Hash of the study's identifier, 12 hexadecimal digits: who knows the identifier can tell that it is this one, nobody can read it from it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub study: Option<String>,
    /// `YYYYMMDD` by the console's clock.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acquired_date: Option<String>,
    /// `HHMMSS` with a fraction, by the console's clock.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub acquired_time: Option<String>,
    /// The console's time zone, minutes east of UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timezone_offset_min: Option<i32>,
    /// Positioner primary angle; + is LAO.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub primary_deg: Option<f64>,
    /// Positioner secondary angle; + is cranial.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub secondary_deg: Option<f64>,
    /// What filters the beam.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filter: Option<FilterTags>,
    /// What the shutters leave open, in pixels of the picture as stored.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub collimator: Option<CollimatorTags>,
    /// What the console shows of the picture, in the same pixels; what lies outside may be in the picture all the same.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub display_shutter: Option<CollimatorTags>,
    /// The picture's extent at the detector along u and v as stored, or its diameter twice (0018,1149).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field_of_view_mm: Option<[f64; 2]>,
    /// Diameter of the image intensifier.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intensifier_mm: Option<f64>,
    /// `IMG_INTENSIFIER` or `DIGITAL_DETECTOR` (0018,9420).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub receptor: Option<String>,
    /// `DIRECT`, `SCINTILLATOR`, `STORAGE` or `FILM` (0018,7004).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detector_type: Option<String>,
    /// `ROUND`, `RECTANGLE` or `HEXAGONAL` (0018,1147).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field_of_view_shape: Option<String>,
    /// Clockwise rotation that the console applied; not undone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field_of_view_rotation_deg: Option<f64>,
    /// Whether the console mirrored the columns; undone, see `Frame::unmirrored`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field_of_view_flipped: Option<bool>,
    /// `MONOCHROME1` or `MONOCHROME2`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub photometric: Option<String>,
    /// `LIN`, `LOG` or `DISP` (0028,1040).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intensity_relationship: Option<String>,
    /// +1: larger stored values mean more X-rays; −1: fewer (0028,1041).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intensity_sign: Option<i32>,
    /// `FOR PROCESSING` or `FOR PRESENTATION` (0008,0068).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub presentation_intent: Option<String>,
    /// Whether text is burned into the pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub burned_in_annotation: Option<bool>,
    /// Bits per stored value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bits_stored: Option<u32>,
    /// First window: centre and width, in stored values after rescaling.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub window: Option<[f64; 2]>,
}

/// The largest that were built have 16 inches; what is larger is the diagonal of a panel.
const LARGEST_INTENSIFIER_MM: f64 = 420.0;

impl FrameTags {
    /// How long after the first each image of the file was taken, µs, where it says so of each.
    #[must_use]
    pub fn image_times_us(&self) -> Vec<i64> {
        let first_ms = self.frame_times_ms.first().copied().unwrap_or(0.0);
        let after_ms = self.frame_times_ms.iter().scan(-first_ms, |sum_ms, step_ms| {
            *sum_ms += step_ms;
            Some(*sum_ms)
        });
        after_ms.map(|ms| (ms * 1e3).round() as i64).collect()
    }

    /// Whether they say anything of which exposure the frame is of.
    #[must_use]
    pub fn names_exposure(&self) -> bool {
        self.exposure_counter.is_some() || self.acquired_time.is_some()
    }

    /// Whether both say when they were acquired, finer than in whole seconds, in which there may be two exposures, and the same, with the same
    /// numbers.
    #[must_use]
    pub fn names_same_exposure(&self, other: &Self) -> bool {
        let said = |tags: &Self| (tags.acquired_local_us(), tags.exposure_counter, tags.instance_number, tags.study.clone());
        self.acquired_local_us().is_some_and(|us| us % 1_000_000 != 0) && said(self) == said(other)
    }

    /// In words, which attribute says that an image intensifier took the picture. Consoles of flat panels write the size of one as well, for that
    /// of their field: beside any word of a flat panel it says nothing.
    #[must_use]
    pub fn names_intensifier(&self) -> Option<String> {
        match self.receptor.as_deref() {
            Some("IMG_INTENSIFIER") => return Some("X-ray receptor type (0018,9420) is IMG_INTENSIFIER".to_owned()),
            Some(_) => return None,
            None => {}
        }
        let size_mm = self.intensifier_mm.filter(|_| !self.names_flat_panel())?;
        Some(format!("intensifier size (0018,1162) is {size_mm} mm"))
    }

    /// Whether an attribute says that a flat panel, and no image intensifier, took the picture.
    #[must_use]
    pub fn names_flat_panel(&self) -> bool {
        match self.receptor.as_deref() {
            Some(receptor) => receptor != "IMG_INTENSIFIER",
            None => {
                matches!(self.detector_type.as_deref(), Some("DIRECT" | "SCINTILLATOR" | "STORAGE"))
                    || self.field_of_view_shape.as_deref() == Some("RECTANGLE")
                    || self.field_of_view_mm.is_some_and(|[across, down]| across != down)
                    || self.intensifier_mm.is_some_and(|size_mm| !(size_mm <= LARGEST_INTENSIFIER_MM))
            }
        }
    }

    /// When the frame was acquired by the console's clock, microseconds since the Unix epoch; `None` unless the file gives date, time and
    /// time zone. The clock itself may be wrong by any amount.
    #[must_use]
    pub fn acquired_us(&self) -> Option<i64> {
        let offset_min = i64::from(self.timezone_offset_min?);
        Some(self.acquired_local_us()? - offset_min * 60_000_000)
    }

    /// Date and time of the console's clock as if its time zone were UTC, microseconds since the Unix epoch.
    #[must_use]
    pub fn acquired_local_us(&self) -> Option<i64> {
        let (date, time) = (self.acquired_date.as_deref()?, self.acquired_time.as_deref()?);
        let number = |text: &str, from: usize, to: usize| text.get(from..to)?.parse::<i64>().ok();
        let (year, month, day) = (number(date, 0, 4)?, number(date, 4, 6)?, number(date, 6, 8)?);
        if !(1..=12).contains(&month) || !(1..=31).contains(&day) {
            return None;
        }
        let (hour, minute, second) = (number(time, 0, 2)?, number(time, 2, 4).unwrap_or(0), number(time, 4, 6).unwrap_or(0));
        let fraction: String = time.get(7..).unwrap_or("").chars().chain("000000".chars()).take(6).collect();
        let micros = fraction.parse::<i64>().ok()?;
        // Days since 1970-01-01 in the proleptic Gregorian calendar, counting years from March so that the leap day is the last.
        let (shifted_year, shifted_month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
        let era = shifted_year.div_euclid(400);
        let year_of_era = shifted_year.rem_euclid(400);
        let day_of_year = (153 * shifted_month + 2) / 5 + day - 1;
        let days = era * 146_097 + year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year - 719_468;
        Some(((days * 24 + hour) * 3600 + minute * 60 + second) * 1_000_000 + micros)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn console_times_become_microseconds() {
        let mut tags =
            FrameTags { acquired_date: Some("20261121".into()), acquired_time: Some("050102.25".into()), ..FrameTags::default() };
        assert_eq!(tags.acquired_local_us(), Some(1_795_237_262_250_000));
        assert_eq!(tags.acquired_us(), None, "without a time zone nothing is claimed");
        tags.timezone_offset_min = Some(-240);
        assert_eq!(tags.acquired_us(), Some(1_795_237_262_250_000 + 4 * 3_600_000_000));
        tags.acquired_date = Some("20261321".into());
        assert_eq!(tags.acquired_local_us(), None, "month 13");
    }

    /// Consoles of flat panels give the size of their field as an intensifier's.
    #[test]
    fn an_intensifier_is_named_unless_a_flat_panel_is_named_too() {
        let text = |word: &str| Some(word.to_owned());
        let sized = FrameTags { intensifier_mm: Some(229.0), ..FrameTags::default() };
        assert!(sized.names_intensifier().is_some_and(|words| words.contains("(0018,1162) is 229 mm")));
        let round = FrameTags { field_of_view_shape: text("ROUND"), ..sized.clone() };
        assert!(round.names_intensifier().is_some());
        let typed = FrameTags { receptor: text("IMG_INTENSIFIER"), ..FrameTags::default() };
        assert!(typed.names_intensifier().is_some_and(|words| words.contains("(0018,9420)")));
        assert!(![&sized, &round, &typed].iter().any(|tags| tags.names_flat_panel()));
        for panel in [
            FrameTags::default(),
            FrameTags { intensifier_mm: Some(480.0), ..FrameTags::default() },
            FrameTags { field_of_view_mm: Some([300.0, 200.0]), ..sized.clone() },
            FrameTags { receptor: text("DIGITAL_DETECTOR"), ..sized.clone() },
            FrameTags { detector_type: text("SCINTILLATOR"), ..sized.clone() },
            FrameTags { field_of_view_shape: text("RECTANGLE"), ..sized.clone() },
        ] {
            assert_eq!(panel.names_intensifier(), None, "{panel:?}");
            assert_eq!(panel.names_flat_panel(), panel != FrameTags::default(), "{panel:?}");
        }
    }

    #[test]
    fn every_kept_tag_names_a_field() {
        let json = include_str!("tags.rs");
        for kept in KEPT_TAGS {
            assert!(json.contains(&format!("pub {}:", kept.field)), "{} has no field {}", kept.tag, kept.field);
            assert!(!kept.reason.is_empty());
        }
    }
}

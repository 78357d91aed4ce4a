//! What survives of a DICOM header: a whitelist of attributes and of terms, checked value by value, so that no free text passes.

use dicom_core::Tag;
use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;

use super::terms::is_term;

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
pub const KEPT_TAGS: [KeptTag; 31] = [
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
    kept(tags::DISTANCE_SOURCE_TO_PATIENT, "sod_mm", "magnification"),
    kept(tags::EXPOSURE_TIME, "exposure_ms", "length of the exposure interval"),
    kept(tags::X_RAY_TUBE_CURRENT, "tube_ma", "dose"),
    kept(tags::EXPOSURE, "exposure_uas", "dose, in mAs, when the finer attribute is missing"),
    kept(tags::EXPOSURE_INU_AS, "exposure_uas", "dose"),
    kept(tags::INTENSIFIER_SIZE, "intensifier_mm", "evidence of an image intensifier: distortion and processing"),
    kept(tags::IMAGER_PIXEL_SPACING, "pitch_mm", "pixel pitch at the detector"),
    kept(tags::PIXEL_SPACING, "pixel_spacing_mm", "pixel pitch at the object, where calibrated"),
    kept(tags::POSITIONER_PRIMARY_ANGLE, "primary_deg", "pose prior, + is LAO"),
    kept(tags::POSITIONER_SECONDARY_ANGLE, "secondary_deg", "pose prior, + is cranial"),
    kept(tags::FIELD_OF_VIEW_ROTATION, "field_of_view_rotation_deg", "how the console turned the image"),
    kept(tags::FIELD_OF_VIEW_HORIZONTAL_FLIP, "field_of_view_flipped", "whether the console mirrored the image"),
    kept(tags::PRESENTATION_INTENT_TYPE, "presentation_intent", "FOR PROCESSING or FOR PRESENTATION"),
    kept(tags::ACQUISITION_NUMBER, "exposure_counter", "binds the frame to an exposure"),
    kept(tags::INSTANCE_NUMBER, "instance_number", "order of export"),
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
    /// Source to detector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sid_mm: Option<f64>,
    /// Source to patient.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sod_mm: Option<f64>,
    /// Tube voltage.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kvp: Option<f64>,
    /// Tube current.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tube_ma: Option<f64>,
    /// Exposure time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_ms: Option<f64>,
    /// Exposure in µAs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_uas: Option<f64>,
    /// Acquisition number (0020,0012).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_counter: Option<u32>,
    /// Instance number (0020,0013).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub instance_number: Option<u32>,
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
    /// Diameter of the image intensifier.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intensifier_mm: Option<f64>,
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

impl FrameTags {
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

/// Reads attributes one by one and refuses what does not look as the standard says; a refused value is noted without being repeated.
pub(super) struct TagReader<'a> {
    object: &'a InMemDicomObject,
    notes: &'a mut Vec<String>,
}

impl<'a> TagReader<'a> {
    pub(super) fn new(object: &'a InMemDicomObject, notes: &'a mut Vec<String>) -> Self {
        Self { object, notes }
    }

    fn texts(&self, tag: Tag) -> Vec<String> {
        let Some(element) = self.object.get(tag) else { return Vec::new() };
        let Ok(values) = element.to_multi_str() else { return Vec::new() };
        values.iter().map(|value| value.trim_matches([' ', '\0']).to_owned()).filter(|value| !value.is_empty()).collect()
    }

    fn refuse(&mut self, tag: Tag, what: &str) {
        self.notes.push(format!("attribute {tag} is ignored: it is not {what}"));
    }

    /// Code strings that the standard defines for `field`; any other is dropped, because free text is put there too.
    pub(super) fn terms(&mut self, tag: Tag, field: &str) -> Vec<String> {
        let values = self.texts(tag);
        let count = values.len();
        let terms: Vec<String> = values.into_iter().filter(|value| is_term(field, value)).collect();
        if terms.len() < count {
            self.refuse(tag, "a term of the standard");
        }
        terms
    }

    pub(super) fn term(&mut self, tag: Tag, field: &str) -> Option<String> {
        self.terms(tag, field).into_iter().next()
    }

    /// A calendar day `YYYYMMDD`, unless it is the day of birth.
    fn date(&mut self, tag: Tag) -> Option<String> {
        let value = self.digits(tag, "")?;
        let born = self.texts(tags::PATIENT_BIRTH_DATE).into_iter().next();
        if is_day(&value) && born.as_deref() != Some(&value) {
            return Some(value);
        }
        self.refuse(tag, "a date of acquisition");
        None
    }

    /// `HHMMSS` with a fraction, or the start of it.
    fn time(&mut self, tag: Tag) -> Option<String> {
        let value = self.digits(tag, ".")?;
        let pair = |at: usize, below: u32| value.get(at..at + 2).is_none_or(|pair| pair.parse::<u32>().is_ok_and(|n| n < below));
        let whole = value.split('.').next().map_or(0, str::len);
        if matches!(whole, 2 | 4 | 6) && pair(0, 24) && pair(2, 60) && pair(4, 61) {
            return Some(value);
        }
        self.refuse(tag, "a time of day");
        None
    }

    fn digits(&mut self, tag: Tag, allowed: &str) -> Option<String> {
        let value = self.texts(tag).into_iter().next()?;
        if value.len() <= 26 && value.chars().all(|c| c.is_ascii_digit() || allowed.contains(c)) {
            return Some(value);
        }
        self.refuse(tag, "a date or time");
        None
    }

    pub(super) fn numbers(&mut self, tag: Tag) -> Vec<f64> {
        let values = self.texts(tag);
        let numbers: Vec<f64> =
            values.iter().filter_map(|value| value.parse().ok()).filter(|value: &f64| value.is_finite()).collect();
        if numbers.len() != values.len() {
            self.refuse(tag, "a finite number");
            return Vec::new();
        }
        numbers
    }

    pub(super) fn number(&mut self, tag: Tag) -> Option<f64> {
        self.numbers(tag).into_iter().next()
    }

    fn positive(&mut self, tag: Tag) -> Option<f64> {
        let value = self.number(tag)?;
        if value > 0.0 {
            return Some(value);
        }
        self.refuse(tag, "positive");
        None
    }

    fn counter(&mut self, tag: Tag) -> Option<u32> {
        let value = self.number(tag)?;
        if value >= 0.0 && value <= f64::from(u32::MAX) && value.fract() == 0.0 {
            return Some(value as u32);
        }
        self.refuse(tag, "a count");
        None
    }

    /// DICOM gives row spacing (along v) first; this is (u, v).
    fn spacing(&mut self, tag: Tag) -> Option<[f64; 2]> {
        match self.numbers(tag)[..] {
            [] => None,
            [along_v, along_u] if along_v > 0.0 && along_u > 0.0 => Some([along_u, along_v]),
            _ => {
                self.refuse(tag, "a pair of positive spacings");
                None
            }
        }
    }

    fn yes(&mut self, tag: Tag) -> Option<bool> {
        match self.texts(tag).first()?.as_str() {
            "YES" => Some(true),
            "NO" => Some(false),
            _ => {
                self.refuse(tag, "YES or NO");
                None
            }
        }
    }

    /// Reads the whole whitelist.
    pub(super) fn read(&mut self) -> FrameTags {
        let born = self.texts(tags::PATIENT_BIRTH_DATE).into_iter().next();
        let date_time = self
            .digits(tags::ACQUISITION_DATE_TIME, ".+-")
            .filter(|text| text.get(..8).is_some_and(is_day) && text.get(..8) != born.as_deref());
        let from_date_time = |from: usize, to: Option<usize>| {
            let text = date_time.as_deref()?;
            let end = text.find(['+', '-']).unwrap_or(text.len());
            let part = text.get(from..to.map_or(end, |to| to.min(end)))?;
            (!part.is_empty()).then(|| part.to_owned())
        };
        let zone = date_time.as_deref().and_then(|text| text.find(['+', '-']).map(|at| text[at..].to_owned()));
        let (mut date, mut time) = (self.date(tags::ACQUISITION_DATE), self.time(tags::ACQUISITION_TIME));
        if date.is_none() || time.is_none() {
            (date, time) = (from_date_time(0, Some(8)), from_date_time(8, None));
        }
        if date.is_none() || time.is_none() {
            (date, time) = (self.date(tags::CONTENT_DATE), self.time(tags::CONTENT_TIME));
        }
        let zone = zone.or_else(|| self.digits(tags::TIMEZONE_OFFSET_FROM_UTC, "+-"));
        let (centre, width) = (self.number(tags::WINDOW_CENTER), self.number(tags::WINDOW_WIDTH));
        let exposure_mas = self.positive(tags::EXPOSURE);
        FrameTags {
            modality: self.term(tags::MODALITY, "modality"),
            image_type: self.terms(tags::IMAGE_TYPE, "image_type"),
            pitch_mm: self.spacing(tags::IMAGER_PIXEL_SPACING),
            pixel_spacing_mm: self.spacing(tags::PIXEL_SPACING),
            sid_mm: self.positive(tags::DISTANCE_SOURCE_TO_DETECTOR),
            sod_mm: self.positive(tags::DISTANCE_SOURCE_TO_PATIENT),
            kvp: self.positive(tags::KVP),
            tube_ma: self.positive(tags::X_RAY_TUBE_CURRENT),
            exposure_ms: self.positive(tags::EXPOSURE_TIME),
            exposure_uas: self.positive(tags::EXPOSURE_INU_AS).or(exposure_mas.map(|mas| mas * 1000.0)),
            exposure_counter: self.counter(tags::ACQUISITION_NUMBER),
            instance_number: self.counter(tags::INSTANCE_NUMBER),
            acquired_date: date,
            acquired_time: time,
            timezone_offset_min: zone.as_deref().and_then(minutes_from_zone),
            primary_deg: self.number(tags::POSITIONER_PRIMARY_ANGLE),
            secondary_deg: self.number(tags::POSITIONER_SECONDARY_ANGLE),
            intensifier_mm: self.positive(tags::INTENSIFIER_SIZE),
            field_of_view_rotation_deg: self.number(tags::FIELD_OF_VIEW_ROTATION),
            field_of_view_flipped: self.yes(tags::FIELD_OF_VIEW_HORIZONTAL_FLIP),
            photometric: self.term(tags::PHOTOMETRIC_INTERPRETATION, "photometric"),
            intensity_relationship: self.term(tags::PIXEL_INTENSITY_RELATIONSHIP, "intensity_relationship"),
            intensity_sign: self.number(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN).map(|sign| if sign < 0.0 { -1 } else { 1 }),
            presentation_intent: self.term(tags::PRESENTATION_INTENT_TYPE, "presentation_intent"),
            burned_in_annotation: self.yes(tags::BURNED_IN_ANNOTATION),
            bits_stored: self.counter(tags::BITS_STORED),
            window: centre.zip(width).filter(|(_, width)| *width > 0.0).map(|(centre, width)| [centre, width]),
        }
    }
}

/// Whether `text` is `YYYYMMDD` in the time of digital radiography.
fn is_day(text: &str) -> bool {
    let number = |from: usize, to: usize| text.get(from..to).and_then(|part| part.parse::<u32>().ok()).unwrap_or(0);
    text.len() == 8
        && (1980..=2100).contains(&number(0, 4))
        && (1..=12).contains(&number(4, 6))
        && (1..=31).contains(&number(6, 8))
}

fn minutes_from_zone(zone: &str) -> Option<i32> {
    let sign = match zone.get(..1)? {
        "-" => -1,
        "+" => 1,
        _ => return None,
    };
    let (hours, minutes) = (zone.get(1..3)?.parse::<i32>().ok()?, zone.get(3..5)?.parse::<i32>().ok()?);
    (hours <= 14 && minutes < 60).then_some(sign * (hours * 60 + minutes))
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
        tags.timezone_offset_min = minutes_from_zone("-0400");
        assert_eq!(tags.acquired_us(), Some(1_795_237_262_250_000 + 4 * 3_600_000_000));
        tags.acquired_date = Some("20261321".into());
        assert_eq!(tags.acquired_local_us(), None, "month 13");
        assert_eq!(minutes_from_zone("+2500"), None);
    }

    #[test]
    fn days_are_those_of_digital_radiography() {
        assert!(is_day("20261121") && !is_day("19521204") && !is_day("20261321"));
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

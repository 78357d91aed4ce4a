//! Reads the attributes of a DICOM header that are kept, value by value, so that no free text passes.

use dicom_core::Tag;
use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;
use serde::de::DeserializeOwned;

use super::beam_tags::{CollimatorTags, FilterForm, FilterLayer, FilterMaterial, FilterTags};
use super::tags::FrameTags;
use super::terms::is_term;
use crate::image::sha256_bytes;

/// Thicker filters are none, and numbers beyond it are something else.
const MOST_FILTER_MM: f64 = 50.0;
/// Shutters further from the picture are no shutters.
const MOST_PX: f64 = 65_535.0;
/// No picture is wider.
const MOST_FIELD_MM: f64 = 5000.0;

/// No blades have more corners.
const MOST_CORNERS: usize = 64;
/// No series of exposures in one file has more images.
const MOST_OF_SERIES: usize = 64;

/// The attributes of an opening.
struct OpeningTags {
    shape: Tag,
    /// Left, upper, right, lower.
    edges: [Tag; 4],
    centre: Tag,
    radius: Tag,
    corners: Tag,
}

const COLLIMATOR: OpeningTags = OpeningTags {
    shape: tags::COLLIMATOR_SHAPE,
    edges: [
        tags::COLLIMATOR_LEFT_VERTICAL_EDGE,
        tags::COLLIMATOR_UPPER_HORIZONTAL_EDGE,
        tags::COLLIMATOR_RIGHT_VERTICAL_EDGE,
        tags::COLLIMATOR_LOWER_HORIZONTAL_EDGE,
    ],
    centre: tags::CENTER_OF_CIRCULAR_COLLIMATOR,
    radius: tags::RADIUS_OF_CIRCULAR_COLLIMATOR,
    corners: tags::VERTICES_OF_THE_POLYGONAL_COLLIMATOR,
};

const DISPLAY_SHUTTER: OpeningTags = OpeningTags {
    shape: tags::SHUTTER_SHAPE,
    edges: [
        tags::SHUTTER_LEFT_VERTICAL_EDGE,
        tags::SHUTTER_UPPER_HORIZONTAL_EDGE,
        tags::SHUTTER_RIGHT_VERTICAL_EDGE,
        tags::SHUTTER_LOWER_HORIZONTAL_EDGE,
    ],
    centre: tags::CENTER_OF_CIRCULAR_SHUTTER,
    radius: tags::RADIUS_OF_CIRCULAR_SHUTTER,
    corners: tags::VERTICES_OF_THE_POLYGONAL_SHUTTER,
};

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

    /// Of a file of many images one time stands for all: they are of one exposure.
    fn frame_times_ms(&mut self) -> Vec<f64> {
        let times_ms = self.numbers(tags::FRAME_TIME_VECTOR);
        let is_series = times_ms.len() <= MOST_OF_SERIES && times_ms.iter().all(|ms| *ms >= 0.0);
        if is_series { times_ms } else { Vec::new() }
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
        // An integer string ends at 2³¹ − 1: a count beyond that is written as its complement of two. −1 is the count that is none.
        if (f64::from(i32::MIN)..-1.0).contains(&value) && value.fract() == 0.0 {
            return Some((value as i32).cast_unsigned());
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

    /// The variants that stand for the standard's terms, each at its place among the values; any other word is dropped.
    fn variants<T: DeserializeOwned>(&mut self, tag: Tag) -> Vec<Option<T>> {
        let values = self.texts(tag);
        let variants: Vec<Option<T>> = values.into_iter().map(|value| serde_json::from_value(value.into()).ok()).collect();
        if variants.iter().any(Option::is_none) {
            self.refuse(tag, "a term of the standard");
        }
        variants
    }

    fn filter(&mut self) -> Option<FilterTags> {
        let materials = self.materials();
        let form = self.variants::<FilterForm>(tags::FILTER_TYPE).into_iter().flatten().next();
        // "None" beside a material is of wedges alone.
        let form = form.filter(|form| *form != FilterForm::NoFilter || materials.is_empty());
        let thinnest = self.thicknesses(tags::FILTER_THICKNESS_MINIMUM, materials.len());
        let thickest = self.thicknesses(tags::FILTER_THICKNESS_MAXIMUM, materials.len());
        let ends = thinnest.as_ref().or(thickest.as_ref()).zip(thickest.as_ref().or(thinnest.as_ref()));
        let layer = |(place, material): (usize, FilterMaterial)| {
            let thickness_mm = ends.map(|(a, b)| [a[place].min(b[place]), a[place].max(b[place])]);
            FilterLayer { material, thickness_mm }
        };
        let layers: Vec<FilterLayer> = materials.into_iter().enumerate().map(layer).collect();
        (form.is_some() || !layers.is_empty()).then_some(FilterTags { form, layers })
    }

    /// The filter's materials, each at its place: by the standard's terms (PS3.3 C.8.7.10), by other spellings and by symbols. Any other word is a
    /// material as well, of which only that is kept.
    fn materials(&mut self) -> Vec<FilterMaterial> {
        let tag = tags::FILTER_MATERIAL;
        let known = |value: String| FilterMaterial::named(&value).unwrap_or(FilterMaterial::Other);
        let materials: Vec<FilterMaterial> = self.texts(tag).into_iter().map(known).collect();
        let others = materials.iter().filter(|material| **material == FilterMaterial::Other).count();
        if others > 0 {
            let count = materials.len();
            self.notes.push(format!(
                "attribute {tag} has {others} of {count} words that are no filter material of the standard: what else filters the beam is not known"
            ));
        }
        materials
    }

    fn thicknesses(&mut self, tag: Tag, materials: usize) -> Option<Vec<f64>> {
        let values = self.numbers(tag);
        if values.is_empty() {
            return None;
        }
        if values.len() == materials && values.iter().all(|mm| (0.0..=MOST_FILTER_MM).contains(mm)) {
            return Some(values);
        }
        self.refuse(tag, "a thickness in mm for each filter material");
        None
    }

    fn opening(&mut self, of: &OpeningTags) -> Option<CollimatorTags> {
        let shapes: Vec<_> = self.variants(of.shape).into_iter().flatten().collect();
        let edges_px = match of.edges.map(|tag| self.place(tag)) {
            [Some(left), Some(top), Some(right), Some(bottom)] if left < right && top < bottom => {
                Some([left, top, right, bottom])
            }
            _ => None,
        };
        let centre_px = match self.places(of.centre)[..] {
            // DICOM gives the row first; this is (u, v).
            [row, column] => Some([column, row]),
            _ => None,
        };
        let radius_px = self.place(of.radius).filter(|radius| *radius > 0.0);
        let corners_px = self.corners(of.corners);
        let opening = CollimatorTags { shapes, edges_px, centre_px, radius_px, corners_px };
        (opening != CollimatorTags::default()).then_some(opening)
    }

    fn corners(&mut self, tag: Tag) -> Vec<[f64; 2]> {
        let values = self.places(tag);
        if values.is_empty() {
            return Vec::new();
        }
        let pairs = values.chunks_exact(2);
        if pairs.remainder().is_empty() && (3..=MOST_CORNERS).contains(&pairs.len()) {
            // DICOM gives the row first; this is (u, v).
            return pairs.map(|pair| [pair[1], pair[0]]).collect();
        }
        self.refuse(tag, "a polygon's rows and columns");
        Vec::new()
    }

    /// Numbers of columns, rows or pixels, in the picture or not far from it.
    fn places(&mut self, tag: Tag) -> Vec<f64> {
        let values = self.numbers(tag);
        if values.iter().all(|px| px.abs() <= MOST_PX) {
            return values;
        }
        self.refuse(tag, "a place in the picture");
        Vec::new()
    }

    fn place(&mut self, tag: Tag) -> Option<f64> {
        self.places(tag).into_iter().next()
    }

    fn field_of_view(&mut self) -> Option<[f64; 2]> {
        let is_length = |mm: &f64| *mm > 0.0 && *mm <= MOST_FIELD_MM;
        match self.numbers(tags::FIELD_OF_VIEW_DIMENSIONS)[..] {
            [] => None,
            [diameter] if is_length(&diameter) => Some([diameter; 2]),
            // PS3.3 C.8.11.4.1.1: the row dimension, which is row spacing times rows, comes first; this is (u, v).
            [down, across] if is_length(&down) && is_length(&across) => Some([across, down]),
            _ => {
                self.refuse(tags::FIELD_OF_VIEW_DIMENSIONS, "one or two lengths in mm");
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
            // The vertical side comes first, as in spacings.
            pixel_aspect: self.spacing(tags::PIXEL_ASPECT_RATIO),
            sid_mm: self.positive(tags::DISTANCE_SOURCE_TO_DETECTOR),
            sod_mm: self.positive(tags::DISTANCE_SOURCE_TO_PATIENT),
            magnification: self.positive(tags::ESTIMATED_RADIOGRAPHIC_MAGNIFICATION_FACTOR),
            kvp: self.positive(tags::KVP),
            tube_ma: self.positive(tags::X_RAY_TUBE_CURRENT),
            exposure_ms: self.positive(tags::EXPOSURE_TIME),
            radiation_setting: self.term(tags::RADIATION_SETTING, "radiation_setting"),
            frame_time_ms: self.positive(tags::FRAME_TIME),
            frame_times_ms: self.frame_times_ms(),
            exposure_uas: self.positive(tags::EXPOSURE_INU_AS).or(exposure_mas.map(|mas| mas * 1000.0)),
            exposure_counter: self.counter(tags::ACQUISITION_NUMBER),
            instance_number: self.counter(tags::INSTANCE_NUMBER),
            study: self.texts(tags::STUDY_INSTANCE_UID).first().map(|uid| study_hash(uid)),
            acquired_date: date,
            acquired_time: time,
            timezone_offset_min: zone.as_deref().and_then(minutes_from_zone),
            primary_deg: self.number(tags::POSITIONER_PRIMARY_ANGLE),
            secondary_deg: self.number(tags::POSITIONER_SECONDARY_ANGLE),
            filter: self.filter(),
            collimator: self.opening(&COLLIMATOR),
            display_shutter: self.opening(&DISPLAY_SHUTTER),
            field_of_view_mm: self.field_of_view(),
            intensifier_mm: self.positive(tags::INTENSIFIER_SIZE),
            receptor: self.term(tags::X_RAY_RECEPTOR_TYPE, "receptor"),
            detector_type: self.term(tags::DETECTOR_TYPE, "detector_type"),
            field_of_view_shape: self.term(tags::FIELD_OF_VIEW_SHAPE, "field_of_view_shape"),
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

fn study_hash(uid: &str) -> String {
    sha256_bytes(format!("sidecarm study {uid}").as_bytes()).chars().take(12).collect()
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
    fn days_are_those_of_digital_radiography() {
        assert!(is_day("20261121") && !is_day("19521204") && !is_day("20261321"));
    }

    #[test]
    fn zones_become_minutes() {
        assert_eq!(minutes_from_zone("-0400"), Some(-240));
        assert_eq!(minutes_from_zone("+2500"), None);
    }
}

//! What the header of one DICOM file says of the CT slices in it. Of its texts nothing passes: a series and an image are known by a hash of
//! what names them.

use dicom_core::Tag;
use dicom_dictionary_std::{tags, uids};
use dicom_object::InMemDicomObject;
use glam::DVec3;

use crate::acquire::parse_dicom;
use crate::image::sha256_bytes;

/// What one file is to a series.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) enum FileHead {
    /// CT slices.
    Ct(CtHead),
    /// A localizer (scout, topogram).
    Localizer,
    /// DICOM, and no CT.
    Other,
    /// A data set that does not parse.
    Damaged,
}

/// A file with CT slices: one, or all of a series.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct CtHead {
    /// What tells its series from another.
    pub series: String,
    /// The number of the series on its console.
    pub series_number: Option<i32>,
    /// What tells its scan from another.
    pub scan: ScanHead,
    /// Its slices, or what one of them lacks.
    pub slices: Result<Vec<SliceHead>, String>,
}

/// What the files of one scan have in common, names by a hash; `None` where a file does not say it.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct ScanHead {
    pub patient: Option<String>,
    pub study: Option<String>,
    pub frame_of_reference: Option<String>,
    pub patient_position: Option<String>,
    /// It says that it is no CT, though stored as one.
    pub is_other_modality: bool,
    /// It says that it shows the brightest or darkest along a depth, or a surface.
    pub is_projection: bool,
}

/// One slice.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct SliceHead {
    /// What tells its image from another.
    pub image: String,
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Centre of its first pixel, `lps` mm.
    pub first_pixel_in_lps: DVec3,
    /// Where columns count up to, unit.
    pub along_row: DVec3,
    /// Where rows count up to, unit.
    pub along_column: DVec3,
    /// From column to column, and from row to row.
    pub pitch_mm: [f64; 2],
    /// Its thickness by its own word.
    pub thickness_mm: Option<f64>,
    /// How far it lies from the next by its own word.
    pub between_mm: Option<f64>,
    /// Its number; none where several are in one file.
    pub number: Option<i32>,
}

/// Classes of one slice a file.
const SINGLE: [&str; 2] = [uids::CT_IMAGE_STORAGE, uids::CT_IMAGE_STORAGE_FOR_PROCESSING];
/// Classes of many slices a file.
const MULTI: [&str; 4] = [
    uids::ENHANCED_CT_IMAGE_STORAGE,
    uids::LEGACY_CONVERTED_ENHANCED_CT_IMAGE_STORAGE,
    uids::ENHANCED_CT_IMAGE_STORAGE_FOR_PROCESSING,
    uids::LEGACY_CONVERTED_ENHANCED_CT_IMAGE_STORAGE_FOR_PROCESSING,
];
/// Slices of a file that are looked at.
const MOST_SLICES: u32 = 1 << 14;
/// Direction cosines are rounded when they are written; from this on they are wrong.
const UNIT_LIMIT: f64 = 1e-3;
/// Within this they are kept bit by bit.
const UNIT_EXACT: f64 = 1e-9;

/// Looks at a file; its pixels need not be there.
pub(super) fn file_head(bytes: &[u8]) -> FileHead {
    let Ok(object) = parse_dicom(bytes, Some(tags::PIXEL_DATA)) else { return FileHead::Damaged };
    let class = text(&object, tags::SOP_CLASS_UID).unwrap_or_default();
    let is_multi = MULTI.contains(&class.as_str());
    if !is_multi && !SINGLE.contains(&class.as_str()) {
        return FileHead::Other;
    }
    if terms(&object, tags::IMAGE_TYPE).iter().any(|term| term == "LOCALIZER") {
        return FileHead::Localizer;
    }
    let series = text(&object, tags::SERIES_INSTANCE_UID).unwrap_or_default();
    let series_number = object.get(tags::SERIES_NUMBER).and_then(|element| element.to_int().ok());
    let slices = if is_multi { slices_of_many(&object) } else { slice(&object, 0).map(|slice| vec![slice]) };
    FileHead::Ct(CtHead { series: key(&series), series_number, scan: scan(&object), slices })
}

fn scan(object: &InMemDicomObject) -> ScanHead {
    let hashed = |tag: Tag| text(object, tag).filter(|text| !text.is_empty()).map(|text| key(&text));
    let frame_type = terms(group(object, 0, tags::CT_IMAGE_FRAME_TYPE_SEQUENCE), tags::FRAME_TYPE);
    ScanHead {
        patient: hashed(tags::PATIENT_ID),
        study: hashed(tags::STUDY_INSTANCE_UID),
        frame_of_reference: hashed(tags::FRAME_OF_REFERENCE_UID),
        patient_position: hashed(tags::PATIENT_POSITION),
        is_other_modality: text(object, tags::MODALITY).is_some_and(|modality| !matches!(modality.as_str(), "CT" | "")),
        is_projection: terms(object, tags::IMAGE_TYPE).iter().chain(&frame_type).any(|term| is_projection(term)),
    }
}

/// Terms of an image type that mean a projection, by the standard and as vendors write them (`CSA MIP`).
fn is_projection(term: &str) -> bool {
    let is_word = |word: &str| matches!(word, "MIP" | "MINIP" | "VRT" | "SSD");
    matches!(term, "MAX_IP" | "MIN_IP" | "VOLUME_RENDER" | "SURFACE_RENDER" | "PROJECTION") || term.split([' ', '_']).any(is_word)
}

fn terms(object: &InMemDicomObject, tag: Tag) -> Vec<String> {
    let found = object.get(tag).and_then(|element| element.to_multi_str().ok());
    found.map(|terms| terms.iter().map(|term| term.trim_matches([' ', '\0']).to_owned()).collect()).unwrap_or_default()
}

/// A name of the file's own, so that nobody can read it but everybody can compare it.
fn key(text: &str) -> String {
    sha256_bytes(text.as_bytes()).get(..16).unwrap_or_default().to_owned()
}

fn text(object: &InMemDicomObject, tag: Tag) -> Option<String> {
    Some(object.get(tag)?.to_str().ok()?.trim_matches([' ', '\0']).to_owned())
}

fn slices_of_many(object: &InMemDicomObject) -> Result<Vec<SliceHead>, String> {
    let count = object.get(tags::NUMBER_OF_FRAMES).and_then(|element| element.to_int::<u32>().ok()).unwrap_or(1);
    if !(1..=MOST_SLICES).contains(&count) {
        return Err(format!("has {count} frames (0028,0008), expected 1 to {MOST_SLICES}"));
    }
    // The number is that of the file.
    (0..count as usize).map(|frame| slice(object, frame).map(|slice| SliceHead { number: None, ..slice })).collect()
}

/// The item that holds what is said of `frame` under `sequence`: its own, else that of all frames; the data set itself where there are no
/// such groups.
pub(super) fn group(object: &InMemDicomObject, frame: usize, sequence: Tag) -> &InMemDicomObject {
    let item = |groups: Tag, index: usize| {
        let groups = object.get(groups)?.value().items()?.get(index)?;
        groups.get(sequence)?.value().items()?.first()
    };
    item(tags::PER_FRAME_FUNCTIONAL_GROUPS_SEQUENCE, frame)
        .or_else(|| item(tags::SHARED_FUNCTIONAL_GROUPS_SEQUENCE, 0))
        .unwrap_or(object)
}

fn slice(object: &InMemDicomObject, frame: usize) -> Result<SliceHead, String> {
    let pixels = |tag: Tag, name: &str| {
        let found = object.get(tag).and_then(|element| element.to_int::<u32>().ok()).filter(|count| *count > 0);
        found.map(|count| count as usize).ok_or_else(|| format!("has no {name}"))
    };
    let size_px = [pixels(tags::COLUMNS, "columns (0028,0011)")?, pixels(tags::ROWS, "rows (0028,0010)")?];
    let place = group(object, frame, tags::PLANE_POSITION_SEQUENCE);
    let turned = group(object, frame, tags::PLANE_ORIENTATION_SEQUENCE);
    let measures = group(object, frame, tags::PIXEL_MEASURES_SEQUENCE);
    let [x, y, z] = numbers(place, tags::IMAGE_POSITION_PATIENT, "image position (0020,0032)")?;
    let cosines: [f64; 6] = numbers(turned, tags::IMAGE_ORIENTATION_PATIENT, "image orientation (0020,0037)")?;
    let [between_rows, between_columns] = numbers(measures, tags::PIXEL_SPACING, "pixel spacing (0028,0030)")?;
    if !(between_rows > 0.0 && between_columns > 0.0) {
        return Err(format!("has a pixel spacing (0028,0030) of {between_rows} and {between_columns} mm, expected above 0"));
    }
    let along_row = unit(DVec3::new(cosines[0], cosines[1], cosines[2]))?;
    let along_column = unit(DVec3::new(cosines[3], cosines[4], cosines[5]))?;
    if !(along_row.dot(along_column).abs() <= UNIT_LIMIT) {
        let cosine = along_row.dot(along_column);
        return Err(format!("has an image orientation (0020,0037) whose axes are not perpendicular (cosine {cosine:.4})"));
    }
    let name = text(object, tags::SOP_INSTANCE_UID).unwrap_or_default();
    // Some write zero or a sign for what they do not know.
    let length_mm = |tag: Tag| {
        let found = measures.get(tag).and_then(|element| element.to_float64().ok());
        found.map(f64::abs).filter(|mm| mm.is_finite() && *mm > 0.0)
    };
    Ok(SliceHead {
        image: key(&format!("{name}/{frame}")),
        size_px,
        first_pixel_in_lps: DVec3::new(x, y, z),
        along_row,
        along_column,
        pitch_mm: [between_columns, between_rows],
        thickness_mm: length_mm(tags::SLICE_THICKNESS),
        between_mm: length_mm(tags::SPACING_BETWEEN_SLICES),
        number: object.get(tags::INSTANCE_NUMBER).and_then(|element| element.to_int().ok()),
    })
}

/// Exactly `N` finite numbers.
fn numbers<const N: usize>(object: &InMemDicomObject, tag: Tag, name: &str) -> Result<[f64; N], String> {
    let found = object.get(tag).and_then(|element| element.to_multi_float64().ok());
    let found = found.and_then(|found| <[f64; N]>::try_from(found).ok()).filter(|all| all.iter().all(|n| n.is_finite()));
    found.ok_or_else(|| format!("has no {name} of {N} numbers"))
}

fn unit(direction: DVec3) -> Result<DVec3, String> {
    let off = (direction.length() - 1.0).abs();
    if !(off <= UNIT_LIMIT) {
        return Err(format!("has an image orientation (0020,0037) of length {:.4}, expected 1", direction.length()));
    }
    Ok(if off <= UNIT_EXACT { direction } else { direction.normalize() })
}

//! Voxels of a CT series: the pixels of its slices in order, in Hounsfield units.

use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;

use super::ct_slice::group;
use super::head::{VolumeHead, VoxelSummary};
use super::rescales::{Rescaled, jumps};
use crate::acquire::{StoredValue, StoredValues, parse_dicom};
use crate::foreign::Limits;
use crate::scene::density::DensityCurve;

/// A series as a helper is asked for it: the files come in this order.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct SlicesWanted {
    pub head: VolumeHead,
    /// Of each file, the slices that are wanted, in order.
    pub slices_of_files: Vec<Vec<usize>>,
}

/// Slices of a file, at most.
const MOST_SLICES: u64 = 1 << 14;
/// What padding becomes where it would pass for air: below anything that is reconstructed.
const PADDING_HU: f64 = -2000.0;

/// Reads the slices of `wanted` from the contents of its files, which `next` gives one after the other.
///
/// # Errors
/// One sentence, when a slice is damaged or not what its header said, or `start` or `take` gives up.
pub(super) fn decode_slices(
    wanted: &SlicesWanted,
    next: &mut dyn FnMut() -> Result<Option<Vec<u8>>, String>,
    limits: &Limits,
    start: &mut dyn FnMut(&VolumeHead) -> Result<(), String>,
    take: &mut dyn FnMut(&[f32]) -> Result<(), String>,
) -> Result<VoxelSummary, String> {
    start(&wanted.head)?;
    // A file may hold all slices, which a volume's limits count as one image.
    let limits = Limits { images: MOST_SLICES, ..limits.clone() };
    let [columns, rows, count] = wanted.head.size;
    let mut reading = Reading::default();
    let mut values: Vec<f32> = Vec::with_capacity(columns * rows);
    let mut done = 0;
    for slices in &wanted.slices_of_files {
        let number = done + 1;
        let of = |detail: String| format!("slice {number} of {count}: {detail}");
        let bytes = next()?.ok_or_else(|| of("its file was not given".to_owned()))?;
        let object = parse_dicom(&bytes, None).map_err(|fault| of(fault.to_string()))?;
        drop(bytes);
        let mut notes = Vec::new();
        let stored = StoredValues::of(&object, &limits, &mut notes).map_err(|fault| of(fault.to_string()))?;
        if stored.size_px() != [columns, rows] || slices.iter().any(|slice| *slice >= stored.images()) {
            return Err(of("it changed while the series was read; try again when it lies still".to_owned()));
        }
        for slice in slices {
            let scale = Scale::of(&object, *slice).map_err(&of)?;
            values.clear();
            values.extend(stored.image(*slice).map(|pixel| reading.value(&scale, pixel)));
            reading.note(&scale);
            take(&values)?;
            done += 1;
        }
        reading.other.extend(notes);
    }
    reading.other.sort();
    reading.other.dedup();
    Ok(reading.summary())
}

/// From stored values to Hounsfield units.
struct Scale {
    slope: f64,
    intercept: f64,
    /// Both were missing.
    is_absent: bool,
    /// The unit is another, by the file's own word.
    is_other: bool,
    /// The unit is left open, by the file's own word.
    is_open: bool,
}

impl Scale {
    fn of(object: &InMemDicomObject, slice: usize) -> Result<Self, String> {
        let scale = group(object, slice, tags::PIXEL_VALUE_TRANSFORMATION_SEQUENCE);
        if scale.get(tags::MODALITY_LUT_SEQUENCE).is_some() {
            return Err("it has a modality look-up table (0028,3000), expected rescale slope and intercept".to_owned());
        }
        let number = |tag| scale.get(tag).map(|element| element.to_float64().ok().filter(|number| number.is_finite()));
        let (slope, intercept) = (number(tags::RESCALE_SLOPE), number(tags::RESCALE_INTERCEPT));
        let unit = scale.get(tags::RESCALE_TYPE).and_then(|element| element.to_str().ok());
        let unit = unit.as_ref().map_or("", |unit| unit.trim_matches([' ', '\0']));
        let (is_other, is_open) = (!matches!(unit, "HU" | "US" | ""), unit == "US");
        match (slope, intercept) {
            (None, None) => Ok(Self { slope: 1.0, intercept: 0.0, is_absent: true, is_other, is_open }),
            (Some(Some(slope)), Some(Some(intercept))) if slope != 0.0 => {
                Ok(Self { slope, intercept, is_absent: false, is_other, is_open })
            }
            _ => Err("its rescale slope and intercept (0028,1053 and 0028,1052) are not usable".to_owned()),
        }
    }
}

/// What is counted on the way.
#[derive(Default)]
struct Reading {
    summary: VoxelSummary,
    padding: u64,
    beyond: u64,
    absent: u64,
    other_unit: u64,
    open_unit: u64,
    other: Vec<String>,
    /// Of the slice that is read: how many pixels are no padding, and their sum as stored.
    measured: u64,
    stored_sum: f64,
    rescaled: Vec<Rescaled>,
}

impl Reading {
    fn value(&mut self, scale: &Scale, stored: StoredValue) -> f32 {
        let mut hu = stored.value as f64 * scale.slope + scale.intercept;
        self.beyond += u64::from(stored.holds_more);
        if stored.is_padding {
            self.padding += 1;
            // Nothing was reconstructed there, and the scene knows that by the number alone.
            if !(hu <= DensityCurve::shipped().unknown_at_most_hu) {
                hu = PADDING_HU;
            }
        } else {
            self.measured += 1;
            self.stored_sum += stored.value as f64;
        }
        let value = hu as f32;
        self.summary.count(value);
        value
    }

    fn note(&mut self, scale: &Scale) {
        self.absent += u64::from(scale.is_absent);
        self.other_unit += u64::from(scale.is_other);
        self.open_unit += u64::from(scale.is_open);
        let stored_mean = std::mem::take(&mut self.stored_sum) / std::mem::take(&mut self.measured) as f64;
        self.rescaled.push(Rescaled { slope: scale.slope, intercept: scale.intercept, stored_mean });
    }

    fn summary(self) -> VoxelSummary {
        let mut summary = self.summary;
        let warning = |words: String| (Some("not HU".to_owned()), words);
        if self.beyond > 0 {
            let words = format!(
                "{} voxels hold more than the bits that are stored (0028,0101): the rest was cut off, as overlays are; if they are \
                 bright, their values have wrapped round",
                self.beyond
            );
            summary.remarks.push((Some("stored bits".to_owned()), words));
        }
        if self.absent > 0 {
            let words = format!("{} slices have no rescale slope and intercept: stored values are taken for HU", self.absent);
            summary.remarks.push(warning(words));
        }
        if self.other_unit > 0 {
            let words = format!("{} slices are not in HU by their own word (rescale type 0028,1054)", self.other_unit);
            summary.remarks.push(warning(words));
        }
        if self.open_unit > 0 {
            let words = format!(
                "{} slices leave their unit open (rescale type 0028,1054 is US, unspecified): they are taken for HU",
                self.open_unit
            );
            summary.remarks.push((None, words));
        }
        summary.remarks.extend(jumps(&self.rescaled));
        if self.padding > 0 {
            let words = format!("{} voxels are padding by the file's own word (0028,0120): not reconstructed", self.padding);
            summary.remarks.push((None, words));
        }
        summary.remarks.extend(self.other.into_iter().map(|words| (None, words)));
        summary
    }
}

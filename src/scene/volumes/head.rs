//! What the header of a volume says, whatever its format, and what is checked of it before a voxel is read.

use glam::DAffine3;

use crate::foreign::Limits;
use crate::memory;

/// What a person should hear: a kind of warning, or none for a note, and the words.
pub(super) type Remark = (Option<String>, String);

/// What a volume's header says.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct VolumeHead {
    /// What kind of file this is.
    pub format: VolumeFormat,
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`, mm.
    pub lps_from_voxel: DAffine3,
    /// What placed it.
    pub placed_by: PlacedBy,
    /// Type of the stored values.
    pub data_type: String,
    /// Unit of length in the header.
    pub unit: String,
    /// What a person should hear.
    pub remarks: Vec<Remark>,
    /// Numbers and names of labels, where the file has a table of them.
    pub label_names: Vec<(u32, String)>,
}

impl VolumeHead {
    /// All voxels.
    pub fn voxels(&self) -> u64 {
        self.size.iter().map(|n| *n as u64).product()
    }

    /// Distance of voxel centres along i, j, k.
    pub fn spacing_mm(&self) -> [f64; 3] {
        let axes = self.lps_from_voxel.matrix3;
        [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| axis.length())
    }

    /// Adds a remark where voxels have a size that is hardly in millimetres.
    pub fn doubt_spacing(&mut self) {
        let spacing_mm = self.spacing_mm();
        if !spacing_mm.into_iter().all(is_plausible) {
            let words = format!("voxels of {spacing_mm:?} mm: metres or microns taken for millimetres?");
            self.remarks.push((Some("voxel size".to_owned()), words));
        }
    }
}

/// Formats of volumes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum VolumeFormat {
    /// NIfTI-1 in one file.
    #[serde(rename = "NIfTI")]
    Nifti,
    /// NRRD, its voxels in the same file or in another.
    #[serde(rename = "NRRD")]
    Nrrd,
    /// MetaImage, its voxels in the same file or in another.
    MetaImage,
    /// Slices of one CT series, or one file with all of them.
    #[serde(rename = "DICOM series")]
    DicomSeries,
}

impl VolumeFormat {
    /// In words.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Nifti => "NIfTI",
            Self::Nrrd => "NRRD",
            Self::MetaImage => "MetaImage",
            Self::DicomSeries => "DICOM series",
        }
    }
}

/// What of a header places its volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum PlacedBy {
    /// The affine matrix of NIfTI.
    #[serde(rename = "sform")]
    Sform,
    /// The quaternion of NIfTI.
    #[serde(rename = "qform")]
    Qform,
    /// Nothing but the sizes of voxels.
    #[serde(rename = "voxel sizes only")]
    SpacingOnly,
    /// Space, space directions and space origin of NRRD.
    #[serde(rename = "space directions")]
    SpaceDirections,
    /// Matrix, offset and spacing of MetaImage.
    #[serde(rename = "transform matrix")]
    TransformMatrix,
    /// Image position, orientation and pixel spacing of each DICOM slice.
    #[serde(rename = "image positions")]
    ImagePositions,
}

impl PlacedBy {
    /// In words.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Sform => "sform",
            Self::Qform => "qform",
            Self::SpacingOnly => "voxel sizes only",
            Self::SpaceDirections => "space directions",
            Self::TransformMatrix => "transform matrix",
            Self::ImagePositions => "image positions",
        }
    }
}

/// What all voxels together say.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct VoxelSummary {
    /// Smallest and largest finite value; `None` without any.
    pub range: Option<[f32; 2]>,
    /// Voxels that are NaN or infinite.
    pub not_finite: u64,
    /// What is known only once the voxels are read.
    pub remarks: Vec<Remark>,
}

impl VoxelSummary {
    /// Takes one more voxel into account.
    pub fn count(&mut self, value: f32) {
        if value.is_finite() {
            let [low, high] = self.range.unwrap_or([value, value]);
            self.range = Some([low.min(value), high.max(value)]);
        } else {
            self.not_finite += 1;
        }
    }
}

/// What a voxel takes once it is rendered: density, class, whether it is known, and the kind of its cell.
const BYTES_PER_VOXEL: u64 = 7;

/// Voxel sizes outside this are probably metres or microns taken for millimetres. The ends belong to it, in single precision too.
const PLAUSIBLE_SPACING_MM: (f64, f64) = (0.005 * 0.999_9, 20.0 * 1.000_1);

fn is_plausible(spacing_mm: f64) -> bool {
    (PLAUSIBLE_SPACING_MM.0..=PLAUSIBLE_SPACING_MM.1).contains(&spacing_mm)
}

/// Refuses a volume that is empty, or larger than limits and memory allow.
///
/// # Errors
/// One sentence.
pub(super) fn check_size(size: [u64; 3], limits: &Limits) -> Result<[usize; 3], String> {
    let what = format!("{} x {} x {} voxels", size[0], size[1], size[2]);
    if size.contains(&0) {
        return Err(format!("{what}: it is empty, or its header is damaged"));
    }
    let voxels = size.iter().try_fold(1u64, |product, n| product.checked_mul(*n)).unwrap_or(u64::MAX);
    if let Some(refused) = memory::refusal(&what, voxels.saturating_mul(BYTES_PER_VOXEL), memory::available_bytes()) {
        return Err(format!("{refused}; crop or resample it, or free memory"));
    }
    if voxels > limits.file_pixels {
        return Err(format!("{what} are {voxels}, at most {} are read; crop or resample it", limits.file_pixels));
    }
    Ok(size.map(|n| n as usize))
}

/// Refuses a place that is none; `by` is what says it.
///
/// # Errors
/// One sentence.
pub(super) fn check_place(lps_from_voxel: &DAffine3, by: &str) -> Result<(), String> {
    if !lps_from_voxel.is_finite() {
        return Err(format!("{by} holds a number that is not finite"));
    }
    let m = lps_from_voxel.matrix3;
    let relative = m.determinant().abs() / (m.x_axis.length() * m.y_axis.length() * m.z_axis.length());
    if !(relative > 1e-6) {
        return Err(format!("{by} is singular: its axes have no volume"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slices_of_two_centimetres_in_single_precision_are_millimetres() {
        for spacing_mm in [20.0, 20.000_000_8, 0.005, 0.004_999_999_9, 1.0] {
            assert!(is_plausible(spacing_mm), "{spacing_mm}");
        }
        for spacing_mm in [20.1, 0.0049, 0.0, f64::NAN, f64::INFINITY] {
            assert!(!is_plausible(spacing_mm), "{spacing_mm}");
        }
    }
}

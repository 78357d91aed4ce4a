//! Volumes: CT, labels and fractions from NIfTI, NRRD, MetaImage and DICOM series, in `lps` and mm. They are foreign files, which a helper
//! process decodes.
//!
//! ```text
//! parent: source (which files?) ─ series (which slices, in which order?), one_scan           ┐ exchange
//! helper: nifti · nrrd, metaimage → header_file · ct_slice, slices, rescales ─ voxels ─ head ┘
//! ```

mod ct_slice;
mod exchange;
mod head;
mod header_file;
mod label_table;
mod metaimage;
mod nifti;
mod nrrd;
mod one_scan;
mod reorder;
mod rescales;
mod series;
mod slices;
mod source;
mod voxels;
mod write_nifti;

use std::path::Path;

use glam::DAffine3;

use super::SceneError;
use crate::foreign::Kind;
use crate::geometry::VoxelGrid;
use crate::reporter::Reporter;

use head::{VolumeHead, VoxelSummary};

pub(super) use exchange::serve;
pub use head::{PlacedBy, VolumeFormat};
pub use source::{VolumeContent, VolumeSource, is_ct_slice, is_volume};
pub use write_nifti::write_nifti;

/// A volume as its file has it, in `lps` and mm.
#[derive(Clone, Debug)]
pub struct VolumeFile {
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`.
    pub lps_from_voxel: DAffine3,
    /// Scaled values, i fastest.
    pub values: Vec<f32>,
    /// Which form placed it.
    pub placed_by: PlacedBy,
    /// Distance of voxel centres along i, j, k.
    pub spacing_mm: [f64; 3],
    /// Numbers and names of labels, where the file has a table of them.
    pub label_names: Vec<(u32, String)>,
}

impl VolumeFile {
    /// Its size and place.
    #[must_use]
    pub fn grid(&self) -> VoxelGrid {
        VoxelGrid { size: self.size, lps_from_voxel: self.lps_from_voxel }
    }
}

/// What `info` says of a volume.
#[derive(Clone, Debug)]
pub struct VolumeFacts {
    /// What kind of file it is.
    pub format: VolumeFormat,
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`.
    pub lps_from_voxel: DAffine3,
    /// Distance of voxel centres along i, j, k.
    pub spacing_mm: [f64; 3],
    /// Which form placed it.
    pub placed_by: PlacedBy,
    /// Type of the stored values.
    pub data_type: String,
    /// Unit of length in the header.
    pub unit: String,
    /// Smallest and largest finite value.
    pub range: Option<[f32; 2]>,
    /// Voxels that are NaN or infinite.
    pub not_finite: u64,
    /// What a person should hear of it.
    pub remarks: Vec<String>,
}

/// Reads a volume: a NIfTI, NRRD or MetaImage file, or the DICOM series of a folder or of one of its slices. Reports what is odd about it.
///
/// # Errors
/// When a file cannot be read, is damaged or cut short, is no single volume of numbers, holds NaN or infinity, or lies nowhere.
pub fn read_volume(path: &Path, reporter: &Reporter) -> Result<VolumeFile, SceneError> {
    VolumeSource::open(path)?.read_voxels(reporter)
}

/// Header and range of a volume, whose voxels are decoded but not kept.
///
/// # Errors
/// As [`read_volume`], but NaN and infinity are counted.
pub fn read_volume_facts(path: &Path) -> Result<VolumeFacts, SceneError> {
    let (head, _, summary) = VolumeSource::open(path)?.read(Kind::VolumeFacts)?;
    let spacing_mm = head.spacing_mm();
    let remarks = head.remarks.iter().chain(&summary.remarks).map(|(_, words)| words.clone()).collect();
    let VolumeHead { format, size, lps_from_voxel, placed_by, data_type, unit, .. } = head;
    let VoxelSummary { range, not_finite, .. } = summary;
    Ok(VolumeFacts { format, size, lps_from_voxel, spacing_mm, placed_by, data_type, unit, range, not_finite, remarks })
}

impl VolumeSource {
    /// Its voxels. Reports what is odd about them.
    ///
    /// # Errors
    /// As [`read_volume`].
    pub fn read_voxels(&self, reporter: &Reporter) -> Result<VolumeFile, SceneError> {
        let (head, values, summary) = self.read(Kind::Volume)?;
        let shown = self.path().display();
        for (kind, words) in head.remarks.iter().chain(&summary.remarks) {
            match kind {
                Some(kind) => reporter.warn(kind, format_args!("{shown}: {words}")),
                None => reporter.note(format_args!("{shown}: {words}")),
            }
        }
        if summary.not_finite > 0 {
            let (bad, all) = (summary.not_finite, head.voxels());
            let detail = format!(
                "{bad} of {all} voxels are NaN or infinite; replace them (air is -1000 HU in a CT, nothing is 0 in labels and \
                 fractions) and try again"
            );
            return Err(SceneError::Volume { path: self.path().to_owned(), detail });
        }
        let spacing_mm = head.spacing_mm();
        let VolumeHead { size, lps_from_voxel, placed_by, label_names, .. } = head;
        Ok(VolumeFile { size, lps_from_voxel, values, placed_by, spacing_mm, label_names })
    }
}

//! NIfTI volumes in `lps`: header rules, affines, values.

use std::path::Path;

use glam::{DAffine3, DMat3, DVec3};
use nifti::{IntoNdArray, NiftiHeader, NiftiObject, ReaderOptions};

use super::SceneError;
use crate::reporter::Reporter;

/// A scalar grid in `lps`.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`.
    pub lps_from_voxel: DAffine3,
    /// i varies fastest; slope and intercept applied.
    pub values: Vec<f32>,
}

/// Voxel sizes outside this are suspected to be in other units.
const PLAUSIBLE_VOXEL_MM: (f64, f64) = (0.005, 20.0);

/// Reads a `.nii` or `.nii.gz` file.
///
/// # Errors
/// When the file cannot be read, is damaged or truncated, has more than three dimensions, no voxels, a singular affine, or values that
/// are not finite.
pub fn read(path: &Path, reporter: &Reporter) -> Result<Grid, SceneError> {
    let wrong = |detail: String| SceneError::Volume { path: path.to_owned(), detail };
    if path.is_dir() {
        return Err(wrong("is a folder; DICOM series are not available in this version, convert them to NIfTI".to_owned()));
    }
    if let Err(source) = std::fs::File::open(path) {
        return Err(SceneError::Io { path: path.to_owned(), source });
    }
    let name = path.to_string_lossy().to_lowercase();
    if !(name.ends_with(".nii") || name.ends_with(".nii.gz")) {
        return Err(wrong("is no NIfTI file by its name; .nii and .nii.gz are read".to_owned()));
    }
    let damaged = |error: nifti::NiftiError| wrong(format!("is not a readable NIfTI file, or is cut short ({error})"));
    let object = ReaderOptions::new().read_file(path).map_err(damaged)?;
    let header = object.header().clone();
    let rank = usize::from(header.dim[0]);
    if !(1..=7).contains(&rank) || header.dim[4..].iter().take(rank.saturating_sub(3)).any(|n| *n > 1) {
        return Err(wrong(format!("has dimensions {:?}, expected one volume of three", &header.dim[1..=rank.clamp(1, 7)])));
    }
    let size: [usize; 3] = std::array::from_fn(|axis| if axis < rank { usize::from(header.dim[axis + 1]) } else { 1 });
    if size.contains(&0) {
        return Err(wrong(format!("has {size:?} voxels, none to render")));
    }
    let lps_from_voxel = lps_from_voxel(&header, path, reporter)?;
    let array = object.into_volume().into_ndarray::<f32>().map_err(damaged)?;
    let count = size.iter().product::<usize>();
    // Arrays come in Fortran order, so the reversed view iterates with i fastest.
    let values: Vec<f32> = array.t().iter().copied().collect();
    if values.len() != count {
        return Err(wrong(format!("holds {} voxels, its header promises {count}", values.len())));
    }
    let bad = values.iter().filter(|value| !value.is_finite()).count();
    if bad > 0 {
        return Err(wrong(format!("has {bad} voxels that are NaN or infinite; fill them (air is -1000 HU)")));
    }
    Ok(Grid { size, lps_from_voxel, values })
}

/// sform before qform before voxel sizes, converted from RAS to LPS and to millimetres.
fn lps_from_voxel(header: &NiftiHeader, path: &Path, reporter: &Reporter) -> Result<DAffine3, SceneError> {
    let ras_from_voxel = if header.sform_code > 0 {
        let rows = [header.srow_x, header.srow_y, header.srow_z].map(|row| row.map(f64::from));
        let column = |c: usize| DVec3::new(rows[0][c], rows[1][c], rows[2][c]);
        DAffine3::from_mat3_translation(DMat3::from_cols(column(0), column(1), column(2)), column(3))
    } else if header.qform_code > 0 {
        from_quaternion(header)
    } else {
        reporter.warn("no orientation", format!("{}: no orientation in the header; voxel axes are taken as RAS", path.display()));
        let spacing = DVec3::new(header.pixdim[1].into(), header.pixdim[2].into(), header.pixdim[3].into()).abs();
        DAffine3::from_scale(spacing.map(|s| if s > 0.0 { s } else { 1.0 }))
    };
    let to_mm = match header.xyzt_units & 7 {
        1 => 1000.0,
        3 => 1e-3,
        _ => 1.0,
    };
    if to_mm != 1.0 {
        reporter.warn(
            "units",
            format!("{}: header is in {}, converted to mm", path.display(), if to_mm > 1.0 { "metres" } else { "micrometres" }),
        );
    }
    let lps_from_ras = DAffine3::from_scale(DVec3::new(-1.0, -1.0, 1.0));
    let affine = lps_from_ras * DAffine3::from_scale(DVec3::splat(to_mm)) * ras_from_voxel;
    let lengths = [affine.matrix3.x_axis.length(), affine.matrix3.y_axis.length(), affine.matrix3.z_axis.length()];
    let determinant = affine.matrix3.determinant() / (lengths[0] * lengths[1] * lengths[2]);
    if !(affine.is_finite() && determinant.abs() > 1e-6) {
        let detail = format!("has a singular or non-finite affine (voxel sizes {lengths:?} mm); rewrite its orientation");
        return Err(SceneError::Volume { path: path.to_owned(), detail });
    }
    let (least, most) = PLAUSIBLE_VOXEL_MM;
    if lengths.iter().any(|length| !(*length >= least && *length <= most)) {
        let message = format!("{}: voxels of {lengths:?} mm; metres and millimetres mixed up?", path.display());
        reporter.warn("voxel size", message);
    }
    Ok(affine)
}

/// NIfTI-1 method 2.
fn from_quaternion(header: &NiftiHeader) -> DAffine3 {
    let [b, c, d] = [header.quatern_b, header.quatern_c, header.quatern_d].map(f64::from);
    let a = (1.0 - b * b - c * c - d * d).max(0.0).sqrt();
    let rotation = glam::DQuat::from_xyzw(b, c, d, a).normalize();
    let handed = if header.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
    let spacing = DVec3::new(header.pixdim[1].into(), header.pixdim[2].into(), f64::from(header.pixdim[3]) * handed);
    let origin = DVec3::new(header.quatern_x.into(), header.quatern_y.into(), header.quatern_z.into());
    DAffine3::from_scale_rotation_translation(spacing, rotation, origin)
}

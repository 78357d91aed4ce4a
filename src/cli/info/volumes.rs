//! Volumes and meshes.

use std::path::Path;

use glam::{DQuat, DVec3};
use nifti::{NiftiHeader, NiftiObject, ReaderOptions};
use serde_json::json;

use super::{Found, InfoError, object};

pub(super) fn nifti(path: &Path) -> Result<Found, InfoError> {
    let damaged = |detail: String| InfoError::Damaged { path: path.to_owned(), kind: "NIfTI volume", detail };
    let header = NiftiHeader::from_file(path).map_err(|error| damaged(format!("header: {error}")))?;
    let size: Vec<u64> = header.dim().map_err(|error| damaged(error.to_string()))?.iter().map(|&n| u64::from(n)).collect();
    let voxels = size.iter().try_fold(1u64, |product, &n| product.checked_mul(n)).unwrap_or(u64::MAX);
    if voxels == 0 {
        return Err(damaged(format!("size {size:?} holds no voxel")));
    }
    let expected = voxels.saturating_mul(u64::from(header.bitpix.unsigned_abs()) / 8);
    let found = content_bytes(path).map_err(|error| damaged(format!("{error}; the file is cut short or corrupt")))?;
    if expected > found {
        return Err(damaged(format!("header promises {expected} bytes of voxels, the file holds {found}: it is cut short")));
    }
    let volume =
        ReaderOptions::new().read_file(path).map_err(|error| damaged(format!("voxels: {error}; the file is cut short")))?;
    let (axes, origin) = ras_from_voxel(volume.header());
    let data_type = volume.header().data_type().map(|kind| format!("{kind:?}")).unwrap_or_else(|_| "unknown".into());
    let units =
        volume.header().xyzt_to_space().map(|unit| format!("{unit:?}").to_lowercase()).unwrap_or_else(|_| "unknown".into());
    let (sform, qform) = (volume.header().sform_code, volume.header().qform_code);
    let values = nifti::IntoNdArray::into_ndarray::<f32>(volume.into_volume()).map_err(|error| damaged(error.to_string()))?;
    let not_finite = values.iter().filter(|value| !value.is_finite()).count();
    let (low, high) = values
        .iter()
        .filter(|value| value.is_finite())
        .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), &value| (low.min(value), high.max(value)));
    let spacing_mm = axes.map(|axis| axis.length());
    let handed = axes[0].cross(axes[1]).dot(axes[2]);
    let row = |index: usize, sign: f64| [axes[0], axes[1], axes[2], origin].map(|column| sign * column[index] + 0.0);
    let facts = json!({
        "format": "NIfTI",
        "size": size,
        "spacing_mm": spacing_mm,
        "orientation": orientation(&axes),
        "handedness": if handed > 0.0 { "right" } else if handed < 0.0 { "left" } else { "degenerate" },
        "data_type": data_type,
        "space_unit": units,
        "value_range": [low, high],
        "not_finite": not_finite,
        "transform_from": if sform > 0 { "sform" } else if qform > 0 { "qform" } else { "voxel sizes only" },
        // NIfTI is RAS; `lps` negates x and y.
        "lps_from_voxel": [row(0, -1.0), row(1, -1.0), row(2, 1.0), [0.0, 0.0, 0.0, 1.0]],
        "notes": notes(low, high, not_finite, &spacing_mm, &units),
    });
    Ok(("volume", object(facts), Vec::new()))
}

/// Bytes in the file after unpacking; reads a gzip stream to its checksum, which the volume's reader does not.
fn content_bytes(path: &Path) -> std::io::Result<u64> {
    use std::io::Read;
    let mut file = std::io::BufReader::new(std::fs::File::open(path)?);
    let mut magic = [0u8; 2];
    file.read_exact(&mut magic)?;
    let mut rest = magic.as_slice().chain(file);
    if magic == [0x1f, 0x8b] {
        return std::io::copy(&mut flate2::bufread::MultiGzDecoder::new(rest), &mut std::io::sink());
    }
    std::io::copy(&mut rest, &mut std::io::sink())
}

/// Columns of the transform from voxel indices to RAS, and its origin: the sform where there is one, else the qform, else the spacings.
fn ras_from_voxel(header: &NiftiHeader) -> ([DVec3; 3], DVec3) {
    let spacing = [1, 2, 3].map(|axis| f64::from(header.pixdim[axis]));
    if header.sform_code > 0 {
        let column = |j: usize| DVec3::new(header.srow_x[j].into(), header.srow_y[j].into(), header.srow_z[j].into());
        return ([column(0), column(1), column(2)], column(3));
    }
    if header.qform_code > 0 {
        let vector = DVec3::new(header.quatern_b.into(), header.quatern_c.into(), header.quatern_d.into());
        let scalar = (1.0 - vector.length_squared()).max(0.0).sqrt();
        let turn = DQuat::from_xyzw(vector.x, vector.y, vector.z, scalar).normalize();
        let third = if header.pixdim[0] < 0.0 { -spacing[2] } else { spacing[2] };
        let axes = [turn * DVec3::X * spacing[0], turn * DVec3::Y * spacing[1], turn * DVec3::Z * third];
        return (axes, DVec3::new(header.quatern_x.into(), header.quatern_y.into(), header.quatern_z.into()));
    }
    ([DVec3::X * spacing[0], DVec3::Y * spacing[1], DVec3::Z * spacing[2]], DVec3::ZERO)
}

/// What looks odd for a CT.
fn notes(low: f32, high: f32, not_finite: usize, spacing_mm: &[f64; 3], units: &str) -> Vec<String> {
    let mut notes = Vec::new();
    if not_finite > 0 {
        notes.push(format!("{not_finite} voxels are NaN or infinite"));
    }
    if low >= 0.0 && high <= 255.0 {
        notes.push("values lie within 0 and 255: labels or a fraction, not Hounsfield units".into());
    } else if low > -500.0 {
        notes.push("no voxel is near −1000: perhaps not in Hounsfield units".into());
    }
    if spacing_mm.iter().any(|&spacing| !(0.005..=50.0).contains(&spacing)) {
        notes.push(format!(
            "a voxel spacing of {spacing_mm:?} mm is unusual: metres or micrometres suspected (unit in the header: {units})"
        ));
    }
    notes
}

/// Letters of the anatomical direction that each voxel axis points to (towards right, left, anterior …), as RAS+.
fn orientation(axes: &[DVec3; 3]) -> String {
    axes.iter()
        .map(|axis| {
            let letters = [(axis.x, 'R', 'L'), (axis.y, 'A', 'P'), (axis.z, 'S', 'I')];
            let most = letters.iter().copied().reduce(|a, b| if b.0.abs() > a.0.abs() { b } else { a });
            most.map_or('?', |(value, positive, negative)| if value >= 0.0 { positive } else { negative })
        })
        .collect()
}

pub(super) fn stl(path: &Path) -> Result<Found, InfoError> {
    let damaged =
        |error: std::io::Error| InfoError::Damaged { path: path.to_owned(), kind: "STL mesh", detail: error.to_string() };
    let file = std::fs::File::open(path).map_err(|source| InfoError::Io { path: path.to_owned(), source })?;
    let mesh = stl_io::read_stl(&mut std::io::BufReader::new(file)).map_err(damaged)?;
    let mut edges: std::collections::HashMap<(usize, usize), i32> = std::collections::HashMap::new();
    for face in &mesh.faces {
        for (from, to) in [(0, 1), (1, 2), (2, 0)].map(|(a, b)| (face.vertices[a], face.vertices[b])) {
            *edges.entry((from.min(to), from.max(to))).or_default() += if from < to { 1 } else { -1 };
        }
    }
    let open_edges = edges.values().filter(|&&balance| balance != 0).count();
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for vertex in &mesh.vertices {
        for axis in 0..3 {
            low[axis] = low[axis].min(vertex[axis]);
            high[axis] = high[axis].max(vertex[axis]);
        }
    }
    if mesh.faces.is_empty() {
        return Err(damaged(std::io::Error::other("no triangle")));
    }
    let facts = json!({
        "format": "STL",
        "triangles": mesh.faces.len(),
        "vertices": mesh.vertices.len(),
        "from_mm": low,
        "to_mm": high,
        "watertight": open_edges == 0,
        "open_edges": open_edges,
    });
    Ok(("mesh", object(facts), Vec::new()))
}

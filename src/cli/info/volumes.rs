//! Volumes and meshes.

use std::collections::HashMap;
use std::path::Path;

use glam::DVec3;
use serde_json::json;

use super::found::{Found, InfoError, object};
use super::{described, frames};
use crate::scene::{SceneError, Triangle, mesh_unit_doubt, read_triangles, read_volume_facts};

/// The scene's word on a file, as `info` says it.
fn damaged(path: &Path, kind: &'static str, error: SceneError) -> InfoError {
    let path = path.to_owned();
    match error {
        SceneError::Io { source, .. } => InfoError::Io { path, source },
        SceneError::Volume { detail, .. } | SceneError::Mesh { detail, .. } => InfoError::Damaged { path, kind, detail },
        other => InfoError::Damaged { path, kind, detail: other.to_string() },
    }
}

/// A CT slice: the volume that it is a part of, else what it is by itself.
pub(super) fn of_slice(path: &Path) -> Result<Found, InfoError> {
    match examine(path) {
        Err(InfoError::NoVolume { detail, .. }) => {
            let (kind, facts, mut losses) = frames::examine(path)?;
            losses.push(format!("no volume: {detail}"));
            Ok((kind, facts, losses))
        }
        other => other,
    }
}

/// A volume of any format: a file, or the folder of a series.
pub(super) fn examine(path: &Path) -> Result<Found, InfoError> {
    let facts = read_volume_facts(path).map_err(|error| match (error, kind_by_name(path)) {
        (SceneError::Volume { detail, .. }, None) => InfoError::NoVolume { path: path.to_owned(), detail },
        (error, kind) => damaged(path, kind.unwrap_or("volume"), error),
    })?;
    let matrix = facts.lps_from_voxel;
    // NIfTI is RAS; `lps` negates x and y.
    let ras = |axis: DVec3| DVec3::new(-axis.x, -axis.y, axis.z);
    let axes = [matrix.matrix3.x_axis, matrix.matrix3.y_axis, matrix.matrix3.z_axis];
    let handed = axes[0].cross(axes[1]).dot(axes[2]);
    let row = |index: usize| [axes[0], axes[1], axes[2], matrix.translation].map(|column| column[index] + 0.0);
    let [low, high] = facts.range.unwrap_or([f32::NAN, f32::NAN]);
    let dose = described::dose(path, facts.size);
    let mut notes: Vec<String> = not_finite(facts.not_finite).into_iter().collect();
    if dose.is_none() {
        notes.extend(not_hu(low, high));
    }
    notes.extend(odd_spacing(&facts.spacing_mm, &facts.unit));
    notes.extend(facts.remarks);
    let found = json!({
        "format": facts.format.words(),
        "quantity": dose,
        "unit": dose.map(|_| "Gy"),
        "size": facts.size,
        "spacing_mm": facts.spacing_mm,
        "orientation": orientation(&axes.map(ras)),
        "handedness": if handed > 0.0 { "right" } else if handed < 0.0 { "left" } else { "degenerate" },
        "data_type": facts.data_type,
        "space_unit": facts.unit,
        "value_range": facts.range,
        "not_finite": facts.not_finite,
        "transform_from": facts.placed_by.words(),
        "lps_from_voxel": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
        "notes": notes,
    });
    Ok(("volume", object(found), Vec::new()))
}

/// What a volume should be by the ending of its name; `None` for folders and slices.
fn kind_by_name(path: &Path) -> Option<&'static str> {
    let ending = path.extension().filter(|_| !path.is_dir())?.to_ascii_lowercase();
    match ending.to_str()? {
        "nii" | "gz" => Some("NIfTI volume"),
        "nrrd" | "nhdr" => Some("NRRD volume"),
        "mha" | "mhd" => Some("MetaImage volume"),
        _ => None,
    }
}

fn not_finite(voxels: u64) -> Option<String> {
    (voxels > 0).then(|| format!("{voxels} voxels are NaN or infinite"))
}

/// What looks odd for a CT's values.
fn not_hu(low: f32, high: f32) -> Option<String> {
    if low >= 0.0 && high <= 255.0 {
        Some("values lie within 0 and 255: labels or a fraction, not Hounsfield units".into())
    } else if low > -500.0 {
        Some("no voxel is near −1000: perhaps not in Hounsfield units".into())
    } else {
        None
    }
}

fn odd_spacing(spacing_mm: &[f64; 3], units: &str) -> Option<String> {
    let is_odd = spacing_mm.iter().any(|&spacing| !(0.005..=50.0).contains(&spacing));
    is_odd.then(|| {
        format!("a voxel spacing of {spacing_mm:?} mm is unusual: metres or micrometres suspected (unit in the header: {units})")
    })
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
    let triangles = read_triangles(path).map_err(|error| damaged(path, "STL mesh", error))?;
    if triangles.is_empty() {
        return Err(InfoError::Damaged { path: path.to_owned(), kind: "STL mesh", detail: "no triangle".into() });
    }
    let (vertices, open_edges) = count_vertices_and_open_edges(&triangles);
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for vertex in triangles.iter().flatten() {
        for axis in 0..3 {
            low[axis] = low[axis].min(vertex[axis]);
            high[axis] = high[axis].max(vertex[axis]);
        }
    }
    let longest_mm = (0..3).map(|axis| f64::from(high[axis] - low[axis])).fold(0.0, f64::max);
    let facts = json!({
        "format": "STL",
        "triangles": triangles.len(),
        "vertices": vertices,
        "from_mm": low,
        "to_mm": high,
        "watertight": open_edges == 0,
        "open_edges": open_edges,
        "notes": mesh_unit_doubt(longest_mm).into_iter().collect::<Vec<String>>(),
    });
    Ok(("mesh", object(facts), Vec::new()))
}

/// Different positions, and edges that are not walked as often in one direction as in the other.
fn count_vertices_and_open_edges(triangles: &[Triangle]) -> (usize, usize) {
    let mut known: HashMap<[u32; 3], usize> = HashMap::new();
    let mut balance: HashMap<(usize, usize), i32> = HashMap::new();
    for triangle in triangles {
        let corners = triangle.map(|vertex| {
            let next = known.len();
            // Adding zero makes −0 and 0 the same vertex.
            *known.entry(vertex.map(|x| (x + 0.0).to_bits())).or_insert(next)
        });
        for (from, to) in [(0, 1), (1, 2), (2, 0)].map(|(a, b)| (corners[a], corners[b])) {
            *balance.entry((from.min(to), from.max(to))).or_default() += if from < to { 1 } else { -1 };
        }
    }
    (known.len(), balance.values().filter(|&&balance| balance != 0).count())
}

//! Eq. 5 read with a resampled third volume: L_ct − L_overlap + L_tool, where the overlap is the CT's density resampled where the tool is,
//! on a voxel grid of the tool's own. For measurement only: the executors mask later objects along the ray instead, which has no grid
//! and no such error.

use std::sync::Arc;

use glam::{DAffine3, DMat3, DVec3};

use super::integrate_density::{Density, integrate_density};
use crate::geometry::View;
use crate::render::RenderError;
use crate::render::cells::Cells;
use crate::render::meshes::MadeMesh;
use crate::render::plan_parts::Sampling;
use crate::render::prepared::Prepared;
use crate::scene::model::{Matter, Object, Scene, Shape, Solid, Volume};

/// Voxels that a tool's grid may have.
const MOST_VOXELS: f64 = 2e8;

/// Area densities by Eq. 5 with the overlap resampled at `grid_mm`, in a grid parallel to the first shape's axes around all shapes.
/// `scene` must be one CT followed by shapes, the tool.
///
/// Per material the difference is clamped at zero: the overlap reaches up to a voxel beyond the tool.
///
/// # Errors
/// When the scene is not one volume followed by shapes, `grid_mm` is no length, or the grid has too many voxels.
pub fn overlap_by_resampling(scene: &Scene, view: &View, grid_mm: f64) -> Result<Density, RenderError> {
    let (ct, tool) = split(scene)?;
    if !(grid_mm > 0.0 && grid_mm.is_finite()) {
        return Err(RenderError::Number { what: "grid_mm", value: grid_mm, expected: "a positive number of millimetres" });
    }
    let mut density = integrate(scene, view, vec![Matter::Volume(ct.clone())])?;
    let tool_only = integrate(scene, view, vec![Matter::Solids(tool.clone())])?;
    let materials = scene.materials.len();
    for (class, material) in ct.class_materials.iter().enumerate() {
        let overlap = resampled(ct, class as u8 + 1, *material, &tool, grid_mm)?;
        let overlap = integrate(scene, view, vec![Matter::Volume(Arc::new(overlap))])?;
        let paths = density.g_per_cm2.iter_mut().zip(&overlap.g_per_cm2);
        paths.skip(*material).step_by(materials).for_each(|(path, overlap)| *path -= overlap);
    }
    for (path, tool) in density.g_per_cm2.iter_mut().zip(&tool_only.g_per_cm2) {
        *path = path.max(0.0) + tool;
    }
    Ok(density)
}

fn split(scene: &Scene) -> Result<(&Arc<Volume>, Vec<Solid>), RenderError> {
    let wrong = |name: &str, detail: &str| RenderError::Volume { name: name.to_owned(), detail: detail.to_owned() };
    let Some((first, later)) = scene.objects.split_first() else {
        return Err(wrong("objects", "the scene is empty, expected one CT and then the shapes of a tool"));
    };
    let Matter::Volume(ct) = &first.matter else {
        return Err(wrong(&first.name, "expected a CT as the first object"));
    };
    let mut tool = Vec::new();
    for object in later {
        match &object.matter {
            Matter::Solids(solids) => tool.extend_from_slice(solids),
            _ => return Err(wrong(&object.name, "expected shapes after the CT")),
        }
    }
    if tool.is_empty() {
        return Err(wrong(&first.name, "expected the shapes of a tool after the CT"));
    }
    Ok((ct, tool))
}

/// Area densities of some matter of `scene` alone.
fn integrate(scene: &Scene, view: &View, matters: Vec<Matter>) -> Result<Density, RenderError> {
    let object = |matter| Object { name: "part".to_owned(), body: String::new(), matter };
    let part = Scene { objects: matters.into_iter().map(object).collect(), ..scene.clone() };
    let prepared = Prepared::new(
        &part,
        *view,
        |volume, name| {
            let too_many =
                || RenderError::Volume { name: name.to_owned(), detail: "more than 250 materials in one volume".to_owned() };
            Cells::new(volume, None).map(|cells| (Arc::new(cells), None)).ok_or_else(too_many)
        },
        |mesh| Arc::new(MadeMesh::new(mesh)),
    )?;
    Ok(integrate_density(&prepared, Sampling::ExactCells))
}

/// The CT's density of one class at the centres of the tool's voxels that lie in the tool, nothing elsewhere.
fn resampled(ct: &Volume, class: u8, material: usize, tool: &[Solid], grid_mm: f64) -> Result<Volume, RenderError> {
    let lps_from_tool = tool[0].lps_from_local;
    let tool_from_lps = lps_from_tool.inverse();
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for solid in tool {
        let (centre, radius_mm) = solid.shape.bounding_sphere();
        let centre = tool_from_lps.transform_point(solid.lps_from_local.transform_point(centre));
        (low, high) = (low.min(centre - radius_mm), high.max(centre + radius_mm));
    }
    // A voxel of nothing all around, so that the field ends inside the grid.
    let size = ((high - low) / grid_mm).ceil() + 2.0;
    if !(size.element_product() <= MOST_VOXELS) {
        let expected = "coarse enough that the tool's grid has at most 2e8 voxels";
        return Err(RenderError::Number { what: "grid_mm", value: grid_mm, expected });
    }
    let size = size.to_array().map(|n| n as usize);
    let first = low - 0.5 * grid_mm;
    let turn = DMat3::from_quat(lps_from_tool.rotation);
    let lps_from_voxel = DAffine3 { matrix3: turn * grid_mm, translation: lps_from_tool.transform_point(first) };
    let voxel_from_lps = ct.lps_from_voxel.inverse();
    let density_g_per_cm3: Vec<f32> = (0..size[0] * size[1] * size[2])
        .map(|index| {
            let at = [index % size[0], index / size[0] % size[1], index / (size[0] * size[1])];
            let point = lps_from_voxel.transform_point3(DVec3::from_array(at.map(|n| n as f64)));
            let inside = tool.iter().any(|solid| holds(&solid.shape, solid.lps_from_local.inverse().transform_point(point)));
            if inside { field(ct, class, voxel_from_lps.transform_point3(point)) } else { 0.0 }
        })
        .collect();
    Ok(Volume {
        size,
        lps_from_voxel,
        class: density_g_per_cm3.iter().map(|density| u8::from(*density > 0.0)).collect(),
        density_g_per_cm3,
        class_materials: vec![material],
        truncated_at_faces: false,
        unknown: Vec::new(),
    })
}

/// Whether a point in the shape's frame is in its matter.
fn holds(shape: &Shape, p: DVec3) -> bool {
    match *shape {
        Shape::Ellipsoid { semi_axes_mm } => (p / semi_axes_mm).length_squared() <= 1.0,
        Shape::Cuboid { half_size_mm } => p.abs().cmple(half_size_mm).all(),
        Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } => {
            let across = p.x.hypot(p.y);
            (0.0..=length_mm).contains(&p.z) && across <= radius_mm && across >= inner_radius_mm
        }
    }
}

/// ρ of one class at continuous voxel coordinates: the trilinear field of DESIGN §5.
fn field(volume: &Volume, class: u8, voxel: DVec3) -> f32 {
    let mut cells = [(0usize, 0usize, 0.0f64); 3];
    for (axis, cell) in cells.iter_mut().enumerate() {
        let last = volume.size[axis] - 1;
        if !(voxel[axis] >= -0.5 && voxel[axis] <= last as f64 + 0.5) {
            return 0.0;
        }
        let x = voxel[axis].clamp(0.0, last as f64);
        let low = (x as usize).min(last);
        *cell = (low, (low + 1).min(last), x - low as f64);
    }
    let corner = |bits: usize| {
        let side = |axis: usize| {
            let (low, high, upper) = cells[axis];
            if bits >> axis & 1 == 1 { (high, upper) } else { (low, 1.0 - upper) }
        };
        let ((i, a), (j, b), (k, c)) = (side(0), side(1), side(2));
        let index = volume.index(i, j, k);
        if volume.class[index] == class { a * b * c * f64::from(volume.density_g_per_cm3[index]) } else { 0.0 }
    };
    (0..8).map(corner).sum::<f64>() as f32
}

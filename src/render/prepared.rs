//! A scene seen from one view, flattened for the executors: what to do along a ray, last object first.

use std::sync::Arc;

use glam::{DAffine3, DMat3, DVec3};

use super::RenderError;
pub use super::bounds::Bounds;
use super::bounds::sphere_bounds;
use super::cells::Cells;
use super::meshes::MadeMesh;
use super::slabs::Slabs;
use crate::geometry::View;
use crate::scene::model::{Matter, Mesh, Scene, Solid, Volume};

/// A shape as the camera sees it.
#[derive(Clone, Debug)]
pub struct SeenSolid<'a> {
    /// The shape.
    pub solid: &'a Solid,
    /// The focal spot in the shape's frame, mm.
    pub source_in_local: DVec3,
    /// Directions of the camera in the shape's frame.
    pub local_from_camera: DMat3,
    /// Centre of the bounding sphere in the camera, mm.
    pub centre_in_camera: DVec3,
    /// Where it can be seen.
    pub bounds: Bounds,
}

/// A volume as the camera sees it.
#[derive(Clone, Debug)]
pub struct SeenVolume<'a> {
    /// The volume.
    pub volume: &'a Arc<Volume>,
    /// Its cells.
    pub cells: Arc<Cells>,
    /// Its slabs, when it is crossed slab by slab.
    pub slabs: Option<Arc<Slabs>>,
    /// Kind of cells that hold air, if air is kept.
    pub air_kind: Option<u8>,
    /// `cell` coordinates (voxel + 1) of points in the camera, mm.
    pub cell_from_camera: DAffine3,
    /// Where its matter can be seen.
    pub bounds: Bounds,
    /// Index of its object; the densities of volumes of one object add up.
    pub object: usize,
}

/// A mesh as the camera sees it.
#[derive(Clone, Debug)]
pub struct SeenMesh<'a> {
    /// The mesh.
    pub mesh: &'a Mesh,
    /// Its tree, in lps.
    pub made: Arc<MadeMesh>,
    /// The focal spot in lps, mm.
    pub source_in_lps: DVec3,
    /// Directions of the camera in lps.
    pub lps_from_camera: DMat3,
    /// Middle of the mesh in the camera, mm.
    pub centre_in_camera: DVec3,
    /// Where it can be seen.
    pub bounds: Bounds,
}

/// One thing to do along a ray.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Index into `Prepared::solids`.
    Solid(usize),
    /// Index into `Prepared::meshes`.
    Mesh(usize),
    /// Index into `Prepared::volumes`; everything but its air.
    Volume(usize),
    /// Index into `Prepared::volumes`; its air, which displaces nothing and is displaced by everything.
    VolumeAir(usize),
}

/// A scene seen from one view.
#[derive(Clone, Debug)]
pub struct Prepared<'a> {
    /// The view.
    pub view: View,
    /// Depth of the detector plane in mm; matter beyond it is not seen.
    pub detector_mm: f64,
    /// Materials of the scene.
    pub material_count: usize,
    /// Shapes in scene order.
    pub solids: Vec<SeenSolid<'a>>,
    /// Volumes in scene order.
    pub volumes: Vec<SeenVolume<'a>>,
    /// Meshes in scene order.
    pub meshes: Vec<SeenMesh<'a>>,
    /// In the order in which they claim the ray: the last object first, air last.
    pub steps: Vec<Step>,
}

impl<'a> Prepared<'a> {
    /// Looks at `scene` from `view`; `cells_of` supplies what was prepared of a volume, `mesh_of` of a mesh.
    ///
    /// # Errors
    /// When the view has no pixels, or the detector has no distance.
    pub fn new(
        scene: &'a Scene,
        view: View,
        mut cells_of: impl FnMut(&'a Arc<Volume>, &str) -> Result<(Arc<Cells>, Option<Arc<Slabs>>), RenderError>,
        mut mesh_of: impl FnMut(&'a Arc<Mesh>) -> Arc<MadeMesh>,
    ) -> Result<Self, RenderError> {
        let detector_mm = view.intrinsics.source_to_detector_mm(scene.detector.pitch_mm);
        if !(detector_mm > 0.0 && detector_mm.is_finite()) {
            return Err(RenderError::DetectorDistance { fx: view.intrinsics.fx, pitch_mm: scene.detector.pitch_mm });
        }
        if view.size_px.contains(&0) {
            return Err(RenderError::EmptyView { width: view.size_px[0], height: view.size_px[1] });
        }
        let is_air = |material: usize| scene.is_air(material);
        let mut prepared = Self {
            view,
            detector_mm,
            material_count: scene.materials.len(),
            solids: Vec::new(),
            volumes: Vec::new(),
            meshes: Vec::new(),
            steps: Vec::new(),
        };
        let mut air_steps = Vec::new();
        for (number, object) in scene.objects.iter().enumerate() {
            match &object.matter {
                Matter::Solids(solids) => {
                    for solid in solids.iter().filter(|solid| solid.density_g_per_cm3 > 0.0) {
                        let step = Step::Solid(prepared.solids.len());
                        prepared.solids.push(see_solid(solid, &view));
                        if is_air(solid.material) { air_steps.push(step) } else { prepared.steps.push(step) }
                    }
                }
                Matter::Volume(_) | Matter::Parts(_) => {
                    for volume in object.matter.volumes() {
                        let (cells, slabs) = cells_of(volume, &object.name)?;
                        let air = cells.materials.iter().position(|material| is_air(*material));
                        let index = prepared.volumes.len();
                        prepared.volumes.push(SeenVolume {
                            volume,
                            air_kind: air.map(|material| material as u8 + 1),
                            cell_from_camera: cell_from_camera(volume, &view),
                            bounds: volume_bounds(volume, &cells, &view),
                            cells,
                            slabs,
                            object: number,
                        });
                        prepared.steps.push(Step::Volume(index));
                        if air.is_some() {
                            air_steps.push(Step::VolumeAir(index));
                        }
                    }
                }
                Matter::Mesh(mesh) if mesh.density_g_per_cm3 > 0.0 => {
                    let step = Step::Mesh(prepared.meshes.len());
                    prepared.meshes.push(see_mesh(mesh, mesh_of(mesh), &view));
                    if is_air(mesh.material) { air_steps.push(step) } else { prepared.steps.push(step) }
                }
                Matter::Mesh(_) => {}
            }
        }
        prepared.steps.reverse();
        prepared.steps.extend(air_steps.into_iter().rev());
        Ok(prepared)
    }
}

/// Depth at which a volume ends, at most that of the detector.
#[must_use]
pub fn far_mm(seen: &SeenVolume, detector_mm: f64) -> f64 {
    let camera_from_cell = seen.cell_from_camera.inverse();
    let size = DVec3::from_array(seen.volume.size.map(|n| n as f64 + 1.0));
    let corner = |i: usize| size * DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64);
    (0..8).map(|i| camera_from_cell.transform_point3(corner(i)).z).fold(0.0, f64::max).min(detector_mm)
}

/// `cell` coordinates of points in the camera.
fn cell_from_camera(volume: &Volume, view: &View) -> DAffine3 {
    let lps_from_camera = view.camera_from_lps.inverse();
    let lps_from_camera = DAffine3::from_rotation_translation(lps_from_camera.rotation, lps_from_camera.translation_mm);
    DAffine3::from_translation(DVec3::ONE) * volume.lps_from_voxel.inverse() * lps_from_camera
}

/// Where the cells that hold matter can be seen; everywhere when faces with matter decide about validity.
fn volume_bounds(volume: &Volume, cells: &Cells, view: &View) -> Bounds {
    if volume.truncated_at_faces {
        return Bounds { from: [0, 0], to: view.size_px };
    }
    let [first, end] = cells.occupied.map(|cell| DVec3::from_array(cell.map(|n| n as f64)));
    // Cell c spans voxels c − 1 to c.
    let centre = volume.lps_from_voxel.transform_point3(0.5 * (first + end) - 1.0);
    let half = 0.5 * (end - first);
    let reach = |x: f64, y: f64| volume.lps_from_voxel.matrix3.mul_vec3(DVec3::new(half.x * x, half.y * y, half.z)).length();
    let radius_mm = reach(1.0, 1.0).max(reach(-1.0, 1.0)).max(reach(1.0, -1.0)).max(reach(-1.0, -1.0));
    sphere_bounds(view, view.camera_from_lps.transform_point(centre), radius_mm)
}

fn see_solid<'a>(solid: &'a Solid, view: &View) -> SeenSolid<'a> {
    let local_from_lps = solid.lps_from_local.inverse();
    let lps_from_camera = view.camera_from_lps.inverse();
    let (centre, radius_mm) = solid.shape.bounding_sphere();
    let centre_in_camera = view.camera_from_lps.transform_point(solid.lps_from_local.transform_point(centre));
    SeenSolid {
        solid,
        source_in_local: local_from_lps.transform_point(lps_from_camera.translation_mm),
        local_from_camera: DMat3::from_quat((local_from_lps.rotation * lps_from_camera.rotation).normalize()),
        centre_in_camera,
        bounds: sphere_bounds(view, centre_in_camera, radius_mm),
    }
}

fn see_mesh<'a>(mesh: &'a Mesh, made: Arc<MadeMesh>, view: &View) -> SeenMesh<'a> {
    let lps_from_camera = view.camera_from_lps.inverse();
    let centre_in_camera = view.camera_from_lps.transform_point(made.centre_lps_mm);
    SeenMesh {
        mesh,
        bounds: sphere_bounds(view, centre_in_camera, made.radius_mm),
        made,
        source_in_lps: lps_from_camera.translation_mm,
        lps_from_camera: DMat3::from_quat(lps_from_camera.rotation.normalize()),
        centre_in_camera,
    }
}

//! What was made of volumes, kept between images: a view that moves pays for nothing else.

use std::sync::Arc;

use glam::DVec3;

use super::RenderError;
use super::cells::Cells;
use super::meshes::MeshCache;
use super::prepared::Prepared;
use super::slabs::Slabs;
use crate::geometry::View;
use crate::scene::model::{Matter, Object, Scene, Volume, Voxels};

/// Prepared volumes and meshes of the scene that was rendered last, and of small pictures beside it.
#[derive(Debug, Default)]
pub struct VolumeCache {
    held: Vec<Held>,
    meshes: MeshCache,
    thinned: Vec<Thinned>,
    /// Volumes that were prepared, also those that are forgotten.
    prepared: usize,
}

/// A volume of fewer slices, for small pictures.
#[derive(Debug)]
struct Thinned {
    of: Arc<Volume>,
    /// Across which axis, and how many slices are one.
    by: (usize, usize),
    is: Arc<Volume>,
}

/// What slices that are made one put beside its ray is less than this share of a pixel away …
const MOST_BESIDE_PX: f64 = 0.6;
/// … along rays that run half-way between two axes, and no more slices than this are one.
const MOST_SLICES: usize = 4;

#[derive(Debug)]
struct Held {
    volume: Arc<Volume>,
    cells: Arc<Cells>,
    /// Outer: whether slabs were tried; inner: whether the volume is for them.
    slabs: Option<Option<Arc<Slabs>>>,
}

type Made = (Arc<Cells>, Option<Arc<Slabs>>);

impl VolumeCache {
    /// Forgets volumes and meshes that `scene` does not hold: those of small pictures beside another, or those of others.
    pub fn keep(&mut self, scene: &Scene, beside: bool) {
        let Self { held, meshes, thinned, .. } = self;
        let is_there = |volume: &Arc<Volume>| holds(scene, |matter| matter.volumes().iter().any(|of| Arc::ptr_eq(of, volume)));
        thinned.retain(|thinned| beside || is_there(&thinned.of));
        let is_thin = |volume: &Arc<Volume>| thinned.iter().any(|thinned| Arc::ptr_eq(&thinned.is, volume));
        held.retain(|held| is_there(&held.volume) || is_thin(&held.volume) != beside);
        meshes.keep(|mesh| holds(scene, |matter| matches!(matter, Matter::Mesh(of) if Arc::ptr_eq(of, mesh))));
    }

    /// The objects of `scene` for small pictures about `view`, which cost half as much and less.
    #[must_use]
    pub fn thinned(&mut self, scene: &Scene, view: &View) -> Vec<Object> {
        let mut objects = scene.objects.clone();
        if scene.model.voxels != Voxels::Trilinear {
            return objects;
        }
        for object in &mut objects {
            match &mut object.matter {
                Matter::Volume(volume) => *volume = self.thin(volume, view),
                Matter::Parts(parts) => parts.iter_mut().for_each(|part| *part = self.thin(part, view)),
                Matter::Solids(_) | Matter::Mesh(_) => {}
            }
        }
        objects
    }

    fn thin(&mut self, volume: &Arc<Volume>, view: &View) -> Arc<Volume> {
        let by = thinning(volume, view);
        let voxels = volume.size.iter().product::<usize>();
        // What is not what its size says is for `prepare` to refuse.
        if by.1 < 2 || volume.density_g_per_cm3.len() != voxels || volume.class.len() != voxels {
            return volume.clone();
        }
        let found = self.thinned.iter().find(|thinned| thinned.by == by && Arc::ptr_eq(&thinned.of, volume));
        found.map(|thinned| thinned.is.clone()).unwrap_or_else(|| {
            let is = Arc::new(volume.thinned(by.0, by.1));
            self.thinned.retain(|thinned| !Arc::ptr_eq(&thinned.of, volume));
            self.thinned.push(Thinned { of: volume.clone(), by, is: is.clone() });
            is
        })
    }

    /// `scene` from `view`, with slabs where asked for.
    ///
    /// # Errors
    /// When a volume is not what its size says, or as [`Prepared::new`].
    pub fn prepare<'a>(&mut self, scene: &'a Scene, view: View, slabs: bool) -> Result<Prepared<'a>, RenderError> {
        let Self { held, meshes, prepared, .. } = self;
        let air = (0..scene.materials.len()).find(|material| scene.is_air(*material));
        let cells_of = |volume: &'a Arc<Volume>, name: &str| {
            let known = held.len();
            let made = make(held, volume, name, air, slabs);
            *prepared += held.len() - known;
            made
        };
        Prepared::new(scene, view, cells_of, |mesh| meshes.make(mesh))
    }

    /// Volumes that were prepared, and copies that are kept of them.
    #[must_use]
    pub fn made(&self) -> [usize; 2] {
        let slabs = self.held.iter().filter_map(|held| held.slabs.as_ref()?.as_ref());
        [self.prepared, slabs.map(|slabs| slabs.copies_made()).sum()]
    }
}

/// How many slices across which axis may be one in a picture from `view`.
fn thinning(volume: &Volume, view: &View) -> (usize, usize) {
    let middle = volume.lps_from_voxel.transform_point3(0.5 * DVec3::from_array(volume.size.map(|n| n as f64 - 1.0)));
    let in_camera = view.camera_from_lps.transform_point(middle);
    let ray = volume.lps_from_voxel.matrix3.inverse() * (view.camera_from_lps.rotation.conjugate() * in_camera);
    let axis = ray.abs().max_position();
    let slice_mm = volume.lps_from_voxel.matrix3.col(axis).length();
    let slices = 1.0 + (2.0 * MOST_BESIDE_PX * in_camera.z / view.intrinsics.fx / slice_mm).floor();
    // Also where any of these is no number.
    (axis, if slices > 1.0 { (slices as usize).min(MOST_SLICES) } else { 1 })
}

fn make(all: &mut Vec<Held>, volume: &Arc<Volume>, name: &str, air: Option<usize>, slabs: bool) -> Result<Made, RenderError> {
    let index = match all.iter().position(|held| Arc::ptr_eq(&held.volume, volume)) {
        Some(index) => index,
        None => {
            let cells = Arc::new(make_cells(volume, name, air)?);
            all.push(Held { volume: volume.clone(), cells, slabs: None });
            all.len() - 1
        }
    };
    let held = &mut all[index];
    if !slabs {
        return Ok((held.cells.clone(), None));
    }
    let made = held.slabs.get_or_insert_with(|| Slabs::new(volume, &held.cells).map(Arc::new));
    Ok((held.cells.clone(), made.clone()))
}

fn holds(scene: &Scene, is: impl Fn(&Matter) -> bool) -> bool {
    scene.objects.iter().any(|object| is(&object.matter))
}

fn make_cells(volume: &Volume, name: &str, air: Option<usize>) -> Result<Cells, RenderError> {
    let wrong = |detail: String| RenderError::Volume { name: name.to_owned(), detail };
    let voxels = volume.size.iter().product::<usize>();
    if voxels == 0 || volume.density_g_per_cm3.len() != voxels || volume.class.len() != voxels {
        let found = volume.density_g_per_cm3.len();
        return Err(wrong(format!(
            "a grid of {:?} voxels holds {found} densities and {} classes",
            volume.size,
            volume.class.len()
        )));
    }
    if !(volume.lps_from_voxel.matrix3.determinant().abs() > 0.0) {
        return Err(wrong("its affine is singular".to_owned()));
    }
    Cells::new(volume, air).ok_or_else(|| wrong("more than 250 materials in one volume".to_owned()))
}

//! What was made of volumes, kept between images: a view that moves pays for nothing else.

use std::sync::Arc;

use super::RenderError;
use super::cells::Cells;
use super::meshes::MeshCache;
use super::prepared::Prepared;
use super::slabs::Slabs;
use crate::geometry::View;
use crate::scene::model::{Matter, Scene, Volume};

/// Prepared volumes and meshes of the scene that was rendered last.
#[derive(Debug, Default)]
pub struct VolumeCache {
    held: Vec<Held>,
    meshes: MeshCache,
}

#[derive(Debug)]
struct Held {
    volume: Arc<Volume>,
    cells: Arc<Cells>,
    /// Outer: whether slabs were tried; inner: whether the volume is for them.
    slabs: Option<Option<Arc<Slabs>>>,
}

type Made = (Arc<Cells>, Option<Arc<Slabs>>);

impl VolumeCache {
    /// Forgets volumes and meshes that `scene` does not hold.
    pub fn keep(&mut self, scene: &Scene) {
        self.held.retain(|held| holds(scene, |matter| matter.volumes().iter().any(|of| Arc::ptr_eq(of, &held.volume))));
        self.meshes.keep(|mesh| holds(scene, |matter| matches!(matter, Matter::Mesh(of) if Arc::ptr_eq(of, mesh))));
    }

    /// `scene` from `view`, with slabs where asked for.
    ///
    /// # Errors
    /// When a volume is not what its size says, or as [`Prepared::new`].
    pub fn prepare<'a>(&mut self, scene: &'a Scene, view: View, slabs: bool) -> Result<Prepared<'a>, RenderError> {
        let Self { held, meshes } = self;
        let air = (0..scene.materials.len()).find(|material| scene.is_air(*material));
        Prepared::new(scene, view, |volume, name| make(held, volume, name, air, slabs), |mesh| meshes.make(mesh))
    }
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

//! What was made of volumes, kept between images: a view that moves pays for nothing else.

use std::sync::Arc;

use super::RenderError;
use super::cells::Cells;
use super::prepared::Prepared;
use super::slabs::Slabs;
use crate::geometry::View;
use crate::scene::model::{Matter, Scene, Volume};

/// Prepared volumes of the scene that was rendered last.
#[derive(Debug, Default)]
pub struct VolumeCache {
    held: Vec<Held>,
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
    /// Forgets volumes that `scene` does not hold.
    pub fn keep(&mut self, scene: &Scene) {
        self.held.retain(|held| holds(scene, &held.volume));
    }

    /// `scene` from `view`, with slabs where asked for.
    ///
    /// # Errors
    /// When a volume is not what its size says, or as [`Prepared::new`].
    pub fn prepare<'a>(&mut self, scene: &'a Scene, view: View, slabs: bool) -> Result<Prepared<'a>, RenderError> {
        Prepared::new(scene, view, |volume, name| self.make(volume, name, slabs))
    }

    fn make(&mut self, volume: &Arc<Volume>, name: &str, slabs: bool) -> Result<Made, RenderError> {
        let index = match self.held.iter().position(|held| Arc::ptr_eq(&held.volume, volume)) {
            Some(index) => index,
            None => {
                let cells = Arc::new(make_cells(volume, name)?);
                self.held.push(Held { volume: volume.clone(), cells, slabs: None });
                self.held.len() - 1
            }
        };
        let held = &mut self.held[index];
        if !slabs {
            return Ok((held.cells.clone(), None));
        }
        let made = held.slabs.get_or_insert_with(|| Slabs::new(volume, &held.cells).map(Arc::new));
        Ok((held.cells.clone(), made.clone()))
    }
}

fn holds(scene: &Scene, volume: &Arc<Volume>) -> bool {
    scene.objects.iter().any(|object| matches!(&object.matter, Matter::Volume(held) if Arc::ptr_eq(held, volume)))
}

fn make_cells(volume: &Volume, name: &str) -> Result<Cells, RenderError> {
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
    Cells::new(volume).ok_or_else(|| wrong("more than 250 materials in one volume".to_owned()))
}

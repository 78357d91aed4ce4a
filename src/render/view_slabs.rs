//! Which copies of its volumes a view needs, and whether fixed point has windows for its rays.

use super::cpu::bundles::Rays;
use super::prepared::{Prepared, SeenVolume, far_mm};

impl Prepared<'_> {
    /// Makes the copies of volumes that this view needs, rounded to 16 bits or not: one for each axis along which some ray mainly runs.
    pub fn make_slabs(&self, rounded: bool) {
        self.make_slabs_along(rounded, |seen| Rays::new(&self.view, &seen.cell_from_camera).axes(self.view.size_px));
    }

    /// Makes the copies that any view needs.
    pub fn make_all_slabs(&self, rounded: bool) {
        self.make_slabs_along(rounded, |_| [true; 3]);
    }

    fn make_slabs_along(&self, rounded: bool, axes_of: impl Fn(&SeenVolume) -> [bool; 3]) {
        for seen in &self.volumes {
            if let Some(slabs) = &seen.slabs {
                let axes = axes_of(seen);
                for axis in (0..3).filter(|axis| axes[*axis]) {
                    if rounded {
                        slabs.round(axis, seen.volume, &seen.cells);
                    } else {
                        slabs.prepare(axis, seen.volume, &seen.cells);
                    }
                }
            }
        }
    }

    /// The largest of 4, 2, 1 pixels between rays that fixed point has windows for; 0 where there is none, or a volume cannot be rounded.
    #[must_use]
    pub fn coarsest_rounded(&self) -> u32 {
        let fits = |step_px: &u32| {
            self.volumes.iter().all(|seen| {
                let rays = Rays::new(&self.view, &seen.cell_from_camera);
                let far_mm = far_mm(seen, self.detector_mm);
                seen.slabs.as_ref().is_some_and(|slabs| slabs.rounds()) && rays.fit_windows(self.view.size_px, far_mm, *step_px)
            })
        };
        [4, 2, 1].into_iter().find(fits).unwrap_or(0)
    }
}

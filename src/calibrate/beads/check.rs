//! Volumes in which no bead can be found are refused with what is wrong with them.

use rayon::prelude::*;

use super::lumps::METAL_HU;
use crate::geometry::VoxelGrid;

/// Voxels of this and more hold a bead and its halo in one or two: no centre.
const COARSEST_MM: f64 = 4.0;
/// A CT with more metal than this share is none in Hounsfield units.
const MOST_METAL: f64 = 0.02;

/// Why no bead was found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BeadsInCtError {
    /// A slice or a line.
    #[error("the volume is {size:?} voxels: a single slice; a bead's centre needs at least {least} slices")]
    Flat {
        /// Voxels along i, j, k.
        size: [usize; 3],
        /// Needed along each axis.
        least: usize,
    },
    /// Voxels too coarse.
    #[error("voxels are {spacing_mm:?} mm, a bead's centre needs less than {limit_mm} mm; use the thin-slice reconstruction")]
    Coarse {
        /// Along i, j, k.
        spacing_mm: [f64; 3],
        /// Limit.
        limit_mm: f64,
    },
    /// Not a number of voxels as the size says, or voxels without a number.
    #[error("{found} voxels hold a finite number, {expected} are needed")]
    NotFinite {
        /// Finite values.
        found: usize,
        /// Voxels.
        expected: usize,
    },
    /// One value everywhere.
    #[error("the volume is empty: every voxel is {value}")]
    Empty {
        /// The value.
        value: f32,
    },
    /// Grey values.
    #[error("values run from {low} to {high}: grey values of 8 bits, not Hounsfield numbers; export the CT with 12 bits or more")]
    EightBit {
        /// Smallest.
        low: f32,
        /// Largest.
        high: f32,
    },
    /// Something else than a CT.
    #[error(
        "{share_percent:.0} % of the voxels are above {threshold_hu} HU: these are hardly Hounsfield numbers (rescale left out?)"
    )]
    TooMuchMetal {
        /// Share.
        share_percent: f64,
        /// Threshold.
        threshold_hu: f32,
    },
    /// A CT without metal.
    #[error("there is no metal: the largest value is {most_hu} HU, metal has {needed_hu} HU and more")]
    NoMetal {
        /// Largest value.
        most_hu: f32,
        /// Threshold.
        needed_hu: f32,
    },
    /// Metal, but no bead.
    #[error(
        "none of {lumps} pieces of metal is a bead; the brightest, at ({x:.1}, {y:.1}, {z:.1}) mm lps: {reason}",
        x = at_lps_mm[0], y = at_lps_mm[1], z = at_lps_mm[2]
    )]
    NoBead {
        /// How many.
        lumps: usize,
        /// Middle of the brightest.
        at_lps_mm: [f64; 3],
        /// Why it is none.
        reason: String,
    },
}

/// Slices needed along each axis.
const LEAST_SLICES: usize = 3;

/// Refuses volumes in which beads cannot be found.
pub(super) fn volume(grid: &VoxelGrid, hu: &[f32]) -> Result<(), BeadsInCtError> {
    if grid.size.iter().any(|n| *n < LEAST_SLICES) {
        return Err(BeadsInCtError::Flat { size: grid.size, least: LEAST_SLICES });
    }
    let finite = hu.par_iter().filter(|value| value.is_finite()).count();
    if finite != grid.voxels() || hu.len() != grid.voxels() {
        return Err(BeadsInCtError::NotFinite { found: finite, expected: grid.voxels() });
    }
    let spacing_mm = grid.spacing_mm().map(|mm| (mm * 1000.0).round() / 1000.0);
    if !spacing_mm.iter().all(|mm| *mm > 0.0 && *mm < COARSEST_MM) {
        return Err(BeadsInCtError::Coarse { spacing_mm, limit_mm: COARSEST_MM });
    }
    let low = hu.par_iter().copied().reduce(|| f32::INFINITY, f32::min);
    let high = hu.par_iter().copied().reduce(|| f32::NEG_INFINITY, f32::max);
    if low == high {
        return Err(BeadsInCtError::Empty { value: low });
    }
    if low >= -128.0 && high <= 255.0 && high - low > 100.0 && hu.par_iter().all(|value| value.fract() == 0.0) {
        return Err(BeadsInCtError::EightBit { low, high });
    }
    let metal = hu.par_iter().filter(|value| **value >= METAL_HU).count();
    if metal == 0 {
        return Err(BeadsInCtError::NoMetal { most_hu: high, needed_hu: METAL_HU });
    }
    let share = metal as f64 / hu.len() as f64;
    if !(share <= MOST_METAL || metal < 4000) {
        return Err(BeadsInCtError::TooMuchMetal { share_percent: 100.0 * share, threshold_hu: METAL_HU });
    }
    Ok(())
}

//! The voxels around a bead, and what would be there without it.

use std::collections::BTreeSet;

use glam::DVec3;

use super::fit::Sample;
use super::lumps::METAL_HU;
use crate::estimate::median;
use crate::geometry::VoxelGrid;
use crate::scene::fill_harmonic;

/// Past the last voxel above the threshold a bead's halo reaches this far, plus half a voxel's diagonal; mm.
const HALO_MM: f64 = 1.0;
/// Voxels this near to metal that is no bead say nothing of a bead, mm.
const FOREIGN_HALO_MM: f64 = 1.3;
/// The surroundings are looked at this far past the halo, mm.
const SHELL_MM: f64 = 3.0;
/// Values below this were not reconstructed.
const UNKNOWN_HU: f32 = -1500.0;

/// A place where a bead may be.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    /// Number of its lump.
    pub lump: usize,
    /// First guess of its centre.
    pub centre_lps_mm: DVec3,
    /// From there to the farthest voxel above the threshold that is its own.
    pub reach_mm: f64,
}

impl Candidate {
    /// To the end of its halo.
    pub fn window_mm(&self, half_diagonal_mm: f64) -> f64 {
        self.reach_mm + HALO_MM + half_diagonal_mm
    }
}

/// What a fit is given.
#[derive(Clone, Debug)]
pub(super) struct Window {
    /// Voxels that are the bead's own.
    pub samples: Vec<Sample>,
    /// White noise, from differences of neighbours around the halo.
    pub noise_hu: f64,
    /// Standard deviation of what surrounds the halo, without the noise.
    pub structure_hu: f64,
    /// Its middle value.
    pub middle_hu: f64,
}

/// The window of candidate `at`. Where other beads are nearer, or foreign metal is near, voxels are left out. `None` where nothing
/// but metal surrounds it.
pub(super) fn window(grid: &VoxelGrid, hu: &[f32], all: &[Candidate], at: usize, foreign: &BTreeSet<usize>) -> Option<Window> {
    let own = &all[at];
    let half_diagonal_mm = 0.5 * DVec3::from_array(grid.spacing_mm()).length();
    let radius_mm = own.window_mm(half_diagonal_mm);
    let near_mm = radius_mm + SHELL_MM;
    let neighbours: Vec<&Candidate> = all
        .iter()
        .enumerate()
        .filter(|(other, candidate)| {
            *other != at && candidate.centre_lps_mm.distance(own.centre_lps_mm) < near_mm + candidate.window_mm(half_diagonal_mm)
        })
        .map(|(_, candidate)| candidate)
        .collect();
    let around = grid.within(own.centre_lps_mm, near_mm);
    let spoiled = near_foreign(grid, &around, foreign);
    let halo = |place: DVec3| {
        let hides = |candidate: &&Candidate| candidate.centre_lps_mm.distance(place) <= candidate.window_mm(half_diagonal_mm);
        hides(&own) || neighbours.iter().any(hides)
    };
    let (hidden, shell): (Vec<usize>, Vec<usize>) =
        around.iter().copied().filter(|index| !spoiled.contains(index)).partition(|index| halo(grid.centre(*index)));
    let is_shell: BTreeSet<usize> = shell.into_iter().filter(|index| hu[*index] < METAL_HU && hu[*index] > UNKNOWN_HU).collect();
    let filled = fill_harmonic(grid, hu, &hidden, &|index| is_shell.contains(&index))?;
    let (noise_hu, structure_hu, middle_hu) = surroundings(grid, hu, &is_shell)?;
    let mut samples = Vec::new();
    for (index, background_hu) in hidden.into_iter().zip(filled) {
        let place = grid.centre(index);
        let distance = place.distance(own.centre_lps_mm);
        let nearest = neighbours.iter().all(|other| other.centre_lps_mm.distance(place) >= distance);
        if distance <= radius_mm && nearest && hu[index] > UNKNOWN_HU {
            samples.push(Sample { place_lps_mm: place, hu: f64::from(hu[index]), background_hu });
        }
    }
    Some(Window { samples, noise_hu, structure_hu, middle_hu })
}

/// Voxels of `around` that metal which is no bead reaches.
fn near_foreign(grid: &VoxelGrid, around: &[usize], foreign: &BTreeSet<usize>) -> BTreeSet<usize> {
    let (Some(first), Some(last)) = (around.first(), around.last()) else { return BTreeSet::new() };
    let reach_mm = FOREIGN_HALO_MM + 0.5 * DVec3::from_array(grid.spacing_mm()).length();
    // A margin in the list's order, so that metal just outside counts too.
    let stride = grid.size[0] * grid.size[1];
    let steps = stride * ((reach_mm / grid.spacing_mm()[2]).ceil() as usize + 1);
    foreign
        .range(first.saturating_sub(steps)..=last + steps)
        .flat_map(|index| grid.within(grid.centre(*index), reach_mm))
        .collect()
}

/// White noise, structure and median of voxels.
fn surroundings(grid: &VoxelGrid, hu: &[f32], shell: &BTreeSet<usize>) -> Option<(f64, f64, f64)> {
    let values: Vec<f64> = shell.iter().map(|index| f64::from(hu[*index])).collect();
    let middle = median(values.iter().copied())?;
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    let steps = shell
        .iter()
        .filter_map(|index| grid.neighbour(*index, 0, true).filter(|next| shell.contains(next)).map(|next| (*index, next)))
        .map(|(index, next)| (f64::from(hu[next]) - f64::from(hu[index])).abs());
    const SIGMA_FROM_MEDIAN: f64 = 1.4826;
    let noise = median(steps).map_or(variance.sqrt(), |step| SIGMA_FROM_MEDIAN * step * std::f64::consts::FRAC_1_SQRT_2);
    // Ten percent more than the noise is within what the noise is known to.
    let structure = (variance - 1.1 * noise * noise).max(0.0).sqrt();
    // Stored values are rounded, and no CT is better than this.
    Some((noise.max(3.0), structure, middle))
}

//! Lumps of metal: voxels above a threshold that touch, their size and shape, and where in a lump beads may be.

use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, SymmetricEigen};
use rayon::prelude::*;

use crate::geometry::VoxelGrid;

/// From here on a voxel may hold metal: above nearly all bone, below what a 1 mm steel ball makes of a voxel of 1 mm.
pub(super) const METAL_HU: f32 = 1800.0;
/// σ of the blur under which a lump's summits are counted, mm: plateaus of clipped values get one summit, balls 4 mm apart keep two.
const SUMMIT_BLUR_MM: f64 = 0.7;
/// Closer summits than this are one.
const SUMMITS_APART_MM: f64 = 2.0;

/// Voxels that touch at a face, an edge or a corner.
#[derive(Clone, Debug)]
pub(super) struct Lump {
    /// Ascending.
    pub voxels: Vec<usize>,
    /// Mean place of the voxels, weighted by what they exceed half of the threshold by; lps mm.
    pub centre_lps_mm: DVec3,
    /// Length along the principal axes, longest first, voxels included, mm.
    pub extent_mm: [f64; 3],
    /// Largest value.
    pub peak_hu: f32,
}

/// All lumps, in the order of their first voxel.
pub(super) fn lumps(grid: &VoxelGrid, hu: &[f32]) -> Vec<Lump> {
    let above: Vec<usize> = hu.par_iter().enumerate().filter(|(_, value)| **value >= METAL_HU).map(|(index, _)| index).collect();
    let mut group = vec![usize::MAX; above.len()];
    let mut lumps = Vec::new();
    let mut stack = Vec::new();
    for first in 0..above.len() {
        if group[first] != usize::MAX {
            continue;
        }
        group[first] = lumps.len();
        stack.push(first);
        let mut voxels = Vec::new();
        while let Some(at) = stack.pop() {
            voxels.push(above[at]);
            for next in touching(grid, above[at]) {
                if let Ok(next) = above.binary_search(&next)
                    && group[next] == usize::MAX
                {
                    group[next] = lumps.len();
                    stack.push(next);
                }
            }
        }
        voxels.sort_unstable();
        lumps.push(measure(grid, hu, voxels));
    }
    lumps
}

/// The up to 26 voxels around one.
fn touching(grid: &VoxelGrid, index: usize) -> impl Iterator<Item = usize> + '_ {
    let at = grid.coordinates(index);
    (0..27usize).filter(|step| *step != 13).filter_map(move |step| {
        let steps = [step % 3, step / 3 % 3, step / 9];
        let mut next = [0; 3];
        for axis in 0..3 {
            next[axis] = (at[axis] + steps[axis]).checked_sub(1).filter(|n| *n < grid.size[axis])?;
        }
        Some(grid.index(next))
    })
}

fn measure(grid: &VoxelGrid, hu: &[f32], voxels: Vec<usize>) -> Lump {
    let weight = |index: &usize| f64::from(hu[*index]) - 0.5 * f64::from(METAL_HU);
    let total: f64 = voxels.iter().map(weight).sum();
    let centre = voxels.iter().map(|index| grid.centre(*index) * weight(index)).sum::<DVec3>() / total;
    let mut spread = DMat3::ZERO;
    for index in &voxels {
        let away = grid.centre(*index) - centre;
        spread += DMat3::from_cols(away * away.x, away * away.y, away * away.z);
    }
    let eigen = SymmetricEigen::new(Matrix3::from_column_slice(&spread.to_cols_array()));
    let edges = grid.lps_from_voxel.matrix3;
    let mut extent_mm = [0, 1, 2].map(|axis| {
        let axis = DVec3::from_slice(eigen.eigenvectors.column(axis).as_slice());
        let along = voxels.iter().map(|index| (grid.centre(*index) - centre).dot(axis));
        let (low, high) = along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        let voxel_mm = (edges.x_axis.dot(axis).powi(2) + edges.y_axis.dot(axis).powi(2) + edges.z_axis.dot(axis).powi(2)).sqrt();
        high - low + voxel_mm
    });
    extent_mm.sort_by(|a, b| b.total_cmp(a));
    let peak_hu = voxels.iter().map(|index| hu[*index]).fold(f32::NEG_INFINITY, f32::max);
    Lump { voxels, centre_lps_mm: centre, extent_mm, peak_hu }
}

/// Where beads may lie in a lump, lps mm: the summits of the blurred values, highest first. At least one.
pub(super) fn summits(grid: &VoxelGrid, hu: &[f32], lump: &Lump) -> Vec<DVec3> {
    let blurred = |index: usize| {
        let place = grid.centre(index);
        let weigh = |near: usize| {
            let weight = (-0.5 * grid.centre(near).distance_squared(place) / (SUMMIT_BLUR_MM * SUMMIT_BLUR_MM)).exp();
            (weight * f64::from(hu[near]), weight)
        };
        let sums =
            grid.within(place, 2.5 * SUMMIT_BLUR_MM).into_iter().map(weigh).fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
        sums.0 / sums.1
    };
    let heights: Vec<f64> = lump.voxels.par_iter().map(|index| blurred(*index)).collect();
    let height = |index: usize| lump.voxels.binary_search(&index).map_or(f64::NEG_INFINITY, |at| heights[at]);
    let mut tops: Vec<(f64, usize)> = lump
        .voxels
        .iter()
        .map(|index| (height(*index), *index))
        .filter(|(top, index)| touching(grid, *index).all(|next| height(next) <= *top))
        .collect();
    tops.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut found: Vec<DVec3> = Vec::new();
    for (_, index) in tops {
        let place = grid.centre(index);
        if found.iter().all(|other| other.distance(place) >= SUMMITS_APART_MM) {
            found.push(place);
        }
    }
    if found.len() <= 1 {
        return vec![lump.centre_lps_mm];
    }
    found
}

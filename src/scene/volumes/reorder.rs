//! The same voxels in another order: programs differ in which axis comes first and where it counts to.

use glam::{DAffine3, DMat3, DVec3};
use rayon::prelude::*;

use super::VolumeFile;
use crate::geometry::VoxelGrid;

/// Axes are parallel when no voxel of the other grid goes further across in one step, in voxels.
const PARALLEL: f64 = 0.02;

impl VolumeFile {
    /// Voxels in the order of those of `grid`, where its axes are those of this volume but for their order and directions; else as they are.
    #[must_use]
    pub(in crate::scene) fn in_order_of(self, grid: &VoxelGrid) -> Self {
        let own_from_grid = self.lps_from_voxel.matrix3.inverse() * grid.lps_from_voxel.matrix3;
        let columns = [own_from_grid.x_axis, own_from_grid.y_axis, own_from_grid.z_axis];
        let [Some(i), Some(j), Some(k)] = columns.map(axis_of) else { return self };
        let axes = [i, j, k];
        let mut sorted = axes.map(|(own, _)| own);
        sorted.sort_unstable();
        if sorted != [0, 1, 2] || axes == [(0, true), (1, true), (2, true)] {
            return self;
        }
        let strides = [1, self.size[0], self.size[0] * self.size[1]];
        let size = axes.map(|(own, _)| self.size[own]);
        let own_index = |at: [usize; 3]| -> usize {
            let along = |n: usize| if axes[n].1 { at[n] } else { size[n] - 1 - at[n] };
            (0..3).map(|n| along(n) * strides[axes[n].0]).sum()
        };
        let mut values = vec![0.0; self.values.len()];
        values.par_chunks_mut((size[0] * size[1]).max(1)).enumerate().for_each(|(z, slice)| {
            for (index, value) in slice.iter_mut().enumerate() {
                *value = self.values[own_index([index % size[0], index / size[0], z])];
            }
        });
        let direction = |n: usize| DVec3::AXES[axes[n].0] * if axes[n].1 { 1.0 } else { -1.0 };
        let backwards = |n: usize| if axes[n].1 { DVec3::ZERO } else { DVec3::AXES[axes[n].0] * (size[n] as f64 - 1.0) };
        let own_from_ordered = DAffine3 {
            matrix3: DMat3::from_cols(direction(0), direction(1), direction(2)),
            translation: (0..3).map(backwards).sum(),
        };
        let spacing_mm = axes.map(|(own, _)| self.spacing_mm[own]);
        Self { size, lps_from_voxel: self.lps_from_voxel * own_from_ordered, values, spacing_mm, ..self }
    }
}

/// The axis along which a step goes, and whether it goes up.
fn axis_of(step: DVec3) -> Option<(usize, bool)> {
    let axis =
        (0..3).find(|axis| (step - DVec3::AXES[*axis] * step[*axis]).abs().max_element() < PARALLEL && step[*axis] != 0.0)?;
    Some((axis, step[axis] > 0.0))
}

#[cfg(test)]
mod tests {
    use super::super::PlacedBy;
    use super::*;

    fn volume(size: [usize; 3], columns: [DVec3; 3]) -> VolumeFile {
        let matrix3 = DMat3::from_cols(columns[0], columns[1], columns[2]);
        let lps_from_voxel = DAffine3 { matrix3, translation: DVec3::new(3.0, -5.0, 7.0) };
        let values = (0..size.iter().product::<usize>()).map(|index| index as f32).collect();
        let spacing_mm = columns.map(DVec3::length);
        VolumeFile { size, lps_from_voxel, values, placed_by: PlacedBy::Sform, spacing_mm, label_names: Vec::new() }
    }

    /// What lies at each place, whatever the order.
    fn by_place(volume: &VolumeFile) -> Vec<([i64; 3], f32)> {
        let [ni, nj, nk] = volume.size;
        let index =
            (0..nk).flat_map(|k| (0..nj).flat_map(move |j| (0..ni).map(move |i| DVec3::new(i as f64, j as f64, k as f64))));
        let place = |voxel: DVec3| volume.lps_from_voxel.transform_point3(voxel).to_array().map(|mm| (mm * 1e6).round() as i64);
        let mut found: Vec<_> = index.zip(&volume.values).map(|(voxel, value)| (place(voxel), *value)).collect();
        found.sort_by_key(|(place, _)| *place);
        found
    }

    #[test]
    fn every_order_and_direction_of_axes_keeps_each_voxel_in_its_place() {
        let (size, steps) = ([2, 3, 4], [DVec3::X * 1.5, DVec3::Y * 2.0, DVec3::Z * 2.5]);
        let orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
        for (order, signs) in orders.iter().flat_map(|order| (0..8).map(move |signs| (order, signs))) {
            let given = volume(order.map(|n| size[n]), order.map(|n| if signs >> n & 1 == 1 { -steps[n] } else { steps[n] }));
            let ordered = given.clone().in_order_of(&VoxelGrid {
                size,
                lps_from_voxel: DAffine3::from_mat3(DMat3::from_cols(steps[0], steps[1], steps[2])),
            });
            assert_eq!((ordered.size, ordered.spacing_mm), (size, [1.5, 2.0, 2.5]), "{order:?} {signs:03b}");
            assert!((0..3).all(|n| ordered.lps_from_voxel.matrix3.col(n) == steps[n]), "{order:?} {signs:03b}");
            assert_eq!(by_place(&ordered), by_place(&given), "{order:?} {signs:03b}");
        }
        let slanted = volume(size, [DVec3::new(1.5, 0.1, 0.0), DVec3::Y * 2.0, DVec3::Z * 2.5]);
        let grid = VoxelGrid { size, lps_from_voxel: DAffine3::from_mat3(DMat3::from_cols(-steps[0], steps[1], steps[2])) };
        assert_eq!(slanted.clone().in_order_of(&grid).lps_from_voxel, slanted.lps_from_voxel, "another grid");
    }
}

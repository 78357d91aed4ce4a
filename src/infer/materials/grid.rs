//! A CT as the passes see it: averaged to about their resolution, and read at the points of their grids.

use glam::{DAffine3, DVec3};
use rayon::prelude::*;

use crate::geometry::VoxelGrid;

/// A CT.
#[derive(Clone, Copy, Debug)]
pub struct HuVolume<'a> {
    /// Where its voxels lie.
    pub grid: VoxelGrid,
    /// Hounsfield numbers, i fastest.
    pub hu: &'a [f32],
}

/// A volume averaged over blocks of voxels, as many along each axis as fit between the points of a pass.
#[derive(Clone, Debug)]
pub struct Reduced {
    /// Blocks along i, j, k.
    pub size: [usize; 3],
    /// Voxels of a block along i, j, k.
    pub block: [usize; 3],
    /// Means of the blocks, i fastest.
    pub values: Vec<f32>,
    voxels: VoxelGrid,
    voxel_from_lps: DAffine3,
}

impl Reduced {
    /// `value` of the voxels of a volume, averaged for points `wanted_mm` apart along x, y, z of `lps`.
    pub fn of(voxels: &VoxelGrid, wanted_mm: [f64; 3], value: impl Fn(usize) -> f32 + Sync) -> Self {
        let VoxelGrid { size, lps_from_voxel } = *voxels;
        let axes = lps_from_voxel.matrix3;
        let spacing = voxels.spacing_mm();
        let wanted = DVec3::from_array(wanted_mm);
        let block: [usize; 3] = std::array::from_fn(|axis| {
            // How far the points lie apart along this axis of voxels.
            let direction = axes.col(axis) / spacing[axis];
            let along = 1.0 / (direction / wanted).length();
            ((along / spacing[axis]).floor() as usize).clamp(1, size[axis].max(1))
        });
        let blocks: [usize; 3] = std::array::from_fn(|axis| size[axis].div_ceil(block[axis]));
        let [width, height, _] = blocks;
        let mut values = vec![0.0; blocks.iter().product()];
        values.par_chunks_mut(width).enumerate().for_each(|(line, row)| {
            let range = |at: usize, axis: usize| at * block[axis]..((at + 1) * block[axis]).min(size[axis]);
            let (rows, slices) = (range(line % height, 1), range(line / height, 2));
            for (i, mean) in row.iter_mut().enumerate() {
                let (mut sum, mut count) = (0.0, 0);
                for k in slices.clone() {
                    for j in rows.clone() {
                        let start = size[0] * (j + size[1] * k);
                        let columns = range(i, 0);
                        count += columns.len();
                        sum += columns.map(|i| value(start + i)).sum::<f32>();
                    }
                }
                *mean = sum / count as f32;
            }
        });
        Self { size: blocks, block, values, voxels: *voxels, voxel_from_lps: lps_from_voxel.inverse() }
    }

    /// (i, j, k) of a block.
    fn coordinates(&self, block: usize) -> [usize; 3] {
        [block % self.size[0], block / self.size[0] % self.size[1], block / (self.size[0] * self.size[1])]
    }

    /// Middle of the block at `at` along `axis`, in voxels; the last one may have fewer.
    fn middle(&self, axis: usize, at: usize) -> f64 {
        let first = at * self.block[axis];
        let end = (first + self.block[axis]).min(self.voxels.size[axis]);
        (first + end - 1) as f64 / 2.0
    }

    /// The voxel in the block's middle, as an index into the volume.
    #[must_use]
    pub fn middle_voxel(&self, block: usize) -> usize {
        let at = self.coordinates(block);
        self.voxels.index(std::array::from_fn(|axis| self.middle(axis, at[axis]).ceil() as usize))
    }

    /// Where a block lies, `lps` mm.
    #[must_use]
    pub fn centre(&self, block: usize) -> DVec3 {
        let at = self.coordinates(block);
        let voxel = DVec3::from_array(std::array::from_fn(|axis| self.middle(axis, at[axis])));
        self.voxels.lps_from_voxel.transform_point3(voxel)
    }

    /// The blocks about a point and their trilinear shares: constant beyond the middles of the outermost, none outside the volume.
    #[must_use]
    pub fn about(&self, point_lps_mm: DVec3) -> Shares {
        let voxel = self.voxel_from_lps.transform_point3(point_lps_mm);
        let mut block = DVec3::ZERO;
        for axis in 0..3 {
            let (at, last) = (voxel[axis], self.size[axis] - 1);
            if !(at >= -0.5 && at <= self.voxels.size[axis] as f64 - 0.5) {
                return Shares::NONE;
            }
            let nominal = (at - self.middle(axis, 0)) / self.block[axis] as f64;
            let before_last = last.saturating_sub(1);
            // The last step may be shorter.
            let step = self.middle(axis, last) - self.middle(axis, before_last);
            let is_last = last > 0 && nominal > before_last as f64;
            let exact = if is_last { before_last as f64 + (at - self.middle(axis, before_last)) / step } else { nominal };
            block[axis] = exact.clamp(0.0, last as f64);
        }
        Shares::about(block, self.size)
    }

    /// Trilinear interpolation of `value` of the blocks at a point; `outside` beyond the volume.
    pub fn interpolated(&self, point_lps_mm: DVec3, outside: f32, value: impl Fn(usize) -> f32) -> f32 {
        self.about(point_lps_mm).sum(outside, value)
    }
}

/// Up to eight places in a list, and their shares.
#[derive(Clone, Copy, Debug)]
pub struct Shares {
    places: [usize; 8],
    shares: [f32; 8],
    count: usize,
}

impl Shares {
    const NONE: Self = Self { places: [0; 8], shares: [0.0; 8], count: 0 };

    /// Of the points of a grid about the continuous index `at`.
    fn about(at: DVec3, size: [usize; 3]) -> Self {
        let mut found = Self::NONE;
        let low = at.floor();
        let beyond = at - low;
        for corner in 0..8_usize {
            let step = [corner & 1, corner >> 1 & 1, corner >> 2];
            let (mut share, mut index, mut stride, mut is_inside) = (1.0, 0, 1, true);
            for axis in 0..3 {
                share *= if step[axis] == 1 { beyond[axis] } else { 1.0 - beyond[axis] };
                let place = low[axis] + step[axis] as f64;
                is_inside &= place >= 0.0 && place < size[axis] as f64;
                index += stride * place.max(0.0) as usize;
                stride *= size[axis];
            }
            if is_inside && share > 0.0 {
                (found.places[found.count], found.shares[found.count]) = (index, share as f32);
                found.count += 1;
            }
        }
        found
    }

    /// The places.
    #[must_use]
    pub fn places(&self) -> &[usize] {
        &self.places[..self.count]
    }

    /// The places, each with its share.
    pub fn each(&self) -> impl Iterator<Item = (usize, f32)> + '_ {
        self.places().iter().copied().zip(self.shares)
    }

    /// Σ share · value, what is missing to 1 being `outside`.
    pub fn sum(&self, outside: f32, value: impl Fn(usize) -> f32) -> f32 {
        let (mut sum, mut shares) = (0.0, 0.0);
        for (place, share) in self.each() {
            sum += share * value(place);
            shares += share;
        }
        sum + outside * (1.0 - shares)
    }
}

/// The points of a pass over a volume: along the axes of `lps`, whatever the axes of the voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PassGrid {
    /// Points along x, y, z.
    pub size: [usize; 3],
    first_lps_mm: DVec3,
    spacing_mm: DVec3,
}

impl PassGrid {
    /// Over all voxel centres of a volume.
    #[must_use]
    pub fn covering(voxels: &VoxelGrid, spacing_mm: [f64; 3]) -> Self {
        let last = DVec3::from_array(voxels.size.map(|n| n as f64 - 1.0));
        let corner = |bits: u32| DVec3::new(f64::from(bits & 1), f64::from(bits >> 1 & 1), f64::from(bits >> 2)) * last;
        let corners = (0..8).map(|bits| voxels.lps_from_voxel.transform_point3(corner(bits)));
        let (low, high) =
            corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), corner| (low.min(corner), high.max(corner)));
        let spacing_mm = DVec3::from_array(spacing_mm);
        let steps = ((high - low) / spacing_mm).ceil();
        Self { size: steps.to_array().map(|n| n as usize + 1), first_lps_mm: low, spacing_mm }
    }

    /// Number of points of a grid over a volume, however many that would be.
    #[must_use]
    pub fn points_over(voxels: &VoxelGrid, spacing_mm: [f64; 3]) -> f64 {
        let axes = voxels.lps_from_voxel.matrix3;
        // The box about the volume.
        let last = DVec3::from_array(voxels.size.map(|n| n as f64 - 1.0));
        let extent = axes.x_axis.abs() * last.x + axes.y_axis.abs() * last.y + axes.z_axis.abs() * last.z;
        (extent / DVec3::from_array(spacing_mm) + 2.0).element_product()
    }

    /// Where the point (x, y, z) lies; beyond the grid as well.
    #[must_use]
    pub fn point(&self, at: [i64; 3]) -> DVec3 {
        self.first_lps_mm + DVec3::from_array(at.map(|n| n as f64)) * self.spacing_mm
    }

    /// The points about a place and their trilinear shares.
    #[must_use]
    pub fn about(&self, point_lps_mm: DVec3) -> Shares {
        Shares::about((point_lps_mm - self.first_lps_mm) / self.spacing_mm, self.size)
    }

    /// Number of points.
    #[must_use]
    pub fn points(&self) -> usize {
        self.size.iter().product()
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    /// A left-handed, oblique grid of voxels.
    fn oblique() -> DAffine3 {
        let turn = DMat3::from_rotation_z(0.4) * DMat3::from_rotation_x(0.2);
        let axes = turn * DMat3::from_diagonal(DVec3::new(-0.7, 0.8, 2.5));
        DAffine3 { matrix3: axes, translation: DVec3::new(20.0, -5.0, 8.0) }
    }

    #[test]
    fn a_linear_field_is_read_as_it_is_between_blocks_of_voxels() {
        let (size, lps_from_voxel) = ([24, 20, 12], oblique());
        let field = |p: DVec3| (3.0 * p.x - 2.0 * p.y + 0.5 * p.z) as f32;
        let at = |index: usize| [index % 24, index / 24 % 20, index / 480].map(|n| n as f64);
        let value = |index: usize| field(lps_from_voxel.transform_point3(DVec3::from_array(at(index))));
        let reduced = Reduced::of(&VoxelGrid { size, lps_from_voxel }, [3.0; 3], value);
        assert_eq!(reduced.block, [4, 3, 1]);
        // The last block of j has two voxels, 18 and 19.
        for voxel in
            [DVec3::new(9.3, 7.7, 4.2), DVec3::new(13.0, 10.0, 6.0), DVec3::new(13.0, 17.5, 6.0), DVec3::new(13.0, 18.2, 6.0)]
        {
            let point = lps_from_voxel.transform_point3(voxel);
            let found = reduced.interpolated(point, -1000.0, |place| reduced.values[place]);
            assert!((found - field(point)).abs() < 1e-3, "{found} {}", field(point));
        }
        assert_eq!(reduced.interpolated(DVec3::splat(1e4), -1000.0, |_| 0.0), -1000.0);
        // Constant over the outer half voxel and to the middles of the outermost blocks, nothing beyond.
        let beside = |i: f64| {
            let point = lps_from_voxel.transform_point3(DVec3::new(i, 10.0, 6.0));
            reduced.interpolated(point, -1000.0, |place| reduced.values[place])
        };
        assert!((beside(-0.49) - beside(1.5)).abs() < 1e-3 && (beside(23.49) - beside(21.5)).abs() < 1e-3);
        assert!(beside(-0.51) == -1000.0 && beside(23.51) == -1000.0);
        let block = 2 + 6 * (3 + 7 * 5);
        assert_eq!(reduced.middle_voxel(block), 10 + 24 * (10 + 20 * 5));
        let shares = reduced.about(reduced.centre(block));
        assert!((shares.sum(0.0, |place| f32::from(u8::from(place == block))) - 1.0).abs() < 1e-4);
    }

    #[test]
    fn a_grid_covers_every_voxel() {
        let lps_from_voxel = oblique();
        let voxels = VoxelGrid { size: [9, 7, 5], lps_from_voxel };
        let grid = PassGrid::covering(&voxels, [1.5; 3]);
        for index in 0..315 {
            assert!(grid.about(voxels.centre(index)).sum(0.0, |_| 1.0) > 1.0 - 1e-6, "{index}");
        }
        let at = [2, 1, 3];
        let index = 2 + grid.size[0] * (1 + grid.size[1] * 3);
        assert!(grid.about(grid.point(at)).sum(0.0, |place| f32::from(u8::from(place == index))) > 1.0 - 1e-6);
    }
}

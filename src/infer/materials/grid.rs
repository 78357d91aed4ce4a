//! A CT as the passes see it: averaged to about their resolution, and read at the points of their grids.

use glam::{DAffine3, DVec3};
use rayon::prelude::*;

/// A CT.
#[derive(Clone, Copy, Debug)]
pub struct HuVolume<'a> {
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`, mm.
    pub lps_from_voxel: DAffine3,
    /// Hounsfield numbers, i fastest.
    pub hu: &'a [f32],
}

impl HuVolume<'_> {
    /// Distance of voxel centres along i, j, k.
    #[must_use]
    pub fn spacing_mm(&self) -> [f64; 3] {
        spacing_mm(&self.lps_from_voxel)
    }
}

fn spacing_mm(lps_from_voxel: &DAffine3) -> [f64; 3] {
    let axes = lps_from_voxel.matrix3;
    [axes.x_axis, axes.y_axis, axes.z_axis].map(DVec3::length)
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
    block_from_lps: DAffine3,
}

impl Reduced {
    /// `value` of the voxels of a volume, averaged for points `wanted_mm` apart along x, y, z of `lps`.
    pub fn of(size: [usize; 3], lps_from_voxel: &DAffine3, wanted_mm: [f64; 3], value: impl Fn(usize) -> f32 + Sync) -> Self {
        let axes = lps_from_voxel.matrix3;
        let spacing = spacing_mm(lps_from_voxel);
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
        let scale = DVec3::from_array(block.map(|n| n as f64));
        let voxel_from_block = DAffine3::from_translation((scale - 1.0) / 2.0) * DAffine3::from_scale(scale);
        Self { size: blocks, block, values, block_from_lps: (*lps_from_voxel * voxel_from_block).inverse() }
    }

    /// The first voxel of the block's middle, as an index into the volume of `size`.
    #[must_use]
    pub fn middle_voxel(&self, block: usize, size: [usize; 3]) -> usize {
        let at = [block % self.size[0], block / self.size[0] % self.size[1], block / (self.size[0] * self.size[1])];
        let voxel: [usize; 3] =
            std::array::from_fn(|axis| (at[axis] * self.block[axis] + self.block[axis] / 2).min(size[axis] - 1));
        voxel[0] + size[0] * (voxel[1] + size[1] * voxel[2])
    }

    /// Where a block lies, `lps` mm.
    #[must_use]
    pub fn centre(&self, block: usize) -> DVec3 {
        let at = [block % self.size[0], block / self.size[0] % self.size[1], block / (self.size[0] * self.size[1])];
        self.block_from_lps.inverse().transform_point3(DVec3::from_array(at.map(|n| n as f64)))
    }

    /// The blocks about a point and their trilinear shares; those beyond the volume are left out, so that the shares of a point outside sum
    /// to less than 1.
    #[must_use]
    pub fn about(&self, point_lps_mm: DVec3) -> Shares {
        Shares::about(self.block_from_lps.transform_point3(point_lps_mm), self.size)
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
    /// Of the points of a grid about the continuous index `at`.
    fn about(at: DVec3, size: [usize; 3]) -> Self {
        let mut found = Self { places: [0; 8], shares: [0.0; 8], count: 0 };
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

    /// Σ share · value, what is missing to 1 being `outside`.
    pub fn sum(&self, outside: f32, value: impl Fn(usize) -> f32) -> f32 {
        let (mut sum, mut shares) = (0.0, 0.0);
        for (place, share) in self.places().iter().zip(&self.shares) {
            sum += share * value(*place);
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
    pub fn covering(volume: &HuVolume<'_>, spacing_mm: [f64; 3]) -> Self {
        let last = DVec3::from_array(volume.size.map(|n| n as f64 - 1.0));
        let corner = |bits: u32| DVec3::new(f64::from(bits & 1), f64::from(bits >> 1 & 1), f64::from(bits >> 2)) * last;
        let corners = (0..8).map(|bits| volume.lps_from_voxel.transform_point3(corner(bits)));
        let (low, high) =
            corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), corner| (low.min(corner), high.max(corner)));
        let spacing_mm = DVec3::from_array(spacing_mm);
        let steps = ((high - low) / spacing_mm).ceil();
        Self { size: steps.to_array().map(|n| n as usize + 1), first_lps_mm: low, spacing_mm }
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
        let reduced = Reduced::of(size, &lps_from_voxel, [3.0; 3], value);
        assert_eq!(reduced.block, [4, 3, 1]);
        for voxel in [DVec3::new(9.3, 7.7, 4.2), DVec3::new(13.0, 10.0, 6.0)] {
            let point = lps_from_voxel.transform_point3(voxel);
            let found = reduced.interpolated(point, -1000.0, |place| reduced.values[place]);
            assert!((found - field(point)).abs() < 1e-3, "{found} {}", field(point));
        }
        assert_eq!(reduced.interpolated(DVec3::splat(1e4), -1000.0, |_| 0.0), -1000.0);
        let block = 2 + 6 * (3 + 7 * 5);
        assert_eq!(reduced.middle_voxel(block, size), 10 + 24 * (10 + 20 * 5));
        let shares = reduced.about(reduced.centre(block));
        assert!((shares.sum(0.0, |place| f32::from(u8::from(place == block))) - 1.0).abs() < 1e-4);
    }

    #[test]
    fn a_grid_covers_every_voxel() {
        let lps_from_voxel = oblique();
        let volume = HuVolume { size: [9, 7, 5], lps_from_voxel, hu: &[] };
        let grid = PassGrid::covering(&volume, [1.5; 3]);
        for index in 0..315 {
            let voxel = [index % 9, index / 9 % 7, index / 63].map(|n| n as f64);
            let shares = grid.about(lps_from_voxel.transform_point3(DVec3::from_array(voxel)));
            assert!(shares.sum(0.0, |_| 1.0) > 1.0 - 1e-6, "{voxel:?}");
        }
        let at = [2, 1, 3];
        let index = 2 + grid.size[0] * (1 + grid.size[1] * 3);
        assert!(grid.about(grid.point(at)).sum(0.0, |place| f32::from(u8::from(place == index))) > 1.0 - 1e-6);
    }
}

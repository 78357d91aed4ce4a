//! The specimen's CT: the phantom without beads and robot, averaged over each voxel, as NIfTI.

use std::io::Write;

use crate::MockError;
use crate::matrix::Vec3;
use crate::phantom::{Body, Phantom, tissue_density_at};

/// HU on a grid; i (towards +x of LPS) varies fastest.
#[derive(Clone, Debug)]
pub struct Ct {
    /// Voxels along x, y, z.
    pub size: [usize; 3],
    /// Voxel size.
    pub spacing_mm: Vec3,
    /// Centre of voxel (0, 0, 0).
    pub first_lps_mm: Vec3,
    /// Values.
    pub hu: Vec<i16>,
}

/// Sub-samples of a voxel along each axis where the phantom is not uniform.
const SUBSAMPLES: usize = 3;

/// Voxelises the phantom's tissue.
#[must_use]
pub fn voxelise(phantom: &Phantom) -> Ct {
    let spacing_mm = phantom.ct.spacing_mm;
    let half = phantom.ct.half_extent_mm;
    let size: [usize; 3] = std::array::from_fn(|axis| (2.0 * half[axis] / spacing_mm[axis]).round() as usize);
    let first_lps_mm: Vec3 = std::array::from_fn(|axis| -half[axis] + 0.5 * spacing_mm[axis]);
    let tissue = phantom.tissue();
    let grid = Grid { tissue: &tissue, size, spacing_mm, first_lps_mm };
    let plane = size[0] * size[1];
    let mut hu = vec![0i16; plane * size[2]];
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let slices = size[2].div_ceil(workers);
    std::thread::scope(|scope| {
        for (part, share) in hu.chunks_mut(plane * slices).enumerate() {
            let grid = &grid;
            scope.spawn(move || {
                let mut above = grid.corners(part * slices);
                for (k, slice) in share.chunks_mut(plane).enumerate() {
                    let k = part * slices + k;
                    let below = std::mem::replace(&mut above, grid.corners(k + 1));
                    for (index, value) in slice.iter_mut().enumerate() {
                        let density = grid.mean_density([index % size[0], index / size[0], k], [&below, &above]);
                        *value = phantom.hu_of_density(density).round() as i16;
                    }
                }
            });
        }
    });
    Ct { size, spacing_mm, first_lps_mm, hu }
}

/// Where voxels are, and what is there.
struct Grid<'a> {
    tissue: &'a [Body],
    size: [usize; 3],
    spacing_mm: Vec3,
    first_lps_mm: Vec3,
}

impl Grid<'_> {
    /// Density at a place in voxels.
    fn at(&self, voxel: Vec3) -> f64 {
        let air = 0.0012;
        let p = std::array::from_fn(|axis| self.first_lps_mm[axis] + voxel[axis] * self.spacing_mm[axis]);
        tissue_density_at(self.tissue, p).max(air)
    }

    /// Densities at the corners that slices `k - 1` and `k` share.
    fn corners(&self, k: usize) -> Vec<f64> {
        let columns = self.size[0] + 1;
        let corner = |index: usize| [index % columns, index / columns, k].map(|n| n as f64 - 0.5);
        (0..columns * (self.size[1] + 1)).map(|index| self.at(corner(index))).collect()
    }

    /// Over a voxel between two planes of corners; sampled where corners and centre are not one density.
    fn mean_density(&self, [i, j, k]: [usize; 3], planes: [&[f64]; 2]) -> f64 {
        let centre = [i, j, k].map(|n| n as f64);
        let middle = self.at(centre);
        let columns = self.size[0] + 1;
        let first = j * columns + i;
        let corners =
            planes.into_iter().flat_map(|plane| [first, first + 1, first + columns, first + columns + 1].map(|n| plane[n]));
        if corners.into_iter().all(|corner| corner == middle) {
            return middle;
        }
        let n = SUBSAMPLES;
        let part = |k: usize| (k as f64 + 0.5) / n as f64 - 0.5;
        let sample = |s: usize| self.at([centre[0] + part(s % n), centre[1] + part(s / n % n), centre[2] + part(s / (n * n))]);
        (0..n * n * n).map(sample).sum::<f64>() / (n * n * n) as f64
    }
}

impl Ct {
    /// A gzipped NIfTI-1 file, RAS sform (x and y change sign).
    ///
    /// # Errors
    /// When it cannot be packed.
    pub fn packed(&self) -> Result<Vec<u8>, MockError> {
        let mut header = vec![0u8; 352];
        let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, &348i32.to_le_bytes());
        let dims = [3, self.size[0] as i16, self.size[1] as i16, self.size[2] as i16, 1, 1, 1, 1];
        dims.iter().enumerate().for_each(|(i, d)| put(40 + 2 * i, &d.to_le_bytes()));
        put(70, &4i16.to_le_bytes());
        put(72, &16i16.to_le_bytes());
        let pixdim = [1.0, self.spacing_mm[0], self.spacing_mm[1], self.spacing_mm[2], 0.0, 0.0, 0.0, 0.0];
        pixdim.iter().enumerate().for_each(|(i, d)| put(76 + 4 * i, &(*d as f32).to_le_bytes()));
        put(108, &352f32.to_le_bytes());
        put(112, &1f32.to_le_bytes());
        put(123, &[2]);
        put(252, &0i16.to_le_bytes());
        put(254, &1i16.to_le_bytes());
        let ([sx, sy, sz], [x, y, z]) = (self.spacing_mm, self.first_lps_mm);
        let rows = [[-sx, 0.0, 0.0, -x], [0.0, -sy, 0.0, -y], [0.0, 0.0, sz, z]];
        rows.iter().flatten().enumerate().for_each(|(i, value)| put(280 + 4 * i, &(*value as f32).to_le_bytes()));
        put(344, b"n+1\0");
        let mut zipped = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        let voxels: Vec<u8> = self.hu.iter().flat_map(|value| value.to_le_bytes()).collect();
        zipped.write_all(&header).and_then(|()| zipped.write_all(&voxels)).map_err(MockError::io("the CT"))?;
        zipped.finish().map_err(MockError::io("the CT"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ct_weighs_what_the_shape_weighs() {
        let mut phantom = Phantom::embedded().expect("embedded");
        phantom.shapes.truncate(1);
        let ct = voxelise(&phantom);
        let grams: f64 = ct.hu.iter().filter(|hu| **hu > -990).map(|hu| phantom.density_of_hu(f64::from(*hu)) * 1e-3).sum();
        let closed = 4.0 / 3.0 * std::f64::consts::PI * 6.4 * 5.2 * 5.4 * phantom.density_of_hu(50.0);
        assert!((grams / closed - 1.0).abs() < 0.01, "{grams} {closed}");
    }
}

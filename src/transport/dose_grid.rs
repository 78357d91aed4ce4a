//! Where a map of the dose has its voxels: where the CT has them, several as one where they are too many, else in cubes around all matter.

use glam::{DAffine3, DMat3, DVec3};

use super::bounds::Region;
use crate::geometry::VoxelGrid;
use crate::scene::model::{Scene, Volume};

/// Voxels that a map has at most, unless somebody says otherwise: their sums stand in memory, and in every checkpoint.
pub const MOST_DOSE_VOXELS: usize = 1 << 19;
/// Edge of a cube where there is no CT, mm.
const SMALLEST_MM: f64 = 1.0;
/// Voxels along one axis, as files have them.
const LONGEST: usize = 32_767;

/// The voxels of a map.
#[derive(Clone, Debug)]
pub struct DoseGrid {
    /// Size and place.
    pub grid: VoxelGrid,
    voxel_from_lps: DAffine3,
}

impl DoseGrid {
    /// At most `most` voxels: on the grid of the largest CT of `scene`, or of its largest volume; without any over `bounds`, in cubes.
    #[must_use]
    pub fn new(scene: &Scene, bounds: &Region, most: usize) -> Self {
        let volumes = || scene.objects.iter().flat_map(|object| object.matter.volumes()).map(|volume| &**volume);
        let mm3 = |volume: &Volume| {
            volume.lps_from_voxel.matrix3.determinant().abs() * volume.size.map(|n| n as f64).iter().product::<f64>()
        };
        let larger = |a: &&Volume, b: &&Volume| mm3(a).total_cmp(&mm3(b));
        let largest = volumes().filter(|volume| volume.truncated_at_faces).max_by(larger).or_else(|| volumes().max_by(larger));
        let grid = match largest {
            Some(volume) => binned(&VoxelGrid { size: volume.size, lps_from_voxel: volume.lps_from_voxel }, most),
            None => cubes(bounds, most),
        };
        Self { grid, voxel_from_lps: grid.lps_from_voxel.inverse() }
    }

    /// The place in the list of the voxel that holds a point; that after the last one where none does.
    #[inline]
    #[must_use]
    pub fn voxel(&self, point: DVec3) -> u32 {
        let at = (self.voxel_from_lps.transform_point3(point) + 0.5).floor();
        let size = DVec3::from_array(self.grid.size.map(|n| n as f64));
        if !(at.cmpge(DVec3::ZERO).all() && at.cmplt(size).all()) {
            return self.grid.voxels() as u32;
        }
        self.grid.index([at.x as usize, at.y as usize, at.z as usize]) as u32
    }
}

/// `fine` with so many voxels as one along each axis that there are no more than `most`, nor more along an axis than files have, and they come
/// as near to cubes as they can.
fn binned(fine: &VoxelGrid, most: usize) -> VoxelGrid {
    let spacing_mm = fine.spacing_mm();
    let mut factor = [1; 3];
    let size = |factor: [usize; 3]| -> [usize; 3] { std::array::from_fn(|axis| fine.size[axis].div_ceil(factor[axis])) };
    loop {
        let width_mm = |axis: &usize| spacing_mm[*axis] * factor[*axis] as f64;
        let are_few = size(factor).iter().product::<usize>() <= most.max(1);
        let least = if are_few { LONGEST } else { 1 };
        let divisible = (0..3).filter(|axis| size(factor)[*axis] > least);
        let Some(axis) = divisible.min_by(|a, b| width_mm(a).total_cmp(&width_mm(b))) else { break };
        factor[axis] += 1;
    }
    let factor_f64 = DVec3::from_array(factor.map(|n| n as f64));
    // A voxel's centre is the middle of those that it is made of.
    let fine_from_voxel = DAffine3 { matrix3: DMat3::from_diagonal(factor_f64), translation: 0.5 * (factor_f64 - 1.0) };
    VoxelGrid { size: size(factor), lps_from_voxel: fine.lps_from_voxel * fine_from_voxel }
}

/// Cubes from the lower corner of `bounds` on, no more than `most`.
fn cubes(bounds: &Region, most: usize) -> VoxelGrid {
    let extent_mm = bounds.high - bounds.low;
    let mut edge_mm = (extent_mm.element_product() / most.max(1) as f64).cbrt().max(SMALLEST_MM);
    loop {
        let size = extent_mm.to_array().map(|mm| ((mm / edge_mm).ceil() as usize).max(1));
        if size.iter().product::<usize>() <= most.max(1) && size.iter().all(|n| *n <= LONGEST) {
            let lps_from_voxel =
                DAffine3 { matrix3: DMat3::from_diagonal(DVec3::splat(edge_mm)), translation: bounds.low + 0.5 * edge_mm };
            return VoxelGrid { size, lps_from_voxel };
        }
        edge_mm *= 1.02;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::fixture::{everything, scene};

    #[test]
    fn voxels_of_a_ct_are_put_together_until_they_are_few() {
        let scene = everything();
        let bounds = Region { low: DVec3::splat(-100.0), high: DVec3::splat(100.0) };
        let fine = DoseGrid::new(&scene, &bounds, MOST_DOSE_VOXELS).grid;
        // The larger part, of 5 x 4 x 6 mm.
        assert_eq!(fine.size, [12, 11, 10]);
        let coarse = DoseGrid::new(&scene, &bounds, 200);
        assert!(coarse.grid.voxels() <= 200 && coarse.grid.voxels() > 60, "{:?}", coarse.grid.size);
        let spacing_mm = coarse.grid.spacing_mm();
        assert!(spacing_mm.iter().all(|mm| (7.9..12.1).contains(mm)), "{spacing_mm:?}");
        // One corner, and every fine voxel in the one that it is put into.
        let corner = |grid: &VoxelGrid| grid.lps_from_voxel.transform_point3(DVec3::splat(-0.5));
        assert!(corner(&fine).distance(corner(&coarse.grid)) < 1e-9);
        for index in 0..fine.voxels() {
            let into: [usize; 3] =
                std::array::from_fn(|axis| fine.coordinates(index)[axis] / fine.size[axis].div_ceil(coarse.grid.size[axis]));
            assert_eq!(coarse.voxel(fine.centre(index)) as usize, coarse.grid.index(into), "{index}");
        }
        for outside in [corner(&fine) + (corner(&fine) - fine.centre(0)), DVec3::splat(1e6), DVec3::NAN] {
            assert_eq!(coarse.voxel(outside) as usize, coarse.grid.voxels(), "{outside}");
        }
    }

    /// Known before the transport, which takes hours, and not when its map is written.
    #[test]
    fn an_axis_has_no_more_voxels_than_a_file() {
        let strip = |size| binned(&VoxelGrid { size, lps_from_voxel: DAffine3::IDENTITY }, MOST_DOSE_VOXELS).size;
        assert_eq!(strip([1, LONGEST + 1, 3]), [1, LONGEST.div_ceil(2), 3]);
        assert_eq!(strip([1, LONGEST, 3]), [1, LONGEST, 3], "the control");
    }

    #[test]
    fn without_a_ct_cubes_cover_all_matter() {
        let bounds = Region { low: DVec3::new(-3.0, 0.0, 10.0), high: DVec3::new(97.0, 1.5, 60.0) };
        for (most, edge_mm) in [(1 << 19, 1.0..1.0 + 1e-9), (500, 2.0..4.0), (1, 100.0..110.0)] {
            let cubes = DoseGrid::new(&scene(&["water"], vec![]), &bounds, most);
            assert!(cubes.grid.voxels() <= most && edge_mm.contains(&cubes.grid.spacing_mm()[1]), "{:?}", cubes.grid);
            for corner in [bounds.low, bounds.high] {
                let within = corner + (0.5 * (bounds.low + bounds.high) - corner) * 1e-9;
                assert!((cubes.voxel(within) as usize) < cubes.grid.voxels(), "{corner} of {:?}", cubes.grid);
            }
        }
    }
}

//! A grid of voxels in `lps`: which index lies where, and which voxels lie near a point.

use glam::{DAffine3, DVec3};

/// Size and place of a volume whose values lie in one list, i fastest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VoxelGrid {
    /// Voxels along i, j, k.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps`, mm; any affine with a volume.
    pub lps_from_voxel: DAffine3,
}

impl VoxelGrid {
    /// Number of voxels.
    #[must_use]
    pub fn voxels(&self) -> usize {
        self.size.iter().product()
    }

    /// Place of voxel (i, j, k) in the list.
    #[must_use]
    pub fn index(&self, [i, j, k]: [usize; 3]) -> usize {
        i + self.size[0] * (j + self.size[1] * k)
    }

    /// (i, j, k) of a place in the list.
    #[must_use]
    pub fn coordinates(&self, index: usize) -> [usize; 3] {
        [index % self.size[0], index / self.size[0] % self.size[1], index / (self.size[0] * self.size[1])]
    }

    /// Centre of a voxel, lps mm.
    #[must_use]
    pub fn centre(&self, index: usize) -> DVec3 {
        self.lps_from_voxel.transform_point3(DVec3::from_array(self.coordinates(index).map(|n| n as f64)))
    }

    /// Distance of voxel centres along i, j, k, mm.
    #[must_use]
    pub fn spacing_mm(&self) -> [f64; 3] {
        let axes = self.lps_from_voxel.matrix3;
        [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| axis.length())
    }

    /// The neighbour of a voxel one step along `axis` (`forward` or back); `None` past the grid's end.
    #[must_use]
    pub fn neighbour(&self, index: usize, axis: usize, forward: bool) -> Option<usize> {
        let stride = [1, self.size[0], self.size[0] * self.size[1]][axis];
        let at = self.coordinates(index)[axis];
        if forward { (at + 1 < self.size[axis]).then(|| index + stride) } else { (at > 0).then(|| index - stride) }
    }

    /// The neighbours of a voxel across its faces, two to six.
    pub fn neighbours(&self, index: usize) -> impl Iterator<Item = usize> + '_ {
        (0..6).filter_map(move |side| self.neighbour(index, side / 2, side % 2 == 1))
    }

    /// Voxels whose centres lie within `radius_mm` of `centre_lps_mm`, ascending.
    #[must_use]
    pub fn within(&self, centre_lps_mm: DVec3, radius_mm: f64) -> Vec<usize> {
        let mut found = Vec::new();
        let Some([low, high]) = self.box_around(centre_lps_mm, radius_mm) else { return found };
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    let place = self.lps_from_voxel.transform_point3(DVec3::new(i as f64, j as f64, k as f64));
                    if place.distance_squared(centre_lps_mm) <= radius_mm * radius_mm {
                        found.push(self.index([i, j, k]));
                    }
                }
            }
        }
        found
    }

    /// First and last voxel along each axis of a box that holds the ball; `None` where the ball misses the grid or is none.
    fn box_around(&self, centre_lps_mm: DVec3, radius_mm: f64) -> Option<[[usize; 3]; 2]> {
        let voxel_from_lps = self.lps_from_voxel.inverse();
        let centre = voxel_from_lps.transform_point3(centre_lps_mm);
        // Rows of the inverse: how far an index runs per mm in its steepest direction.
        let rows = voxel_from_lps.matrix3.transpose();
        let (mut low, mut high) = ([0; 3], [0; 3]);
        for axis in 0..3 {
            let reach = radius_mm * rows.col(axis).length();
            let last = self.size[axis] as f64 - 1.0;
            let (first, end) = ((centre[axis] - reach).ceil().max(0.0), (centre[axis] + reach).floor().min(last));
            if !(first <= end) {
                return None;
            }
            (low[axis], high[axis]) = (first as usize, end as usize);
        }
        Some([low, high])
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    fn oblique() -> VoxelGrid {
        let turn = DMat3::from_rotation_z(0.3) * DMat3::from_rotation_x(-0.5);
        let axes = turn * DMat3::from_diagonal(DVec3::new(-0.7, 0.8, 2.0));
        VoxelGrid { size: [9, 7, 5], lps_from_voxel: DAffine3 { matrix3: axes, translation: DVec3::new(10.0, -4.0, 3.0) } }
    }

    #[test]
    fn within_finds_what_a_search_of_all_voxels_finds() {
        let grid = oblique();
        let mut found = 0;
        for (at, radius_mm) in [(157, 1.0), (0, 2.5), (314, 4.0), (40, 0.3), (100, 50.0)] {
            let centre = grid.centre(at) + DVec3::new(0.01, 0.02, -0.01) * radius_mm;
            let all: Vec<usize> = (0..grid.voxels()).filter(|index| grid.centre(*index).distance(centre) <= radius_mm).collect();
            assert_eq!(grid.within(centre, radius_mm), all, "{at} {radius_mm}");
            found += all.len();
        }
        assert!(found > grid.voxels());
        assert!(grid.within(DVec3::splat(1e3), 5.0).is_empty() && grid.within(DVec3::NAN, 5.0).is_empty());
    }

    #[test]
    fn neighbours_stay_inside() {
        let grid = oblique();
        assert_eq!(grid.neighbours(0).collect::<Vec<_>>(), [1, 9, 63]);
        let middle = grid.index([4, 3, 2]);
        assert_eq!(grid.neighbours(middle).count(), 6);
        assert!(grid.neighbours(middle).all(|next| {
            let apart = grid.coordinates(next).iter().zip(grid.coordinates(middle)).map(|(a, b)| a.abs_diff(b)).sum::<usize>();
            apart == 1
        }));
    }
}

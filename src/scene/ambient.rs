//! Air around what was scanned, told from air within it (DESIGN §5).

use glam::DAffine3;
use rayon::prelude::*;

use crate::geometry::VoxelGrid;

/// A slice with more than this share of its voxels both open to the border and denser than room air holds a lung that is cut open there.
const OPEN_SHARE: f64 = 0.1;
/// Room air with the noise of a scan stays below this.
const DENSER_THAN_AIR_HU: f32 = -950.0;

/// The voxels of a CT that are room air: in each axial slice those below the threshold that connect to the slice's border through such
/// voxels, edge to edge.
#[derive(Clone, Debug)]
pub(super) struct AmbientAir {
    /// One per slice, the first of the two other axes fastest.
    slices: Vec<Vec<bool>>,
    grid: VoxelGrid,
    /// The axis across the slices.
    across: usize,
    /// Slices in which much of it is denser than air: a lung or a mattress that is open to the border.
    pub doubtful_slices: usize,
}

impl AmbientAir {
    /// Finds it among `values`, i fastest. `is_named`: what a voxel is made of is known otherwise, so that nothing there is doubtful.
    pub fn find(grid: &VoxelGrid, values: &[f32], below_hu: f64, is_named: &(dyn Fn(usize) -> bool + Sync)) -> Self {
        let across = axial_axis(&grid.lps_from_voxel);
        let [along, down] = others(across);
        let (width, height) = (grid.size[along], grid.size[down]);
        let found: Vec<(Vec<bool>, bool)> = (0..grid.size[across])
            .into_par_iter()
            .map(|slice| {
                let index = |x: usize, y: usize| {
                    let mut voxel = [slice; 3];
                    (voxel[along], voxel[down]) = (x, y);
                    grid.index(voxel)
                };
                let voxels = || (0..height).flat_map(|y| (0..width).map(move |x| index(x, y)));
                let thin: Vec<bool> = voxels().map(|at| f64::from(values[at]) < below_hu).collect();
                let open = connected_to_border(&thin, width, height);
                let dense = voxels().zip(&open).filter(|(at, open)| **open && values[*at] > DENSER_THAN_AIR_HU && !is_named(*at));
                let doubtful = dense.count() as f64 > OPEN_SHARE * (width * height) as f64;
                (open, doubtful)
            })
            .collect();
        let doubtful_slices = found.iter().filter(|(_, doubtful)| *doubtful).count();
        Self { slices: found.into_iter().map(|(open, _)| open).collect(), grid: *grid, across, doubtful_slices }
    }

    /// Whether the voxel at `index` (i fastest) is room air.
    pub fn holds(&self, index: usize) -> bool {
        let voxel = self.grid.coordinates(index);
        let [along, down] = others(self.across);
        self.slices[voxel[self.across]][voxel[along] + voxel[down] * self.grid.size[along]]
    }
}

/// The axis of voxels that runs most along the patient.
fn axial_axis(lps_from_voxel: &DAffine3) -> usize {
    let axes = lps_from_voxel.matrix3;
    let along = [axes.x_axis, axes.y_axis, axes.z_axis].map(|axis| axis.normalize_or_zero().z.abs());
    (0..3).max_by(|a, b| along[*a].total_cmp(&along[*b])).unwrap_or(2)
}

fn others(axis: usize) -> [usize; 2] {
    match axis {
        0 => [1, 2],
        1 => [0, 2],
        _ => [0, 1],
    }
}

/// Which pixels of `inside` connect to the border of the picture through such pixels, edge to edge.
fn connected_to_border(inside: &[bool], width: usize, height: usize) -> Vec<bool> {
    let mut reached = vec![false; inside.len()];
    let mut starts: Vec<(usize, usize)> = Vec::new();
    starts.extend((0..width).flat_map(|x| [(x, 0), (x, height - 1)]));
    starts.extend((0..height).flat_map(|y| [(0, y), (width - 1, y)]));
    while let Some((x, y)) = starts.pop() {
        let row = y * width;
        let free = |reached: &[bool], x: usize| inside[row + x] && !reached[row + x];
        if !free(&reached, x) {
            continue;
        }
        let first = (0..x).rev().take_while(|x| free(&reached, *x)).last().unwrap_or(x);
        let last = (x + 1..width).take_while(|x| free(&reached, *x)).last().unwrap_or(x);
        reached[row + first..=row + last].fill(true);
        // Of each run that touches this one from above or below, one pixel is enough.
        for next in [y.checked_sub(1), Some(y + 1).filter(|y| *y < height)].into_iter().flatten() {
            let begins = |x: usize| {
                let here = |x: usize| inside[next * width + x] && !reached[next * width + x];
                here(x) && (x == first || !here(x - 1))
            };
            starts.extend((first..=last).filter(|x| begins(*x)).map(|x| (x, next)));
        }
    }
    reached
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::random::{Purpose, Stream};

    fn picture(rows: &[&str]) -> (Vec<bool>, usize, usize) {
        (rows.iter().flat_map(|row| row.bytes().map(|b| b == b'.')).collect(), rows[0].len(), rows.len())
    }

    #[test]
    fn a_closed_hole_is_not_reached_and_a_corner_is_no_door() {
        let (thin, width, height) = picture(&[".......", ".#####.", ".#...#.", ".#.#.#.", ".####..", "......."]);
        let open = connected_to_border(&thin, width, height);
        assert!(open[0] && open[width * height - 1]);
        assert!(!open[2 * width + 2], "the hole");
        assert!(!open[3 * width + 4], "it touches the outside only at a corner");
        let (thin, width, height) = picture(&[".......", ".#####.", ".#...#.", ".#.#...", ".#####.", "......."]);
        assert!(connected_to_border(&thin, width, height)[2 * width + 2], "control: a door");
    }

    #[test]
    fn runs_reach_what_a_walk_from_pixel_to_pixel_reaches() {
        let mut stream = Stream::new(7, 0, 0, Purpose::Evaluation);
        for _ in 0..200 {
            let (width, height) = (1 + (stream.uniform() * 20.0) as usize, 1 + (stream.uniform() * 20.0) as usize);
            let share = stream.uniform();
            let thin: Vec<bool> = (0..width * height).map(|_| stream.uniform() < share).collect();
            let mut expected = vec![false; thin.len()];
            loop {
                let mut changed = false;
                for at in 0..thin.len() {
                    let (x, y) = (at % width, at / width);
                    let border = x == 0 || y == 0 || x + 1 == width || y + 1 == height;
                    let beside = [
                        (x > 0, at.wrapping_sub(1)),
                        (x + 1 < width, at + 1),
                        (y > 0, at.wrapping_sub(width)),
                        (y + 1 < height, at + width),
                    ];
                    if thin[at] && !expected[at] && (border || beside.iter().any(|(there, other)| *there && expected[*other])) {
                        expected[at] = true;
                        changed = true;
                    }
                }
                if !changed {
                    break;
                }
            }
            assert_eq!(connected_to_border(&thin, width, height), expected, "{width} x {height}");
        }
    }

    #[test]
    fn slices_lie_across_the_patient_whatever_the_order_of_axes() {
        // A tube along z, closed to the sides and open at its ends: its lumen is no room air. k runs along x here, i along z.
        let size = [5, 7, 6];
        let lps_from_voxel = DAffine3::from_mat3_translation(DMat3::from_cols(DVec3::Z * 2.0, DVec3::Y, DVec3::X), DVec3::ZERO);
        let at = |index: usize| [index % size[0], index / size[0] % size[1], index / (size[0] * size[1])];
        let ring = |index: usize| {
            let [_, j, k] = at(index);
            (1..=5).contains(&j) && (1..=4).contains(&k) && (j == 1 || j == 5 || k == 1 || k == 4)
        };
        let lumen = |index: usize| (2..=4).contains(&at(index)[1]) && (2..=3).contains(&at(index)[2]);
        let values: Vec<f32> = (0..210).map(|index| if ring(index) { 0.0 } else { -1000.0 }).collect();
        let found = AmbientAir::find(&VoxelGrid { size, lps_from_voxel }, &values, -700.0, &|_| false);
        for index in 0..210 {
            assert_eq!(found.holds(index), !ring(index) && !lumen(index), "{:?}", at(index));
        }
        assert_eq!(found.doubtful_slices, 0);
        let upright = DAffine3::from_scale(DVec3::ONE);
        let along = AmbientAir::find(&VoxelGrid { size, lps_from_voxel: upright }, &values, -700.0, &|_| false);
        assert!((0..210).any(|index| lumen(index) && along.holds(index)), "control: cut along the tube its lumen is open");
    }

    #[test]
    fn a_lung_that_is_open_to_the_border_is_doubtful() {
        let lung: Vec<f32> = vec![-850.0; 64];
        let grid = VoxelGrid { size: [4, 4, 4], lps_from_voxel: DAffine3::IDENTITY };
        assert_eq!(AmbientAir::find(&grid, &lung, -700.0, &|_| false).doubtful_slices, 4);
        assert_eq!(AmbientAir::find(&grid, &lung, -700.0, &|_| true).doubtful_slices, 0, "named");
        assert_eq!(AmbientAir::find(&grid, &[-1000.0; 64], -700.0, &|_| false).doubtful_slices, 0);
    }
}

//! Which poses put other beads where shadows are: a look at many side by side, before the few that are worth it are looked at one by one.

use glam::{DMat3, DVec3};

use super::occupancy::Occupancy;
use super::tables::Target;
use super::triangle::{Images, turn_and_shift};
use crate::geometry::Intrinsics;

/// What other beads are looked for in.
pub(super) struct Seen<'a> {
    pub targets: &'a [Target],
    pub images: &'a Images,
    pub intrinsics: &'a Intrinsics,
    pub shadows: &'a Occupancy,
}

/// So many go together from step to step, and from bead to bead: columns are as long as some times that.
pub(super) const WIDE: usize = 16;

/// What one group takes of a column.
#[inline(always)]
pub(super) fn part<T: Copy + Default>(column: &[T], first: usize) -> [T; WIDE] {
    let mut own = [T::default(); WIDE];
    own.copy_from_slice(&column[first..][..WIDE]);
    own
}

/// Tells which exact depths put so many other beads where a shadow may be near, and all before the camera.
pub(super) struct Supported<'b> {
    /// Triples with depths: the first of the columns.
    pub count: usize,
    pub beads: &'b [[u32; 3]],
    pub depths_mm: [&'b [f64]; 3],
    /// 1 where they do.
    pub counts: &'b mut [u64],
    pub seen: &'b Seen<'b>,
    pub needed: i64,
}

/// Turns column by column, and shifts.
struct Poses {
    turns: [[[f64; WIDE]; 3]; 3],
    shifts_mm: [[f64; WIDE]; 3],
}

impl Poses {
    #[inline(always)]
    fn new(corners_mm: &[[[f64; WIDE]; 3]; 3], depths_mm: &[[f64; WIDE]; 3], images: &Images) -> Self {
        let (mut turns, mut shifts_mm) = ([[[0.0; WIDE]; 3]; 3], [[0.0; WIDE]; 3]);
        for l in 0..WIDE {
            let [a, b, c] = corners_mm;
            let points = [
                DVec3::new(a[0][l], a[1][l], a[2][l]),
                DVec3::new(b[0][l], b[1][l], b[2][l]),
                DVec3::new(c[0][l], c[1][l], c[2][l]),
            ];
            let depths = [depths_mm[0][l], depths_mm[1][l], depths_mm[2][l]];
            let (turn, shift) = turn_and_shift(&points, images, depths);
            (turns[0][0][l], turns[0][1][l], turns[0][2][l]) = (turn.x_axis.x, turn.x_axis.y, turn.x_axis.z);
            (turns[1][0][l], turns[1][1][l], turns[1][2][l]) = (turn.y_axis.x, turn.y_axis.y, turn.y_axis.z);
            (turns[2][0][l], turns[2][1][l], turns[2][2][l]) = (turn.z_axis.x, turn.z_axis.y, turn.z_axis.z);
            (shifts_mm[0][l], shifts_mm[1][l], shifts_mm[2][l]) = (shift.x, shift.y, shift.z);
        }
        Self { turns, shifts_mm }
    }

    #[inline(always)]
    fn place(&self, l: usize, lps_mm: DVec3) -> DVec3 {
        let [x, y, z] = &self.turns;
        let turn = DMat3::from_cols(
            DVec3::new(x[0][l], x[1][l], x[2][l]),
            DVec3::new(y[0][l], y[1][l], y[2][l]),
            DVec3::new(z[0][l], z[1][l], z[2][l]),
        );
        turn * lps_mm + DVec3::new(self.shifts_mm[0][l], self.shifts_mm[1][l], self.shifts_mm[2][l])
    }
}

impl pulp::NullaryFnOnce for Supported<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { count, beads, depths_mm, counts, seen: Seen { targets, images, intrinsics, shadows }, needed } = self;
        let (images, intrinsics, count) = (**images, **intrinsics, count.min(beads.len()));
        for first in (0..count).step_by(WIDE) {
            let (mut own, mut corners_mm) = ([[0u64; WIDE]; 3], [[[0.0; WIDE]; 3]; 3]);
            for (l, beads) in beads[first..][..WIDE].iter().enumerate() {
                for (n, bead) in beads.iter().enumerate() {
                    let at = targets.get(*bead as usize).map_or(DVec3::ZERO, |target| target.lps_mm);
                    own[n][l] = u64::from(*bead);
                    (corners_mm[n][0][l], corners_mm[n][1][l], corners_mm[n][2][l]) = (at.x, at.y, at.z);
                }
            }
            let depths_mm = depths_mm.map(|column| part(column, first));
            let poses = Poses::new(&corners_mm, &depths_mm, &images);
            // Others that may still be near a shadow; of what only fills the vector there are none.
            let mut left = [-1i64; WIDE];
            left[..WIDE.min(count - first)].fill(targets.len() as i64 - 3);
            for (bead, target) in targets.iter().enumerate() {
                let (mut cells, mut is_before, mut is_near) = ([0u32; WIDE], [0i64; WIDE], [0i64; WIDE]);
                for l in 0..WIDE {
                    let p = poses.place(l, target.lps_mm);
                    is_before[l] = i64::from(p.z > 1.0);
                    cells[l] = shadows.cell(intrinsics.project(p));
                }
                for l in 0..WIDE {
                    is_near[l] = i64::from(shadows.is_near(cells[l]));
                }
                let mut most = i64::MIN;
                for l in 0..WIDE {
                    let is_own = (own[0][l] == bead as u64) | (own[1][l] == bead as u64) | (own[2][l] == bead as u64);
                    // One behind the camera is worse than any number of misses.
                    let lost = if is_before[l] == 0 { i64::from(u32::MAX) } else { is_near[l] ^ 1 };
                    left[l] = left[l].wrapping_sub(if is_own { 0 } else { lost });
                    most = most.max(left[l]);
                }
                if most < needed {
                    break;
                }
            }
            for (counts, left) in counts[first..][..WIDE].iter_mut().zip(left) {
                *counts = u64::from(left >= needed);
            }
        }
    }
}

//! A volume that is crossed in bundles of sixteen rays: where they begin and end, what lies below, whether the scan was complete.

use super::bundles::{Aimed, Pattern, Rays};
use super::cross_fixed::cross_fixed;
use super::cross_slabs::cross;
use super::edges::{BundleSums, Layers};
use super::fixed_lanes::FixedLanes;
use super::lanes::{LANES, Lanes};
use crate::render::cells::{BRICK, CUT};
use crate::render::prepared::{Prepared, SeenVolume, far_mm};
use crate::render::slabs::{AXES, CUT_BIT, SlabGrid};

/// The volume of a scene that can be crossed in bundles.
pub struct Crossing<'a> {
    /// The scene.
    pub prepared: &'a Prepared<'a>,
    /// Its volume.
    pub seen: &'a SeenVolume<'a>,
    /// Its rays.
    pub rays: Rays,
    grids: [Option<SlabGrid<'a>>; 3],
    /// Depth at which the volume ends, at most that of the detector.
    pub far_mm: f64,
    /// Cells that hold matter, as far as the grid goes: first and end.
    occupied: [[f64; 3]; 2],
    /// Whether rays are crossed in fixed point, thirty-two at a time.
    pub fixed: bool,
}

impl<'a> Crossing<'a> {
    /// `None` when the volume must be walked cell by cell: air is kept, or it is not for slabs.
    #[must_use]
    pub fn new(prepared: &'a Prepared<'a>, index: usize, fixed: bool) -> Option<Self> {
        let seen = &prepared.volumes[index];
        let slabs = seen.slabs.as_ref().filter(|_| seen.air_kind.is_none())?;
        let far_mm = far_mm(seen, prepared.detector_mm);
        let [first, end] = seen.cells.occupied.map(|cell| cell.map(|n| n as f64));
        let occupied =
            [first.map(|n| n.max(0.5)), std::array::from_fn(|axis| end[axis].min(seen.volume.size[axis] as f64 + 0.5))];
        let grids = [0, 1, 2].map(|axis| if fixed { slabs.rounded_grid(axis) } else { slabs.grid(axis) });
        Some(Self { prepared, seen, rays: Rays::new(&prepared.view, &seen.cell_from_camera), grids, far_mm, occupied, fixed })
    }

    /// The rays of `pattern`; those that are not `seen` cross nothing.
    #[inline(always)]
    #[must_use]
    pub fn aim(&self, pattern: Pattern, seen: &[bool; LANES]) -> Aimed {
        let (q, mm_per_depth) = self.rays.sixteen(&pattern);
        let mut main = [0; LANES];
        let mut l = 0;
        while l < LANES {
            // As `Rays::dominant`, lanes side by side.
            let [x, y, z] = [q[0][l].abs(), q[1][l].abs(), q[2][l].abs()];
            let (first, most) = (if y > x { 1.0 } else { 0.0 }, if y > x { y } else { x });
            main[l] = whole(if z > most { 2.0 } else { first }) as u8;
            l += 1;
        }
        let mut mm_per_cell = [[0.0; LANES]; 3];
        let mut axis = 0;
        while axis < 3 {
            let mut l = 0;
            while l < LANES {
                // A ray along the faces: far in or far out, never 0 · ∞.
                mm_per_cell[axis][l] = 1.0 / if q[axis][l].abs() < 1e-12 { 1e-12 } else { q[axis][l] };
                l += 1;
            }
            axis += 1;
        }
        let mut t = self.depths(&self.occupied, &mm_per_cell);
        let mut axes = [false; 3];
        let mut any = false;
        let mut l = 0;
        while l < LANES {
            if seen[l] && t[1][l] > t[0][l] {
                axes[usize::from(main[l])] = true;
                any = true;
            } else {
                t[1][l] = t[0][l];
            }
            l += 1;
        }
        Aimed { pattern, q, mm_per_cell, main, mm_per_depth, t, axes, any }
    }

    /// Depths between which each ray is inside a box of cells.
    #[inline(always)]
    fn depths(&self, [low, high]: &[[f64; 3]; 2], mm_per_cell: &[[f64; LANES]; 3]) -> [[f64; LANES]; 2] {
        let mut t = [[0.0; LANES], [self.prepared.detector_mm; LANES]];
        let mut axis = 0;
        while axis < 3 {
            let (to_low, to_high) = (low[axis] - self.rays.p[axis], high[axis] - self.rays.p[axis]);
            let mut l = 0;
            while l < LANES {
                let (x, y) = (to_low * mm_per_cell[axis][l], to_high * mm_per_cell[axis][l]);
                let (x, y) = if x < y { (x, y) } else { (y, x) };
                t[0][l] = if x > t[0][l] { x } else { t[0][l] };
                t[1][l] = if y < t[1][l] { y } else { t[1][l] };
                l += 1;
            }
            axis += 1;
        }
        t
    }
}

/// The nearest whole number, for x from −0.5 to 2³¹. Unlike `as`, which saturates, it is done for many lanes at once.
#[inline(always)]
fn whole(x: f64) -> i32 {
    // 2⁵², whose neighbours are 1 apart.
    (x + 4_503_599_627_370_496.0).to_bits() as i32
}

/// What lies below a rectangle of pixels.
pub struct Below<'c, 'a> {
    crossing: &'c Crossing<'a>,
    corners: [[f64; 2]; 4],
    filled: [bool; 3],
    layers: [Layers; 3],
}

impl<'c, 'a> Below<'c, 'a> {
    /// Below the pixels between `corners`.
    #[must_use]
    pub fn new(crossing: &'c Crossing<'a>, corners: [[f64; 2]; 4]) -> Self {
        Self { crossing, corners, filled: [false; 3], layers: Default::default() }
    }

    /// The volume for rays along an axis, and where they are described; sees to its layers.
    #[inline(always)]
    fn look(&mut self, axis: usize) -> Option<(&'c SlabGrid<'a>, f64)> {
        let grid = self.crossing.grids[axis].as_ref()?;
        let reference = 0.5 * f64::from(grid.voxels[2]);
        if !self.filled[axis] {
            self.layers[axis].fill(grid, &self.crossing.rays.corners(&self.corners, axis, reference), reference);
            self.filled[axis] = true;
        }
        Some((grid, reference))
    }

    /// Adds ∫ρ dc of rays along each of the axes that are dominant for any. Returns the bits of the bricks below; `None` where an axis has
    /// no slabs.
    #[inline(always)]
    pub fn cross<S: Lanes>(&mut self, s: S, aimed: &Aimed, sums: &mut BundleSums) -> Option<u8> {
        let mut met = 0;
        let pixels = aimed.pattern.corners();
        let rays = &self.crossing.rays;
        let mut axis = 0;
        while axis < 3 {
            if aimed.axes[axis] {
                let (grid, reference) = self.look(axis)?;
                let bundle = rays.bundle(aimed, rays.corners(&pixels, axis, reference), axis, reference);
                met |= cross::<S>(s, grid, &bundle, &self.layers[axis], sums);
            }
            axis += 1;
        }
        Some(met)
    }

    /// The same for two bundles, the second below the first, in fixed point.
    #[inline(always)]
    pub fn cross_fixed<S: FixedLanes>(&mut self, s: S, aimed: [&Aimed; 2], sums: [&mut BundleSums; 2]) -> Option<u8> {
        let mut met = 0;
        let [[left, right, _, _], [_, _, low_left, low_right]] = [aimed[0].pattern.corners(), aimed[1].pattern.corners()];
        let rays = &self.crossing.rays;
        let [first, second] = sums;
        let mut axis = 0;
        while axis < 3 {
            if aimed[0].axes[axis] || aimed[1].axes[axis] {
                let (grid, reference) = self.look(axis)?;
                let corners = rays.corners(&[left, right, low_left, low_right], axis, reference);
                let bundles = [rays.bundle(aimed[0], corners, axis, reference), rays.bundle(aimed[1], corners, axis, reference)];
                let [upper, lower] = &bundles;
                met |= cross_fixed::<S>(s, grid, [upper, lower], &corners, &self.layers[axis], [first, second]);
            }
            axis += 1;
        }
        Some(met)
    }
}

impl Crossing<'_> {
    /// Whether a ray of `aimed` crosses, between two depths, a cell in which matter borders on the unknown.
    #[inline(always)]
    #[must_use]
    pub fn meets_cut(&self, below: &Below, aimed: &Aimed, lane: usize, (from, to): (f64, f64)) -> bool {
        let axis = usize::from(aimed.main[lane]);
        let q = aimed.direction(lane);
        let [a, b, c] = AXES[axis];
        let (p, cells) = (&self.rays.p, &self.seen.cells);
        let (low, high) = (p[c] + q[c] * from, p[c] + q[c] * to);
        let (low, high) = if low < high { (low, high) } else { (high, low) };
        let last = [a, b, c].map(|axis| cells.size[axis] as i64 - 1);
        // Towards zero is as good as down: what is below 0 ends up in cell 0.
        let cell = |x: f64, place: usize| (x as i64).clamp(0, last[place]) as usize;
        let (first, end) = (cell(low, 2), cell(high, 2));
        let (slope_a, slope_b) = (q[a] / q[c], q[b] / q[c]);
        let across = |z: f64| (p[a] + slope_a * (z - p[c]), p[b] + slope_b * (z - p[c]));
        let is_cut = |ia: usize, ib: usize, ic: usize| {
            let mut at = [0usize; 3];
            (at[a], at[b], at[c]) = (ia, ib, ic);
            cells.kind[cells.index(at)] == CUT
        };
        let mut layer = first / BRICK;
        while layer <= end / BRICK {
            let (begin, stop) = ((layer * BRICK).max(first), (layer * BRICK + BRICK - 1).min(end));
            layer += 1;
            if below.layers[axis].at(begin as i32) & CUT_BIT == 0 {
                continue;
            }
            for ic in begin..stop + 1 {
                let ((a0, b0), (a1, b1)) = (across(low.max(ic as f64)), across(high.min(ic as f64 + 1.0)));
                let ([ia, ja], [ib, jb]) = ([cell(a0, 0), cell(a1, 0)], [cell(b0, 1), cell(b1, 1)]);
                // Between two slices a ray meets at most three cells; the middle one is behind the face that it reaches first.
                let share = |from: f64, to: f64| (from.max(to) as i64 as f64 - from) / (to - from);
                let middle = || if share(a0, a1) < share(b0, b1) { (ja, ib) } else { (ia, jb) };
                let bends = ia != ja && ib != jb;
                if is_cut(ia, ib, ic) || is_cut(ja, jb, ic) || (bends && is_cut(middle().0, middle().1, ic)) {
                    return true;
                }
            }
        }
        false
    }
}

//! Crossing a volume cell by cell, with the trilinear field integrated exactly in each.

use glam::DVec3;

use crate::render::cells::{BRICK, CUT, Cells, EMPTY, EMPTY_BRICK, MIXED, voxel_pair};
use crate::scene::model::Volume;

/// A ray `p + q t` in `cell` coordinates (voxel + 1).
#[derive(Clone, Copy, Debug)]
pub struct CellRay {
    /// At t = 0.
    pub p: DVec3,
    /// Per mm of depth.
    pub q: DVec3,
}

/// Which cells count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pass {
    /// Everything but cells that hold air only.
    Matter,
    /// Cells that hold air only.
    Air,
}

/// A volume with its cells, and which of its materials (index into `Cells::materials`) is air.
#[derive(Clone, Copy, Debug)]
pub struct Field<'a> {
    /// Voxels.
    pub volume: &'a Volume,
    /// Their cells.
    pub cells: &'a Cells,
    /// Kind of the air cells, if air is kept.
    pub air_kind: Option<u8>,
}

/// What a walk leaves behind.
#[derive(Debug, Default)]
pub struct Found {
    /// Where cells with matter were crossed, in order and merged; filled when `collect` is set.
    pub spans: Vec<(f64, f64)>,
    /// Whether to fill `spans`.
    pub collect: bool,
    /// The ray crossed from known matter into the unknown.
    pub cut: bool,
}

impl Field<'_> {
    /// Whether a cell counts in `pass`.
    #[inline]
    fn counts(&self, kind: u8, pass: Pass) -> bool {
        (self.air_kind == Some(kind)) == (pass == Pass::Air)
    }

    /// Adds ∫ρ_m dt over [`from`, `to`] (which must lie inside the grid) to `sums` (by scene material).
    // Along a straight piece m + s·h, s ∈ [−1, 1], a trilinear function has no pure quadratic terms; its mean is
    // f(m) + ⅓ (f_xy h_x h_y + f_yz h_y h_z + f_xz h_x h_z), exactly what two Gauss points give, for one evaluation.
    pub fn integrate(&self, ray: &CellRay, from: f64, to: f64, pass: Pass, sums: &mut [f64], found: &mut Found) {
        let (p, q) = (ray.p, ray.q);
        let size = self.cells.size;
        let start = p + q * from;
        let mut cell: [i32; 3] = std::array::from_fn(|axis| (start[axis].floor() as i32).clamp(0, size[axis] as i32 - 1));
        let inverse: [f64; 3] = std::array::from_fn(|axis| 1.0 / q[axis]);
        let step: [i32; 3] = std::array::from_fn(|axis| if q[axis] > 0.0 { 1 } else { -1 });
        let ahead: [i32; 3] = std::array::from_fn(|axis| i32::from(q[axis] > 0.0));
        let face = |axis: usize, at: i32| if q[axis] == 0.0 { f64::INFINITY } else { (f64::from(at) - p[axis]) * inverse[axis] };
        let mut next: [f64; 3] = std::array::from_fn(|axis| face(axis, cell[axis] + ahead[axis]));
        let delta: [f64; 3] = std::array::from_fn(|axis| inverse[axis].abs());
        let density = self.volume.density_g_per_cm3.as_slice();
        let (row, slice) = (self.volume.size[0], self.volume.size[0] * self.volume.size[1]);
        // Lower voxels of cells that lie between different voxels along every axis.
        let inner = self.volume.size.map(|n| n as u32 - 1);
        let mut t = from;
        loop {
            let index = (cell[2] as usize).wrapping_mul(size[1]).wrapping_add(cell[1] as usize);
            let index = index.wrapping_mul(size[0]).wrapping_add(cell[0] as usize);
            let kind = self.cells.kind[index];
            if kind == EMPTY_BRICK {
                // Leave the brick at once: to the nearest of its three far faces.
                let brick_face = |axis: usize| {
                    let brick = cell[axis].div_euclid(BRICK as i32) + ahead[axis];
                    face(axis, (brick * BRICK as i32).min(size[axis] as i32))
                };
                let exits = [brick_face(0), brick_face(1), brick_face(2)];
                let axis = smallest(&exits);
                t = t.max(exits[axis]);
                if !(t < to) {
                    return;
                }
                let here = p + q * t;
                for other in 0..3 {
                    if other == axis {
                        let brick = cell[other].div_euclid(BRICK as i32);
                        cell[other] = if step[other] > 0 { (brick + 1) * BRICK as i32 } else { brick * BRICK as i32 - 1 };
                    } else {
                        // Never backwards, however `here` was rounded: each jump then makes progress.
                        let at = (here[other].floor() as i32).clamp(0, size[other] as i32 - 1);
                        cell[other] = if step[other] > 0 { at.max(cell[other]) } else { at.min(cell[other]) };
                    }
                    if cell[other] < 0 || cell[other] >= size[other] as i32 {
                        return;
                    }
                    next[other] = face(other, cell[other] + ahead[other]);
                }
                continue;
            }
            let axis = smallest(&next);
            let beyond = next[axis];
            let end = if beyond < to { beyond } else { to };
            if kind != EMPTY && end > t && self.counts(kind, pass) {
                let lower = cell.map(|c| (c - 1) as u32);
                if kind < MIXED && lower[0] < inner[0] && lower[1] < inner[1] && lower[2] < inner[2] {
                    // Nearly every cell: one material, 2×2×2 different voxels. The grid has been checked to hold them.
                    let base = (lower[2] as usize).wrapping_mul(slice).wrapping_add((lower[1] as usize).wrapping_mul(row));
                    let base = base.wrapping_add(lower[0] as usize);
                    let [a, b] = pair(density, base);
                    let [c, d] = pair(density, base.wrapping_add(row));
                    let [e, f] = pair(density, base.wrapping_add(slice));
                    let [g, i] = pair(density, base.wrapping_add(slice).wrapping_add(row));
                    let (m, h) = middle_and_half(ray, cell, (t, end));
                    let mean = mean_along(&[a, b, c, d, e, f, g, i], m, h);
                    sums[self.cells.materials[usize::from(kind) - 1]] += f64::from(mean) * (end - t);
                } else {
                    self.add_piece(ray, cell, kind, (t, end), sums);
                }
                if found.collect {
                    match found.spans.last_mut() {
                        Some(last) if last.1 >= t => last.1 = end,
                        _ => found.spans.push((t, end)),
                    }
                }
                found.cut |= kind == CUT;
            }
            if !(beyond < to) {
                return;
            }
            t = if beyond > t { beyond } else { t };
            next[axis] = beyond + delta[axis];
            cell[axis] += step[axis];
            if cell[axis] < 0 || cell[axis] >= size[axis] as i32 {
                return;
            }
        }
    }

    /// Cells in which materials meet, and the outer half voxels.
    #[inline(never)]
    fn add_piece(&self, ray: &CellRay, cell: [i32; 3], kind: u8, (from, to): (f64, f64), sums: &mut [f64]) {
        let volume = self.volume;
        let (m, h) = middle_and_half(ray, cell, (from, to));
        let cell = cell.map(|c| c as usize);
        let [(i, di), (j, dj), (k, dk)] =
            [voxel_pair(cell[0], volume.size[0]), voxel_pair(cell[1], volume.size[1]), voxel_pair(cell[2], volume.size[2])];
        let (row, slice) = (dj * volume.size[0], dk * volume.size[0] * volume.size[1]);
        let base = volume.index(i, j, k);
        let density = &volume.density_g_per_cm3;
        let offsets = [0, di, row, row + di, slice, slice + di, slice + row, slice + row + di];
        let corners = offsets.map(|offset| density[base + offset]);
        let length = to - from;
        if kind < MIXED {
            sums[self.cells.materials[usize::from(kind - 1)]] += f64::from(mean_along(&corners, m, h)) * length;
            return;
        }
        // Where two materials meet, the second is the whole less the first: two means for eight weights.
        let kinds = offsets.map(|offset| match volume.class[base + offset] {
            0 => 0,
            class => self.cells.material_of_class[usize::from(class - 1)] + 1,
        });
        let first = kinds.into_iter().find(|kind| *kind != 0).unwrap_or(1);
        let second = kinds.into_iter().find(|kind| *kind != 0 && *kind != first).unwrap_or(first);
        let material = |kind: u8| self.cells.materials[usize::from(kind - 1)];
        if kinds.into_iter().all(|kind| kind == 0 || kind == first || kind == second) {
            let own: [f32; 8] = std::array::from_fn(|corner| if kinds[corner] == first { corners[corner] } else { 0.0 });
            let mean = mean_along(&own, m, h);
            sums[material(first)] += f64::from(mean) * length;
            if second != first {
                sums[material(second)] += f64::from((mean_along(&corners, m, h) - mean).max(0.0)) * length;
            }
            return;
        }
        for ((kind, weight), corner) in kinds.into_iter().zip(mean_weights(m, h)).zip(corners) {
            if kind != 0 {
                sums[material(kind)] += f64::from(weight * corner) * length;
            }
        }
    }
}

/// Middle of a piece from the cell's lower corner, and half its extent, in voxels.
#[inline(always)]
fn middle_and_half(ray: &CellRay, cell: [i32; 3], (from, to): (f64, f64)) -> ([f32; 3], [f32; 3]) {
    let (middle, half) = (0.5 * (from + to), 0.5 * (to - from));
    let (p, q) = (ray.p, ray.q);
    let m = [
        (p.x + q.x * middle - f64::from(cell[0])) as f32,
        (p.y + q.y * middle - f64::from(cell[1])) as f32,
        (p.z + q.z * middle - f64::from(cell[2])) as f32,
    ];
    (m, [(q.x * half) as f32, (q.y * half) as f32, (q.z * half) as f32])
}

/// Two neighbours along i.
#[inline(always)]
fn pair(values: &[f32], at: usize) -> [f32; 2] {
    match values.get(at..at.wrapping_add(2)) {
        Some(&[a, b]) => [a, b],
        _ => [0.0; 2],
    }
}

/// Index of the smallest; without branches, which would be mispredicted at every other cell.
#[inline(always)]
fn smallest(values: &[f64; 3]) -> usize {
    let first = usize::from(values[1] < values[0]);
    let third = usize::from(values[2] < values[first]);
    first * (1 - third) + 2 * third
}

/// Mean of the trilinear interpolant of `corners` (x fastest) along m − h … m + h.
#[inline(always)]
#[must_use]
pub fn mean_along(corners: &[f32; 8], m: [f32; 3], h: [f32; 3]) -> f32 {
    let [a, b, c, d, e, f, g, i] = *corners;
    let (x0, x1, x2, x3) = (b - a, d - c, f - e, i - g);
    let (v0, v1, v2, v3) = (a + m[0] * x0, c + m[0] * x1, e + m[0] * x2, g + m[0] * x3);
    let (y0, y1) = (v1 - v0, v3 - v2);
    let (w0, w1) = (v0 + m[1] * y0, v2 + m[1] * y1);
    let (xy0, xy1) = (x1 - x0, x3 - x2);
    let (wx0, wx1) = (x0 + m[1] * xy0, x2 + m[1] * xy1);
    let f_xy = xy0 + m[2] * (xy1 - xy0);
    let f_yz = y1 - y0;
    let f_xz = wx1 - wx0;
    w0 + m[2] * (w1 - w0) + (f_xy * h[0] * h[1] + f_yz * h[1] * h[2] + f_xz * h[0] * h[2]) * (1.0 / 3.0)
}

/// Mean trilinear weight of each corner along m − h … m + h; they add up to 1.
#[inline(always)]
#[must_use]
pub fn mean_weights(m: [f32; 3], h: [f32; 3]) -> [f32; 8] {
    std::array::from_fn(|corner| {
        let side = |axis: usize| if corner >> axis & 1 == 1 { (m[axis], h[axis]) } else { (1.0 - m[axis], -h[axis]) };
        let ((a, da), (b, db), (c, dc)) = (side(0), side(1), side(2));
        a * b * c + (a * db * dc + b * da * dc + c * da * db) * (1.0 / 3.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_is_what_a_fine_sum_gives() {
        let corners = [0.3f32, 1.2, 0.7, 0.1, 2.0, 0.4, 1.7, 0.9];
        let (m, h) = ([0.4f32, 0.55, 0.6], [0.3f32, -0.2, 0.35]);
        let at = |s: f32| {
            let x: [f32; 3] = std::array::from_fn(|axis| m[axis] + s * h[axis]);
            mean_weights(x, [0.0; 3]).iter().zip(corners).map(|(w, c)| w * c).sum::<f32>()
        };
        let fine = (0..1000).map(|i| f64::from(at(-1.0 + (i as f32 + 0.5) / 500.0))).sum::<f64>() / 1000.0;
        assert!((f64::from(mean_along(&corners, m, h)) - fine).abs() < 1e-6);
        let by_weights: f32 = mean_weights(m, h).iter().zip(corners).map(|(w, c)| w * c).sum();
        assert!((f64::from(by_weights) - fine).abs() < 1e-6);
        let midpoint_only = at(0.0);
        assert!((f64::from(midpoint_only) - fine).abs() > 1e-3, "the control: the midpoint rule is not exact");
    }
}

//! Bundles of sixteen neighbouring pixels, as rays through one volume.

use super::cross_slabs::{Bundle, Fit, fit};
use super::lanes::LANES;
use crate::geometry::View;
use crate::render::prepared::SeenVolume;
use crate::render::slabs::AXES;

/// Rays of an image in cell coordinates (voxel + 1): p + q(u, v) t with t the depth in mm, q linear in the pixel.
#[derive(Clone, Copy, Debug)]
pub struct Rays {
    /// The focal spot.
    pub p: [f64; 3],
    q0: [f64; 3],
    qu: [f64; 3],
    qv: [f64; 3],
}

/// Columns of pixels in a bundle; its rows are 16 / columns.
const LAYOUTS: [usize; 3] = [4, 8, 2];

impl Rays {
    /// Rays of `view` through `seen`.
    #[must_use]
    pub fn new(view: &View, seen: &SeenVolume) -> Self {
        let at = |u: f64, v: f64| seen.cell_from_camera.matrix3 * view.intrinsics.unproject(glam::DVec2::new(u, v));
        let q0 = at(0.0, 0.0);
        // Far pixels, so that the differences lose nothing.
        let far = 1024.0;
        let (qu, qv) = ((at(far, 0.0) - q0) / far, (at(0.0, far) - q0) / far);
        Self { p: seen.cell_from_camera.translation.to_array(), q0: q0.to_array(), qu: qu.to_array(), qv: qv.to_array() }
    }

    /// Cells per mm of depth.
    #[inline(always)]
    #[must_use]
    pub fn direction(&self, u: f64, v: f64) -> [f64; 3] {
        [
            self.q0[0] + self.qu[0] * u + self.qv[0] * v,
            self.q0[1] + self.qu[1] * u + self.qv[1] * v,
            self.q0[2] + self.qu[2] * u + self.qv[2] * v,
        ]
    }

    /// The axis along which a ray crosses most cells.
    #[inline(always)]
    #[must_use]
    pub fn dominant(q: [f64; 3]) -> usize {
        let first = usize::from(q[1].abs() > q[0].abs());
        if q[2].abs() > q[first].abs() { 2 } else { first }
    }

    /// Axes that are dominant somewhere in an image: the rays between the corners of a rectangle of pixels run along none that the
    /// corners do not, as long as the corners agree.
    #[must_use]
    pub fn axes(&self, size_px: [u32; 2]) -> [bool; 3] {
        let mut found = [false; 3];
        let [width, height] = size_px.map(|n| n as usize);
        for v in (0..height).step_by(8).chain([height - 1]) {
            for u in (0..width).step_by(8).chain([width - 1]) {
                found[Self::dominant(self.direction(u as f64, v as f64))] = true;
            }
        }
        found
    }

    /// Columns of the bundles near pixel (u, v) that need the smallest windows in a volume that ends at depth `t`.
    #[inline(always)]
    #[must_use]
    pub fn columns(&self, u: f64, v: f64, t: f64) -> usize {
        let q = self.direction(u, v);
        let [a, b, c] = AXES[Self::dominant(q)];
        let (slope_a, slope_b) = (q[a] / q[c], q[b] / q[c]);
        // Across at constant c: da = t (q_a' − slope q_c').
        let (au, av) = (((self.qu[a] - slope_a * self.qu[c]) * t).abs(), ((self.qv[a] - slope_a * self.qv[c]) * t).abs());
        let (bu, bv) = (((self.qu[b] - slope_b * self.qu[c]) * t).abs(), ((self.qv[b] - slope_b * self.qv[c]) * t).abs());
        let mut best = (Fit::Memory, LAYOUTS[0]);
        let mut i = 0;
        while i < LAYOUTS.len() {
            let (w, h) = ((LAYOUTS[i] - 1) as f64, (LANES / LAYOUTS[i] - 1) as f64);
            let found = fit([au * w + av * h + slope_a.abs(), bu * w + bv * h + slope_b.abs()]);
            if found < best.0 {
                best = (found, LAYOUTS[i]);
            }
            i += 1;
        }
        best.1
    }

    /// The rays of a block of pixels from (u, v) on that run mainly along `axis`, between the depths `t`.
    #[inline(always)]
    #[must_use]
    pub fn bundle(&self, [u, v]: [usize; 2], columns: usize, axis: usize, c_reference: f64, t: &[[f64; LANES]; 2]) -> Bundle {
        let [a, b, c] = AXES[axis];
        let mut bundle = Bundle {
            at: [[0.0; LANES]; 2],
            slope: [[0.0; LANES]; 2],
            c_reference,
            from: [0.0; LANES],
            to: [0.0; LANES],
            corners: [0, columns - 1, LANES - columns, LANES - 1],
        };
        let (mut qc, mut own) = ([0.0f64; LANES], [false; LANES]);
        let mut l = 0;
        while l < LANES {
            let q = self.direction((u + l % columns) as f64, (v + l / columns) as f64);
            let inverse = 1.0 / if q[c] == 0.0 { 1e-30 } else { q[c] };
            // Rays that run along another axis only mark the block's corners; they must stay finite.
            bundle.slope[0][l] = (q[a] * inverse).clamp(-4.0, 4.0);
            bundle.slope[1][l] = (q[b] * inverse).clamp(-4.0, 4.0);
            bundle.at[0][l] = self.p[a] + (c_reference - self.p[c]) * bundle.slope[0][l];
            bundle.at[1][l] = self.p[b] + (c_reference - self.p[c]) * bundle.slope[1][l];
            qc[l] = q[c];
            own[l] = Self::dominant(q) == axis;
            l += 1;
        }
        let mut l = 0;
        while l < LANES {
            let (x, y) = (self.p[c] + qc[l] * t[0][l], self.p[c] + qc[l] * t[1][l]);
            let (x, y) = if x < y { (x, y) } else { (y, x) };
            bundle.from[l] = x;
            bundle.to[l] = if own[l] && t[1][l] > t[0][l] { y } else { x };
            l += 1;
        }
        bundle
    }
}

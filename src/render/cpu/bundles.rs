//! Bundles of sixteen neighbouring pixels, as rays through one volume.

use glam::DAffine3;

use super::edges::{Bundle, Corners};
use super::fixed_windows;
use super::lanes::LANES;
use super::window_places::{Fit, fit};
use super::windows;
use crate::geometry::View;
use crate::render::slabs::AXES;

/// Rays of an image in cell coordinates (voxel + 1): p + q(u, v) t with t the depth in mm, q linear in the pixel.
#[derive(Clone, Copy, Debug)]
pub struct Rays {
    /// The focal spot.
    pub p: [f64; 3],
    q0: [f64; 3],
    qu: [f64; 3],
    qv: [f64; 3],
    /// x and y per mm of depth in the camera's frame, linear in the pixel: at (0, 0), by column, by row.
    camera: [[f64; 2]; 3],
}

/// Columns of pixels in a bundle; its rows are 16 / columns.
const LAYOUTS: [usize; 3] = [4, 8, 2];

/// The pixels of a bundle: rows of `columns` neighbours.
#[derive(Clone, Copy, Debug)]
pub struct Pattern {
    /// Columns of the pixels, lane by lane.
    pub u: [f64; LANES],
    /// Rows.
    pub v: [f64; LANES],
    columns: usize,
    first: [usize; 2],
}

impl Pattern {
    /// The pixels from (u, v) on, in rows of `columns`, a divisor of sixteen.
    #[inline(always)]
    #[must_use]
    pub fn grid([u, v]: [usize; 2], columns: usize) -> Self {
        let mut pattern = Self { u: [0.0; LANES], v: [0.0; LANES], columns, first: [u, v] };
        let mut l = 0;
        while l < LANES {
            pattern.u[l] = (u + l % columns) as f64;
            pattern.v[l] = (v + l / columns) as f64;
            l += 1;
        }
        pattern
    }

    /// Column and row of a pixel.
    #[inline(always)]
    #[must_use]
    pub fn pixel(&self, lane: usize) -> [usize; 2] {
        [self.first[0] + lane % self.columns, self.first[1] + lane / self.columns]
    }

    /// The four pixels that no other lies outside of.
    #[inline(always)]
    #[must_use]
    pub fn corners(&self) -> [[f64; 2]; 4] {
        let (left, right, top, bottom) = (self.u[0], self.u[self.columns - 1], self.v[0], self.v[LANES - 1]);
        [[left, top], [right, top], [left, bottom], [right, bottom]]
    }
}

/// Sixteen rays on their way.
#[derive(Clone, Copy)]
pub struct Aimed {
    /// Their pixels.
    pub pattern: Pattern,
    /// Cells per mm of depth, by axis.
    pub q: [[f64; LANES]; 3],
    /// mm of depth per cell, by axis; large where a ray runs along the faces, never infinite.
    pub mm_per_cell: [[f64; LANES]; 3],
    /// The axis along which each crosses most cells.
    pub main: [u8; LANES],
    /// mm along each ray per mm of depth.
    pub mm_per_depth: [f64; LANES],
    /// Depths between which they cross what holds matter.
    pub t: [[f64; LANES]; 2],
    /// Axes that are dominant for any of them.
    pub axes: [bool; 3],
    /// Whether any of them crosses anything.
    pub any: bool,
}

impl Aimed {
    /// Cells per mm of depth of one ray.
    #[inline(always)]
    #[must_use]
    pub fn direction(&self, lane: usize) -> [f64; 3] {
        [self.q[0][lane], self.q[1][lane], self.q[2][lane]]
    }

    /// g/cm² per unit of ∫ρ dc: along the axis with the largest |q| a ray is `mm_per_depth` / |q| mm long in a cell, and there are 10 mm in a cm.
    #[inline(always)]
    #[must_use]
    pub fn g_per_cm2(&self) -> [f32; LANES] {
        let mut scale = [0.0f32; LANES];
        let mut l = 0;
        while l < LANES {
            let [x, y, z] = [self.mm_per_cell[0][l].abs(), self.mm_per_cell[1][l].abs(), self.mm_per_cell[2][l].abs()];
            let least = if x < y { x } else { y };
            let least = if least < z { least } else { z };
            scale[l] = (0.1 * self.mm_per_depth[l] * least) as f32;
            l += 1;
        }
        scale
    }
}

impl Rays {
    /// Rays of `view` through a volume whose cells lie at `cell_from_camera`.
    #[must_use]
    pub fn new(view: &View, cell_from_camera: &DAffine3) -> Self {
        let at = |u: f64, v: f64| cell_from_camera.matrix3 * view.intrinsics.unproject(glam::DVec2::new(u, v));
        let q0 = at(0.0, 0.0);
        // Far pixels, so that the differences lose nothing.
        let far = 1024.0;
        let (qu, qv) = ((at(far, 0.0) - q0) / far, (at(0.0, far) - q0) / far);
        let plane = |u: f64, v: f64| view.intrinsics.unproject(glam::DVec2::new(u, v)).truncate();
        let camera = [plane(0.0, 0.0), (plane(far, 0.0) - plane(0.0, 0.0)) / far, (plane(0.0, far) - plane(0.0, 0.0)) / far];
        Self {
            p: cell_from_camera.translation.to_array(),
            q0: q0.to_array(),
            qu: qu.to_array(),
            qv: qv.to_array(),
            camera: camera.map(|at| at.to_array()),
        }
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

    /// Directions of the rays of a pattern, by axis, and mm along each per mm of depth.
    #[inline(always)]
    #[must_use]
    pub fn sixteen(&self, pattern: &Pattern) -> ([[f64; LANES]; 3], [f64; LANES]) {
        let mut q = [[0.0; LANES]; 3];
        let mut l = 0;
        while l < LANES {
            [q[0][l], q[1][l], q[2][l]] = self.direction(pattern.u[l], pattern.v[l]);
            l += 1;
        }
        let [at, by_u, by_v] = &self.camera;
        let mut mm = [0.0; LANES];
        let mut l = 0;
        while l < LANES {
            let x = at[0] + by_u[0] * pattern.u[l] + by_v[0] * pattern.v[l];
            let y = at[1] + by_u[1] * pattern.u[l] + by_v[1] * pattern.v[l];
            mm[l] = (1.0 + x * x + y * y).sqrt();
            l += 1;
        }
        (q, mm)
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
        let mut best = (Fit::Memory, LAYOUTS[0]);
        let mut i = 0;
        while i < LAYOUTS.len() {
            let found = fit(self.spread([u, v], t, [LAYOUTS[i], LANES / LAYOUTS[i]], 1.0), windows::BROAD_ROWS);
            if found < best.0 {
                best = (found, LAYOUTS[i]);
            }
            i += 1;
        }
        best.1
    }

    /// The same for two bundles, one below the other, of every `step_px`-th pixel, in fixed point.
    #[inline(always)]
    #[must_use]
    pub fn fixed_fit(&self, at: [f64; 2], t: f64, step_px: f64) -> (Fit, usize) {
        let wide = fit(self.spread(at, t, [8, 4], step_px), fixed_windows::BROAD_ROWS);
        let high = fit(self.spread(at, t, [4, 8], step_px), fixed_windows::BROAD_ROWS);
        if wide <= high { (wide, 8) } else { (high, 4) }
    }

    /// Voxels along a and b that so many columns and rows of every `step_px`-th pixel near (u, v) spread over in one slab, at depth `t`.
    #[inline(always)]
    fn spread(&self, [u, v]: [f64; 2], t: f64, [columns, rows]: [usize; 2], step_px: f64) -> [f64; 2] {
        let q = self.direction(u, v);
        let [a, b, c] = AXES[Self::dominant(q)];
        let (slope_a, slope_b) = (q[a] / q[c], q[b] / q[c]);
        // Across at constant c: da = t (q_a' − slope q_c').
        let (au, av) = (((self.qu[a] - slope_a * self.qu[c]) * t).abs(), ((self.qv[a] - slope_a * self.qv[c]) * t).abs());
        let (bu, bv) = (((self.qu[b] - slope_b * self.qu[c]) * t).abs(), ((self.qv[b] - slope_b * self.qv[c]) * t).abs());
        let (w, h) = (step_px * (columns - 1) as f64, step_px * (rows - 1) as f64);
        [au * w + av * h + slope_a.abs(), bu * w + bv * h + slope_b.abs()]
    }

    /// Whether the windows of fixed point hold the bundles of an image, of which every `step_px`-th pixel is cast, through a volume that
    /// ends at depth `t`.
    #[must_use]
    pub fn fit_windows(&self, size_px: [u32; 2], t: f64, step_px: u32) -> bool {
        let at = |n: u32| [0.0, 0.5 * f64::from(n), f64::from(n)];
        let held = |u: f64, v: f64| self.fixed_fit([u, v], t, f64::from(step_px)).0 != Fit::Memory;
        at(size_px[0]).into_iter().all(|u| at(size_px[1]).into_iter().all(|v| held(u, v)))
    }

    /// Lines through the corners of a rectangle of pixels, as functions of c.
    #[inline(always)]
    #[must_use]
    pub fn corners(&self, pixels: &[[f64; 2]; 4], axis: usize, c_reference: f64) -> Corners {
        let mut corners = Corners::default();
        let mut i = 0;
        while i < 4 {
            let q = self.direction(pixels[i][0], pixels[i][1]);
            let (at, slope) = self.line(&q, axis, c_reference);
            let mut x = 0;
            while x < 2 {
                corners.at[x][i] = at[x];
                corners.slope[x][i] = slope[x];
                x += 1;
            }
            i += 1;
        }
        corners
    }

    /// A ray as a function of c: where it is at `c_reference`, and its slopes.
    #[inline(always)]
    fn line(&self, q: &[f64; 3], axis: usize, c_reference: f64) -> ([f64; 2], [f64; 2]) {
        let [a, b, c] = AXES[axis];
        let inverse = 1.0 / if q[c] == 0.0 { 1e-30 } else { q[c] };
        // Rays that run along another axis only mark corners; they must stay finite.
        let slope = [(q[a] * inverse).clamp(-4.0, 4.0), (q[b] * inverse).clamp(-4.0, 4.0)];
        let on = c_reference - self.p[c];
        ([self.p[a] + on * slope[0], self.p[b] + on * slope[1]], slope)
    }

    /// The rays of `aimed` that run mainly along `axis`.
    #[inline(always)]
    #[must_use]
    pub fn bundle(&self, aimed: &Aimed, corners: Corners, axis: usize, c_reference: f64) -> Bundle {
        let [a, b, c] = AXES[axis];
        let (qa, qb, qc) = (&aimed.q[a], &aimed.q[b], &aimed.q[c]);
        let on = c_reference - self.p[c];
        let mut bundle = Bundle {
            at: [[0.0; LANES]; 2],
            slope: [[0.0; LANES]; 2],
            c_reference,
            from: [0.0; LANES],
            to: [0.0; LANES],
            corners,
        };
        let mut l = 0;
        while l < LANES {
            // Rays that run along another axis must only stay finite.
            let inverse = aimed.mm_per_cell[c][l];
            bundle.slope[0][l] = (qa[l] * inverse).clamp(-4.0, 4.0);
            bundle.slope[1][l] = (qb[l] * inverse).clamp(-4.0, 4.0);
            l += 1;
        }
        let mut l = 0;
        while l < LANES {
            bundle.at[0][l] = self.p[a] + on * bundle.slope[0][l];
            bundle.at[1][l] = self.p[b] + on * bundle.slope[1][l];
            l += 1;
        }
        let mut l = 0;
        while l < LANES {
            let (x, y) = (self.p[c] + qc[l] * aimed.t[0][l], self.p[c] + qc[l] * aimed.t[1][l]);
            let (x, y) = if x < y { (x, y) } else { (y, x) };
            bundle.from[l] = x;
            bundle.to[l] = if usize::from(aimed.main[l]) == axis && aimed.t[1][l] > aimed.t[0][l] { y } else { x };
            l += 1;
        }
        bundle
    }
}

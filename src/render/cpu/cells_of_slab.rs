//! The cells that rays meet between two slices of voxels.
//!
//! A ray whose slopes are at most 1 meets at most three: it leaves the first through a face across a or b, and the second through the
//! other. In each cell the trilinear field along the ray is a cubic polynomial, whose mean is f(m) + ⅓ (f_ab h_a h_b + f_bc h_b h_c +
//! f_ac h_a h_c) with m the middle and h half the piece: the integral is exact. Rules that do not see the faces (Joseph's, Simpson's)
//! save little and err at every face.
//!
//! Of a and b, p is the one whose face a ray meets first, q the other; both are measured along the ray's own direction, so that nodes
//! are (0, 0) (1, 0) (0, 1) (1, 1) in the first cell, (1, 0) (2, 0) (1, 1) (2, 1) in the second, (1, 1) (2, 1) (1, 2) (2, 2) in the third.

use super::edges::Bundle;
use super::lanes::{LANES, Lanes};
use super::windows::Window;
use crate::render::slabs::SlabGrid;

/// Slopes of sixteen rays and what follows from them.
#[derive(Clone, Copy)]
pub struct Slopes<S: Lanes> {
    /// da/dc.
    pub a: S::F,
    /// db/dc.
    pub b: S::F,
    size: [S::F; 2],
    inverse: [S::F; 2],
    /// 1 where the ray runs backwards: its first node lies behind the floor.
    behind: [S::F; 2],
    sign: [S::F; 2],
    /// From node to node along the ray.
    step: [S::I; 2],
}

/// `stride` is the step of indices from row to row.
#[inline(always)]
#[must_use]
pub fn slopes<S: Lanes>(s: S, bundle: &Bundle, stride: i32) -> Slopes<S> {
    let mut slope = [[0.0f32; LANES]; 2];
    let mut x = 0;
    while x < 2 {
        let mut l = 0;
        while l < LANES {
            slope[x][l] = bundle.slope[x][l] as f32;
            l += 1;
        }
        x += 1;
    }
    let (zero, one, minus) = (s.splat(0.0), s.splat(1.0), s.splat(-1.0));
    let (a, b) = (s.load(&slope[0]), s.load(&slope[1]));
    let (back_a, back_b) = (s.less(a, zero), s.less(b, zero));
    let size = [s.max(a, s.sub(zero, a)), s.max(b, s.sub(zero, b))];
    // Along a slope of 0 the face ahead is never reached.
    let tiny = s.splat(1e-20);
    Slopes {
        a,
        b,
        size,
        inverse: [s.div(one, s.max(size[0], tiny)), s.div(one, s.max(size[1], tiny))],
        behind: [s.select(back_a, one, zero), s.select(back_b, one, zero)],
        sign: [s.select(back_a, minus, one), s.select(back_b, minus, one)],
        step: [
            s.select_index(back_a, s.same_index(-1), s.same_index(1)),
            s.select_index(back_b, s.same_index(-stride), s.same_index(stride)),
        ],
    }
}

/// The cubic pieces of one slab.
struct Pieces<'t, S: Lanes, const N: usize> {
    class_bits: u32,
    classes: [u32; N],
    /// dp/dc and dq/dc.
    slope: [S::F; 2],
    totals: &'t mut [S::F; N],
}

/// Adds the integrals over a slab's part [from, to], in units of c; `at` counts from where the windows begin.
#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "everything is in registers")]
pub fn cells<S: Lanes, W: Window<S>, const N: usize>(
    s: S,
    grid: &SlabGrid,
    k: &Slopes<S>,
    [a, b]: [S::F; 2],
    [w0, w1]: [W; 2],
    [from, to]: [S::F; 2],
    classes: [u32; N],
    totals: &mut [S::F; N],
) {
    let one = s.splat(1.0);
    let (ia, ib) = (s.add(s.floor(a), k.behind[0]), s.add(s.floor(b), k.behind[1]));
    let (pa, pb) = (s.mul(s.sub(a, ia), k.sign[0]), s.mul(s.sub(b, ib), k.sign[1]));
    // Where the ray leaves the first cell across a and across b; the clamp takes care of slopes near 0.
    let ta = s.min(s.max(s.mul(s.sub(one, pa), k.inverse[0]), from), to);
    let tb = s.min(s.max(s.mul(s.sub(one, pb), k.inverse[1]), from), to);
    let a_first = s.less(ta, tb);
    let (t1, t2) = (s.min(ta, tb), s.max(ta, tb));
    let step_p = s.select_index(a_first, k.step[0], k.step[1]);
    let step_q = s.select_index(a_first, k.step[1], k.step[0]);
    let (p, q) = (s.select(a_first, pa, pb), s.select(a_first, pb, pa));
    let slope = [s.select(a_first, k.size[0], k.size[1]), s.select(a_first, k.size[1], k.size[0])];
    let mut pieces = Pieces { class_bits: grid.class_bits, classes, slope, totals };

    let i00 = s.index(s.fma(ib, s.splat(W::STRIDE as f32), ia));
    let i10 = s.add_index(i00, step_p);
    let i01 = s.add_index(i00, step_q);
    let i11 = s.add_index(i10, step_q);
    let (l10, u10) = (w0.fetch(s, grid, i10), w1.fetch(s, grid, i10));
    let (l11, u11) = (w0.fetch(s, grid, i11), w1.fetch(s, grid, i11));
    let lower = [w0.fetch(s, grid, i00), l10, w0.fetch(s, grid, i01), l11];
    let upper = [w1.fetch(s, grid, i00), u10, w1.fetch(s, grid, i01), u11];
    pieces.add(s, [p, q], lower, upper, [from, t1]);
    if !s.any(s.less(t1, to)) {
        return;
    }
    let p = s.sub(p, one);
    let (i20, i21) = (s.add_index(i10, step_p), s.add_index(i11, step_p));
    let (l21, u21) = (w0.fetch(s, grid, i21), w1.fetch(s, grid, i21));
    let lower = [l10, w0.fetch(s, grid, i20), l11, l21];
    let upper = [u10, w1.fetch(s, grid, i20), u11, u21];
    pieces.add(s, [p, q], lower, upper, [t1, t2]);
    if !s.any(s.less(t2, to)) {
        return;
    }
    let q = s.sub(q, one);
    let (i12, i22) = (s.add_index(i11, step_q), s.add_index(i21, step_q));
    let lower = [l11, l21, w0.fetch(s, grid, i12), w0.fetch(s, grid, i22)];
    let upper = [u11, u21, w1.fetch(s, grid, i12), w1.fetch(s, grid, i22)];
    pieces.add(s, [p, q], lower, upper, [t2, to]);
}

impl<S: Lanes, const N: usize> Pieces<'_, S, N> {
    /// One material's share of four values.
    #[inline(always)]
    fn own(&self, s: S, v: [S::F; 4], class: u32) -> [S::F; 4] {
        if N == 1 {
            return v;
        }
        let bits = self.class_bits;
        [
            s.of_class(v[0], bits, class),
            s.of_class(v[1], bits, class),
            s.of_class(v[2], bits, class),
            s.of_class(v[3], bits, class),
        ]
    }

    /// The integral over [from, to] in the cell with values (0, 0) (1, 0) (0, 1) (1, 1) on its lower and its upper side; p, q from its
    /// first node on, at the slab's beginning.
    #[inline(always)]
    fn add(&mut self, s: S, [p, q]: [S::F; 2], lower: [S::F; 4], upper: [S::F; 4], [from, to]: [S::F; 2]) {
        let half = s.splat(0.5);
        let length = s.sub(to, from);
        let (h, m) = (s.mul(half, length), s.mul(half, s.add(from, to)));
        let (fp, fq) = (s.fma(self.slope[0], m, p), s.fma(self.slope[1], m, q));
        let (hp, hq) = (s.mul(self.slope[0], h), s.mul(self.slope[1], h));
        let third = s.splat(1.0 / 3.0);
        let mut n = 0;
        while n < N {
            let (v, u) = (self.own(s, lower, self.classes[n]), self.own(s, upper, self.classes[n]));
            // Differences along c, values at m.
            let d = [s.sub(u[0], v[0]), s.sub(u[1], v[1]), s.sub(u[2], v[2]), s.sub(u[3], v[3])];
            let e = [s.fma(m, d[0], v[0]), s.fma(m, d[1], v[1]), s.fma(m, d[2], v[2]), s.fma(m, d[3], v[3])];
            let (ep0, ep1) = (s.sub(e[1], e[0]), s.sub(e[3], e[2]));
            let (x, y) = (s.fma(fp, ep0, e[0]), s.fma(fp, ep1, e[2]));
            let value = s.fma(fq, s.sub(y, x), x);
            let f_pq = s.sub(ep1, ep0);
            let dp = s.sub(d[1], d[0]);
            let d_pq = s.sub(s.sub(d[3], d[2]), dp);
            let (f_pc, f_qc) = (s.fma(fq, d_pq, dp), s.fma(fp, d_pq, s.sub(d[2], d[0])));
            let with_c = s.mul(s.fma(f_qc, hq, s.mul(f_pc, hp)), h);
            let cross = s.fma(s.mul(f_pq, hp), hq, with_c);
            self.totals[n] = s.fma(length, s.fma(third, cross, value), self.totals[n]);
            n += 1;
        }
    }
}

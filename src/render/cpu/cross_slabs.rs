//! Crossing a volume slab by slab, sixteen rays at a time.
//!
//! Between two slices of voxels a ray whose slopes are at most 1 meets at most three cells: it leaves the first through a face
//! across a or b, and the second through the other. In each cell the trilinear field along the ray is a cubic polynomial, whose mean
//! is f(m) + ⅓ (f_ab h_a h_b + f_bc h_b h_c + f_ac h_a h_c): the integral is exact, with three evaluations a slab. Rules that do not see
//! the faces (Joseph's, Simpson's) save a fifth of the time and err a thousand times more.

use super::lanes::{LANES, Lanes};
use super::windows::{Memory, Small, Square, Wide, Window};
use crate::render::slabs::SlabGrid;

/// Sixteen rays as functions of c.
#[derive(Clone, Debug)]
pub struct Bundle {
    /// Position along a and b at `c_reference`.
    pub at: [[f64; LANES]; 2],
    /// da/dc and db/dc.
    pub slope: [[f64; LANES]; 2],
    /// Where `at` holds.
    pub c_reference: f64,
    /// First and last c; no lane with `to` ≤ `from` counts.
    pub from: [f64; LANES],
    /// See `from`.
    pub to: [f64; LANES],
    /// Lanes at the corners of the block of pixels: all others lie between them.
    pub corners: [usize; 4],
}

/// The smallest kind of window that holds a bundle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fit {
    /// 8 × 4.
    Small,
    /// 16 × 4.
    Wide,
    /// 8 × 8.
    Square,
    /// Any.
    Memory,
}

/// What holds values that spread over `spread` voxels along a and b in one slab (slope included).
#[inline(always)]
#[must_use]
pub fn fit(spread: [f64; 2]) -> Fit {
    let [a, b] = spread;
    // n values hold positions that spread over n − 2: one more for the floor, one for the upper neighbour.
    if a <= 5.99 && b <= 1.99 {
        Fit::Small
    } else if a <= 13.99 && b <= 1.99 {
        Fit::Wide
    } else if a <= 5.99 && b <= 5.99 {
        Fit::Square
    } else {
        Fit::Memory
    }
}

/// Slopes and what follows from them.
#[derive(Clone, Copy)]
struct Slopes<S: Lanes> {
    a: S::F,
    b: S::F,
    inverse_a: S::F,
    inverse_b: S::F,
    ahead_a: S::F,
    ahead_b: S::F,
    step_a: S::F,
    step_b: S::F,
}

/// Adds ∫ρ dc per material (`classes`, at most `M`) to `sums`. Returns the bits of all bricks that were met.
#[inline(always)]
pub fn cross<S: Lanes, const M: usize>(
    s: S,
    grid: &SlabGrid,
    bundle: &Bundle,
    classes: &[u32; M],
    sums: &mut [[f32; LANES]; M],
) -> u8 {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    let (mut full_from, mut full_to) = (f64::NEG_INFINITY, f64::INFINITY);
    let mut l = 0;
    while l < LANES {
        if bundle.to[l] > bundle.from[l] {
            low = if bundle.from[l] < low { bundle.from[l] } else { low };
            high = if bundle.to[l] > high { bundle.to[l] } else { high };
        }
        full_from = if bundle.from[l] > full_from { bundle.from[l] } else { full_from };
        full_to = if bundle.to[l] < full_to { bundle.to[l] } else { full_to };
        l += 1;
    }
    if !(high > low) {
        return 0;
    }
    let mut spread = [0.0f64; 2];
    let mut axis = 0;
    while axis < 2 {
        let near = corners_at(bundle, axis, low);
        let far = corners_at(bundle, axis, high);
        let (near, far) = (max4(near) - min4(near), max4(far) - min4(far));
        let mut steepest = 0.0f64;
        let mut i = 0;
        while i < 4 {
            let slope = bundle.slope[axis][bundle.corners[i]].abs();
            steepest = if slope > steepest { slope } else { steepest };
            i += 1;
        }
        spread[axis] = if near > far { near } else { far } + steepest;
        axis += 1;
    }
    let range = Range { low, high, full_from, full_to };
    if !S::TABLES {
        return cross_in::<S, Memory, M>(s, grid, bundle, &range, classes, sums);
    }
    match fit(spread) {
        Fit::Small => cross_in::<S, Small<S>, M>(s, grid, bundle, &range, classes, sums),
        Fit::Wide => cross_in::<S, Wide<S>, M>(s, grid, bundle, &range, classes, sums),
        Fit::Square => cross_in::<S, Square<S>, M>(s, grid, bundle, &range, classes, sums),
        Fit::Memory => cross_in::<S, Memory, M>(s, grid, bundle, &range, classes, sums),
    }
}

/// Values of c that any lane, and that all lanes cross.
struct Range {
    low: f64,
    high: f64,
    full_from: f64,
    full_to: f64,
}

#[inline(always)]
fn corners_at(bundle: &Bundle, axis: usize, c: f64) -> [f64; 4] {
    let mut x = [0.0; 4];
    let mut i = 0;
    while i < 4 {
        let lane = bundle.corners[i];
        x[i] = bundle.at[axis][lane] + bundle.slope[axis][lane] * (c - bundle.c_reference);
        i += 1;
    }
    x
}

#[inline(always)]
fn min4(v: [f64; 4]) -> f64 {
    let a = if v[0] < v[1] { v[0] } else { v[1] };
    let b = if v[2] < v[3] { v[2] } else { v[3] };
    if a < b { a } else { b }
}

#[inline(always)]
fn max4(v: [f64; 4]) -> f64 {
    let a = if v[0] > v[1] { v[0] } else { v[1] };
    let b = if v[2] > v[3] { v[2] } else { v[3] };
    if a > b { a } else { b }
}

#[inline(always)]
fn slopes<S: Lanes>(s: S, bundle: &Bundle) -> Slopes<S> {
    let mut value = [[0.0f32; LANES]; 2];
    let mut inverse = [[0.0f32; LANES]; 2];
    let mut ahead = [[0.0f32; LANES]; 2];
    let mut step = [[0.0f32; LANES]; 2];
    let mut axis = 0;
    while axis < 2 {
        let mut l = 0;
        while l < LANES {
            let slope = bundle.slope[axis][l] as f32;
            value[axis][l] = slope;
            inverse[axis][l] = if slope.abs() < 1e-20 { 1e20 } else { 1.0 / slope };
            // A slope of 0 looks ahead: the face there is never reached.
            ahead[axis][l] = if slope >= 0.0 { 1.0 } else { 0.0 };
            step[axis][l] = if slope >= 0.0 { 1.0 } else { -1.0 };
            l += 1;
        }
        axis += 1;
    }
    Slopes {
        a: s.load(&value[0]),
        b: s.load(&value[1]),
        inverse_a: s.load(&inverse[0]),
        inverse_b: s.load(&inverse[1]),
        ahead_a: s.load(&ahead[0]),
        ahead_b: s.load(&ahead[1]),
        step_a: s.load(&step[0]),
        step_b: s.load(&step[1]),
    }
}

/// Slabs along the edge of a brick.
const BRICK: i32 = 8;

#[inline(always)]
fn cross_in<S: Lanes, W: Window<S>, const M: usize>(
    s: S,
    grid: &SlabGrid,
    bundle: &Bundle,
    range: &Range,
    classes: &[u32; M],
    sums: &mut [[f32; LANES]; M],
) -> u8 {
    let k = slopes(s, bundle);
    let mut totals = [s.splat(0.0); M];
    let mut met = 0;
    let end = (range.high.ceil() as i32).min(grid.voxels[2] + 1);
    let mut slab = (range.low.floor() as i32).max(0);
    while slab < end {
        let group_end = ((slab / BRICK + 1) * BRICK).min(end);
        let group = Group::new::<S, W>(grid, bundle, slab, group_end);
        let mask = group.bricks(grid, slab);
        if mask == 0 {
            slab = group_end;
            continue;
        }
        met |= mask;
        let mut x = [[0.0f32; LANES]; 2];
        let mut axis = 0;
        while axis < 2 {
            let shift = f64::from(slab) - bundle.c_reference;
            let mut l = 0;
            while l < LANES {
                x[axis][l] = (bundle.at[axis][l] + bundle.slope[axis][l] * shift - group.low[axis]) as f32;
                l += 1;
            }
            axis += 1;
        }
        let (mut xa, mut xb) = (s.load(&x[0]), s.load(&x[1]));
        let mut j = 0;
        while slab < group_end {
            let [wa, wb] = group.windows[j];
            let (w0, w1) = (W::open(s, grid, wa, wb, slab), W::open(s, grid, wa, wb, slab + 1));
            let a = s.add(xa, s.splat(group.low[0] as f32 - wa as f32));
            let b = s.add(xb, s.splat(group.low[1] as f32 - wb as f32));
            let whole = f64::from(slab) >= range.full_from && f64::from(slab + 1) <= range.full_to;
            let (mut from, mut to) = (s.splat(0.0), s.splat(1.0));
            if !whole {
                let (mut f, mut t) = ([0.0f32; LANES], [0.0f32; LANES]);
                let mut l = 0;
                while l < LANES {
                    f[l] = (bundle.from[l] - f64::from(slab)).clamp(0.0, 1.0) as f32;
                    t[l] = (bundle.to[l] - f64::from(slab)).clamp(0.0, 1.0) as f32;
                    t[l] = if t[l] > f[l] { t[l] } else { f[l] };
                    l += 1;
                }
                (from, to) = (s.load(&f), s.load(&t));
            }
            cells::<S, W, M>(s, grid, &k, a, b, w0, w1, from, to, classes, &mut totals);
            (xa, xb) = (s.add(xa, k.a), s.add(xb, k.b));
            slab += 1;
            j += 1;
        }
    }
    let mut m = 0;
    while m < M {
        let total = s.store(totals[m]);
        let mut l = 0;
        while l < LANES {
            sums[m][l] += total[l];
            l += 1;
        }
        m += 1;
    }
    met
}

/// Up to eight slabs in one layer of bricks.
struct Group {
    /// Whole numbers at or below all positions.
    low: [f64; 2],
    high: [f64; 2],
    /// Where each slab's window begins.
    windows: [[i32; 2]; BRICK as usize],
}

impl Group {
    #[inline(always)]
    fn new<S: Lanes, W: Window<S>>(grid: &SlabGrid, bundle: &Bundle, slab: i32, end: i32) -> Self {
        let mut group = Self { low: [0.0; 2], high: [0.0; 2], windows: [[0; 2]; BRICK as usize] };
        let mut axis = 0;
        while axis < 2 {
            let near = corners_at(bundle, axis, f64::from(slab));
            let far = corners_at(bundle, axis, f64::from(end));
            let (low, far_low) = (min4(near), min4(far));
            let (high, far_high) = (max4(near), max4(far));
            group.low[axis] = if low < far_low { low } else { far_low }.floor();
            group.high[axis] = if high > far_high { high } else { far_high };
            if W::SIZE[axis] > 0 {
                // The lowest corner over slab j is at x + min(slope, 0) + slope j.
                let mut lowest = [f32::INFINITY; BRICK as usize];
                let mut i = 0;
                while i < 4 {
                    let slope = bundle.slope[axis][bundle.corners[i]] as f32;
                    let x = (near[i] - group.low[axis]) as f32 + if slope < 0.0 { slope } else { 0.0 };
                    let mut j = 0;
                    while j < BRICK as usize {
                        let here = x + slope * j as f32;
                        lowest[j] = if here < lowest[j] { here } else { lowest[j] };
                        j += 1;
                    }
                    i += 1;
                }
                let last = grid.size[axis] - W::SIZE[axis];
                let mut j = 0;
                while j < BRICK as usize {
                    // Whole numbers within a few thousand: the cast is a floor after the shift.
                    let start = (lowest[j] + 64.0) as i32 - 64 + group.low[axis] as i32;
                    let start = if start > last { last } else { start };
                    group.windows[j][axis] = if start < 0 { 0 } else { start };
                    j += 1;
                }
            }
            axis += 1;
        }
        group
    }

    /// Union of the bricks below the bundle.
    #[inline(always)]
    fn bricks(&self, grid: &SlabGrid, slab: i32) -> u8 {
        let brick = |x: f64, axis: usize| ((x as i32).clamp(0, grid.voxels[axis]) / BRICK) as usize;
        let (a0, a1) = (brick(self.low[0], 0), brick(self.high[0], 0));
        let (b0, b1) = (brick(self.low[1], 1), brick(self.high[1], 1));
        let base = (slab / BRICK) as usize * grid.brick_stride[2];
        let mut mask = 0;
        let mut b = b0;
        while b <= b1 {
            let mut a = a0;
            while a <= a1 {
                mask |= match grid.bricks.get(base + a * grid.brick_stride[0] + b * grid.brick_stride[1]) {
                    Some(bits) => *bits,
                    None => 0,
                };
                a += 1;
            }
            b += 1;
        }
        mask
    }
}

/// Indices of the four corners of cells (ia, ib).
#[inline(always)]
fn corners<S: Lanes, W: Window<S>>(s: S, ia: S::F, ib: S::F) -> [S::I; 4] {
    let first = s.index(s.fma(ib, s.splat(W::STRIDE as f32), ia));
    [first, s.offset(first, 1), s.offset(first, W::STRIDE), s.offset(first, W::STRIDE + 1)]
}

#[inline(always)]
fn fetch<S: Lanes, W: Window<S>>(s: S, grid: &SlabGrid, w: W, i: [S::I; 4]) -> [S::F; 4] {
    [w.fetch(s, grid, i[0]), w.fetch(s, grid, i[1]), w.fetch(s, grid, i[2]), w.fetch(s, grid, i[3])]
}

/// One material's share of four values.
#[inline(always)]
fn own<S: Lanes, const M: usize>(s: S, v: [S::F; 4], bits: u32, class: u32) -> [S::F; 4] {
    if M == 1 {
        return v;
    }
    [s.of_class(v[0], bits, class), s.of_class(v[1], bits, class), s.of_class(v[2], bits, class), s.of_class(v[3], bits, class)]
}

/// The slab's part [from, to], cell by cell.
#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "everything is in registers")]
fn cells<S: Lanes, W: Window<S>, const M: usize>(
    s: S,
    grid: &SlabGrid,
    k: &Slopes<S>,
    a: S::F,
    b: S::F,
    w0: W,
    w1: W,
    from: S::F,
    to: S::F,
    classes: &[u32; M],
    totals: &mut [S::F; M],
) {
    let (ia, ib) = (s.floor(a), s.floor(b));
    // Where the ray leaves the first cell across a and across b; the clamp takes care of slopes near 0.
    let ta = s.mul(s.sub(s.add(ia, k.ahead_a), a), k.inverse_a);
    let ta = s.min(s.max(ta, from), to);
    let tb = s.mul(s.sub(s.add(ib, k.ahead_b), b), k.inverse_b);
    let tb = s.min(s.max(tb, from), to);
    let a_first = s.less(ta, tb);
    let (t1, t2) = (s.min(ta, tb), s.max(ta, tb));
    let (ja, jb) = (s.add(ia, k.step_a), s.add(ib, k.step_b));
    let second = [s.select(a_first, ja, ia), s.select(a_first, ib, jb)];
    // One body for the three cells, left as soon as no ray has anything left.
    let (mut cell, mut begin, mut end) = ([ia, ib], from, t1);
    let mut n = 0;
    loop {
        piece::<S, W, M>(s, grid, k, a, b, w0, w1, cell, [begin, end], classes, totals);
        begin = end;
        n += 1;
        if n == 3 || !s.any(s.less(begin, to)) {
            break;
        }
        (cell, end) = if n == 1 { (second, t2) } else { ([ja, jb], to) };
    }
}

#[inline(always)]
#[expect(clippy::too_many_arguments, reason = "everything is in registers")]
fn piece<S: Lanes, W: Window<S>, const M: usize>(
    s: S,
    grid: &SlabGrid,
    k: &Slopes<S>,
    a: S::F,
    b: S::F,
    w0: W,
    w1: W,
    [ia, ib]: [S::F; 2],
    [from, to]: [S::F; 2],
    classes: &[u32; M],
    totals: &mut [S::F; M],
) {
    let half = s.splat(0.5);
    let length = s.sub(to, from);
    let (h, m) = (s.mul(half, length), s.mul(half, s.add(from, to)));
    let (fa, fb) = (s.sub(s.fma(k.a, m, a), ia), s.sub(s.fma(k.b, m, b), ib));
    let (ha, hb) = (s.mul(k.a, h), s.mul(k.b, h));
    let i = corners::<S, W>(s, ia, ib);
    let (lower, upper) = (fetch(s, grid, w0, i), fetch(s, grid, w1, i));
    let third = s.splat(1.0 / 3.0);
    let mut n = 0;
    while n < M {
        let v = own::<S, M>(s, lower, grid.class_bits, classes[n]);
        let u = own::<S, M>(s, upper, grid.class_bits, classes[n]);
        let d = [s.sub(u[0], v[0]), s.sub(u[1], v[1]), s.sub(u[2], v[2]), s.sub(u[3], v[3])];
        let e = [s.fma(m, d[0], v[0]), s.fma(m, d[1], v[1]), s.fma(m, d[2], v[2]), s.fma(m, d[3], v[3])];
        let (ea0, ea1) = (s.sub(e[1], e[0]), s.sub(e[3], e[2]));
        let p = s.fma(fa, ea0, e[0]);
        let q = s.fma(fa, ea1, e[2]);
        let value = s.fma(fb, s.sub(q, p), p);
        let f_ab = s.sub(ea1, ea0);
        let (da0, da1) = (s.sub(d[1], d[0]), s.sub(d[3], d[2]));
        let f_ac = s.fma(fb, s.sub(da1, da0), da0);
        let (db0, db1) = (s.sub(d[2], d[0]), s.sub(d[3], d[1]));
        let f_bc = s.fma(fa, s.sub(db1, db0), db0);
        let cross = s.fma(s.mul(f_ab, ha), hb, s.fma(s.mul(f_bc, hb), h, s.mul(s.mul(f_ac, ha), h)));
        totals[n] = s.fma(length, s.fma(third, cross, value), totals[n]);
        n += 1;
    }
}

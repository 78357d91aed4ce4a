//! Which kind of window holds the rays of a bundle, and where the windows of its slabs begin.

use super::edges::Edges;
use super::lanes::{LANES, Lanes};

/// The smallest kind of window that holds a bundle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fit {
    /// 8 × 4.
    Small,
    /// 16 × 4.
    Wide,
    /// 8 × 8.
    Square,
    /// 16 columns, and as many rows as [`fit`] is told.
    Broad,
    /// Any.
    Memory,
}

/// What holds values that spread over `spread` voxels along a and b in one slab (slope included), where broad windows have so many rows.
#[inline(always)]
#[must_use]
pub fn fit([a, b]: [f64; 2], broad_rows: i32) -> Fit {
    // n values hold positions that spread over n − 2: one more for the floor, one for the upper neighbour.
    if a <= 5.99 && b <= 1.99 {
        Fit::Small
    } else if a <= 13.99 && b <= 1.99 {
        Fit::Wide
    } else if a <= 5.99 && b <= 5.99 {
        Fit::Square
    } else if a <= 13.99 && b <= f64::from(broad_rows) - 2.01 {
        Fit::Broad
    } else {
        Fit::Memory
    }
}

/// Where windows begin, as a function of the slab: along a in the first eight lanes, along b in the others.
#[derive(Clone, Copy)]
pub struct Places<S: Lanes> {
    /// At c = 0, and how that changes with c.
    low: S::F,
    low_slope: S::F,
    /// The last columns and rows where they can.
    last: S::F,
}

const RAMP: [f32; LANES] = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];
const IS_B: [f32; LANES] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];

/// Voxels by which windows begin early: more than is rounded, less than [`fit`] leaves.
const MARGIN: f64 = 1e-3;

impl<S: Lanes> Places<S> {
    /// Of windows of size `window` around what `edges` hem in, in a grid of size `grid`.
    #[inline(always)]
    #[must_use]
    pub fn new(s: S, edges: &Edges, grid: &[i32; 3], window: [i32; 2]) -> Self {
        let mut low = [0.0f32; 2];
        let mut x = 0;
        while x < 2 {
            // The lowest position of a slab is at its beginning or at its end.
            let down = if edges.low_slope[x] < 0.0 { edges.low_slope[x] } else { 0.0 };
            low[x] = (edges.low[x] - edges.low_slope[x] * edges.c + down - MARGIN) as f32;
            x += 1;
        }
        Self {
            low: halves(s, low[0], low[1]),
            low_slope: halves(s, edges.low_slope[0] as f32, edges.low_slope[1] as f32),
            last: halves(s, (grid[0] - window[0]) as f32, (grid[1] - window[1]) as f32),
        }
    }

    /// In the eight slabs from `slab` on.
    #[inline(always)]
    #[must_use]
    pub fn from(&self, s: S, slab: i32) -> S::F {
        let c = s.add(s.load(&RAMP), s.splat(slab as f32));
        let start = s.floor(s.fma(self.low_slope, c, self.low));
        s.max(s.min(start, self.last), s.splat(0.0))
    }
}

/// `a` in the first eight lanes, `b` in the others.
#[inline(always)]
#[must_use]
pub fn halves<S: Lanes>(s: S, a: f32, b: f32) -> S::F {
    s.fma(s.load(&IS_B), s.splat(b - a), s.splat(a))
}

/// Two f32 whose sum is closer to each value than one can be.
#[inline(always)]
#[must_use]
pub fn in_two<S: Lanes>(s: S, values: &[f64; LANES]) -> [S::F; 2] {
    let (mut high, mut low) = ([0.0f32; LANES], [0.0f32; LANES]);
    let mut l = 0;
    while l < LANES {
        high[l] = values[l] as f32;
        low[l] = (values[l] - f64::from(high[l])) as f32;
        l += 1;
    }
    [s.load(&high), s.load(&low)]
}

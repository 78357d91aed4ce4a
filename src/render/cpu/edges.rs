//! What lies below a block of pixels: lines that hem its rays in, and the bricks between them, layer by layer.

use super::lanes::LANES;
use crate::render::cells;
use crate::render::slabs::{FILLING_SHIFT, MOST_MATERIALS, SlabGrid};

/// Slabs along the edge of a brick.
pub const BRICK: i32 = cells::BRICK as i32;

/// More layers of bricks than any volume that is laid out in slabs has.
const MOST_LAYERS: usize = 512;

/// Four rays that no ray of a block lies outside of, as functions of c.
#[derive(Clone, Copy, Debug, Default)]
pub struct Corners {
    /// Position along a and b at the bundle's `c_reference`.
    pub at: [[f64; 4]; 2],
    /// da/dc and db/dc.
    pub slope: [[f64; 4]; 2],
}

/// Lines below and above all rays of a block, along a and along b.
#[derive(Clone, Copy, Debug, Default)]
pub struct Edges {
    /// Where `low` and `high` hold.
    pub c: f64,
    /// Below all rays.
    pub low: [f64; 2],
    /// d low / dc.
    pub low_slope: [f64; 2],
    /// Above all rays.
    pub high: [f64; 2],
    /// d high / dc.
    pub high_slope: [f64; 2],
}

impl Edges {
    /// Chords between c₀ and c₁: the least of lines is concave and lies above its chord, the largest is convex.
    #[inline(always)]
    #[must_use]
    pub fn new(corners: &Corners, c_reference: f64, c0: f64, c1: f64) -> Self {
        let mut edges = Self { c: c0, ..Self::default() };
        let inverse = 1.0 / (c1 - c0);
        let mut x = 0;
        while x < 2 {
            let (mut near, mut far) = ([0.0; 4], [0.0; 4]);
            let mut i = 0;
            while i < 4 {
                near[i] = corners.at[x][i] + corners.slope[x][i] * (c0 - c_reference);
                far[i] = corners.at[x][i] + corners.slope[x][i] * (c1 - c_reference);
                i += 1;
            }
            edges.low[x] = min4(near);
            edges.high[x] = max4(near);
            edges.low_slope[x] = (min4(far) - edges.low[x]) * inverse;
            edges.high_slope[x] = (max4(far) - edges.high[x]) * inverse;
            x += 1;
        }
        edges
    }

    /// The most that the block covers along a and b in one slab, up to c₁.
    #[inline(always)]
    #[must_use]
    pub fn spread(&self, c1: f64) -> [f64; 2] {
        let mut spread = [0.0; 2];
        let mut x = 0;
        while x < 2 {
            let near = self.high[x] - self.low[x];
            let far = near + (self.high_slope[x] - self.low_slope[x]) * (c1 - self.c);
            spread[x] = larger(near, far) + larger(self.high_slope[x].abs(), self.low_slope[x].abs());
            x += 1;
        }
        spread
    }
}

/// Per layer of bricks across c, the bits of all bricks that a block of rays may meet there; a filling where all share it.
#[derive(Clone, Debug)]
pub struct Layers {
    bits: [u16; MOST_LAYERS],
}

impl Default for Layers {
    fn default() -> Self {
        Self { bits: [0; MOST_LAYERS] }
    }
}

impl Layers {
    /// The bits at slab `slab`.
    #[inline(always)]
    #[must_use]
    pub fn at(&self, slab: i32) -> u8 {
        self.bits[(slab / BRICK) as usize & (MOST_LAYERS - 1)] as u8
    }

    /// The number of the value that fills all bricks at slab `slab`; 0 where there is none.
    #[inline(always)]
    #[must_use]
    pub fn filling(&self, slab: i32) -> usize {
        usize::from(self.bits[(slab / BRICK) as usize & (MOST_LAYERS - 1)] >> FILLING_SHIFT)
    }

    /// Looks below the block that `corners` hem in.
    #[inline(always)]
    pub fn fill(&mut self, grid: &SlabGrid, corners: &Corners, c_reference: f64) {
        let slabs = grid.voxels[2] + 1;
        let edges = Edges::new(corners, c_reference, 0.0, f64::from(slabs));
        let mut here = [edges.low, edges.high];
        let mut layer = 0;
        while layer * BRICK < slabs {
            let c = f64::from((layer + 1) * BRICK);
            let mut next = [[0.0; 2]; 2];
            let mut range = [[0usize; 2]; 2];
            let mut x = 0;
            while x < 2 {
                next[0][x] = edges.low[x] + edges.low_slope[x] * c;
                next[1][x] = edges.high[x] + edges.high_slope[x] * c;
                let last = f64::from(grid.voxels[x]);
                range[x][0] = brick(-larger(-here[0][x], -next[0][x]), last);
                range[x][1] = brick(larger(here[1][x], next[1][x]), last);
                x += 1;
            }
            here = next;
            let base = layer as usize * grid.brick_stride[2];
            let (mut any, mut all) = (0, u16::MAX);
            let mut b = range[1][0];
            while b <= range[1][1] {
                let mut a = range[0][0];
                while a <= range[0][1] {
                    let bits = match grid.bricks.get(base + a * grid.brick_stride[0] + b * grid.brick_stride[1]) {
                        Some(bits) => *bits,
                        None => 0,
                    };
                    any |= bits;
                    all &= bits;
                    a += 1;
                }
                b += 1;
            }
            // The same number everywhere, or none.
            let shared = if any >> FILLING_SHIFT == all >> FILLING_SHIFT { any } else { any & ((1 << FILLING_SHIFT) - 1) };
            self.bits[layer as usize & (MOST_LAYERS - 1)] = shared;
            layer += 1;
        }
    }
}

/// The brick of a position, kept inside.
#[inline(always)]
fn brick(x: f64, last: f64) -> usize {
    let x = if x > 0.0 { x } else { 0.0 };
    let x = if x < last { x } else { last };
    (x as i32 / BRICK) as usize
}

#[inline(always)]
fn larger(x: f64, y: f64) -> f64 {
    if x > y { x } else { y }
}

#[inline(always)]
fn min4(v: [f64; 4]) -> f64 {
    -max4([-v[0], -v[1], -v[2], -v[3]])
}

#[inline(always)]
fn max4(v: [f64; 4]) -> f64 {
    larger(larger(v[0], v[1]), larger(v[2], v[3]))
}

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
    /// All rays lie between these.
    pub corners: Corners,
}

/// ∫ρ dc of sixteen rays, by material of the volume.
pub type BundleSums = [[f32; LANES]; MOST_MATERIALS];

/// Values of c that any lane, and that all lanes cross.
#[derive(Clone, Copy, Debug)]
pub struct Extent {
    /// Where the first lane begins.
    pub low: f64,
    /// Where the last lane ends.
    pub high: f64,
    /// From here on all lanes are under way …
    pub full_from: f64,
    /// … until here.
    pub full_to: f64,
}

impl Bundle {
    /// Length in c of each ray's part between two slices.
    #[inline(always)]
    #[must_use]
    pub fn length_between(&self, begin: i32, end: i32) -> [f32; LANES] {
        let (begin, end) = (f64::from(begin), f64::from(end));
        let mut length = [0.0f32; LANES];
        let mut l = 0;
        while l < LANES {
            let from = if self.from[l] > begin { self.from[l] } else { begin };
            let to = if self.to[l] < end { self.to[l] } else { end };
            length[l] = if to > from { (to - from) as f32 } else { 0.0 };
            l += 1;
        }
        length
    }

    /// `None` when no lane counts.
    #[inline(always)]
    #[must_use]
    pub fn extent(&self) -> Option<Extent> {
        // In quarters, so that four lanes are compared at once.
        const PART: usize = LANES / 4;
        let (mut lows, mut highs) = ([f64::INFINITY; PART], [f64::NEG_INFINITY; PART]);
        let (mut froms, mut tos) = ([f64::NEG_INFINITY; PART], [f64::INFINITY; PART]);
        let mut l = 0;
        while l < LANES {
            let mut i = 0;
            while i < PART {
                let (from, to) = (self.from[l + i], self.to[l + i]);
                let counts = to > from;
                lows[i] = if counts && from < lows[i] { from } else { lows[i] };
                highs[i] = if counts && to > highs[i] { to } else { highs[i] };
                froms[i] = if from > froms[i] { from } else { froms[i] };
                tos[i] = if to < tos[i] { to } else { tos[i] };
                i += 1;
            }
            l += PART;
        }
        let (low, high) = (min4(lows), max4(highs));
        let (full_from, full_to) = (max4(froms), min4(tos));
        if high > low { Some(Extent { low, high, full_from, full_to }) } else { None }
    }
}

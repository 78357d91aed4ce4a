//! Crossing a volume slab by slab, sixteen rays at a time: layers of bricks, groups of slabs, windows, rays.

use super::cells_of_slab::{Slopes, cells, slopes};
use super::edges::{BRICK, Bundle, BundleSums, Edges, Extent, Layers};
use super::lanes::{LANES, Lanes};
use super::window_places::{Fit, Places, fit, halves, in_two};
use super::windows::{BROAD_ROWS, Broad, Memory, Small, Square, Wide, Window};
use crate::render::slabs::{MATERIAL_BITS, MOST_MATERIALS, SlabGrid};

/// Adds ∫ρ dc per material to `sums`. Returns the bits of all bricks that were met.
#[inline(always)]
pub fn cross<S: Lanes>(s: S, grid: &SlabGrid, bundle: &Bundle, layers: &Layers, sums: &mut BundleSums) -> u8 {
    let Some(extent) = bundle.extent() else { return 0 };
    let (first, end) = (extent.low.floor(), extent.high.ceil());
    let edges = Edges::new(&bundle.corners, bundle.c_reference, first, end);
    let crossing = Crossing { grid, bundle, layers, extent, edges };
    if !S::TABLES {
        return crossing.run::<S, Memory>(s, sums);
    }
    match fit(edges.spread(end), BROAD_ROWS) {
        Fit::Small => crossing.run::<S, Small<S>>(s, sums),
        Fit::Wide => crossing.run::<S, Wide<S>>(s, sums),
        Fit::Square => crossing.run::<S, Square<S>>(s, sums),
        Fit::Broad => crossing.run::<S, Broad<S>>(s, sums),
        Fit::Memory => crossing.run::<S, Memory>(s, sums),
    }
}

struct Crossing<'c> {
    grid: &'c SlabGrid<'c>,
    bundle: &'c Bundle,
    layers: &'c Layers,
    extent: Extent,
    edges: Edges,
}

/// Up to eight slabs in one layer of bricks.
struct Group<S: Lanes> {
    slab: i32,
    end: i32,
    /// Positions at the first slab, from where its window begins.
    x: [S::F; 2],
    /// From there to where each window begins: eight slabs along a, eight along b.
    starts: [f32; LANES],
    /// Columns and rows where the windows begin.
    places: [i32; LANES],
}

/// What all groups of a bundle are made from.
struct Along<S: Lanes> {
    places: Places<S>,
    /// Rays along a and b at the bundle's `c_reference`, in two parts.
    at: [[S::F; 2]; 2],
    slope: [[S::F; 2]; 2],
}

impl Crossing<'_> {
    #[inline(always)]
    fn run<S: Lanes, W: Window<S>>(&self, s: S, sums: &mut BundleSums) -> u8 {
        let k = slopes(s, self.bundle, W::STRIDE);
        let along = self.along::<S, W>(s);
        let mut met = 0;
        let end = (self.extent.high.ceil() as i32).min(self.grid.voxels[2] + 1);
        let mut slab = (self.extent.low.floor() as i32).max(0);
        while slab < end {
            let group_end = ((slab / BRICK + 1) * BRICK).min(end);
            let bits = self.layers.at(slab);
            met |= bits;
            let present = bits & MATERIAL_BITS;
            if present == 0 {
                slab = group_end;
                continue;
            }
            let filling = self.layers.filling(slab);
            if filling != 0 {
                let path = self.filled(s, slab, group_end, filling);
                add(s, sums, present.trailing_zeros(), path);
                slab = group_end;
                continue;
            }
            let group = self.group::<S, W>(s, &along, slab, group_end);
            let mut left = present;
            while left != 0 {
                let first = left.trailing_zeros();
                left &= left - 1;
                if present & (present - 1) == 0 {
                    // All that is near is one material, or nothing.
                    let [found] = self.slabs::<S, W, 1>(s, &k, &group, [first + 1]);
                    add(s, sums, first, found);
                } else {
                    let second = if left == 0 { first } else { left.trailing_zeros() };
                    let [found, other] = self.slabs::<S, W, 2>(s, &k, &group, [first + 1, second + 1]);
                    add(s, sums, first, found);
                    if left != 0 {
                        add(s, sums, second, other);
                        left &= left - 1;
                    }
                }
            }
            slab = group_end;
        }
        met
    }

    /// ∫ρ dc from slab to slab where all is filled with the same.
    #[inline(always)]
    fn filled<S: Lanes>(&self, s: S, slab: i32, end: i32, filling: usize) -> S::F {
        s.mul(s.splat(self.grid.filling(filling)), s.load(&self.bundle.length_between(slab, end)))
    }

    #[inline(always)]
    fn along<S: Lanes, W: Window<S>>(&self, s: S) -> Along<S> {
        Along {
            places: Places::new(s, &self.edges, &self.grid.size, W::SIZE),
            at: [in_two(s, &self.bundle.at[0]), in_two(s, &self.bundle.at[1])],
            slope: [in_two(s, &self.bundle.slope[0]), in_two(s, &self.bundle.slope[1])],
        }
    }

    #[inline(always)]
    fn group<S: Lanes, W: Window<S>>(&self, s: S, along: &Along<S>, slab: i32, end: i32) -> Group<S> {
        let zero = s.splat(0.0);
        let start = along.places.from(s, slab);
        let starts = s.store(start);
        let origin = [starts[0], starts[8]];
        // A multiple of ½.
        let on = s.splat((f64::from(slab) - self.bundle.c_reference) as f32);
        let mut group = Group { slab, end, x: [zero; 2], starts: [0.0; LANES], places: s.indices(s.index(start)) };
        let mut x = 0;
        while x < 2 {
            let (at, slope) = (&along.at[x], &along.slope[x]);
            let rest = s.fma(slope[1], on, at[1]);
            group.x[x] = s.add(s.fma(slope[0], on, s.sub(at[0], s.splat(origin[x]))), rest);
            x += 1;
        }
        // Without a window all counts from 0.
        let from = if W::SIZE[0] > 0 { start } else { zero };
        group.starts = s.store(s.sub(from, halves(s, origin[0], origin[1])));
        group
    }

    /// ∫ρ dc of `N` classes over a group.
    #[inline(always)]
    fn slabs<S: Lanes, W: Window<S>, const N: usize>(
        &self,
        s: S,
        k: &Slopes<S>,
        group: &Group<S>,
        classes: [u32; N],
    ) -> [S::F; N] {
        let mut totals = [s.splat(0.0); N];
        let [mut xa, mut xb] = group.x;
        let mut slab = group.slab;
        let mut j = 0;
        while slab < group.end {
            // Of eight, always: the masks only say so to the compiler.
            let (ja, jb) = (j & 7, j & 7 | 8);
            let (pa, pb) = (group.places[ja], group.places[jb]);
            let windows = [W::open(s, self.grid, pa, pb, slab), W::open(s, self.grid, pa, pb, slab + 1)];
            let at = [s.sub(xa, s.splat(group.starts[ja])), s.sub(xb, s.splat(group.starts[jb]))];
            cells::<S, W, N>(s, self.grid, k, at, windows, self.part(s, slab), classes, &mut totals);
            (xa, xb) = (s.add(xa, k.a), s.add(xb, k.b));
            slab += 1;
            j += 1;
        }
        totals
    }

    /// Where in a slab each ray begins and ends, from 0 to 1.
    #[inline(always)]
    fn part<S: Lanes>(&self, s: S, slab: i32) -> [S::F; 2] {
        let (begin, end) = (f64::from(slab), f64::from(slab + 1));
        if begin >= self.extent.full_from && end <= self.extent.full_to {
            return [s.splat(0.0), s.splat(1.0)];
        }
        let (mut from, mut to) = ([0.0f32; LANES], [0.0f32; LANES]);
        let mut l = 0;
        while l < LANES {
            from[l] = (self.bundle.from[l] - begin).clamp(0.0, 1.0) as f32;
            to[l] = (self.bundle.to[l] - begin).clamp(0.0, 1.0) as f32;
            to[l] = if to[l] > from[l] { to[l] } else { from[l] };
            l += 1;
        }
        [s.load(&from), s.load(&to)]
    }
}

#[inline(always)]
fn add<S: Lanes>(s: S, sums: &mut BundleSums, material: u32, found: S::F) {
    let sum = &mut sums[material as usize & (MOST_MATERIALS - 1)];
    *sum = s.store(s.add(s.load(sum), found));
}

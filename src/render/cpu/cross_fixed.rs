//! Crossing a volume slab by slab, thirty-two rays at a time, in 16-bit fixed point.

use super::edges::{BRICK, Bundle, BundleSums, Corners, Edges, Extent, Layers};
use super::fixed_cells::{Course, LAST, ONE, Place, Slab, Sums};
use super::fixed_lanes::FixedLanes;
use super::fixed_windows::{BROAD_ROWS, Broad, FixedWindow, Memory, Small, Square, Wide};
use super::lanes::LANES;
use super::window_places::{Fit, Places, fit, in_two};
use crate::render::slabs::{MATERIAL_BITS, MOST_MATERIALS, SlabGrid};

/// Adds ∫ρ dc per material of two bundles that `corners` hem in. Returns the bits of all bricks that were met.
#[inline(always)]
pub fn cross_fixed<S: FixedLanes>(
    s: S,
    grid: &SlabGrid,
    bundles: [&Bundle; 2],
    corners: &Corners,
    layers: &Layers,
    sums: [&mut BundleSums; 2],
) -> u8 {
    let extent = match (bundles[0].extent(), bundles[1].extent()) {
        (None, None) => return 0,
        (Some(extent), None) | (None, Some(extent)) => Extent { full_from: f64::INFINITY, ..extent },
        (Some(x), Some(y)) => Extent {
            low: x.low.min(y.low),
            high: x.high.max(y.high),
            full_from: x.full_from.max(y.full_from),
            full_to: x.full_to.min(y.full_to),
        },
    };
    let (first, end) = (extent.low.floor(), extent.high.ceil());
    let edges = Edges::new(corners, bundles[0].c_reference, first, end);
    let fit = fit(edges.spread(end), BROAD_ROWS);
    let full = [extent.full_from.ceil() as i32, extent.full_to.floor() as i32];
    let mut crossing = Crossing { grid, bundles, layers, extent, edges, sums, full };
    if !S::TABLES {
        return crossing.run::<S, Memory>(s);
    }
    match fit {
        Fit::Small => crossing.run::<S, Small<S>>(s),
        Fit::Wide => crossing.run::<S, Wide<S>>(s),
        Fit::Square => crossing.run::<S, Square<S>>(s),
        Fit::Broad => crossing.run::<S, Broad<S>>(s),
        Fit::Memory => crossing.run::<S, Memory>(s),
    }
}

struct Crossing<'c> {
    grid: &'c SlabGrid<'c>,
    bundles: [&'c Bundle; 2],
    layers: &'c Layers,
    extent: Extent,
    edges: Edges,
    sums: [&'c mut BundleSums; 2],
    /// First and end of the slabs that all rays cross from slice to slice.
    full: [i32; 2],
}

/// Up to eight slabs in one layer of bricks.
struct Group<S: FixedLanes> {
    slab: i32,
    end: i32,
    place: Place<S>,
    /// Columns and rows where the windows begin: eight slabs along a, eight along b.
    places: [i32; LANES],
}

/// One bundle's positions.
struct Half<S: FixedLanes> {
    /// Rays along a and b at `c_reference`, along their own direction, in two parts.
    at: [[S::F; 2]; 2],
    slope: [[S::F; 2]; 2],
    /// −1 where they run backwards.
    sign: [S::F; 2],
}

/// What all groups of two bundles are made from.
struct Along<S: FixedLanes> {
    places: Places<S>,
    halves: [Half<S>; 2],
    /// First and last c of each ray.
    ends: [[S::F; 2]; 2],
}

impl Crossing<'_> {
    #[inline(always)]
    fn run<S: FixedLanes, W: FixedWindow<S>>(&mut self, s: S) -> u8 {
        let k = self.course::<S, W>(s);
        let along = self.along::<S, W>(s);
        let mut met = 0;
        let end = (self.extent.high.ceil() as i32).min(self.grid.voxels[2] + 1);
        let mut slab = (self.extent.low.floor() as i32).max(0);
        while slab < end {
            let group_end = ((slab / BRICK + 1) * BRICK).min(end);
            let bits = self.layers.at(slab);
            met |= bits;
            let mut left = bits & MATERIAL_BITS;
            if left == 0 {
                slab = group_end;
                continue;
            }
            let filling = self.layers.filling(slab);
            if filling != 0 {
                self.filled(s, slab, group_end, filling, left.trailing_zeros() as usize);
                slab = group_end;
                continue;
            }
            let group = self.group::<S, W>(s, &along, slab, group_end);
            while left != 0 {
                let material = left.trailing_zeros() as usize & (MOST_MATERIALS - 1);
                left &= left - 1;
                self.slabs::<S, W>(s, &k, &along, &group, material);
            }
            slab = group_end;
        }
        met
    }

    #[inline(always)]
    fn filled<S: FixedLanes>(&mut self, s: S, slab: i32, end: i32, filling: usize, material: usize) {
        let density = s.splat(self.grid.filling(filling));
        let mut half = 0;
        while half < 2 {
            let length = self.bundles[half].length_between(slab, end);
            let sum = &mut self.sums[half][material & (MOST_MATERIALS - 1)];
            *sum = s.store(s.fma(density, s.load(&length), s.load(sum)));
            half += 1;
        }
    }

    #[inline(always)]
    fn course<S: FixedLanes, W: FixedWindow<S>>(&self, s: S) -> Course<S> {
        let none = s.word(0);
        let mut course = Course { slope: [none; 2], half: [none; 2], inverse: [none; 2], shift: [none; 2], step: [none; 2] };
        let (zero, tiny) = (s.splat(0.0), s.splat(1e-9));
        let mut x = 0;
        while x < 2 {
            let stride = if x == 0 { 1 } else { W::STRIDE };
            let none = s.same_index(0);
            let (mut slope, mut inverse, mut shift, mut step) = ([none; 2], [none; 2], [none; 2], [none; 2]);
            let mut half = 0;
            while half < 2 {
                let [rate, _] = in_two(s, &self.bundles[half].slope[x]);
                let size = rounded_slope(s, rate);
                // size = m 2^−e with 1 ≤ m < 2; of 0 nothing is ever used.
                let [mantissa, exponent] = s.parts(s.max(s.mul(size, s.splat(1.0 / 65536.0)), tiny));
                slope[half] = s.index(size);
                inverse[half] = s.index(s.div(s.splat(f32::from(LAST)), mantissa));
                shift[half] = s.index(s.min(s.sub(zero, exponent), s.splat(15.0)));
                step[half] = s.select_index(s.less(rate, zero), s.same_index(-stride), s.same_index(stride));
                half += 1;
            }
            course.slope[x] = s.interleave(slope[0], slope[1]);
            course.half[x] = s.w_half(course.slope[x]);
            course.inverse[x] = s.interleave(inverse[0], inverse[1]);
            course.shift[x] = s.interleave(shift[0], shift[1]);
            course.step[x] = s.interleave(step[0], step[1]);
            x += 1;
        }
        course
    }

    #[inline(always)]
    fn along<S: FixedLanes, W: FixedWindow<S>>(&self, s: S) -> Along<S> {
        Along {
            places: Places::new(s, &self.edges, &self.grid.size, W::SIZE),
            halves: [half(s, self.bundles[0]), half(s, self.bundles[1])],
            ends: [ends(s, self.bundles[0]), ends(s, self.bundles[1])],
        }
    }

    #[inline(always)]
    fn group<S: FixedLanes, W: FixedWindow<S>>(&self, s: S, along: &Along<S>, slab: i32, end: i32) -> Group<S> {
        let zero = s.splat(0.0);
        let start = along.places.from(s, slab);
        let starts = s.store(start);
        let on = s.splat((f64::from(slab) - self.bundles[0].c_reference) as f32);
        let mut at = [[s.same_index(0); 2]; 2];
        let mut node = [s.same_index(0); 2];
        let mut h = 0;
        while h < 2 {
            let half = &along.halves[h];
            let mut index = zero;
            let mut x = 0;
            while x < 2 {
                let rest = s.fma(half.slope[x][1], on, half.at[x][1]);
                let origin = s.mul(s.splat(starts[8 * x]), half.sign[x]);
                let y = s.add(s.fma(half.slope[x][0], on, s.sub(half.at[x][0], origin)), rest);
                let whole = s.floor(y);
                let fraction = s.fma(s.sub(y, whole), s.splat(65536.0), s.splat(0.5));
                at[x][h] = s.index(s.min(fraction, s.splat(65535.0)));
                let stride = s.splat(if x == 0 { 1.0 } else { W::STRIDE as f32 });
                index = s.fma(s.mul(whole, half.sign[x]), stride, index);
                x += 1;
            }
            node[h] = s.index(index);
            h += 1;
        }
        let place = Place {
            at: [s.interleave(at[0][0], at[0][1]), s.interleave(at[1][0], at[1][1])],
            node: s.interleave(node[0], node[1]),
            open: s.word(0),
        };
        Group { slab, end, place, places: s.indices(s.index(start)) }
    }

    /// Adds one material's share of a group.
    #[inline(always)]
    fn slabs<S: FixedLanes, W: FixedWindow<S>>(
        &mut self,
        s: S,
        k: &Course<S>,
        along: &Along<S>,
        group: &Group<S>,
        material: usize,
    ) {
        let none = s.same_index(0);
        let mut sums = Sums { ends: [none; 2], middles: [none; 2] };
        let mut place = group.place;
        let words = self.grid.words[material];
        let mut slab = group.slab;
        let mut j = 0;
        while slab < group.end {
            let (ja, jb) = (j & 7, j & 7 | 8);
            let (pa, pb) = (group.places[ja], group.places[jb]);
            let [lower, upper] = W::open(s, words, pa, pb, slab);
            let here = Slab { words, lower, upper, s };
            if slab >= self.full[0] && slab < self.full[1] {
                here.whole(k, &mut place, &mut sums);
            } else {
                here.part(k, &mut place, &mut sums, self.part(s, along, slab));
            }
            slab += 1;
            j += 1;
            if slab < group.end {
                let on = (group.places[j & 7] - pa) + (group.places[j & 7 | 8] - pb) * W::STRIDE;
                place.node = s.w_sub(place.node, s.word(on as u16));
            } else {
                here.close(upper, k, &mut place, &mut sums);
            }
        }
        // The weights of a slab add up to `ONE` / 32768.
        let scale = s.splat(self.grid.word_g_per_cm3[material] * (32768.0 / (3.0 * f32::from(ONE))));
        let mut half = 0;
        while half < 2 {
            let twice = s.add_index(sums.middles[half], sums.middles[half]);
            let sum = &mut self.sums[half][material];
            *sum = s.store(s.fma(s.number(s.add_index(sums.ends[half], twice)), scale, s.load(sum)));
            half += 1;
        }
    }

    /// Where in a slab each ray begins and ends, in 1/32768.
    #[inline(always)]
    fn part<S: FixedLanes>(&self, s: S, along: &Along<S>, slab: i32) -> [S::W; 2] {
        let (begin, zero, one) = (s.splat(slab as f32), s.splat(0.0), s.splat(1.0));
        let mut ends = [[s.same_index(0); 2]; 2];
        let mut half = 0;
        while half < 2 {
            let mut e = 0;
            while e < 2 {
                let at = s.max(s.min(s.sub(along.ends[half][e], begin), one), zero);
                ends[e][half] = s.index(s.fma(at, s.splat(f32::from(ONE)), s.splat(0.5)));
                e += 1;
            }
            half += 1;
        }
        [s.interleave(ends[0][0], ends[0][1]), s.interleave(ends[1][0], ends[1][1])]
    }
}

/// |slope| in 1/65536, below 1.
#[inline(always)]
fn rounded_slope<S: FixedLanes>(s: S, slope: S::F) -> S::F {
    let size = s.max(slope, s.sub(s.splat(0.0), slope));
    s.min(s.floor(s.fma(size, s.splat(65536.0), s.splat(0.5))), s.splat(65535.0))
}

/// First and last c.
#[inline(always)]
fn ends<S: FixedLanes>(s: S, bundle: &Bundle) -> [S::F; 2] {
    [in_two(s, &bundle.from)[0], in_two(s, &bundle.to)[0]]
}

#[inline(always)]
fn half<S: FixedLanes>(s: S, bundle: &Bundle) -> Half<S> {
    let zero = s.splat(0.0);
    let mut half = Half { at: [[zero; 2]; 2], slope: [[zero; 2]; 2], sign: [zero; 2] };
    let mut x = 0;
    while x < 2 {
        let (at, slope) = (in_two(s, &bundle.at[x]), in_two(s, &bundle.slope[x]));
        let back = s.less(slope[0], zero);
        let sign = s.select(back, s.splat(-1.0), s.splat(1.0));
        half.sign[x] = sign;
        half.slope[x] = [s.mul(slope[0], sign), s.mul(slope[1], sign)];
        // What eight slabs of the rounded slope gain, halved, so that it is off by as much at either end.
        let rounded = s.mul(rounded_slope(s, slope[0]), s.splat(1.0 / 65536.0));
        let gain = s.mul(s.sub(rounded, half.slope[x][0]), s.splat(4.0));
        half.at[x] = [s.mul(at[0], sign), s.sub(s.mul(at[1], sign), gain)];
        x += 1;
    }
    half
}

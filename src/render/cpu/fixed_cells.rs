//! The cells that thirty-two rays meet between two slices of voxels, in 16-bit fixed point.
//!
//! Pieces and nodes are those of `cells_of_slab`; in each piece the trilinear field is a cubic polynomial, whose mean is
//! (f(begin) + 4 f(middle) + f(end)) / 6. Two pieces share the value on the face between them, two slabs the value on the slice.
//!
//! Positions are in 1/65536 of a voxel along each ray's own direction, so that a carry is a face; in a piece they are, like times and
//! weights, in 1/32768. A time of 1 is [`ONE`], so that the weights of a slab add up to exactly that.

use super::fixed_lanes::FixedLanes;
use super::fixed_windows::FixedWindow;
use crate::render::words::Words;

/// A whole slab.
pub const ONE: u16 = 32767;

/// The latest time of a face, so that it is told from none.
pub const LAST: u16 = ONE - 1;

/// 1/√3 in 1/32768: nodes of Gauss's rule.
const GAUSS: u16 = 18919;

/// What stays the same along thirty-two rays; a and b.
#[derive(Clone, Copy)]
pub struct Course<S: FixedLanes> {
    /// Voxels a slab, in 1/65536.
    pub slope: [S::W; 2],
    /// … in 1/32768.
    pub half: [S::W; 2],
    /// The slope's inverse, see [`Course::shift`].
    pub inverse: [S::W; 2],
    /// (32768 − position) · inverse / 32768 · 2^shift is the time of the face ahead.
    pub shift: [S::W; 2],
    /// Index step from node to node along the ray.
    pub step: [S::W; 2],
}

/// Where thirty-two rays are.
#[derive(Clone, Copy)]
pub struct Place<S: FixedLanes> {
    /// Along a and b from the last node on, in 1/65536.
    pub at: [S::W; 2],
    /// Index of that node.
    pub node: S::W,
    /// Length of the last piece, whose end has not been weighed yet.
    pub open: S::W,
}

/// (`ends` + 2 `middles`) / 3 is the sum of all slabs' means, in words · [`ONE`] / 32768.
#[derive(Clone, Copy)]
pub struct Sums<S: FixedLanes> {
    /// Half the values at begins and ends, weighed with the lengths beside them.
    pub ends: [S::I; 2],
    /// Values in the middle, weighed with their lengths.
    pub middles: [S::I; 2],
}

/// Two slices, opened.
#[derive(Clone, Copy)]
pub struct Slab<'g, S: FixedLanes, W: FixedWindow<S>> {
    /// The material.
    pub words: Words<'g>,
    /// The lower slice.
    pub lower: W,
    /// The upper one.
    pub upper: W,
    /// Lanes.
    pub s: S,
}

/// What a slab holds for each ray; of a and b, p is the one whose face it meets first.
struct Ahead<S: FixedLanes> {
    /// Along a and b on the upper slice, from the last node there on.
    next: [S::W; 2],
    /// Whether a face across a, across b lies between.
    over: [S::K; 2],
    /// When the first face is met, and the second.
    times: [S::W; 2],
    /// p and q on the lower slice.
    at: [S::W; 2],
    /// dp/dc and dq/dc.
    slope: [S::W; 2],
    /// Index steps along p and q.
    step: [S::W; 2],
}

impl<S: FixedLanes> Ahead<S> {
    #[inline(always)]
    fn new(s: S, k: &Course<S>, [a, b]: [S::W; 2]) -> Self {
        let next = [s.w_add(a, k.slope[0]), s.w_add(b, k.slope[1])];
        let over = [s.w_below(next[0], a), s.w_below(next[1], b)];
        let (a, b) = (s.w_half(a), s.w_half(b));
        let (ta, tb) = (time(s, k, 0, a, over[0]), time(s, k, 1, b, over[1]));
        let a_first = s.w_below(ta, tb);
        Self {
            next,
            over,
            times: [s.w_min(ta, tb), s.w_max(ta, tb)],
            at: [s.w_choose(a_first, a, b), s.w_choose(a_first, b, a)],
            slope: [s.w_choose(a_first, k.half[0], k.half[1]), s.w_choose(a_first, k.half[1], k.half[0])],
            step: [s.w_choose(a_first, k.step[0], k.step[1]), s.w_choose(a_first, k.step[1], k.step[0])],
        }
    }

    /// The last node on the upper slice.
    #[inline(always)]
    fn node(&self, s: S, k: &Course<S>, node: S::W) -> S::W {
        let node = s.w_add(node, s.w_keep(self.over[0], k.step[0]));
        s.w_add(node, s.w_keep(self.over[1], k.step[1]))
    }
}

/// The nodes of a cell: words on its lower side, and what is to be added for its upper side.
struct Cell<S: FixedLanes> {
    low: [S::W; 4],
    rise: [S::W; 4],
}

/// a + (b − a) w.
#[inline(always)]
fn mix<S: FixedLanes>(s: S, a: S::W, b: S::W, w: S::W) -> S::W {
    s.w_add(a, s.w_scale(s.w_sub(b, a), w))
}

/// Halfway between two words below 2¹⁵.
#[inline(always)]
fn mean<S: FixedLanes>(s: S, a: S::W, b: S::W) -> S::W {
    s.w_half(s.w_add(a, b))
}

impl<S: FixedLanes> Cell<S> {
    /// The field at (p, q) and time t.
    #[inline(always)]
    fn value(&self, s: S, [p, q]: [S::W; 2], t: S::W) -> S::W {
        let [l, r] = [&self.low, &self.rise];
        let v0 = s.w_add(l[0], s.w_scale(r[0], t));
        let v1 = s.w_add(l[1], s.w_scale(r[1], t));
        let v2 = s.w_add(l[2], s.w_scale(r[2], t));
        let v3 = s.w_add(l[3], s.w_scale(r[3], t));
        mix(s, mix(s, v0, v1, p), mix(s, v2, v3, p), q)
    }
}

impl<S: FixedLanes, W: FixedWindow<S>> Slab<'_, S, W> {
    #[inline(always)]
    fn both(&self, i: S::W) -> (S::W, S::W) {
        let low = self.lower.fetch(self.s, self.words, i);
        (low, self.s.w_sub(self.upper.fetch(self.s, self.words, i), low))
    }

    /// From slice to slice.
    #[inline(always)]
    pub fn whole(&self, k: &Course<S>, place: &mut Place<S>, sums: &mut Sums<S>) {
        let s = self.s;
        let one = s.word(ONE);
        let ahead = Ahead::new(s, k, place.at);
        let ([p0, q0], [sp, sq], [step_p, step_q], [t1, t2]) = (ahead.at, ahead.slope, ahead.step, ahead.times);
        let (once, twice) = (s.k_or(ahead.over[0], ahead.over[1]), s.k_and(ahead.over[0], ahead.over[1]));

        let i00 = place.node;
        let (i10, i01) = (s.w_add(i00, step_p), s.w_add(i00, step_q));
        let i11 = s.w_add(i10, step_q);
        let ((v00, d00), (v10, d10), (v01, d01), (v11, d11)) = (self.both(i00), self.both(i10), self.both(i01), self.both(i11));
        let first = Cell::<S> { low: [v00, v10, v01, v11], rise: [d00, d10, d01, d11] };
        let begin = mix(s, mix(s, v00, v10, p0), mix(s, v01, v11, p0), q0);
        let p1 = s.w_min(s.w_add(p0, sp), one);
        let q1 = s.w_min(s.w_add(q0, s.w_scale(sq, t1)), one);
        let middle = first.value(s, [mean(s, p0, p1), mean(s, q0, q1)], s.w_half(t1));
        let mut ends = s.w_scale(begin, mean(s, place.open, t1));
        let mut middles = s.w_scale(middle, t1);
        place.at = ahead.next;
        place.open = one;
        if s.k_any(once) {
            let (rest, length) = (s.w_sub(one, t1), s.w_sub(t2, t1));
            let (i20, i21) = (s.w_add(i10, step_p), s.w_add(i11, step_p));
            let ((v20, d20), (v21, d21)) = (self.both(i20), self.both(i21));
            let second = Cell::<S> { low: [v10, v20, v11, v21], rise: [d10, d20, d11, d21] };
            let (e10, e11) = (s.w_add(v10, s.w_scale(d10, t1)), s.w_add(v11, s.w_scale(d11, t1)));
            let face = mix(s, e10, e11, q1);
            let p2 = s.w_scale(sp, length);
            let q2 = s.w_min(s.w_add(q0, sq), one);
            let middle = second.value(s, [s.w_half(p2), mean(s, q1, q2)], mean(s, t1, t2));
            ends = s.w_add(ends, s.w_scale(face, s.w_keep(once, s.w_half(t2))));
            middles = s.w_add(middles, s.w_scale(middle, length));

            let length = s.w_sub(one, t2);
            let (i12, i22) = (s.w_add(i11, step_q), s.w_add(i21, step_q));
            let ((v12, d12), (v22, d22)) = (self.both(i12), self.both(i22));
            let third = Cell::<S> { low: [v11, v21, v12, v22], rise: [d11, d21, d12, d22] };
            let (e11, e21) = (s.w_add(v11, s.w_scale(d11, t2)), s.w_add(v21, s.w_scale(d21, t2)));
            let face = mix(s, e11, e21, p2);
            let (p3, q3) = (s.w_scale(sp, rest), s.w_scale(sq, length));
            let middle = third.value(s, [mean(s, p2, p3), s.w_half(q3)], mean(s, t2, one));
            ends = s.w_add(ends, s.w_scale(face, s.w_keep(twice, s.w_half(rest))));
            middles = s.w_add(middles, s.w_scale(middle, length));
            place.open = s.w_sub(one, s.w_choose(twice, t2, s.w_keep(once, t1)));
            place.node = ahead.node(s, k, i00);
        }
        sums.ends = s.gather_sums(sums.ends, ends);
        sums.middles = s.gather_sums(sums.middles, middles);
    }

    /// Between the times `from` and `to`.
    #[inline(always)]
    pub fn part(&self, k: &Course<S>, place: &mut Place<S>, sums: &mut Sums<S>, [from, to]: [S::W; 2]) {
        let s = self.s;
        let one = s.word(ONE);
        let ahead = Ahead::new(s, k, place.at);
        let ([p0, q0], [sp, sq], [step_p, step_q], [t1, t2]) = (ahead.at, ahead.slope, ahead.step, ahead.times);
        self.close(self.lower, k, place, sums);

        let i00 = place.node;
        let (i10, i01) = (s.w_add(i00, step_p), s.w_add(i00, step_q));
        let i11 = s.w_add(i10, step_q);
        let (i20, i21) = (s.w_add(i10, step_p), s.w_add(i11, step_p));
        let (i12, i22) = (s.w_add(i11, step_q), s.w_add(i21, step_q));
        let cells = [[i00, i10, i01, i11], [i10, i20, i11, i21], [i11, i21, i12, i22]];
        let (c1, c2) = (s.w_min(s.w_max(t1, from), to), s.w_min(s.w_max(t2, from), to));
        let times = [[from, c1], [c1, c2], [c2, to]];
        let mut total = s.word(0);
        let mut n = 0;
        while n < 3 {
            let [begin, end] = times[n];
            let length = s.w_less(end, begin);
            let away = s.w_scale(s.w_half(length), s.word(GAUSS));
            let middle = mean(s, begin, end);
            let nodes = cells[n];
            let (f0, f1, f2, f3) = (self.both(nodes[0]), self.both(nodes[1]), self.both(nodes[2]), self.both(nodes[3]));
            let cell = Cell::<S> { low: [f0.0, f1.0, f2.0, f3.0], rise: [f0.1, f1.1, f2.1, f3.1] };
            let early = s.w_less(middle, away);
            let late = s.w_min(s.w_add(middle, away), one);
            let mut values = [early, late];
            let mut g = 0;
            while g < 2 {
                let t = values[g];
                let p = if n == 0 { s.w_add(p0, s.w_scale(sp, t)) } else { s.w_scale(sp, s.w_less(t, t1)) };
                let q = if n == 2 { s.w_scale(sq, s.w_less(t, t2)) } else { s.w_add(q0, s.w_scale(sq, t)) };
                values[g] = cell.value(s, [s.w_min(p, one), s.w_min(q, one)], t);
                g += 1;
            }
            total = s.w_add(total, s.w_scale(mean(s, values[0], values[1]), length));
            n += 1;
        }
        // All of it counts once.
        sums.ends = s.gather_sums(sums.ends, total);
        sums.middles = s.gather_sums(sums.middles, total);
        place.at = ahead.next;
        place.node = ahead.node(s, k, i00);
    }

    /// Weighs the end of the last piece, which lies on `slice`.
    #[inline(always)]
    pub fn close(&self, slice: W, k: &Course<S>, place: &mut Place<S>, sums: &mut Sums<S>) {
        let s = self.s;
        let (i0, i1) = (place.node, s.w_add(place.node, k.step[0]));
        let (v0, v1) = (slice.fetch(s, self.words, i0), slice.fetch(s, self.words, i1));
        let (i2, i3) = (s.w_add(i0, k.step[1]), s.w_add(i1, k.step[1]));
        let (v2, v3) = (slice.fetch(s, self.words, i2), slice.fetch(s, self.words, i3));
        let [a, b] = [s.w_half(place.at[0]), s.w_half(place.at[1])];
        let end = mix(s, mix(s, v0, v1, a), mix(s, v2, v3, a), b);
        sums.ends = s.gather_sums(sums.ends, s.w_scale(end, s.w_half(place.open)));
        place.open = s.word(0);
    }
}

/// When a ray meets the face ahead across axis `x`; [`ONE`] where it does not in this slab.
#[inline(always)]
fn time<S: FixedLanes>(s: S, k: &Course<S>, x: usize, half: S::W, over: S::K) -> S::W {
    let rest = s.w_sub(s.word(ONE), half);
    let t = s.w_min(s.w_shift(s.w_scale(rest, k.inverse[x]), k.shift[x]), s.word(LAST));
    s.w_choose(over, t, s.word(ONE))
}

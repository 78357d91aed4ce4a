//! Rows and columns that do not answer, or answer otherwise than those beside them, along much of their length.

use rayon::prelude::*;

use crate::image::{Image, quantile};

/// A line is looked at in so many parts, and is one where so many say the same.
const PARTS: usize = 12;
const FEWEST_PARTS: usize = 4;
/// Between and beside these no stretch has room that is long enough, see `runs`.
const LOOKED_AT_FIRST: [usize; 5] = [2, 3, 6, 7, 8];
/// Pixels of a part that are looked at, about, and at least.
const LOOKS: usize = 32;
const FEWEST_LOOKS: usize = 12;
/// Lines beside each other, at most.
const WIDEST: usize = 2;
/// Lines so far beside one tell what it should be.
const BESIDE: usize = 3;
/// It differs from these by so many standard deviations of a pixel.
const LEAST_SIGMAS: f64 = 2.0;
/// The next lines differ by no more than this share of that, or than so many standard deviations of their median: a sharp wire's do.
const LEFT_BESIDE: f64 = 0.15;
const SIGMAS_BESIDE: f64 = 5.0;
/// σ of a median over that of a mean, and of a difference from the mean of two over that of one.
const OF_MEDIAN: f64 = 1.25 * 1.22;

/// The frame seen along its columns, or along its rows.
struct Lines<'a> {
    pixels: &'a [f32],
    usable: &'a [bool],
    /// How many there are, and how long they are.
    count: usize,
    length: usize,
    /// From one to the next, and from a pixel to the next.
    strides: [usize; 2],
    floor: f64,
}

/// Pixels of `pixels` on lines that differ from those beside them, by more than `floor`. Lines at the very border are not looked at.
pub(super) fn dead_lines(pixels: &Image<f32>, usable: &Image<bool>, floor: f64) -> Image<bool> {
    let (width, height) = (pixels.width, pixels.height);
    let mut dead = Image::filled(width, height, false);
    for (count, length, strides) in [(width, height, [1, width]), (height, width, [width, 1])] {
        let lines = Lines { pixels: &pixels.pixels, usable: &usable.pixels, count, length, strides, floor };
        let of_line = |buffer: &mut Vec<f32>, line: usize| -> [[f64; PARTS]; WIDEST] {
            std::array::from_fn(|more| lines.departures(line, more + 1, buffer))
        };
        let departures: Vec<[[f64; PARTS]; WIDEST]> =
            (0..count).into_par_iter().map_init(|| Vec::with_capacity(2 * LOOKS), of_line).collect();
        let each = (0..count).flat_map(|line| (1..=WIDEST).flat_map(move |wide| [-1.0, 1.0].map(|sign| (line, wide, sign))));
        for (line, lines_wide, sign) in each {
            let is_hit = |part: &usize| departures[line][lines_wide - 1][*part] * sign > 0.0;
            for (first, last) in runs(&(0..PARTS).filter(is_hit).collect::<Vec<_>>(), sign) {
                for along in lines.part(first).start..lines.part(last).end {
                    (line..line + lines_wide).for_each(|line| dead.pixels[lines.index(line, along)] = true);
                }
            }
        }
    }
    dead
}

/// First and last part of each stretch in which a line is dead, by the parts in which it differs, up or down by `sign`.
fn runs(hits: &[usize], sign: f64) -> impl Iterator<Item = (usize, usize)> {
    let stretches = hits.chunk_by(|part, next| next - part <= 2).filter(|run| run.len() >= FEWEST_PARTS);
    // A readout lacks lines from its edge on; what is dark in the middle of a frame may be a thin wire.
    stretches.map(|run| (run[0], run[run.len() - 1])).filter(move |(first, last)| sign > 0.0 || *first == 0 || *last == PARTS - 1)
}

impl Lines<'_> {
    fn index(&self, line: usize, along: usize) -> usize {
        line * self.strides[0] + along * self.strides[1]
    }

    fn part(&self, part: usize) -> std::ops::Range<usize> {
        part * self.length / PARTS..(part + 1) * self.length / PARTS
    }

    /// By how much so many lines differ in each part from what lies beside them, 0 where they do not; 0 throughout where they are not dead by
    /// the parts that are looked at first.
    fn departures(&self, line: usize, lines_wide: usize, buffer: &mut Vec<f32>) -> [f64; PARTS] {
        let mut departures = [0.0; PARTS];
        let mut look = |part: usize| self.departure(part, line, lines_wide, buffer).unwrap_or(0.0);
        for part in LOOKED_AT_FIRST {
            departures[part] = look(part);
        }
        if departures.iter().all(|departure| *departure == 0.0) {
            return departures;
        }
        for part in (0..PARTS).filter(|part| !LOOKED_AT_FIRST.contains(part)) {
            departures[part] = look(part);
        }
        departures
    }

    fn departure(&self, part: usize, line: usize, lines_wide: usize, buffer: &mut Vec<f32>) -> Option<f64> {
        let [low, high] = [line.checked_sub(BESIDE)?, line + lines_wide - 1 + BESIDE];
        if high >= self.count {
            return None;
        }
        let range = self.part(part);
        let step = (range.len() / LOOKS).max(1);
        let value = |line: usize, along: usize| self.pixels[self.index(line, along)];
        // Medians over the part of what a line is more than those beside it, and of how much these differ.
        let mut median = |of: &dyn Fn(usize) -> f32| {
            buffer.clear();
            let looked_at = range.clone().step_by(step).filter(|along| self.usable[self.index(line, *along)]);
            buffer.extend(looked_at.map(of).filter(|value| value.is_finite()));
            let looks = buffer.len();
            quantile(buffer, 0.5).filter(|_| looks >= FEWEST_LOOKS).map(|middle| (middle, looks))
        };
        let expected = |along: usize| 0.5 * (value(low, along) + value(high, along));
        let (own, looks) = median(&|along| value(line, along) - expected(along))?;
        if !(own.abs() > LEAST_SIGMAS * self.floor) {
            return None;
        }
        let (apart, _) = median(&|along| (value(low, along) - value(high, along)).abs())?;
        let sigma = (apart / (0.6745 * std::f64::consts::SQRT_2)).max(self.floor);
        let mut least = own.abs();
        for other in line + 1..line + lines_wide {
            let (departure, _) = median(&|along| value(other, along) - expected(along))?;
            least = least.min(departure * own.signum());
        }
        if !(least > LEAST_SIGMAS * sigma) {
            return None;
        }
        let room = (LEFT_BESIDE * least).max(SIGMAS_BESIDE * OF_MEDIAN * sigma / (looks as f64).sqrt());
        // Those two away are of the same parity: columns that are read out in turns differ from their neighbours, and are not dead.
        for other in [line - 2, line - 1, line + lines_wide, line + lines_wide + 1] {
            let (left, _) = median(&|along| value(other, along) - expected(along))?;
            if !(left.abs() <= room) {
                return None;
            }
        }
        Some(own)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_no_part_of_the_first_is_hit_there_is_no_stretch() {
        let (mut without, mut with) = (0, 0);
        for hits in 0..1usize << PARTS {
            let parts: Vec<usize> = (0..PARTS).filter(|part| hits >> part & 1 == 1).collect();
            let stretches = [-1.0, 1.0].map(|sign| runs(&parts, sign).count());
            if LOOKED_AT_FIRST.iter().any(|part| parts.contains(part)) {
                with += stretches[1];
            } else {
                without += 1;
                assert_eq!(stretches, [0, 0], "{parts:?}");
            }
        }
        assert!(without == 1 << (PARTS - LOOKED_AT_FIRST.len()) && with > 100, "{without}, {with}");
    }
}

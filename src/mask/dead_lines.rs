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
/// Median size of the difference of two normal numbers, in σ.
const OF_DIFFERENCE: f64 = 0.6745 * std::f64::consts::SQRT_2;

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
        let of_line = |buffers: &mut [Vec<f32>; 2], line: usize| -> [[f64; PARTS]; WIDEST] {
            std::array::from_fn(|more| lines.departures(line, more + 1, buffers))
        };
        let buffers = || [(); 2].map(|()| Vec::with_capacity(2 * LOOKS));
        let departures: Vec<[[f64; PARTS]; WIDEST]> = (0..count).into_par_iter().map_init(buffers, of_line).collect();
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
    fn departures(&self, line: usize, lines_wide: usize, buffers: &mut [Vec<f32>; 2]) -> [f64; PARTS] {
        let mut departures = [0.0; PARTS];
        let mut look = |part: usize| self.departure(part, line, lines_wide, buffers).unwrap_or(0.0);
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

    fn departure(&self, part: usize, line: usize, lines_wide: usize, buffers: &mut [Vec<f32>; 2]) -> Option<f64> {
        let [low, high] = [line.checked_sub(BESIDE)?, line + lines_wide - 1 + BESIDE];
        if high >= self.count {
            return None;
        }
        let range = self.part(part);
        let step = (range.len() / LOOKS).max(1);
        let value = |line: usize, along: usize| self.pixels[self.index(line, along)];
        let looked_at = || range.clone().step_by(step).filter(|along| self.usable[self.index(line, *along)]);
        // Of a pixel of a line, what it is more than those beside, and by how much these differ.
        let of_pixel = |line: usize, along: usize| {
            let [one, other] = [value(low, along), value(high, along)];
            [value(line, along) - 0.5 * (one + other), (one - other).abs()]
        };
        let [buffer, apart] = buffers;
        buffer.clear();
        apart.clear();
        for [more, between] in looked_at().map(|along| of_pixel(line, along)) {
            buffer.extend(Some(more).filter(|value| value.is_finite()));
            apart.extend(Some(between).filter(|value| value.is_finite()));
        }
        if buffer.len() < FEWEST_LOOKS || apart.len() < FEWEST_LOOKS || is_surely_alike(buffer, apart) {
            return None;
        }
        let median = |values: &mut [f32]| quantile(values, 0.5).filter(|_| values.len() >= FEWEST_LOOKS);
        let looks = buffer.len();
        let own = median(buffer)?;
        if !(own.abs() > LEAST_SIGMAS * self.floor) {
            return None;
        }
        let apart = median(apart)?;
        let mut median_of_line = |other: usize| {
            buffer.clear();
            buffer.extend(looked_at().map(|along| of_pixel(other, along)[0]).filter(|value| value.is_finite()));
            median(buffer)
        };
        let sigma = (apart / OF_DIFFERENCE).max(self.floor);
        let mut least = own.abs();
        for other in line + 1..line + lines_wide {
            let departure = median_of_line(other)?;
            least = least.min(departure * own.signum());
        }
        if !(least > LEAST_SIGMAS * sigma) {
            return None;
        }
        let room = (LEFT_BESIDE * least).max(SIGMAS_BESIDE * OF_MEDIAN * sigma / (looks as f64).sqrt());
        // Those two away are of the same parity: columns that are read out in turns differ from their neighbours, and are not dead.
        for other in [line - 2, line - 1, line + lines_wide, line + lines_wide + 1] {
            let left = median_of_line(other)?;
            if !(left.abs() <= room) {
                return None;
            }
        }
        Some(own)
    }
}

/// Whether the median of `more` is surely no more than [`LEAST_SIGMAS`] of what `apart` says a σ is, by counts alone, which are sooner had than
/// medians; `false` where these would have to be asked.
fn is_surely_alike(more: &[f32], apart: &[f32]) -> bool {
    // Whatever it is: where it is well below the median of what lies between, and few differ by so much, the answer is yes.
    let between = 0.5 * apart.iter().sum::<f32>() / apart.len() as f32;
    let limit = (0.999_99 * LEAST_SIGMAS / OF_DIFFERENCE) as f32 * between;
    // The median is the value with so many before it.
    let before = more.len() / 2;
    let [mut above, mut below] = [0, 0];
    for value in more {
        above += usize::from(*value > limit);
        below += usize::from(*value < -limit);
    }
    let within = apart.iter().filter(|value| **value <= between).count();
    within <= apart.len() / 2 && above < more.len() - before && below <= before
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

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

    /// Where counts say that a line is alike, medians say so too; and they say it of most lines of noise.
    #[test]
    fn counts_say_nothing_that_medians_do_not() {
        let mut random = Stream::new(5, 0, 0, Purpose::Evaluation);
        let (mut sure, mut differing) = (0, 0);
        for n in 0..4000usize {
            let looks = FEWEST_LOOKS + n % 40;
            let shift = (n % 8) as f64 * 0.5 * if n % 3 == 0 { -1.0 } else { 1.0 };
            // Whole numbers have many that are equal.
            let whole = |value: f64| if n.is_multiple_of(5) { value.round() as f32 } else { value as f32 };
            let mut more: Vec<f32> = (0..looks).map(|_| whole(random.normal() + shift)).collect();
            let mut apart: Vec<f32> =
                (0..looks).map(|_| whole((std::f64::consts::SQRT_2 * random.normal()).abs() * (n % 7) as f64 / 4.0)).collect();
            let is_sure = is_surely_alike(&more, &apart);
            let median = |values: &mut [f32]| quantile(values, 0.5).expect("values");
            let differs = median(&mut more).abs() > LEAST_SIGMAS * (median(&mut apart) / OF_DIFFERENCE);
            assert!(!(is_sure && differs), "{n}: {more:?} beside {apart:?}");
            differing += usize::from(differs);
            sure += usize::from(is_sure);
        }
        assert!(sure > 1000 && differing > 500, "{sure}, {differing}");
    }
}

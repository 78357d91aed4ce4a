//! What was done to a picture that hides beads and that the picture itself shows: blocks of a lossy compression, lines of an anti-scatter grid.

use crate::estimate::median;
use crate::image::Image;
use crate::image::fourier::{Complex, transform};

/// Side of a JPEG's blocks.
const BLOCK_PX: usize = 8;
/// Mean jump between blocks over that within them from which on, along both axes, the blocks are said: noise alone has 1.00 ± 0.01; a
/// pelvis has 1.0 to 2.3 at quality 90, the more the less noise there is, 1.7 to 4 at 60, and 3 to 25 below.
const BLOCKED: f64 = 1.6;
/// Pixels of the lines whose spectrum is taken, and lines of a picture that are looked at, at most.
const SPAN: usize = 256;
const MOST_LINES: usize = 96;
/// Waves in a span from which on they are lines of a grid and not anatomy.
const FEWEST_WAVES: usize = 12;
/// Power of a wave over that of its neighbours from which on lines are said: pelvis, noise, streaks and blocks reach 4, a moiré of 5 % reaches
/// 50 to 200.
const LINED: f64 = 10.0;
/// Neighbours of a wave: so many waves to either side, those next to it left out.
const BESIDE: std::ops::RangeInclusive<usize> = 4..=12;

/// What a picture shows of what was done to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Artefact {
    /// Blocks of 8 × 8 pixels; how much more its values jump between them than within.
    Blocks { times: f64 },
    /// Parallel lines, their distance along columns or rows.
    Lines { period_px: f64 },
}

impl std::fmt::Display for Artefact {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Blocks { times } => write!(
                f,
                "the picture jumps {times:.1} times as much between blocks of {BLOCK_PX} x {BLOCK_PX} pixels as within them, as JPEG of low quality \
                 leaves it: export it without loss, or at a higher quality"
            ),
            Self::Lines { period_px } => write!(
                f,
                "lines every {period_px:.1} pixels run through the picture, as of an anti-scatter grid or its moiré: take the grid off, switch its \
                 suppression on, or export the panel's own pixels"
            ),
        }
    }
}

impl Artefact {
    /// All that `pixels` show.
    pub(super) fn of(pixels: &Image<f32>) -> Vec<Self> {
        let across = |line: usize, n: usize| f64::from(pixels.pixels[line * pixels.width + n]);
        let down = |line: usize, n: usize| f64::from(pixels.pixels[n * pixels.width + line]);
        let (w, h) = (pixels.width, pixels.height);
        let blocks = blocked(h, w, across).zip(blocked(w, h, down)).map(|(across, down)| across.min(down));
        let lines = [waves(h, w, across), waves(w, h, down)].into_iter().flatten().max_by(|a, b| a.0.total_cmp(&b.0));
        let blocks = blocks.filter(|times| *times >= BLOCKED).map(|times| Self::Blocks { times });
        // Blocks are waves as well, whole fractions of their side long; the window spreads a wave over its neighbours.
        let of_blocks = (SPAN / BLOCK_PX) as f64;
        let is_of_blocks = |period_px: f64| {
            let times = SPAN as f64 / period_px / of_blocks;
            (times - times.round()).abs() * of_blocks <= 2.0
        };
        let lines = lines
            .filter(|(times, period_px)| *times >= LINED && !(blocks.is_some() && is_of_blocks(*period_px)))
            .map(|(_, period_px)| Self::Lines { period_px });
        blocks.into_iter().chain(lines).collect()
    }
}

/// How much more values jump at the worst of eight places in a block, beyond the slope on either side, than at the usual one.
fn blocked(lines: usize, length: usize, value: impl Fn(usize, usize) -> f64) -> Option<f64> {
    let mut sums = [(0.0f64, 0usize); BLOCK_PX];
    for line in 0..lines {
        for n in 1..length.saturating_sub(2) {
            let [before, left, right, after] = [n - 1, n, n + 1, n + 2].map(|n| value(line, n));
            let jump = (right - left - 0.5 * (left - before) - 0.5 * (after - right)).abs();
            if jump.is_finite() {
                sums[n % BLOCK_PX].0 += jump;
                sums[n % BLOCK_PX].1 += 1;
            }
        }
    }
    let means = sums.map(|(sum, count)| sum / count.max(1) as f64);
    let usual = median(means).filter(|usual| *usual > 0.0)?;
    Some(means.into_iter().fold(0.0, f64::max) / usual)
}

/// The wave along the lines whose power is most above that of its neighbours: how many times, and its period.
fn waves(lines: usize, length: usize, value: impl Fn(usize, usize) -> f64) -> Option<(f64, f64)> {
    if length < SPAN || lines == 0 {
        return None;
    }
    // Hann's: what a border cuts is no wave.
    let window: Vec<f64> = (0..SPAN).map(|n| 0.5 - 0.5 * (std::f64::consts::TAU * n as f64 / SPAN as f64).cos()).collect();
    let first = (length - SPAN) / 2;
    let mut power = vec![0.0f64; SPAN / 2];
    for line in (0..lines).step_by(lines.div_ceil(MOST_LINES)) {
        let span: Vec<f64> = (0..SPAN).map(|n| value(line, first + n)).collect();
        if !span.iter().all(|value| value.is_finite()) {
            continue;
        }
        let mean = span.iter().sum::<f64>() / SPAN as f64;
        let mut waves: Vec<Complex> = span.iter().zip(&window).map(|(value, share)| [(value - mean) * share, 0.0]).collect();
        transform(&mut waves);
        power.iter_mut().zip(&waves).for_each(|(power, [re, im])| *power += re * re + im * im);
    }
    let over = |k: usize| {
        let beside = BESIDE.flat_map(|off| [k - off, k + off]).filter_map(|k| power.get(k).copied());
        let usual = median(beside).filter(|usual| *usual > 0.0)?;
        Some((power[k] / usual, SPAN as f64 / k as f64))
    };
    // The last waves have neighbours on one side only, which is enough.
    (FEWEST_WAVES..SPAN / 2 - 2).filter_map(over).max_by(|a, b| a.0.total_cmp(&b.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    /// A smooth field with noise of 3 %; `more` is what is done to a pixel of it.
    fn picture(more: impl Fn(usize, usize, f64) -> f64) -> Image<f32> {
        let mut random = Stream::new(5, 0, 0, Purpose::Evaluation);
        let mut image = Image::filled(300, 280, 0.0f32);
        for row in 0..280 {
            for column in 0..300 {
                let field = 1000.0 + 2.0 * column as f64 - row as f64 + 150.0 * (0.03 * row as f64).sin();
                *image.at_mut(column, row) = more(column, row, field * (1.0 + 0.03 * random.normal())) as f32;
            }
        }
        image
    }

    #[test]
    fn noise_on_a_smooth_field_is_no_artefact() {
        assert!(Artefact::of(&picture(|_, _, value| value)).is_empty());
        assert!(Artefact::of(&Image::filled(300, 280, 7.0f32)).is_empty(), "nothing at all");
        assert!(Artefact::of(&Image::filled(3, 2, 7.0f32)).is_empty(), "hardly a picture");
        assert!(Artefact::of(&picture(|_, _, _| f64::NAN)).is_empty(), "no numbers");
    }

    #[test]
    fn lines_are_said_with_their_distance_whichever_way_they_run() {
        let wave = |at: f64| 1.0 + 0.05 * (std::f64::consts::TAU * at / 4.3).sin();
        let upright = picture(|column, row, value| value * wave(column as f64 + 0.06 * row as f64));
        let lying = picture(|_, row, value| value * wave(row as f64));
        for image in [upright, lying] {
            let found = Artefact::of(&image);
            let [Artefact::Lines { period_px }] = found.as_slice() else { panic!("{found:?}") };
            assert!((*period_px - 4.3).abs() < 0.1, "{period_px}");
            assert!(found[0].to_string().contains("every 4.3 pixels"), "{}", found[0]);
        }
    }

    /// What is left of a JPEG of low quality: each block's mean and slope, and a tenth of its noise.
    #[test]
    fn blocks_are_said_wherever_they_begin_and_not_for_lines() {
        let noisy = picture(|_, _, value| value);
        for offset in [0, 3] {
            let start = |n: usize| ((n + offset) / BLOCK_PX * BLOCK_PX).saturating_sub(offset);
            let block_mean = |column: usize, row: usize| {
                let (left, top) = (start(column), start(row));
                let (right, bottom) = ((left + BLOCK_PX).min(300), (top + BLOCK_PX).min(280));
                let values = (top..bottom).flat_map(|row| (left..right).map(move |column| (column, row)));
                let (sum, count) =
                    values.fold((0.0, 0.0), |(sum, count), (column, row)| (sum + f64::from(*noisy.at(column, row)), count + 1.0));
                sum / count
            };
            let blocked = picture(|column, row, value| {
                let mean = block_mean(column, row);
                mean + 0.02 * (value - mean)
            });
            let found = Artefact::of(&blocked);
            let [Artefact::Blocks { times }] = found.as_slice() else { panic!("{found:?}") };
            assert!(*times > BLOCKED && found[0].to_string().contains("JPEG"), "{found:?}");
        }
    }
}

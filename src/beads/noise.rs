//! The noise of a frame as a function of its value, and of its correlation between neighbours.

use rayon::prelude::*;

use super::correlation::Correlation;
use crate::image::{Image, on_widest_vectors, quantile};
use crate::units::{interpolated, interpolated_below};

/// Standard deviation of a pixel's noise against the pixel's value.
#[derive(Clone, Debug)]
pub struct Noise {
    /// Ascending mean values of the bins.
    values: Vec<f64>,
    /// Standard deviation in each bin, > 0.
    sigmas: Vec<f64>,
    /// Variance = slope · value + offset where that law fits (quanta); else the bins are interpolated.
    law: Option<(f64, f64)>,
    floor: f64,
    /// Between pixels.
    correlation: Correlation,
}

const BINS: usize = 24;

impl Noise {
    /// Measures `pixels` where `usable` holds. `quanta`: the values are proportional to detected quanta, so that the law may be carried
    /// to values that hardly occur.
    ///
    /// The measure is the median absolute second difference, which is blind to planes and, being a median, to edges (after Immerkær 1996).
    pub fn measure(pixels: &Image<f32>, usable: &Image<bool>, quanta: bool) -> Self {
        let (w, h) = (pixels.width, pixels.height);
        let stride = ((w * h) as f64 / 400_000.0).sqrt().ceil().max(1.0) as usize;
        let sample = |row: usize, column: usize| {
            let at = |dc: usize, dr: usize| pixels.pixels[(row + dr - 1) * w + column + dc - 1];
            let corners = at(0, 0) + at(2, 0) + at(0, 2) + at(2, 2);
            let sides = at(1, 0) + at(0, 1) + at(2, 1) + at(1, 2);
            let second = (corners - 2.0 * sides + 4.0 * at(1, 1)) / 6.0;
            ((corners + sides + at(1, 1)) / 9.0, second.abs())
        };
        let rows: Vec<usize> = (1..h.saturating_sub(1)).step_by(stride).collect();
        let places = rows.par_iter().flat_map_iter(|&row| {
            (1..w.saturating_sub(1))
                .step_by(stride)
                .filter(move |column| usable.pixels[row * w + column])
                .map(move |column| (row, column))
        });
        let places: Vec<(usize, usize)> = places.collect();
        let greys: Vec<f32> = places.par_iter().map(|(row, column)| pixels.pixels[row * w + column]).collect();
        let samples = by_first(places.par_iter().map(|(row, column)| sample(*row, *column)).collect());
        let range = match (samples.first(), samples.last()) {
            (Some(first), Some(last)) => f64::from(last.0 - first.0),
            _ => 0.0,
        };
        // What is rounded to grey levels is off by that, even where all about it is as smooth as a lossy compression leaves it: noise of next to
        // nothing stops a fit before it has arrived.
        let floor = (1e-5 * range).max(grey_step(greys) / 12f64.sqrt()).max(1e-9);
        let size = samples.len().div_ceil(BINS).max(64);
        let (mut values, mut sigmas) = (Vec::new(), Vec::new());
        for bin in samples.chunks(size).filter(|bin| bin.len() >= 32) {
            let mut seconds: Vec<f32> = bin.iter().map(|sample| sample.1).collect();
            let median = quantile(&mut seconds, 0.5).unwrap_or(0.0);
            values.push(bin.iter().map(|sample| f64::from(sample.0)).sum::<f64>() / bin.len() as f64);
            // Quantised images have a median of zero where noise is below half a grey level.
            sigmas.push((median / 0.6745).max(floor));
        }
        if values.is_empty() {
            values.push(0.0);
            sigmas.push((1e-3 * range).max(floor));
        }
        let law = quanta.then(|| quantum_law(&values, &sigmas)).flatten();
        let mut noise = Self { values, sigmas, law, floor, correlation: Correlation::none() };
        let correlation = Correlation::measure(pixels, usable, |value| noise.sigma(value));
        // Second differences see little of noise that neighbours share.
        noise.scale(correlation.variance_ratio);
        noise.correlation = correlation;
        noise
    }

    fn scale(&mut self, variance_ratio: f64) {
        let factor = variance_ratio.sqrt();
        let floor = self.floor;
        self.sigmas.iter_mut().for_each(|sigma| *sigma = (*sigma * factor).max(floor));
        self.law = self.law.map(|(slope, offset)| (slope * variance_ratio, offset * variance_ratio));
    }

    /// Correlation between pixels.
    pub fn correlation(&self) -> &Correlation {
        &self.correlation
    }

    /// Standard deviation at `value`.
    pub fn sigma(&self, value: f64) -> f64 {
        if let Some(law) = self.law {
            return by_law(law, self.floor, value);
        }
        interpolated(&self.values, &self.sigmas, value)
    }

    /// [`Self::sigma`] at each of `values`.
    pub fn fill_sigmas(&self, values: &[f64], sigmas: &mut [f64]) {
        on_widest_vectors(Sigmas { noise: self, values, sigmas });
    }
}

/// Variance = slope · value + offset.
#[inline(always)]
fn by_law((slope, offset): (f64, f64), floor: f64, value: f64) -> f64 {
    (slope * value.max(0.0) + offset).sqrt().max(floor)
}

/// See [`Noise::fill_sigmas`].
struct Sigmas<'a> {
    noise: &'a Noise,
    values: &'a [f64],
    sigmas: &'a mut [f64],
}

impl pulp::NullaryFnOnce for Sigmas<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { noise, values, sigmas } = self;
        if let Some(law) = noise.law {
            for (sigma, value) in sigmas.iter_mut().zip(values) {
                *sigma = by_law(law, noise.floor, *value);
            }
            return;
        }
        if !noise.values.is_sorted() {
            for (sigma, value) in sigmas.iter_mut().zip(values) {
                *sigma = interpolated(&noise.values, &noise.sigmas, *value);
            }
            return;
        }
        // Of few places all are asked at once, of many values side by side: a search would guess at every turn.
        for (sigmas, values) in sigmas.chunks_mut(SIDE_BY_SIDE).zip(values.chunks(SIDE_BY_SIDE)) {
            let (mut asked, mut below) = ([0.0; SIDE_BY_SIDE], [0u64; SIDE_BY_SIDE]);
            asked[..values.len()].copy_from_slice(values);
            for place in &noise.values {
                for (below, value) in below.iter_mut().zip(&asked) {
                    *below += u64::from(*place < *value);
                }
            }
            for ((sigma, value), below) in sigmas.iter_mut().zip(values).zip(below) {
                *sigma = interpolated_below(&noise.values, &noise.sigmas, *value, below as usize);
            }
        }
    }
}

/// Values whose places are counted together.
const SIDE_BY_SIDE: usize = 32;

/// `samples` in the order of their first numbers, those that are alike as they came.
fn by_first(samples: Vec<(f32, f32)>) -> Vec<(f32, f32)> {
    // Whole numbers are compared without a branch. They are in the order of `f32::total_cmp`.
    let rank = |value: f32| value.to_bits() ^ if value.is_sign_negative() { u32::MAX } else { 1 << 31 };
    let mut order: Vec<(u32, u32)> = samples.par_iter().enumerate().map(|(n, sample)| (rank(sample.0), n as u32)).collect();
    order.par_sort_unstable_by_key(|(rank, n)| (u64::from(*rank) << 32) | u64::from(*n));
    order.par_iter().map(|(_, n)| samples[*n as usize]).collect()
}

/// Fewer levels than these are no scale: a drawing, or a mask, has a few.
const LEVELS: usize = 32;

/// Step between the grey levels that occur, as nine in ten neighbours have it or more; next to nothing where values are not rounded.
fn grey_step(mut greys: Vec<f32>) -> f64 {
    greys.par_sort_unstable_by(f32::total_cmp);
    greys.dedup();
    if greys.len() < LEVELS {
        return 0.0;
    }
    let mut gaps: Vec<f32> = greys.windows(2).map(|pair| pair[1] - pair[0]).collect();
    quantile(&mut gaps, 0.1).filter(|step| step.is_finite()).unwrap_or(0.0)
}

/// Variance = slope · value + offset through those bins that hold noise only; `None` when it does not rise.
///
/// Rims of beads and bones add to a bin's second differences and never take away, so the line sought is one that most bins lie on or
/// above: of all lines through two bins, or through one and the origin, the one with the least lopsided loss (quantile regression).
fn quantum_law(values: &[f64], sigmas: &[f64]) -> Option<(f64, f64)> {
    let bins: Vec<(f64, f64)> = values.iter().zip(sigmas).map(|(value, sigma)| (value.max(0.0), sigma * sigma)).collect();
    let through_origin = bins.iter().map(|(value, variance)| (variance / value, 0.0));
    let through_two = bins.iter().enumerate().flat_map(|(n, a)| {
        bins[..n].iter().map(move |b| {
            let slope = (a.1 - b.1) / (a.0 - b.0);
            (slope, a.1 - slope * a.0)
        })
    });
    let is_law = |(slope, offset): &(f64, f64)| *slope > 0.0 && slope.is_finite() && *offset >= 0.0 && offset.is_finite();
    let loss = |(slope, offset): (f64, f64)| {
        let above = |(value, variance): &(f64, f64)| variance / (slope * value + offset) - 1.0;
        bins.iter()
            .map(above)
            .map(|excess| if excess > 0.0 { LOW_QUANTILE * excess.min(1.0) } else { (LOW_QUANTILE - 1.0) * excess })
            .sum::<f64>()
    };
    let laws = through_origin.chain(through_two).filter(is_law).map(|law| (loss(law), law));
    laws.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, law)| law)
}

/// Share of bins that may lie below the line of noise.
const LOW_QUANTILE: f64 = 0.3;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    /// A slope with noise of so many grey levels.
    fn slope(noise: f64) -> Image<f32> {
        let mut random = Stream::new(9, 0, 0, Purpose::Evaluation);
        let mut image = Image::filled(320, 300, 0.0f32);
        for (n, pixel) in image.pixels.iter_mut().enumerate() {
            *pixel = (40.0 + 0.1 * (n % 320) as f64 + 0.0137 * (n / 320) as f64 + noise * random.normal()) as f32;
        }
        image
    }

    fn sigma(image: &Image<f32>) -> f64 {
        Noise::measure(image, &Image::filled(image.width, image.height, true), false).sigma(56.0)
    }

    #[test]
    fn samples_keep_their_order_where_they_are_alike_whatever_they_are() {
        let mut random = Stream::new(11, 0, 0, Purpose::Evaluation);
        let strange = [0.0, -0.0, f32::NAN, -f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MIN_POSITIVE, -1e-40];
        let first = |n: usize, random: &mut Stream| {
            if n.is_multiple_of(5) { strange[n / 5 % 8] } else { (4.0 * random.normal()).round() as f32 }
        };
        let samples: Vec<(f32, f32)> = (0..5000).map(|n| (first(n, &mut random), n as f32)).collect();
        let mut stable = samples.clone();
        stable.sort_by(|a, b| a.0.total_cmp(&b.0));
        let bits = |samples: &[(f32, f32)]| samples.iter().map(|(a, b)| (a.to_bits(), b.to_bits())).collect::<Vec<_>>();
        assert_eq!(bits(&by_first(samples)), bits(&stable));
    }

    #[test]
    fn many_sigmas_at_once_are_those_of_each() {
        let image = slope(3.0);
        let usable = Image::filled(image.width, image.height, true);
        for quanta in [false, true] {
            let noise = Noise::measure(&image, &usable, quanta);
            assert_eq!(noise.law.is_some(), quanta, "either way is tried");
            let values: Vec<f64> = (0..700)
                .map(|n| f64::from(n) * 0.2 - 20.0)
                .chain(noise.values.clone())
                .chain([f64::NAN, f64::INFINITY])
                .collect();
            let mut sigmas = vec![0.0; values.len()];
            noise.fill_sigmas(&values, &mut sigmas);
            for (value, sigma) in values.iter().zip(&sigmas) {
                assert_eq!(sigma.to_bits(), noise.sigma(*value).to_bits(), "{value}");
            }
        }
    }

    /// Of a JPEG's smooth blocks the noise was a hundred-thousandth of the range: fits stopped short, and clear beads were not found.
    #[test]
    fn what_is_rounded_has_the_noise_of_rounding_at_least_and_what_is_not_has_none() {
        let rounded = sigma(&slope(0.0).map(|value| value.round()));
        assert!((0.28..0.6).contains(&rounded), "{rounded}");
        assert!(sigma(&slope(0.0)) < 0.02, "{}", sigma(&slope(0.0)));
        let (plain, rounded) = (sigma(&slope(3.0)), sigma(&slope(3.0).map(|value| value.round())));
        assert!((plain - 3.0).abs() < 0.3 && (rounded - 3.0).abs() < 0.3, "{plain}, {rounded}");
    }
}

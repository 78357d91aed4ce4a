//! How far a pixel differs from its surroundings by noise alone, at each value of a frame.

use rayon::prelude::*;

use crate::estimate::median;
use crate::image::{Image, in_order};
use crate::units::interpolated;

/// Places at which the noise is looked at, about.
const SAMPLES: f64 = 60_000.0;
const BINS: usize = 24;
/// Share of a bin's differences that counts: the largest are edges.
const COUNTED: f64 = 0.98;
/// σ over the mean size of a normal number of which the largest are left out.
const SIGMA_PER_MEAN: f64 = 1.32;
/// σ over the median size of a normal number.
const SIGMA_PER_MEDIAN: f64 = 1.0 / 0.6745;
/// A frame of fewer quanta a pixel has no tail that is known well enough.
const FEWEST_QUANTA: f64 = 5.0;

/// The noise of differences from the surroundings' median.
pub(super) struct LocalNoise {
    /// Ascending mean values of the bins.
    values: Vec<f64>,
    /// Standard deviation in each bin.
    sigmas: Vec<f64>,
    /// At most: what a quantum adds to a value. It bounds the skewness.
    gain: f64,
    /// Differences smaller than this are steps of the values.
    pub floor: f64,
}

/// Median of the sixteen pixels two away, as far as the frame has them and they are numbers; `None` where these are fewer than half.
pub(super) fn around(pixels: &Image<f32>, column: usize, row: usize) -> Option<f32> {
    let (mut ring, mut count) = ([0.0f32; 16], 0);
    for dv in 0..5usize {
        for du in 0..5usize {
            if !(matches!(dv, 0 | 4) || matches!(du, 0 | 4)) || column + du < 2 || row + dv < 2 {
                continue;
            }
            let (u, v) = (column + du - 2, row + dv - 2);
            if u < pixels.width && v < pixels.height && pixels.pixels[v * pixels.width + u].is_finite() {
                ring[count] = pixels.pixels[v * pixels.width + u];
                count += 1;
            }
        }
    }
    if count == ring.len() {
        return Some(middle_of_all(ring));
    }
    let ring = &mut ring[..count];
    ring.sort_unstable_by(f32::total_cmp);
    (count >= 8).then(|| 0.5 * (ring[(count - 1) / 2] + ring[count / 2]))
}

/// The median of sixteen numbers, by how many are smaller than each: sooner had than their order, as nothing hangs on which way two lie.
fn middle_of_all(ring: [f32; 16]) -> f32 {
    let words = ring.map(|value| (in_order(value) ^ 1 << 31) as i32);
    let mut before = [0i32; 16];
    for word in words {
        before.iter_mut().zip(&words).for_each(|(before, other)| *before += i32::from(word < *other));
    }
    // In their order the one at a place is the largest of those before which no more come.
    let [mut low, mut high] = [i32::MIN; 2];
    for (word, before) in words.into_iter().zip(before) {
        low = low.max(if before <= 7 { word } else { i32::MIN });
        high = high.max(if before <= 8 { word } else { i32::MIN });
    }
    let value = |word: i32| out_of_order(word as u32 ^ 1 << 31);
    0.5 * (value(low) + value(high))
}

/// The number of which [`in_order`] makes this word.
fn out_of_order(word: u32) -> f32 {
    f32::from_bits(if word >> 31 == 1 { word ^ 1 << 31 } else { !word })
}

/// A line, flat beyond two values, that lies nowhere above the variance of a [`LocalNoise`].
pub(super) struct VarianceBound {
    /// Between these it is `at_zero` + `slope` × value.
    ends: [f32; 2],
    at_zero: f32,
    slope: f32,
}

impl VarianceBound {
    /// A variance that is nowhere too large; below 0 where nothing is known.
    #[inline]
    pub fn at(&self, value: f32) -> f32 {
        self.at_zero + self.slope * value.max(self.ends[0]).min(self.ends[1])
    }
}

impl LocalNoise {
    /// As the variance of quanta rises with their number, much of it lies near a line.
    pub fn variance_bound(&self) -> VarianceBound {
        let (first, last) = (self.values[0], self.values[self.values.len() - 1]);
        let variance = |sigma: f64| sigma * sigma;
        let rise = variance(self.sigmas[self.sigmas.len() - 1]) - variance(self.sigmas[0]);
        let slope = f64::from(if last > first { (rise / (last - first)).max(0.0) as f32 } else { 0.0 });
        let mut least = variance(self.sigmas[0]) - slope * first;
        for (values, sigmas) in self.values.windows(2).zip(self.sigmas.windows(2)) {
            let excess = |sigma: f64, value: f64| variance(sigma) - slope * value;
            least = least.min(excess(sigmas[1], values[1]));
            // σ is straight between two values, and its square has the slope of the line at one place.
            let per_value = (sigmas[1] - sigmas[0]) / (values[1] - values[0]);
            let sigma = 0.5 * slope / per_value;
            if sigma > sigmas[0].min(sigmas[1]) && sigma < sigmas[0].max(sigmas[1]) {
                least = least.min(excess(sigma, values[0] + (sigma - sigmas[0]) / per_value));
            }
        }
        // What single precision may be off, between ends that are rounded too.
        let size = least.abs() + slope * first.abs().max(last.abs());
        VarianceBound { ends: [first as f32, last as f32], at_zero: (least - 1e-5 * size) as f32, slope: slope as f32 }
    }

    /// Measures `pixels`, proportional to quanta up to an offset, where they are `usable`; `None` where these are too few or all alike.
    pub fn measure(pixels: &Image<f32>, usable: &Image<bool>) -> Option<Self> {
        let (width, height) = (pixels.width, pixels.height);
        // An odd stride looks at all columns of a pattern of two.
        let stride = ((width * height) as f64 / SAMPLES).sqrt().max(1.0) as usize | 1;
        let rows: Vec<usize> = (0..height).step_by(stride).collect();
        let samples: Vec<[f32; 3]> = rows
            .par_iter()
            .flat_map_iter(|&row| {
                (0..width).step_by(stride).filter(move |column| usable.pixels[row * width + column]).filter_map(move |column| {
                    let value = pixels.pixels[row * width + column];
                    let around = around(pixels, column, row)?;
                    value.is_finite().then(|| [around, (value - around).abs(), value])
                })
            })
            .collect();
        if samples.len() < 32 * BINS {
            return None;
        }
        // By what is around them, then as they come: words are put in order sooner than samples.
        let word = |(n, sample): (usize, &[f32; 3])| u64::from(in_order(sample[0])) << 32 | n as u64;
        let mut order: Vec<u64> = samples.iter().enumerate().map(word).collect();
        order.par_sort_unstable();
        let samples: Vec<[f32; 3]> = order.into_iter().map(|word| samples[word as u32 as usize]).collect();
        let range = f64::from(samples[samples.len() - 1][0] - samples[0][0]);
        let step = smallest_step(samples.iter().map(|sample| sample[2]));
        let floor = (0.5 * step).max(1e-5 * range);
        let of_bin = |bin: &[[f32; 3]]| {
            // Sizes are not negative: their bits are in their order.
            let mut sizes: Vec<u32> = bin.iter().map(|sample| sample[1].to_bits()).collect();
            sizes.sort_unstable();
            let size = |bits: u32| f64::from(f32::from_bits(bits));
            let counted = &sizes[..(COUNTED * sizes.len() as f64).ceil() as usize];
            // Few quanta are few different sizes, of which the median is one; the mean of many edges is too large, which does no harm.
            let of_mean = SIGMA_PER_MEAN * counted.iter().map(|bits| size(*bits)).sum::<f64>() / counted.len() as f64;
            let value = bin.iter().map(|sample| f64::from(sample[0])).sum::<f64>() / bin.len() as f64;
            (value, of_mean.max(SIGMA_PER_MEDIAN * size(sizes[sizes.len() / 2])).max(floor))
        };
        let (values, mut sigmas): (Vec<f64>, Vec<f64>) = samples.par_chunks(samples.len().div_ceil(BINS)).map(of_bin).unzip();
        // Where values are cut off they scatter less than their noise.
        let most = sigmas.iter().copied().fold(floor, f64::max);
        sigmas.iter_mut().filter(|sigma| **sigma <= floor).for_each(|sigma| *sigma = most);
        let gain = most_gain(&values, &sigmas);
        sigmas.iter().all(|sigma| *sigma > 0.0).then_some(Self { values, sigmas, gain, floor })
    }

    /// Standard deviation where the surroundings have this value.
    pub fn sigma(&self, value: f64) -> f64 {
        interpolated(&self.values, &self.sigmas, value)
    }

    /// Whether noise makes a pixel differ so far from surroundings of this value with less than e to the minus `rarity`.
    // Of N quanta D / g too many come with less than exp(−N h(D / (g N))), h(x) = (1 + x) ln(1 + x) − x (Chernoff's bound), N = (σ / g)²;
    // too few with less than a normal number would be.
    pub fn is_beyond(&self, difference: f64, around: f64, rarity: f64) -> bool {
        let variance = self.sigma(around).powi(2);
        if !(difference > 0.0 && self.gain > 0.0) {
            return difference * difference > 2.0 * variance * rarity;
        }
        let quanta = variance / self.gain.powi(2);
        // A median of whole quanta lies up to half of one below the mean.
        let excess = (difference - 0.5 * self.gain).max(0.0);
        let x = excess * self.gain / variance;
        let h = if x > 1e-3 { (1.0 + x) * x.ln_1p() - x } else { 0.5 * x * x };
        quanta >= FEWEST_QUANTA && quanta * h > rarity
    }
}

/// The smallest difference of two values.
fn smallest_step(values: impl Iterator<Item = f32>) -> f64 {
    let mut words: Vec<u32> = values.map(in_order).collect();
    words.par_sort_unstable();
    let value = |word: u32| f64::from(out_of_order(word));
    let steps = words.windows(2).map(|pair| value(pair[1]) - value(pair[0])).filter(|step| *step > 0.0);
    let step = steps.fold(f64::INFINITY, f64::min);
    if step.is_finite() { step } else { 0.0 }
}

/// What a quantum adds to a value, at most: from how the variance rises with the value, and as if there were no offset.
fn most_gain(values: &[f64], sigmas: &[f64]) -> f64 {
    let middle = |of: Vec<f64>| median(of).unwrap_or(0.0);
    let variances: Vec<f64> = sigmas.iter().map(|sigma| sigma * sigma).collect();
    let ratio = if values.iter().all(|value| *value > 0.0) {
        middle(variances.iter().zip(values).map(|(variance, value)| variance / value).collect())
    } else {
        0.0
    };
    let third = values.len() / 3;
    let (low, high) = (0..third, values.len() - third..values.len());
    let rise = middle(variances[high.clone()].to_vec()) - middle(variances[low.clone()].to_vec());
    let run = middle(values[high].to_vec()) - middle(values[low].to_vec());
    let slope = if run > 0.0 { rise / run } else { 0.0 };
    ratio.max(slope).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    #[test]
    fn the_median_of_sixteen_is_that_of_their_order() {
        let mut random = Stream::new(9, 0, 0, Purpose::Evaluation);
        for n in 0..2000u32 {
            let ring: [f32; 16] = std::array::from_fn(|_| match n % 4 {
                0 => random.normal() as f32,
                1 => (2.0 * random.normal()).round() as f32,
                2 => (0.6 * random.normal()).round() as f32 * -0.0,
                _ => f32::from_bits(random.next_u32()),
            });
            if !ring.iter().all(|value| value.is_finite()) {
                continue;
            }
            let mut sorted = ring;
            sorted.sort_by(f32::total_cmp);
            assert_eq!(middle_of_all(ring).to_bits(), (0.5 * (sorted[7] + sorted[8])).to_bits(), "{ring:?}");
        }
    }

    #[test]
    fn the_bound_lies_nowhere_above_the_variance_and_often_near_it() {
        let noise = |values: &[f64], sigmas: &[f64]| LocalNoise {
            values: values.to_vec(),
            sigmas: sigmas.to_vec(),
            gain: 1.0,
            floor: 0.0,
        };
        let quanta: Vec<f64> = (1..25).map(|n| 40.0 * f64::from(n)).collect();
        let roots: Vec<f64> = quanta.iter().map(|quanta| quanta.sqrt()).collect();
        let kinds = [
            noise(&quanta, &roots),
            noise(&[-3.0, -3.0, 1.0, 1.0, 9.0], &[0.5, 2.0, 0.1, 4.0, 3.0]),
            noise(&[0.0, 1.0, 2.0], &[3.0, 2.0, 1.0]),
            noise(&[60_000.0, 60_000.001, 60_000.002], &[1e-3, 3e-3, 2e-3]),
            noise(&[5.0, 5.0], &[2.0, 1.0]),
            noise(&[0.0, 10.0], &[1.0, 9.0]),
        ];
        for (n, noise) in kinds.iter().enumerate() {
            let bound = noise.variance_bound();
            let (first, last) = (noise.values[0], noise.values[noise.values.len() - 1]);
            for step in -300..=1300 {
                let value = (first + (last - first + 1e-3) * f64::from(step) / 1000.0) as f32;
                let [variance, least] = [noise.sigma(f64::from(value)).powi(2), f64::from(bound.at(value))];
                assert!(least <= variance, "{n}: {least} at {value}, where the variance is {variance}");
                let is_between = f64::from(value) > first && f64::from(value) < last;
                assert!(n > 0 || !is_between || least > 0.8 * variance, "{least} of {variance} at {value}");
            }
        }
    }
}

//! Filters that never mix in masked pixels: normalised convolution, gradients, block means.

use rayon::prelude::*;

use crate::image::{Image, on_widest_vectors, quantile, zip};

/// A pixel of a smoothed image is trusted when at least this share of its kernel lay on usable pixels.
pub(super) const TRUSTED_WEIGHT: f32 = 0.75;

/// A Gaussian for normalised convolutions over one mask, at every pixel or at every so many of them each way.
pub(super) struct Kernel {
    taps: Vec<f32>,
    stride: usize,
    /// Share of the kernel that lies on usable pixels.
    pub weight: Image<f32>,
}

/// Gaussian weights out to 3 σ, normalised to a sum of 1.
fn gaussian(sigma_px: f64) -> Vec<f32> {
    let radius = (3.0 * sigma_px).ceil().max(1.0) as i32;
    let weights: Vec<f64> = (-radius..=radius).map(|i| (-0.5 * (f64::from(i) / sigma_px).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|w| (w / sum) as f32).collect()
}

/// Separable convolution, evaluated at every `stride`-th column and row; beyond the image there is zero.
fn convolve(image: &Image<f32>, kernel: &[f32], stride: usize) -> Image<f32> {
    let (width, height) = (image.width.div_ceil(stride), image.height.div_ceil(stride));
    let radius = (kernel.len() / 2) as isize;
    let mut across = vec![0.0f32; width * image.height];
    across.par_chunks_mut(width.max(1)).zip(image.pixels.par_chunks(image.width.max(1))).for_each_init(
        || vec![Vec::new(); stride],
        |lanes, (out, row)| {
            // Slices rather than indices or steps: without a check in each step these are vectors.
            let lanes: Vec<&[f32]> = match stride {
                1 => vec![row],
                _ => {
                    lanes.iter_mut().enumerate().for_each(|(phase, lane)| {
                        lane.clear();
                        lane.extend(row.iter().skip(phase).step_by(stride));
                    });
                    lanes.iter().map(Vec::as_slice).collect()
                }
            };
            on_widest_vectors(Across { out, lanes: &lanes, kernel });
        },
    );
    let mut down = vec![0.0f32; width * height];
    down.par_chunks_mut(width.max(1)).enumerate().for_each(|(v, out)| {
        on_widest_vectors(Down { out, across: &across, kernel, first: (v * stride) as isize - radius });
    });
    Image { width, height, pixels: down }
}

/// A row of `out` from the lanes of a row: `lanes[phase][n]` is its value at column n · stride + phase.
struct Across<'a> {
    out: &'a mut [f32],
    lanes: &'a [&'a [f32]],
    kernel: &'a [f32],
}

impl pulp::NullaryFnOnce for Across<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let (stride, radius) = (self.lanes.len() as isize, (self.kernel.len() / 2) as isize);
        for (tap, weight) in self.kernel.iter().enumerate() {
            // out[u] += w · row[stride · u + tap − radius], for the u where that exists.
            let shift = tap as isize - radius;
            let lane = self.lanes[shift.rem_euclid(stride) as usize];
            let first = shift.div_euclid(stride);
            let (skipped, from) = (first.max(0) as usize, (-first).max(0) as usize);
            let (lane, out) = (lane.get(skipped..).unwrap_or_default(), self.out.get_mut(from..).unwrap_or_default());
            out.iter_mut().zip(lane).for_each(|(o, r)| *o += weight * r);
        }
    }
}

/// A row of `out` from the rows of `across`, as wide, from row `first` on.
struct Down<'a> {
    out: &'a mut [f32],
    across: &'a [f32],
    kernel: &'a [f32],
    first: isize,
}

impl pulp::NullaryFnOnce for Down<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let width = self.out.len();
        let rows = (self.across.len() / width.max(1)) as isize;
        for (tap, weight) in self.kernel.iter().enumerate() {
            let source = self.first + tap as isize;
            if (0..rows).contains(&source) {
                let row = &self.across[source as usize * width..][..width];
                self.out.iter_mut().zip(row).for_each(|(o, r)| *o += weight * r);
            }
        }
    }
}

impl Kernel {
    pub(super) fn on(usable: &Image<bool>, sigma_px: f64, stride: usize) -> Self {
        let taps = gaussian(sigma_px);
        let weight = convolve(&usable.map(|&u| f32::from(u8::from(u))), &taps, stride);
        Self { taps, stride, weight }
    }

    /// The same, of a kernel at every pixel, at every `stride`-th.
    pub(super) fn at_every(&self, stride: usize) -> Self {
        Self { taps: self.taps.clone(), stride, weight: every(&self.weight, stride) }
    }

    /// Gaussian mean over usable pixels, the same as in [`Kernel::on`]; 0 where none is near. Values at unusable pixels (NaN included) are
    /// never read.
    pub(super) fn smooth(&self, image: &Image<f32>, usable: &Image<bool>) -> Image<f32> {
        let kept = zip(image, usable, |&value, &u| if u { value } else { 0.0 });
        let mut value = convolve(&kept, &self.taps, self.stride);
        value.pixels.iter_mut().zip(&self.weight.pixels).for_each(|(v, &w)| *v = if w > 1e-3 { *v / w } else { 0.0 });
        value
    }
}

/// Every `stride`-th column and row, from the first.
pub(super) fn every<T: Copy>(image: &Image<T>, stride: usize) -> Image<T> {
    let (width, height) = (image.width.div_ceil(stride), image.height.div_ceil(stride));
    let rows = image.pixels.chunks(image.width.max(1)).step_by(stride);
    Image { width, height, pixels: rows.flat_map(|row| row.iter().step_by(stride).copied()).collect() }
}

/// Central differences of a smoothed image, per pixel; `known` where all four neighbours are trusted.
pub(super) struct Gradient {
    pub du: Image<f32>,
    pub dv: Image<f32>,
    pub known: Image<bool>,
}

/// `weight`: the share of the kernel that was usable when `value` was smoothed.
pub(super) fn gradient(value: &Image<f32>, weight: &Image<f32>) -> Gradient {
    let (width, height) = (value.width, value.height);
    let mut found = Gradient {
        du: Image::filled(width, height, 0.0),
        dv: Image::filled(width, height, 0.0),
        known: Image::filled(width, height, false),
    };
    let (value, weight) = (&value.pixels, &weight.pixels);
    let trusted = |index: usize| weight[index] >= TRUSTED_WEIGHT;
    for v in 1..height.saturating_sub(1) {
        for at in v * width + 1..((v + 1) * width).saturating_sub(1) {
            if trusted(at - 1) && trusted(at + 1) && trusted(at - width) && trusted(at + width) {
                found.du.pixels[at] = 0.5 * (value[at + 1] - value[at - 1]);
                found.dv.pixels[at] = 0.5 * (value[at + width] - value[at - width]);
                found.known.pixels[at] = true;
            }
        }
    }
    found
}

/// True where the whole (2·margin + 1)² neighbourhood is true; beyond the image counts as true.
pub(super) fn erode(image: &Image<bool>, margin: usize) -> Image<bool> {
    let (width, height) = (image.width, image.height);
    let window = |at: usize, end: usize| at.saturating_sub(margin)..(at + margin + 1).min(end);
    let mut across = image.clone();
    for v in 0..height {
        for u in 0..width {
            across.pixels[v * width + u] = window(u, width).all(|column| image.pixels[v * width + column]);
        }
    }
    let mut both = across.clone();
    for v in 0..height {
        for u in 0..width {
            both.pixels[v * width + u] = window(v, height).all(|row| across.pixels[row * width + u]);
        }
    }
    both
}

/// Median, and 1.4826 times the median absolute deviation (σ of a normal distribution).
pub(super) fn median_and_spread(values: &mut [f32]) -> Option<(f64, f64)> {
    let median = quantile(values, 0.5)?;
    values.iter_mut().for_each(|v| *v = (f64::from(*v) - median).abs() as f32);
    Some((median, 1.4826 * quantile(values, 0.5)?))
}

/// σ of a pixel from ½(a − b − c + d) over 2×2 blocks, which no plane affects; median based, so that edges do not count.
pub(super) fn noise(image: &Image<f32>, scored: &Image<bool>) -> Option<f64> {
    let width = image.width;
    let mut sizes: Vec<f32> = Vec::new();
    for v in 0..image.height.saturating_sub(1) {
        for u in 0..width.saturating_sub(1) {
            let at = v * width + u;
            let four = [at, at + 1, at + width, at + width + 1];
            if four.iter().all(|&i| scored.pixels[i]) {
                let [a, b, c, d] = four.map(|i| image.pixels[i]);
                sizes.push((0.5 * (a - b - c + d)).abs());
            }
        }
    }
    if sizes.len() < 200 {
        return None;
    }
    quantile(&mut sizes, 0.5).map(|median| 1.4826 * median)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::block_means;

    #[test]
    fn masked_pixels_leave_no_trace() {
        let mut image = Image::filled(40, 30, 2.0f32);
        let mut usable = Image::filled(40, 30, true);
        for u in 10..14 {
            *image.at_mut(u, 12) = f32::NAN;
            *usable.at_mut(u, 12) = false;
        }
        let smoothed = Kernel::on(&usable, 1.5, 1).smooth(&image, &usable);
        assert!(smoothed.pixels.iter().all(|v| (v - 2.0).abs() < 1e-5));
        // The control: the same hole, not masked, spoils its surroundings.
        let all = Image::filled(40, 30, true);
        let spoiled = Kernel::on(&all, 1.5, 1).smooth(&image, &all);
        assert!(spoiled.pixels.iter().any(|v| v.is_nan()));
    }

    #[test]
    fn a_gaussian_smooths_an_impulse_to_its_own_shape() {
        let mut image = Image::filled(41, 41, 0.0f32);
        *image.at_mut(20, 20) = 1.0;
        let all = Image::filled(41, 41, true);
        let smoothed = Kernel::on(&all, 2.0, 1).smooth(&image, &all);
        let second: f64 = (0..41).map(|u| f64::from(*smoothed.at(u, 20)) * (u as f64 - 20.0).powi(2)).sum();
        let mass: f64 = (0..41).map(|u| f64::from(*smoothed.at(u, 20))).sum();
        assert!((second / mass - 4.0).abs() < 0.15, "variance {}", second / mass);
    }

    #[test]
    fn fewer_places_have_the_same_means() {
        let pixels = (0..37 * 23).map(|at| ((at * 7919) % 101) as f32).collect();
        let image = Image::from_pixels(37, 23, pixels).expect("37x23");
        let usable = image.map(|v| *v > 9.0);
        for sigma_px in [0.8, 1.5, 6.0] {
            let all = Kernel::on(&usable, sigma_px, 1).smooth(&image, &usable);
            for stride in [2, 3] {
                let found = Kernel::on(&usable, sigma_px, stride).smooth(&image, &usable);
                assert_eq!([found.width, found.height], [37usize.div_ceil(stride), 23usize.div_ceil(stride)]);
                let expected = every(&all, stride);
                let worst = found.pixels.iter().zip(&expected.pixels).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(worst < 1e-4, "{worst} at sigma {sigma_px}, stride {stride}");
            }
        }
    }

    #[test]
    fn blocks_average_what_is_usable() {
        let image = Image::from_pixels(4, 2, vec![1.0, 3.0, 9.0, f32::NAN, 5.0, 7.0, f32::NAN, f32::NAN]).expect("4x2");
        let usable = image.map(|v| v.is_finite());
        let (means, kept) = block_means(&image, &usable, 2);
        assert_eq!(*means.at(0, 0), 4.0);
        assert_eq!(kept.pixels, [true, false]);
    }
}

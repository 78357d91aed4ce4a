//! Filters that never mix in masked pixels: normalised convolution, gradients, block means.

use rayon::prelude::*;

use super::convolution::{convolve, gaussian};
use crate::image::{Image, on_widest_vectors, quantile};

/// A pixel of a smoothed image is trusted when at least this share of its kernel lay on usable pixels.
pub(super) const TRUSTED_WEIGHT: f32 = 0.75;

/// A core takes at least so many pixels at a time, where each is for itself.
const FEWEST_PX: usize = 1 << 14;

/// A new image of `f(pixel)`, made by all cores.
pub(super) fn each<T: Sync, U: Send>(image: &Image<T>, f: impl Fn(&T) -> U + Sync + Send) -> Image<U> {
    let pixels = image.pixels.par_iter().with_min_len(FEWEST_PX).map(f).collect();
    Image { width: image.width, height: image.height, pixels }
}

/// What a normalised convolution reads of `image`: zeros where it is not usable. Values there (NaN included) are never read.
pub(super) fn kept(image: &Image<f32>, usable: &Image<bool>) -> Image<f32> {
    debug_assert!(image.same_size(usable), "images of one size");
    let keep = |(value, usable): (&f32, &bool)| if *usable { *value } else { 0.0 };
    let pixels = image.pixels.par_iter().zip(&usable.pixels).with_min_len(FEWEST_PX).map(keep).collect();
    Image { width: image.width, height: image.height, pixels }
}

/// 1 where `usable`, else 0: what a kernel's weight is made of.
pub(super) fn shares(usable: &Image<bool>) -> Image<f32> {
    each(usable, |usable| f32::from(u8::from(*usable)))
}

/// A Gaussian for normalised convolutions over one mask, at every pixel or at every so many of them each way.
pub(super) struct Kernel {
    taps: Vec<f32>,
    stride: usize,
    /// Share of the kernel that lies on usable pixels.
    pub weight: Image<f32>,
}

impl Kernel {
    pub(super) fn on(usable: &Image<bool>, sigma_px: f64, stride: usize) -> Self {
        Self::of(&shares(usable), sigma_px, stride)
    }

    /// The same, given the [`shares`] of the mask.
    pub(super) fn of(shares: &Image<f32>, sigma_px: f64, stride: usize) -> Self {
        let taps = gaussian(sigma_px);
        let weight = convolve(shares, &taps, stride);
        Self { taps, stride, weight }
    }

    /// The same, of a kernel at every pixel, at every `stride`-th.
    pub(super) fn at_every(&self, stride: usize) -> Self {
        Self { taps: self.taps.clone(), stride, weight: every(&self.weight, stride) }
    }

    /// Gaussian mean over usable pixels, the same as in [`Kernel::on`]; 0 where none is near.
    pub(super) fn smooth(&self, image: &Image<f32>, usable: &Image<bool>) -> Image<f32> {
        self.smooth_kept(&kept(image, usable))
    }

    /// The same of what was [`kept`] of an image.
    pub(super) fn smooth_kept(&self, kept: &Image<f32>) -> Image<f32> {
        let mut value = convolve(kept, &self.taps, self.stride);
        let pixels = value.pixels.par_iter_mut().zip(&self.weight.pixels).with_min_len(FEWEST_PX);
        pixels.for_each(|(v, &w)| *v = if w > 1e-3 { *v / w } else { 0.0 });
        value
    }
}

/// Every `stride`-th column and row, from the first.
pub(super) fn every<T: Copy>(image: &Image<T>, stride: usize) -> Image<T> {
    let (width, height) = (image.width.div_ceil(stride), image.height.div_ceil(stride));
    let mut pixels = Vec::with_capacity(width * height);
    let rows = image.pixels.chunks(image.width.max(1)).step_by(stride);
    rows.for_each(|row| pixels.extend(row.iter().step_by(stride)));
    Image { width, height, pixels }
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
    let long = width.max(1);
    let rows = found.du.pixels.par_chunks_mut(long).zip(found.dv.pixels.par_chunks_mut(long));
    rows.zip(found.known.pixels.par_chunks_mut(long)).enumerate().for_each(|(v, ((du, dv), known))| {
        if v == 0 || v + 1 >= height || width < 3 {
            return;
        }
        let inner = 1..width - 1;
        on_widest_vectors(Differences {
            du: &mut du[inner.clone()],
            dv: &mut dv[inner.clone()],
            known: &mut known[inner],
            value: neighbours(value, v),
            weight: neighbours(weight, v),
        });
    });
    found
}

/// Of the inner pixels of row `v`: those left, right, above and below.
fn neighbours(image: &Image<f32>, v: usize) -> [&[f32]; 4] {
    let width = image.width;
    let row = |v: usize| &image.pixels[v * width..][..width];
    [&row(v)[..width - 2], &row(v)[2..], &row(v - 1)[1..width - 1], &row(v + 1)[1..width - 1]]
}

/// The inner pixels of a row, and their [`neighbours`].
struct Differences<'a> {
    du: &'a mut [f32],
    dv: &'a mut [f32],
    known: &'a mut [bool],
    value: [&'a [f32]; 4],
    weight: [&'a [f32]; 4],
}

impl pulp::NullaryFnOnce for Differences<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [left, right, above, below] = self.weight;
        let weights = left.iter().zip(right).zip(above.iter().zip(below));
        for (known, ((left, right), (above, below))) in self.known.iter_mut().zip(weights) {
            // Without a branch at each of them these are vectors.
            *known =
                (*left >= TRUSTED_WEIGHT) & (*right >= TRUSTED_WEIGHT) & (*above >= TRUSTED_WEIGHT) & (*below >= TRUSTED_WEIGHT);
        }
        let [left, right, above, below] = self.value;
        for (out, from, to) in [(self.du, left, right), (self.dv, above, below)] {
            for ((out, known), (from, to)) in out.iter_mut().zip(self.known.iter()).zip(from.iter().zip(to)) {
                *out = if *known { 0.5 * (to - from) } else { 0.0 };
            }
        }
    }
}

/// True where the whole (2·margin + 1)² neighbourhood is true; beyond the image counts as true.
// A line is true where it has been so for more than `margin` pixels, and will be for as many: two sweeps tell it, however wide the margin.
pub(super) fn erode(image: &Image<bool>, margin: usize) -> Image<bool> {
    let (width, height) = (image.width, image.height);
    let long = width.max(1);
    let step = |is_true: bool, for_px: &mut usize, out: &mut bool| {
        *for_px = if is_true { *for_px + 1 } else { 0 };
        *out &= *for_px > margin;
    };
    let mut across = image.clone();
    across.pixels.par_chunks_mut(long).zip(image.pixels.par_chunks(long)).for_each(|(out, row)| {
        let mut for_px = margin;
        out.iter_mut().zip(row).for_each(|(out, is)| step(*is, &mut for_px, out));
        for_px = margin;
        out.iter_mut().zip(row).rev().for_each(|(out, is)| step(*is, &mut for_px, out));
    });
    let mut both = across.clone();
    let mut sweep = |rows: &mut dyn Iterator<Item = usize>| {
        let mut for_px = vec![margin; width];
        for v in rows {
            let (out, row) = (&mut both.pixels[v * width..][..width], &across.pixels[v * width..][..width]);
            out.iter_mut().zip(row).zip(&mut for_px).for_each(|((out, is), for_px)| step(*is, for_px, out));
        }
    };
    sweep(&mut (0..height));
    sweep(&mut (0..height).rev());
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
    let mut sizes = vec![0.0f32; image.pixels.len()];
    let mut count = 0;
    for v in 0..image.height.saturating_sub(1) {
        // Slices rather than indices: their ends are checked once a row.
        let [here, below] = [v, v + 1].map(|row| &image.pixels[row * width..][..width]);
        let [scored_here, scored_below] = [v, v + 1].map(|row| &scored.pixels[row * width..][..width]);
        let scored = scored_here.windows(2).zip(scored_below.windows(2));
        for ((above, under), (here, below)) in scored.zip(here.windows(2).zip(below.windows(2))) {
            // What is not scored is written over: which pixels are is not guessed at each of them.
            sizes[count] = (0.5 * (here[0] - here[1] - below[0] + below[1])).abs();
            count += usize::from(above[0] & above[1] & under[0] & under[1]);
        }
    }
    sizes.truncate(count);
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
    fn gradients_are_differences_where_all_four_neighbours_are_trusted() {
        for (width, height) in [(2, 9), (9, 2), (37, 23)] {
            let pixels = (0..width * height).map(|at| ((at * 7919) % 101) as f32 * 0.3).collect();
            let value = Image::from_pixels(width, height, pixels).expect("size");
            let weight = value.map(|v| {
                if *v > 3.0 {
                    TRUSTED_WEIGHT
                } else if *v > 2.0 {
                    f32::NAN
                } else {
                    0.7
                }
            });
            let found = gradient(&value, &weight);
            let mut known = 0;
            for (at, is_known) in found.known.pixels.iter().enumerate() {
                let (u, v) = (at % width, at / width);
                let inside = u > 0 && v > 0 && u + 1 < width && v + 1 < height;
                let sides = || [at - 1, at + 1, at - width, at + width];
                assert_eq!(*is_known, inside && sides().iter().all(|side| weight.pixels[*side] >= TRUSTED_WEIGHT), "{u}, {v}");
                let across = |from: usize, to: usize| if *is_known { 0.5 * (value.pixels[to] - value.pixels[from]) } else { 0.0 };
                let [du, dv] = if inside { [across(at - 1, at + 1), across(at - width, at + width)] } else { [0.0; 2] };
                assert_eq!([found.du.pixels[at], found.dv.pixels[at]].map(f32::to_bits), [du, dv].map(f32::to_bits), "{u}, {v}");
                known += usize::from(*is_known);
            }
            assert!((known > 300) == (width == 37), "{known} of {width}x{height}");
        }
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

    /// As the definition has it, pixel by pixel.
    #[test]
    fn what_is_eroded_has_nothing_false_within_the_margin() {
        let mut cases = 0;
        for (width, height) in [(1, 1), (1, 9), (9, 1), (23, 17)] {
            for every in [1, 2, 7, 40, 1000] {
                let pixels = (0..width * height).map(|at| (at * 7919 + 3) % 1009 % every != 0).collect();
                let image = Image::from_pixels(width, height, pixels).expect("size");
                for margin in [0, 1, 3, 30] {
                    let found = erode(&image, margin);
                    let near = |at: usize, end: usize| at.saturating_sub(margin)..(at + margin + 1).min(end);
                    for v in 0..height {
                        for u in 0..width {
                            let expected = near(v, height).all(|row| near(u, width).all(|column| *image.at(column, row)));
                            assert_eq!(*found.at(u, v), expected, "{width}x{height}, {every}, {margin}: {u}, {v}");
                            cases += usize::from(expected);
                        }
                    }
                }
            }
        }
        assert!(cases > 500, "{cases} pixels are left");
    }

    #[test]
    fn blocks_average_what_is_usable() {
        let image = Image::from_pixels(4, 2, vec![1.0, 3.0, 9.0, f32::NAN, 5.0, 7.0, f32::NAN, f32::NAN]).expect("4x2");
        let usable = image.map(|v| v.is_finite());
        let (means, kept) = block_means(&image, &usable, 2);
        assert_eq!(*means.at(0, 0), 4.0);
        assert_eq!(kept.pixels, [true, false]);
        // Whole blocks only, each half usable at least, of an image smaller than one as well.
        let image = Image { width: 11, height: 8, pixels: (0..88).map(|at| ((at * 37) % 29) as f32 * 0.1).collect() };
        let usable = image.map(|v| *v > 1.2);
        for factor in [1, 3, 5, 20] {
            let (means, kept) = block_means(&image, &usable, factor);
            assert_eq!([means.width, means.height], [11 / factor, 8 / factor].map(|size| size.max(1)));
            for at in 0..kept.pixels.len() {
                let (u, v) = (at % kept.width, at / kept.width);
                let block = image.part(&[u * factor..(u + 1) * factor, v * factor..(v + 1) * factor]);
                let values: Vec<f64> = block.pixels.iter().filter(|v| **v > 1.2).map(|v| f64::from(*v)).collect();
                let keeps = !values.is_empty() && 2 * values.len() >= block.pixels.len();
                let mean = (values.iter().fold(0.0, |sum, value| sum + value) / values.len() as f64) as f32;
                assert_eq!((kept.pixels[at], means.pixels[at].is_nan()), (keeps, !keeps), "{factor}: {u}, {v}");
                assert!(!keeps || means.pixels[at].to_bits() == mean.to_bits(), "{factor}: {u}, {v}");
            }
        }
    }
}

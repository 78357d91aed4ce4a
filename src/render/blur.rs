//! Gaussian blur of what is detected: of the focal spot before noise, of the scintillator with it.
//!
//! The kernel is the Gaussian at the pixels' centres, its width such that the variance of what it does to pixels is exactly t = σ² px²,
//! however narrow. From σ = 0.7 px on that is the Gaussian itself to 0.3 % of its variance, with its full width at half maximum and its modulation transfer function.
//! Borders are mirrored, so that flat stays flat.

use rayon::prelude::*;

use super::cpu::attenuate_spectrum::{Arriving, Signal};
use crate::geometry::View;
use crate::scene::model::Scene;

/// A core takes at least so many pixels at a time, where each is for itself.
pub(super) const FEWEST_PX: usize = 4096;

/// Full width at half maximum of a Gaussian over its σ: 2 √(2 ln 2).
pub const FWHM_PER_SIGMA: f64 = 2.354_820_045_030_949;

/// How the focal spot blurs an object in the middle of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FocalBlur {
    /// σ along columns' and rows' direction, in pixels.
    pub sigma_px: [f64; 2],
    /// Depth for which it holds.
    pub depth_mm: f64,
    /// The wider FWHM, in pixels, at the nearest and at the farthest corner of the scene.
    pub range_px: [f64; 2],
}

/// Blur of the focal spot on the detector; `None` for a point or when the middle of the scene is not between source and detector.
// A point at depth z shadows each part of the spot elsewhere: a spot of width w is drawn w (SDD − z)/z wide on the detector, that is
// w f (1/z − 1/SDD) pixels.
#[must_use]
pub fn focal_blur(scene: &Scene, view: &View) -> Option<FocalBlur> {
    let spot_mm = scene.beam.shape.focal_spot_mm;
    if spot_mm == [0.0; 2] {
        return None;
    }
    let (low, high) = scene.bounds_lps_mm()?;
    let sdd_mm = view.intrinsics.source_to_detector_mm(scene.detector.pitch_mm);
    let depth_of = |point| view.camera_from_lps.transform_point(point).z;
    let depth_mm = depth_of(0.5 * (low + high));
    if !(depth_mm > 1.0 && depth_mm < sdd_mm) {
        return None;
    }
    let per_mm = |focal_px: f64, depth_mm: f64| focal_px * (1.0 / depth_mm.clamp(1.0, sdd_mm) - 1.0 / sdd_mm);
    let focal_px = [view.intrinsics.fx, view.intrinsics.fy];
    let sigma_px = [0, 1].map(|axis| spot_mm[axis] / FWHM_PER_SIGMA * per_mm(focal_px[axis], depth_mm));
    let corner = |bits: u32| {
        let pick = |bit: u32, low: f64, high: f64| if bits >> bit & 1 == 0 { low } else { high };
        depth_of(glam::DVec3::new(pick(0, low.x, high.x), pick(1, low.y, high.y), pick(2, low.z, high.z)))
    };
    let depths: Vec<f64> = (0..8).map(corner).collect();
    let near = depths.iter().copied().fold(f64::INFINITY, f64::min);
    let far = depths.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let widest = |depth: f64| (spot_mm[0] * per_mm(focal_px[0], depth)).max(spot_mm[1] * per_mm(focal_px[1], depth));
    Some(FocalBlur { sigma_px, depth_mm, range_px: [widest(near), widest(far)] })
}

/// Blurs what arrives: intensities, not their logarithms, and with them the photons that noise is drawn from.
pub fn blur_signal(signal: &mut Signal, view: &View, sigma_px: [f64; 2]) {
    let size = view.size_px.map(|n| n as usize);
    blur_line_integral(&mut signal.line_integral, size, sigma_px);
    let sums = |f: fn([f64; 3]) -> f64| -> Vec<f64> {
        let one = |a: &Arriving| f([a.photon_fraction, a.mean_response, a.mean_square_response].map(f64::from));
        let mut field: Vec<f64> = signal.arriving.par_iter().with_min_len(FEWEST_PX).map(one).collect();
        blur(&mut field, size, sigma_px);
        field
    };
    let [photons, responses, squares] = [sums(|[n, ..]| n), sums(|[n, r, _]| n * r), sums(|[n, _, s]| n * s)];
    signal.arriving.par_iter_mut().enumerate().with_min_len(FEWEST_PX).for_each(|(pixel, arriving)| {
        let number = photons[pixel];
        arriving.photon_fraction = number as f32;
        if number > 0.0 {
            arriving.mean_response = (responses[pixel] / number) as f32;
            arriving.mean_square_response = (squares[pixel] / number) as f32;
        }
    });
}

/// Blurs exp(−line integral); +∞ stands for nothing. What is darker than e⁻⁷⁴⁵ and stays so keeps its value.
pub fn blur_line_integral(line_integral: &mut [f32], size: [usize; 2], sigma_px: [f64; 2]) {
    let intensity = |line: &f32| (-f64::from(*line)).exp();
    let mut field: Vec<f64> = line_integral.par_iter().with_min_len(FEWEST_PX).map(intensity).collect();
    blur(&mut field, size, sigma_px);
    line_integral.par_iter_mut().zip(&field).with_min_len(FEWEST_PX).for_each(|(line, intensity)| {
        if !(*intensity == 0.0) {
            *line = -intensity.ln() as f32;
        }
    });
}

/// Convolves `field` (row-major, columns × rows) with Gaussians along both axes.
pub fn blur(field: &mut [f64], [width, height]: [usize; 2], sigma_px: [f64; 2]) {
    if field.is_empty() {
        return;
    }
    if sigma_px[0] > 0.0 {
        let kernel = gaussian_kernel(sigma_px[0].powi(2));
        field.par_chunks_mut(width).for_each_init(Vec::new, |padded, row| blur_row(row, &kernel, padded));
    }
    if sigma_px[1] > 0.0 {
        let kernel = gaussian_kernel(sigma_px[1].powi(2));
        let source = field.to_vec();
        let line = |row: isize| &source[mirror(row, height) * width..][..width];
        field.par_chunks_mut(width).enumerate().for_each(|(row, out)| {
            out.iter_mut().zip(line(row as isize)).for_each(|(out, value)| *out = kernel[0] * value);
            for (distance, weight) in kernel.iter().enumerate().skip(1) {
                let (above, below) = (line(row as isize - distance as isize), line((row + distance) as isize));
                out.iter_mut().zip(above).zip(below).for_each(|((out, a), b)| *out += weight * (a + b));
            }
        });
    }
}

fn blur_row(row: &mut [f64], kernel: &[f64], padded: &mut Vec<f64>) {
    let reach = kernel.len() - 1;
    padded.clear();
    padded.extend((0..row.len() + 2 * reach).map(|i| row[mirror(i as isize - reach as isize, row.len())]));
    for (column, value) in row.iter_mut().enumerate() {
        let centre = column + reach;
        let sides = kernel.iter().enumerate().skip(1);
        *value = kernel[0] * padded[centre]
            + sides.map(|(distance, weight)| weight * (padded[centre - distance] + padded[centre + distance])).sum::<f64>();
    }
}

/// The index in 0..n that `at` mirrors to: … 1 0 | 0 1 … n−1 | n−1 n−2 …
pub fn mirror(at: isize, n: usize) -> usize {
    let folded = at.rem_euclid(2 * n as isize) as usize;
    if folded < n { folded } else { 2 * n - 1 - folded }
}

/// Variance from which on the Gaussian at pixels' centres has the variance of the Gaussian, to 1e-14 of it (Poisson summation).
const WIDE_PX2: f64 = 2.0;

/// G(0), G(1), … of the Gaussian kernel of variance `t` px², as far as they matter; G(0) + 2 Σ G(n) = 1.
#[must_use]
pub fn gaussian_kernel(t: f64) -> Vec<f64> {
    if t >= WIDE_PX2 {
        return gaussian_at_pixels(t);
    }
    let variance = |kernel: &[f64]| kernel.iter().enumerate().map(|(n, weight)| 2.0 * (n * n) as f64 * weight).sum::<f64>();
    // Narrow ones fall between the pixels: of all widths the one that gives the variance.
    let (mut low, mut high) = (1e-3, WIDE_PX2 + 1.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if variance(&gaussian_at_pixels(middle)) < t { low = middle } else { high = middle }
    }
    gaussian_at_pixels(high)
}

/// exp(−n² / 2w), normalised.
fn gaussian_at_pixels(w: f64) -> Vec<f64> {
    let reach = (8.5 * w.sqrt()).ceil() as usize + 2;
    let mut kernel: Vec<f64> = (0..=reach).map(|n| (-((n * n) as f64) / (2.0 * w)).exp()).collect();
    let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f64>();
    kernel.iter_mut().for_each(|weight| *weight /= sum);
    kernel
}

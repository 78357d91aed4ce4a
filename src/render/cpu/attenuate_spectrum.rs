//! Twin of `shaders/attenuate_spectrum.wgsl`: polychromatic Beer–Lambert per pixel (Eq. 6).

use rayon::prelude::*;

use super::integrate_density::Density;
use crate::image::on_widest_vectors;
use crate::render::spectrum::Bins;

/// What reaches the detector, per pixel.
#[derive(Clone, Debug, Default)]
pub struct Signal {
    /// −ln intensity, noise-free; no floor, 51.5 behind 20 cm of steel.
    pub line_integral: Vec<f32>,
    /// Σ φ T, mean response and mean squared response of the photons that arrive; empty unless noise asks for them.
    pub arriving: Vec<Arriving>,
}

/// Moments of the photons that arrive in a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct Arriving {
    /// Σ φ T.
    pub photon_fraction: f32,
    /// Mean r of them.
    pub mean_response: f32,
    /// Mean r² of them.
    pub mean_square_response: f32,
}

/// Pixels that are attenuated side by side.
const WIDE: usize = 16;
/// Pixels that one thread takes at a time.
const CHUNK: usize = 512;

/// Attenuates every pixel; `moments` asks for what noise needs.
// With d = min_k depth_k, Σ w_k exp(−depth_k) = exp(−d) Σ w_k exp(d − depth_k): the sum neither under- nor overflows and
// −ln of it is d − ln Σ.
#[must_use]
pub fn attenuate_spectrum(density: &Density, bins: &Bins, moments: bool) -> Signal {
    let pixels = density.valid.len();
    let materials = density.material_count;
    let mut line_integral = vec![0.0f32; pixels];
    let mut arriving = vec![Arriving::default(); if moments { pixels } else { 0 }];
    let work = |chunk: usize, line: &mut [f32], arriving: &mut [Arriving]| {
        let paths = &density.g_per_cm2[chunk * CHUNK * materials..][..line.len() * materials];
        on_widest_vectors(Chunk { paths, materials, bins, line, arriving });
    };
    if moments {
        let chunks = line_integral.par_chunks_mut(CHUNK).zip(arriving.par_chunks_mut(CHUNK)).enumerate();
        chunks.for_each(|(chunk, (line, arriving))| work(chunk, line, arriving));
    } else {
        line_integral.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, line)| work(chunk, line, &mut []));
    }
    Signal { line_integral, arriving }
}

/// Neighbouring pixels; `arriving` is empty where it is not asked for.
struct Chunk<'c> {
    paths: &'c [f32],
    materials: usize,
    bins: &'c Bins,
    line: &'c mut [f32],
    arriving: &'c mut [Arriving],
}

impl pulp::NullaryFnOnce for Chunk<'_> {
    type Output = ();

    // Plain loops over sixteen pixels: the compiler makes vectors of them, of the width that the caller allows.
    #[inline(always)]
    fn call(self) {
        let Self { paths, materials, bins, line, arriving } = self;
        let used = used(bins);
        let mut depth = vec![[0.0f32; WIDE]; used];
        let mut path = vec![[0.0f32; WIDE]; materials];
        for first in (0..line.len()).step_by(WIDE) {
            let count = WIDE.min(line.len() - first);
            let mut seen = [false; WIDE];
            let mut any = false;
            for (m, path) in path.iter_mut().enumerate() {
                for l in 0..count {
                    path[l] = paths[(first + l) * materials + m];
                    seen[l] |= path[l] != 0.0;
                    any |= path[l] != 0.0;
                }
            }
            if any {
                let smallest = optical_depths(&path, bins, &mut depth);
                let signal = if arriving.is_empty() {
                    let [signal] = weighted_sums([&bins.signal_weight], &depth, &smallest);
                    signal
                } else {
                    let weights = [&bins.signal_weight, &bins.photon_weight, &bins.square_weight].map(Vec::as_slice);
                    let [signal, photons, squares] = weighted_sums(weights, &depth, &smallest);
                    for l in 0..count {
                        arriving[first + l] = Arriving {
                            // e^-87 is the least normal number: of any photons that there may be, none is left.
                            photon_fraction: if smallest[l] > 87.0 { 0.0 } else { photons[l] * exp_of_negative(-smallest[l]) },
                            mean_response: signal[l] * bins.mean_response as f32 / photons[l],
                            mean_square_response: squares[l] / photons[l],
                        };
                    }
                    signal
                };
                for l in 0..count {
                    line[first + l] = if seen[l] { smallest[l] - ln(signal[l]) } else { 0.0 };
                }
            }
            if !arriving.is_empty() {
                for l in 0..count {
                    if !seen[l] {
                        arriving[first + l] = Arriving {
                            photon_fraction: 1.0,
                            mean_response: bins.mean_response as f32,
                            mean_square_response: bins.mean_square_response as f32,
                        };
                    }
                }
            }
        }
    }
}

/// Bins before the padding.
fn used(bins: &Bins) -> usize {
    let weights = [&bins.signal_weight, &bins.photon_weight, &bins.square_weight];
    // A NaN is no padding.
    let counts = |k: &usize| weights.iter().any(|weights| !(weights[*k] == 0.0));
    (0..bins.padded).rev().find(counts).map_or(1, |last| last + 1)
}

/// Fills `depth` with Σ_m (μ/ρ)_m L_m per bin and returns the smallest.
#[inline(always)]
fn optical_depths(path: &[[f32; WIDE]], bins: &Bins, depth: &mut [[f32; WIDE]]) -> [f32; WIDE] {
    let mut smallest = [f32::INFINITY; WIDE];
    for (k, depth) in depth.iter_mut().enumerate() {
        *depth = [0.0; WIDE];
        for (m, path) in path.iter().enumerate() {
            let mu = bins.cm2_per_g[m * bins.padded + k];
            for l in 0..WIDE {
                depth[l] += mu * path[l];
            }
        }
        for l in 0..WIDE {
            smallest[l] = if depth[l] < smallest[l] { depth[l] } else { smallest[l] };
        }
    }
    smallest
}

/// Σ w exp(smallest − depth) for `N` kinds of weights.
#[inline(always)]
fn weighted_sums<const N: usize>(weights: [&[f32]; N], depth: &[[f32; WIDE]], smallest: &[f32; WIDE]) -> [[f32; WIDE]; N] {
    let mut sums = [[0.0f32; WIDE]; N];
    for (k, depth) in depth.iter().enumerate() {
        let mut passed = [0.0f32; WIDE];
        for l in 0..WIDE {
            passed[l] = exp_of_negative(smallest[l] - depth[l]);
        }
        for (sums, weights) in sums.iter_mut().zip(&weights) {
            for l in 0..WIDE {
                sums[l] += weights[k] * passed[l];
            }
        }
    }
    sums
}

/// eˣ for x ≤ 0 to 2e-7 relative, without branches so that it vectorises; below −87 it is 1.6e-38.
// x = n ln 2 + f with |f| ≤ ½ ln 2; e^f is a polynomial (Taylor to the sixth power, remainder 1e-7), 2ⁿ goes into the exponent.
#[inline(always)]
pub(in crate::render) fn exp_of_negative(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0;
    let x = if x < -87.0 { -87.0 } else { x };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let f = (x - n * 0.693_359_4) + n * 2.121_944_4e-4;
    let p = 1.0 + f * (1.0 + f * (0.5 + f * (1.0 / 6.0 + f * (1.0 / 24.0 + f * (1.0 / 120.0 + f * (1.0 / 720.0))))));
    let exponent = (shifted.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32).wrapping_add(127);
    p * f32::from_bits((exponent << 23) as u32)
}

/// ln x for normal x > 0 to 1e-7 of max(1, |ln x|), without branches; NaN stays NaN.
// x = 2ⁿ m with m between √½ and √2; ln m = 2 artanh s with s = (m − 1) / (m + 1), |s| ≤ 0.172: five odd powers leave 4e-9.
#[inline(always)]
fn ln(x: f32) -> f32 {
    const HALF_ROOT: u32 = 0x3f35_04f3;
    let shifted = x.to_bits().wrapping_sub(HALF_ROOT);
    let n = (shifted as i32) >> 23;
    let m = f32::from_bits((shifted & 0x007f_ffff).wrapping_add(HALF_ROOT));
    let s = (m - 1.0) / (m + 1.0);
    let z = s * s;
    let series = 2.0 * s * (1.0 + z * (1.0 / 3.0 + z * (0.2 + z * (1.0 / 7.0 + z * (1.0 / 9.0)))));
    let found = n as f32 * std::f32::consts::LN_2 + series;
    if x.is_nan() { x } else { found }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_right_to_three_parts_in_ten_million() {
        let mut worst = 0.0f64;
        for i in 0..87_000 {
            let x = -(i as f32) * 1e-3;
            worst = worst.max((f64::from(exp_of_negative(x)) / f64::from(x).exp() - 1.0).abs());
        }
        assert!(worst < 3e-7, "{worst:e}");
        assert!(exp_of_negative(-1e9) < 1e-37);
    }

    #[test]
    fn the_logarithm_is_right_to_two_parts_in_ten_million() {
        let mut worst = 0.0f64;
        for i in 1..400_000 {
            let x = (-(f64::from(i) * 2e-4)).exp() as f32;
            let expected = f64::from(x).ln();
            worst = worst.max((f64::from(ln(x)) - expected).abs() / expected.abs().max(1.0));
        }
        assert!(worst < 2e-7, "{worst:e}");
        assert_eq!(ln(1.0), 0.0);
        assert!(ln(f32::NAN).is_nan());
    }

    #[test]
    fn air_between_pixels_that_see_something_stays_air() {
        let bins = Bins {
            padded: 8,
            signal_weight: vec![0.25, 0.75, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            photon_weight: vec![0.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            square_weight: vec![10.0, 20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            cm2_per_g: vec![0.3, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2],
            mean_response: 5.0,
            mean_square_response: 30.0,
        };
        let g_per_cm2: Vec<f32> = (0..37).map(|i| if i % 3 == 0 { 0.0 } else { i as f32 }).collect();
        let density = Density { material_count: 1, g_per_cm2, valid: vec![1; 37] };
        let signal = attenuate_spectrum(&density, &bins, true);
        for (pixel, path) in density.g_per_cm2.iter().enumerate() {
            let depth = [0.3, 0.2].map(|mu| f64::from(*path) * mu);
            let arriving = signal.arriving[pixel];
            let sum = |weights: [f64; 2]| weights[0] * (-depth[0]).exp() + weights[1] * (-depth[1]).exp();
            let line = -sum([0.25, 0.75]).ln();
            assert!((f64::from(signal.line_integral[pixel]) - line).abs() < 3e-7 * line.max(1.0), "{pixel}");
            assert!((f64::from(arriving.photon_fraction) / sum([0.5, 0.5]) - 1.0).abs() < 1e-6, "{pixel}");
            if *path == 0.0 {
                assert_eq!((signal.line_integral[pixel], arriving.mean_response), (0.0, 5.0));
            }
        }
    }
}

//! Twin of `shaders/attenuate_spectrum.wgsl`: polychromatic Beer–Lambert per pixel (Eq. 6).

use rayon::prelude::*;

use super::integrate_density::Density;
use crate::render::spectrum::{Bins, LANES};

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

/// Attenuates every pixel; `moments` asks for what noise needs.
// With d = min_k depth_k, Σ w_k exp(−depth_k) = exp(−d) Σ w_k exp(d − depth_k): the sum neither under- nor overflows and
// −ln of it is d − ln Σ.
#[must_use]
pub fn attenuate_spectrum(density: &Density, bins: &Bins, moments: bool) -> Signal {
    let pixels = density.valid.len();
    let materials = density.material_count;
    let mut line_integral = vec![0.0f32; pixels];
    let mut arriving = vec![Arriving::default(); if moments { pixels } else { 0 }];
    const CHUNK: usize = 4096;
    let air = Arriving {
        photon_fraction: 1.0,
        mean_response: bins.mean_response as f32,
        mean_square_response: bins.mean_square_response as f32,
    };
    let work = |first: usize, line: &mut [f32], mut arriving: Option<&mut [Arriving]>| {
        let mut depth = vec![0.0f32; bins.padded];
        for (index, line) in line.iter_mut().enumerate() {
            let pixel = first + index;
            let paths = &density.g_per_cm2[pixel * materials..(pixel + 1) * materials];
            if paths.iter().all(|path| *path == 0.0) {
                if let Some(arriving) = &mut arriving {
                    arriving[index] = air;
                }
                continue;
            }
            let smallest = optical_depth(paths, bins, &mut depth);
            let signal = weighted_sum(&bins.signal_weight, &depth, smallest);
            *line = smallest - signal.ln();
            if let Some(arriving) = &mut arriving {
                let photons = weighted_sum(&bins.photon_weight, &depth, smallest);
                let squares = weighted_sum(&bins.square_weight, &depth, smallest);
                arriving[index] = Arriving {
                    photon_fraction: photons * (-smallest).exp(),
                    mean_response: signal * bins.mean_response as f32 / photons,
                    mean_square_response: squares / photons,
                };
            }
        }
    };
    if moments {
        let chunks = line_integral.par_chunks_mut(CHUNK).zip(arriving.par_chunks_mut(CHUNK)).enumerate();
        chunks.for_each(|(chunk, (line, arriving))| work(chunk * CHUNK, line, Some(arriving)));
    } else {
        line_integral.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, line)| work(chunk * CHUNK, line, None));
    }
    Signal { line_integral, arriving }
}

/// Fills `depth` with Σ_m (μ/ρ)_m L_m per bin and returns the smallest.
fn optical_depth(paths: &[f32], bins: &Bins, depth: &mut [f32]) -> f32 {
    depth.fill(0.0);
    for (path, attenuation) in paths.iter().zip(bins.cm2_per_g.chunks_exact(bins.padded)) {
        if *path != 0.0 {
            depth.iter_mut().zip(attenuation).for_each(|(depth, mu)| *depth += mu * path);
        }
    }
    let mut smallest = [f32::INFINITY; LANES];
    for lanes in depth.chunks_exact(LANES) {
        for (s, d) in smallest.iter_mut().zip(lanes) {
            *s = if *d < *s { *d } else { *s };
        }
    }
    smallest.into_iter().fold(f32::INFINITY, f32::min)
}

/// Σ w exp(smallest − depth), eight lanes at a time.
fn weighted_sum(weights: &[f32], depth: &[f32], smallest: f32) -> f32 {
    let mut sums = [0.0f32; LANES];
    for (weights, depth) in weights.chunks_exact(LANES).zip(depth.chunks_exact(LANES)) {
        for lane in 0..LANES {
            sums[lane] += weights[lane] * exp_of_negative(smallest - depth[lane]);
        }
    }
    sums.iter().sum()
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
}

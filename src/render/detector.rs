//! From what arrives to what the detector says: photon numbers, noise that is correlated, counts.

use rayon::prelude::*;

use super::Quantity;
use super::cpu::attenuate_spectrum::Signal;
use super::spectrum::Bins;
use crate::geometry::View;
use crate::random::{Purpose, Stream};
use crate::scene::model::{Noise, Response, Scene};

/// N₀(u)/N₀ per pixel: (SDD/d)³, the obliquity of a flat detector under a point source.
#[must_use]
pub fn obliquity(view: &View) -> Vec<f32> {
    let [width, height] = view.size_px.map(|n| n as usize);
    let mut factor = vec![0.0f32; width * height];
    factor.par_chunks_mut(width).enumerate().for_each(|(row, factors)| {
        for (column, factor) in factors.iter_mut().enumerate() {
            let ray = view.intrinsics.unproject(glam::DVec2::new(column as f64, row as f64));
            *factor = ray.length().powi(-3) as f32;
        }
    });
    factor
}

/// N(u) = N₀(u) Σ φ T.
#[must_use]
pub fn expected_photons(scene: &Scene, signal: &Signal, obliquity: &[f32]) -> Vec<f32> {
    let n0 = scene.beam.photons_per_pixel;
    let number = |(arriving, factor): (&super::cpu::attenuate_spectrum::Arriving, &f32)| {
        (n0 * f64::from(*factor) * f64::from(arriving.photon_fraction)) as f32
    };
    signal.arriving.iter().zip(obliquity).map(number).collect()
}

/// Noise of `intensity`: quantum noise Ē·(Poisson(N) − N) / (N₀(u) Σφr), correlated by the crosstalk kernel, plus readout noise.
#[must_use]
pub fn intensity_noise(
    scene: &Scene,
    view: &View,
    bins: &Bins,
    signal: &Signal,
    deviates: &[f32],
    obliquity: &[f32],
    frame: u32,
) -> Vec<f32> {
    let [width, height] = view.size_px.map(|n| n as usize);
    let n0 = scene.beam.photons_per_pixel;
    let compound = scene.model.noise == Noise::True && scene.detector.response == Response::Energy;
    let quantum = |pixel: usize| {
        let arriving = signal.arriving[pixel];
        let mean = f64::from(arriving.mean_response);
        let per_photon = if compound { f64::from(arriving.mean_square_response).max(mean * mean).sqrt() } else { mean };
        (per_photon * f64::from(deviates[pixel]) / (n0 * f64::from(obliquity[pixel]) * bins.mean_response)) as f32
    };
    let field: Vec<f32> = (0..width * height).into_par_iter().with_min_len(4096).map(quantum).collect();
    let mut noise = correlated(&field, width, height, &scene.detector.crosstalk);
    if let Some(readout) = scene.detector.readout_noise {
        // First-order autoregression along the row: e_c = ρ e_{c−1} + √(1 − ρ²) z_c has unit variance everywhere.
        let fresh = (1.0 - readout.row_correlation.powi(2)).sqrt();
        noise.par_chunks_mut(width).enumerate().for_each(|(row, values)| {
            let mut error = 0.0;
            for (column, value) in values.iter_mut().enumerate() {
                let pixel = row * width + column;
                let z = Stream::new(scene.model.seed, frame, pixel as u32, Purpose::ReadoutNoise).normal();
                error = if column == 0 { z } else { readout.row_correlation * error + fresh * z };
                *value += (readout.sigma * error / f64::from(obliquity[pixel])) as f32;
            }
        });
    }
    noise
}

/// `field` convolved with an odd square kernel; mirrored at the borders, so that the variance there is that of the inside.
fn correlated(field: &[f32], width: usize, height: usize, kernel: &[Vec<f64>]) -> Vec<f32> {
    let size = kernel.len();
    if size <= 1 {
        return field.to_vec();
    }
    let reach = (size / 2) as isize;
    let mirror = |at: isize, n: usize| {
        let period = 2 * n as isize;
        let folded = at.rem_euclid(period);
        (if folded < n as isize { folded } else { period - 1 - folded }) as usize
    };
    let mut out = vec![0.0f32; field.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(row, values)| {
        for (column, value) in values.iter_mut().enumerate() {
            let mut sum = 0.0;
            for (dr, weights) in kernel.iter().enumerate() {
                let from_row = mirror(row as isize + dr as isize - reach, height) * width;
                for (dc, weight) in weights.iter().enumerate() {
                    sum += weight * f64::from(field[from_row + mirror(column as isize + dc as isize - reach, width)]);
                }
            }
            *value = sum as f32;
        }
    });
    out
}

/// The page of `quantity`; `noise` is empty when there is none.
#[must_use]
pub fn page(scene: &Scene, quantity: Quantity, line_integral: &[f32], noise: &[f32], bins: &Bins, obliquity: &[f32]) -> Vec<f32> {
    let n0 = scene.beam.photons_per_pixel;
    let intensity = |pixel: usize| {
        let clean = f64::from(-line_integral[pixel]).exp();
        clean + noise.get(pixel).map_or(0.0, |noise| f64::from(*noise))
    };
    let value = |pixel: usize| match quantity {
        Quantity::Intensity => intensity(pixel) as f32,
        Quantity::LineIntegral if noise.is_empty() => line_integral[pixel],
        // Not max, which would turn NaN into the floor.
        Quantity::LineIntegral => match intensity(pixel) {
            below if below < 0.5 / n0 => -(0.5 / n0).ln() as f32,
            seen => -seen.ln() as f32,
        },
        Quantity::Counts => {
            let signal = n0 * f64::from(obliquity[pixel]) * bins.mean_response * intensity(pixel);
            (scene.detector.gain * signal + scene.detector.offset) as f32
        }
        Quantity::AreaDensity => 0.0,
    };
    (0..line_integral.len()).into_par_iter().with_min_len(4096).map(value).collect()
}

//! From what arrives to what the detector says: photon numbers, noise that is correlated, counts.

use rayon::prelude::*;

use super::Quantity;
use super::blur::{FEWEST_PX, FWHM_PER_SIGMA, blur, blur_line_integral, mirror};
use super::cpu::attenuate_spectrum::Signal;
use super::flood::Flood;
use crate::geometry::View;
use crate::random::{Purpose, Stream};
use crate::scene::model::{Noise, ReadoutNoise, Response, Scene};

/// N(u) = N₀(u) Σ φ T.
#[must_use]
pub fn expected_photons(signal: &Signal, flood: &Flood) -> Vec<f32> {
    let n0 = flood.photons_per_pixel;
    let number = |(pixel, (arriving, factor)): (usize, (&super::cpu::attenuate_spectrum::Arriving, &f32))| {
        (n0 * f64::from(*factor) * flood.open(pixel) * f64::from(arriving.photon_fraction)) as f32
    };
    signal.arriving.par_iter().zip(&flood.photons).enumerate().with_min_len(FEWEST_PX).map(number).collect()
}

/// −ln of the noise-free intensity as the panel shows it: what arrives, times the open share, spread by the scintillator. +∞ where
/// nothing arrives.
#[must_use]
pub fn seen_line_integral(scene: &Scene, view: &View, arriving: &[f32], flood: &Flood) -> Vec<f32> {
    let close = |(pixel, line): (usize, &f32)| *line - flood.open(pixel).ln() as f32;
    let mut line: Vec<f32> = match flood.open.is_empty() {
        true => arriving.to_vec(),
        false => arriving.par_iter().enumerate().with_min_len(FEWEST_PX).map(close).collect(),
    };
    if scene.detector.panel.blur_fwhm_mm > 0.0 {
        blur_line_integral(&mut line, view.size_px.map(|n| n as usize), scintillator_sigma_px(scene, view));
    }
    line
}

/// σ of the spread of light along columns' and rows' direction.
pub(super) fn scintillator_sigma_px(scene: &Scene, view: &View) -> [f64; 2] {
    let sdd_mm = view.intrinsics.source_to_detector_mm(scene.detector.pitch_mm);
    let sigma_mm = scene.detector.panel.blur_fwhm_mm / FWHM_PER_SIGMA;
    [view.intrinsics.fx, view.intrinsics.fy].map(|focal_px| sigma_mm * focal_px / sdd_mm)
}

/// Noise of `intensity`: quantum noise Ē·(Poisson(N) − N) / (N₀(u) Σφr), correlated by scintillator and crosstalk, plus readout noise.
#[must_use]
pub fn intensity_noise(scene: &Scene, view: &View, flood: &Flood, signal: &Signal, deviates: &[f32], frame: u32) -> Vec<f32> {
    let [width, height] = view.size_px.map(|n| n as usize);
    let n0 = flood.photons_per_pixel;
    let compound = scene.model.noise == Noise::True && scene.detector.response == Response::Energy;
    let quantum = |pixel: usize| {
        let arriving = signal.arriving[pixel];
        let mean = f64::from(arriving.mean_response);
        let per_photon = if compound { f64::from(arriving.mean_square_response).max(mean * mean).sqrt() } else { mean };
        (per_photon * f64::from(deviates[pixel]) / (n0 * f64::from(flood.photons[pixel]) * flood.response(pixel))) as f32
    };
    let mut field: Vec<f32> = (0..width * height).into_par_iter().with_min_len(FEWEST_PX).map(quantum).collect();
    if scene.detector.panel.blur_fwhm_mm > 0.0 {
        let mut wide: Vec<f64> = field.iter().map(|value| f64::from(*value)).collect();
        blur(&mut wide, [width, height], scintillator_sigma_px(scene, view));
        field = wide.iter().map(|value| *value as f32).collect();
    }
    let mut noise = correlated(&field, width, height, &scene.detector.crosstalk);
    if let Some(readout) = scene.detector.readout_noise {
        read_out(readout, (scene.model.seed, frame), flood, width, &mut noise);
    }
    noise
}

/// Adds readout noise, keyed by (seed, frame), to the noise of an image so many pixels wide.
// First-order autoregression along the row: e_c = ρ e_{c−1} + √(1 − ρ²) z_c has unit variance everywhere.
pub(super) fn read_out(readout: ReadoutNoise, (seed, frame): (u64, u32), flood: &Flood, width: usize, noise: &mut [f32]) {
    let fresh = (1.0 - readout.row_correlation.powi(2)).sqrt();
    noise.par_chunks_mut(width).enumerate().for_each(|(row, values)| {
        let mut error = 0.0;
        for (column, value) in values.iter_mut().enumerate() {
            let pixel = row * width + column;
            let z = Stream::new(seed, frame, pixel as u32, Purpose::ReadoutNoise).normal();
            error = if column == 0 { z } else { readout.row_correlation * error + fresh * z };
            *value += (readout.sigma * error / flood.relative_signal(pixel)) as f32;
        }
    });
}

/// `field` convolved with an odd square kernel; mirrored at the borders, so that the variance there is that of the inside.
pub(super) fn correlated(field: &[f32], width: usize, height: usize, kernel: &[Vec<f64>]) -> Vec<f32> {
    let size = kernel.len();
    if size <= 1 {
        return field.to_vec();
    }
    let reach = (size / 2) as isize;
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

/// The page of `quantity` from [`seen_line_integral`]; `noise` is empty when there is none. Where no photon arrives, line integrals are
/// −ln 1/(2 N₀).
#[must_use]
pub fn page(scene: &Scene, quantity: Quantity, line_integral: &[f32], noise: &[f32], flood: &Flood) -> Vec<f32> {
    let floor = 0.5 / scene.beam.photons_per_pixel;
    let limits = limits(scene, flood.photons_per_pixel * flood.principal_response);
    let intensity = |pixel: usize| {
        let clean = f64::from(-line_integral[pixel]).exp();
        clean + noise.get(pixel).map_or(0.0, |noise| f64::from(*noise))
    };
    let is_whole = !noise.is_empty() && counts_by_itself(scene);
    let value = |pixel: usize| match quantity {
        Quantity::Intensity => intensity(pixel) as f32,
        Quantity::LineIntegral if noise.is_empty() => {
            let line = line_integral[pixel];
            if line == f32::INFINITY && flood.open(pixel) == 0.0 { -floor.ln() as f32 } else { line }
        }
        // Not max, which would turn NaN into the floor.
        Quantity::LineIntegral => match intensity(pixel) {
            below if below < floor => -floor.ln() as f32,
            seen => -seen.ln() as f32,
        },
        Quantity::Counts => {
            let air = flood.photons_per_pixel * f64::from(flood.photons[pixel]) * flood.response(pixel);
            let signal = air * intensity(pixel);
            counts(scene, if is_whole { whole(signal) } else { signal }, limits) as f32
        }
        Quantity::AreaDensity => 0.0,
    };
    (0..line_integral.len()).into_par_iter().with_min_len(FEWEST_PX).map(value).collect()
}

/// Whether the noise of a pixel is that of photons that it counted, and no other's.
fn counts_by_itself(scene: &Scene) -> bool {
    let detector = &scene.detector;
    let is_alone = detector.panel.blur_fwhm_mm == 0.0 && detector.crosstalk.len() <= 1 && detector.readout_noise.is_none();
    detector.response == Response::Counting && is_alone
}

/// The photons that were drawn: mean and deviate, apart in f32, add up to them but for rounding. NaN stays NaN.
fn whole(signal: f64) -> f64 {
    match signal.round() {
        none if none <= 0.0 => 0.0,
        photons => photons,
    }
}

/// gain · signal + offset, clipped and rounded as the panel does; NaN stays NaN.
fn counts(scene: &Scene, signal: f64, (lowest, highest): (f64, f64)) -> f64 {
    let detector = &scene.detector;
    let clipped = (detector.gain * signal + detector.offset).clamp(lowest, highest);
    if detector.panel.bits.is_some() { clipped.round() } else { clipped }
}

/// Fewest and most counts of a pixel: of `bits`, and of `saturation` times `air`, the unattenuated signal on the principal ray.
#[must_use]
pub fn limits(scene: &Scene, air: f64) -> (f64, f64) {
    let detector = &scene.detector;
    let full = detector.panel.saturation.map_or(f64::INFINITY, |most| detector.gain * most * air + detector.offset);
    match detector.panel.bits {
        Some(bits) => {
            let highest = f64::from(bits).exp2() - 1.0;
            (0.0, full.round().clamp(0.0, highest))
        }
        None => (f64::NEG_INFINITY, full),
    }
}

//! What an image intensifier makes of the picture on its input: distortion, round mask, veiling glare.
//!
//! Rays are cast on the undistorted raster. Each pixel of the frame looks up what arrives at its undistorted place, bilinearly in
//! intensity as light adds up, and collects photons in proportion to the area that it shows there: pincushion darkens the rim. Blur of
//! the panel, noise and counts come after, in the frame's own pixels; the glare is made of what they show.

use glam::DVec2;
use rayon::prelude::*;

use super::RenderError;
use super::blur::FEWEST_PX;
use super::cpu::attenuate_spectrum::{Arriving, Signal};
use super::flood::Flood;
use super::veil::spread;
use crate::geometry::{Intensifier, View};
use crate::scene::model::Scene;

/// The intensifier of `scene` for pictures of `view`'s size.
///
/// # Errors
/// When it was measured in another picture.
pub(super) fn of_view(scene: &Scene, view: &View) -> Result<Option<Intensifier>, RenderError> {
    let sized = scene.detector.panel.intensifier.as_ref().map(|intensifier| intensifier.for_size(view.size_px));
    sized.transpose().map_err(|error| RenderError::Intensifier { detail: error.to_string() })
}

/// Where a pixel of the frame looks: four pixels of the undistorted raster with their shares, and the area that it shows.
struct Look {
    pixels: [u32; 4],
    shares: [f32; 4],
    /// Undistorted pixels per pixel; 0 outside the disc or the raster.
    area: f32,
}

fn looks(intensifier: &Intensifier, [width, height]: [usize; 2]) -> Vec<Look> {
    let last = DVec2::new(width as f64 - 1.0, height as f64 - 1.0);
    let look = |index: usize| {
        let at = DVec2::new((index % width) as f64, (index / width) as f64);
        let there = intensifier.distortion.undistorted(at);
        let held = there.clamp(DVec2::ZERO, last);
        let on_raster = (there - held).abs().max_element() <= 0.5;
        let area =
            if intensifier.distortion.sees(at) && on_raster { intensifier.distortion.jacobian(at).determinant() } else { 0.0 };
        let low = held.floor();
        let share = held - low;
        let (column, row) = (low.x as usize, low.y as usize);
        let (right, below) = ((column + 1).min(width - 1), (row + 1).min(height - 1));
        Look {
            pixels: [row * width + column, row * width + right, below * width + column, below * width + right].map(|n| n as u32),
            shares: [(1.0 - share.x) * (1.0 - share.y), share.x * (1.0 - share.y), (1.0 - share.x) * share.y, share.x * share.y]
                .map(|share| share as f32),
            area: area as f32,
        }
    };
    (0..width * height).into_par_iter().with_min_len(FEWEST_PX).map(look).collect()
}

impl Look {
    fn weighed(&self) -> impl Iterator<Item = (usize, f64)> {
        self.pixels
            .iter()
            .zip(&self.shares)
            .filter(|(_, share)| **share > 0.0)
            .map(|(pixel, share)| (*pixel as usize, f64::from(*share)))
    }

    fn mean(&self, values: &[f32]) -> f32 {
        self.weighed().map(|(pixel, share)| share * f64::from(values[pixel])).sum::<f64>() as f32
    }

    /// −ln Σ w e^−l, from the least of them on, so that nothing is too dark.
    fn line_integral(&self, values: &[f32]) -> f32 {
        let least = self.weighed().map(|(pixel, _)| f64::from(values[pixel])).fold(f64::INFINITY, f64::min);
        if least == f64::INFINITY {
            return f32::INFINITY;
        }
        let sum: f64 = self.weighed().map(|(pixel, share)| share * (least - f64::from(values[pixel])).exp()).sum();
        (least - sum.ln()) as f32
    }

    fn arriving(&self, values: &[Arriving]) -> Arriving {
        let mut sums = [0.0; 3];
        for (pixel, share) in self.weighed() {
            let Arriving { photon_fraction, mean_response, mean_square_response } = values[pixel];
            let photons = share * f64::from(photon_fraction);
            let terms = [1.0, f64::from(mean_response), f64::from(mean_square_response)];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += photons * term);
        }
        let [photons, responses, squares] = sums;
        if !(photons > 0.0) {
            return Arriving { photon_fraction: photons as f32, ..values[self.pixels[0] as usize] };
        }
        let (mean_response, mean_square_response) = ((responses / photons) as f32, (squares / photons) as f32);
        Arriving { photon_fraction: photons as f32, mean_response, mean_square_response }
    }
}

/// Puts signal, flood and validity on the frame's own raster; what lies outside the disc is shut.
pub(super) fn distort(intensifier: &Intensifier, signal: &mut Signal, flood: &mut Flood, valid: &mut Vec<u8>) {
    let looks = looks(intensifier, intensifier.size_px.map(|n| n as usize));
    signal.line_integral =
        looks.par_iter().with_min_len(FEWEST_PX).map(|look| look.line_integral(&signal.line_integral)).collect();
    if !signal.arriving.is_empty() {
        signal.arriving = looks.par_iter().with_min_len(FEWEST_PX).map(|look| look.arriving(&signal.arriving)).collect();
    }
    let sees_valid = |look: &Look| u8::from(look.area > 0.0 && look.weighed().all(|(pixel, _)| valid[pixel] != 0));
    *valid = looks.par_iter().with_min_len(FEWEST_PX).map(sees_valid).collect();
    flood.resample(|values| looks.par_iter().with_min_len(FEWEST_PX).map(|look| look.mean(values)).collect());
    flood.photons.iter_mut().zip(&looks).filter(|(_, look)| look.area > 0.0).for_each(|(photons, look)| *photons *= look.area);
    if flood.open.is_empty() {
        flood.open = vec![1.0; looks.len()];
    }
    flood.open.iter_mut().zip(&looks).filter(|(_, look)| !(look.area > 0.0)).for_each(|(open, _)| *open = 0.0);
}

/// A mask of the undistorted raster on the frame's own: 1 where any of the pixels that are looked up is.
pub(super) fn shown(intensifier: &Intensifier, mask: &[u8]) -> Vec<u8> {
    let looks = looks(intensifier, intensifier.size_px.map(|n| n as usize));
    looks.iter().map(|look| u8::from(look.area > 0.0 && look.weighed().any(|(pixel, _)| mask[pixel] != 0))).collect()
}

/// Veils the picture: `line_integral` and `noise` become those of a frame over an air frame of the same intensifier, both with their
/// glare, so that air stays 1; `flood` takes on the air frame's brightness. The spread light carries no noise of its own.
pub(super) fn veil(intensifier: &Intensifier, line_integral: &mut [f32], noise: &mut [f32], flood: &mut Flood) {
    let Some(glare) = intensifier.glare else { return };
    let size = intensifier.size_px.map(|n| n as usize);
    let open = |pixel: usize| intensifier.distortion.sees(DVec2::new((pixel % size[0]) as f64, (pixel / size[0]) as f64));
    let air: Vec<f64> =
        (0..line_integral.len()).map(|pixel| if open(pixel) { flood.relative_signal(pixel) } else { 0.0 }).collect();
    let light: Vec<f64> = air.iter().zip(line_integral.iter()).map(|(air, line)| air * (-f64::from(*line)).exp()).collect();
    let (air_glare, glares) = (spread(&air, size, glare.scale_px), spread(&light, size, glare.scale_px));
    for pixel in 0..line_integral.len() {
        if !(air[pixel] > 0.0) {
            continue;
        }
        let direct = (1.0 - glare.fraction) * air[pixel];
        let bright = direct + glare.fraction * air_glare[pixel];
        let seen = (1.0 - glare.fraction) * light[pixel] + glare.fraction * glares[pixel];
        line_integral[pixel] = -(seen / bright).ln() as f32;
        if let Some(noise) = noise.get_mut(pixel) {
            *noise *= (direct / bright) as f32;
        }
        flood.brighten(pixel, bright / air[pixel]);
    }
}

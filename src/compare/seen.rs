//! An image as the scores see it: smoothed, differentiated and squared once for all of them.

use std::sync::OnceLock;

use super::filters::{Gradient, Kernel, TRUSTED_WEIGHT, gradient};
use crate::image::{Image, zip};

/// Gaussian σ of the window of SSIM, and of the smoothing before gradients are taken, in pixels.
pub const SCORE_SIGMA_PX: f64 = 1.5;
/// The band of the local NCC lies between Gaussians of these σ, in pixels; one fine image serves gradients, SSIM and the band.
pub const LOCAL_BAND_PX: [f64; 2] = [SCORE_SIGMA_PX, 6.0];
/// Gaussian σ of the window of the local NCC, in pixels.
pub const LOCAL_WINDOW_PX: f64 = 8.0;

/// Which pixels count, and how much of each smoothing kernel lies on them.
pub(super) struct Ground {
    pub usable: Image<bool>,
    /// Usable pixels at which what the fine kernel gives is trusted.
    pub known: Image<bool>,
    fine: Kernel,
    coarse: Kernel,
    window: Kernel,
}

impl Ground {
    pub(super) fn of(usable: Image<bool>) -> Self {
        let [fine, coarse] = LOCAL_BAND_PX.map(|sigma_px| Kernel::on(&usable, sigma_px));
        let known = zip(&fine.weight, &usable, |weight, usable| *usable && *weight >= TRUSTED_WEIGHT);
        let window = Kernel::on(&known, LOCAL_WINDOW_PX);
        Self { usable, known, fine, coarse, window }
    }

    /// Share of the fine kernel that lies on usable pixels.
    pub(super) fn fine_weight(&self) -> &Image<f32> {
        &self.fine.weight
    }

    /// Means of `image` in SSIM's windows.
    pub(super) fn in_fine_windows(&self, image: &Image<f32>) -> Image<f32> {
        self.fine.smooth(image, &self.usable)
    }

    /// Means of `band` in the local NCC's windows.
    pub(super) fn in_windows(&self, band: &Image<f32>) -> Image<f32> {
        self.window.smooth(band, &self.known)
    }
}

/// See the module.
pub(super) struct Seen<'a> {
    pub image: &'a Image<f32>,
    /// Mean of the usable pixels: second moments are taken about it, so that they do not cancel in f32.
    pub mean: f32,
    /// Smoothed with [`SCORE_SIGMA_PX`].
    pub fine: Image<f32>,
    /// Between the two σ of [`LOCAL_BAND_PX`].
    pub band: Image<f32>,
    /// `band`² in the local NCC's windows.
    pub band_power: Image<f32>,
    /// Of `fine`.
    pub gradient: Gradient,
    power: OnceLock<Image<f32>>,
}

impl<'a> Seen<'a> {
    pub(super) fn on(ground: &Ground, image: &'a Image<f32>) -> Self {
        let fine = ground.in_fine_windows(image);
        let coarse = ground.coarse.smooth(image, &ground.usable);
        let band = zip(&fine, &coarse, |fine, coarse| fine - coarse);
        let band_power = ground.in_windows(&zip(&band, &band, |a, b| a * b));
        let gradient = gradient(&fine, &ground.fine.weight);
        let (mut sum, mut count) = (0.0, 0usize);
        for (value, _) in image.pixels.iter().zip(&ground.usable.pixels).filter(|(_, usable)| **usable) {
            sum += f64::from(*value);
            count += 1;
        }
        let mean = (sum / count.max(1) as f64) as f32;
        Self { image, mean, fine, band, band_power, gradient, power: OnceLock::new() }
    }

    /// The second moment about `mean` in SSIM's windows.
    pub(super) fn power(&self, ground: &Ground) -> &Image<f32> {
        self.power.get_or_init(|| ground.in_fine_windows(&self.product(self)))
    }

    /// Product with `other`, each about its mean.
    pub(super) fn product(&self, other: &Self) -> Image<f32> {
        zip(self.image, other.image, |a, b| (a - self.mean) * (b - other.mean))
    }
}

//! An image as the scores see it: smoothed and differentiated once for all of them.

use super::filters::{Gradient, Kernel, gradient};
use crate::image::{Image, zip};

/// Gaussian σ of the window of SSIM, and of the smoothing before gradients are taken, in pixels.
pub const SCORE_SIGMA_PX: f64 = 1.5;
/// The band of the local NCC lies between Gaussians of these σ, in pixels; one fine image serves gradients, SSIM and the band.
pub const LOCAL_BAND_PX: [f64; 2] = [SCORE_SIGMA_PX, 6.0];

/// Which pixels count, and how much of each smoothing kernel lies on them.
pub(super) struct Ground<'a> {
    pub usable: &'a Image<bool>,
    fine: Kernel,
    coarse: Kernel,
}

impl<'a> Ground<'a> {
    pub(super) fn of(usable: &'a Image<bool>) -> Self {
        Self { usable, fine: Kernel::on(usable, LOCAL_BAND_PX[0]), coarse: Kernel::on(usable, LOCAL_BAND_PX[1]) }
    }

    /// The fine kernel.
    pub(super) fn fine(&self) -> &Kernel {
        &self.fine
    }
}

/// See the module.
pub(super) struct Seen<'a> {
    pub image: &'a Image<f32>,
    /// Smoothed with [`SCORE_SIGMA_PX`].
    pub fine: Image<f32>,
    /// Between the two σ of [`LOCAL_BAND_PX`].
    pub band: Image<f32>,
    /// Of `fine`.
    pub gradient: Gradient,
}

impl<'a> Seen<'a> {
    pub(super) fn on(ground: &Ground, image: &'a Image<f32>) -> Self {
        let fine = ground.fine.smooth(image, ground.usable);
        let coarse = ground.coarse.smooth(image, ground.usable);
        let band = zip(&fine, &coarse, |fine, coarse| fine - coarse);
        let gradient = gradient(&fine, &ground.fine.weight);
        Self { image, fine, band, gradient }
    }
}

//! An image as the scores see it: smoothed, differentiated and squared once for all of them.

use std::sync::OnceLock;

use super::filters::{Gradient, Kernel, TRUSTED_WEIGHT, every, gradient, kept, shares};
use crate::image::{Image, zip};

/// Gaussian σ of the window of SSIM, and of the smoothing before gradients are taken, in pixels.
pub const SCORE_SIGMA_PX: f64 = 1.5;
/// The band of the local NCC lies between Gaussians of these σ, in pixels; one fine image serves gradients, SSIM and the band.
pub const LOCAL_BAND_PX: [f64; 2] = [SCORE_SIGMA_PX, 6.0];
/// Gaussian σ of the window of the local NCC, in pixels.
pub const LOCAL_WINDOW_PX: f64 = 8.0;

/// The windows of SSIM and local NCC stand at every second column and row: their neighbours hold nearly the same.
pub(super) const WINDOW_STRIDE_PX: usize = 2;

/// No score of a pixel hears of anything further away: a window, and the coarser smoothing of what it holds, out to 3 σ.
pub(super) const REACH_PX: usize = (3.0 * (LOCAL_WINDOW_PX + LOCAL_BAND_PX[1])) as usize + 2;

/// Which pixels count, and how much of each smoothing kernel lies on them.
pub(super) struct Ground {
    pub usable: Image<bool>,
    /// Where windows stand: usable pixels at which what the fine kernel gives is trusted.
    pub known: Image<bool>,
    fine: Kernel,
    fine_windows: Kernel,
    coarse: Kernel,
    window: Kernel,
}

impl Ground {
    pub(super) fn of(usable: Image<bool>) -> Self {
        let [fine_px, coarse_px] = LOCAL_BAND_PX;
        let shares = shares(&usable);
        let fine = Kernel::of(&shares, fine_px, 1);
        let fine_windows = fine.at_every(WINDOW_STRIDE_PX);
        let coarse = Kernel::of(&shares, coarse_px, WINDOW_STRIDE_PX);
        let at_windows = every(&usable, WINDOW_STRIDE_PX);
        let known = zip(&fine_windows.weight, &at_windows, |weight, usable| *usable && *weight >= TRUSTED_WEIGHT);
        let window = Kernel::on(&known, LOCAL_WINDOW_PX / WINDOW_STRIDE_PX as f64, 1);
        Self { usable, known, fine, fine_windows, coarse, window }
    }

    /// Means of `image` in SSIM's windows.
    pub(super) fn in_fine_windows(&self, image: &Image<f32>) -> Image<f32> {
        self.fine_windows.smooth(image, &self.usable)
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
    /// Smoothed with [`SCORE_SIGMA_PX`], where windows stand.
    pub fine: Image<f32>,
    /// Between the two σ of [`LOCAL_BAND_PX`], where windows stand.
    pub band: Image<f32>,
    /// `band`² in the local NCC's windows.
    pub band_power: Image<f32>,
    /// Of the image smoothed with [`SCORE_SIGMA_PX`], at every pixel.
    pub gradient: Gradient,
    power: OnceLock<Image<f32>>,
}

impl<'a> Seen<'a> {
    pub(super) fn on(ground: &Ground, image: &'a Image<f32>) -> Self {
        let kept = kept(image, &ground.usable);
        let smooth = ground.fine.smooth_kept(&kept);
        let gradient = gradient(&smooth, &ground.fine.weight);
        let fine = every(&smooth, WINDOW_STRIDE_PX);
        let coarse = ground.coarse.smooth_kept(&kept);
        let band = zip(&fine, &coarse, |fine, coarse| fine - coarse);
        let band_power = ground.in_windows(&zip(&band, &band, |a, b| a * b));
        let (mut sum, mut count) = (0.0, 0usize);
        for (value, _) in image.pixels.iter().zip(&ground.usable.pixels).filter(|(_, usable)| **usable) {
            sum += f64::from(*value);
            count += 1;
        }
        let mean = (sum / count.max(1) as f64) as f32;
        Self { image, mean, fine, band, band_power, gradient, power: OnceLock::new() }
    }

    /// The second moment about `mean` in SSIM's windows, made by all cores when it is first asked for. Of an image that is scored several
    /// times side by side it must have been asked for before: a thread that makes it may be handed another score meanwhile, which would wait
    /// for it for ever.
    pub(super) fn power(&self, ground: &Ground) -> &Image<f32> {
        self.power.get_or_init(|| ground.in_fine_windows(&self.product(self)))
    }

    /// Product with `other`, each about its mean.
    pub(super) fn product(&self, other: &Self) -> Image<f32> {
        zip(self.image, other.image, |a, b| (a - self.mean) * (b - other.mean))
    }
}

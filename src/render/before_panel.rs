//! The scene as stated errors mean it: line integrals of what arrives, before the panel distorts, blurs, cuts or digitises it.

use crate::scene::model::{Noise, ScatterModel, Scene};

/// `scene` without noise, scatter, collimation, intensifier, and the blur of focal spot and scintillator; heel, bow-tie and the scintillator's absorption, which act on
/// each ray's spectrum, stay.
#[must_use]
pub fn before_panel(scene: &Scene) -> Scene {
    let mut before = scene.clone();
    before.model.noise = Noise::Off;
    before.model.scatter = ScatterModel::Off;
    before.beam.shape.field = None;
    before.beam.shape.focal_spot_mm = [0.0; 2];
    before.detector.panel.blur_fwhm_mm = 0.0;
    before.detector.panel.intensifier = None;
    before
}

/// Whether line integrals of `scene` are those of [`before_panel`].
#[must_use]
pub fn is_before_panel(scene: &Scene) -> bool {
    let (shape, panel) = (&scene.beam.shape, &scene.detector.panel);
    let spread = shape.focal_spot_mm != [0.0; 2] || panel.blur_fwhm_mm != 0.0 || panel.intensifier.is_some();
    let adds = scene.model.noise != Noise::Off || scene.model.scatter != ScatterModel::Off;
    !adds && shape.field.is_none() && !spread
}

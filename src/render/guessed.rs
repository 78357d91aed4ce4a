//! Pixels that show a guess: where a body of the specimen lay and has moved away, what fills its place was never scanned.

use super::RenderError;
use super::cpu::integrate_density::integrate_density;
use super::intensifier;
use super::plan::Sampling;
use super::volumes::VolumeCache;
use crate::image::Image;
use crate::scene::model::{Matter, Object, Scene};

/// Shorter paths through a filling are no guess that an image shows. Its density lies between that of fat and of muscle, 0.93 and
/// 1.06 g/cm³; it may be wrong by all of that, and 2 mm of it are then 0.005 nepers at 60 keV (0.2 cm²/g). Edges of voxels, which the
/// smallest motion leaves, stay below it too.
pub const LEAST_GUESSED_MM: f64 = 2.0;

/// 1 where a ray from the scene's view runs farther than [`LEAST_GUESSED_MM`] through what fills the places that bodies left; `None` where
/// none has moved.
///
/// # Errors
/// When the scene has no view, or the intensifier was measured in another picture.
pub fn guessed(scene: &Scene) -> Result<Option<Image<u8>>, RenderError> {
    let view = scene.view.ok_or(RenderError::NoView)?;
    if scene.bodies.filled.is_empty() {
        return Ok(None);
    }
    let filled = scene.bodies.filled.iter().map(|(_, shares)| shares.clone()).collect();
    let object = Object { name: "filled".to_owned(), body: String::new(), matter: Matter::Parts(filled) };
    let only = Scene { objects: vec![object], robot: None, ..scene.clone() };
    // A cache of its own: the scene's volumes stay prepared.
    let mut cache = VolumeCache::default();
    let paths = integrate_density(&cache.prepare(&only, view, false)?, Sampling::ExactCells);
    // Shares are densities: 1 g/cm² is 10 mm.
    let is_guess = |cm: &[f32]| u8::from(10.0 * cm.iter().map(|cm| f64::from(*cm)).sum::<f64>() > LEAST_GUESSED_MM);
    let mut pixels: Vec<u8> = paths.g_per_cm2.chunks_exact(paths.material_count.max(1)).map(is_guess).collect();
    if let Some(intensifier) = intensifier::of_view(scene, &view)? {
        pixels = intensifier::shown(&intensifier, &pixels);
    }
    let [width, height] = view.size_px.map(|n| n as usize);
    Ok(Some(Image { width, height, pixels }))
}

/// Share of the pixels that are guessed.
#[must_use]
pub fn guessed_share(guessed: &Image<u8>) -> f64 {
    guessed.pixels.iter().filter(|pixel| **pixel != 0).count() as f64 / guessed.pixels.len().max(1) as f64
}

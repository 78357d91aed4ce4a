//! What the shaders are asked for.

use crate::render::prepared::Prepared;
use crate::render::spectrum::Bins;

/// What to render of a view.
#[derive(Clone, Copy, Debug)]
pub struct Request<'p> {
    /// The scene, from the view.
    pub prepared: &'p Prepared<'p>,
    /// Energies; none for area densities alone.
    pub bins: Option<&'p Bins>,
    /// Noise to draw.
    pub noise: Option<NoiseKey>,
    /// g/cm² by material up to which the energies hold; empty where they hold everywhere.
    pub fitted_up_to: &'p [f64],
    /// Whether area densities are read back at once.
    pub paths: bool,
}

/// Noise to draw.
#[derive(Clone, Copy, Debug)]
pub struct NoiseKey {
    /// Seed.
    pub seed: u64,
    /// Frame.
    pub frame: u32,
    /// N₀.
    pub photons_per_pixel: f64,
}

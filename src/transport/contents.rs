//! What a box of space may hold: nothing, one material of one density, or things with bounds of what they have there.

use super::bounds::Range;

/// What a box of space holds.
#[derive(Clone, Debug, PartialEq)]
pub enum Content {
    /// Nothing.
    Empty,
    /// One material of one density, g/cm³, everywhere.
    Uniform {
        /// Scene material.
        material: u32,
        /// Its density.
        density: f64,
    },
    /// Whatever the things have at a point.
    Mixed(Mixture),
}

/// Things that may have matter in a box, and bounds of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Mixture {
    /// Indices of things, the scene's last first.
    pub things: Vec<u32>,
    /// Whether air that is kept has to be asked for.
    pub keeps_air: bool,
    /// Attenuation at any point is at most the largest of `to` · μ/ρ, and, if there is matter everywhere, at least the smallest of
    /// `from` · μ/ρ.
    pub ranges: Vec<Range>,
    /// Whether there is matter everywhere, none of it fading.
    pub is_full: bool,
}

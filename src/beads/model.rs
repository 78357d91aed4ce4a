//! The model of a shadow, and what a fit of it says.

use super::flags::Flags;
use super::profile::{MOST_NEPERS, Profile, SHAPES, Shape};

/// How a pixel's value depends on the path through metal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Model {
    /// Proportional to detected quanta.
    Transmission,
    /// Value goes up (`sign` 1) or down (−1) under metal by a profile of index `shape`.
    Additive {
        /// 1 or −1.
        sign: f64,
        /// Index into [`SHAPES`].
        shape: usize,
    },
}

/// Standard deviation of what is expected of a bead's nepers: where all that it stops is stopped by a few, more are not made up.
const NEPERS_SIGMA: f64 = 8.0;
/// Something brighter than its surroundings has less than no nepers; no more of these are tried.
const LEAST_NEPERS: f64 = -5.0;
/// By how much χ² must be less for a logarithm to be taken instead of what is proportional to quanta: with a blur of its own either follows the
/// other, at another radius.
const LOGARITHM_MARGIN: f64 = 4.0;

impl Model {
    /// Of a shadow of contrast c.
    pub fn shape(self, contrast: f64) -> Shape {
        match self {
            Self::Transmission => Shape::Flattened(contrast),
            Self::Additive { shape, .. } => SHAPES[shape.min(SHAPES.len() - 1)],
        }
    }

    /// `contrast`, no farther than it can be told.
    pub fn bounded(self, contrast: f64) -> f64 {
        match self {
            Self::Transmission => contrast.clamp(LEAST_NEPERS, MOST_NEPERS),
            Self::Additive { .. } => contrast,
        }
    }

    /// Weight against a contrast, for what is known of metal beforehand.
    pub fn contrast_weight(self) -> f64 {
        match self {
            Self::Transmission => NEPERS_SIGMA.powi(-2),
            Self::Additive { .. } => 0.0,
        }
    }

    /// What a shadow of this blur (in radii) has in its middle: nepers for transmission, else the image's unit.
    pub fn depth(self, contrast: f64, beta: f64) -> f64 {
        let value = Profile::new(self.shape(contrast), beta).at(0.0).value;
        match self {
            Self::Transmission => -Stopped::of(contrast).left(value).ln(),
            Self::Additive { .. } => contrast * value,
        }
    }

    /// By how much χ² must be less for it to be taken instead of another.
    pub fn margin(self) -> f64 {
        match self.shape(0.0) {
            Shape::Flattened(_) => 0.0,
            Shape::Logarithm(_) => LOGARITHM_MARGIN,
        }
    }
}

/// What metal of some nepers stops and lets pass in the middle of a bead without blur.
#[derive(Clone, Copy, Debug)]
pub struct Stopped {
    /// 1 − e^(−c).
    pub share: f64,
    /// e^(−c).
    pub passes: f64,
}

impl Stopped {
    /// By a contrast c.
    pub fn of(contrast: f64) -> Self {
        Self { share: -(-contrast).exp_m1(), passes: (-contrast).exp() }
    }

    /// What is left of the light where the profile is `value`: no less than without blur, whatever the table's rounding.
    #[inline(always)]
    pub fn left(self, value: f64) -> f64 {
        (1.0 - self.share * value).max(self.passes.min(1.0))
    }
}

/// A fitted shadow.
#[derive(Clone, Copy, Debug)]
pub struct Fit {
    pub model: Model,
    pub u_px: f64,
    pub v_px: f64,
    pub radius_px: f64,
    /// Standard deviation of the radius' logarithm, see [`super::radius_sigma`].
    pub radius_sigma_ln: f64,
    pub blur_px: f64,
    /// c: nepers for transmission, else the image's unit.
    pub contrast: f64,
    /// What of it the blur leaves in the middle: this the picture shows, while c of thick metal is as good as any.
    pub depth: f64,
    /// How sure it is that a shadow is there: its depth over its standard deviation, form and size taken as known.
    pub snr: f64,
    /// Covariance of (u, v) for the noise's correlation and for structure under the shadow.
    pub covariance_px2: [[f64; 2]; 2],
    /// Weighted square residual per degree of freedom.
    pub chi2_per_dof: f64,
    /// Degrees of freedom.
    pub dof: f64,
    /// Structure left in the residual, as a share of the shadow's depth.
    pub misfit: f64,
    /// Share of the window that could be used.
    pub coverage: f64,
    /// Standard deviation of the centre per axis from structure.
    pub structure_px: f64,
    /// What can be told from the fit alone.
    pub flags: Flags,
}

impl Fit {
    /// Whether nothing speaks for `other`, fitted to the same pixels, instead of it.
    pub fn is_as_good_as(&self, other: &Self) -> bool {
        self.chi2_per_dof <= other.chi2_per_dof + other.model.margin() / other.dof
    }
}

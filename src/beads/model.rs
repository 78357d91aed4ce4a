//! The model of a shadow, and what a fit of it says.

use super::flags::Flags;
use super::profile;

/// How a pixel's value depends on the path through metal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Model {
    /// Proportional to detected quanta.
    Transmission,
    /// Value goes up (`sign` 1) or down (−1) under metal by a profile of index `shape`.
    Additive {
        /// 1 or −1.
        sign: f64,
        /// Index into [`profile::SHAPES`].
        shape: usize,
    },
}

impl Model {
    /// Index into [`profile::SHAPES`].
    pub fn shape(self) -> usize {
        match self {
            Self::Transmission => 0,
            Self::Additive { shape, .. } => shape.min(profile::SHAPES.len() - 1),
        }
    }
}

/// A fitted shadow.
#[derive(Clone, Copy, Debug)]
pub struct Fit {
    pub model: Model,
    pub u_px: f64,
    pub v_px: f64,
    pub radius_px: f64,
    pub blur_px: f64,
    /// c: nepers for transmission, else the image's unit.
    pub contrast: f64,
    /// c over its standard deviation, radius and blur taken as known.
    pub snr: f64,
    /// Covariance of (u, v) for the noise's correlation and for structure under the shadow.
    pub covariance_px2: [[f64; 2]; 2],
    /// Weighted square residual per degree of freedom.
    pub chi2_per_dof: f64,
    /// Structure left in the residual, as a share of the shadow's depth.
    pub misfit: f64,
    /// Share of the window that could be used.
    pub coverage: f64,
    /// Standard deviation of the centre per axis from structure.
    pub structure_px: f64,
    /// What can be told from the fit alone.
    pub flags: Flags,
}

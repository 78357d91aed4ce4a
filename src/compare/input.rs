//! What is compared, and why it may not be.

use glam::{DVec2, DVec3};

use super::domain::{AirContradiction, AirLevel};
use super::pedestal::OffsetRule;
use super::tone::Tone;
use crate::acquire::{Domain, Frame};
use crate::geometry::View;
use crate::image::Image;
use crate::mask::Masks;

/// Why two images are not compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CompareError {
    /// The acquired frame is not a whole number of times larger than the simulated image.
    #[error(
        "sizes differ: {name} is {acquired:?} px, the simulated image {simulated:?}; render at the frame's size or a whole fraction of it"
    )]
    Size {
        /// The frame.
        name: String,
        /// Columns and rows.
        acquired: [usize; 2],
        /// Columns and rows.
        simulated: [usize; 2],
    },
    /// A mask has another size than the simulated image.
    #[error("{what} mask is {found:?} px, the simulated image {expected:?}")]
    MaskSize {
        /// Which mask.
        what: &'static str,
        /// Columns and rows.
        found: [usize; 2],
        /// Columns and rows.
        expected: [usize; 2],
    },
    /// A declared air level that the frame itself contradicts.
    #[error(transparent)]
    AirLevel(#[from] AirContradiction),
    /// Too little is left to score.
    #[error("{left:.1} % of the image is left after masking, {required:.0} % are required ({causes})")]
    TooLittleLeft {
        /// Percent.
        left: f64,
        /// Percent.
        required: f64,
        /// Share by cause.
        causes: String,
    },
    /// A tone that this domain does not permit.
    #[error("tone {} does not suit domain {domain}: it permits {permitted}", tone.as_str())]
    ToneNotPermitted {
        /// Declared.
        tone: Tone,
        /// Of the frame.
        domain: Domain,
        /// Words.
        permitted: &'static str,
    },
    /// The images do not determine the tone.
    #[error("tone {} cannot be fitted: the simulated image is nearly constant where it is not masked", tone.as_str())]
    ToneUndetermined {
        /// Declared.
        tone: Tone,
    },
}

/// Two images to compare, and what is known about them.
#[derive(Clone, Copy, Debug)]
pub struct CompareInput<'a> {
    /// As acquired. May be a whole number of times larger than the simulated image; it is binned then.
    pub acquired: &'a Frame,
    /// Simulated line integral, nepers; NaN where it cannot be known.
    pub simulated_line_integral: &'a Image<f32>,
    /// 1 where the simulation is valid.
    pub valid: Option<&'a Image<u8>>,
    /// 1 where the simulation shows a guess: what fills the place that a body left.
    pub guessed: Option<&'a Image<u8>>,
    /// What the frame alone masks, where it was found before.
    pub masks: Option<&'a Masks>,
    /// True: leave out. At the simulated image's size, or at the acquired frame's.
    pub extra_mask: Option<&'a Image<bool>>,
    /// True: the robot or a tool, scored apart.
    pub tool: Option<&'a Image<bool>>,
    /// Centre and radius of the beads in the simulated image, px.
    pub beads: &'a [(DVec2, f64)],
    /// What may be fitted.
    pub tone: Tone,
    /// How the air level is known.
    pub air: AirLevel,
    /// How the stored value without X-rays is known, for linear frames.
    pub offset: OffsetRule,
    /// The view of the simulated image: gives edge distances in mm, and the null.
    pub view: Option<&'a View>,
    /// Centroid of the beads, else the centre of the specimen.
    pub centre_lps_mm: Option<DVec3>,
}

impl<'a> CompareInput<'a> {
    /// Nothing but the two images: no tone, air level from open air.
    #[must_use]
    pub fn new(acquired: &'a Frame, simulated_line_integral: &'a Image<f32>) -> Self {
        Self {
            acquired,
            simulated_line_integral,
            valid: None,
            guessed: None,
            masks: None,
            extra_mask: None,
            tool: None,
            beads: &[],
            tone: Tone::None,
            air: AirLevel::Open,
            offset: OffsetRule::Shutters,
            view: None,
            centre_lps_mm: None,
        }
    }
}

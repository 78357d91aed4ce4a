//! Why frames of a grid give no calibration.

use crate::geometry::{DistortionError, IntensifierError};

/// Why frames of a grid give no calibration.
#[derive(Debug, thiserror::Error)]
pub enum IntensifierFault {
    /// No frame at all.
    #[error("there is no frame of the grid: give one at least")]
    NoFrames,
    /// Frames differ.
    #[error("{frame} has {found:?} px, the first frame {expected:?}: give frames of one size")]
    Sizes {
        /// Which.
        frame: String,
        /// Its size.
        found: [usize; 2],
        /// The first frame's.
        expected: [usize; 2],
    },
    /// Two frames were taken at one angle.
    #[error("{frame} and {other} were both taken at orbital {:.2}°, angulation {:.2}°: give one frame for each angle", angles_deg[0], angles_deg[1])]
    SameAngle {
        /// One.
        frame: String,
        /// The other.
        other: String,
        /// Their angle.
        angles_deg: [f64; 2],
    },
    /// An angle is missing.
    #[error(
        "{frame}: the angle of the C-arm is not stated: with several frames give --angles, or DICOM files with both positioner angles"
    )]
    NoAngle {
        /// Which frame.
        frame: String,
    },
    /// No grid.
    #[error(
        "{frame}: of {spots} spots {named} lie on a square grid, {required} are needed: are these beads or holes (--holes), in focus and 8 px apart or more?"
    )]
    NoGrid {
        /// Which frame.
        frame: String,
        /// Found.
        spots: usize,
        /// Named.
        named: usize,
        /// Fewest.
        required: usize,
    },
    /// The distortion cannot be inverted.
    #[error("{frame}: {source}")]
    Distortion {
        /// Which frame.
        frame: String,
        /// What is wrong.
        source: DistortionError,
    },
    /// The glare frame does not show what it should.
    #[error("{frame}: {why}")]
    Glare {
        /// Which frame.
        frame: String,
        /// What is missing.
        why: String,
    },
    /// The result is no calibration.
    #[error(transparent)]
    Calibration(#[from] IntensifierError),
}

//! Why frames of a grid, or of a bead phantom, give no calibration.

use crate::estimate::EstimateError;
use crate::geometry::{DistortionError, IntensifierError};

/// Why frames of a grid, or of a bead phantom, give no calibration.
#[derive(Debug, thiserror::Error)]
pub enum IntensifierFault {
    /// No frame at all.
    #[error("there is no frame of the grid or the phantom: give one at least")]
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
    /// The layout cannot be used.
    #[error("the bead layout cannot be used: {detail}")]
    Layout {
        /// What is wrong with it.
        detail: String,
    },
    /// The phantom has hardly any beads.
    #[error("the bead layout has {found} beads, {required} are needed: 24 and more, spread over the disc, are better")]
    SmallLayout {
        /// In the layout.
        found: usize,
        /// Needed.
        required: usize,
    },
    /// The phantom is a plate.
    #[error(
        "the bead layout is flat: {third_mm:.1} mm deep (standard deviation) where it is {first_mm:.1} mm wide, {required_mm:.1} mm are needed: distortion cannot be told from its tilt; use beads in depth, or a square grid without --beads"
    )]
    FlatLayout {
        /// Standard deviation along the longest axis.
        first_mm: f64,
        /// Along the shortest.
        third_mm: f64,
        /// Needed there.
        required_mm: f64,
    },
    /// No frame shows the phantom.
    #[error(
        "in none of {frames} frames were the {beads} beads of the layout recognised ({shadows} round shadows at most): are these frames of this phantom, and K and the pitch those of the undistorted picture? --prior POSE.json for each frame says where to look"
    )]
    NotRecognised {
        /// Given.
        frames: usize,
        /// Of the layout.
        beads: usize,
        /// In the frame that has most.
        shadows: usize,
    },
    /// The beads leave the polynomial open.
    #[error(
        "{frame}: {found} shadows of beads in {frames} frames at this angle, order {order} needs {required}: add frames with the phantom moved, or give a lower --order"
    )]
    TooFewBeads {
        /// The first frame at this angle.
        frame: String,
        /// Frames in which the phantom was recognised.
        frames: usize,
        /// Shadows in all of them.
        found: usize,
        /// Of the polynomial.
        order: usize,
        /// Needed.
        required: usize,
    },
    /// The equations have no solution.
    #[error(
        "{frame}: poses and distortion cannot be solved ({source}): add frames with the phantom moved, or give a lower --order"
    )]
    Unsolved {
        /// The first frame at this angle.
        frame: String,
        /// What is wrong.
        source: EstimateError,
    },
    /// The beads do not agree.
    #[error(
        "{frame}: beads that the fit has not seen are {rms_px:.2} px off, at most {limit_px:.2} px are believed: check the layout, K and the pitch"
    )]
    Contradicted {
        /// The first frame at this angle.
        frame: String,
        /// Rms of held-out beads.
        rms_px: f64,
        /// Believed.
        limit_px: f64,
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

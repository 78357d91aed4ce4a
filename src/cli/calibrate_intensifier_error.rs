//! Why `sidecarm calibrate intensifier` gives no calibration.

use std::path::PathBuf;

use crate::acquire::AcquireError;
use crate::beads::BeadsError;
use crate::calibrate::intensifier::IntensifierFault;
use crate::image::ImageFileError;
use crate::pose::PoseFileError;

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateIntensifierError {
    /// A frame cannot be read.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// The frames give no calibration.
    #[error(transparent)]
    Intensifier(#[from] IntensifierFault),
    /// The bead layout cannot be read.
    #[error(transparent)]
    Beads(#[from] BeadsError),
    /// K or a prior cannot be read.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// K is for other frames.
    #[error(
        "{path}: K is for {expected:?} px, the frames have {found:?} px, which is no whole binning of it: give K for frames of that size",
        path = path.display()
    )]
    Size {
        /// The file of K.
        path: PathBuf,
        /// What it says.
        expected: [u32; 2],
        /// The frames'.
        found: [u32; 2],
    },
    /// Nobody knows the side of a pixel.
    #[error("{path}: has no pitch_mm, and the frames do not state it: add the side of an undistorted pixel", path = path.display())]
    NoPitch {
        /// The file of K.
        path: PathBuf,
    },
    /// Priors and frames do not pair.
    #[error("{priors} priors are given for {frames} frames; give one --prior for each frame in its order, or none")]
    Priors {
        /// How many priors.
        priors: usize,
        /// How many frames.
        frames: usize,
    },
    /// The output.
    #[error(transparent)]
    Output(#[from] ImageFileError),
    /// A number that was typed.
    #[error("{option} is {found}, expected {expected}")]
    Option {
        /// As typed.
        option: &'static str,
        /// Found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// The list of angles.
    #[error("{path}: {detail}; expected [{{\"frame\": \"FILE\", \"orbital_deg\": 0, \"angulation_deg\": 0}}, …]", path = path.display())]
    Angles {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
}

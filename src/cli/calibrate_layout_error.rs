//! Why shots of a phantom gave no layout.

use std::path::PathBuf;

use super::calibrate_carm::CalibrateCarmError;
use crate::acquire::AcquireError;
use crate::calibrate::phantom::PhantomRefusal;
use crate::image::ImageFileError;
use crate::pose::PoseFileError;

/// Why there is no layout.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateShotsError {
    /// A frame.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// K, or a prior.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// The table of joints.
    #[error(transparent)]
    Joints(#[from] CalibrateCarmError),
    /// The arm.
    #[error("{path}: {detail}", path = path.display())]
    Arm {
        /// Its file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// Images alone are not enough.
    #[error(
        "nothing says where the cameras were: images alone tell neither the scale nor, safely, which shadow is which bead; give --joints with --calibration, or one --prior per shot"
    )]
    NoCameras,
    /// A shot without joints.
    #[error("{shot}: there are no joints of it; add a line `{shot},…` to the table of --joints")]
    NoJoints {
        /// The frame's name without its ending.
        shot: String,
    },
    /// A shot whose joints give no camera.
    #[error("{shot}: {detail}")]
    Camera {
        /// Which.
        shot: String,
        /// What is missing.
        detail: String,
    },
    /// Priors and shots do not pair.
    #[error("{priors} priors are given for {shots} shots; give one --prior for each shot in its order")]
    Priors {
        /// How many priors.
        priors: usize,
        /// How many shots.
        shots: usize,
    },
    /// K or arm of another frame size.
    #[error("{shot} is {} x {} px, {of} is for {} x {}: give that of this frame size", found[0], found[1], expected[0], expected[1])]
    Size {
        /// Which.
        shot: String,
        /// What is for another size.
        of: &'static str,
        /// Its size.
        found: [u32; 2],
        /// What it is for.
        expected: [u32; 2],
    },
    /// No K.
    #[error("{shot}: no --intrinsics, and no SID with pixel spacing in the header: nothing tells K")]
    NoIntrinsics {
        /// Which.
        shot: String,
    },
    /// The output has an ending that Slicer does not open.
    #[error("{path}: the point list ends in .mrk.json, as 3D Slicer expects", path = path.display())]
    Extension {
        /// The output.
        path: PathBuf,
    },
    /// What was typed.
    #[error("{option} is {found}, expected {expected}")]
    Option {
        /// As typed.
        option: &'static str,
        /// Found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// The shots do not tell.
    #[error(transparent)]
    Refused(#[from] PhantomRefusal),
    /// An output.
    #[error(transparent)]
    Output(#[from] ImageFileError),
}

//! Why `calibrate robot` gave nothing.

use std::path::PathBuf;

use super::shot_files::OutOfRange;
use crate::acquire::AcquireError;
use crate::calibrate::robot::RobotFitError;
use crate::image::ImageFileError;
use crate::image::plot::PlotError;
use crate::pose::PoseFileError;
use crate::record::RecordError;
use crate::scene::SceneError;
use crate::session::SessionError;

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateRobotError {
    /// A pose file.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// A frame.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// A log.
    #[error(transparent)]
    Log(#[from] RecordError),
    /// A log's session.
    #[error(transparent)]
    Session(#[from] SessionError),
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The table of angles, or the tracker's tie.
    #[error("{path}: {detail}", path = path.display())]
    Input {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// A pose without frame and angles.
    #[error("{shot}: nothing says its frame and control angles; add a line `{shot},…` to the table of --angles")]
    NoAngles {
        /// Name of the pose file, without its ending.
        shot: String,
    },
    /// A number that was typed.
    #[error(transparent)]
    Option(#[from] OutOfRange),
    /// The shots.
    #[error(transparent)]
    Fit(#[from] RobotFitError),
    /// The plot.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// An output.
    #[error(transparent)]
    Output(#[from] ImageFileError),
}

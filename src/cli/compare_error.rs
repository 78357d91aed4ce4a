//! Why a comparison cannot be made.

use std::path::PathBuf;

use super::compare_origin::OriginError;
use crate::acquire::{AcquireError, DetectorCalibrationError};
use crate::compare::CompareError;
use crate::image::ImageFileError;
use crate::pose::PoseFileError;
use crate::render::RenderError;
use crate::scene::SceneError;

/// Why nothing was compared.
#[derive(Debug, thiserror::Error)]
pub enum CompareCommandError {
    /// The acquired frame.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// The detector calibration cannot be read, or does not apply to the frame.
    #[error(transparent)]
    Detector(#[from] DetectorCalibrationError),
    /// The simulated image, or an output.
    #[error(transparent)]
    Image(#[from] ImageFileError),
    /// The pose.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A pose that is not the simulated image's.
    #[error(transparent)]
    Origin(#[from] OriginError),
    /// The renderer of the null.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// Refused.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// A render that says of itself that pixels are invalid, without the mask that says which.
    #[error("{path}: is not there, but {percent:.1} % of the simulated image are invalid; copy it along, or render again", path = path.display())]
    NoValidity {
        /// The mask.
        path: PathBuf,
        /// Share of invalid pixels.
        percent: f64,
    },
    /// A file that cannot be read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nothing says what the simulated image holds.
    #[error("{path}: quantity is {found}, a comparison needs intensity or line_integral (--quantity, or IMAGE.tif.json beside it)", path = path.display())]
    Quantity {
        /// The simulated image.
        path: PathBuf,
        /// What was found.
        found: String,
    },
    /// What is declared is not what was rendered.
    #[error("--quantity {declared}: {path} says that it holds {found}; leave the flag out", path = path.display())]
    OtherQuantity {
        /// The simulated image.
        path: PathBuf,
        /// As typed.
        declared: String,
        /// By its description.
        found: String,
    },
    /// Several pages.
    #[error("{path}: holds {found} pages, a comparison needs one", path = path.display())]
    Pages {
        /// The simulated image.
        path: PathBuf,
        /// How many.
        found: usize,
    },
    /// A mask that is no picture.
    #[error("{path}: not a readable mask ({detail})", path = path.display())]
    Mask {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        detail: String,
    },
}

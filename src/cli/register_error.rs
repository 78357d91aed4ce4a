//! Why nothing was registered.

use std::path::PathBuf;

use crate::acquire::{AcquireError, DetectorCalibrationError};
use crate::beads::tags::{TagsError, TagsFileError};
use crate::beads::{BeadsError, CorrespondencesError};
use crate::geometry::{ConsoleError, IntensifierError};
use crate::image::ImageFileError;
use crate::pose::{PoseFileError, why_other_size};

/// Why nothing was registered.
#[derive(Debug, thiserror::Error)]
pub enum RegisterError {
    /// The frame.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// The detector calibration cannot be read, or does not apply to the frame.
    #[error(transparent)]
    Detector(#[from] DetectorCalibrationError),
    /// Beads or landmarks.
    #[error(transparent)]
    Beads(#[from] BeadsError),
    /// The list of tags.
    #[error(transparent)]
    TagsFile(#[from] TagsFileError),
    /// The tag decoder.
    #[error(transparent)]
    Tags(#[from] TagsError),
    /// Correspondences.
    #[error(transparent)]
    Correspondences(#[from] CorrespondencesError),
    /// K, prior, or the result.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// An output.
    #[error(transparent)]
    Output(#[from] ImageFileError),
    /// Several frames, and nothing that says what to do with them.
    #[error("{found} frames are given, register takes one; solve several of one specimen with --together")]
    Frames {
        /// How many.
        found: usize,
    },
    /// Priors and frames do not pair.
    #[error("{priors} priors are given for {frames} frames; give one --prior for each frame in its order, or none")]
    Priors {
        /// How many priors.
        priors: usize,
        /// How many frames.
        frames: usize,
    },
    /// The folder for the results cannot be made.
    #[error("{path}: {source}", path = path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Frames that cannot share K.
    #[error("{path} has {found:?} px, the first frame {expected:?} px: frames of different sizes share no K", path = path.display())]
    Sizes {
        /// The frame.
        path: PathBuf,
        /// Of the first.
        expected: [u32; 2],
        /// Its own.
        found: [u32; 2],
    },
    /// The radius typed is impossible.
    #[error("--bead-radius is {found} mm, it must be positive")]
    Radius {
        /// What was typed.
        found: f64,
    },
    /// The calibration of the image intensifier cannot be read, or does not fit the frame.
    #[error("{path}: {source}{hint}", path = path.display(), hint = angles_hint(source))]
    Distortion {
        /// Its file.
        path: PathBuf,
        /// What does not fit.
        source: Box<IntensifierError>,
    },
    /// Which part of a distorted picture is seen was found as if it were straight.
    #[error(
        "--console solve finds cropping and enlargement from beads in an undistorted picture, and --distortion needs to know them first; state them, --console FILE.json"
    )]
    DistortedAndSolved,
    /// Views are solved together as if each were straight.
    #[error(
        "--together solves views that nothing has bent: with it --distortion can be none alone; register distorted frames one by one"
    )]
    DistortedTogether,
    /// Nothing says what the panel's picture would be.
    #[error(
        "--console solve needs --intrinsics K.json with size_px, the panel's, and --prior POSE.json: beads cannot tell a turned picture from a turned camera"
    )]
    SolveWhat,
    /// The console's geometry does not fit frame and panel.
    #[error("{path}: {error}", path = path.display())]
    Console {
        /// What states it.
        path: PathBuf,
        /// Why not.
        error: ConsoleError,
    },
    /// K is for another frame.
    #[error("{path}: K is for frames of {expected:?} px, {frame} has {found:?} px, {why}", path = path.display(), frame = frame.display(), why = why_other_size(*expected, *found, by_file))]
    Size {
        /// File of K.
        path: PathBuf,
        /// Its size.
        expected: [u32; 2],
        /// The frame.
        frame: PathBuf,
        /// The frame's size.
        found: [u32; 2],
    },
}

/// How keys of a console's geometry are stated to `register`.
fn by_file(keys: &str) -> String {
    format!("write {keys} into a file and give it with --console, or let --console solve find it by a prior")
}

fn angles_hint(error: &IntensifierError) -> &'static str {
    if matches!(error, IntensifierError::AngleUnknown { .. }) { " (--carm-angles ORBITAL,ANGULATION)" } else { "" }
}

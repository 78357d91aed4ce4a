//! Files of poses, priors and K: JSON whose errors name file and key, written all or nothing.

use std::path::{Path, PathBuf};

use crate::foreign::read_small;
use crate::image::{ImageFileError, write_atomically};
use crate::json::{JsonFault, parse_json};

/// Why a pose, prior or intrinsics file is unusable.
#[derive(Debug, thiserror::Error)]
pub enum PoseFileError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not JSON, an unknown key, or a value of the wrong form.
    #[error("{path}: at {place}: {message}", path = path.display())]
    Form {
        /// The file.
        path: PathBuf,
        /// Path of keys.
        place: String,
        /// What is wrong there.
        message: String,
    },
    /// A prior without a pose.
    #[error("{path}: has no camera_from_lps{why}; a prior needs one", path = path.display())]
    NoPose {
        /// The file.
        path: PathBuf,
        /// `: the pose was refused`, or nothing.
        why: String,
    },
    /// The covariance is not one.
    #[error("{path}: covariance is not symmetric and positive definite: {detail}", path = path.display())]
    Covariance {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// It states its camera twice, differently.
    #[error(
        "{path}: projection is not K [I|0] camera_from_lps: places near the patient's origin are {off_px:.1} px apart; correct one of them, or leave projection out", path = path.display()
    )]
    Contradiction {
        /// The file.
        path: PathBuf,
        /// How far the two put one place apart, at most.
        off_px: f64,
    },
    /// The file could not be written.
    #[error(transparent)]
    Write(#[from] ImageFileError),
}

/// Reads a JSON file; errors name the key.
pub(super) fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, PoseFileError> {
    let bytes = read_small(path).map_err(|source| PoseFileError::Read { path: path.to_owned(), source })?;
    let form = |JsonFault { place, detail }| PoseFileError::Form { path: path.to_owned(), place, message: detail };
    parse_json(&bytes).map_err(form)
}

/// Writes a JSON file, all or nothing.
///
/// # Errors
/// When the folder is missing or not writable, or the disk is full.
pub(super) fn write_json<T: serde::Serialize>(path: &Path, value: &T) -> Result<(), PoseFileError> {
    write_atomically(path, |file| {
        let mut text = serde_json::to_vec_pretty(value).map_err(std::io::Error::other)?;
        text.push(b'\n');
        file.write_all(&text)
    })?;
    Ok(())
}

//! Why a session file is refused.

use std::path::PathBuf;

/// Why a session cannot start.
#[derive(Debug, thiserror::Error)]
pub enum SessionFileError {
    /// A file cannot be read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file is not what it should be; `place` is the key.
    #[error("{path}: at {place}: {detail}", path = path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// The key where it stands.
        place: String,
        /// What is wrong there.
        detail: String,
    },
    /// A named file is nowhere.
    #[error("{path}: {key} names {named}, which is neither beside the session file nor in the current folder", path = path.display())]
    Missing {
        /// The session file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// What it names.
        named: String,
    },
    /// The detector calibration.
    #[error(transparent)]
    Detector(#[from] crate::acquire::DetectorCalibrationError),
    /// A value makes no sense.
    #[error("{path}: {key} is {found}, expected {expected}", path = path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// What was found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
}

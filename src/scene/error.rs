//! What can be wrong with a scene.

use std::path::PathBuf;

use super::physics::PhysicsError;
use crate::geometry::{CameraError, CarmCalibrationError, RobotModelError};

/// Why a scene cannot be loaded; every message names file, place and what to do where it is not obvious.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file cannot be read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The JSON is wrong; `place` is the key.
    #[error("{path}: at {place}: {detail}", path = path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// The key.
        place: String,
        /// What is wrong there.
        detail: String,
    },
    /// A named file is nowhere.
    #[error("{scene}: {place} names {named}, which is neither beside the scene nor in the current folder", scene = scene.display())]
    Missing {
        /// The scene file.
        scene: PathBuf,
        /// The key.
        place: String,
        /// What it names.
        named: String,
    },
    /// A value makes no sense.
    #[error("{place} is {found}, expected {expected}")]
    Value {
        /// The key.
        place: String,
        /// What was found.
        found: String,
        /// What would be right.
        expected: String,
    },
    /// A key of the format that this version cannot honour.
    #[error("{place} is not available in this version; remove it from the scene")]
    NotAvailable {
        /// The key.
        place: String,
    },
    /// A volume file is damaged or of a kind that is not read.
    #[error("{path}: {detail}", path = path.display())]
    Volume {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// Materials, spectrum.
    #[error("{place}: {source}")]
    Physics {
        /// The key.
        place: String,
        /// What is wrong.
        source: PhysicsError,
    },
    /// The view.
    #[error("{place}: {source}")]
    Camera {
        /// The key.
        place: String,
        /// What is wrong.
        source: CameraError,
    },
    /// The C-arm's joints.
    #[error("{place}: {source}")]
    Carm {
        /// The key.
        place: String,
        /// What is wrong.
        source: CarmCalibrationError,
    },
    /// The robot.
    #[error("{place}: {source}")]
    Robot {
        /// The key.
        place: String,
        /// What is wrong.
        source: RobotModelError,
    },
    /// The scene has no view, and one is needed.
    #[error("{path}: the scene has no view; add \"view\" with size_px, intrinsics and camera_from_lps", path = path.display())]
    NoView {
        /// The scene file.
        path: PathBuf,
    },
}

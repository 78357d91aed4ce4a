//! Why a scene cannot be used.

use std::path::PathBuf;

use super::physics::PhysicsError;
use crate::geometry::{CameraError, CarmCalibrationError, IntensifierError, RobotModelError};

/// Why a scene, or a file that it names, cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The operating system refused.
    #[error("{path}: cannot be read ({source})", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file that another one names is not there.
    #[error("{place}: {path} is not there; looked in {looked}")]
    Missing {
        /// File and key that name it.
        place: String,
        /// As it was named.
        path: String,
        /// Where it was looked for.
        looked: String,
    },
    /// Our own JSON is malformed or has the wrong keys.
    #[error("{path}: {place}: {detail}", path = path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// The key, as `objects[2].sphere.radius_mm`.
        place: String,
        /// What is wrong, with line and column.
        detail: String,
    },
    /// A value makes no sense.
    #[error("{place} is {found}, expected {expected}")]
    Value {
        /// File and key.
        place: String,
        /// What was found.
        found: String,
        /// What would be right.
        expected: String,
    },
    /// Keys that exclude or need each other.
    #[error("{place}: {detail}")]
    Keys {
        /// File and object.
        place: String,
        /// Which keys.
        detail: String,
    },
    /// A materials network cannot be used.
    #[cfg(feature = "learn")]
    #[error("{place}: {source}")]
    Network {
        /// File and key that ask for it.
        place: String,
        /// Why.
        source: Box<crate::infer::InferError>,
    },
    /// A material, an energy or a spectrum is wrong.
    #[error("{place}: {source}")]
    Physics {
        /// File and key.
        place: String,
        /// What is wrong.
        source: PhysicsError,
    },
    /// The calibration of an image intensifier does not fit.
    #[error("{place}: {source}")]
    Intensifier {
        /// File and key.
        place: String,
        /// What is wrong.
        source: Box<IntensifierError>,
    },
    /// K or P is no camera.
    #[error("{place}: {source}")]
    Camera {
        /// File and key.
        place: String,
        /// What is wrong.
        source: CameraError,
    },
    /// A C-arm calibration does not give a camera.
    #[error("{place}: {source}")]
    Carm {
        /// File and key.
        place: String,
        /// What is wrong.
        source: CarmCalibrationError,
    },
    /// A robot model or its angles are unusable.
    #[error("{place}: {source}")]
    Robot {
        /// File and key.
        place: String,
        /// What is wrong.
        source: RobotModelError,
    },
    /// A robot was to be moved in a scene without one.
    #[error("the scene has no robot object, so it cannot be bent")]
    NoRobot,
    /// A body has moved that no object belongs to.
    #[error(
        "the body '{body}' has moved by {angle_deg:.2} deg and {shift_mm:.2} mm, and the scene does not know it (it knows {known}); name it with \"body\" of an object or \"bodies\" of a CT's labels"
    )]
    UnknownBody {
        /// Its name.
        body: String,
        /// By how much it turned.
        angle_deg: f64,
        /// How far its origin went.
        shift_mm: f64,
        /// Bodies of the scene.
        known: String,
    },
    /// A volume file is not what it says.
    #[error("{path}: {detail}", path = path.display())]
    Volume {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        detail: String,
    },
    /// Labels and CT lie on different grids.
    #[error("{labels}: not on the grid of {ct}: {detail}; resample the labels to the CT", labels = labels.display(), ct = ct.display())]
    Grid {
        /// The label file.
        labels: PathBuf,
        /// The CT.
        ct: PathBuf,
        /// How they differ.
        detail: String,
    },
    /// A mesh file is damaged or not closed.
    #[error("{path}: {detail}", path = path.display())]
    Mesh {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        detail: String,
    },
    /// More materials than a volume can number.
    #[error("{place}: {found} classes, at most 255 fit")]
    TooManyClasses {
        /// The object.
        place: String,
        /// How many.
        found: usize,
    },
}

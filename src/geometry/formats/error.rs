//! Why a text is no camera.

use super::format::Format;
use crate::geometry::{CameraError, RigidError};

/// Why a text is no camera, or a camera cannot be written in a format.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FormatError {
    /// NaN or infinity.
    #[error("{what} holds a number that is not finite")]
    NotFinite {
        /// Where.
        what: String,
    },
    /// A word where a number should stand.
    #[error("{what}: `{found}` is not a number")]
    NotNumber {
        /// Where.
        what: String,
        /// The word.
        found: String,
    },
    /// A matrix or list of another size.
    #[error("{what} is {found}, expected {expected}")]
    Shape {
        /// Which.
        what: String,
        /// What was found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// A key that this format does not have.
    #[error("unknown key `{key}`, expected one of {expected}")]
    UnknownKey {
        /// As found.
        key: String,
        /// What is known.
        expected: String,
    },
    /// A key stands there twice.
    #[error("key `{key}` stands there twice")]
    TwiceKey {
        /// As found.
        key: String,
    },
    /// A key that is needed.
    #[error("has no {key}")]
    MissingKey {
        /// What is missing.
        key: &'static str,
    },
    /// Not the grammar of the format.
    #[error("not {expected}: {detail}")]
    Syntax {
        /// The format.
        expected: &'static str,
        /// Where and what.
        detail: String,
    },
    /// A left-handed camera.
    #[error("{what} mirrors: its determinant is negative ({determinant:.3e}); un-mirror the frame first{hint}")]
    Mirrored {
        /// Which matrix.
        what: &'static str,
        /// Its determinant, rows scaled to length 1.
        determinant: f64,
        /// What else may be the cause.
        hint: &'static str,
    },
    /// One file holds several poses.
    #[error("holds {found} projections, a pose is one; cut the file")]
    Several {
        /// How many.
        found: usize,
    },
    /// A value that this program cannot express.
    #[error("{key} is {found}, expected {expected}")]
    Unsupported {
        /// Which value.
        key: String,
        /// What was found.
        found: String,
        /// What can be used.
        expected: &'static str,
    },
    /// Two statements of one file contradict each other.
    #[error("{what} differ by {difference:.3e}, at most {limit:.0e} is rounding")]
    Inconsistent {
        /// Which two.
        what: &'static str,
        /// By how much.
        difference: f64,
        /// What is accepted.
        limit: f64,
    },
    /// The format does not say what is needed.
    #[error("{format} needs {what}; give {remedy}")]
    Needs {
        /// The format.
        format: Format,
        /// What is missing.
        what: &'static str,
        /// Where it can come from.
        remedy: &'static str,
    },
    /// No camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// No rigid motion.
    #[error(transparent)]
    Rigid(#[from] RigidError),
}

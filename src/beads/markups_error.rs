//! What is wrong with a file of beads or landmarks.

use std::path::PathBuf;

use super::place_covariance::CovarianceFault;

/// Why a file of beads or landmarks is unusable.
#[derive(Debug, thiserror::Error)]
pub enum BeadsError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file's name ends in neither `.json` nor `.fcsv`.
    #[error("{path}: expected a Slicer markups file ending in .mrk.json or .fcsv", path = path.display())]
    Extension {
        /// The file.
        path: PathBuf,
    },
    /// Not JSON, or damaged.
    #[error("{path}: not readable as JSON: {source}", path = path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// What is wrong, and where.
        source: crate::json::JsonFault,
    },
    /// JSON or a table, but not of this form.
    #[error("{path}: {place} is {found}, expected {expected}", path = path.display())]
    Form {
        /// The file.
        path: PathBuf,
        /// Key or line.
        place: String,
        /// What is there.
        found: String,
        /// What should be there.
        expected: &'static str,
    },
    /// No defined point.
    #[error("{path}: holds no defined point ({skipped} skipped as not defined); place the points in Slicer and save again", path = path.display())]
    Empty {
        /// The file.
        path: PathBuf,
        /// Points without a position.
        skipped: usize,
    },
    /// Two points of one name.
    #[error("{path}: label {name:?} occurs twice; names must be unique", path = path.display())]
    Duplicate {
        /// The file.
        path: PathBuf,
        /// The label.
        name: String,
    },
    /// A coordinate is NaN or infinite.
    #[error("{path}: point {name:?} has position {found}, three finite numbers in mm are needed", path = path.display())]
    Position {
        /// The file.
        path: PathBuf,
        /// The label.
        name: String,
        /// What is there.
        found: String,
    },
    /// A key of the description has an impossible value.
    #[error("{path}: point {name:?}: {key}={found} in its description, a positive number is needed", path = path.display())]
    Description {
        /// The file.
        path: PathBuf,
        /// The label.
        name: String,
        /// Which key.
        key: &'static str,
        /// What is there.
        found: String,
    },
    /// A covariance that is none.
    #[error("{path}: point {name:?}: covariance_mm2={found} in its description {fault}", path = path.display())]
    Covariance {
        /// The file.
        path: PathBuf,
        /// The label.
        name: String,
        /// What is there.
        found: String,
        /// What is wrong with it.
        fault: CovarianceFault,
    },
    /// A role that beads do not have.
    #[error("{path}: point {name:?}: role={found} in its description; the only role is check, of beads on which no pose may rest", path = path.display())]
    Role {
        /// The file.
        path: PathBuf,
        /// The label.
        name: String,
        /// What is there.
        found: String,
    },
    /// Nothing to solve a pose from.
    #[error("{path}: all {checks} points have role=check; a pose needs beads without it", path = path.display())]
    OnlyChecks {
        /// The file.
        path: PathBuf,
        /// How many.
        checks: usize,
    },
}

//! Which shadow is which bead, as a person has marked it.

use std::path::{Path, PathBuf};

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::foreign::read_small;
use crate::json::{JsonFault, parse_json};

/// A bead and where its shadow is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Correspondence {
    /// Its name in the layout.
    pub bead: String,
    /// A place in or beside its shadow, in the frame's continuous pixels; the shadow's own centre is what is used.
    pub image_px: DVec2,
}

/// Why a file of correspondences is unusable.
#[derive(Debug, thiserror::Error)]
pub enum CorrespondencesError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Another form.
    #[error("{path}: at {place}: {message}; expected {{\"correspondences\": [{{\"bead\": \"B1\", \"image_px\": [310.5, 200.0]}}, …]}}", path = path.display())]
    Form {
        /// The file.
        path: PathBuf,
        /// Path of keys.
        place: String,
        /// What is wrong there.
        message: String,
    },
}

/// Reads `{"correspondences": [{"bead", "image_px"}, …]}`.
///
/// # Errors
/// When the file cannot be read, has another form, or a place is not finite.
pub fn read_correspondences(path: &Path) -> Result<Vec<Correspondence>, CorrespondencesError> {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Given {
        correspondences: Vec<Correspondence>,
    }
    let bytes = read_small(path).map_err(|source| CorrespondencesError::Read { path: path.to_owned(), source })?;
    let form = |place: String, message: String| CorrespondencesError::Form { path: path.to_owned(), place, message };
    let given: Given = parse_json(&bytes).map_err(|JsonFault { place, detail }| form(place, detail))?;
    match given.correspondences.iter().find(|one| !one.image_px.is_finite()) {
        Some(bad) => Err(form("correspondences".to_owned(), format!("the place of {:?} is not finite", bad.bead))),
        None => Ok(given.correspondences),
    }
}

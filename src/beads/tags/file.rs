//! `TAGS.json`: which tags there are, how large, and where in the specimen.

use std::path::{Path, PathBuf};

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{CORNERS, Family};
use crate::beads::{DEFAULT_BODY, DEFAULT_SIGMA_MM};
use crate::foreign::read_small;
use crate::geometry::Rigid;
use crate::json::{JsonFault, parse_json};

/// A tag on or in the specimen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tag {
    /// Number in the family.
    pub id: u32,
    /// Side of the square whose corners are found (see the module).
    pub size_mm: f64,
    /// The tag's frame (see the module) in the CT's patient axes.
    pub lps_from_tag: Rigid,
    /// The rigid part it is fixed to.
    #[serde(default = "default_body")]
    pub body: String,
    /// Standard deviation of the place of its corners per axis.
    #[serde(default = "default_sigma")]
    pub sigma_mm: f64,
}

fn default_body() -> String {
    DEFAULT_BODY.to_owned()
}

fn default_sigma() -> f64 {
    DEFAULT_SIGMA_MM
}

impl Tag {
    /// Its corners in `lps`, in the order of [`CORNERS`].
    #[must_use]
    pub fn corners_lps_mm(&self) -> [DVec3; 4] {
        CORNERS.map(|[x, y]| self.lps_from_tag.transform_point(DVec3::new(x, y, 0.0) * (0.5 * self.size_mm)))
    }
}

/// All tags of a specimen: `{"family": "tag36h11", "tags": [{"id", "size_mm", "lps_from_tag", "body"?, "sigma_mm"?}, …]}`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TagLayout {
    /// The family of all of them.
    pub family: Family,
    /// At least one; no id twice.
    pub tags: Vec<Tag>,
}

impl TagLayout {
    /// Mean of all corners.
    #[must_use]
    pub fn centre_lps_mm(&self) -> DVec3 {
        let corners = self.tags.iter().flat_map(Tag::corners_lps_mm);
        corners.sum::<DVec3>() / (CORNERS.len() * self.tags.len()).max(1) as f64
    }
}

/// Why a file of tags is unusable.
#[derive(Debug, thiserror::Error)]
pub enum TagsFileError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Another form.
    #[error("{path}: at {place}: {message}; expected {{\"family\": \"tag36h11\", \"tags\": [{{\"id\": 3, \"size_mm\": 12.0, \"lps_from_tag\": 4x4 rows}}, …]}}", path = path.display())]
    Form {
        /// The file.
        path: PathBuf,
        /// Path of keys.
        place: String,
        /// What is wrong there.
        message: String,
    },
    /// A number that cannot be.
    #[error("{path}: at tags[{index}].{key}: found {found}, expected {expected}", path = path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Which tag, from 0.
        index: usize,
        /// The key.
        key: &'static str,
        /// What is there.
        found: String,
        /// What should be.
        expected: String,
    },
    /// No tag in it.
    #[error("{path}: lists no tags", path = path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
}

/// Reads a file of tags.
///
/// # Errors
/// When it cannot be read, has another form or unknown keys, or a number in it cannot be.
pub fn read_tags(path: &Path) -> Result<TagLayout, TagsFileError> {
    let bytes = read_small(path).map_err(|source| TagsFileError::Read { path: path.to_owned(), source })?;
    parse_tags(path, &bytes)
}

/// The tags of a file's `bytes`; `path` is for errors.
///
/// # Errors
/// As [`read_tags`].
pub fn parse_tags(path: &Path, bytes: &[u8]) -> Result<TagLayout, TagsFileError> {
    let form = |JsonFault { place, detail }| TagsFileError::Form { path: path.to_owned(), place, message: detail };
    let layout: TagLayout = parse_json(bytes).map_err(form)?;
    if layout.tags.is_empty() {
        return Err(TagsFileError::Empty { path: path.to_owned() });
    }
    for (index, tag) in layout.tags.iter().enumerate() {
        let wrong = |key: &'static str, found: String, expected: String| {
            Err(TagsFileError::Value { path: path.to_owned(), index, key, found, expected })
        };
        if tag.id >= layout.family.count() {
            return wrong("id", tag.id.to_string(), format!("less than {} in {}", layout.family.count(), layout.family));
        }
        if layout.tags[..index].iter().any(|other| other.id == tag.id) {
            return wrong("id", tag.id.to_string(), "each id once".to_owned());
        }
        if !(tag.size_mm > 0.0 && tag.size_mm.is_finite()) {
            return wrong("size_mm", tag.size_mm.to_string(), "a positive length".to_owned());
        }
        if !(tag.sigma_mm >= 0.0 && tag.sigma_mm.is_finite()) {
            return wrong("sigma_mm", tag.sigma_mm.to_string(), "zero or a positive length".to_owned());
        }
    }
    Ok(layout)
}

//! Why a line of text is no sample.

use serde::Serialize;

/// What of a line is quoted, characters.
const QUOTED: usize = 24;

/// Why a line is no sample. Nothing of it is used.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, thiserror::Error)]
#[serde(rename_all = "snake_case", tag = "kind")]
pub enum LineFault {
    /// Bytes that are no text.
    #[error("line is no text: {bytes} bytes that are not UTF-8, or hold a zero")]
    NotText {
        /// Its length.
        bytes: usize,
    },
    /// The port closed within it.
    #[error("line is cut: the port closed after {bytes} bytes of it")]
    Cut {
        /// What had come.
        bytes: usize,
    },
    /// Columns have no names yet.
    #[error("no header yet: expected a line that names the columns {expected}")]
    NoHeader {
        /// Columns that are read.
        expected: String,
    },
    /// Another number of columns.
    #[error("line has {found} columns, expected {expected}")]
    Columns {
        /// As declared, or as the header has them.
        expected: usize,
        /// In this line.
        found: usize,
    },
    /// The pattern is another.
    #[error("line does not match the pattern: '{found}'")]
    NoMatch {
        /// Its beginning.
        found: String,
    },
    /// No JSON object.
    #[error("line is no JSON object: {reason}")]
    NotJson {
        /// What the parser says.
        reason: String,
    },
    /// A value that must be there is not.
    #[error("{field} is missing ('{from}')")]
    Missing {
        /// Key of the declaration.
        field: String,
        /// Column, group or path.
        from: String,
    },
    /// A value is no finite number, no whole number, or no word of those declared.
    #[error("{field} is '{found}', expected {expected}")]
    Value {
        /// Key of the declaration.
        field: String,
        /// As it stands in the line.
        found: String,
        /// What would be right.
        expected: String,
    },
    /// The base's rotation.
    #[error("{field} is no rotation: its quaternion has length {length}, expected 1")]
    NotARotation {
        /// Key of the declaration.
        field: String,
        /// Three digits.
        length: String,
    },
}

/// The beginning of what a device sent, fit for a sentence.
pub(super) fn quoted(text: &str) -> String {
    let shown: String = text.chars().take(QUOTED).flat_map(char::escape_default).collect();
    if text.chars().nth(QUOTED).is_some() { format!("{shown}…") } else { shown }
}

//! Why a declaration is none.

/// What is wrong in a declaration, and where.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("at {place}: {detail}")]
pub struct AdapterError {
    /// Path of keys.
    pub place: String,
    /// What is wrong there, and what would be right.
    pub detail: String,
}

impl AdapterError {
    pub(super) fn new(place: impl Into<String>, detail: impl Into<String>) -> Self {
        Self { place: place.into(), detail: detail.into() }
    }
}

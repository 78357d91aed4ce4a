//! What is asked of a helper.

use super::kind::Kind;
use super::limits::Limits;

/// What a helper is asked for: on its command line, or first of all on its standard input.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub struct Request {
    /// What the file should be.
    pub kind: Kind,
    /// What the helper may take.
    pub limits: Limits,
    /// What else the decoder of this kind needs to know; never a name or a path.
    #[serde(default)]
    pub detail: serde_json::Value,
}

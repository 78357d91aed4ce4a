//! A bead's part in a pair: what the report's table of residuals shows.

use crate::pose::BeadResidual;

/// A bead of the layout in one frame.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct BeadRow {
    /// As in the layout.
    pub name: String,
    /// Centre of its shadow, px; absent where none was matched.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub found_px: Option<[f64; 2]>,
    /// Found minus where P puts it, px.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub residual_px: Option<[f64; 2]>,
    /// Whether P rests on it.
    pub used: bool,
    /// Why not, if not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// It is kept to check P, which never rests on it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub check: bool,
}

impl BeadRow {
    /// Of a bead of a pose.
    #[must_use]
    pub fn of(bead: &BeadResidual) -> Self {
        let BeadResidual { name, image_px, residual_px, used, reason, check, .. } = bead;
        Self {
            name: name.clone(),
            found_px: *image_px,
            residual_px: *residual_px,
            used: *used,
            reason: reason.clone(),
            check: *check,
        }
    }

    /// Whether P rests on it, or why not.
    #[must_use]
    pub fn part(&self) -> &str {
        match (self.used, self.check, &self.reason) {
            (true, ..) => "used",
            (false, true, _) => "kept to check P",
            (false, false, Some(reason)) => reason,
            (false, false, None) => "not used",
        }
    }
}

//! What several views of one bead set say together, and its file.

use std::path::Path;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::geometry::{Intrinsics, Rigid};
use crate::pose::file::{PoseFileError, write_json};
use crate::pose::record::{Pose, Status};

/// Why several views give nothing together.
#[derive(Clone, Debug, PartialEq, thiserror::Error, Serialize, Deserialize)]
#[serde(tag = "code", rename_all = "snake_case")]
pub enum TogetherRefusal {
    /// There is nothing to solve together.
    #[error(
        "too_few_views: {accepted} of {given} frames give a pose of their own, {required} are needed; the others say why not"
    )]
    TooFewViews { given: usize, accepted: usize, required: usize },
    /// The views have nothing in common.
    #[error("too_few_shared: {shared} beads are seen in two views or more, {required} are needed; take views that overlap")]
    TooFewShared { shared: usize, required: usize },
    /// Some direction is not determined, or the solver failed.
    #[error("unsolved: {detail}")]
    Unsolved { detail: String },
    /// The residuals are too large.
    #[error(
        "residual: {views} views agree only to {times:.1} times what noise and bead positions allow (limit {limit:.0}); is it the same specimen, and K right?"
    )]
    Residual { views: usize, times: f64, limit: f64 },
}

/// What became of a bead.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BeadVerdict {
    /// It is where the layout has it, as far as can be told.
    InPlace,
    /// All views agree that it is elsewhere.
    Migrated,
    /// A single place, elsewhere or not, does not explain its shadows: it moved between the views, or several shadows are not its own.
    Inconsistent,
    /// It has moved, or one of its shadows is off: these views cannot tell which.
    Unclear,
    /// No view shows it.
    NotSeen,
}

/// A bead, solved from all views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SolvedBead {
    /// As in the layout.
    pub name: String,
    /// The rigid part it is fixed to.
    pub body: String,
    /// Its place in its body, layout and shadows together; of a migrated one by its shadows alone.
    pub lps_mm: DVec3,
    /// Standard deviations of that.
    pub sigma_mm: [f64; 3],
    /// Covariance of that, mm².
    pub covariance_mm2: [[f64; 3]; 3],
    /// Distance from its place in the layout.
    pub moved_mm: f64,
    /// Whether it has migrated since the scan.
    pub migrated: bool,
    /// What became of it.
    pub verdict: BeadVerdict,
    /// Views whose shadow of it was used.
    pub views: usize,
}

/// What a motion is seen against.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Against {
    /// Another body, in the same views.
    Body { name: String },
    /// The room, by the priors of the views.
    Room,
}

/// A body that moved between two views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bump {
    /// What moved; against the room the body that the cameras are solved from, and with it all that did not move against it.
    pub body: String,
    /// What it moved against.
    pub against: Against,
    /// First view, counted from 0, in which it is elsewhere.
    pub from_view: usize,
    /// By how much it turned.
    pub angle_deg: f64,
    /// By how much its beads shifted.
    pub shift_mm: f64,
    /// Squared motion in standard deviations, six degrees of freedom.
    pub chi2: f64,
}

/// Several views, solved together; the file `POSES.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Together {
    /// Accepted or refused.
    pub status: Status,
    /// Why it is refused: a word, a colon, a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The same in parts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refusal: Option<TogetherRefusal>,
    /// The first view whose pose may be another one, and why; each view says its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub doubt: Option<String>,
    /// The frames, in the order of `views`.
    pub frames: Vec<String>,
    /// Each view's pose: solved together, or as it was refused alone.
    pub views: Vec<Pose>,
    /// K that all views share; absent where each has its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intrinsics: Option<Intrinsics>,
    /// Standard deviations of (fx, fy, cx, cy), px, where K was solved.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intrinsics_sigma_px: Option<[f64; 4]>,
    /// All beads of the layout, in its order.
    pub beads: Vec<SolvedBead>,
    /// Bodies that moved between views.
    pub bumps: Vec<Bump>,
    /// Weighted square residual over its degrees of freedom.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chi2_per_dof: Option<f64>,
    /// Observed numbers, priors among them, less unknowns.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub degrees_of_freedom: Option<i64>,
    /// What a person should look at.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cautions: Vec<String>,
    /// Software that wrote it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub version: Option<String>,
}

impl Together {
    /// Whether the poses may be used.
    #[must_use]
    pub fn is_accepted(&self) -> bool {
        self.status == Status::Accepted
    }

    /// Where `body` is in a view, if that was solved.
    #[must_use]
    pub fn lps_from_body(&self, view: usize, body: &str) -> Option<Rigid> {
        let bodies = &self.views.get(view)?.bodies;
        bodies.iter().find(|own| own.name == body).map(|own| own.lps_from_body)
    }

    /// Writes a file, all or nothing.
    ///
    /// # Errors
    /// When the folder is missing or not writable, or the disk is full.
    pub fn write(&self, path: &Path) -> Result<(), PoseFileError> {
        write_json(path, self)
    }
}

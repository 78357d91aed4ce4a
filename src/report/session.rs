//! A session's report: what happened, in numbers, for `pairs.json` and `report.html`.

use std::collections::BTreeMap;

use super::pair::{Pair, PairStatus, PoseSource};
use crate::reporter::Counted;

/// A time in which a link was down.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Gap {
    /// Host time, µs.
    pub start_us: i64,
    /// Host time, µs.
    pub end_us: i64,
    /// `unplugged`, `no bytes for 1.2 s`.
    pub reason: String,
}

/// How a device's link did.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct LinkReport {
    /// `carm`, `robot`, `frames`.
    pub device: String,
    /// Host time of the first sample, µs.
    pub first_us: Option<i64>,
    /// Host time of the last sample, µs.
    pub last_us: Option<i64>,
    /// `frames`, `corrupt`, `lost`, `duplicate`, `reordered`, `stale` and the others of the link, then `clock_steps`.
    pub counters: Vec<(String, u64)>,
    /// When it was down.
    pub gaps: Vec<Gap>,
}

/// Quantities of one unit over time.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Track {
    /// `C-arm angles`.
    pub title: String,
    /// `deg`, `mm`.
    pub unit: String,
    /// Name, and (host time µs, value) in order of time; NaN breaks the line.
    pub series: Vec<(String, Vec<(i64, f64)>)>,
}

/// What a result rests on.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Provenance {
    /// Of sidecarm.
    pub version: String,
    /// What rendered.
    pub adapter: Option<String>,
    /// What became of the session: the command, `demo`, `live`, `replay of …`.
    pub command: Option<String>,
    /// Files that went in: path and SHA-256.
    pub inputs: Vec<(String, String)>,
    /// Anything else: name and value.
    pub details: Vec<(String, String)>,
}

/// All that a session's report shows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SessionReport {
    /// Heading.
    pub title: String,
    /// Host time, µs.
    pub started_us: Option<i64>,
    /// Host time, µs.
    pub ended_us: Option<i64>,
    /// One per exposure, in order of time.
    pub pairs: Vec<Pair>,
    /// One per device.
    pub links: Vec<LinkReport>,
    /// Joints and angles.
    pub tracks: Vec<Track>,
    /// Warnings by kind, from the reporter.
    pub warnings: BTreeMap<String, Counted>,
    /// Data that did not arrive or was not kept, one sentence each.
    pub losses: Vec<String>,
    /// What is not modelled (scatter, …), one sentence each.
    pub not_modelled: Vec<String>,
    /// What it rests on.
    pub provenance: Provenance,
    /// PNG files by the path that pairs name them with; what is missing is read from the session's folder when it is written.
    pub pictures: BTreeMap<String, Vec<u8>>,
}

/// How many exposures came out how.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Counts {
    /// All but the copies.
    pub exposures: usize,
    /// Pictures that were exported again; they stand in no other count.
    #[serde(default)]
    pub copies: usize,
    /// P from beads, and the image agrees or cannot tell.
    pub accepted: usize,
    /// P from beads, but the image prefers another pose.
    #[serde(default)]
    pub image_disagrees: usize,
    /// P from beads, but telemetry puts specimen or detector elsewhere.
    #[serde(default)]
    pub telemetry_disagrees: usize,
    /// P from beads, but another pose may be the right one.
    #[serde(default)]
    pub in_doubt: usize,
    /// Registration refused.
    pub refused: usize,
    /// Not tried.
    pub no_pose: usize,
    /// Of the refused and not tried: shown with the pose from telemetry.
    pub from_telemetry: usize,
}

impl SessionReport {
    /// Seconds from the session's start, which is its first exposure where nothing else is known, to a host time.
    pub(super) fn seconds(&self, host_us: i64) -> f64 {
        let start_us = self.started_us.or_else(|| self.pairs.iter().filter_map(|pair| pair.time_us).min()).unwrap_or(0);
        (host_us - start_us) as f64 * 1e-6
    }

    /// Counts by status.
    #[must_use]
    pub fn counts(&self) -> Counts {
        let own = || self.pairs.iter().filter(|pair| pair.copy_of.is_none());
        let with = |status: PairStatus| own().filter(|pair| pair.status == status).count();
        let exposures = own().count();
        Counts {
            exposures,
            copies: self.pairs.len() - exposures,
            accepted: with(PairStatus::Accepted),
            image_disagrees: with(PairStatus::AcceptedImageDisagrees),
            telemetry_disagrees: with(PairStatus::AcceptedTelemetryDisagrees),
            in_doubt: with(PairStatus::AcceptedInDoubt),
            refused: with(PairStatus::Refused),
            no_pose: with(PairStatus::NoPose),
            from_telemetry: own().filter(|pair| pair.pose_source == PoseSource::Telemetry).count(),
        }
    }
}

/// `9 frames, 5 accepted, 1 accepted but the image disagrees, 1 refused, 2 copies`: what a session came to, in a line for the terminal. Copies
/// stand in no other count but that of the frames.
#[must_use]
pub fn counted(pairs: &[Pair]) -> String {
    counted_of(pairs, pairs.len(), 0)
}

/// The same of a session that recorded so many `frames`, and left `unfinished` of them without a pair, or with one that is not complete.
#[must_use]
pub fn counted_of(pairs: &[Pair], frames: usize, unfinished: usize) -> String {
    let count = |keep: &dyn Fn(&Pair) -> bool| pairs.iter().filter(|pair| pair.copy_of.is_none() && keep(pair)).count();
    let accepted = count(&|pair| pair.status == PairStatus::Accepted);
    let mut words = format!("{} frames, {accepted} accepted", frames.max(pairs.len()));
    for (status, what) in [
        (PairStatus::AcceptedImageDisagrees, "but the image disagrees"),
        (PairStatus::AcceptedTelemetryDisagrees, "but telemetry disagrees"),
        (PairStatus::AcceptedInDoubt, "in doubt"),
    ] {
        let doubtful = count(&|pair| pair.status == status);
        if doubtful > 0 {
            words += &format!(", {doubtful} accepted {what}");
        }
    }
    for (status, what) in [(PairStatus::Refused, "refused"), (PairStatus::NoPose, "not registered")] {
        let left = count(&|pair| pair.status == status);
        if left > 0 {
            words += &format!(", {left} {what}");
        }
    }
    let as_in_scene = count(&|pair| pair.robot_words().is_some());
    if as_in_scene > 0 {
        words += &format!(", {as_in_scene} with the robot drawn as in the scene file (no telemetry of their exposures)");
    }
    if unfinished > 0 {
        words += &format!(", {unfinished} not finished");
    }
    match pairs.iter().filter(|pair| pair.copy_of.is_some()).count() {
        0 => {}
        1 => words += ", 1 copy",
        copies => words += &format!(", {copies} copies"),
    }
    words
}

/// `pairs.json`.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PairsFile {
    /// One per exposure, in order of time.
    pub pairs: Vec<Pair>,
}

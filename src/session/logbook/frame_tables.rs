//! The tables of a log that are of its frames: poses, beads and scores.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::super::log::PoseRecord;
use super::LogbookError;
use super::frames::{FrameTold, Frames};
use super::sheet::{Table, number, or_empty, word};
use crate::compare::{NULL_SCORES, Scores};
use crate::geometry::{Intrinsics, JOINT_KEYS};
use crate::pose::Pose;
use crate::report::{Pair, PoseSource};

/// Names of a matrix of three rows and four columns, row by row.
fn matrix(prefix: &str) -> impl Iterator<Item = String> {
    (0..3).flat_map(move |row| (0..4).map(move |column| format!("{prefix}{row}{column}")))
}

fn label(frames: &Frames, number: u32) -> String {
    frames.by_number.get(&number).map(|frame| frame.label.clone()).unwrap_or_default()
}

/// One row a frame, whatever became of it, with what was used for it: P and all that belongs to P may be of telemetry.
pub(super) fn write_poses(
    table: &mut Table,
    frames: &Frames,
    poses: &BTreeMap<u32, PoseRecord>,
    pairs: &BTreeMap<u32, Pair>,
) -> Result<(), LogbookError> {
    let head = ["frame", "label", "time_us", "log", "exposure", "counter", "binding", "pose_source", "status", "rms_px"];
    let of_k = ["fx_px", "fy_px", "cx_px", "cy_px"];
    let named = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
    let mut columns = named(&head);
    columns.extend(matrix("p"));
    columns.extend(named(&of_k));
    columns.extend(matrix("camera_from_lps_"));
    columns.push("intrinsics_source".to_owned());
    columns.extend(JOINT_KEYS.iter().map(|(name, _)| (*name).to_owned()));
    table.head(columns)?;
    for (number, frame) in &frames.by_number {
        table.row(pose_row(frame, poses.get(number), pairs.get(number)))?;
    }
    Ok(())
}

fn pose_row(frame: &FrameTold, record: Option<&PoseRecord>, pair: Option<&Pair>) -> Vec<String> {
    let told = frame.pose.as_ref();
    let pose = record.and_then(|record| Pose::deserialize(&record.pose).ok());
    // The word of the pair knows of doubts that came after the pose.
    let status = match (pair, told) {
        (Some(pair), _) => word(&pair.status),
        (None, Some(told)) if told.accepted => "accepted".to_owned(),
        (None, Some(told)) if told.tried => "refused".to_owned(),
        (None, Some(_)) => "no_pose".to_owned(),
        (None, None) => String::new(),
    };
    let mut row = vec![frame.number.to_string(), frame.label.clone()];
    row.extend([
        or_empty(told.map(|told| told.time_us)),
        or_empty(told.map(|told| told.piece + 1)),
        or_empty(told.and_then(|told| told.exposure).map(|index| index + 1)),
        or_empty(told.and_then(|told| told.exposure_counter)),
        told.map(|told| told.binding.clone()).unwrap_or_default(),
        told.map(|told| word(&told.source)).unwrap_or_default(),
        status,
        or_empty(told.and_then(|told| told.rms_px)),
    ]);
    let twelve = |rows: Option<[[f64; 4]; 3]>| rows.unwrap_or([[f64::NAN; 4]; 3]).into_iter().flatten().map(number);
    let projection = record.and_then(|record| record.projection);
    row.extend(twelve(projection.map(|projection| projection.0)));
    // The pose has its K digit by digit; that of telemetry stands in P alone.
    let of_beads = pose.filter(|_| told.is_some_and(|told| told.source == PoseSource::Beads));
    let (known, source) = of_beads.map_or((None, None), |pose| (pose.intrinsics, pose.intrinsics_source));
    let intrinsics = known.or_else(|| Some(projection?.decompose().ok()?.0));
    row.extend(intrinsics.map_or([f64::NAN; 4], |Intrinsics { fx, fy, cx, cy, .. }| [fx, fy, cx, cy]).map(number));
    let camera_from_lps = record.and_then(|record| record.camera_from_lps).map(|camera_from_lps| camera_from_lps.to_rows());
    row.extend(twelve(camera_from_lps.map(|[first, second, third, _]| [first, second, third])));
    row.push(source.unwrap_or_default());
    let joints = record.map(|record| &record.binding["exposure"]["joints"]["value"]);
    row.extend(JOINT_KEYS.map(|(name, _)| or_empty(joints.and_then(|joints| joints[name].as_f64()))));
    row
}

pub(super) fn write_beads(table: &mut Table, frames: &Frames, poses: &BTreeMap<u32, PoseRecord>) -> Result<(), LogbookError> {
    let head = [
        "frame",
        "label",
        "status",
        "bead",
        "body",
        "x_lps_mm",
        "y_lps_mm",
        "z_lps_mm",
        "image_u_px",
        "image_v_px",
        "predicted_u_px",
        "predicted_v_px",
        "residual_u_px",
        "residual_v_px",
        "sigma_px",
        "used",
        "check",
        "reason",
    ];
    table.head(head.map(str::to_owned))?;
    for (frame, record) in poses {
        let Ok(pose) = Pose::deserialize(&record.pose) else { continue };
        let status = if pose.is_accepted() { "accepted" } else { "refused" };
        for bead in &pose.beads {
            let pixels = |at: Option<[f64; 2]>| at.unwrap_or([f64::NAN; 2]).map(number);
            let mut row = vec![frame.to_string(), label(frames, *frame), status.to_owned(), bead.name.clone(), bead.body.clone()];
            row.extend(bead.lps_mm.to_array().map(number));
            row.extend([bead.image_px, bead.predicted_px, bead.residual_px].map(pixels).into_iter().flatten());
            row.extend([
                or_empty(bead.sigma_px),
                u8::from(bead.used).to_string(),
                u8::from(bead.check).to_string(),
                bead.reason.clone().unwrap_or_default(),
            ]);
            table.row(row)?;
        }
    }
    Ok(())
}

/// Scores without a null, in the order of their file.
const OTHER_SCORES: [&str; 3] = ["edge_distance_mm", "bias_nepers", "noise_nepers"];

pub(super) fn write_scores(table: &mut Table, frames: &Frames, pairs: &BTreeMap<u32, Pair>) -> Result<(), LogbookError> {
    let head = ["frame", "label", "time_us", "status", "pose_source", "binding", "rms_px", "rms_mm", "render_error"];
    let with_null = NULL_SCORES.iter().flat_map(|(name, _)| [(*name).to_owned(), format!("{name}_null_margin")]);
    let others = OTHER_SCORES.iter().map(|name| (*name).to_owned());
    table.head(head.map(str::to_owned).into_iter().chain(with_null).chain(others))?;
    for (frame, pair) in pairs {
        let mut row = vec![
            frame.to_string(),
            label(frames, *frame),
            or_empty(pair.time_us),
            word(&pair.status),
            word(&pair.pose_source),
            pair.binding.clone(),
            or_empty(pair.rms_px),
            or_empty(pair.rms_mm),
            or_empty(pair.render_error),
        ];
        for (name, larger_is_better) in NULL_SCORES {
            let margin = pair.null.get(name).and_then(|null| {
                let ahead = null.at_pose? - null.best_shifted?;
                Some(if larger_is_better { ahead } else { -ahead })
            });
            row.extend([of(&pair.scores, name), or_empty(margin)]);
        }
        row.extend(OTHER_SCORES.map(|name| of(&pair.scores, name)));
        table.row(row)?;
    }
    Ok(())
}

fn of(scores: &Scores, name: &str) -> String {
    scores.get(name).map(number).unwrap_or_default()
}

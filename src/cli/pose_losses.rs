//! What a conversion of a pose does not keep or use, and what is doubtful in it, in sentences; and what the pixels' pitch must be by K.

use crate::geometry::formats::ExchangedCamera;
use crate::geometry::{ConsoleGeometry, Intrinsics, Rigid};
use crate::pose::Pose;

/// Relative difference of lengths that is rounding.
const ROUNDING: f64 = 1e-6;
/// Relative difference beyond which K and two pitches cannot both be meant; numbers that people round differ by less.
const CONTRADICTION: f64 = 1e-3;

/// What our pose file says of the picture and its parts that the file of another tool has no word for.
pub(super) fn unkept(pose: &Pose, format: &str) -> Vec<String> {
    let mut losses = Vec::new();
    if pose.mirrored && !pose.console.as_ref().is_some_and(ConsoleGeometry::is_mirrored) {
        losses.push(format!(
            "the frame is stored mirrored, the pose is for the un-mirrored picture (mirrored: true), and {format} has no word for \
             that: un-mirror the picture before this camera is used with it"
        ));
    }
    if let Some(console) = &pose.console {
        let undone = console.words().join(", ");
        if !undone.is_empty() {
            losses.push(format!(
                "the pose is for the picture with the console's doing undone ({undone}), and {format} has no word for that: turn and \
                 un-mirror the picture before this camera is used with it"
            ));
        }
    }
    let moved: Vec<&str> =
        pose.bodies.iter().filter(|body| body.lps_from_body != Rigid::IDENTITY).map(|body| body.name.as_str()).collect();
    if !moved.is_empty() {
        losses.push(format!("where {} moved since the scan is not kept", moved.join(", ")));
    }
    losses
        .extend(pose.cautions.iter().map(|caution| format!("the pose was accepted with caution, which is not kept: {caution}")));
    losses
}

/// What was typed of the panel and not used, as the pose has its own.
pub(super) fn unused(camera: &ExchangedCamera, size_px: Option<[u32; 2]>, k: Option<Intrinsics>) -> Vec<String> {
    let other_size = size_px.zip(camera.size_px).filter(|(typed, own)| typed != own);
    let size = other_size.map(|([columns, rows], [own_columns, own_rows])| {
        format!("--size {columns},{rows} is not used: POSE has its own, {own_columns} by {own_rows} pixels")
    });
    let alike = |a: &Intrinsics, b: &Intrinsics| {
        let pairs = a.to_rows().into_iter().flatten().zip(b.to_rows().into_iter().flatten());
        pairs.map(|(a, b)| (a - b).abs()).all(|apart| apart <= ROUNDING * a.fx)
    };
    let other_k = k.zip(camera.intrinsics).filter(|(typed, own)| !alike(typed, own));
    let k = other_k.map(|(typed, own)| {
        format!("K of --intrinsics (fx {:.1} px) is not used: POSE has its own (fx {:.1} px)", typed.fx, own.fx)
    });
    size.into_iter().chain(k).collect()
}

/// No patient's origin lies nearer to a focal spot: on the housing of the tube.
const NEAREST_ORIGIN_MM: f64 = 50.0;

/// What no C-arm does, though other tools' patients may lie anywhere.
pub(super) fn implausible(camera_from_lps: &Rigid) -> Option<String> {
    let origin_mm = camera_from_lps.translation_mm;
    let away_mm = origin_mm.length();
    if !(away_mm >= NEAREST_ORIGIN_MM) {
        return Some(format!("the focal spot lies {away_mm:.3} mm from the patient's origin: are its lengths in metres?"));
    }
    let behind = !(origin_mm.z > 0.0);
    behind.then(|| {
        format!(
            "the patient's origin lies {:.0} mm behind the focal spot: is it the inverse of a pose, or of a camera that looks along -z?",
            -origin_mm.z
        )
    })
}

/// A patient's origin may lie so far from what is X-rayed: at the head of a table, for feet.
const ORIGIN_OFF_MM: f64 = 1500.0;

/// The patient behind the panel, by K and the pitch: what is X-rayed lies before it.
pub(super) fn beyond_panel(camera: &ExchangedCamera) -> Option<String> {
    let distance_mm = camera.intrinsics?.source_to_detector_mm(camera.pitch_mm?[0]);
    let depth_mm = camera.camera_from_lps.translation_mm.z;
    (!(depth_mm <= distance_mm + ORIGIN_OFF_MM)).then(|| {
        format!(
            "the patient's origin lies {depth_mm:.0} mm from the focal spot, beyond the panel at {distance_mm:.0} mm (fx times pitch): is the pitch \
             that of K's pixels, in mm, or does the origin lie outside of the patient?"
        )
    })
}

/// K and the pitches of columns and rows say two distances from source to detector.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "pixels of {} by {} mm contradict K, by which rows are {expected_mm:.6} mm apart (fx and fy times pitch are one distance); give one \
     pitch, or the two that fit K",
    .found_mm[0], .found_mm[1]
)]
pub struct PitchContradiction {
    /// Between columns, between rows.
    pub found_mm: [f64; 2],
    /// Between rows, by K and the pitch between columns.
    pub expected_mm: f64,
}

/// Gives the camera the pitch between rows that follows from K, since fx · pitch and fy · pitch are one distance; what that changes,
/// and what a target with `one_pitch` loses, in sentences. `typed_mm` is the pitch of the command line, both alike where one was typed.
pub(super) fn settle_pitch(
    camera: &mut ExchangedCamera,
    typed_mm: Option<[f64; 2]>,
    one_pitch: bool,
) -> Result<Vec<String>, PitchContradiction> {
    let alike = |a: f64, b: f64, limit: f64| (a / b - 1.0).abs() <= limit;
    let Some(found_mm) = camera.pitch_mm else { return Ok(Vec::new()) };
    let [columns_mm, mut rows_mm] = found_mm;
    let mut said = Vec::new();
    if let Some(k) = camera.intrinsics {
        let expected_mm = columns_mm * k.fx / k.fy;
        if alike(columns_mm, rows_mm, ROUNDING) && !alike(rows_mm, expected_mm, ROUNDING) {
            rows_mm = expected_mm;
            said.push(format!(
                "pixels are not square by K (fx {}, fy {} px): {columns_mm} mm is taken for the pitch between columns, {rows_mm:.6} mm \
                 between rows follows",
                k.fx, k.fy
            ));
        } else if !alike(rows_mm, expected_mm, CONTRADICTION) {
            return Err(PitchContradiction { found_mm, expected_mm });
        }
    }
    camera.pitch_mm = Some([columns_mm, rows_mm]);
    let used = |[x, y]: &[f64; 2]| alike(*x, columns_mm, ROUNDING) && (x == y || alike(*y, found_mm[1], ROUNDING));
    if let Some([x, y]) = typed_mm.filter(|typed| !used(typed)) {
        said.push(format!("--pitch {x},{y} is not used: POSE has its own, {} by {} mm", found_mm[0], found_mm[1]));
    }
    if one_pitch && !alike(columns_mm, rows_mm, ROUNDING) {
        said.push(format!(
            "a pose file keeps one pitch_mm, that between columns ({columns_mm} mm); that between rows ({rows_mm:.6} mm) is in its notes"
        ));
    }
    Ok(said)
}

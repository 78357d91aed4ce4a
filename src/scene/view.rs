//! `view` of a scene file: K and pose, or P, or C-arm joints.

use super::SceneError;
use super::file::ViewFile;
use super::files::Files;
use crate::geometry::{CarmCalibration, CarmJoints, JOINT_KEYS, View};

/// Largest raster along one axis.
const MAX_SIZE_PX: u32 = 32_768;

/// What a view says: the camera, and the pitch where a calibration gives one.
pub(super) struct Resolved {
    pub view: View,
    pub pitch_mm: Option<f64>,
    /// Whether the camera is a P, which cannot tell a mirrored image from one taken backwards.
    pub by_projection: bool,
}

pub(super) fn resolve(file: &ViewFile, files: &mut Files) -> Result<Resolved, SceneError> {
    let given = [
        ("intrinsics", file.intrinsics.is_some()),
        ("camera_from_lps", file.camera_from_lps.is_some()),
        ("projection", file.projection.is_some()),
        ("carm", file.carm.is_some()),
        ("calibration", file.calibration.is_some()),
        ("world_from_lps", file.world_from_lps.is_some()),
    ];
    let keys: Vec<&str> = given.iter().filter(|(_, there)| *there).map(|(key, _)| *key).collect();
    let resolved = if let (Some(intrinsics), Some(camera_from_lps), 2) = (file.intrinsics, file.camera_from_lps, keys.len()) {
        let size_px = file.size_px.ok_or_else(|| no_size(files))?;
        Resolved { view: View { size_px, intrinsics, camera_from_lps }, pitch_mm: None, by_projection: false }
    } else if let (Some(projection), 1) = (file.projection, keys.len()) {
        let size_px = file.size_px.ok_or_else(|| no_size(files))?;
        let camera = |source| SceneError::Camera { place: files.place("view.projection"), source };
        let (intrinsics, camera_from_lps) = projection.decompose().map_err(camera)?;
        Resolved { view: View { size_px, intrinsics, camera_from_lps }, pitch_mm: None, by_projection: false }
    } else if let (Some(joints), Some(name), Some(world_from_lps), 3) =
        (file.carm, &file.calibration, file.world_from_lps, keys.len())
    {
        let calibration: CarmCalibration = files.read_json("view.calibration", name)?;
        check_joints(&joints, files)?;
        let carm = |source| SceneError::Carm { place: files.place("view.carm"), source };
        let camera_from_world = calibration.world_from_camera(&joints).map_err(carm)?.inverse();
        let intrinsics = calibration.intrinsics(&joints).map_err(carm)?;
        let calibrated_px = [calibration.columns_px, calibration.rows_px];
        let size_px = file.size_px.unwrap_or(calibrated_px);
        if size_px != calibrated_px {
            return Err(SceneError::Value {
                place: files.place("view.size_px"),
                found: format!("{size_px:?}"),
                expected: format!("{calibrated_px:?} of {name}, or no size"),
            });
        }
        Resolved {
            view: View { size_px, intrinsics, camera_from_lps: camera_from_world * world_from_lps },
            pitch_mm: Some(calibration.pitch_mm),
            by_projection: false,
        }
    } else {
        return Err(SceneError::Keys {
            place: files.place("view"),
            detail: format!(
                "found {}; expected intrinsics and camera_from_lps, or projection, or carm, calibration and world_from_lps",
                if keys.is_empty() { "no camera".to_owned() } else { keys.join(", ") }
            ),
        });
    };
    if !resolved.view.size_px.iter().all(|n| (1..=MAX_SIZE_PX).contains(n)) {
        return Err(SceneError::Value {
            place: files.place("view.size_px"),
            found: format!("{:?}", resolved.view.size_px),
            expected: format!("[columns, rows], each from 1 to {MAX_SIZE_PX}"),
        });
    }
    let (key, by_projection) = if file.projection.is_some() { ("view.projection", true) } else { ("view", false) };
    resolved.view.check().map_err(|source| SceneError::Camera { place: files.place(key), source })?;
    Ok(Resolved { by_projection, ..resolved })
}

/// A principal point farther from the middle than this share of the size is looked at, and is in the middle within the second.
const OFF_MIDDLE: f64 = 0.1;
const IN_MIDDLE: f64 = 0.02;

/// That the principal point, far from the middle, would be there if columns and rows were exchanged.
pub(super) fn swapped_size(view: &View) -> Option<String> {
    let [columns, rows] = view.size_px;
    let (cx, cy) = (view.intrinsics.cx, view.intrinsics.cy);
    let off = |[width, height]: [u32; 2]| {
        let of_side = |at: f64, side: u32| ((at + 0.5) / f64::from(side) - 0.5).abs();
        of_side(cx, width).max(of_side(cy, height))
    };
    (off([columns, rows]) > OFF_MIDDLE && off([rows, columns]) <= IN_MIDDLE).then(|| {
        format!(
            "the view's principal point ({cx:.1}, {cy:.1}) px is not in the middle of {columns} x {rows} px, but of {rows} x {columns}: \
             size_px is [columns, rows]: swapped?"
        )
    })
}

/// Focal spot to panel of any C-arm; metres and centimetres lie outside.
const DISTANCES_MM: (f64, f64) = (200.0, 5_000.0);
/// A carriage goes no further from its zero.
const TRAVEL_MM: (f64, f64) = (-10_000.0, 10_000.0);
/// What rounding adds to a full turn between degrees and radians.
const TURN_DEG: (f64, f64) = (-360.0 - 1e-9, 360.0 + 1e-9);

/// All joints of a view are there, and each is one that a C-arm has: a joint that telemetry does not report can be asked for elsewhere,
/// one that a scene leaves out would stand where nobody put it.
fn check_joints(joints: &CarmJoints, files: &Files) -> Result<(), SceneError> {
    for ((key, is_angle), value) in JOINT_KEYS.iter().zip(joints.to_array()) {
        let ((low, high), unit) = match (*is_angle, *key) {
            (true, _) => (TURN_DEG, "degrees"),
            (false, "source_to_detector_mm") => (DISTANCES_MM, "mm"),
            (false, _) => (TRAVEL_MM, "mm"),
        };
        let shown = if *is_angle { value.to_degrees() } else { value };
        if shown >= low && shown <= high {
            continue;
        }
        let found = if shown.is_nan() { "missing or null".to_owned() } else { format!("{shown:.6}") };
        let expected = format!("{low:.0} to {high:.0} {unit}; a view needs all seven joints");
        return Err(SceneError::Value { place: files.place(&format!("view.carm.{key}")), found, expected });
    }
    Ok(())
}

fn no_size(files: &Files) -> SceneError {
    SceneError::Keys { place: files.place("view"), detail: "size_px is missing; expected [columns, rows]".to_owned() }
}

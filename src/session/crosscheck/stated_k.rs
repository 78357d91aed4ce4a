//! K that a session states, against what else is known of its frames.

use super::finding::Finding;
use super::units::{PITCH_MM, PITCH_SHARE, length, sid};
use crate::scene::Scene;
use crate::session::file::Setup;

/// Lengths, the principal point, the scene's pitch and the size of the C-arm's frames; the newest frame's size is looked at with its pose.
pub(super) fn check_stated_k(setup: &Setup, scene: &Scene) -> Vec<Finding> {
    const CHECK: &str = "intrinsics";
    let Some(file) = &setup.intrinsics else { return Vec::new() };
    let (k, mut found) = (&file.intrinsics, Vec::new());
    if let Some(pitch_mm) = file.pitch_mm {
        found.extend(length(CHECK, "pitch_mm", pitch_mm, PITCH_MM));
        found.extend(sid(CHECK, "fx times pitch_mm", k.source_to_detector_mm(pitch_mm)));
        let of_scene = scene.detector.pitch_mm;
        if !((of_scene / pitch_mm - 1.0).abs() <= PITCH_SHARE) {
            let detail = format!("the scene's pitch is {of_scene} mm, that of the intrinsics {pitch_mm} mm");
            let remedy = "give both the pitch of the frames as they arrive (binned pixels are larger)";
            found.push(Finding::warn(CHECK, detail, remedy));
        }
    }
    if let Some([width, height]) = file.size_px {
        if !(k.cx > 0.0 && k.cx < f64::from(width) && k.cy > 0.0 && k.cy < f64::from(height)) {
            let detail = format!("the principal point ({}, {}) px lies outside {width} x {height} px", k.cx, k.cy);
            found.push(Finding::warn(CHECK, detail, "check size_px and intrinsics: binned together?"));
        }
        let of_carm = setup.carm.as_ref().map(|carm| [carm.columns_px, carm.rows_px]);
        if let Some([columns, rows]) = of_carm.filter(|of_carm| *of_carm != [width, height]) {
            let detail = format!("they are for {width} x {height} px, the C-arm's calibration for {columns} x {rows} px");
            found.push(Finding::warn(CHECK, detail, "give both for frames as they arrive"));
        }
    }
    if found.is_empty() {
        let size = file.size_px.map_or("any size".to_owned(), |[width, height]| format!("{width} x {height} px"));
        found.push(Finding::pass(CHECK, format!("f {:.1} px, for frames of {size}", k.fx)));
    }
    found
}

//! The files that a session needs, and the truth that it must not read before its end.

use std::path::Path;

use serde_json::{Value, json};

use crate::MockError;
use crate::delivery::Way;
use crate::dialect::Dialect;
use crate::drawn;
use crate::kinematics::{CarmGeometry, DRILL_LENGTH_MM, camera_from_lps, pieces, projection};
use crate::lab::{Device, Displacement, Exposure, Lab};
use crate::matrix::{Mat4, dot, mul, point, rotation, translation};
use crate::monitor::crop_px;
use crate::phantom::{Bead, Phantom};
use crate::script::Script;
use crate::storescu::{CALLED, CALLING};
use crate::voxels::voxelise;

/// Geometry of the lab's C-arm and the size of its frames.
#[derive(Clone, Copy, Debug)]
pub struct Arm {
    /// The chain.
    pub geometry: CarmGeometry,
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Pixel size.
    pub pitch_mm: f64,
    /// Focal spot to detector.
    pub source_to_detector_mm: f64,
}

/// Reads the arm from the lab's calibration.
///
/// # Errors
/// When a number is missing.
pub fn arm(lab: &Lab) -> Result<Arm, MockError> {
    let list = |key: &str, index: usize| lab.carm[key][index].as_f64().unwrap_or(0.0);
    let (pitch_mm, source_to_detector_mm) = (lab.carm_number("pitch_mm")?, lab.carm_number("source_to_detector_mm")?);
    let geometry = CarmGeometry {
        column_to_isocentre_mm: std::array::from_fn(|i| list("column_to_isocentre_mm", i)),
        source_to_isocentre_mm: lab.carm_number("source_to_isocentre_mm")?,
        focal_px: source_to_detector_mm / pitch_mm,
        principal_px: [list("principal_point_px", 0), list("principal_point_px", 1)],
    };
    let size_px = [lab.carm_number("columns_px")? as usize, lab.carm_number("rows_px")? as usize];
    Ok(Arm { geometry, size_px, pitch_mm, source_to_detector_mm })
}

/// Where the specimen really lies at the `index`-th exposure, from 0.
#[must_use]
pub fn true_world_from_lps(lab: &Lab, index: usize) -> Mat4 {
    let at_first = displaced(&lab.world_from_lps, &lab.setup_error);
    match lab.moved_from {
        Some(first) if index >= first => displaced(&at_first, &lab.specimen_move),
        _ => at_first,
    }
}

/// Turned about the specimen's origin, then shifted in the room.
fn displaced(world_from_lps: &Mat4, by: &Displacement) -> Mat4 {
    let [rx, ry, rz] = by.rotation_deg;
    let [x, y, z] = by.translation_mm;
    let turned = mul(&mul(&rotation(0, rx), &rotation(1, ry)), &rotation(2, rz));
    mul(&mul(&translation(x, y, z), world_from_lps), &turned)
}

/// How the devices and their frames reach the receiver.
#[derive(Clone, Debug, Default)]
pub struct Wires<'a> {
    /// Ports of C-arm and robot, where they have one.
    pub ports: [Option<&'a str>; 2],
    /// Devices that print lines instead of sending packets.
    pub dialects: &'a [(Device, Dialect)],
    /// How frames come.
    pub way: Way,
}

/// Writes the lab kit into `folder`: CT, beads, landmarks, scene, calibrations, session and truth; C-arm and robot where they have a port, with
/// a declaration where they print lines. A CT is taken from `drawn` where it was kept there.
///
/// # Errors
/// When a file cannot be written.
pub fn write(folder: &Path, script: &Script, phantom: &Phantom, wires: &Wires, drawn: Option<&Path>) -> Result<(), MockError> {
    let lab = script.lab;
    for name in ["frames", wires.way.folder()] {
        std::fs::create_dir_all(folder.join(name)).map_err(MockError::io(folder.display()))?;
    }
    let ct = drawn::once(drawn, &format!("{phantom:?}"), || voxelise(phantom).packed())?;
    let path = folder.join("ct.nii.gz");
    std::fs::write(&path, ct).map_err(MockError::io(path.display()))?;
    put(folder, "carm.json", &lab.carm)?;
    put(folder, "robot.json", &lab.robot)?;
    put(folder, "detector.json", &detector(lab))?;
    put(folder, "beads.mrk.json", &markups(&phantom.beads, &format!("radius_mm={}", phantom.bead_radius_mm)))?;
    put(folder, "landmarks.mrk.json", &markups(&phantom.landmarks, ""))?;
    let (k, scene) = (intrinsics(&arm(lab)?), scene(lab, phantom));
    put(folder, "k.json", &k)?;
    put(folder, "scene.json", &scene)?;
    put(folder, "scene-001.json", &of_first_frame(lab, &arm(lab)?, scene, &k))?;
    let [mut carm, mut robot] = wires.ports.map(|port| port.map(|port| json!({"port": port, "baud": 921_600})));
    for (line, device, key, file) in
        [(&mut carm, Device::Carm, "calibration", "carm.json"), (&mut robot, Device::Robot, "model", "robot.json")]
    {
        let Some(line) = line else { continue };
        line[key] = file.into();
        if let Some((_, dialect)) = wires.dialects.iter().find(|(printing, _)| *printing == device) {
            let name = format!("{}-lines.json", device.name());
            put(folder, &name, &dialect.declaration(device))?;
            line["adapter"] = name.into();
        }
    }
    let mut session = json!({
        "carm": carm, "robot": robot, "frames": frames(lab, &wires.way)?, "scene": "scene.json", "beads": "beads.mrk.json",
        "landmarks": "landmarks.mrk.json", "world_from_lps": lab.world_from_lps, "world_from_tracker": null, "out": "session"
    });
    if matches!(wires.way, Way::Monitor(_) | Way::Recording(_)) {
        session["domain"] = "display".into();
    }
    put(folder, "session.json", &session)?;
    put(folder, "truth.json", &truth(script, phantom)?)
}

fn put(folder: &Path, name: &str, value: &Value) -> Result<(), MockError> {
    let path = folder.join(name);
    std::fs::write(&path, format!("{value:#}\n")).map_err(MockError::io(path.display()))
}

/// A list of points as 3D Slicer has it.
fn markups(points: &[Bead], description: &str) -> Value {
    let point = |(index, point): (usize, &Bead)| {
        json!({
            "id": (index + 1).to_string(), "label": point.name, "description": description,
            "associatedNodeID": "", "position": point.lps_mm, "orientation": [-1.0, -0.0, -0.0, -0.0, -1.0, -0.0, 0.0, 0.0, 1.0],
            "selected": true, "locked": false, "visibility": true, "positionStatus": "defined"
        })
    };
    json!({
        "@schema": "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/markups-schema-v1.0.3.json#",
        "markups": [{
            "type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "locked": false,
            "labelFormat": "%N-%d", "controlPoints": points.iter().enumerate().map(point).collect::<Vec<_>>(), "measurements": []
        }]
    })
}

/// The session's word of how frames come.
fn frames(lab: &Lab, way: &Way) -> Result<Value, MockError> {
    let mut frames = json!({"folder": "frames"});
    match way {
        Way::Folder => {}
        Way::Dicom(port) => frames["dicom"] = json!({"port": port, "ae_title": CALLED, "calling_ae_titles": [CALLING]}),
        Way::Monitor(file) | Way::Recording(file) => {
            let from = std::path::absolute(file).map_err(MockError::io(file.display()))?;
            frames["video"] = json!({"from": from, "crop_px": crop_px(arm(lab)?.size_px)});
        }
    }
    Ok(frames)
}

/// Place of the robot among the scene's objects.
const ROBOT: usize = 1;

fn scene(lab: &Lab, phantom: &Phantom) -> Value {
    let mut objects = vec![
        json!({"ct": {"path": "ct.nii.gz", "materials": "threshold"}}),
        json!({"robot": {"model": "robot.json", "lps_from_base": phantom.lps_from_base, "control_angles_deg": [0.0, 0.0, 0.0, 0.0, 0.0]}}),
    ];
    for bead in &phantom.beads {
        objects.push(json!({"sphere": {
            "centre_lps_mm": bead.lps_mm, "radius_mm": phantom.bead_radius_mm, "material": "steel_316l"}}));
    }
    json!({
        "objects": objects,
        "beam": {"tube_kvp": lab.tube_kvp, "anode_angle_deg": 12, "filtration_mm": {"aluminium": lab.aluminium_mm},
                 "photons_per_pixel": lab.photons_per_pixel},
        "detector": {"response": "energy", "pitch_mm": lab.carm["pitch_mm"], "gain": 1.0, "offset": 0.0},
        "model": {"formation": "deepdrr", "scatter": "off", "noise": false, "seed": 1}
    })
}

/// K of every frame: it is exact, and the same throughout.
fn intrinsics(arm: &Arm) -> Value {
    let (f, [cx, cy]) = (arm.geometry.focal_px, arm.geometry.principal_px);
    json!({"intrinsics": [[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]], "size_px": arm.size_px, "pitch_mm": arm.pitch_mm})
}

/// The scene of the first frame as the devices tell it: seen from where the joints put the camera, the robot bent by its angles.
fn of_first_frame(lab: &Lab, arm: &Arm, mut scene: Value, k: &Value) -> Value {
    let Some(exposure) = lab.exposures.first() else { return scene };
    let camera = camera_from_lps(&arm.geometry, &exposure.joints(), &lab.world_from_lps);
    scene["view"] = json!({"size_px": arm.size_px, "intrinsics": k["intrinsics"], "camera_from_lps": camera});
    scene["objects"][ROBOT]["robot"]["control_angles_deg"] = json!(exposure.control_deg);
    scene
}

fn detector(lab: &Lab) -> Value {
    json!({
        "origin": "the mock's own detector: linear, flat-field corrected, saturating at 65535",
        "columns_px": lab.carm["columns_px"], "rows_px": lab.carm["rows_px"], "pitch_mm": lab.carm["pitch_mm"], "response": "energy",
        "bits": 16, "air_value": lab.air_value, "offset_value": 0.0, "photons_per_pixel": lab.photons_per_pixel,
        "readout_sigma_value": lab.readout_sigma * lab.air_value
    })
}

fn truth(script: &Script, phantom: &Phantom) -> Result<Value, MockError> {
    let lab = script.lab;
    let arm = arm(lab)?;
    let frame = |(index, exposure): (usize, &Exposure)| {
        let camera = camera_from_lps(&arm.geometry, &exposure.joints(), &true_world_from_lps(lab, index));
        let projection = projection(&arm.geometry, &camera);
        let (_, end) = pieces(&exposure.control_deg);
        let tip = point(&mul(&phantom.lps_from_base, &end), [0.0, 0.0, DRILL_LENGTH_MM]);
        let [left, top, right, bottom] = exposure.field_mm.unwrap_or(lab.open_field_mm());
        let shown = |bead: &Bead| {
            let [x, y, depth] = projection.map(|row| dot([row[0], row[1], row[2]], bead.lps_mm) + row[3]);
            let [u, v] = [x / depth, y / depth];
            let [dx, dy] = [u - arm.geometry.principal_px[0], v - arm.geometry.principal_px[1]].map(|px| px * arm.pitch_mm);
            let in_field = dx > left && dx < right && dy > top && dy < bottom;
            json!({"name": bead.name, "image_px": [u, v], "in_field": in_field})
        };
        json!({
            "frame": frame_name(index), "exposure_counter": script.counter.then_some(index + 1), "projection": projection,
            "camera_from_lps": camera, "control_angles_deg": exposure.control_deg, "tip_lps_mm": tip,
            "beads": phantom.beads.iter().map(shown).collect::<Vec<_>>()
        })
    };
    let frames: Vec<Value> = lab.exposures.iter().take(script.count()).enumerate().map(frame).collect();
    let named = |points: &[Bead]| -> Vec<Value> { points.iter().map(|p| json!({"name": p.name, "lps_mm": p.lps_mm})).collect() };
    Ok(json!({
        "frames": frames, "landmarks": named(&phantom.landmarks), "beads": named(&phantom.beads), "air_value": lab.air_value,
        "world_from_lps": true_world_from_lps(lab, 0)
    }))
}

/// File name of the `index`-th frame, from 0.
#[must_use]
pub fn frame_name(index: usize) -> String {
    format!("frame-{:03}.dcm", index + 1)
}

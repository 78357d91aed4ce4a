//! The kit's files agree with each other and with the phantom.

use std::io::Read;
use std::path::Path;

use mock_lab::delivery::Way;
use mock_lab::dialect::Dialect;
use mock_lab::kinematics::{BODY_RADII_MM, DRILL_LENGTH_MM, DRILL_RADIUS_MM, SHAFT_RADIUS_MM};
use mock_lab::kit::{Wires, true_world_from_lps, write};
use mock_lab::lab::{Device, Lab};
use mock_lab::matrix::{inverse, mul, point};
use mock_lab::phantom::{Phantom, area_densities};
use mock_lab::script::Script;
use serde_json::Value;

use crate::folder;

fn json(folder: &Path, name: &str) -> Value {
    serde_json::from_str(&std::fs::read_to_string(folder.join(name)).expect(name)).expect(name)
}

#[test]
fn the_kit_is_whole_and_its_files_agree() {
    let folder = folder("kit");
    let (lab, phantom) = (Lab::embedded().expect("embedded"), Phantom::embedded().expect("embedded"));
    let script = Script { lab: &lab, duration_s: 20.0, exposures: usize::MAX, counter: true };
    let wires = Wires { ports: [Some("udp://127.0.0.1:5005"), None], ..Wires::default() };
    write(&folder, &script, &phantom, &wires, None).expect("written");
    let session = json(&folder, "session.json");
    assert!(session["robot"].is_null(), "no robot was asked for");
    assert_eq!(session["carm"]["port"], "udp://127.0.0.1:5005");
    for name in [&session["carm"]["calibration"], &session["scene"], &session["beads"]] {
        json(&folder, name.as_str().expect("a file"));
    }
    let truth = json(&folder, "truth.json");
    // The session's landmarks are those at which the truth is judged.
    let landmarks = json(&folder, session["landmarks"].as_str().expect("a file"));
    let stated = landmarks["markups"][0]["controlPoints"].as_array().expect("points");
    let known = truth["landmarks"].as_array().expect("points");
    assert!(known.len() >= 3 && stated.len() == known.len());
    for (stated, known) in stated.iter().zip(known) {
        assert_eq!((&stated["label"], &stated["position"]), (&known["name"], &known["lps_mm"]));
    }
    let frames = truth["frames"].as_array().expect("frames");
    assert!(frames.len() >= 6);
    let seen: Vec<usize> = frames
        .iter()
        .map(|frame| frame["beads"].as_array().expect("beads").iter().filter(|bead| bead["in_field"] == true).count())
        .collect();
    assert_eq!(seen.iter().filter(|count| **count < 4).count(), 1, "one exposure shows too few beads: {seen:?}");
    assert!(seen.iter().filter(|count| **count >= 8).count() >= 6, "{seen:?}");
    assert_eq!(json(&folder, "detector.json")["air_value"], truth["air_value"]);

    // K of the file is that of the truth, and the scene with a view is the session's scene.
    let k = json(&folder, "k.json");
    let number = |value: &Value| value.as_f64().expect("a number");
    for frame in frames {
        let (camera, projection) = (&frame["camera_from_lps"], &frame["projection"]);
        for (row, column) in (0..3).flat_map(|row| (0..4).map(move |column| (row, column))) {
            let by_k: f64 = (0..3).map(|n| number(&k["intrinsics"][row][n]) * number(&camera[n][column])).sum();
            assert!((by_k - number(&projection[row][column])).abs() < 1e-6, "{row} {column}: {by_k}");
        }
    }
    let (scene, mut seen) = (json(&folder, "scene.json"), json(&folder, "scene-001.json"));
    assert!(scene["view"].is_null() && seen["view"]["size_px"] == k["size_px"]);
    let bent = seen["objects"][1]["robot"]["control_angles_deg"].take();
    assert_eq!(bent, frames[0]["control_angles_deg"]);
    seen["objects"][1]["robot"]["control_angles_deg"] = scene["objects"][1]["robot"]["control_angles_deg"].clone();
    assert_eq!(seen["objects"], scene["objects"]);

    let mut bytes = Vec::new();
    let file = std::fs::File::open(folder.join("ct.nii.gz")).expect("ct");
    flate2::read::GzDecoder::new(file).read_to_end(&mut bytes).expect("unpacks");
    let size = |axis: usize| usize::from(u16::from_le_bytes([bytes[42 + 2 * axis], bytes[43 + 2 * axis]]));
    assert_eq!(bytes.len(), 352 + 2 * size(0) * size(1) * size(2));
    let sform = |row: usize, column: usize| {
        let at = 280 + 16 * row + 4 * column;
        f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
    };
    // Column 0 runs towards patient left: −x in RAS. The grid is centred on the origin.
    assert!(sform(0, 0) < 0.0 && (sform(0, 3) + sform(0, 0) * 0.5 * (size(0) as f32 - 1.0)).abs() < 1e-4);

    // Beer's paths through the voxels and through the shapes are the same matter: total mass within 1 %.
    let hu = |index: usize| f64::from(i16::from_le_bytes([bytes[352 + 2 * index], bytes[353 + 2 * index]]));
    let count = size(0) * size(1) * size(2);
    let in_voxels: f64 =
        (0..count).map(hu).filter(|hu| *hu > phantom.air_below_hu).map(|hu| phantom.density_of_hu(hu) * 1e-3).sum();
    let in_shapes = mass_g(&phantom, 0.0);
    assert!((in_voxels / in_shapes - 1.0).abs() < 0.01, "{in_voxels} g, {in_shapes} g");
    assert!((in_voxels / mass_g(&phantom, 0.02) - 1.0).abs() > 0.01, "control");
    std::fs::remove_dir_all(folder).expect("removed");
}

/// Mass of the tissue from its closed-form paths along y, every 0.5 mm; `excess` makes it wrong.
fn mass_g(phantom: &Phantom, excess: f64) -> f64 {
    let (tissue, step) = (phantom.tissue(), 0.5);
    let mut scratch = Vec::new();
    let mut sum = 0.0;
    for i in -130..130 {
        for k in -115..115 {
            let (x, z) = ((f64::from(i) + 0.5) * step, (f64::from(k) + 0.5) * step);
            let paths = area_densities(&tissue, [x, -200.0, z], [x, 200.0, z], &mut scratch);
            sum += paths.iter().sum::<f64>() * step * step * 0.01;
        }
    }
    sum * (1.0 + excess)
}

#[test]
fn the_session_says_how_devices_speak_and_how_frames_come() {
    let (lab, phantom) = (Lab::embedded().expect("embedded"), Phantom::embedded().expect("embedded"));
    let script = Script { lab: &lab, duration_s: 20.0, exposures: 1, counter: true };
    let folder = folder("wires");
    let session_of = |dialects: &[(Device, Dialect)], way: Way| {
        let wires = Wires { ports: [Some("ttyCARM"), Some("file:robot.log")], dialects, way };
        write(&folder, &script, &phantom, &wires, None).expect("written");
        json(&folder, "session.json")
    };
    let plain = session_of(&[], Way::Folder);
    assert!(plain["robot"]["adapter"].is_null() && plain["frames"] == serde_json::json!({"folder": "frames"}), "{plain:#}");
    let session = session_of(&[(Device::Robot, Dialect::Json)], Way::Dicom(11_112));
    assert!(session["carm"]["adapter"].is_null() && session["robot"]["port"] == "file:robot.log", "{session:#}");
    assert_eq!((&session["frames"]["dicom"]["port"], &session["domain"]), (&serde_json::json!(11_112), &Value::Null));
    let declared = json(&folder, session["robot"]["adapter"].as_str().expect("a declaration"));
    assert_eq!(declared, Dialect::Json.declaration(Device::Robot));
    let session = session_of(&[], Way::Monitor(folder.join("monitor.y4m")));
    assert_eq!(session["domain"], "display");
    assert_eq!(session["frames"]["video"]["crop_px"], serde_json::json!([50, 0, 620, 480]));
    assert!(folder.join("exported").is_dir());
    std::fs::remove_dir_all(folder).expect("removed");
}

#[test]
fn a_specimen_that_is_moved_lies_elsewhere_from_then_on() {
    let (unmoved, phantom) = (Lab::embedded().expect("embedded"), Phantom::embedded().expect("embedded"));
    let moved = Lab { moved_from: Some(3), ..unmoved.clone() };
    for index in 0..unmoved.exposures.len() {
        let (before, now) = (true_world_from_lps(&unmoved, index), true_world_from_lps(&moved, index));
        let turned = mul(&inverse(&before), &now);
        let turn_deg = (0.5 * (turned[0][0] + turned[1][1] + turned[2][2] - 1.0)).clamp(-1.0, 1.0).acos().to_degrees();
        let [was, is] = [&before, &now].map(|world_from_lps| point(world_from_lps, [0.0; 3]));
        let shift_mm = was.iter().zip(is).map(|(was, is)| (is - was).powi(2)).sum::<f64>().sqrt();
        match index {
            0..3 => assert_eq!(before, now, "exposure {index}"),
            _ => assert!((shift_mm - 15.0).abs() < 1e-9 && (turn_deg - 4.0).abs() < 1e-6, "{shift_mm} mm, {turn_deg} degrees"),
        }
    }
    // The truth of the kit follows.
    let folder = folder("moved");
    let truth_of = |lab: &Lab| {
        let script = Script { lab, duration_s: 20.0, exposures: usize::MAX, counter: true };
        let wires = Wires { ports: [Some("ttyCARM"), Some("ttyROBOT")], ..Wires::default() };
        write(&folder, &script, &phantom, &wires, None).expect("written");
        json(&folder, "truth.json")
    };
    let (before, now) = (truth_of(&unmoved), truth_of(&moved));
    std::fs::remove_dir_all(&folder).expect("removed");
    assert_eq!(before["world_from_lps"], now["world_from_lps"]);
    for index in 0..unmoved.exposures.len() {
        assert_eq!(before["frames"][index] == now["frames"][index], index < 3, "exposure {index}");
    }
}

#[test]
fn exposures_are_taken_at_the_stands_that_are_asked_for() {
    let lab = Lab::embedded().expect("embedded");
    let stands = lab.clone().at_stands(&[1, 2, 2]).expect("they are there").exposures;
    for (index, stand) in [0, 1, 1, 3].into_iter().enumerate() {
        let (taken, scripted) = (&stands[index], &lab.exposures[index]);
        assert_eq!((taken.joints(), taken.field_mm), (lab.exposures[stand].joints(), lab.exposures[stand].field_mm));
        assert_eq!((taken.at, taken.control_deg), (scripted.at, scripted.control_deg));
    }
    let wrong: [&[usize]; 3] = [&[0], &[99], &[1; 99]];
    for wrong in wrong {
        assert!(lab.clone().at_stands(wrong).is_err(), "{wrong:?}");
    }
}

#[test]
fn the_robot_s_model_says_what_the_mock_draws() {
    let robot = Lab::embedded().expect("embedded").robot;
    let said = |part: &str, key: &str| robot[part][key].as_f64().expect(key);
    assert_eq!([said("body", "outer_diameter_mm"), said("body", "inner_diameter_mm")], BODY_RADII_MM.map(|radius| 2.0 * radius));
    assert_eq!(said("shaft", "diameter_mm"), 2.0 * SHAFT_RADIUS_MM);
    assert_eq!([said("drill", "length_mm"), said("drill", "diameter_mm")], [DRILL_LENGTH_MM, 2.0 * DRILL_RADIUS_MM]);
}

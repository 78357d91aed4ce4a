//! `sidecarm calibrate robot` as a person runs it: files, a session's log, what a scene makes of the result.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use sidecarm::calibrate::robot::RobotReport;
use sidecarm::geometry::{Rigid, RobotCalibration};
use sidecarm::pose::Pose;
use sidecarm::reporter::Reporter;
use sidecarm::scene::{SceneError, load, load_text};

use crate::robot_lab::{SIX, write};
use crate::session_demo::demo;

fn calibrate(shots: &[PathBuf], more: &[&str], out: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.args(["calibrate", "robot"]).args(shots).args(more).args(["--origin", "a test", "--json", "--out"]).arg(out);
    command.current_dir(env!("CARGO_MANIFEST_DIR")).output().expect("sidecarm runs")
}

fn said(run: &Output) -> String {
    String::from_utf8_lossy(&run.stderr).into_owned()
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

#[test]
fn the_command_writes_a_calibration_that_a_scene_takes() {
    let folder = tempfile::tempdir().expect("scratch");
    let drawn = SIX.drawn();
    let paths = write(folder.path(), &SIX, &drawn);
    let (out, scene) = (folder.path().join("robot-lab.json"), folder.path().join("scene.json"));
    let table = folder.path().join("angles.csv");
    let more = ["--domain", "linear", "--angles", text(&table), "--scene", text(&scene)];

    let stray = folder.path().join("stray.json");
    std::fs::copy(&paths[0], &stray).expect("copied");
    let refused = calibrate(&[stray], &more, &out);
    assert_eq!(refused.status.code(), Some(1));
    assert!(said(&refused).contains("add a line `stray,"), "{}", said(&refused));
    let over = calibrate(&paths, &more, &folder.path().join("frame-1.tif"));
    assert!(over.status.code() == Some(1) && said(&over).contains("frame-1.tif"), "{}", said(&over));
    assert!(!out.exists(), "nothing half-written");

    // A pose that may be another one makes a shot all the same: that is said, and stands with the shot.
    let doubted = Pose { doubt: Some("two shadows run into one".to_owned()), ..drawn.poses[2].clone() };
    doubted.write(&paths[2]).expect("written");
    let done = calibrate(&paths, &more, &out);
    assert_eq!(done.status.code(), Some(0), "{}", said(&done));
    let warned = said(&done).matches("pose-2 is a shot, but its pose is in doubt: two shadows run into one").count();
    assert!(warned == 1 && said(&done).matches("in doubt").count() == 1, "{}", said(&done));
    let report: RobotReport = serde_json::from_slice(&done.stdout).expect("the report");
    let in_doubt: Vec<bool> = report.shots.iter().map(|shot| shot.doubt.as_ref() == doubted.doubt.as_ref()).collect();
    assert_eq!(in_doubt, [false, false, true, false, false, false], "{report:?}");
    assert_eq!(std::fs::read(folder.path().join("robot-lab.report.json")).expect("beside it"), done.stdout);
    assert!(std::fs::read_to_string(folder.path().join("robot-lab.svg")).expect("plot").starts_with("<svg"));
    assert!(report.shots.len() == 6 && report.undetermined_offsets.is_empty(), "{report:?}");
    let calibration: RobotCalibration = serde_json::from_slice(&std::fs::read(&out).expect("written")).expect("reads");
    assert!(calibration.origin.contains("a test; the robot's shadow in 6 frames"), "{}", calibration.origin);

    // The scene with the calibration in place of its own base has the robot's tip where it is.
    let mut value = drawn.scene_json();
    value["objects"][0]["robot"]["calibration"] = "robot-lab.json".into();
    let both = load_text(&value.to_string(), &scene, false, &Reporter::silent());
    assert!(matches!(&both, Err(SceneError::Keys { detail, .. }) if detail.contains("lps_from_base")), "{:?}", both.err());
    value["objects"][0]["robot"].as_object_mut().expect("keys").remove("lps_from_base");
    value["objects"][0]["robot"]["control_angles_deg"] = json!(drawn.readings_deg[2]);
    let taken = load_text(&value.to_string(), &scene, false, &Reporter::silent()).expect("a scene");
    let robot = taken.robot.as_ref().expect("the robot");
    let angles = std::array::from_fn(|k| robot.control_angles_deg[k] + robot.control_angle_offsets_deg[k]);
    let shape = robot.model.shape(&angles).expect("finite");
    let tip = (robot.lps_from_base * shape.base_from_tip).translation_mm;
    assert!(tip.distance(DVec3::from_array(drawn.snakes[2].tip())) < 0.4, "{tip} {:?}", drawn.snakes[2].tip());
    assert!(taken.inputs.iter().any(|input| input.path == "robot-lab.json"), "{:?}", taken.inputs);
    // A session's telemetry goes through the same offsets.
    let moved = taken.with_robot(drawn.readings_deg[0], None).expect("bends");
    let solids = |scene: &sidecarm::scene::Scene| format!("{:?}", scene.objects[0].matter);
    assert_ne!(solids(&moved), solids(&taken));
    let back = moved.with_robot(drawn.readings_deg[2], None).expect("bends");
    assert_eq!(solids(&back), solids(&taken));
}

/// A tracked base that moves between the shots: what is sought is the base in the marker's frame, and scenes put the robot there.
#[test]
fn a_tracked_base_is_calibrated_against_its_marker() {
    let folder = tempfile::tempdir().expect("scratch");
    let drawn = SIX.drawn();
    let paths = write(folder.path(), &SIX, &drawn);
    let turned =
        |x: f64, y: f64, at: DVec3| Rigid { rotation: DQuat::from_rotation_x(x) * DQuat::from_rotation_y(y), translation_mm: at };
    let world_from_lps = turned(0.3, -0.2, DVec3::new(800.0, 20.0, 1000.0));
    let world_from_tracker = turned(-1.1, 0.4, DVec3::new(-500.0, 900.0, 1700.0));
    let truth = turned(0.05, -0.04, DVec3::new(4.0, -3.0, 5.0));
    let tie = folder.path().join("tie.json");
    std::fs::write(&tie, json!({"world_from_lps": world_from_lps, "world_from_tracker": world_from_tracker}).to_string())
        .expect("written");
    let lps_from_base = crate::robot_lab::rigid(&drawn.base);
    let row = |n: usize| {
        let tracked = world_from_tracker.inverse() * world_from_lps * lps_from_base * truth.inverse();
        let mut row = json!({"image": format!("frame-{n}.tif"), "control_angles_deg": drawn.readings_deg[n]});
        if n != 3 {
            row["tracker_from_base"] = json!(tracked);
        }
        (format!("pose-{n}"), row)
    };
    let table = folder.path().join("angles.json");
    let rows: serde_json::Map<String, Value> = (0..6).map(row).collect();
    std::fs::write(&table, Value::from(rows).to_string()).expect("written");
    let (out, scene) = (folder.path().join("marker.json"), folder.path().join("scene.json"));
    let more = ["--domain", "linear", "--angles", text(&table), "--scene", text(&scene), "--tracker", text(&tie)];
    let done = calibrate(&paths, &more, &out);
    assert_eq!(done.status.code(), Some(0), "{}", said(&done));
    assert!(said(&done).contains("pose-3 is no shot: there is no tracked base"), "{}", said(&done));
    let calibration: RobotCalibration = serde_json::from_slice(&std::fs::read(&out).expect("written")).expect("reads");
    let found = calibration.marker_from_base.expect("in the marker's frame");
    assert!(calibration.lps_from_base.is_none());
    let off = (found.translation_mm.distance(truth.translation_mm), found.angle_to_rad(&truth).to_degrees());
    assert!(off.0 < 0.3 && off.1 < 1.2, "{off:?}");

    let mut value = drawn.scene_json();
    value["objects"][0]["robot"]["calibration"] = "marker.json".into();
    let taken = load_text(&value.to_string(), &scene, false, &Reporter::silent()).expect("a scene");
    let tracked = world_from_lps.inverse() * world_from_tracker * world_from_tracker.inverse() * world_from_lps * lps_from_base;
    let moved = taken.with_robot([0.0; 5], Some(tracked * truth.inverse())).expect("bends").robot.expect("the robot");
    assert!(moved.lps_from_base.translation_mm.distance(lps_from_base.translation_mm) < 0.3, "{:?}", moved.lps_from_base);
}

/// The mocked laboratory draws its frames by a physics of its own; the log of a session there has poses, angles and frames.
#[test]
fn a_session_s_log_calibrates_the_robot_that_was_in_it() {
    let Some((lab, _)) = demo() else { return };
    let folder = tempfile::tempdir().expect("scratch");
    let kit = lab.join("scene.json");
    let mut value: Value = serde_json::from_slice(&std::fs::read(&kit).expect("the kit's scene")).expect("JSON");
    let truth = load(&kit, false, &Reporter::silent()).expect("a scene").robot.expect("a robot").lps_from_base;
    let objects = value["objects"].as_array_mut().expect("objects");
    let robot = objects.iter_mut().find_map(|object| object.get_mut("robot")).expect("a robot");
    let turn = Rigid::rotation(DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 4f64.to_radians()));
    let guess = Rigid::translation(DVec3::new(5.0, -4.0, 6.0)) * truth * turn;
    robot["lps_from_base"] = json!(guess);
    let rough = lab.join("rough.json");
    std::fs::write(&rough, value.to_string()).expect("written");
    let out = folder.path().join("robot.json");
    let done = calibrate(&[lab.join("session/session.mcap")], &["--scene", text(&rough)], &out);
    assert!(matches!(done.status.code(), Some(0 | 3)), "{}", said(&done));
    let report: RobotReport = serde_json::from_slice(&done.stdout).expect("the report");
    let found = report.calibration.lps_from_base.expect("in the specimen");
    let off = (found.translation_mm.distance(truth.translation_mm), found.angle_to_rad(&truth).to_degrees());
    let offset = report.calibration.control_angle_offsets_deg.iter().fold(0.0f64, |most, offset| most.max(offset.abs()));
    println!("{off:?} {offset} {} shots, {:?}", report.shots.len(), report.left_out);
    assert!(off.0 < 0.3 && off.1 < 1.2 && offset < 0.2, "{off:?} {offset}: {report:#?}");
    assert!(report.shots.len() >= 4, "{report:#?}");
}

//! What `calibrate carm` takes for a shot: poses of logs, of consoles that turn, of bodies that moved; and what it refuses.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use glam::{DVec2, DVec3};
use serde_json::{Value, json};
use sidecarm::calibrate::carm::{CarmFitError, CarmReport, NoShot, Shot, calibrate};
use sidecarm::geometry::{CarmJoints, Rigid};
use sidecarm::pose::Pose;
use sidecarm::record::{Provenance, Recorder, topic};
use sidecarm::timeline::{Answer, Binding, BindingFlag, ExposureInterval, Support};

use crate::calibrate_carm::{GOOD, GOOD_LAB, Lab, nominal, pose_of};
use crate::carm_arm::{Arm, Bed};

fn shots(seed: u64) -> Vec<Shot> {
    Lab { seed, ..GOOD_LAB }.shots(&Arm::drawn(seed), &Bed::drawn(seed))
}

fn bound(joints: CarmJoints, flags: Vec<BindingFlag>) -> Binding {
    let value = joints;
    let (gap_us, age_us, uncertainty_us) = (20_000, 10_000, 100.0);
    let answer = Answer { value, support: Support::Between, gap_us, age_us, uncertainty_us, across_break: false };
    let exposure = ExposureInterval {
        index: 0,
        counter: None,
        epoch: 1,
        start_us: 0,
        end_us: 100_000,
        segment: 0,
        device_us: [0, 100_000],
        start_uncertainty_us: 1.0,
        end_uncertainty_us: 1.0,
        open: false,
        start_seen: true,
        end_seen: true,
        samples: 5,
        tube_kvp: 80.0,
        tube_ma: 2.0,
        joints: Some(answer),
        beam: None,
        joint_range: [0.0; 7],
        control_angles_deg: None,
        tracker_from_base: None,
    };
    Binding { exposure: Some(exposure), flags, ..Binding::default() }
}

fn command(folder: &Path, shots: &Path, more: &[&str]) -> std::process::Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.args(["calibrate", "carm"]).arg(shots).args(["--calibration", "calibration/carm/nominal-mobile.json"]);
    command.args(["--encoder-sigma-deg", "0.02", "--encoder-sigma-mm", "0.1", "--json", "--out"]).arg(folder.join("lab.json"));
    command.args(more).current_dir(env!("CARGO_MANIFEST_DIR")).output().expect("sidecarm runs")
}

/// As a session records them: one frame is refused, one bound to nothing, one taken while the arm moved, one posed again.
#[test]
fn a_log_gives_its_shots_and_says_what_is_none() {
    let folder = tempfile::tempdir().expect("scratch");
    let path = folder.path().join("session.mcap");
    let recorder = Recorder::create(&path, &Provenance::of_this_program(1_000, json!({}))).expect("created");
    let record = |number: usize, development: u32, binding: &Binding, pose: &Value| {
        let message = json!({"number": number, "development": development, "frame": format!("XA-{number}"), "pose_source": "beads",
            "camera_from_lps": null, "projection": null, "binding": binding, "control_angles_deg": null, "pose": pose});
        recorder.json(topic::POSE, 1_000, &message).expect("recorded");
    };
    let shots = shots(7);
    for (number, shot) in shots.iter().enumerate() {
        if number == 4 {
            // Before its exposure was known it had the joints of another.
            record(number, 0, &bound(shots[5].joints, Vec::new()), &pose_of(shot));
        }
        let mut pose = pose_of(shot);
        if number == 6 {
            pose["doubt"] = json!("two shadows run into one");
        }
        record(number, u32::from(number == 4), &bound(shot.joints, Vec::new()), &pose);
    }
    let mut refused = pose_of(&shots[0]);
    refused["status"] = "refused".into();
    record(20, 0, &bound(shots[0].joints, Vec::new()), &refused);
    record(21, 0, &Binding::default(), &pose_of(&shots[1]));
    // A run while the arm turns: every image would have the joints of its middle.
    let moved = BindingFlag::Moved { joint: "orbital", moved: 20.0, limit: 0.2 };
    record(22, 0, &bound(shots[2].joints, vec![moved, BindingFlag::Run { image: 3, count: 40 }]), &pose_of(&shots[3]));
    record(23, 0, &bound(shots[2].joints, vec![BindingFlag::TelemetryGap { gap_us: 900_000 }]), &pose_of(&shots[3]));
    recorder.finish().expect("finished");

    let done = command(folder.path(), &path, &[]);
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(0), "{said}");
    let report: CarmReport = serde_json::from_slice(&done.stdout).expect("the report");
    assert_eq!(report.shots.len(), 10);
    assert!(report.left_out.is_empty() && report.held_out_piercing_mm < 2.0, "{report:?}");
    for words in [
        "frame 20 (XA-20) is no shot: its pose was refused",
        "frame 21 (XA-21) is no shot: it is not bound",
        "frame 22 (XA-22) is no shot: the arm moved",
        "frame 23 (XA-23) is no shot: telemetry has a gap",
        "frame 6 (XA-6) is a shot, but its pose is in doubt: two shadows run into one",
    ] {
        assert!(said.contains(words), "{words}: {said}");
    }
    assert_eq!(said.matches("is in doubt").count(), 1, "{said}");
}

/// Joints as JSON, and one shot with those of another moment: it is named, and the exit code says that something was left out.
#[test]
fn a_shot_that_is_left_out_is_said_by_the_command() {
    let folder = tempfile::tempdir().expect("scratch");
    let mut shots = shots(6);
    shots[3].joints.orbital_rad += 8f64.to_radians();
    let joints: BTreeMap<&str, CarmJoints> = shots.iter().map(|shot| (shot.name.as_str(), shot.joints)).collect();
    let (table, first) = (folder.path().join("joints.json"), folder.path().join("shot-00.json"));
    std::fs::write(&table, serde_json::to_string(&joints).expect("JSON")).expect("written");
    let mut more = vec!["--joints".to_owned(), table.display().to_string()];
    for shot in &shots {
        let path = folder.path().join(format!("{}.json", shot.name));
        std::fs::write(&path, pose_of(shot).to_string()).expect("written");
        if path != first {
            more.push(path.display().to_string());
        }
    }
    let done = command(folder.path(), &first, &more.iter().map(String::as_str).collect::<Vec<_>>());
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(3), "{said}");
    assert!(said.contains("warning: shot-03") && !said.contains("shot-04"), "{said}");
    let report: CarmReport = serde_json::from_slice(&done.stdout).expect("the report");
    assert_eq!((report.shots.len(), report.left_out.len()), (9, 1));
}

fn read(value: &Value) -> Pose {
    serde_json::from_value(value.clone()).expect("a pose")
}

/// The console binned the panel's picture, and turned it by 13 degrees about its middle: the shot is that of the panel.
#[test]
fn a_shot_of_a_console_is_in_the_panel_s_pixels() {
    let shot = &shots(3)[0];
    let mut value = pose_of(shot);
    let middle = DVec2::splat(383.5);
    let turn = DVec2::from_angle(13f64.to_radians());
    for (row, bead) in value["beads"].as_array_mut().expect("a list").iter_mut().zip(&shot.beads) {
        let binned = 0.5 * (bead.image_px + 0.5) - 0.5;
        row["image_px"] = json!((turn.rotate(binned - middle) + middle).to_array());
        row["sigma_px"] = json!(0.5 * bead.noise_px2[0].sqrt());
    }
    value["size_px"] = json!([768, 768]);
    value["console"] = json!({"rotation_deg": 13.0, "binning": 2});
    let of = |value: &Value| Shot::of("a", &read(value), shot.joints);
    assert_eq!(of(&value), Err(NoShot::PanelUnknown));
    value["detector"] = json!({"detector_from_image": [[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]], "size_px": [1536, 1536],
        "camera_from_lps": shot.camera_from_lps});
    value["camera_from_lps"] = json!(Rigid::IDENTITY);
    let found = of(&value).expect("a shot");
    assert_eq!((found.size_px, found.camera_from_lps), ([1536, 1536], read(&pose_of(shot)).camera_from_lps.expect("there")));
    for (found, truth) in found.beads.iter().zip(&shot.beads) {
        assert!(found.image_px.distance(truth.image_px) < 1e-9, "{found:?} {truth:?}");
        assert!(found.noise_px2.iter().zip(truth.noise_px2).all(|(found, truth)| (found - truth).abs() < 1e-12));
    }
    assert_eq!(found.beads.len(), shot.beads.len());
}

#[test]
fn beads_of_a_body_that_moved_are_no_beads_of_a_shot() {
    let shot = &shots(3)[1];
    let mut value = pose_of(shot);
    let count = shot.beads.len();
    for row in value["beads"].as_array_mut().expect("a list").iter_mut().take(3) {
        row["body"] = "femur".into();
    }
    let body = |name: &str, place: Rigid| json!({"name": name, "lps_from_body": place, "beads": 3, "used": 3});
    let beads = |value: &Value| Shot::of("a", &read(value), shot.joints).expect("a shot").beads.len();
    value["bodies"] = json!([body("specimen", Rigid::IDENTITY), body("femur", Rigid::IDENTITY)]);
    assert_eq!(beads(&value), count, "the control");
    value["bodies"] = json!([body("specimen", Rigid::IDENTITY), body("femur", Rigid::translation(DVec3::new(4.0, 0.0, 0.0)))]);
    assert_eq!(beads(&value), count - 3);
}

#[test]
fn shots_that_give_no_arm_are_refused_for_their_reason() {
    let good = shots(5);
    let refused = |change: &dyn Fn(&mut Vec<Shot>)| {
        let mut shots = good.clone();
        change(&mut shots);
        calibrate(&shots, &nominal(), &GOOD).map(|fit| fit.chi2_per_dof).expect_err("refused")
    };
    let size = refused(&|shots| shots[2].size_px = [768, 768]);
    assert!(
        matches!(&size, CarmFitError::Size { shot, found: [768, 768], expected: [1536, 1536] } if shot == "shot-02"),
        "{size}"
    );
    let few = refused(&|shots| shots[6].beads.truncate(3));
    assert!(matches!(&few, CarmFitError::TooFewBeads { shot, found: 3, .. } if shot == "shot-06"), "{few}");
    let joint = refused(&|shots| shots[1].joints.angulation_rad = f64::NAN);
    assert!(joint.to_string().contains("shot-01") && joint.to_string().contains("angulation_deg"), "{joint}");
    // Half of the joints are those of other moments.
    let mixed = refused(&|shots| (0..5).for_each(|n| shots[2 * n].joints.orbital_rad += 0.2 + 0.1 * n as f64));
    assert!(matches!(&mixed, CarmFitError::Residual { times, .. } if *times > 10.0), "{mixed}");
}

/// Of poses that rest on two layouts, the place that the first shot stated stood for all.
#[test]
fn shots_that_state_other_places_of_a_bead_are_named() {
    let mut shots = shots(8);
    shots[3].beads[2].lps_mm += DVec3::new(0.0, 0.0, 1.2);
    match calibrate(&shots, &nominal(), &GOOD) {
        Err(CarmFitError::OtherPlace { bead, shots: named, distance_mm, .. }) => {
            assert_eq!((bead.as_str(), named), ("bead-02", ["shot-00".to_owned(), "shot-03".to_owned()]));
            assert!((distance_mm - 1.2).abs() < 1e-9, "{distance_mm}");
        }
        other => panic!("{:?}", other.map(|fit| fit.chi2_per_dof)),
    }
}

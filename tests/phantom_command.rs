//! `sidecarm calibrate layout SHOTS…`, as it is typed, on drawn frames.

use std::process::{Command, Output};

use glam::DVec3;
use serde_json::{Value, json};
use sidecarm::beads::read_markups;
use sidecarm::calibrate::phantom::Phantom;
use sidecarm::geometry::{CarmCalibration, Intrinsics, View};
use sidecarm::image::write_tiff_f32;
use sidecarm::pose::Pose;

use crate::calibrate_carm::{camera_from_lps, nominal};
use crate::carm_arm::Arm;
use crate::phantom_lab::{Compared, Lab, RADIUS_MM, beads};
use crate::pose_synthetic::Radiograph;

#[test]
fn frames_with_joints_become_a_layout_for_slicer() {
    let lab = Lab { shots: 5, beads: beads(9, [110.0, 110.0, 90.0], 170), ..Lab::new(170) };
    let (arm, bed) = (Arm::straight(0.0, 0.0, [0.0; 2]), lab.bed());
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    // Pixels of twice the side, so that frames are soon read.
    let half = CarmCalibration { columns_px: 768, rows_px: 768, pitch_mm: 0.388, ..nominal() };
    std::fs::write(path("arm.json"), serde_json::to_string(&half).expect("JSON")).expect("written");
    let k = Intrinsics { fx: 1020.0 / 0.388, fy: 1020.0 / 0.388, skew: 0.0, cx: 383.5, cy: 383.5 };
    let mut table = "frame,lift_mm,wig_wag_deg,longitudinal_mm,angulation_deg,orbital_deg,detector_rotation_deg\n".to_owned();
    let mut noise = sidecarm::random::Stream::new(170, 53, 0, sidecarm::random::Purpose::Evaluation);
    let (mut frames, mut priors) = (Vec::new(), Vec::new());
    for (n, joints) in lab.joints().into_iter().enumerate() {
        let view = View { size_px: [768, 768], intrinsics: k, camera_from_lps: camera_from_lps(&arm.posture(joints), &bed) };
        let own = lab.beads.iter().map(|bead| (DVec3::from_array(*bead), RADIUS_MM)).collect();
        let drawn = Radiograph {
            view,
            beads: own,
            photons: 20_000.0,
            blur_px: 0.4,
            anatomy: false,
            metal: false,
            collimated: false,
            seed: n as u64,
        };
        let name = format!("shot-{n}.tif");
        write_tiff_f32(&path(&name), std::slice::from_ref(&drawn.draw())).expect("written");
        frames.push(name);
        // About the focal spot, to half a degree or less and 3 mm.
        let variance = |i: usize| if i < 3 { 0.005f64.powi(2) } else { 9.0 };
        let rows = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { variance(i) } else { 0.0 }));
        let prior = Pose {
            camera_from_lps: Some(view.camera_from_lps),
            covariance: Some(rows),
            doubt: (n == 3).then(|| "a mirror image".to_owned()),
            ..Pose::default()
        };
        prior.write(&path(&format!("prior-{n}.json"))).expect("written");
        priors.extend(["--prior".to_owned(), format!("prior-{n}.json")]);
        let [lift, wig_wag, longitudinal, angulation, orbital, rotation, _] = joints;
        let mut read = |joint: f64, sigma: f64| joint + sigma * noise.normal();
        let (lift, longitudinal) = (read(lift, 1.0), read(longitudinal, 1.0));
        let [wig_wag, angulation, orbital, rotation] = [wig_wag, angulation, orbital, rotation].map(|deg| read(deg, 0.2));
        table += &format!("shot-{n},{lift},{wig_wag},{longitudinal},{angulation},{orbital},{rotation}\n");
    }
    std::fs::write(path("joints.csv"), &table).expect("written");
    let run = |frames: &[String], words: &[&str]| -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        command.args(["calibrate", "layout"]).args(frames).args(["--domain", "linear", "--out", "phantom.mrk.json"]).args(words);
        command.current_dir(folder.path()).output().expect("runs")
    };
    let with_arm =
        ["--joints", "joints.csv", "--calibration", "arm.json", "--encoder-sigma-deg", "0.2", "--encoder-sigma-mm", "1"];
    let complaint = |out: &Output, expected: &str| {
        let words = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.code() == Some(1) && words.contains(expected), "{expected}: {out:?}");
    };
    complaint(&run(&frames, &[]), "images alone tell neither");
    complaint(&run(&frames, &["--prior", "joints.csv"]), "1 priors are given for 5 shots");
    complaint(&run(&frames[..2], &with_arm), "2 shots, a layout needs at least 3");
    assert!(!path("phantom.mrk.json").exists(), "nothing half-written");

    let done = run(&frames, &[&with_arm[..], &["--bead-radius", "1.5", "--json"]].concat());
    assert_eq!(done.status.code(), Some(0), "{}", String::from_utf8_lossy(&done.stderr));
    let phantom: Phantom = serde_json::from_slice(&done.stdout).expect("the report");
    assert_eq!(std::fs::read(path("phantom.report.json")).expect("beside it"), done.stdout);
    let compared = Compared::new(&phantom, &lab.beads);
    assert!(phantom.beads.len() == 9 && compared.shape_mm < 0.1, "{compared:?}");
    assert!(
        compared.larger_by.abs() < 3.0 * phantom.scale.sigma && phantom.scale.sigma < 0.03,
        "{compared:?} {:?}",
        phantom.scale
    );
    assert_eq!(phantom.scale.sources.len(), 2, "joints and radii");

    let layout = read_markups(&path("phantom.mrk.json")).expect("the project's own reader reads it");
    assert_eq!(layout.beads.len(), 9);
    for (read, own) in layout.beads.iter().zip(&phantom.beads) {
        assert!(
            read.name == own.name && read.lps_mm.distance(DVec3::from_array(own.mm)) < 1e-9 && read.radius_mm == Some(RADIUS_MM)
        );
        assert!((read.sigma_mm.expect("stated") - own.sigma_mm).abs() < 1e-4 && own.sigma_mm >= own.shape_sigma_mm);
    }
    let document: Value = serde_json::from_slice(&std::fs::read(path("phantom.mrk.json")).expect("written")).expect("JSON");
    assert_eq!(document["markups"][0]["type"], json!("Fiducial"));

    // Priors in place of joints: a doubt about one of them is said, and written.
    assert!(phantom.warnings.iter().all(|warning| !warning.contains("in doubt")), "{:?}", phantom.warnings);
    std::fs::write(path("K.json"), json!({"intrinsics": k, "size_px": [768, 768]}).to_string()).expect("written");
    let priors: Vec<&str> = priors.iter().map(String::as_str).collect();
    let by_priors = run(&frames, &[&priors[..], &["--intrinsics", "K.json", "--bead-radius", "1.5", "--json"]].concat());
    assert_eq!(by_priors.status.code(), Some(0), "{}", String::from_utf8_lossy(&by_priors.stderr));
    let doubt = "shot-3: the pose that its prior is read from is in doubt: a mirror image";
    assert_eq!(String::from_utf8_lossy(&by_priors.stderr).matches(doubt).count(), 1, "{by_priors:?}");
    let phantom: Phantom = serde_json::from_slice(&by_priors.stdout).expect("the report");
    assert_eq!(phantom.warnings.iter().filter(|warning| *warning == doubt).count(), 1, "{:?}", phantom.warnings);

    // The table of joints lacks a line; the layout is not written over a frame.
    let short: String = table.lines().take(5).map(|line| format!("{line}\n")).collect();
    std::fs::write(path("joints.csv"), short).expect("written");
    complaint(&run(&frames, &with_arm), "add a line `shot-4,");
}

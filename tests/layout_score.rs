//! A layout's score: what resembles itself, what is flat, what a planned view will give.

use std::process::Command;

use glam::DVec3;
use serde_json::{Value, json};
use sidecarm::calibrate::layout::{Planned, score};
use sidecarm::geometry::Intrinsics;

use crate::pose_intrinsics::beads;
use crate::pose_synthetic as synthetic;

fn boxed() -> Vec<DVec3> {
    let corner = |n: i32| DVec3::new(f64::from(n & 1) * 70.0, f64::from(n >> 1 & 1) * 50.0, f64::from(n >> 2) * 40.0);
    (0..8).map(corner).collect()
}

#[test]
fn a_box_resembles_itself_and_scattered_beads_do_not() {
    let symmetric = score(&synthetic::layout_of(&boxed(), 0.75), 1.0, None);
    let found = symmetric.self_match.expect("eight beads");
    assert!(found.beads == 8 && (found.angle_deg - 180.0).abs() < 1e-6 && found.rms_mm < 1e-6, "{found:?}");
    assert!(found.pairs.iter().all(|[from, to]| from != to));
    assert_eq!(symmetric.mirrored_match.map(|found| found.beads), Some(8));
    assert!(symmetric.warnings.iter().any(|warning| warning.starts_with("alike")), "{:?}", symmetric.warnings);

    // One corner moved breaks a part of it, and says how much is left.
    let mut places = boxed();
    places[0] += DVec3::new(9.0, 5.0, 7.0);
    let broken = score(&synthetic::layout_of(&places, 0.75), 1.0, None);
    assert_eq!(broken.self_match.map(|found| found.beads), Some(6));

    let scattered = score(&beads(10, 4), 1.0, None);
    assert!(scattered.warnings.is_empty(), "the control: {:?}", scattered.warnings);
    assert!(scattered.self_match.is_none_or(|found| found.beads <= 4) && scattered.flatness > 0.4);
}

/// Every three beads of a plate fall on some hundreds of others; trying them all took hours.
#[test]
fn a_plate_of_a_hundred_beads_is_scored_in_part_and_said_to_be() {
    let cell = |n: i32| DVec3::new(f64::from(n % 10) * 10.0, f64::from(n / 10) * 10.0, 0.0);
    let plate: Vec<DVec3> = (0..100).filter(|n| ![17, 42, 58].contains(n)).map(cell).collect();
    let plate = score(&synthetic::layout_of(&plate, 0.75), 1.0, None);
    assert!(plate.self_match.is_some_and(|found| found.beads >= 90), "{:?}", plate.warnings);
    assert!(plate.notes.iter().any(|note| note.contains("not every three")), "{:?}", plate.notes);
    assert!(score(&beads(20, 4), 1.0, None).notes.is_empty(), "control");
}

#[test]
fn a_flat_layout_is_said_to_be_flat_and_is_its_own_mirror_image() {
    let mut layout = beads(9, 2);
    layout.beads.iter_mut().for_each(|bead| bead.lps_mm.z *= 0.01);
    let flat = score(&layout, 1.0, None);
    assert!(flat.flatness < 0.05 && flat.warnings[0].starts_with("flat"), "{:?}", flat.warnings);
    assert_eq!(flat.mirrored_match.map(|found| found.beads), Some(9));
}

#[test]
fn a_prediction_is_what_the_beads_scatter_allows() {
    let layout = beads(9, 6);
    let k = Intrinsics { fx: 3480.0, fy: 3480.0, skew: 0.0, cx: 511.5, cy: 511.5 };
    let planned = Planned {
        intrinsics: k,
        size_px: [1024, 1024],
        source_to_isocentre_mm: 680.0,
        orbital_deg: vec![0.0, 90.0],
        angulation_deg: vec![0.0],
        sigma_px: 1e-3,
        landmarks: vec![sidecarm::beads::Landmark { name: "middle".to_owned(), lps_mm: layout.centroid_lps_mm() }],
    };
    let views = score(&layout, 1.0, Some(&planned)).views;
    assert_eq!(views.len(), 2);
    for view in &views {
        // Shadows being exact, the centroid is known to the beads' σ over the root of their number.
        let expected_mm = 0.15 / (view.in_view as f64).sqrt();
        let [x, y, along] = view.centroid_mm.expect("enough beads");
        assert!(view.in_view >= 7, "{}", view.in_view);
        assert!((x / expected_mm - 1.0).abs() < 0.25 && (y / expected_mm - 1.0).abs() < 0.25, "{x} {y} {expected_mm}");
        assert!(along > 2.0 * x, "depth is worse: {along}");
        assert!((view.landmarks_mm[0].1 / x.max(y) - 1.0).abs() < 0.02, "{:?}", view.landmarks_mm);
    }
    let three = score(&beads(3, 6), 1.0, Some(&planned)).views;
    assert!(three.iter().all(|view| view.in_view == 3 && view.centroid_mm.is_none()), "three beads fit four poses");
    let none = Planned { size_px: [20, 20], ..planned };
    assert!(score(&layout, 1.0, Some(&none)).views[0].centroid_mm.is_none(), "no bead in view, no promise");
}

#[test]
fn the_command_scores_a_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, places: &[DVec3]| {
        let points: Vec<Value> =
            places.iter().enumerate().map(|(n, p)| json!({"label": format!("b{n}"), "position": p.to_array()})).collect();
        let text = json!({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}]});
        std::fs::write(folder.path().join(name), text.to_string()).expect("written");
    };
    write("box.mrk.json", &boxed());
    let scattered: Vec<DVec3> = beads(9, 4).beads.iter().map(|bead| bead.lps_mm).collect();
    write("good.mrk.json", &scattered);
    let k = json!({"intrinsics": [[3480, 0, 511.5], [0, 3480, 511.5], [0, 0, 1]], "size_px": [1024, 1024], "pitch_mm": 0.293});
    std::fs::write(folder.path().join("K.json"), k.to_string()).expect("written");
    let run = |words: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        command.args(["calibrate", "layout"]).args(words).current_dir(folder.path()).output().expect("runs")
    };
    let bad = run(&["--score", "box.mrk.json"]);
    assert_eq!(bad.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&bad.stderr).contains("warning: alike"), "{bad:?}");
    let verdict = |words: &[&str]| String::from_utf8_lossy(&run(words).stdout).lines().last().unwrap_or_default().to_owned();
    assert_eq!(verdict(&["--score", "box.mrk.json"]), "not good, for what is said below");
    assert_eq!(verdict(&["--score", "good.mrk.json"]), "good: neither flat nor like itself");
    let planned = ["--score", "good.mrk.json", "--intrinsics", "K.json", "--orbital=-30,60", "--angulation=0"];
    assert_eq!(verdict(&planned), "good: neither flat nor like itself, and gives a pose in all 2 views");
    let good = run(&["--score", "good.mrk.json", "--intrinsics", "K.json", "--orbital=-30,60", "--angulation=0", "--json"]);
    assert_eq!(good.status.code(), Some(0), "{good:?}");
    let answer: Value = serde_json::from_slice(&good.stdout).expect("one JSON object");
    assert_eq!(answer["views"].as_array().expect("a list").len(), 2);
    assert!(answer["views"][0]["centroid_mm"][0].is_f64(), "{answer}");
    let wrong = run(&["--score", "good.mrk.json", "--tolerance", "nan"]);
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("--tolerance is NaN"), "{wrong:?}");
}

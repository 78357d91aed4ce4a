//! `calibrate intensifier`: distortion from drawn frames of a grid, against the law that drew them.

use std::process::Command;

use glam::DVec2;
use serde_json::json;
use sidecarm::acquire::{Domain, Frame};
use sidecarm::calibrate::intensifier::{GridFrame, GridOf, GridRequest, IntensifierFault, calibrate};
use sidecarm::geometry::{AnglesDeg, AnglesFrom, Distortion, IntensifierCalibration};
use sidecarm::image::{Image, write_tiff_f32};
use sidecarm::pose::Pose;

use crate::intensifier_draw::{Drawn, Law, rms_apart};
use crate::pose_synthetic as synthetic;

/// What global polynomials of the fifth order leave in published measurements.
const LIMIT_PX: f64 = 0.2;

fn request(grid: GridOf) -> GridRequest {
    GridRequest {
        grid,
        pitch_mm: Some(10.0),
        order: 5,
        plate_moved: false,
        disc: None,
        angles_from: AnglesFrom::Given,
        glare: None,
        origin: "drawn".to_owned(),
    }
}

fn frame(drawn: &Drawn, angles_deg: Option<AnglesDeg>) -> GridFrame {
    GridFrame { frame: drawn.frame(), angles_deg }
}

fn calibrated(drawn: &Drawn) -> Result<IntensifierCalibration, IntensifierFault> {
    calibrate(&[frame(drawn, None)], &request(if drawn.holes { GridOf::Holes } else { GridOf::Beads }))
}

/// Distance of what was measured from the law, all over the disc, beads or not.
fn off_px(found: &Distortion, law: &Law) -> f64 {
    let pairs: Vec<(DVec2, DVec2)> = law.places(0.97).map(|p| (found.undistorted(p), law.undistorted(p))).collect();
    rms_apart(&pairs)
}

/// What a grid came to: rms of held-out beads, rms against the law, spots.
fn judged(drawn: &Drawn) -> (f64, f64, usize) {
    let calibration = calibrated(drawn).unwrap_or_else(|error| panic!("seed {}: {error}", drawn.seed));
    let distortion = calibration.at(None).expect("one view").distortion;
    let held_out_px = calibration.held_out_rms_px.expect("measured");
    // A plate with holes hides the disc: then the largest in the frame stands for it.
    let off = if drawn.holes { 0.05 * drawn.size as f64 } else { 2.0 };
    assert!(
        distortion.centre_px().distance(drawn.law.centre) < off,
        "seed {}: disc {:?}",
        drawn.seed,
        calibration.disc_centre_px
    );
    assert!((distortion.radius_px() - drawn.law.radius_px).abs() < off, "seed {}", drawn.seed);
    (held_out_px, off_px(&distortion, &drawn.law), calibration.views[0].spots)
}

#[test]
fn grids_of_beads_and_of_holes_are_straightened_to_a_fifth_of_a_pixel() {
    let mut grids = 0;
    for (seed, size, holes) in [(1, 512, false), (2, 512, true), (4, 1024, false)] {
        let drawn = Drawn { holes, ..Drawn::random(seed, size) };
        assert!((drawn.law.mean_px() - 11.0).abs() < 0.01);
        let (held_out_px, law_px, spots) = judged(&drawn);
        println!(
            "seed {seed}, {size} px, holes {holes}: held out {held_out_px:.3} px, against the law {law_px:.3} px, {spots} spots"
        );
        assert!(held_out_px <= LIMIT_PX && law_px <= LIMIT_PX, "seed {seed}: {held_out_px} {law_px}");
        // Were it a plain camera, this would be left.
        let straight = Distortion::new(drawn.law.centre, drawn.law.radius_px, 1, vec![DVec2::ZERO; 3]).expect("none");
        assert!(off_px(&straight, &drawn.law) > 10.0 * LIMIT_PX, "control");
        grids += 1;
    }
    assert_eq!(grids, 3);
}

/// The grid of `drawn` as an S that grows with the orbital angle shows it.
pub fn turned(drawn: &Drawn, orbital_deg: f64) -> Drawn {
    let s_rad = drawn.law.s_rad + 0.04 * orbital_deg.to_radians().sin();
    Drawn { law: Law { s_rad, ..drawn.law }, seed: drawn.seed + orbital_deg.abs() as u64, ..drawn.clone() }
}

#[test]
fn between_measured_angles_the_distortion_is_interpolated_and_beyond_them_the_nearest_holds() {
    let plate = Drawn { missing: 0.0, ..Drawn::random(11, 512) };
    let frames: Vec<GridFrame> = [0.0, 30.0].map(|angle| frame(&turned(&plate, angle), Some([angle, 0.0]))).into();
    let calibration = calibrate(&frames, &request(GridOf::Beads)).expect("two views");
    assert!(!calibration.notes.iter().any(|note| note.contains("its own centre")), "{:?}", calibration.notes);
    let law = turned(&plate, 15.0).law;
    let between = calibration.at(Some([15.0, 0.0])).expect("between");
    assert!(between.note.is_none());
    let [at_start, interpolated] =
        [[0.0, 0.0], [15.0, 0.0]].map(|angles| off_px(&calibration.at(Some(angles)).expect("measured").distortion, &law));
    println!("held out {:?} px, between {interpolated:.3} px, with the view at 0 {at_start:.3} px", calibration.held_out_rms_px);
    assert!(interpolated <= LIMIT_PX && at_start > 2.0 * LIMIT_PX, "{interpolated} {at_start}");
    let beyond = calibration.at(Some([50.0, 5.0])).expect("beyond");
    assert_eq!(beyond.distortion, calibration.at(Some([30.0, 0.0])).expect("measured").distortion);
    assert!(beyond.note.expect("said").contains("not measured"));
    assert!(calibration.at(None).expect_err("two views").to_string().contains("2 angles"));
    let same = [&frames[0], &frames[0]].map(Clone::clone);
    assert!(matches!(calibrate(&same, &request(GridOf::Beads)), Err(IntensifierFault::SameAngle { .. })));
}

/// A calibration of first order whose only coefficient is the shift of columns.
fn shifted(views: &[(AnglesDeg, f64)]) -> serde_json::Value {
    let view = |(angles, shift): &(AnglesDeg, f64)| json!({"orbital_deg": angles[0], "angulation_deg": angles[1], "shift_u_px": [shift, 0, 0], "shift_v_px": [0, 0, 0]});
    json!({"origin": "a test", "size_px": [512, 512], "disc_centre_px": [255, 255], "disc_radius_px": 250, "order": 1,
        "angles_from": "given", "views": views.iter().map(view).collect::<Vec<_>>()})
}

#[test]
fn rows_of_angles_are_interpolated_along_and_across() {
    let parse = |value: serde_json::Value| serde_json::from_value::<IntensifierCalibration>(value).expect("a calibration");
    let calibration = parse(shifted(&[([-30.0, 0.0], 1.0), ([30.0, 0.0], 3.0), ([0.0, 20.0], 6.0), ([30.0, 20.0], 8.0)]));
    let shift = |angles: AnglesDeg| {
        let seen = calibration.at(Some(angles)).expect("good");
        (seen.distortion.undistorted(DVec2::ZERO).x, seen.note.is_some())
    };
    // Along the row of 0°: 2 at 0°, 2.5 at 15°; along that of 20°: 7 at 15°; half way between them 4.75.
    assert!((shift([15.0, 10.0]).0 - 4.75).abs() < 1e-12 && !shift([15.0, 10.0]).1);
    assert!((shift([30.0, 20.0]).0 - 8.0).abs() < 1e-12);
    assert!((shift([90.0, 40.0]).0 - 8.0).abs() < 1e-12 && shift([90.0, 40.0]).1);
    assert!((shift([-15.0, 10.0]).0 - 0.5 * (1.5 + 6.0)).abs() < 1e-12 && shift([-15.0, 10.0]).1, "one row is shorter");
}

#[test]
fn files_with_unknown_keys_or_a_fold_are_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("intensifier.json");
    let complaint = |value: &serde_json::Value| {
        std::fs::write(&path, value.to_string()).expect("written");
        IntensifierCalibration::read(&path).expect_err("refused").to_string()
    };
    let good = shifted(&[([0.0, 0.0], 1.0)]);
    std::fs::write(&path, good.to_string()).expect("written");
    assert!(IntensifierCalibration::read(&path).is_ok());
    let with = |pointer: &str, value: serde_json::Value| {
        let mut changed = good.clone();
        match changed.pointer_mut(pointer) {
            Some(slot) => *slot = value,
            None => changed[pointer] = value,
        }
        changed
    };
    for (changed, word) in [
        (with("gain", json!(1)), "gain"),
        (with("/views/0/shift_u_px", json!([0, -251, 0])), "folds"),
        (with("/views/0/shift_u_px", json!([0, 0])), "coefficients"),
        (with("/disc_radius_px", json!(-1)), "radius"),
        (with("/views", json!([])), "views"),
        (with("veiling_glare", json!({"fraction": 1.5, "scale_px": 10})), "veiling_glare"),
    ] {
        let said = complaint(&changed);
        assert!(said.contains(word), "{word}: {said}");
    }
}

#[test]
fn what_is_no_grid_is_refused() {
    let drawn = Drawn { missing: 0.85, ..Drawn::random(5, 512) };
    let fault = calibrated(&drawn).expect_err("a few beads").to_string();
    assert!(fault.contains("grid-5") && fault.contains("are needed"), "{fault}");
    // A plate of thirty spots determines 21 terms and leaves too little to judge them by.
    let coarse = Drawn { missing: 0.0, false_spots: Vec::new(), pitch_px: 75.0, spot_px: 8.0, ..Drawn::random(5, 512) };
    match calibrated(&coarse).expect_err("too few") {
        IntensifierFault::NoGrid { named, required: 42, .. } => assert!(named > 21 && named < 42, "{named}"),
        other => panic!("{other}"),
    }
    let refused = |frames: &[GridFrame]| calibrate(frames, &request(GridOf::Beads)).expect_err("refused");
    assert!(matches!(refused(&[]), IntensifierFault::NoFrames));
    let blank = |width: usize, angles_deg: Option<AnglesDeg>| {
        let pixels = Image::filled(width, 64, 1e3);
        GridFrame { frame: Frame::from_pixels("blank", pixels, Domain::Linear).expect("a frame"), angles_deg }
    };
    let sizes = refused(&[blank(64, Some([0.0, 0.0])), blank(65, Some([30.0, 0.0]))]);
    assert!(matches!(sizes, IntensifierFault::Sizes { found: [65, 64], expected: [64, 64], .. }), "{sizes}");
    let angle = refused(&[blank(64, Some([0.0, 0.0])), blank(64, None)]);
    assert!(matches!(angle, IntensifierFault::NoAngle { .. }), "{angle}");
    let nothing = refused(&[blank(64, None)]);
    assert!(matches!(nothing, IntensifierFault::NoGrid { named: 0, .. }), "{nothing}");
}

/// A grid is measured by the command, and a radiograph through the same intensifier registered with its file.
#[test]
fn a_pose_through_an_intensifier_is_that_of_the_undistorted_picture() {
    let folder = tempfile::tempdir().expect("folder");
    let sidecarm = |words: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(words).current_dir(folder.path()).output().expect("runs")
    };
    let drawn = Drawn::random(21, 512);
    write_tiff_f32(&folder.path().join("grid.tif"), &[drawn.frame().pixels]).expect("written");
    let made = sidecarm(&["calibrate", "intensifier", "grid.tif", "--domain", "linear", "--pitch-mm", "10", "--out", "ii.json"]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let table = String::from_utf8_lossy(&made.stdout).into_owned();
    assert!(table.starts_with("held-out spots: 0."), "{table}");

    let (view, layout) = (synthetic::view(512, 512, 3), synthetic::layout(14, 1.0, 3));
    let straight = synthetic::radiograph(view, &layout, 3000.0, 3).draw();
    let through = |law: &Law, index: usize| {
        let p = DVec2::new((index % 512) as f64, (index / 512) as f64);
        let there = law.undistorted(p);
        let seen = (p.distance(law.centre) <= law.radius_px).then(|| straight.bilinear(there.x, there.y)).flatten();
        seen.unwrap_or(0.0) as f32
    };
    let pixels = (0..512 * 512).map(|index| through(&drawn.law, index)).collect();
    write_tiff_f32(&folder.path().join("frame.tif"), &[Image { width: 512, height: 512, pixels }]).expect("written");
    let points: Vec<_> = layout
        .beads
        .iter()
        .map(|bead| {
            json!({"label": bead.name, "description": "radius_mm=1.0",
        "position": bead.lps_mm.to_array()})
        })
        .collect();
    let markups = json!({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": points}]});
    std::fs::write(folder.path().join("beads.mrk.json"), markups.to_string()).expect("written");
    let k = json!({"intrinsics": view.intrinsics, "size_px": [512, 512], "pitch_mm": 1020.0 / view.intrinsics.fx});
    std::fs::write(folder.path().join("K.json"), k.to_string()).expect("written");
    let register = |more: &[&str]| {
        let words = ["register", "frame.tif", "--beads", "beads.mrk.json", "--intrinsics", "K.json", "--domain", "linear"];
        let output = sidecarm(&[&words, more, &["--out", "pose.json", "--overlay", "overlay.png"]].concat());
        let pose = Pose::read(&folder.path().join("pose.json"));
        pose.unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&output.stderr)))
    };
    let off = |pose: &Pose| {
        let projection = pose.projection?;
        let off = layout.beads.iter().map(|bead| projection.project(bead.lps_mm).0 - view.projection().project(bead.lps_mm).0);
        Some((off.map(|off| off.length_squared()).sum::<f64>() / layout.beads.len() as f64).sqrt())
    };
    let pose = register(&["--distortion", "ii.json"]);
    let straightened = off(&pose).unwrap_or_else(|| panic!("{:?}", pose.reason));
    assert!(straightened < 0.3, "{straightened}");
    assert!(pose.notes.iter().any(|note| note.contains("undistorted by ii.json")), "{:?}", pose.notes);
    let plain = register(&[]);
    println!("P off by {straightened:.3} px, without --distortion {:?}, rms {:?}", off(&plain), plain.rms_px);
    assert!(off(&plain).is_none_or(|px| px > 5.0 * straightened), "control");
}

#[test]
#[ignore = "minutes long: scripts/evaluate intensifier runs it"]
fn many_grids_are_straightened() {
    let count = std::env::var("SIDECARM_GRIDS").ok().and_then(|count| count.parse().ok()).unwrap_or(60u64);
    let first = std::env::var("SIDECARM_FIRST_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(100u64);
    let (mut over, mut worst, mut squares) = (Vec::new(), [0.0f64; 2], [0.0f64; 2]);
    for seed in first..first + count {
        let size = if seed % 3 == 2 { 1024 } else { 512 };
        let drawn = Drawn { holes: seed % 4 == 1, ..Drawn::random(seed, size) };
        let (held_out_px, law_px, spots) = judged(&drawn);
        println!(
            "seed {seed}, {size} px, holes {}: held out {held_out_px:.3} px, law {law_px:.3} px, {spots} spots",
            drawn.holes
        );
        for (n, px) in [held_out_px, law_px].into_iter().enumerate() {
            worst[n] = worst[n].max(px);
            squares[n] += px * px;
        }
        if !(held_out_px <= LIMIT_PX && law_px <= LIMIT_PX) {
            over.push(seed);
        }
    }
    let rms = squares.map(|sum| (sum / count as f64).sqrt());
    println!(
        "{count} grids, seeds from {first}: held out, law: rms {rms:.3?} px, worst {worst:.3?} px, over {LIMIT_PX} px: {over:?}"
    );
    assert!(count > 0 && over.is_empty(), "{over:?}");
}

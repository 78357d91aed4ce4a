//! `sidecarm register --explain`: which beads, which prior, what else was looked at and why it does not stand, in words and in the pose's file.

use std::path::Path;
use std::process::{Command, Output};

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use sidecarm::beads::Bead;
use sidecarm::image::{Image, write_tiff_f32};
use sidecarm::pose::{Pose, PriorUse, Reading, Rejected, register_shadows};
use sidecarm::random::{Purpose, Stream};

use crate::pose_mistakes::{Draw, about_beads, doubled, scattered, turned};
use crate::pose_registration::{matching, shadows};
use crate::pose_synthetic as synthetic;

/// `sidecarm register` in a folder with K.json.
pub fn register(folder: &Path, frame: &str, beads: &str, more: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.args(["register", frame, "--beads", beads, "--intrinsics", "K.json", "--domain", "linear", "--out", "POSE.json"]);
    command.args(more).current_dir(folder).output().expect("runs")
}

/// Exit code, what is printed, and the pose that is written.
fn registered(folder: &Path, frame: &str, more: &[&str]) -> (Option<i32>, String, Pose) {
    let output = register(folder, frame, "beads.mrk.json", more);
    let pose = Pose::read(&folder.join("POSE.json")).expect("a pose, accepted or refused");
    (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned(), pose)
}

#[test]
fn a_registration_tells_beads_prior_and_what_was_rejected() {
    let view = synthetic::view(620, 480, 3);
    let layout = synthetic::layout(9, 1.5, 3);
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, value: Value| std::fs::write(folder.path().join(name), value.to_string()).expect("written");
    let mut drawing = synthetic::radiograph(view, &layout, 20_000.0, 3);
    (drawing.anatomy, drawing.metal) = (false, false);
    let pixels = drawing.draw();
    let mirrored: Vec<f32> = pixels.pixels.chunks(pixels.width).flat_map(|row| row.iter().rev().copied()).collect();
    write_tiff_f32(&folder.path().join("mirrored.tif"), &[Image { pixels: mirrored, ..pixels }]).expect("written");
    write_tiff_f32(&folder.path().join("frame.tif"), &[drawing.draw()]).expect("written");
    let point = |bead: &Bead| json!({"label": bead.name, "position": bead.lps_mm.to_array(), "description": "radius_mm=1.5"});
    let points: Vec<Value> = layout.beads.iter().map(point).collect();
    write("beads.mrk.json", json!({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": points}]}));
    let pitch_mm = 1020.0 / view.intrinsics.fx;
    write("K.json", json!({"intrinsics": view.intrinsics.to_rows(), "size_px": view.size_px, "pitch_mm": pitch_mm}));
    let near = turned(&view, DQuat::from_rotation_x(2f64.to_radians()), DVec3::X * 5.0);
    write("near.json", json!({"camera_from_lps": near}));
    write("sure.json", json!({"camera_from_lps": near, "covariance": about_beads(&near, 2.0, 5.0)}));
    let away = turned(&view, DQuat::from_rotation_x(100f64.to_radians()), DVec3::X * 60.0);
    write("away.json", json!({"camera_from_lps": away}));
    let says = |text: &str, expected: &[&str]| {
        for words in expected {
            assert!(text.contains(words), "{words:?} in\n{text}");
        }
    };

    let (code, text, pose) = registered(folder.path(), "frame.tif", &["--explain", "--prior", "near.json"]);
    assert_eq!(code, Some(0), "{text}");
    says(
        &text,
        &[
            "P rests on ",
            "each so far from where the others put it: b",
            "prior near.json: ± 5.00°, 5.00°, 5.00° about x, y, z and ± 15.00, 15.00, 15.00 mm at the beads, assumed, it states none; it bounded \
             the search, and P does not rest on it; it is ",
            " σ of both",
            "other readings of the frame:\n",
            "  the frame's mirror image: ",
            "  all shadows, the prior left out: ",
            "  the layout moved onto itself: looked for, and nothing beyond accident is there\n",
            "  a second set of shadows: looked for",
            "told besides:\n  open field by the picture: ",
            "shadows, best first",
        ],
    );
    let told = pose.explained.as_ref().expect("explained");
    let prior = told.prior.as_ref().expect("a prior");
    assert_eq!((prior.source.as_deref(), prior.used, prior.stated), (Some("near.json"), PriorUse::Gate, false));
    let (sigmas, angle_deg) = (prior.innovation_sigmas.expect("beads"), prior.angle_deg.expect("beads"));
    // 2° of 5 about one axis and 5 mm of 15 along another.
    assert!((sigmas - 0.4f64.hypot(1.0 / 3.0)).abs() < 0.05 && (angle_deg - 2.0).abs() < 0.1, "{sigmas} σ, {angle_deg}°");
    assert!(told.readings.iter().any(|own| own.reading == Reading::MovedLayout && own.why == Rejected::NotFound), "{told:?}");
    let file: Value = serde_json::from_slice(&std::fs::read(folder.path().join("POSE.json")).expect("written")).expect("JSON");
    assert_eq!(file["explained"]["prior"]["used"], "gate");
    assert!(file["explained"]["readings"].as_array().expect("a list").iter().any(|own| own["why"]["code"] == "not_found"));
    assert_eq!(file["explained"]["told"][0]["what"], "open field by the picture");

    let (code, text, pose) = registered(folder.path(), "frame.tif", &["--explain", "--prior", "sure.json", "--fuse"]);
    assert_eq!(code, Some(0), "{text}");
    says(&text, &["prior sure.json: ± 2.00°", "as it states; it bounded the search, and is a measurement beside the beads"]);
    let prior = pose.explained.and_then(|told| told.prior).expect("a prior");
    // Against the beads alone, although the pose rests on both.
    let sigmas = prior.innovation_sigmas.expect("beads");
    assert!(prior.used == PriorUse::Measurement && (sigmas - 1f64.hypot(1.0)).abs() < 0.15, "{sigmas} σ");

    let (_, text, pose) = registered(folder.path(), "frame.tif", &["--explain", "--prior", "away.json"]);
    says(&text, &["prior away.json: ", "left aside: nothing that stands is near it"]);
    assert_eq!(pose.explained.and_then(|told| told.prior).map(|prior| prior.used), Some(PriorUse::LeftAside));

    let (code, text, pose) = registered(folder.path(), "mirrored.tif", &["--explain"]);
    assert_eq!(code, Some(1), "{text}");
    says(&text, &["refused: mirrored", "P rests on no bead", "no prior was given", "belongs to no bead"]);
    assert!(pose.explained.is_some(), "of a refused frame as well");

    // The control: without the option nothing of it is printed, and the file has it all the same.
    let (_, plain, pose) = registered(folder.path(), "frame.tif", &[]);
    assert!(plain.starts_with("accepted") && !plain.contains("other readings") && !plain.contains("told besides"), "{plain}");
    assert!(pose.explained.is_some());
}

/// Half a turn puts eight of ten beads onto beads: the reading under those names is named, with why it lost.
#[test]
fn a_rival_that_lost_is_told_with_the_reason() {
    let (mut cases, mut lost_ones) = (0, 0);
    for seed in 0..12u64 {
        let mut draw = Draw(Stream::new(seed, 97, 0, Purpose::Evaluation));
        let half = DVec3::new(45.0, 45.0, 35.0);
        let mut places = doubled(8, half, &|p| DVec3::new(-p.x, -p.y, p.z), &mut draw);
        places.extend(scattered(2, half, &mut draw));
        let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout_of(&places, 0.75));
        let found = shadows(&view, &layout, 0.1, 0.02, seed);
        let crowded = places.iter().enumerate().any(|(n, p)| places[..n].iter().any(|other| other.distance(*p) < 8.0));
        if crowded || found.len() < 10 {
            continue;
        }
        let pose = register_shadows(&matching(&view, &layout), &found);
        if !pose.is_accepted() {
            continue;
        }
        let readings = pose.explained.expect("explained").readings;
        for lost in readings.iter().filter(|own| own.reading == Reading::OtherMatch) {
            let Some(found) = lost.found else { continue };
            // Whatever explains fewer beads lost by that; what explains as many would be ambiguous if it fitted as well.
            match lost.why {
                Rejected::FewerBeads { against } => {
                    let (told, ending) = (lost.to_string(), format!("fewer beads than the {against} of the pose"));
                    let is_told = told.contains(&format!("{} beads to ", found.matched)) && told.ends_with(&ending);
                    assert!(found.matched < against && is_told, "seed {seed}: {told}");
                }
                Rejected::FitsWorse { chi2_more } => assert!(chi2_more > 0.0, "seed {seed}: {lost}"),
                _ => panic!("seed {seed}: {lost}"),
            }
            lost_ones += 1;
        }
        cases += 1;
    }
    assert!(cases >= 3 && lost_ones >= 3, "{cases}, {lost_ones}");
}

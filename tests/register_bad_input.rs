//! Bad frames and bad lists of beads through `sidecarm register`: exit code 1 with one sentence or a refused pose, and never a projection.

use std::path::Path;
use std::process::Command;

use glam::DVec3;
use serde_json::{Value, json};
use sidecarm::geometry::View;
use sidecarm::image::{Image, write_tiff_f32};
use sidecarm::pose::{Pose, Status};
use sidecarm::random::{Purpose, Stream};

use crate::pose_synthetic as synthetic;

const SIZE: (usize, usize) = (620, 480);
const RADIUS_MM: f64 = 1.5;
/// Too few beads at places of their own, or all on a line: what beads in metres are taken for.
const NO_LAYOUT: &[&str] = &["too_few_beads", "collinear"];

/// What is to come of it.
enum Outcome {
    /// One sentence with these words, and no pose file.
    Sentence(&'static str),
    /// A refused pose with one of these codes, or with any where none is listed.
    Refused(&'static [&'static str]),
}
use Outcome::{Refused, Sentence};

fn markups(places: &[DVec3], name: impl Fn(usize) -> String) -> Value {
    let description = format!("radius_mm={RADIUS_MM}");
    let point = |(n, place): (usize, &DVec3)| json!({"label": name(n), "position": place.to_array(), "description": description});
    let points: Vec<Value> = places.iter().enumerate().map(point).collect();
    json!({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}]})
}

/// Readout noise about zero, as an offset correction leaves it where no quantum arrives.
fn dark() -> Image<f32> {
    let mut random = Stream::new(21, 0, 0, Purpose::Evaluation);
    Image::filled(SIZE.0, SIZE.1, 0.0f32).map(|_| (3.0 * random.normal()) as f32)
}

/// A folder with all frames, all lists of beads, K, and the right prior.
fn folder(view: &View, places: &[DVec3]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let layout = synthetic::layout_of(places, RADIUS_MM);
    let (width, height) = SIZE;
    for (name, image) in [
        ("good.tif", synthetic::radiograph(*view, &layout, 20_000.0, 3).draw()),
        ("one.tif", Image::filled(1, 1, 100.0)),
        ("uniform.tif", Image::filled(width, height, 100.0)),
        ("nan.tif", Image::filled(width, height, f32::NAN)),
        ("dark.tif", dark()),
    ] {
        write_tiff_f32(&at(name), &[image]).expect("written");
    }
    let saturated = image::ImageBuffer::from_pixel(width as u32, height as u32, image::Luma([u16::MAX]));
    saturated.save(at("saturated.png")).expect("written");

    let named = |n: usize| format!("b{n}");
    let line: Vec<DVec3> = (0..places.len()).map(|n| DVec3::new(12.0 * n as f64 - 48.0, 5.0, 2.0)).collect();
    let away = view.camera_from_lps.inverse().transform_vector(DVec3::Z * -2000.0);
    let moved = |change: &dyn Fn(DVec3) -> DVec3| places.iter().map(|place| change(*place)).collect::<Vec<_>>();
    let k = view.intrinsics.to_rows();
    let pitch_mm = 1020.0 / view.intrinsics.fx;
    for (name, value) in [
        ("good.mrk.json", markups(places, named)),
        ("line.mrk.json", markups(&line, named)),
        ("place.mrk.json", markups(&moved(&|_| DVec3::new(3.0, 4.0, 5.0)), named)),
        ("behind.mrk.json", markups(&moved(&|place| place + away), named)),
        ("twice.mrk.json", markups(places, |n| format!("b{}", n.min(places.len() - 2)))),
        ("metres.mrk.json", markups(&moved(&|place| place * 1e-3), named)),
        ("K.json", json!({"intrinsics": k, "size_px": view.size_px, "pitch_mm": pitch_mm})),
        ("K-any.json", json!({"intrinsics": k, "pitch_mm": pitch_mm})),
        ("prior.json", json!({"camera_from_lps": view.camera_from_lps})),
    ] {
        std::fs::write(at(name), value.to_string()).expect("written");
    }
    folder
}

/// Exit code, standard output, standard error; no pose file is left from before.
fn register(folder: &Path, frame: &str, beads: &str, more: &[&str]) -> (Option<i32>, String, String) {
    let _ = std::fs::remove_file(folder.join("POSE.json"));
    let output = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .args(["register", frame, "--beads", beads, "--domain", "linear", "--out", "POSE.json"])
        .args(more)
        .current_dir(folder)
        .output()
        .expect("runs");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

#[test]
fn bad_frames_and_bad_beads_give_no_pose() {
    let view = synthetic::view(SIZE.0 as u32, SIZE.1 as u32, 3);
    let places: Vec<DVec3> = synthetic::layout(9, RADIUS_MM, 3).beads.iter().map(|bead| bead.lps_mm).collect();
    let folder = folder(&view, &places);
    let pose_path = folder.path().join("POSE.json");
    let k: &[&str] = &["--intrinsics", "K.json"];
    let guided: &[&str] = &["--intrinsics", "K.json", "--prior", "prior.json"];

    for options in [k, guided] {
        let (code, stdout, stderr) = register(folder.path(), "good.tif", "good.mrk.json", options);
        assert!(code == Some(0) && stdout.starts_with("accepted"), "the control: {stdout}{stderr}");
        assert!(Pose::read(&pose_path).expect("a pose").projection.is_some(), "the control");
    }

    let cases: [(&str, &str, &[&str], Outcome); 11] = [
        ("one.tif", "good.mrk.json", &["--intrinsics", "K-any.json"], Refused(&["too_few_shadows"])),
        ("one.tif", "good.mrk.json", k, Sentence("which no binning gives")),
        ("uniform.tif", "good.mrk.json", k, Refused(&["too_few_shadows"])),
        ("saturated.png", "good.mrk.json", k, Refused(&["too_few_shadows"])),
        ("dark.tif", "good.mrk.json", guided, Refused(&[])),
        ("nan.tif", "good.mrk.json", k, Sentence("all 297600 pixels are NaN, infinite or padding")),
        ("good.tif", "line.mrk.json", k, Refused(&["collinear"])),
        ("good.tif", "place.mrk.json", k, Refused(&["too_few_beads"])),
        ("good.tif", "behind.mrk.json", guided, Refused(&["behind_source"])),
        ("good.tif", "twice.mrk.json", k, Sentence("label \"b7\" occurs twice")),
        ("good.tif", "metres.mrk.json", k, Refused(NO_LAYOUT)),
    ];
    let mut refused = 0;
    for (frame, beads, options, outcome) in cases {
        let (code, stdout, stderr) = register(folder.path(), frame, beads, options);
        let what = format!("{frame}, {beads}, {options:?}: {stdout}{stderr}");
        println!("{what}");
        assert_eq!(code, Some(1), "{what}");
        assert!(!stderr.contains("a fault of this program") && !stderr.contains("panicked"), "{what}");
        match outcome {
            Sentence(words) => {
                // That a frame of one pixel shows no picture is a warning of its own.
                let is_beside = |line: &&str| line.starts_with("hint: ") || line.starts_with("warning: ");
                let lines: Vec<&str> = stderr.lines().filter(|line| !is_beside(line)).collect();
                assert!(lines.len() == 1 && lines[0].starts_with("sidecarm: ") && lines[0].contains(words), "{what}");
                assert!(stdout.is_empty() && !pose_path.exists(), "{what}");
            }
            Refused(codes) => {
                let pose = Pose::read(&pose_path).expect("a refused pose is written");
                let (reason, refusal) = (pose.reason.expect("a reason"), pose.refusal.expect("a refusal in parts"));
                assert!(stdout.starts_with(&format!("refused: {reason}\n")), "{what}");
                assert!(pose.status == Status::Refused && pose.projection.is_none() && pose.camera_from_lps.is_none(), "{what}");
                let panel = pose.detector.is_none_or(|panel| panel.projection.is_none() && panel.camera_from_lps.is_none());
                assert!(panel && (codes.is_empty() || codes.contains(&refusal.code().as_str())), "{what}");
                let text = std::fs::read_to_string(&pose_path).expect("written");
                assert!(!text.contains("\"projection\""), "{what}");
            }
        }
        refused += 1;
    }
    assert_eq!(refused, 11);
}

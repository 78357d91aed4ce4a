//! What a session declares, through `live`: console geometry, domain, tone, air level, detector, bead radius, landmarks.

use std::path::Path;

use serde_json::{Value, json};
use sidecarm::acquire::read_frame;
use sidecarm::beads::read_markups;
use sidecarm::compare::bead_marks;
use sidecarm::geometry::{Projection, View};
use sidecarm::image::Image;
use sidecarm::mask::discs;
use sidecarm::pose::{Refusal, Registration};
use sidecarm::record::{read_log, topic};

use crate::lab_truth::wait_for_pairs;
use crate::live_lab::{HANG_S, Lab, Live, Signal};
use crate::replay_meddled::meddled;
use crate::scene_support::tell_costs;
use crate::session_names::replay;

/// The kit's frames as the console would store them.
pub fn pictures(lab: &Lab) -> Vec<Image<f32>> {
    let mut files: Vec<_> = std::fs::read_dir(lab.frames()).expect("frames").flatten().map(|entry| entry.path()).collect();
    files.sort();
    let pictures = files.iter().map(|path| read_frame(path, None).expect("reads").pixels).collect();
    files.iter().for_each(|path| std::fs::remove_file(path).expect("removed"));
    pictures
}

pub fn write_png16(path: &Path, picture: &Image<f32>) {
    let values: Vec<u16> = picture.pixels.iter().map(|v| v.round().clamp(0.0, 65_535.0) as u16).collect();
    let buffer = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(picture.width as u32, picture.height as u32, values);
    buffer.expect("size").save(path).expect("written");
}

pub fn write_png8(path: &Path, picture: &Image<f32>) {
    let values: Vec<u8> = picture.pixels.iter().map(|v| v.round().clamp(0.0, 255.0) as u8).collect();
    let buffer = image::ImageBuffer::<image::Luma<u8>, _>::from_raw(picture.width as u32, picture.height as u32, values);
    buffer.expect("size").save(path).expect("written");
}

fn crop(picture: &Image<f32>, [left, top, columns, rows]: [usize; 4]) -> Image<f32> {
    let at = |n: usize| *picture.at(left + n % columns, top + n / columns);
    Image { width: columns, height: rows, pixels: (0..columns * rows).map(at).collect() }
}

/// A quarter turn clockwise: the top row becomes the last column.
fn turned(picture: &Image<f32>) -> Image<f32> {
    let (width, height) = (picture.height, picture.width);
    let at = |n: usize| *picture.at(n / width, picture.height - 1 - n % width);
    Image { width, height, pixels: (0..width * height).map(at).collect() }
}

fn mirrored(picture: &Image<f32>) -> Image<f32> {
    let mut copy = picture.clone();
    copy.pixels.chunks_exact_mut(picture.width).for_each(<[f32]>::reverse);
    copy
}

fn binned(picture: &Image<f32>) -> Image<f32> {
    let (width, height) = (picture.width / 2, picture.height / 2);
    let at = |n: usize| {
        let (u, v) = (2 * (n % width), 2 * (n / width));
        [(0, 0), (1, 0), (0, 1), (1, 1)].iter().map(|(du, dv)| picture.at(u + du, v + dv)).sum::<f32>() / 4.0
    };
    Image { width, height, pixels: (0..width * height).map(at).collect() }
}

/// Runs a session on what lies in the folder, until each file has its pair; gives the poses of the log, the pairs, and what was said.
pub fn session(lab: &Lab, change: impl FnOnce(&mut Value)) -> (Vec<Value>, Vec<Value>, String) {
    let file = lab.session("declared.json", |value| {
        value["robot"] = Value::Null;
        change(value);
    });
    let out = lab.kit.join("out");
    let files = std::fs::read_dir(lab.frames()).expect("frames").count();
    let mut live = Live::launch(&file, &out, &["--include-existing"]);
    wait_for_pairs(&live, files);
    live.signalled(Signal::INT);
    let ended = live.program.end(HANG_S);
    let said = live.stdout() + &live.stderr();
    assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{said}");
    let log = read_log(&live.log).expect("the log opens");
    let poses =
        log.entries.iter().filter(|entry| &*entry.topic == topic::POSE).map(|entry| entry.json().expect("JSON")).collect();
    (poses, pairs_in(&out), said)
}

fn pairs_in(folder: &Path) -> Vec<Value> {
    let text = std::fs::read(folder.join("pairs.json")).expect("pairs");
    let pairs: Value = serde_json::from_slice(&text).expect("JSON");
    pairs["pairs"].as_array().expect("a list").clone()
}

pub fn rows(matrix: &Value) -> Vec<Vec<f64>> {
    let row = |row: &Value| row.as_array().expect("a row").iter().map(|v| v.as_f64().expect("a number")).collect();
    matrix.as_array().expect("a matrix").iter().map(row).collect()
}

fn project(matrix: &[Vec<f64>], point: &[f64]) -> [f64; 2] {
    let dot = |row: &Vec<f64>| row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3];
    [dot(&matrix[0]) / dot(&matrix[2]), dot(&matrix[1]) / dot(&matrix[2])]
}

/// How far, in panel pixels, each pose's landmarks lie from those of the truth's nearest frame; `on_panel` takes a frame's pixel to the
/// panel's.
pub fn errors_px(lab: &Lab, poses: &[Value], on_panel: impl Fn([f64; 2]) -> [f64; 2]) -> Vec<(usize, f64)> {
    let truth: Value = serde_json::from_slice(&std::fs::read(lab.kit.join("truth.json")).expect("truth")).expect("JSON");
    let landmarks: Vec<Vec<f64>> =
        truth["landmarks"].as_array().expect("named").iter().map(|l| rows(&json!([l["lps_mm"]])).remove(0)).collect();
    assert!(landmarks.len() >= 3);
    let frames: Vec<Vec<Vec<f64>>> = truth["frames"].as_array().expect("frames").iter().map(|f| rows(&f["projection"])).collect();
    let nearest = |pose: &Value| {
        let found = rows(&pose["projection"]);
        let error = |frame: &Vec<Vec<f64>>| {
            let off = |point: &Vec<f64>| {
                let ([u, v], [x, y]) = (on_panel(project(&found, point)), project(frame, point));
                (u - x).hypot(v - y)
            };
            landmarks.iter().map(off).sum::<f64>() / landmarks.len() as f64
        };
        let errors = frames.iter().map(error).enumerate();
        errors.min_by(|a, b| a.1.total_cmp(&b.1)).expect("frames")
    };
    poses.iter().filter(|pose| pose["pose_source"] == "beads").map(nearest).collect()
}

/// Takes the radius out of the descriptions of the kit's beads: what a session declares is all that tells it.
fn without_radii(lab: &Lab) {
    let path = lab.kit.join("beads.mrk.json");
    let mut beads: Value = serde_json::from_slice(&std::fs::read(&path).expect("beads")).expect("JSON");
    for point in beads["markups"][0]["controlPoints"].as_array_mut().expect("points") {
        assert_eq!(point["description"], "radius_mm=0.75");
        point["description"] = json!("");
    }
    std::fs::write(&path, beads.to_string()).expect("written");
}

/// Share of a frame of this size that is masked for beads of this radius at this pose.
fn share_of_beads(lab: &Lab, pose: &Value, [columns, rows]: [usize; 2], radius_mm: f64) -> f64 {
    let projection: Projection = serde_json::from_value(pose["projection"].clone()).expect("3 x 4");
    let (intrinsics, camera_from_lps) = projection.decompose().expect("a camera");
    let view = View { size_px: [columns as u32, rows as u32], intrinsics, camera_from_lps };
    let layout = read_markups(&lab.kit.join("beads.mrk.json")).expect("beads");
    let listed = Registration::new(view.size_px, &layout).refuse(&Refusal::Fault { detail: "not looked for".to_owned() });
    let marks = bead_marks(&listed, &view, None, |_| Some(radius_mm));
    let mask = discs(columns, rows, &marks);
    mask.pixels.iter().filter(|masked| **masked).count() as f64 / mask.pixels.len() as f64
}

/// The log of the session in the kit's `out` with another radius declared: what a replay makes of its frames.
fn pairs_of_radius(lab: &Lab, radius_mm: f64) -> Vec<Value> {
    let (log, again) = (lab.kit.join("other-radius.mcap"), lab.kit.join("other-radius"));
    let mut changed = 0;
    meddled(&lab.kit.join("out/session.mcap"), &log, &mut |topic, data| {
        if topic == "/session/setup" {
            let mut setup: Value = serde_json::from_slice(data).expect("JSON");
            assert!(setup["session"]["bead_radius_mm"].is_f64(), "the log keeps what was declared");
            setup["session"]["bead_radius_mm"] = json!(radius_mm);
            *data = setup.to_string().into_bytes();
            changed += 1;
        }
        true
    });
    assert_eq!(changed, 1);
    tell_costs(&lab.kit.join("cache"));
    let (code, words) = replay(&log, Some(&lab.kit), &lab.kit.join("cache"), &again);
    assert_eq!(code, Some(3), "other poses than those of the log: {words}");
    pairs_in(&again)
}

/// A console that turns, mirrors and crops gave frames of a size that nobody knew: no K, no pose, or one of the wrong picture. The radius of
/// the beads is what the session declares.
#[test]
fn a_turned_mirrored_and_cropped_picture_gives_the_pose_of_the_panel() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "2"]) else { return };
    let shown = [40, 20, 540, 440];
    let pictures = pictures(&lab);
    assert_eq!(pictures.len(), 2);
    for (index, picture) in pictures.iter().enumerate() {
        write_png16(&lab.frames().join(format!("frame-{:03}.png", index + 1)), &mirrored(&turned(&crop(picture, shown))));
    }
    // One that the console did not crop: its K is not known, and that is said with what to do.
    write_png16(&lab.frames().join("frame-009.png"), &mirrored(&turned(&pictures[0])));
    without_radii(&lab);
    let (poses, pairs, said) = session(&lab, |session| {
        session["domain"] = json!("linear");
        session["console"] = json!({"rotation_deg": 90, "flip": "horizontal", "crop_px": shown});
        session["detector"] = json!("detector.json");
        session["landmarks"] = json!("beads.mrk.json");
        session["bead_radius_mm"] = json!(0.75);
    });
    let fits = |pose: &&Value| pose["frame"] != "frame-009";
    let good: Vec<Value> = poses.iter().filter(fits).cloned().collect();
    let errors = errors_px(&lab, &good, |[u, v]| [u + 40.0, v + 20.0]);
    assert_eq!(errors.len(), 2, "{said}");
    assert!(errors.iter().all(|(_, px)| *px < 0.5), "{errors:?}");
    assert_ne!(errors[0].0, errors[1].0, "each frame has its own pose");
    assert!(good.iter().all(|pose| !pose["pose"]["landmarks"].as_array().expect("asked for").is_empty()), "landmarks are stated");
    assert!(said.contains("frame size") && said.contains("declare"), "{said}");
    // Its beads give a pose all the same, with a K that fits them: it is in doubt, and the size is why.
    let told = poses.iter().find(|pose| pose["frame"] == "frame-009").expect("posed");
    assert_eq!((&told["pose"]["status"], &told["pose_source"]), (&json!("accepted"), &json!("beads")), "{told:#}");
    let doubted = told["pose"]["cautions"].to_string();
    assert!(told["pose"]["doubt"].is_string() && doubted.contains("[480, 620]") && doubted.contains("[440, 540]"), "{told:#}");
    assert!(good.iter().all(|pose| !pose["pose"]["cautions"].to_string().contains("[440, 540]")), "the control");
    let uncropped = pairs.iter().find(|pair| pair["frame"] == "frame-009").expect("a pair");
    let amber = ["accepted_in_doubt", "accepted_telemetry_disagrees"].map(Value::from);
    assert!(amber.contains(&uncropped["status"]), "{uncropped:#}");
    assert!(uncropped["flags"].to_string().contains("[480, 620]"), "{uncropped:#}");
    for pair in pairs.iter().filter(|pair| pair["frame"] != "frame-009") {
        assert_eq!(pair["air"]["rule"], "calibration", "{}", pair["air"]);
        assert!(pair["scores"]["rmse_nepers"].as_f64().is_some_and(|rmse| rmse < 0.3), "absolute numbers: {}", pair["scores"]);
        let size: Vec<u64> =
            pair["null_plan"]["size_px"].as_array().map(|s| s.iter().filter_map(Value::as_u64).collect()).unwrap_or_default();
        assert!(size.is_empty() || size[0] > size[1], "the panel lies across: {size:?}");
        // Beads of unknown radius are masked as if it were 1 mm.
        let pose = good.iter().find(|pose| pose["frame"] == pair["frame"]).expect("posed");
        let [declared, unknown] = [0.75, 1.0].map(|radius_mm| share_of_beads(&lab, pose, [shown[2], shown[3]], radius_mm));
        let share = pair["masks"]["causes"]["beads"].as_f64().expect("beads are masked");
        assert!((share / declared - 1.0).abs() < 0.02 && unknown > 1.2 * declared, "{share}, {declared}, {unknown}");
    }
    // A third more, and the shadows contradict it.
    let refused: Vec<Value> = pairs_of_radius(&lab, 0.975).into_iter().filter(|pair| pair["frame"] != "frame-009").collect();
    assert_eq!(refused.len(), 2);
    for pair in &refused {
        assert_eq!((&pair["status"], &pair["pose_source"]), (&json!("refused"), &json!("none")), "{pair:#}");
        let reason = pair["reason"].as_str().unwrap_or_default();
        assert!(reason.contains("smaller than the beads' radii give"), "{reason}");
    }
}

/// `live` compared every frame without a tone, so that a console's display picture had hardly a score that meant anything.
#[test]
fn a_display_picture_gets_the_scores_that_are_legal_for_it() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "2"]) else { return };
    for (index, picture) in pictures(&lab).iter().enumerate() {
        // What a console shows: binned, a curve of the signal, eight bits.
        let shown = binned(picture).map(|v| 255.0 * (v / 40_000.0).clamp(0.0, 1.0).powf(0.4));
        write_png8(&lab.frames().join(format!("frame-{:03}.png", index + 1)), &shown);
    }
    let (poses, pairs, said) = session(&lab, |session| {
        session["domain"] = json!("display");
        session["console"] = json!({"binning": 2});
    });
    let errors = errors_px(&lab, &poses, |[u, v]| [2.0 * (u + 0.5) - 0.5, 2.0 * (v + 0.5) - 0.5]);
    assert_eq!(errors.len(), 2, "{said}");
    assert!(errors.iter().all(|(_, px)| *px < 1.5), "{errors:?}");
    assert_eq!(pairs.len(), 2);
    for pair in &pairs {
        assert_eq!(pair["tone"]["tone"], "monotone", "{}", pair["tone"]);
        for name in ["edge_distance_mm", "gradient_ncc", "local_ncc", "zncc"] {
            assert!(pair["scores"][name].is_f64(), "{name}: {}", pair["scores"]);
        }
        assert!(pair["scores"]["zncc"].as_f64().is_some_and(|zncc| zncc > 0.9), "{}", pair["scores"]["zncc"]);
        assert!(pair["scores"]["rmse_nepers"].is_null(), "a display picture has no nepers");
    }
}

#[test]
fn a_wrong_word_in_a_session_is_named_before_the_first_exposure() {
    let folder = tempfile::tempdir().expect("scratch");
    let put = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("written");
    put("scene.json", r#"{"objects": []}"#);
    put("flat.json", r#"{"origin": "x", "columns_px": 0, "rows_px": 4}"#);
    put("points.fcsv", "# not a point\n");
    let path = folder.path().join("session.json");
    let mut cases = 0;
    for (key, value, says) in [
        ("domain", json!("linaer"), "domain"),
        ("tone", json!("gamma"), "tone"),
        ("air_level", json!("lots"), "air_level"),
        ("air_level", json!(-3), "air_level is -3"),
        ("bead_radius_mm", json!(0), "bead_radius_mm is 0"),
        ("landmarks", json!("nowhere.mrk.json"), "landmarks names nowhere.mrk.json"),
        ("landmarks", json!("points.fcsv"), "landmarks"),
        ("console", json!({"rotation_deg": 450}), "rotation_deg is 450"),
        ("console", json!({"detector_from_image": [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]}), "detector_from_image"),
        ("console", json!({"rotate": 90}), "console"),
        ("console", json!({"zoom": -1}), "zoom is -1"),
        ("detector", json!("nowhere.json"), "detector names nowhere.json"),
        ("detector", json!("flat.json"), "columns_px"),
        ("intensifier", json!("nowhere.json"), "intensifier names nowhere.json"),
        ("intensifier", json!("flat.json"), "intensifier"),
        ("tags", json!("nowhere.json"), "tags names nowhere.json"),
        ("tags", json!("flat.json"), "family"),
    ] {
        let mut session = json!({"frames": {"folder": "frames"}, "scene": "scene.json"});
        session[key] = value;
        std::fs::write(&path, session.to_string()).expect("written");
        let error = sidecarm::session::file::Setup::load(&path).expect_err("a wrong word").to_string();
        assert!(error.contains(says), "{key}: {error}");
        cases += 1;
    }
    assert_eq!(cases, 17);
    // Its angles would be those of one frame.
    let scene = path.with_file_name("distorting.json");
    std::fs::write(&scene, json!({"detector": {"intensifier": {"calibration": "ii.json"}}}).to_string()).expect("written");
    let session = json!({"frames": {"folder": "frames"}, "scene": "distorting.json"});
    std::fs::write(&path, session.to_string()).expect("written");
    let error = sidecarm::session::file::Setup::load(&path).expect_err("distorts").to_string();
    assert!(error.contains("detector.intensifier") && error.contains("\"intensifier\": \"FILE.json\""), "{error}");
    let twice = json!({"frames": {"folder": "frames", "domain": "log"}, "scene": "scene.json", "domain": "linear"});
    std::fs::write(&path, twice.to_string()).expect("written");
    assert!(sidecarm::session::file::Setup::load(&path).expect_err("two domains").to_string().contains("frames.domain"));
    let good = json!({"frames": {"folder": "frames"}, "scene": "scene.json", "domain": "display", "tone": "monotone", "air_level": "maximum",
        "bead_radius_mm": 0.75, "console": {"rotation_deg": 270, "flip": "vertical"}});
    std::fs::write(&path, good.to_string()).expect("written");
    let setup = sidecarm::session::file::Setup::load(&path).expect("all known");
    let back: Value = serde_json::to_value(&setup.session).expect("JSON");
    assert_eq!(back["air_level"], "maximum", "the log keeps the word");
}

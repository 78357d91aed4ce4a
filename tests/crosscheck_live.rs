//! Sessions whose files contradict each other, through `live` with the mocked laboratory: what is refused, and what is amber.
#![cfg(unix)]

use std::io::{Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};

use rustix::process::{Pid, kill_process};
use serde_json::{Value, json as value};
use sidecarm::image::{Image, read_png_rgb};
use sidecarm::report::{Pair, restated};

use crate::crosscheck_image::json;
use crate::crosscheck_session::{Mock, edit, move_beads, take_ct_away};
use crate::live_lab::{HANG_S, Signal, eventually, pairs_in};
use crate::session_demo::mock_is_built;
use crate::session_names::replay_words;

/// Runs `live` on a mocked laboratory whose files `spoil` has changed, until its three frames have their pairs; those, the report and what was
/// printed.
pub fn live(folder: &Path, options: &[&str], spoil: impl FnOnce(&Path)) -> (Vec<Value>, String, String) {
    const FRAMES: usize = 3;
    let exposures = FRAMES.to_string();
    let mut all =
        vec!["--duration-s", "8", "--exposures", &exposures, "--faults", "none", "--start-delay-s", "1", "--idle-s", "300"];
    all.extend(options);
    let mock = Mock::start(folder, &all);
    spoil(&mock.lab);
    let session = mock.lab.join("session.json");
    let out = mock.lab.join("session");
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("live").arg(session).args(["--headless", "--include-existing"]);
    let live = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("starts");
    let id = Pid::from_child(&live);
    let running = std::thread::spawn(move || live.wait_with_output().expect("runs"));
    let is_over = eventually(HANG_S, || (running.is_finished() || pairs_in(&out) >= FRAMES).then(|| running.is_finished()));
    if is_over != Some(true) {
        // It may have ended just now.
        let _ = kill_process(id, Signal::INT);
    }
    let run = running.join().expect("no panic");
    let words = format!("{}{}{}", String::from_utf8_lossy(&run.stdout), String::from_utf8_lossy(&run.stderr), run.status);
    assert!(out.join("session.mcap").exists(), "{words}");
    let pairs = json(&out.join("pairs.json"))["pairs"].as_array().expect("a list").clone();
    assert_eq!(pairs.len(), FRAMES, "{words}");
    let report = std::fs::read_to_string(out.join("report.html")).expect("report");
    (pairs, report, words)
}

/// Beads whose file says RAS but holds LPS were accepted in green in 6 of 7 frames, with the DRR turned by 180°, and the specimen was tied
/// to the room by that pose; the scene's own spheres stood elsewhere, and nobody compared.
#[test]
fn beads_that_say_ras_but_hold_lps_are_refused_in_a_live_session() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, report, words) = live(folder.path(), &["--no-robot"], |lab| {
        edit(lab, "beads.mrk.json", |beads| beads["markups"][0]["coordinateSystem"] = value!("RAS"));
        edit(lab, "session.json", |session| session["world_from_lps"] = Value::Null);
    });
    for pair in &pairs {
        let reason = pair["reason"].as_str().unwrap_or_default();
        assert!(pair["status"] != "accepted" && pair["pose_source"] != "beads", "{pair}");
        assert!(
            reason.contains("RAS and LPS were swapped") && reason.contains("set its coordinateSystem to \"LPS\""),
            "{reason}"
        );
        // The robot's line is not there either, and the scene has a robot.
        assert_eq!(pair["robot_source"], "scene");
    }
    assert!(words.contains("0 accepted") && words.contains("check: beads and spheres"), "{words}");
    // Not one pose is what the session was for.
    assert!(words.contains("lost: not one of 3 frames gave a pose by its beads") && words.contains("exit status: 3"), "{words}");
    assert!(report.contains("not one of 3 frames gave a pose by its beads"));
    let again = replay_words(&folder.path().join("lab/session/session.mcap"), &folder.path().join("again"));
    assert!(again.contains("lost in the session: not one of 3 frames gave a pose by its beads"), "{again}");
    assert!(!words.contains("tied to the room"), "{words}");
    let robot = "robot drawn as in the scene file: no telemetry";
    assert!(
        report.contains(robot) && words.contains(robot) && words.contains("with the robot drawn as in the scene file"),
        "{words}"
    );
}

/// The reverse: the file says LPS, and its numbers are RAS.
#[test]
fn beads_that_say_lps_but_hold_ras_are_refused_in_a_live_session() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, _, words) = live(folder.path(), &[], |lab| {
        take_ct_away(lab);
        move_beads(lab, |[x, y, z]| [-x, -y, z]);
        edit(lab, "session.json", |session| session["world_from_lps"] = Value::Null);
    });
    for pair in &pairs {
        let reason = pair["reason"].as_str().unwrap_or_default();
        assert!(pair["status"] != "accepted" && pair["pose_source"] != "beads", "{pair}");
        let told = ["RAS and LPS were swapped", "says LPS but its numbers are RAS", "set its coordinateSystem to \"RAS\""];
        assert!(told.iter().all(|words| reason.contains(words)), "{reason}");
    }
    assert!(words.contains("0 accepted") && words.contains("check: beads and spheres"), "{words}");
    assert!(words.contains("lost: not one of 3 frames gave a pose by its beads") && words.contains("exit status: 3"), "{words}");
    assert!(!words.contains("tied to the room"), "{words}");
}

/// The part of a strip's header in which name and status stand; scores stand to its right.
fn status_of(strip: &Image<[u8; 3]>) -> Vec<[u8; 3]> {
    const ROWS: usize = 52;
    let wide = 6 * strip.width / 10;
    strip.pixels.chunks_exact(strip.width).take(ROWS).flat_map(|row| row[..wide].iter().copied()).collect()
}

/// A robot that is drawn as in the scene, for want of its line, was told in `pairs.json` only.
#[test]
fn a_robot_that_is_drawn_without_telemetry_is_said_in_the_strips_of_a_live_session() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, ..) = live(folder.path(), &["--no-robot"], take_ct_away);
    let mut accepted = 0;
    for row in &pairs {
        let pair: Pair = serde_json::from_value(row.clone()).expect("a pair");
        let said = pair.robot_words().unwrap_or_else(|| panic!("nothing of the robot: {row:#}"));
        let strip = pair.strip.as_ref().expect("a strip");
        let strip = read_png_rgb(&folder.path().join("lab/session").join(strip)).expect("readable");
        // What a strip says is drawn: the same words once more are the same picture.
        let with = |status: &str| status_of(&restated(strip.clone(), &pair.frame, pair.standing(), status));
        let status = pair.status_line();
        assert!(status.contains(said), "{status}");
        assert!(status_of(&strip) == with(&status), "frame {} does not say '{status}'", pair.number);
        let silent = status.replace(said, "");
        assert!(silent != status && status_of(&strip) != with(&silent), "control: other words are another picture");
        accepted += usize::from(pair.is_from_beads());
    }
    assert!(accepted >= 2, "{accepted} of {}", pairs.len());
}

fn change_ct(lab: &Path, change: impl FnOnce(&mut [u8])) {
    let mut bytes = Vec::new();
    let path = lab.join("ct.nii.gz");
    let file = std::fs::File::open(&path).expect("the CT");
    flate2::read::GzDecoder::new(file).read_to_end(&mut bytes).expect("unpacks");
    change(&mut bytes);
    let mut packed = flate2::write::GzEncoder::new(std::fs::File::create(&path).expect("writable"), flate2::Compression::fast());
    packed.write_all(&bytes).and_then(|()| packed.finish().map(drop)).expect("written");
}

/// Every pair by beads, two at least, is amber because of the image; how many.
fn assert_amber(pairs: &[Value], because: &str) -> usize {
    let by_beads = || pairs.iter().filter(|pair| pair["pose_source"] == "beads");
    for pair in by_beads() {
        assert_eq!(pair["status"], "accepted_image_disagrees", "{}: {}", pair["frame"], pair["null"]["local_ncc"]);
        let reason = pair["reason"].as_str().unwrap_or_default();
        assert!(reason.contains("image disagrees") && reason.contains(because), "{reason}");
    }
    let amber = by_beads().count();
    assert!(amber >= 2, "{amber} of {}", pairs.len());
    amber
}

/// Beads, spheres and robot right, only the voxels in a mirror: every frame was accepted in green.
#[test]
fn a_ct_in_a_mirror_is_amber_in_a_live_session() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, ..) = live(folder.path(), &[], |lab| {
        change_ct(lab, |bytes| {
            let half = |at: usize| i16::from_le_bytes([bytes[at], bytes[at + 1]]);
            // NIfTI-1: dim at 42, bits of a voxel at 72, voxels from 352 on. Slices in reverse: head for foot.
            let [columns, rows, slices] = [42, 44, 46].map(|at| half(at) as usize);
            let slice = columns * rows * half(72) as usize / 8;
            let voxels = bytes[352..352 + slices * slice].to_vec();
            bytes[352..]
                .chunks_exact_mut(slice)
                .zip(voxels.chunks_exact(slice).rev())
                .for_each(|(to, from)| to.copy_from_slice(from));
        });
    });
    assert_amber(&pairs, "are CT and beads turned or mirrored against each other?");
}

/// A CT that lies 10 mm too high under beads that are right: the beads agree, the image does not.
#[test]
fn an_image_that_disagrees_with_its_beads_is_amber_in_a_live_session() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, report, words) = live(folder.path(), &[], |lab| {
        change_ct(lab, |bytes| {
            // Row z of the sform, its offset.
            let at = 312 + 12;
            let number = f32::from_le_bytes(bytes[at..at + 4].try_into().expect("four"));
            bytes[at..at + 4].copy_from_slice(&(number + 10.0).to_le_bytes());
        });
    });
    let amber = assert_amber(&pairs, "scores prefer");
    assert!(words.contains(&format!(" 0 accepted, {amber} accepted but the image disagrees")), "{words}");
    assert!(report.contains("class=\"badge caution\">accepted, image disagrees") && !report.contains("badge good"));
}

/// It was said, and used all the same: a focal length of two pixels, no beads of such a size, and the word to open the collimator.
#[test]
fn a_distance_in_metres_is_said_and_the_calibration_s_is_used_in_a_live_session() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, _, words) = live(folder.path(), &["--odd", "sid-in-metres"], take_ct_away);
    let by_beads = pairs.iter().filter(|pair| pair["pose_source"] == "beads" && pair["k_source"] == "carm");
    assert!(by_beads.count() >= 2 && !words.contains("too_few_shadows"), "{pairs:#?} {words}");
    assert!(words.contains("metres taken for millimetres?; the calibration's 1020 mm are used"), "{words}");
    let told = pairs.iter().filter(|pair| pair["binding"] != "none");
    assert!(told.clone().count() >= 2, "{words}");
    for pair in told {
        assert!(pair["flags"].to_string().contains("the calibration's 1020 mm are used"), "{pair:#}");
    }
}

/// A detector 22 mm farther away than the frame's own tag says: the beads fit as well, 14 mm deeper. (From 3 % on they tell by themselves.)
#[test]
fn a_detector_that_the_frame_puts_elsewhere_is_amber_in_a_live_session() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, report, words) = live(folder.path(), &[], |lab| {
        edit(lab, "carm.json", |carm| carm["offsets"]["source_to_detector_mm"] = value!(22.0));
    });
    assert!(pairs.len() >= 2, "{words}");
    let mut amber = 0;
    for pair in &pairs {
        let status = pair["status"].as_str().unwrap_or_default();
        assert!(["accepted_telemetry_disagrees", "accepted_image_disagrees", "refused"].contains(&status), "{pair}");
        assert!(pair["flags"].to_string().contains("focal spot to detector"), "{pair}");
        amber += usize::from(status.starts_with("accepted"));
    }
    assert!(amber >= 2, "{words}");
    assert!(words.contains(" 0 accepted") && !report.contains("badge good"), "{words}");
}

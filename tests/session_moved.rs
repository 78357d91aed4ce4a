//! A specimen that somebody moves in mid-session while the C-arm's telemetry is right, and frames whose names differ in nothing but what looks
//! like their ending: through `live`, and through `replay` of its log.
#![cfg(unix)]

use std::path::Path;
use std::process::Command;

use glam::DVec3;
use serde_json::{Value, json};
use sidecarm::acquire::read_frame;
use sidecarm::geometry::Projection;
use sidecarm::image::{Image, read_png_rgb, read_tiff_f32, sha256_file};

use crate::lab_truth::{file_of, has_its_own_exposure, poses, prior_is_right, robot_is_right};
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};

const EXPOSURES: u32 = 6;
/// Frames of exposures from here on, counted from 1, show the specimen 15 mm and 4 degrees from where it lay.
const MOVED_FROM: u32 = 4;
/// What telemetry, whose encoders are noisy, may make of that; where the session declares the specimen, its own error comes on top.
const MOVED_MM: std::ops::Range<f64> = 12.0..20.0;
const MOVED_DEG: std::ops::Range<f64> = 3.2..4.7;
/// Largest distance of the beads from where the truth has them, and the least by which another exposure, or the specimen unmoved, is off.
const RIGHT_PX: f64 = 0.5;
const WRONG_PX: f64 = 20.0;

/// The arm of the lab as one that is known to so many mm and degrees: what it does unmeasured is no jump, the move is.
const MEASURED: &str = "measured.json";
const SIGMA: (f64, f64) = (4.0, 0.45);

const PLAIN: &str = "accepted";
const DISAGREES: &str = "accepted_telemetry_disagrees";

/// A session that has ended.
struct Session {
    lab: Lab,
    live: Live,
    /// Rows of `pairs.json`, and the poses of the log.
    pairs: Vec<Value>,
    poses: Vec<Value>,
    /// All that was printed.
    words: String,
}

fn rows(folder: &Path) -> Vec<Value> {
    let bytes = std::fs::read(folder.join("pairs.json")).expect("pairs.json");
    let value: Value = serde_json::from_slice(&bytes).expect("JSON");
    value["pairs"].as_array().expect("a list").clone()
}

/// Plays a session in which the specimen is moved and nothing is lost. Its frames come under `names`, each when the one before has its pose:
/// a crowded machine registers them in their order as well.
fn session(stands: &str, names: [&str; EXPOSURES as usize], declare: impl FnOnce(&mut Value)) -> Option<Session> {
    let (exposures, moved_from) = (EXPOSURES.to_string(), MOVED_FROM.to_string());
    let lab = Lab::start(&[
        "--duration-s",
        "12",
        "--faults",
        "none",
        "--exposures",
        &exposures,
        "--specimen-moves",
        &moved_from,
        "--stands",
        stands,
        "--await-all",
        "--start-delay-s",
        "2",
        "--idle-s",
        "300",
    ])?;
    let received = lab.kit.join("received");
    std::fs::create_dir(&received).expect("a folder");
    let arm = std::fs::read(lab.kit.join("carm.json")).expect("the arm");
    let mut arm: Value = serde_json::from_slice(&arm).expect("JSON");
    (arm["camera_sigma_mm"], arm["camera_sigma_deg"]) = (json!(SIGMA.0), json!(SIGMA.1));
    std::fs::write(lab.kit.join(MEASURED), arm.to_string()).expect("written");
    let file = lab.session("moved.json", |session| {
        session["frames"]["folder"] = json!(received);
        declare(session);
    });
    let mut live = Live::start(&file, &lab.kit.with_file_name("session"), &[]);
    for (counter, name) in (1..).zip(names) {
        let taken = file_of(&lab, counter);
        let whole = eventually(HANG_S, || read_frame(&taken, None).ok().map(drop));
        assert!(whole.is_some(), "no frame of exposure {counter}: {}", live.stderr());
        let staged = lab.kit.join("staged");
        std::fs::copy(&taken, &staged).expect("copied");
        std::fs::rename(&staged, received.join(name)).expect("renamed");
        let beginning = format!("frame {counter} (");
        let posed = eventually(HANG_S, || live.stderr().lines().any(|line| line.starts_with(&beginning)).then_some(()));
        assert!(posed.is_some(), "frame {counter} is not posed: {}", live.stderr());
    }
    live.signalled(Signal::INT);
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();
    // What it printed last may still be on its way here.
    let said = eventually(10.0, || live.stdout().contains("specimen in the room: ").then_some(()));
    let words = format!("exit code {code:?}: {} {}", live.stdout(), live.stderr());
    // A specimen that was moved is no loss.
    assert!(code == Some(0) && said.is_some() && !words.contains("lost: "), "{words}");
    let (pairs, poses) = (rows(&live.out), poses(&live));
    assert!(pairs.len() == EXPOSURES as usize && poses.len() == pairs.len(), "{} pairs: {words}", pairs.len());
    each_is_said(&live.stderr(), &pairs);
    Some(Session { lab, live, pairs, poses, words })
}

/// `live --headless` said nothing of the frames that it accepted: each has its line on standard error, with its residual.
fn each_is_said(stderr: &str, pairs: &[Value]) {
    for pair in pairs {
        let (number, name) = (pair["number"].as_u64().expect("a number"), pair["frame"].as_str().expect("a name"));
        let rms_px = pair["rms_px"].as_f64().unwrap_or_else(|| panic!("accepted: {pair:#}"));
        let line = |number: u64| {
            let (label, outcome) = (format!("frame {number} ({name})"), format!(": accepted, rms {rms_px:.3} px"));
            stderr.lines().any(|line| line.starts_with(&label) && line.contains(&outcome))
        };
        assert!(line(number) && !line(number + 1), "frame {number} ({name}), rms {rms_px:.3} px: {stderr}");
    }
}

/// Sentences about where the specimen lies, in the order of the alphabet: other threads than the one that registers have their say as well.
fn of_the_specimen(words: &str) -> Vec<&str> {
    let mut found: Vec<&str> = words.lines().filter(|line| line.contains("the specimen ")).collect();
    found.sort_unstable();
    found
}

/// The only sentence with this beginning, and with this further on.
fn sentence<'a>(words: &'a str, beginning: &str, further_on: &str) -> &'a str {
    let beginning = format!("warning: {beginning}");
    let found: Vec<&str> = words.lines().filter(|line| line.starts_with(&beginning) && line.contains(further_on)).collect();
    assert_eq!(found.len(), 1, "'{beginning} … {further_on}': {words}");
    found[0]
}

/// The sentence says `… mm and … degrees`, and that is by how much the specimen was moved.
fn says_how_far(sentence: &str) {
    let words: Vec<&str> = sentence.split(' ').collect();
    let before = |unit: &str| -> Option<f64> { words[words.iter().position(|word| *word == unit)? - 1].parse().ok() };
    let far =
        before("mm").is_some_and(|mm| MOVED_MM.contains(&mm)) && before("degrees").is_some_and(|deg| MOVED_DEG.contains(&deg));
    assert!(far, "{sentence}");
}

/// Telemetry and beads are apart by as much as the specimen was moved, and the pair says so.
fn telemetry_is_off(pair: &Value) {
    let shift: Vec<f64> = pair["innovation"]["shift_mm"].as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
    let mm = shift.iter().map(|mm| mm * mm).sum::<f64>().sqrt();
    let turned = pair["innovation"]["turn_deg"].as_f64().is_some_and(|deg| MOVED_DEG.contains(&deg));
    assert!(shift.len() == 3 && MOVED_MM.contains(&mm) && turned, "{pair:#}");
    let reason = pair["reason"].as_str().unwrap_or_default();
    assert!(reason.starts_with("telemetry and beads are "), "{pair:#}");
    says_how_far(reason);
    assert!(pair["flags"].to_string().contains(reason), "{pair:#}");
}

/// So many frames are accepted against telemetry, in the summary and in the report, which says `why`.
fn in_amber(session: &Session, count: u32, why: &str) {
    let (words, report) = (&session.words, session.live.report());
    let others = EXPOSURES - count;
    assert!(words.contains(&format!("6 frames, {others} accepted, {count} accepted but telemetry disagrees")), "{words}");
    let told = format!("<b class=\"caution\">{count}</b><span>accepted, telemetry disagrees");
    assert!(report.contains(&told) && report.contains(why), "{words}");
}

fn statuses(session: &Session) -> Vec<&str> {
    session.pairs.iter().map(|pair| pair["status"].as_str().unwrap_or_default()).collect()
}

/// Of values that are there in both; NaN where there is nothing.
fn correlation(pairs: impl Iterator<Item = (f64, f64)>) -> f64 {
    let pairs: Vec<(f64, f64)> = pairs.filter(|(a, b)| a.is_finite() && b.is_finite()).collect();
    let count = pairs.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / count;
    let (mean_a, mean_b) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in pairs {
        let (a, b) = (a - mean_a, b - mean_b);
        (ab, aa, bb) = (ab + a * b, aa + a * a, bb + b * b);
    }
    ab / (aa * bb).sqrt()
}

/// That a picture is that of the `index`-th frame: `alike` says how much it is like each of them.
fn is_of_frame(index: usize, alike: &[f64], what: &str) {
    let best = (0..alike.len()).max_by(|a, b| alike[*a].total_cmp(&alike[*b]));
    assert!(
        best == Some(index) && alike[index] > 0.8,
        "the {what} of frame {} correlates with the frames by {alike:.3?}",
        index + 1
    );
}

/// Like `frame`, by what the strip shows under "acquired": left of its four panels, below header and title, above the scale.
fn strip_is_like(strip: &Image<[u8; 3]>, frame: &Image<f32>) -> f64 {
    let (left, top) = (22, 88);
    let (width, height) = ((strip.width - 2 * left - 3 * 16) / 4, strip.height - top - 63);
    let at = |index: usize| {
        let (column, row) = (index % width, index / width);
        let shown = f64::from(strip.at(left + column, top + row)[0]);
        (shown, f64::from(*frame.at(column * frame.width / width, row * frame.height / height)))
    };
    correlation((0..width * height).map(at))
}

/// That every frame has its own pose, DRR, strip and scores, whatever it is called, and that no pose is wrong.
fn each_frame_has_its_own(session: &Session) {
    let Session { lab, live, pairs, poses, .. } = session;
    let truth: Value = serde_json::from_slice(&std::fs::read(lab.kit.join("truth.json")).expect("truth")).expect("JSON");
    let beads: Vec<DVec3> = truth["beads"]
        .as_array()
        .expect("beads")
        .iter()
        .map(|bead| serde_json::from_value(bead["lps_mm"].clone()).expect("a point"))
        .collect();
    assert!(beads.len() >= 6);
    let projection = |value: &Value| -> Projection { serde_json::from_value(value["projection"].clone()).expect("a projection") };
    let truths: Vec<Projection> = truth["frames"].as_array().expect("frames").iter().map(projection).collect();
    let nepers = |counter: u32| {
        let frame = read_frame(&file_of(lab, counter), None).expect("a frame");
        frame.pixels.map(|value| -value.max(1.0).ln())
    };
    let frames: Vec<Image<f32>> = (1..=EXPOSURES).map(nepers).collect();
    assert!(truths.len() == pairs.len() && frames.len() == pairs.len());
    for (index, (pair, pose)) in pairs.iter().zip(poses).enumerate() {
        let number = index + 1;
        assert!(pair["number"] == number && pose["number"] == number, "{pair:#} {pose:#}");
        let sha256 = sha256_file(&file_of(lab, number as u32)).expect("readable");
        assert_eq!(pair["sha256"], sha256.as_str(), "{pair:#}");
        assert!(pair["binding"] == "counter" && pose["binding"]["exposure"]["counter"] == number, "{pair:#} {pose:#}");
        robot_is_right(pose, number as u32);

        let found = projection(pose);
        for (other, truth) in truths.iter().enumerate() {
            let off = beads.iter().map(|bead| found.project(*bead).0.distance(truth.project(*bead).0)).fold(0.0, f64::max);
            let right = if other == index { off < RIGHT_PX } else { off > WRONG_PX };
            assert!(right, "frame {number} is {off} px from where exposure {} was taken: {pair:#}", other + 1);
        }

        assert_eq!(pair["strip"], format!("strips/{number:03}.png"), "{pair:#}");
        assert_eq!(pair["drr"], format!("drr/{number:03}.tif"), "{pair:#}");
        let drr = read_tiff_f32(&live.out.join(format!("drr/{number:03}.tif"))).expect("a DRR").remove(0);
        let strip = read_png_rgb(&live.out.join(format!("strips/{number:03}.png"))).expect("a strip");
        assert!(frames.iter().all(|frame| frame.same_size(&drr)));
        let of_drr = |frame: &Image<f32>| {
            correlation(frame.pixels.iter().zip(&drr.pixels).map(|(seen, drawn)| (f64::from(*seen), f64::from(*drawn))))
        };
        is_of_frame(index, &frames.iter().map(of_drr).collect::<Vec<_>>(), "DRR");
        is_of_frame(index, &frames.iter().map(|frame| strip_is_like(&strip, frame)).collect::<Vec<_>>(), "strip");
        // Scores of another frame's picture are far lower.
        assert!(pair["scores"]["zncc"].as_f64().is_some_and(|zncc| zncc > 0.98), "{pair:#}");
    }
}

/// That a replay of the log gives the same poses, images and scores, says the same of each pair and of the specimen, and writes the same
/// pictures.
fn replays_alike(session: &Session) {
    let Session { lab, live, pairs, .. } = session;
    let again = lab.kit.with_file_name("again");
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let run = command.arg("replay").arg(&live.log).arg("--data").arg(&lab.kit).arg("--json").arg("--out").arg(&again).output();
    let run = run.expect("starts");
    let words = String::from_utf8_lossy(&run.stderr).into_owned();
    let found: Value = serde_json::from_slice(&run.stdout).unwrap_or_else(|_| panic!("{words}"));
    assert_eq!(run.status.code(), Some(0), "{found:#} {words}");
    for what in ["poses", "images", "scores"] {
        let identical = found[format!("{what}_identical")].as_u64();
        assert!(identical.is_some_and(|count| count >= u64::from(EXPOSURES)), "{what}: {found:#}");
        assert_eq!(found[format!("{what}_different")].as_array().map(Vec::len), Some(0), "{what}: {found:#}");
    }
    assert_eq!(of_the_specimen(&words), of_the_specimen(&live.stderr()));
    let replayed = rows(&again);
    assert_eq!(replayed.len(), pairs.len());
    for (then, now) in pairs.iter().zip(&replayed) {
        for key in ["number", "frame", "sha256", "status", "reason", "pose_source", "binding", "innovation", "flags", "scores"] {
            assert_eq!(then[key], now[key], "{key} of {then:#}");
        }
        for key in ["strip", "drr"] {
            assert_eq!(then[key], now[key], "{key} of {then:#}");
            let bytes = |folder: &Path| std::fs::read(folder.join(then[key].as_str().expect("a path"))).expect("a picture");
            assert!(bytes(&live.out) == bytes(&again), "the {key} of frame {} is another in the replay", then["number"]);
        }
    }
}

/// Telemetry is fused where it says where the specimen lies and nothing contradicts that; the move is a jump, and no part of the pose.
fn fused_but_for_the_jump(poses: &[Value]) {
    for (pose, counter) in poses.iter().zip(1..) {
        let pose = &pose["pose"];
        let chi2 = pose["innovation"]["chi2"].as_f64();
        let doubt = pose["doubt"].as_str().unwrap_or_default();
        match counter {
            3 | 6 => assert!(pose["fused"] == true && chi2.is_some_and(|chi2| chi2 < 22.0) && doubt.is_empty(), "{pose:#}"),
            MOVED_FROM => {
                assert!(pose["fused"] == false && chi2.is_some_and(|chi2| chi2 > 23.0), "{pose:#}");
                assert!(doubt.starts_with("telemetry is ") && doubt.contains("is not fused"), "{pose:#}");
            }
            // Before the specimen is tied, and while that is disputed, telemetry measures nothing.
            _ => assert!(pose["fused"] == false && pose["innovation"].is_null() && doubt.is_empty(), "{pose:#}"),
        }
    }
}

/// The first frame after the move contradicts the tie, the second one replaces it, and from the third on all is as before. Frames named by a
/// DICOM receiver once lost the end of their UIDs to a supposed extension: one frame's picture stood beside another's scores.
#[test]
fn a_specimen_that_is_moved_is_said_and_tied_anew_by_two_frames() {
    let names = [
        "XA.1.2.840.113619.1",
        "XA.1.2.840.113619.2",
        "XA.1.2.840.113619.3",
        "XA.1.2.840.113619.4",
        "XA.1.2.840.113619.5",
        "XA.1.2.840.113619.6",
    ];
    let declare = |session: &mut Value| {
        session["world_from_lps"] = Value::Null;
        (session["carm"]["calibration"], session["carm"]["fuse"]) = (json!(MEASURED), json!(true));
    };
    let Some(session) = session("1,2,3,4,5,6", names, declare) else { return };
    let words = &session.words;
    assert_eq!(statuses(&session), [PLAIN, PLAIN, PLAIN, DISAGREES, DISAGREES, PLAIN], "{words}");
    let first = sentence(words, "frame 4: its beads put the specimen ", " from where earlier frames and telemetry do");
    assert!(first.ends_with("was it moved, or is telemetry wrong?"), "{first}");
    says_how_far(first);
    let second =
        sentence(words, "frame 5: the specimen was tied to the room anew", "this frame and frame 4 agree with each other");
    assert!(second.ends_with("it was moved, or telemetry is wrong"), "{second}");
    says_how_far(second);
    assert!(words.contains("2 x specimen in the room: ") && !words.contains("no longer tied"), "{words}");
    in_amber(&session, 2, "tied to the room anew");
    fused_but_for_the_jump(&session.poses);

    for (pair, counter) in session.pairs.iter().zip(1..) {
        has_its_own_exposure(&session.lab, &session.poses[counter as usize - 1], counter);
        match counter {
            // Nothing is expected of a specimen that is not tied yet.
            1 | 2 => assert!(pair["innovation"].is_null(), "{pair:#}"),
            // The joints are those of the tie, and what is expected afterwards is where it lies now.
            3 | 6 => prior_is_right(pair),
            _ => telemetry_is_off(pair),
        }
        let flagged = pair["flags"].to_string().contains("telemetry and beads are ");
        assert_eq!(flagged, [4, 5].contains(&counter), "{pair:#}");
        let sha256 = pair["sha256"].as_str().expect("a hash");
        assert_eq!(pair["frame"], format!("frame-{}", &sha256[..12]), "a name made of UIDs is not shown");
    }
    each_frame_has_its_own(&session);
    replays_alike(&session);
}

/// What the session declares is not overruled: every frame after the move is in amber and said. With the arm at one stand before and after, it
/// is said which frame shows the specimen elsewhere. All frames have one label, and names that differ in an ending of images alone.
#[test]
fn a_specimen_that_is_moved_from_where_the_session_declares_it_stays_in_doubt() {
    let names = ["XA.dcm", "XA.dicom", "XA.ima", "XA.DCM", "XA.IMA", "XA"];
    let Some(session) = session("1,2,3,3,5,6", names, |session| assert!(session["world_from_lps"].is_array())) else { return };
    let words = &session.words;
    assert_eq!(statuses(&session), [PLAIN, PLAIN, PLAIN, DISAGREES, DISAGREES, DISAGREES], "{words}");
    for number in MOVED_FROM..=EXPOSURES {
        let beginning = format!("frame {number}: its beads put the specimen ");
        let said = sentence(words, &beginning, " from where the session's world_from_lps and telemetry do: check world_from_lps");
        says_how_far(said);
    }
    assert!(words.contains("3 x specimen in the room: ") && !words.contains("tied to the room"), "{words}");
    in_amber(&session, 3, "world_from_lps and telemetry do");
    // Said once: frames after it are held against frames that show the specimen where it lies now.
    let moved =
        sentence(words, "frame 4 (XA): the specimen lies ", " from where frame 3 shows it, with the arm in the same place");
    says_how_far(moved);
    assert_eq!(words.matches("with the arm in the same place").count(), 2, "by itself, and in the summary: {words}");

    for (pair, counter) in session.pairs.iter().zip(1..) {
        if counter < MOVED_FROM {
            prior_is_right(pair);
        } else {
            telemetry_is_off(pair);
        }
        let flagged = pair["flags"].to_string().contains("from where frame 3 shows it");
        assert_eq!(flagged, counter == MOVED_FROM, "{pair:#}");
        assert_eq!(pair["frame"], "XA", "{pair:#}");
    }
    each_frame_has_its_own(&session);
    replays_alike(&session);
}

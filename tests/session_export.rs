//! A console that exports everything long after it was taken, through `live`: the samples of the exposures are forgotten by then.
#![cfg(unix)]

use std::path::{Path, PathBuf};

use dicom_core::VR;
use dicom_dictionary_std::tags;
use serde_json::{Value, json};
use sidecarm::record::{FrameAssembler, Provenance, Recorder, topic};
use sidecarm::telemetry::DeviceKind;

use crate::lab_truth::{counter_of, has_its_own_exposure, prior_is_right, put, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Sent, Signal, eventually};
use crate::log_lab::{entries, recorded, replay};

/// Samples of a device that the timeline keeps: ten minutes at 300 Hz. At two hundred times the C-arm's rate that is half a minute, which a
/// test can wait for.
const KEPT: usize = 200_000;
const FRAMES: usize = 6;
/// Of the frame whose tags say another voltage than telemetry, and the one whose tags say another distance.
const OTHER_KVP: u32 = 3;
const OTHER_SID: u32 = 5;

fn of_the_arm(sent: &[Sent], after_us: i64) -> usize {
    sent.iter().filter(|packet| packet.device == DeviceKind::Carm && packet.host_us > after_us).count()
}

/// Joints, prior and beam were those of the samples: frames that came when these were forgotten had none, and tags of another voltage were
/// held against nothing.
#[test]
fn frames_that_come_when_their_samples_are_forgotten_keep_exposure_joints_and_beam() {
    let frames = FRAMES.to_string();
    let lab = [
        "--duration-s",
        "10",
        "--exposures",
        &frames,
        "--idle-rate",
        "200",
        "--no-robot",
        "--faults",
        "none",
        "--await-all",
        "--idle-s",
        "400",
    ];
    let Some(lab) = Lab::start_without_ct(&lab) else { return };
    let folder = lab.kit.join("exported");
    std::fs::create_dir(&folder).expect("a folder");
    let session = lab.session("export.json", |session| session["frames"]["folder"] = "exported".into());
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    let delivered = eventually(HANG_S, || Some(lab.delivered()).filter(|files| files.len() == FRAMES));
    let last_us = delivered.expect("all frames").into_iter().map(|(_, at_us)| at_us).max().expect("frames");
    let forgotten = eventually(HANG_S, || {
        std::thread::sleep(std::time::Duration::from_secs(2));
        (of_the_arm(&lab.sent(), last_us) > KEPT + KEPT / 50).then_some(())
    });
    assert!(forgotten.is_some(), "the C-arm goes on");
    // On a crowded machine some of what was sent is lost on the line.
    let heard = || {
        let packets = live.heard().packets;
        packets.iter().filter(|((device, _), at_us)| *device == DeviceKind::Carm && **at_us > last_us).count()
    };
    let heard = eventually(HANG_S, || (heard() > KEPT + 2000).then_some(()));
    assert!(heard.is_some(), "they are heard: {}", live.stderr());
    let exported_us = sidecarm::time::host_now_us();
    let mut files: Vec<PathBuf> = std::fs::read_dir(lab.frames()).expect("frames").flatten().map(|entry| entry.path()).collect();
    files.sort();
    for file in &files {
        let name = file.file_name().expect("a name").to_str().expect("UTF-8");
        let mut object = dicom_object::open_file(file).expect("a frame");
        match counter_of(name) {
            OTHER_KVP => put(&mut object, tags::KVP, VR::DS, "70"),
            OTHER_SID => put(&mut object, tags::DISTANCE_SOURCE_TO_DETECTOR, VR::DS, "1100"),
            _ => {}
        }
        let to = folder.join(name);
        object.write_to_file(to.with_extension("part")).expect("written");
        std::fs::rename(to.with_extension("part"), to).expect("renamed");
    }
    wait_for_pairs(&live, FRAMES);
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());

    let words = live.stderr();
    // What the test is about: between the last exposure and the export more samples came than are kept.
    let came = live.heard().packets;
    let came = came.iter().filter(|((device, _), at_us)| *device == DeviceKind::Carm && (last_us..exported_us).contains(*at_us));
    assert!(came.count() > KEPT + 1000, "too few samples to forget any: {words}");
    let frames = told_frames(&live);
    assert!(frames.len() == FRAMES, "{} frames: {words}", frames.len());
    for (pair, pose, counter) in &frames {
        let flags = pair["flags"].to_string();
        assert!(pair["binding"] != "none" && flags.contains("after its exposure"), "{pair:#}");
        has_its_own_exposure(&lab, pose, *counter);
        assert!(pair["gap_us"].as_i64().is_some_and(|gap_us| gap_us < 100_000), "joints of its own samples: {pair:#}");
        prior_is_right(pair);
        let (kvp, sid) =
            ("telemetry says 90 kVp, the frame 70", "the frame says 1100 mm from focal spot to detector, telemetry says 1020 mm");
        assert_eq!(flags.contains(kvp), *counter == OTHER_KVP, "{flags}");
        assert_eq!(flags.contains(sid), *counter == OTHER_SID, "{flags}");
    }
    assert!(
        words.contains("telemetry says 90 kVp, the frame 70") && words.contains("check that the frame belongs to this exposure"),
        "{words}"
    );
}

/// A device's samples are kept for ten minutes: later than that they are forgotten.
const LATER_US: i64 = 700_000_000;
/// From somewhere in an exposure to before the next one.
const EXPOSURE_US: i64 = 600_000;
/// Farthest that the drill's tip is seen from where it is drawn with the angles of telemetry, as in the demo. With those of the scene
/// file, which are all zero, none is seen near it.
const TIP_MM: f64 = 0.6;

/// Records the inputs of `log` anew in `out`, its frames last: before them the robot goes on, eleven minutes later and at a port that
/// was opened anew, with what it said in the log `after`. Of the devices it holds what they said until `until_us`, and frames of these `numbers`.
fn with_forgotten_samples(log: &Path, after: &Path, (until_us, numbers): (i64, &[u64]), out: &Path) {
    let inputs = entries(log);
    let mut last_us = inputs.first().expect("messages").host_us;
    let recorder = Recorder::create(out, &Provenance::of_this_program(last_us, Value::Null)).expect("a log");
    let mut assembler = FrameAssembler::default();
    let (mut frames, mut epoch) = (Vec::new(), 0);
    for entry in &inputs {
        match &*entry.topic {
            "/session/setup" | "/session/clock" => {
                recorder.json(&entry.topic, entry.host_us, &entry.json::<Value>().expect("JSON")).expect("recorded");
            }
            topic::CARM_RAW | topic::ROBOT_RAW if entry.host_us > until_us => {}
            topic::CARM_RAW | topic::ROBOT_RAW => {
                let device = entry.topic.trim_matches('/').trim_end_matches("/raw");
                let raw = entry.raw_bytes().expect("sound").expect("bytes");
                recorder.raw_bytes(device, raw.epoch, entry.host_us, raw.bytes).expect("recorded");
                (epoch, last_us) = (epoch.max(raw.epoch), last_us.max(entry.host_us));
            }
            topic::FRAME_TAGS | topic::FRAME_PIXELS => frames.extend(assembler.push(entry).expect("a frame")),
            _ => {}
        }
    }
    let mut at_us = last_us + LATER_US;
    for entry in entries(after).iter().filter(|entry| &*entry.topic == topic::ROBOT_RAW).take(100) {
        let raw = entry.raw_bytes().expect("sound").expect("bytes");
        recorder.raw_bytes("robot", epoch + 1, at_us, raw.bytes).expect("recorded");
        at_us += 10_000;
    }
    for frame in frames.iter().filter(|frame| numbers.contains(&u64::from(frame.number))) {
        recorder.frame(frame, at_us).expect("recorded");
    }
    recorder.json("/session/end", at_us, &json!({"host_us": at_us})).expect("recorded");
    recorder.finish().expect("finished");
}

fn rows(folder: &Path) -> Vec<Value> {
    let bytes = std::fs::read(folder.join("pairs.json")).expect("pairs.json");
    let value: Value = serde_json::from_slice(&bytes).expect("JSON");
    value["pairs"].as_array().expect("a list").clone()
}

/// The robot is drawn as it was in the exposure, by what is kept with that, in frames that come when its samples are forgotten. A
/// replay needs no ten minutes for that: it takes the times of its log.
#[test]
fn frames_that_come_when_the_robots_samples_are_forgotten_show_it_as_it_was() {
    let Some(recorded) = recorded() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let [log, after] = &recorded.logs;
    let (late, again) = (folder.path().join("late.mcap"), folder.path().join("again"));
    let in_time = rows(log.parent().expect("a folder"));
    // As many exposures as frames: beside one more, whose frame had not come when the session ended, frames that all come late may be of either.
    // The time of a frame that is bound to none is that of its arrival, when the next exposure may have been.
    let bound = || in_time.iter().filter(|pair| pair["binding"] != "none");
    let last_us = bound().filter_map(|pair| pair["time_us"].as_i64()).max().expect("pairs");
    let numbers: Vec<u64> = bound().filter_map(|pair| pair["number"].as_u64()).collect();
    with_forgotten_samples(log, after, (last_us + EXPOSURE_US, &numbers), &late);
    let (code, found) = replay(&late, &recorded.kit, &again);
    assert!(matches!(code, Some(0 | 3)), "{found:#}");
    let late = rows(&again);
    let (mut stored, mut seen) = (0, 0);
    for before in bound().filter(|pair| pair["robot_source"] == "sensed") {
        let pair = late.iter().find(|pair| pair["number"] == before["number"]).expect("the same frame");
        // Where its exposure was heard only in part, stamp and count may name none.
        if pair["binding"] == "none" {
            continue;
        }
        assert_eq!(pair["robot_source"], "stored with the exposure", "{pair:#}");
        assert!(pair["flags"].to_string().contains("after its exposure"), "{pair:#}");
        assert!(pair["gap_us"].as_i64().is_some_and(|gap_us| gap_us < 100_000), "angles of its own samples: {pair:#}");
        stored += 1;
        // Where beads say it, the camera is known to a fraction of a millimetre.
        if let Some(mm) = pair["tip"]["length_mm"].as_f64().filter(|_| pair["status"] == "accepted") {
            assert!(mm < TIP_MM, "{pair:#}");
            seen += 1;
        }
    }
    assert!(stored >= 3 && seen >= 2, "{stored} stored, {seen} seen: {found:#}");
}

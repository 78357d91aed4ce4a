//! Frames whose exposure becomes clear only after they were developed, through `live` and its replay.
#![cfg(unix)]

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::Value;
use sidecarm::time::Stopwatch;

use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};

fn pairs(folder: &Path) -> Vec<Value> {
    let bytes = std::fs::read(folder.join("pairs.json")).expect("pairs.json");
    let value: Value = serde_json::from_slice(&bytes).expect("JSON");
    value["pairs"].as_array().cloned().unwrap_or_default()
}

/// The frame at `from` by a console whose clock is two minutes and more ahead.
fn by_another_clock(from: &Path, to: &Path) {
    let mut object = dicom_object::open_file(from).expect("a frame");
    let time = object.element(tags::ACQUISITION_TIME).expect("a time").to_str().expect("text").trim().to_owned();
    let number = |range: std::ops::Range<usize>| time[range].parse::<u32>().expect("digits");
    let at_s = (number(0..2) * 60 + number(2..4)) * 60 + number(4..6) + 137;
    let time = format!("{:02}{:02}{:02}{}", at_s / 3600 % 24, at_s / 60 % 60, at_s % 60, &time[6..]);
    object.put(DataElement::new(tags::ACQUISITION_TIME, VR::TM, PrimitiveValue::from(time)));
    object.write_to_file(to).expect("written");
}

/// A console without a counter and with a clock of its own exports everything long after the last exposure: only all frames together say
/// which is whose, when the session ends. Until then their robot is drawn at the scene's angles.
#[test]
fn frames_bound_at_the_end_get_the_telemetry_of_their_exposure() {
    let Some(lab) = Lab::start(&["--duration-s", "12", "--faults", "none", "--no-counter", "--idle-s", "300"]) else { return };
    let lab = lab.without_ct();
    let folder = lab.kit.join("exported");
    std::fs::create_dir_all(&folder).expect("a folder");
    let session = lab.session("late.json", |session| {
        session["frames"]["folder"] = folder.to_str().expect("UTF-8").into();
        // By itself it is not found in a DRR without the specimen.
        session["air_level"] = Value::from(40_000);
    });
    let out = lab.kit.with_file_name("session");
    let mut live = Live::start(&session, &out, &[]);
    let delivered = eventually(HANG_S, || Some(lab.delivered()).filter(|delivered| delivered.len() == 8));
    assert!(delivered.is_some(), "{} frames", lab.delivered().len());
    // Longer than a frame may come after its exposure to be taken for that one's by its arrival.
    std::thread::sleep(Duration::from_millis(6500));
    let mut files: Vec<_> = std::fs::read_dir(lab.frames()).expect("frames").flatten().map(|entry| entry.path()).collect();
    files.sort();
    for file in files.iter().rev() {
        let to = folder.join(file.file_name().expect("a name"));
        by_another_clock(file, &to.with_extension("part"));
        std::fs::rename(to.with_extension("part"), to).expect("renamed");
    }
    assert!(eventually(HANG_S, || (live.pairs() == 8).then_some(())).is_some(), "{} pairs", live.pairs());
    let before = pairs(&out);
    assert!(before.iter().all(|pair| pair["binding"] == "none" && pair["robot_source"] == "scene"), "{before:#?}");

    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some_and(|status| status.success()), "{}", live.stderr());
    let after = pairs(&out);
    assert_eq!(after.len(), 8);
    // On a crowded machine the session begins to listen after the first exposure, whose frame comes last; nothing is then known of it.
    let heard = |pair: &&Value| pair["number"] != 8 || pair["binding"] != "none";
    assert!(after.iter().filter(heard).count() >= 7);
    for pair in after.iter().filter(heard) {
        let told = format!("frame {}: binding {}, robot {}", pair["number"], pair["binding"], pair["robot_source"]);
        assert!(pair["binding"] == "time" && pair["robot_source"] != "scene" && pair["pose_source"] != "none", "{told}");
    }
    assert!(live.stderr().contains("posed again"), "{}", live.stderr());
    // The robot is drawn where it was: its own score is better than before.
    let tool = |pairs: &[Value]| pairs.iter().filter_map(|pair| pair["scores_tool"]["zncc"].as_f64()).sum::<f64>();
    assert!(tool(&after) > tool(&before), "{} {}", tool(&after), tool(&before));

    let again = out.with_file_name("again");
    let mut replay = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let replayed = replay.arg("replay").arg(&live.log).arg("--json").arg("--out").arg(&again).output().expect("replays");
    let found: Value = serde_json::from_slice(&replayed.stdout).expect("JSON");
    assert_eq!(replayed.status.code(), Some(0), "{found}");
    assert_eq!((&found["poses_identical"], &found["images_identical"]), (&16.into(), &8.into()), "{found}");
    let bindings = |folder: &Path| pairs(folder).iter().map(|pair| pair["binding"].clone()).collect::<Vec<_>>();
    assert_eq!(bindings(&again), bindings(&out));
}

/// A console that exports every picture seven seconds after its exposure, when two or three others have been taken: counts and stamps were right
/// and nothing was bound.
#[test]
fn frames_that_come_after_the_next_exposures_are_bound_by_count_and_stamp() {
    const FRAMES: usize = 6;
    let frames = FRAMES.to_string();
    let Some(lab) = Lab::start(&["--duration-s", "14", "--faults", "none", "--exposures", &frames, "--idle-s", "300"]) else {
        return;
    };
    let lab = lab.without_ct();
    let folder = lab.kit.join("exported");
    std::fs::create_dir_all(&folder).expect("a folder");
    let session = lab.session("slow.json", |session| session["frames"]["folder"] = folder.to_str().expect("UTF-8").into());
    let out = lab.kit.with_file_name("session");
    let mut live = Live::start(&session, &out, &[]);
    let mut waiting: Vec<(std::path::PathBuf, Stopwatch)> = Vec::new();
    let mut copied = 0;
    let all = eventually(HANG_S, || {
        let files = std::fs::read_dir(lab.frames()).expect("frames").flatten().map(|entry| entry.path());
        for file in files.filter(|file| file.extension().is_some_and(|extension| extension == "dcm")) {
            if waiting.iter().all(|(known, _)| *known != file) {
                waiting.push((file, Stopwatch::start()));
            }
        }
        for (file, _) in waiting.iter().skip(copied).filter(|(_, seen)| seen.ms() > 6500.0) {
            let name = file.file_name().expect("a name");
            std::fs::copy(file, folder.join(name).with_extension("part")).expect("copied");
            std::fs::rename(folder.join(name).with_extension("part"), folder.join(name)).expect("renamed");
            copied += 1;
        }
        (lab.delivered().len() == FRAMES && copied == FRAMES).then_some(())
    });
    assert!(all.is_some(), "{copied} of {} frames", lab.delivered().len());
    assert!(eventually(HANG_S, || (live.pairs() == FRAMES).then_some(())).is_some(), "{} pairs", live.pairs());
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some_and(|status| status.success()), "{}", live.stderr());
    let pairs = pairs(&out);
    let bound: Vec<&Value> = pairs.iter().filter(|pair| pair["binding"] == "counter").collect();
    assert!(bound.len() + 1 >= FRAMES, "{} bound: {}", bound.len(), live.stderr());
    for pair in bound {
        let name = pair["frame"].as_str().expect("a name");
        let counter: u32 =
            name.trim_start_matches(|c: char| !c.is_ascii_digit()).parse().expect("frames are called by their counter");
        let evidence = pair["binding_evidence"].to_string();
        assert!(evidence.contains(&format!("exposure {counter}")), "{name}: {evidence}");
    }
}

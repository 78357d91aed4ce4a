//! `sidecarm attach`: a folder exported after the session, against the exposures in its log.

use std::path::{Path, PathBuf};
use std::process::Command;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::Value;
use sidecarm::record::{Provenance, Recorder};

use crate::acquire_frames::{fluoroscopy, save};
use crate::binding_draw::Draw;
use crate::telemetry_frames::carm;

/// 2026-11-21, ten in the morning, UTC.
const T0_US: i64 = 1_795_255_200_000_000;
const EXPOSURES: usize = 40;

/// A log with exposures at these seconds (0.4 s long) and moving joints, as `live` records it; no frame is in it.
fn log(folder: &Path, starts_s: &[f64]) -> PathBuf {
    let path = folder.join("session.mcap");
    let recorder = Recorder::create(&path, &Provenance::of_this_program(T0_US, Value::Null)).expect("a log");
    let end_s = starts_s.last().expect("exposures") + 20.0;
    for number in 0..(end_s * 25.0) as u32 {
        let at_s = f64::from(number) / 25.0;
        let on = starts_s.iter().any(|start| at_s >= *start && at_s < start + 0.4);
        let joints = [at_s, 0.0, 0.0, 0.0, 0.05 * at_s, 0.0, 1020.0];
        let packet = carm(number, 1_000 + (at_s * 1e6) as u64, joints, on, None);
        recorder.raw_bytes("carm", 1, T0_US + (at_s * 1e6) as i64 + 800, &packet).expect("recorded");
    }
    recorder.finish().expect("finished");
    path
}

/// A DICOM file of the exposure at `start_s`, by a console whose clock is off by `offset_s` and drifts; acquisition number always 1.
fn export(folder: &Path, name: &str, start_s: f64, offset_s: f64, content: u16) {
    let mut object = fluoroscopy();
    let console_s = start_s * (1.0 + 150e-6) - offset_s + 36_000.0;
    let second = console_s.floor() as i64;
    let time = format!("{:02}{:02}{:02}", second / 3600, second / 60 % 60, second % 60);
    object.put(DataElement::new(tags::ACQUISITION_TIME, VR::TM, PrimitiveValue::from(time)));
    object.put(DataElement::new(tags::ACQUISITION_NUMBER, VR::IS, PrimitiveValue::from("1")));
    let values: Vec<u16> = (0..8).map(|i| 100 + content * 8 + i).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    save(object, &folder.join(name));
}

fn attach(log: &Path, folder: &Path, more: &[&str]) -> (Option<i32>, Value, String) {
    let output =
        Command::new(env!("CARGO_BIN_EXE_sidecarm")).arg("attach").arg(log).arg(folder).arg("--json").args(more).output();
    let output = output.expect("the program starts");
    let words = String::from_utf8_lossy(&output.stderr).into_owned();
    (output.status.code(), serde_json::from_slice(&output.stdout).unwrap_or(Value::Null), words)
}

fn irregular() -> Vec<f64> {
    let mut draw = Draw::new(77, 1);
    let mut at = 10.0;
    let next = |_| {
        at += draw.log(4.0, 60.0);
        at
    };
    (0..EXPOSURES).map(next).collect()
}

/// Twenty-two of forty in the folders of a medium, of which nobody read a file, shuffled by name, the console four and a half minutes off and drifting, stamps of whole seconds, the counter stuck
/// at 1, and no frame in the log from which its clock could be learnt.
#[test]
fn a_folder_exported_afterwards_is_tied_to_the_logs_exposures() {
    let folder = tempfile::tempdir().expect("folder");
    let starts_s = irregular();
    let log = log(folder.path(), &starts_s);
    let before = std::fs::read(&log).expect("the log");
    let exported = folder.path().join("export");
    std::fs::create_dir(&exported).expect("folder");
    let mut chosen: Vec<usize> = (0..EXPOSURES).collect();
    let mut draw = Draw::new(78, 1);
    draw.shuffle(&mut chosen);
    chosen.truncate(22);
    let studies = [0, 1].map(|study| exported.join(format!("DICOM/STUDY{study}")));
    studies.iter().for_each(|study| std::fs::create_dir_all(study).expect("folders"));
    for (place, index) in chosen.iter().enumerate() {
        export(&studies[place / 11], &format!("img{place:03}.dcm"), starts_s[*index], 271.3, place as u16);
    }
    // No pictures: read, they would be damaged ones.
    for path in [exported.join("DICOMDIR"), studies[1].join(".img.dcm")] {
        std::fs::write(path, [&[0; 128][..], b"DICM"].concat()).expect("written");
    }
    let out = folder.path().join("bindings.json");
    let (code, json, words) = attach(&log, &exported, &["--out", &out.display().to_string()]);
    assert_eq!(code, Some(0), "{words} {json:#}");
    let frames = json["frames"].as_array().expect("frames");
    assert_eq!((frames.len(), json["exposures"].as_u64()), (22, Some(EXPOSURES as u64)));
    for (frame, index) in frames.iter().zip(&chosen) {
        let exposure = &frame["binding"]["exposure"];
        assert_eq!(exposure["index"].as_u64(), Some(*index as u64), "{frame:#}");
        // Joints come from the exposure itself, though the track has long forgotten the samples.
        let lift_mm = exposure["joints"]["value"]["lift_mm"].as_f64().expect("joints are there");
        assert!((lift_mm - starts_s[*index] - 0.2).abs() < 0.1, "{lift_mm} {}", starts_s[*index]);
        // By the C-arm's own clock, to half the time between two samples, and that clock never jumps.
        assert_eq!(exposure["segment"], 0, "{frame:#}");
        for (end, at_s) in [starts_s[*index], starts_s[*index] + 0.4].into_iter().enumerate() {
            let off_us = exposure["device_us"][end].as_f64().expect("a time") - 1_000.0 - 1e6 * at_s;
            assert!(off_us.abs() < 21_000.0, "end {end} is {off_us} µs off: {frame:#}");
        }
    }
    let without = json["exposures_without_frame"].as_array().expect("a list");
    let label = |index: usize| Value::from(format!("exposure #{} of the session", index + 1));
    let has_none = |index: &usize| !chosen.contains(index);
    assert_eq!(*without, (0..EXPOSURES).filter(has_none).map(label).collect::<Vec<_>>());
    let offset_s = json["console"]["offset_us"].as_f64().expect("the clock is known") * 1e-6;
    assert!((offset_s - 271.3).abs() < 1.0, "{offset_s}");
    assert_eq!(serde_json::from_slice::<Value>(&std::fs::read(&out).expect("written")).expect("JSON"), json);
    assert_eq!(std::fs::read(&log).expect("the log"), before, "the log is not touched");
    // The control: three seconds' shift of one frame fits nothing and is left untied, with exit code 3.
    export(&exported, "img999.dcm", starts_s[0] + 3.0, 271.3, 999);
    let (code, json, _) = attach(&log, &exported, &[]);
    let last = json["frames"].as_array().and_then(|frames| frames.last()).expect("frames");
    assert_eq!((code, &last["binding"]["exposure"]), (Some(3), &Value::Null), "{last:#}");
}

#[test]
fn a_regular_rhythm_leaves_the_clock_unknown_and_nothing_is_guessed() {
    let folder = tempfile::tempdir().expect("folder");
    let starts_s: Vec<f64> = (0..EXPOSURES).map(|i| 10.0 + 20.0 * i as f64).collect();
    let log = log(folder.path(), &starts_s);
    let exported = folder.path().join("export");
    std::fs::create_dir(&exported).expect("folder");
    for (index, start_s) in starts_s.iter().enumerate().take(30).skip(8) {
        export(&exported, &format!("img{index:03}.dcm"), *start_s, 271.3, index as u16);
    }
    let (code, json, words) = attach(&log, &exported, &[]);
    assert_eq!(code, Some(3), "{words}");
    let tied = json["frames"].as_array().expect("frames").iter().filter(|frame| !frame["binding"]["exposure"].is_null()).count();
    assert_eq!((tied, &json["console"]), (0, &Value::Null), "{json:#}");
    let ran = Command::new(env!("CARGO_BIN_EXE_sidecarm")).arg("attach").arg(&log).arg(&exported).output().expect("it starts");
    let told = String::from_utf8_lossy(&ran.stdout).into_owned();
    assert!(told.contains("too few frames agree") && told.contains("name all frames of the session at once"), "{told}");
}

/// The zone of a console in India stood in its clock's error, which was so many seconds, less than none, behind the host's; and of a picture without
/// a header counter and arrival, of which it had none, did not agree.
#[test]
fn a_stated_zone_is_no_error_of_the_clock_and_a_picture_that_says_nothing_is_said_to() {
    let folder = tempfile::tempdir().expect("folder");
    let starts_s = irregular();
    let log = log(folder.path(), &starts_s);
    let exported = folder.path().join("export");
    std::fs::create_dir(&exported).expect("folder");
    // Five and a half hours and 22 s ahead: the time of the zone, written with it.
    for (index, start_s) in starts_s.iter().enumerate().take(20) {
        let name = format!("img{index:03}.dcm");
        export(&exported, &name, *start_s, -19_822.0, index as u16);
        let path = exported.join(name);
        let mut object = dicom_object::open_file(&path).expect("a DICOM file");
        object.put(DataElement::new(tags::TIMEZONE_OFFSET_FROM_UTC, VR::SH, PrimitiveValue::from("+0530")));
        object.write_to_file(&path).expect("written");
    }
    image::GrayImage::from_fn(40, 30, |x, y| image::Luma([(7 * x + 3 * y) as u8]))
        .save(exported.join("shot.png"))
        .expect("written");
    let ran = Command::new(env!("CARGO_BIN_EXE_sidecarm")).arg("attach").arg(&log).arg(&exported).output().expect("it starts");
    let told = String::from_utf8_lossy(&ran.stdout).into_owned();
    let clock = told.lines().find(|line| line.starts_with("console clock: ")).unwrap_or_default();
    assert!(clock.contains("s ahead of the host's in its zone, UTC+05:30, from "), "{told}");
    let ahead_s: f64 = clock["console clock: ".len()..].split(' ').next().and_then(|s| s.parse().ok()).expect("seconds");
    assert!((ahead_s - 22.0).abs() < 1.0, "{told}");
    let rows = told.lines().filter(|line| line.contains("(its clock is "));
    assert!(rows.clone().count() > 0 && rows.clone().all(|row| row.contains(" in its zone, UTC+05:30, from ")), "{told}");
    assert_eq!(told.matches("no time and no counter in this picture: nothing ties it").count(), 1, "{told}");
    let (_, json, _) = attach(&log, &exported, &[]);
    assert_eq!(json["console_zone_min"], 330, "{json:#}");
}

/// Puts the file into this study.
fn put_into(path: &Path, study: &str) {
    let mut object = dicom_object::open_file(path).expect("a DICOM file");
    object.put(DataElement::new(tags::STUDY_INSTANCE_UID, VR::UI, PrimitiveValue::from(study)));
    object.write_to_file(path).expect("written");
}

/// Three pictures of another room in the folder ended with "finished with loss", though nothing of the session was lost.
#[test]
fn frames_of_another_study_are_no_loss_where_each_exposure_has_its_frame() {
    let folder = tempfile::tempdir().expect("folder");
    let starts_s = irregular();
    let log = log(folder.path(), &starts_s);
    let exported = folder.path().join("export");
    std::fs::create_dir(&exported).expect("folder");
    for (index, start_s) in starts_s.iter().enumerate() {
        let name = format!("img{index:03}.dcm");
        export(&exported, &name, *start_s, 271.3, index as u16);
        put_into(&exported.join(name), "2.25.71");
    }
    for (nth, start_s) in starts_s.iter().enumerate().take(3) {
        let name = format!("other{nth}.dcm");
        export(&exported, &name, *start_s, 5_000.0, 500 + nth as u16);
        put_into(&exported.join(name), "2.25.72");
    }
    let (code, json, words) = attach(&log, &exported, &[]);
    let tied = |json: &Value| {
        let frames = json["frames"].as_array().expect("frames").iter();
        frames.filter(|frame| !frame["binding"]["exposure"].is_null()).count()
    };
    assert_eq!((code, tied(&json), &json["of_another_study"]), (Some(0), EXPOSURES, &Value::from(3)), "{words} {json:#}");
    let ran = Command::new(env!("CARGO_BIN_EXE_sidecarm")).arg("attach").arg(&log).arg(&exported).output().expect("it starts");
    let told = String::from_utf8_lossy(&ran.stdout).into_owned();
    assert!(told.contains("40 of 43 frames tied\n3 frames of another study"), "{told}");
    // The controls: of the session's own study they are lost, and where an exposure has no frame they may be of that one.
    for nth in 0..3 {
        put_into(&exported.join(format!("other{nth}.dcm")), "2.25.71");
    }
    let (code, json, words) = attach(&log, &exported, &[]);
    assert_eq!((code, tied(&json), &json["of_another_study"]), (Some(3), EXPOSURES, &Value::from(0)), "{words} {json:#}");
    for nth in 0..3 {
        put_into(&exported.join(format!("other{nth}.dcm")), "2.25.72");
    }
    std::fs::remove_file(exported.join("img020.dcm")).expect("removed");
    let (code, json, words) = attach(&log, &exported, &[]);
    assert_eq!((code, tied(&json), &json["of_another_study"]), (Some(3), EXPOSURES - 1, &Value::from(0)), "{words} {json:#}");
}

/// Where the console keeps the time, six exposures in an even rhythm and their six frames leave one reading; a frame less, and there are two.
#[test]
fn a_console_that_keeps_the_time_is_believed_where_first_and_last_exposure_have_their_frames() {
    let folder = tempfile::tempdir().expect("folder");
    let starts_s: Vec<f64> = (0..6).map(|i| 10.0 + 2.2 * f64::from(i)).collect();
    let log = log(folder.path(), &starts_s);
    let exported = folder.path().join("export");
    std::fs::create_dir(&exported).expect("folder");
    for (index, start_s) in starts_s.iter().enumerate() {
        export(&exported, &format!("img{:03}.dcm", 9 - index), *start_s, 0.0, index as u16);
    }
    let indices = |json: &Value| -> Vec<Option<u64>> {
        let frames = json["frames"].as_array().expect("frames").iter();
        frames.map(|frame| frame["binding"]["exposure"]["index"].as_u64()).collect()
    };
    let (code, json, words) = attach(&log, &exported, &[]);
    let tied: Vec<Option<u64>> = (0..6).rev().map(Some).collect();
    assert!(code == Some(0) && indices(&json) == tied, "{words} {json:#}");
    assert!(!words.contains("another study"), "{words}");
    std::fs::remove_file(exported.join("img004.dcm")).expect("removed");
    let (code, json, words) = attach(&log, &exported, &[]);
    assert!(code == Some(3) && indices(&json) == [None; 5], "{words} {json:#}");
}

#[test]
fn what_is_no_log_and_what_would_overwrite_an_input_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let log = log(folder.path(), &irregular());
    let exported = folder.path().join("export");
    std::fs::create_dir(&exported).expect("folder");
    export(&exported, "img001.dcm", 10.0, 0.0, 1);
    let (code, _, words) = attach(&log, &exported, &["--out", &log.display().to_string()]);
    assert!(code == Some(1) && words.contains("--out"), "{words}");
    let (code, _, words) = attach(&exported.join("img001.dcm"), &exported, &[]);
    assert!(code == Some(1) && words.contains("MCAP"), "{words}");
}

/// Of two sessions in one log, both count their exposures from 1.
#[test]
fn a_log_that_was_joined_of_several_is_refused_with_a_sentence() {
    let folder = tempfile::tempdir().expect("folder");
    let exported = folder.path().join("export");
    std::fs::create_dir(&exported).expect("folder");
    export(&exported, "img.dcm", 3.0, 0.0, 1);
    let joined = |name: &str, topic: &str| {
        let path = folder.path().join(name);
        let recorder = Recorder::create(&path, &Provenance::of_this_program(T0_US, Value::Null)).expect("a log");
        for session in 0..2 {
            let t0_us = T0_US + session * 60_000_000;
            if session == 1 {
                recorder.json(topic, t0_us, &serde_json::json!({"numbers_from": 0})).expect("recorded");
            }
            for number in 0..250 {
                let at_us = i64::from(number) * 40_000;
                let on = (75..85).contains(&number);
                let packet = carm(number, 1_000 + at_us as u64, [0.0, 0.0, 0.0, 0.0, 9.0, 0.0, 1020.0], on, None);
                recorder.raw_bytes("carm", 1, t0_us + at_us + 800, &packet).expect("recorded");
            }
        }
        recorder.finish().expect("finished");
        path
    };
    let (code, json, words) = attach(&joined("day.mcap", "/session/restart"), &exported, &[]);
    assert_eq!((code, &json), (Some(1), &Value::Null), "{words}");
    assert!(words.contains("joined of several logs") && words.contains("each of those logs by itself"), "{words}");
    assert_eq!(words.lines().count(), 1, "{words}");
    // The control: the same bytes without a seam are one session.
    let (code, json, words) = attach(&joined("one.mcap", "/session/note"), &exported, &[]);
    assert!(matches!(code, Some(0 | 3)) && json["exposures"] == 2, "{words} {json:#}");
}

//! What a session beside the mocked laboratory is held against: when its exposures were, and where arm and robot stood in them.
#![cfg(unix)]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use chrono::NaiveDateTime;
use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use dicom_object::DefaultDicomObject;
use serde_json::Value;
use sidecarm::record::{read_log, topic};

use crate::live_lab::{HANG_S, Lab, Live, eventually};

/// Beginnings of exposures are found to half a sample of the C-arm, and clocks to some milliseconds on a crowded machine.
pub const TIME_US: i64 = 60_000;
/// Five standard deviations of the encoders, and what the arm still moves before an exposure.
const JOINTS: [(&str, f64); 3] = [("orbital_deg", 0.4), ("angulation_deg", 0.4), ("lift_mm", 1.6)];

/// What is scripted of the `counter`th exposure, from 1.
pub fn scripted(counter: u32) -> Value {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/mocks/data/lab.json");
    let lab: Value = serde_json::from_slice(&std::fs::read(path).expect("the lab's data")).expect("JSON");
    lab["exposures"][counter as usize - 1].clone()
}

/// The mock's own number of a frame, by which its file is called.
pub fn counter_of(name: &str) -> u32 {
    name.trim_start_matches("frame-").trim_end_matches(".dcm").parse().expect("frames are called by their exposure")
}

fn text(object: &DefaultDicomObject, tag: Tag) -> String {
    object.element(tag).expect("there").to_str().expect("text").trim().to_owned()
}

/// When X-ray went on, host time: the mock's console keeps the host's time.
pub fn began_us(file: &Path) -> i64 {
    let object = dicom_object::open_file(file).expect("a frame");
    let stamp = text(&object, tags::ACQUISITION_DATE) + &text(&object, tags::ACQUISITION_TIME);
    NaiveDateTime::parse_from_str(&stamp, "%Y%m%d%H%M%S%.f").expect("a stamp").and_utc().timestamp_micros()
}

pub fn put(object: &mut DefaultDicomObject, tag: Tag, vr: VR, value: &str) {
    object.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
}

/// A file that is written to its end.
fn whole(file: &Path) -> Option<DefaultDicomObject> {
    let object = dicom_object::open_file(file).ok()?;
    let size = |tag| object.element(tag).ok()?.to_int::<usize>().ok();
    let bytes = object.element(tags::PIXEL_DATA).ok()?.to_bytes().ok()?.len();
    (bytes == 2 * size(tags::ROWS)? * size(tags::COLUMNS)?).then_some(object)
}

/// Hands the lab's frames on into `folder`, each as soon as it is whole and as `write` writes it, until there were `count`.
pub fn hand_on(lab: &Lab, folder: &Path, count: usize, mut write: impl FnMut(u32, DefaultDicomObject, &Path)) {
    let mut seen = BTreeSet::new();
    let all = eventually(HANG_S, || {
        for entry in std::fs::read_dir(lab.frames()).expect("frames").flatten() {
            let name = entry.file_name().into_string().expect("UTF-8");
            if !name.ends_with(".dcm") || seen.contains(&name) {
                continue;
            }
            let Some(object) = whole(&entry.path()) else { continue };
            let to = folder.join(&name);
            write(counter_of(&name), object, &to.with_extension("part"));
            std::fs::rename(to.with_extension("part"), to).expect("renamed");
            seen.insert(name);
        }
        (seen.len() == count).then_some(())
    });
    assert!(all.is_some(), "{} of {count} frames", seen.len());
}

/// The rows of `pairs.json`.
pub fn pairs(live: &Live) -> Vec<Value> {
    let bytes = std::fs::read(live.out.join("pairs.json")).expect("pairs.json");
    let value: Value = serde_json::from_slice(&bytes).expect("JSON");
    value["pairs"].as_array().cloned().unwrap_or_default()
}

/// The last pose that the log has of each frame, in their order.
pub fn poses(live: &Live) -> Vec<Value> {
    let log = read_log(&live.log).expect("the log opens");
    let of = log.entries.iter().filter(|entry| &*entry.topic == topic::POSE).map(|entry| entry.json::<Value>().expect("JSON"));
    let last: std::collections::BTreeMap<u64, Value> =
        of.map(|pose| (pose["number"].as_u64().expect("a number"), pose)).collect();
    last.into_values().collect()
}

/// The pairs in order, each with its pose in the log and the mock's own number of the exposure.
pub fn told_frames(live: &Live) -> Vec<(Value, Value, u32)> {
    let poses = poses(live);
    let told = |pair: Value| {
        let pose = poses.iter().find(|pose| pose["number"] == pair["number"]).cloned();
        let counter = counter_of(pair["frame"].as_str().expect("a name"));
        (pair, pose.unwrap_or_else(|| panic!("no pose of frame {counter}: {}", live.stderr())), counter)
    };
    pairs(live).into_iter().map(told).collect()
}

/// A frame as the mock wrote it.
pub fn file_of(lab: &Lab, counter: u32) -> PathBuf {
    lab.frames().join(format!("frame-{counter:03}.dcm"))
}

/// Waits until there are `count` pairs.
pub fn wait_for_pairs(live: &Live, count: usize) {
    let all = eventually(HANG_S, || (live.pairs() >= count).then_some(()));
    assert!(all.is_some(), "{} of {count} pairs: {}", live.pairs(), live.stderr());
}

/// That a frame is bound to its own exposure of 0.3 s, at its own time, with the joints at which the arm stood in it.
pub fn has_its_own_exposure(lab: &Lab, pose: &Value, counter: u32) {
    is_of_exposure(&file_of(lab, counter), pose, counter);
}

/// The same of a frame that the mock keeps as `file`.
pub fn is_of_exposure(file: &Path, pose: &Value, counter: u32) {
    let binding = &pose["binding"];
    let exposure = &binding["exposure"];
    assert_eq!(exposure["counter"], counter, "frame of exposure {counter}: {binding:#}");
    let off_us = binding["time_us"].as_i64().expect("a time") - began_us(file) - 150_000;
    assert!(off_us.abs() < TIME_US, "exposure {counter}: {off_us} µs off");
    let told = scripted(counter);
    for (joint, near) in JOINTS {
        let (found, expected) = (exposure["joints"]["value"][joint].as_f64(), told[joint].as_f64().expect("scripted"));
        let near = found.is_some_and(|found| (found - expected).abs() < near);
        assert!(near, "exposure {counter}: {joint} is {found:?}, the arm stood at {expected}: {exposure:#}");
    }
}

/// That the arm's joints were used as a prior, and the right ones: what telemetry and beads say differs by no more than the specimen lies
/// off, which nobody measured.
pub fn prior_is_right(pair: &Value) {
    let shift = pair["innovation"]["shift_mm"].as_array().unwrap_or_else(|| panic!("no prior by telemetry: {pair:#}"));
    let mm = shift.iter().filter_map(Value::as_f64).map(|mm| mm * mm).sum::<f64>().sqrt();
    assert!(shift.len() == 3 && mm < 12.0 && pair["innovation"]["turn_deg"].as_f64().is_some_and(|deg| deg < 2.0), "{pair:#}");
}

/// That the robot is drawn with the angles that it had.
pub fn robot_is_right(pose: &Value, counter: u32) {
    let (found, expected) = (&pose["control_angles_deg"], scripted(counter));
    for point in 0..5 {
        let off = found[point].as_f64().zip(expected["control_deg"][point].as_f64()).map(|(found, told)| found - told);
        assert!(off.is_some_and(|off| off.abs() < 0.2), "exposure {counter}: {found} instead of {}", expected["control_deg"]);
    }
}

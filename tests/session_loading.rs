//! A session whose scene takes its time to load, through `live`: what devices say and the console delivers meanwhile is the session's.
#![cfg(unix)]

use std::path::Path;
use std::time::UNIX_EPOCH;

use serde_json::{Value, json};
use sidecarm::record::{read_log, topic};

use crate::lab_truth::{has_its_own_exposure, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};

/// A CT of nothing but air: it takes its time to load and changes no picture. The file has holes for its voxels.
fn air(path: &Path, side: u16) {
    let mut header = vec![0u8; 352];
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    let dim = [3, side, side, side, 1, 1, 1, 1];
    for (axis, size) in dim.into_iter().enumerate() {
        put(40 + 2 * axis, &size.to_le_bytes());
    }
    put(70, &4i16.to_le_bytes());
    put(72, &16i16.to_le_bytes());
    for axis in 0..4 {
        put(76 + 4 * axis, &1f32.to_le_bytes());
    }
    put(108, &352f32.to_le_bytes());
    // Stored zeros are -1000 HU.
    put(112, &1f32.to_le_bytes());
    put(116, &(-1000f32).to_le_bytes());
    put(123, &[2]);
    put(254, &1i16.to_le_bytes());
    for (row, at) in [280, 296, 312].into_iter().enumerate() {
        put(at + 4 * row, &1f32.to_le_bytes());
        put(at + 12, &(-f32::from(side) / 2.0).to_le_bytes());
    }
    put(344, b"n+1\0");
    std::fs::write(path, header).expect("written");
    let file = std::fs::OpenOptions::new().write(true).open(path).expect("there");
    file.set_len(352 + 2 * u64::from(side).pow(3)).expect("a file with holes");
}

#[test]
fn what_comes_while_the_scene_is_loaded_is_recorded() {
    let Some(lab) =
        Lab::start(&["--duration-s", "12", "--faults", "none", "--await-all", "--start-delay-s", "0", "--idle-s", "300"])
    else {
        return;
    };
    air(&lab.kit.join("air.nii"), 400);
    let scene = lab.kit.join("scene.json");
    let mut value: Value = serde_json::from_slice(&std::fs::read(&scene).expect("the scene")).expect("JSON");
    value["objects"].as_array_mut().expect("objects").insert(0, json!({"ct": {"path": "air.nii", "materials": "threshold"}}));
    std::fs::write(&scene, value.to_string()).expect("written");

    let mut live = Live::start(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
    wait_for_pairs(&live, 8);
    live.signalled(Signal::INT);
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();
    assert_eq!(code, Some(0), "{} {}", live.stdout(), live.stderr());

    // The session's folders are made once the scene is there.
    let made = std::fs::metadata(live.out.join("drr")).and_then(|made| made.created()).expect("a file system that tells");
    let loaded_us = made.duration_since(UNIX_EPOCH).expect("after 1970").as_micros() as i64;
    let log = read_log(&live.log).expect("the log opens");
    let mut heard_us = 0;
    for line in [topic::CARM_RAW, topic::ROBOT_RAW] {
        // The mock sends once its ports are open, which is a moment before they are set up and emptied.
        let first = log.entries.iter().find(|entry| &*entry.topic == line).expect("reads");
        heard_us = heard_us.max(first.host_us + 100_000);
        let before = log.entries.iter().filter(|entry| &*entry.topic == line && entry.host_us < loaded_us).count();
        assert!(before > 20, "{line}: {before} reads before the scene was there");
    }
    let heard = live.heard();
    let missing = heard.missing(&lab.sent(), heard_us, heard.end_us.expect("an end") - 1_000_000);
    assert!(missing.sent > 1000 && missing.lost == 0, "{missing:?}");
    for (_, pose, counter) in told_frames(&live) {
        has_its_own_exposure(&lab, &pose, counter);
    }
}

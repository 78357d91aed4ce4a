//! What arrives in the folder of a live session: bad files, rewritten names, files that are gone at once. Through the program itself.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::{Value, json};

use crate::acquire_frames::{fluoroscopy, save};

/// A session without devices: a water ball, no beads, frames from `frames`.
pub struct Room {
    pub folder: tempfile::TempDir,
    pub frames: PathBuf,
}

/// How a session ended and what it wrote.
pub struct Ended {
    pub code: Option<i32>,
    pub stdout: Vec<u8>,
    pub stderr: Vec<u8>,
    pub pairs: Vec<Value>,
}

impl Room {
    /// A room whose frames come in `frames`, a path below the room's folder.
    pub fn new(frames: &str) -> Self {
        let folder = tempfile::tempdir().expect("folder");
        let frames = folder.path().join(frames);
        std::fs::create_dir_all(&frames).expect("folder");
        let scene = json!({
            "objects": [{"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 20, "material": "water"}}],
            "beam": {"tube_kvp": 80, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
            "detector": {"response": "energy", "pitch_mm": 2.0}
        });
        std::fs::write(folder.path().join("scene.json"), scene.to_string()).expect("written");
        let session = json!({"frames": {"folder": frames}, "scene": "scene.json"});
        std::fs::write(folder.path().join("session.json"), session.to_string()).expect("written");
        Self { folder, frames }
    }

    pub fn out(&self) -> PathBuf {
        self.folder.path().join("out")
    }

    /// Starts the session and waits until it records.
    pub fn start(&self, seconds: f64) -> Child {
        let child = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
            .args(["live", "session.json", "--headless", "--include-existing", "--out", "out"])
            .args(["--seconds", &seconds.to_string()])
            .current_dir(self.folder.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program starts");
        for _ in 0..600 {
            if self.out().join("session.mcap").exists() {
                break;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        child
    }

    /// Waits for the end of the session.
    pub fn end(&self, child: Child) -> Ended {
        let output = child.wait_with_output().expect("the session ends");
        let text = std::fs::read_to_string(self.out().join("pairs.json")).unwrap_or_else(|_| "{}".into());
        let pairs: Value = serde_json::from_str(&text).expect("JSON");
        let pairs = pairs["pairs"].as_array().cloned().unwrap_or_default();
        Ended { code: output.status.code(), stdout: output.stdout, stderr: output.stderr, pairs }
    }
}

/// Bytes of a small frame whose pixels start with `first`.
pub fn frame_bytes(first: u16) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("folder");
    let mut object = fluoroscopy();
    for (tag, value) in [(tags::ROWS, 48u16), (tags::COLUMNS, 64)] {
        object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
    }
    let values: Vec<u16> = (0..64 * 48).map(|index| first + index % 1000).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    std::fs::read(save(object, &folder.path().join("x.dcm"))).expect("bytes")
}

/// What the log says in words.
fn events(log: &sidecarm::record::LogContents) -> impl Iterator<Item = String> + '_ {
    let told = log.entries.iter().filter(|entry| &*entry.topic == sidecarm::record::topic::EVENTS);
    told.map(|entry| String::from_utf8_lossy(&entry.data).into_owned())
}

fn labels(pairs: &[Value]) -> Vec<String> {
    pairs.iter().map(|pair| pair["frame"].as_str().unwrap_or("?").to_owned()).collect()
}

/// One damaged frame ended `live`, and a bomb was read again at every poll.
#[cfg(unix)]
#[test]
fn a_session_goes_on_past_every_bad_file_and_says_each_once() {
    let room = Room::new("frames");
    let put = |name: &str, bytes: &[u8]| std::fs::write(room.frames.join(name), bytes).expect("written");
    put("frame-001.dcm", &frame_bytes(10));
    put("bad-1.dcm", b"this is no image");
    put("bad-2.png", &crate::acquire_foreign::png_of_size(60_000, 60_000));
    put("bad-3.dcm", &crate::acquire_foreign::dicom_ending_in(room.folder.path(), None, &crate::acquire_foreign::nested(20_000)));
    put("bad-4.tif", &crate::acquire_foreign::tiff_pages(100, 4000, 4000, 4));
    assert!(Command::new("mkfifo").arg(room.frames.join("bad-5.dcm")).status().expect("mkfifo").success());
    std::os::unix::fs::symlink("/dev/zero", room.frames.join("bad-6.dcm")).expect("link");
    let mut bad = 6;
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/bad-files");
    match std::fs::read_dir(&shared) {
        Ok(list) => {
            for entry in list.flatten().filter(|entry| entry.path().extension().is_some_and(|ending| ending != "mcap")) {
                bad += 1;
                std::fs::copy(entry.path(), room.frames.join(format!("bad-{bad}.dcm"))).expect("copied");
            }
        }
        Err(_) => println!("skipped: {} is absent", shared.display()),
    }
    let child = room.start(14.0);
    std::thread::sleep(Duration::from_secs(5));
    put("frame-002.dcm", &frame_bytes(20));
    let ended = room.end(child);
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert!(matches!(ended.code, Some(0 | 3)), "{:?}: {stderr}", ended.code);
    assert_eq!(labels(&ended.pairs), ["frame-001", "frame-002"], "{stderr}");
    for word in ["panicked", "overflowed", "memory allocation"] {
        assert!(!stderr.contains(word), "{stderr}");
    }
    // Every bad file stands in the log, once.
    let log = sidecarm::record::read_log(&room.out().join("session.mcap")).expect("a log");
    let mut said = 0;
    for number in 1..=bad {
        let needle = format!("bad-{number}: ");
        let times = events(&log).filter(|words| words.contains(&needle)).count();
        assert!(times <= 1, "{needle} {times} times");
        said += times;
    }
    // What may be a copy that is not finished is said after ten seconds.
    assert!(said >= 5, "{said} of {bad} were said");
    println!("{said} of {bad} bad files said within the session");
}

/// `latest.dcm` rewritten three times: two frames lost, no word. Files deleted within 300 ms: 23 of 30 gone without an event.
#[test]
fn rewritten_and_deleted_files_become_frames_or_are_said() {
    let room = Room::new("frames");
    let child = room.start(12.0);
    std::thread::sleep(Duration::from_millis(1500));
    for version in 0..3u16 {
        std::fs::write(room.frames.join("latest.dcm"), frame_bytes(100 + version)).expect("written");
        std::thread::sleep(Duration::from_millis(1500));
    }
    for index in 0..10u16 {
        let path = room.frames.join(format!("frame-{index:03}.dcm"));
        std::fs::write(&path, frame_bytes(200 + index)).expect("written");
        std::thread::sleep(Duration::from_millis(60));
        std::fs::remove_file(path).expect("deleted");
    }
    let ended = room.end(child);
    let stderr = String::from_utf8_lossy(&ended.stderr);
    let found = labels(&ended.pairs);
    let latest = found.iter().filter(|label| *label == "latest").count();
    let deleted = found.iter().filter(|label| label.starts_with("frame-")).count();
    let log = sidecarm::record::read_log(&room.out().join("session.mcap")).expect("a log");
    let said = |words: &str| events(&log).filter(|said| said.contains(words)).count();
    let (vanished, overwritten) = (said("was deleted before"), said("was overwritten before"));
    println!("latest: {latest} of 3, {overwritten} said; deleted: {deleted} of 10 read, {vanished} said");
    assert_eq!(latest + overwritten, 3, "{stderr}");
    assert_eq!(deleted + vanished, 10, "{stderr}");
    assert!(latest >= 2 && deleted >= 5, "{found:?}");
}

/// The program answers quickly where a file is not there, a folder, or not readable as text.
#[test]
fn a_volume_that_is_a_bomb_does_not_start_a_session() {
    let room = Room::new("frames");
    let mut huge = crate::scene_support::NiftiFile::int16([4, 4, 4], &[0; 64]);
    huge.dim = [3, 1290, 1290, 1290, 1, 1, 1, 1];
    huge.write(&room.folder.path().join("ct.nii.gz"));
    let scene = std::fs::read_to_string(room.folder.path().join("scene.json")).expect("scene");
    let mut scene: Value = serde_json::from_str(&scene).expect("JSON");
    scene["objects"] = json!([{"ct": {"path": "ct.nii.gz"}}]);
    std::fs::write(room.folder.path().join("scene.json"), scene.to_string()).expect("written");
    let output = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .args(["live", "session.json", "--headless", "--seconds", "2", "--out", "out"])
        .current_dir(room.folder.path())
        .output()
        .expect("the program starts");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("1290 x 1290 x 1290 voxels") && !stderr.contains("panicked"), "{stderr}");
}

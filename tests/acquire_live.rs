//! What arrives in the folder of a live session: bad files, rewritten names, files that are gone at once. Through the program itself.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::{Value, json};
#[cfg(unix)]
use sidecarm::time::{Stopwatch, host_now_us};

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

/// How long a good frame among bad files may take to come into the log, and the whole session: a bomb took 40 s, again and again.
#[cfg(unix)]
const GOOD_FRAME_S: f64 = 10.0;
#[cfg(unix)]
const SESSION_S: f64 = 60.0;

/// A zlib stream of a kilobyte for every mebibyte of `fill` that comes out of it; its checksum is wrong.
#[cfg(unix)]
fn bomb(fill: u8, mebibytes: usize) -> Vec<u8> {
    let mut block = Vec::with_capacity(1 << 16);
    let mut packer = flate2::Compress::new(flate2::Compression::best(), false);
    packer.compress_vec(&vec![fill; 1 << 20], &mut block, flate2::FlushCompress::Full).expect("packed");
    assert!(packer.total_in() == 1 << 20 && block.len() < 1 << 14, "a mebibyte in {} bytes", block.len());
    // After a full flush a block stands for itself, wherever it is.
    [&[0x78_u8, 0xda][..], &block.repeat(mebibytes), &[3, 0], &[0; 4]].concat()
}

/// A PNG of 64 x 48 grey pixels, whose colour profile inflates to 128 MiB and whose pixels to 1 GiB. Those begin with a filter that no PNG
/// has: whoever stops at the 3 kB that are declared refuses it as well.
#[cfg(unix)]
fn png_bomb() -> Vec<u8> {
    let mut bytes = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut chunk = |kind: &[u8], content: &[u8]| {
        let summed = [kind, content].concat();
        bytes.extend((content.len() as u32).to_be_bytes());
        bytes.extend(&summed);
        bytes.extend(crc32fast::hash(&summed).to_be_bytes());
    };
    chunk(b"IHDR", &[0, 0, 0, 64, 0, 0, 0, 48, 8, 0, 0, 0, 0]);
    chunk(b"iCCP", &[&b"profile\0\0"[..], &bomb(0, 128)].concat());
    chunk(b"IDAT", &bomb(0xff, 1024));
    chunk(b"IEND", &[]);
    bytes
}

/// A TIFF of two pages of 64 x 48 grey pixels. The first inflates to 1 GiB; the second is no compressed stream: whoever stops at what the
/// first declares comes to it and refuses the file.
#[cfg(unix)]
fn tiff_bomb() -> Vec<u8> {
    use crate::acquire_foreign::tiff_directory;
    let packed = bomb(0, 1024);
    let page = |strip_at: u32, strip_bytes: u32| -> [(u16, u16, u32); 8] {
        [
            (256, 4, 64),
            (257, 4, 48),
            (258, 3, 8),
            // Deflate.
            (259, 3, 8),
            (262, 3, 1),
            (273, 4, strip_at),
            (278, 4, 48),
            (279, 4, strip_bytes),
        ]
    };
    let first = page(8, packed.len() as u32);
    let mut bytes = b"II*\0".to_vec();
    bytes.extend((8 + packed.len() as u32).to_le_bytes());
    bytes.extend(packed);
    let second_at = bytes.len() + tiff_directory(&first, 0).len();
    bytes.extend(tiff_directory(&first, second_at as u32));
    // The file's own first bytes.
    bytes.extend(tiff_directory(&page(2, 6), 0));
    bytes
}

/// Counts how often each file of a folder is opened, as the system tells.
#[cfg(target_os = "linux")]
struct Opened(std::os::fd::OwnedFd);

#[cfg(target_os = "linux")]
impl Opened {
    fn watch(folder: &Path) -> Self {
        use rustix::fs::inotify::{CreateFlags, WatchFlags, add_watch, init};
        let inotify = init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).expect("the system tells");
        add_watch(&inotify, folder, WatchFlags::OPEN).expect("the system tells of this folder");
        Self(inotify)
    }

    /// Up to now, by name.
    fn counts(self) -> std::collections::BTreeMap<String, usize> {
        use rustix::fs::inotify::{ReadFlags, Reader};
        let mut buffer = [std::mem::MaybeUninit::uninit(); 1 << 14];
        let mut reader = Reader::new(&self.0, &mut buffer);
        let mut counts = std::collections::BTreeMap::new();
        while let Ok(event) = reader.next() {
            assert!(!event.events().contains(ReadFlags::QUEUE_OVERFLOW), "more was opened than the system counts");
            let name = event.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
            *counts.entry(name).or_default() += 1;
        }
        counts
    }
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
    put("bad-7.png", &png_bomb());
    put("bad-8.tif", &tiff_bomb());
    let mut bad = 8;
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
    #[cfg(target_os = "linux")]
    let opened = Opened::watch(&room.frames);
    let watch = Stopwatch::start();
    let child = room.start(14.0);
    // One frame comes while the bad files are being read, one when they have been.
    std::thread::sleep(Duration::from_millis(500));
    let put_us = host_now_us();
    put("frame-002.dcm", &frame_bytes(20));
    std::thread::sleep(Duration::from_millis(4500));
    put("frame-003.dcm", &frame_bytes(30));
    let ended = room.end(child);
    let took_s = watch.ms() * 1e-3;
    let (stdout, stderr) = (String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
    assert_eq!(ended.code, Some(3), "what is not read is a loss: {stdout} {stderr}");
    assert_eq!(labels(&ended.pairs), ["frame-001", "frame-002", "frame-003"], "{stderr}");
    for word in ["panicked", "overflowed", "memory allocation"] {
        assert!(!stderr.contains(word), "{stderr}");
    }
    let log = sidecarm::record::read_log(&room.out().join("session.mcap")).expect("a log");
    let came_s = (came_us(&log, "frame-002").expect("it is in the log") - put_us) as f64 * 1e-6;
    println!("{bad} bad files; a good one among them is in the log after {came_s:.1} s; {took_s:.0} s in all");
    assert!(came_s <= GOOD_FRAME_S, "a good frame waits {came_s:.1} s for bad ones, {GOOD_FRAME_S} allowed: {stderr}");
    assert!(took_s <= SESSION_S, "{took_s:.0} s for a session of 14 s, {SESSION_S} allowed: {stderr}");

    // Every bad file stands in the log, once, and is a loss, once: what may be a copy that is not finished, after ten seconds. Of each kind
    // the first three are printed, and all are counted.
    for number in 1..=bad {
        let needle = format!("bad-{number}: ");
        let in_log = events(&log).filter(|words| words.contains(&needle)).count();
        let lost = stdout.lines().filter(|line| line.starts_with("lost: ") && line.contains(&needle)).count();
        let printed = stderr.lines().filter(|line| line.contains(&needle)).count();
        assert_eq!((in_log, lost), (1, 1), "{needle} in the log and among the losses: {stdout} {stderr}");
        assert!(printed <= 1, "{needle} is printed {printed} times: {stderr}");
    }
    let counted = |kind: &str| -> usize {
        let of_kind = format!(" x {kind}: ");
        let count = stdout.lines().find_map(|line| line.split_once(&of_kind)?.0.parse().ok());
        count.unwrap_or_default()
    };
    let counts = ["unreadable frame", "unfinished frame", "not a file"].map(counted);
    assert_eq!(counts.iter().sum::<usize>(), bad, "{counts:?}: {stdout}");
    #[cfg(target_os = "linux")]
    {
        // None again at every look, and neither the pipe nor the device at all.
        let mut counts = opened.counts();
        counts.retain(|name, _| name.starts_with("bad-"));
        assert_eq!(counts.len(), bad - 2, "{counts:?}");
        assert!(counts.values().all(|count| *count == 1), "{counts:?}");
    }
}

/// When a frame came into the log, by the session's own clock.
#[cfg(unix)]
fn came_us(log: &sidecarm::record::LogContents, label: &str) -> Option<i64> {
    use sidecarm::record::{LogEntry, topic};
    let is_it =
        |entry: &LogEntry| *entry.topic == *topic::FRAME_TAGS && entry.json::<Value>().is_ok_and(|tags| tags["name"] == label);
    let at = log.entries.iter().position(is_it)?;
    log.entries[..at].iter().rev().find(|entry| &*entry.topic == "/session/clock").map(|tick| tick.host_us)
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

//! What is fuzzed: every reader of foreign bytes, one function each. They may refuse; they must not panic, hang or take memory without
//! bound. The project's tests run the same functions on the corpus and on seeded mutations of it (`tests/fuzz_smoke.rs`).

use std::path::Path;

use sidecarm::acquire::read_frames;
use sidecarm::beads::{parse_markups, read_landmarks};
use sidecarm::pose::{Pose, Prior};
use sidecarm::record::{FrameAssembler, LogReader, Tolerance};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{load, read_volume};
use sidecarm::telemetry::{Decoder, DeviceKind, Link};

/// Serial bytes: first as they are, then in openings and at times that the bytes themselves choose.
pub fn decoder(data: &[u8]) {
    for device in DeviceKind::ALL {
        let mut whole = Decoder::new(device);
        let mut events = 0u64;
        whole.push(data, &mut |_| events += 1);
        let mut split = Decoder::new(device);
        let mut events_split = 0u64;
        data.chunks(7).for_each(|part| split.push(part, &mut |_| events_split += 1));
        assert_eq!((events, whole.health()), (events_split, split.health()), "how bytes are split makes no difference");
        let mut link = Link::new(device);
        for part in data.chunks(97) {
            let host_us = part.iter().fold(0i64, |sum, byte| sum.wrapping_mul(131).wrapping_add(i64::from(*byte)));
            link.feed(host_us, u32::from(part[0]), part, &mut |_| {});
        }
    }
}

/// Writes `data` into a file of its own and hands over its path.
fn as_file(data: &[u8], suffix: &str, read: impl FnOnce(&Path)) {
    let folder = if Path::new("/dev/shm").is_dir() { Path::new("/dev/shm") } else { Path::new(".") };
    let file = tempfile::Builder::new().suffix(suffix).tempfile_in(folder).expect("a temporary file");
    std::fs::write(file.path(), data).expect("written");
    read(file.path());
}

/// A volume. The first byte says whether it is compressed.
pub fn nifti(data: &[u8]) {
    let suffix = if data.starts_with(&[0x1f, 0x8b]) { ".nii.gz" } else { ".nii" };
    as_file(data, suffix, |path| drop(read_volume(path, &Reporter::silent())));
}

/// A volume with a header of text and its voxels after it.
pub fn nrrd(data: &[u8]) {
    as_file(data, ".nrrd", |path| drop(read_volume(path, &Reporter::silent())));
}

/// A volume with a header of text and its voxels after it.
pub fn metaimage(data: &[u8]) {
    as_file(data, ".mha", |path| drop(read_volume(path, &Reporter::silent())));
}

/// A folder of DICOM slices. The bytes hold the files one after the other, each beginning with its preamble.
pub fn slices(data: &[u8]) {
    let parent = if Path::new("/dev/shm").is_dir() { Path::new("/dev/shm") } else { Path::new(".") };
    let folder = tempfile::Builder::new().tempdir_in(parent).expect("a temporary folder");
    let marks = data.windows(4).enumerate().filter(|(at, word)| word == b"DICM" && *at >= 128);
    let mut starts: Vec<usize> = marks.map(|(at, _)| at - 128).collect();
    starts.push(data.len());
    for (number, range) in starts.windows(2).take(16).enumerate() {
        let bytes = data.get(range[0]..range[1]).unwrap_or_default();
        std::fs::write(folder.path().join(number.to_string()), bytes).expect("written");
    }
    let _ = read_volume(folder.path(), &Reporter::silent());
}

/// A frame: DICOM, PNG or TIFF.
pub fn dicom(data: &[u8]) {
    let suffix = match data {
        [0x89, b'P', ..] => ".png",
        [b'I', b'I', ..] | [b'M', b'M', ..] => ".tif",
        _ => ".dcm",
    };
    as_file(data, suffix, |path| {
        for frame in read_frames(path, None).into_iter().flatten() {
            assert_eq!(frame.pixels.pixels.len(), frame.pixels.width * frame.pixels.height);
        }
    });
}

/// A mesh, named by a scene.
pub fn stl(data: &[u8]) {
    as_file(data, ".stl", |path| {
        let name = path.display().to_string();
        let mesh = serde_json::json!({"path": name, "material": "titanium",
            "lps_from_mesh": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]});
        let scene = serde_json::json!({
            "objects": [{"mesh": mesh}],
            "beam": {"tube_kvp": 80, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
            "detector": {"response": "energy", "pitch_mm": 2.0}
        });
        as_file(scene.to_string().as_bytes(), ".json", |scene| drop(load(scene, false, &Reporter::silent())));
    });
}

/// Beads and landmarks, as JSON and as lists of commas.
pub fn markups(data: &[u8]) {
    for name in ["beads.mrk.json", "beads.fcsv"] {
        let _ = parse_markups(Path::new(name), data);
    }
    as_file(data, ".mrk.json", |path| drop(read_landmarks(path)));
}

/// A scene.
pub fn scene(data: &[u8]) {
    as_file(data, ".json", |path| drop(load(path, data.len().is_multiple_of(2), &Reporter::silent())));
}

/// A pose, and a prior.
pub fn pose(data: &[u8]) {
    as_file(data, ".json", |path| {
        if let Ok(pose) = Pose::read(path) {
            let _ = pose.camera();
        }
        let _ = Prior::read(path);
    });
}

/// A log, and every message in it.
pub fn mcap(data: &[u8]) {
    let Ok(reader) = LogReader::from_bytes(Path::new("fuzzed.mcap"), data.to_vec()) else { return };
    let (mut tolerance, mut assembler) = (Tolerance::default(), FrameAssembler::default());
    for entry in reader {
        tolerance.take(assembler.push(&entry));
        tolerance.take(entry.raw_bytes());
        tolerance.take(entry.image());
        tolerance.take(entry.event());
        if &*entry.encoding == "json" {
            tolerance.take(entry.json::<serde_json::Value>());
        }
    }
    assert_eq!(tolerance.losses().is_empty(), tolerance.count() == 0);
}

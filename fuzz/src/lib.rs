//! What is fuzzed: every reader of foreign bytes, one function each. They may refuse; they must not panic, hang or take memory without
//! bound. The project's tests run the same functions on the corpus and on seeded mutations of it (`tests/fuzz_smoke.rs`).

use std::path::Path;

use sidecarm::acquire::read_frames;
use sidecarm::beads::{parse_markups, read_landmarks};
use sidecarm::pose::{Pose, Prior};
use sidecarm::record::{FrameAssembler, LogReader, Tolerance};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{load, read_volume};
use sidecarm::telemetry::lines::LineBlanker;
use sidecarm::telemetry::{Decoder, DeviceKind, Event, LineAdapter, Link};

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

/// Lines of text, read as the declarations that come with the program have them.
pub fn lines(data: &[u8]) {
    let declarations = [
        include_str!("../../calibration/telemetry/generic-robot-csv.json"),
        include_str!("../../calibration/telemetry/generic-robot-json.json"),
        include_str!("../../calibration/telemetry/generic-carm-regex.json"),
    ];
    for declaration in declarations {
        let adapter: LineAdapter = serde_json::from_str(declaration).expect("they hold");
        read_lines(&adapter, data);
    }
}

/// A declaration; lines of the others are read with it.
pub fn adapter(data: &[u8]) {
    let Ok(adapter) = serde_json::from_slice::<LineAdapter>(data) else { return };
    let text = serde_json::to_string(&adapter).expect("serialises");
    assert_eq!(serde_json::from_str::<LineAdapter>(&text).expect("what was one is one"), adapter);
    read_lines(
        &adapter,
        b"1,2,3,4,5,6,7\n1500,65535,100,200,50,-100,0,112.5,225,,-125,6.25,3500,-3500,100,home\n{\"joints\":[1,2,3,4,5]}\n",
    );
    read_lines(&adapter, data);
}

fn read_lines(adapter: &LineAdapter, data: &[u8]) {
    let samples = |chunk: usize, data: &[u8]| {
        let mut link = Link::of_lines(adapter, true);
        let mut found = Vec::new();
        for part in data.chunks(chunk) {
            link.feed(1_000_000, 0, part, &mut |received| {
                if let Event::Sample(sample, _) = received.event {
                    found.push(format!("{sample:?}"));
                }
            });
        }
        found
    };
    let whole = samples(data.len().max(1), data);
    assert_eq!(whole, samples(7, data), "how bytes are split makes no difference");
    let mut blanker = LineBlanker::new(adapter);
    let lines = data.split_inclusive(|byte| matches!(byte, b'\n' | b'\r')).take(64);
    let blanked: Vec<u8> = lines
        .flat_map(|line| {
            let end = line.len() - usize::from(matches!(line.last(), Some(b'\n' | b'\r')));
            let blanked = blanker.blanked(&line[..end]);
            assert_eq!(blanked.len(), end);
            [&blanked, &line[end..]].concat()
        })
        .collect();
    assert_eq!(samples(97, &blanked), samples(97, &data[..blanked.len()]), "what is taken out no sample rests on");
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

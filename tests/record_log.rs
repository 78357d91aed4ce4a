//! Logs: round trips, cuts at every byte, damage, a full disk.

use std::io::{Cursor, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::{Arc, Mutex};

use glam::{DQuat, DVec2, DVec3};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::image::Image;
use sidecarm::record::{
    BeadMark, FrameAssembler, Level, LogContents, LogReader, Provenance, RecordError, Recorder, placed_in_room, read_log, topic,
};

fn provenance() -> Provenance {
    Provenance::of_this_program(1_000, serde_json::json!({"adapter": "none"}))
}

fn integer_frame() -> Frame {
    let pixels = (0..48u16).map(|value| f32::from(value * 1000)).collect();
    Frame::from_pixels("integers", Image { width: 8, height: 6, pixels }, Domain::Linear).expect("a frame")
}

fn float_frame() -> Frame {
    let pixels = vec![0.1, -0.0, f32::MIN_POSITIVE, 1e30, 2.5, -7.25];
    Frame::from_pixels("floats", Image { width: 3, height: 2, pixels }, Domain::Log).expect("a frame")
}

fn view() -> View {
    View {
        size_px: [8, 6],
        intrinsics: Intrinsics::from_rows(&[[5000.0, 0.0, 3.5], [0.0, 5000.0, 2.5], [0.0, 0.0, 1.0]]).expect("intrinsics"),
        camera_from_lps: Rigid { rotation: DQuat::from_rotation_x(0.3), translation_mm: DVec3::new(1.0, 2.0, 600.0) },
    }
}

/// Records a bit of everything.
fn fill(recorder: &Recorder) -> Result<(), RecordError> {
    recorder.raw_bytes("carm", 1, 2_000, &[0, 1, 2, 255])?;
    recorder.raw_bytes("robot", 3, 2_500, &[])?;
    recorder.json(topic::CARM_JOINTS, 3_000, &serde_json::json!({"orbital_rad": 0.5}))?;
    recorder.frame(&integer_frame(), 4_000)?;
    recorder.frame(&float_frame(), 5_000)?;
    recorder.drr("integers", &Image { width: 2, height: 1, pixels: vec![0.125, 3.5] }, 6_000)?;
    let bead = BeadMark { name: "b1".into(), detected_px: Some(DVec2::new(1.0, 2.0)), projected_px: DVec2::ONE, radius_px: 3.0 };
    recorder.pose_geometry(&view(), &placed_in_room(None, Some(view().camera_from_lps)), &[bead], 7_000)?;
    recorder.joint_states("/robot/joint_states", 7_500, &[("bend_1", 0.1), ("bend_2", f64::NAN)])?;
    recorder.event(Level::Warning, "line lost", 8_000)?;
    recorder.attach("scene.json", "application/json", 9_000, b"{}")
}

fn recorded(folder: &Path) -> std::path::PathBuf {
    let path = folder.join("session.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    fill(&recorder).expect("recorded");
    let summary = recorder.finish().expect("finished");
    assert_eq!(summary.topics[topic::FRAME_PIXELS], 2);
    assert_eq!(summary.messages, 15);
    path
}

fn contents(bytes: &[u8]) -> Result<LogContents, RecordError> {
    let mut reader = LogReader::from_bytes(Path::new("memory.mcap"), bytes.to_vec())?;
    let entries = reader.by_ref().collect();
    Ok(LogContents { entries, attachments: reader.attachments().to_vec(), losses: reader.losses().to_vec() })
}

#[test]
fn everything_comes_back_bit_for_bit() {
    let folder = tempfile::tempdir().expect("folder");
    let path = recorded(folder.path());
    let log = read_log(&path).expect("readable");
    assert!(log.losses.is_empty(), "{:?}", log.losses);
    assert_eq!(log.entries[0].json::<Provenance>().expect("provenance"), provenance());
    let raw: Vec<_> = log.entries.iter().filter_map(|entry| entry.raw_bytes().expect("raw")).collect();
    assert_eq!((raw[0].epoch, raw[0].bytes), (1, [0, 1, 2, 255].as_slice()));
    assert_eq!((raw[1].epoch, raw[1].bytes), (3, [].as_slice()));
    let mut assembler = FrameAssembler::default();
    let frames: Vec<Frame> = log.entries.iter().filter_map(|entry| assembler.push(entry).expect("sound")).collect();
    assert_eq!(frames, [integer_frame(), float_frame()]);
    let bits = |frame: &Frame| frame.pixels.pixels.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    assert_eq!(bits(&frames[1]), bits(&float_frame()), "also the sign of zero");
    let drr = log.entries.iter().find(|entry| &*entry.topic == topic::DRR).expect("a DRR");
    assert_eq!(drr.image().expect("sound").expect("an image").pixels, [0.125, 3.5]);
    assert_eq!(drr.host_us, 6_000);
    assert_eq!(log.attachments[0].data, b"{}");
    let events: Vec<_> = log.entries.iter().filter_map(|entry| entry.event().expect("sound")).collect();
    assert!(events.contains(&"line lost".to_owned()));
    let schemas: Vec<&str> = log.entries.iter().map(|entry| &*entry.schema).collect();
    for known in [
        "foxglove.RawImage",
        "foxglove.CameraCalibration",
        "foxglove.FrameTransforms",
        "foxglove.ImageAnnotations",
        "foxglove.JointStates",
    ] {
        assert!(schemas.contains(&known), "{known}");
    }
}

/// A replay took whatever pixels stood in the log: with a right checksum, other pixels gave other scores and not a word.
#[test]
fn pixels_that_were_not_recorded_are_no_frame() {
    let folder = tempfile::tempdir().expect("folder");
    let log = read_log(&recorded(folder.path())).expect("readable");
    let mut refused = 0;
    let mut assembler = FrameAssembler::default();
    for mut entry in log.entries {
        let is_pixels = &*entry.topic == topic::FRAME_PIXELS;
        if is_pixels && let Some(byte) = entry.data.last_mut() {
            *byte ^= 1;
        }
        match assembler.push(&entry) {
            Ok(frame) => assert!(frame.is_none(), "{frame:?}"),
            Err(error) => {
                assert!(is_pixels, "{error}");
                refused += usize::from(error.to_string().contains("not those that were recorded"));
            }
        }
    }
    assert_eq!(refused, 2);
}

/// serde_json's default parser may be off by one unit in the last place; replay needs the very same bits.
#[test]
fn floats_in_json_come_back_bit_for_bit() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("floats.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    let numbers: Vec<f64> = (1..2000u32).map(|n| (f64::from(n) * 0.618_033_988).sin() * 10f64.powi(n as i32 % 40 - 20)).collect();
    recorder.json("/pose", 1, &serde_json::json!({ "numbers": numbers })).expect("recorded");
    recorder.finish().expect("finished");
    let back: serde_json::Value = read_log(&path).expect("readable").entries[1].json().expect("JSON");
    let back: Vec<u64> =
        back["numbers"].as_array().expect("a list").iter().map(|n| n.as_f64().expect("a number").to_bits()).collect();
    assert_eq!(back, numbers.iter().map(|n| n.to_bits()).collect::<Vec<_>>());
}

#[test]
fn a_finished_log_has_a_summary_for_other_tools() {
    let folder = tempfile::tempdir().expect("folder");
    let bytes = std::fs::read(recorded(folder.path())).expect("bytes");
    let summary = mcap::Summary::read(&bytes).expect("sound").expect("present");
    assert_eq!(summary.stats.expect("statistics").message_count, 15);
    assert_eq!(summary.attachment_indexes.len(), 1);
    let messages = mcap::MessageStream::new(&bytes).expect("stream").collect::<Result<Vec<_>, _>>().expect("sound");
    assert_eq!(messages.len(), 15);
}

#[test]
fn what_stands_behind_the_end_of_a_log_is_said() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let bytes = std::fs::read(recorded(folder.path())).expect("the log");
    let twice = contents(&[bytes.clone(), bytes.clone()].concat()).expect("the first of the two opens");
    assert_eq!(twice.entries.len(), contents(&bytes).expect("opens").entries.len());
    let said: Vec<&str> = twice.losses.iter().map(|loss| loss.reason.as_str()).collect();
    assert!(said.len() == 1 && said[0].contains("two logs in one file"), "{said:?}");
    assert_eq!(twice.losses[0].at_byte, bytes.len() as u64);
}

#[test]
fn a_log_cut_at_any_byte_gives_what_came_before() {
    let folder = tempfile::tempdir().expect("folder");
    let bytes = std::fs::read(recorded(folder.path())).expect("bytes");
    let whole = contents(&bytes).expect("readable");
    let mut with_some = 0;
    for length in 1..bytes.len() {
        let cut = contents(&bytes[..length]).unwrap_or_else(|error| panic!("{length}: {error}"));
        assert!(!cut.losses.is_empty(), "{length} of {}: the cut is said", bytes.len());
        assert!(whole.entries.starts_with(&cut.entries), "{length}: a prefix");
        assert!(cut.losses[0].at_byte <= length as u64);
        with_some += usize::from(!cut.entries.is_empty());
    }
    assert!(with_some > 100, "cuts behind the first chunk keep its messages");
    assert!(matches!(contents(&[]), Err(RecordError::NotALog { .. })));
    assert!(matches!(contents(b"no log"), Err(RecordError::NotALog { .. })));
}

#[test]
fn damage_anywhere_neither_panics_nor_passes_unsaid() {
    let folder = tempfile::tempdir().expect("folder");
    let bytes = std::fs::read(recorded(folder.path())).expect("bytes");
    let whole = contents(&bytes).expect("readable");
    let mut said = 0;
    let mut flips = 0;
    for at in (8..bytes.len()).step_by(3) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x55;
        let read = contents(&damaged).expect("the first bytes are sound");
        let same = read.entries == whole.entries && read.attachments == whole.attachments;
        assert!(same || !read.losses.is_empty(), "byte {at}: something is missing and nobody says so");
        said += usize::from(!read.losses.is_empty());
        flips += 1;
    }
    assert!(said > flips / 4 && flips > 500, "{said} of {flips}");
}

/// It said that openings are counted from 1; the first is 0 in every log.
#[test]
fn the_layout_of_raw_bytes_in_a_log_says_from_where_openings_are_counted() {
    let folder = tempfile::tempdir().expect("folder");
    let bytes = std::fs::read(recorded(folder.path())).expect("bytes");
    let mut told = 0;
    for message in mcap::MessageStream::new(&bytes).expect("a log") {
        let channel = message.expect("a message").channel;
        if let Some(schema) = channel.schema.as_ref().filter(|schema| schema.name == "sidecarm.RawBytes") {
            let layout = String::from_utf8_lossy(&schema.data).into_owned();
            assert!(layout.contains("counts the openings of the serial line, starting at 0"), "{layout}");
            told += 1;
        }
    }
    assert_eq!(told, 2);
}

/// A chunk as other programs write it, of one byte packed with lz4.
fn chunk_of_lz4() -> Vec<u8> {
    let head =
        [&[0u8; 16][..], &9u64.to_le_bytes(), &0u32.to_le_bytes(), &3u32.to_le_bytes(), b"lz4", &1u64.to_le_bytes(), &[0u8]];
    let body = head.concat();
    [&[mcap::records::op::CHUNK][..], &(body.len() as u64).to_le_bytes(), &body].concat()
}

/// It was told as damage, without a word of the compression.
#[test]
fn a_log_that_is_compressed_with_lz4_says_so_and_what_to_do() {
    let folder = tempfile::tempdir().expect("folder");
    let bytes = std::fs::read(recorded(folder.path())).expect("bytes");
    let record_end = |at: usize| {
        let length = bytes[at + 1..].first_chunk::<8>().expect("a record");
        at + 9 + u64::from_le_bytes(*length) as usize
    };
    let first_chunk =
        std::iter::successors(Some(8), |at| Some(record_end(*at))).find(|at| bytes[*at] == mcap::records::op::CHUNK);
    let first_chunk = first_chunk.expect("a chunk");
    let put_in = |at: usize| [&bytes[..at], &chunk_of_lz4(), &bytes[at..]].concat();
    let refused = contents(&put_in(first_chunk)).expect_err("it begins with lz4");
    let told = refused.to_string();
    assert!(matches!(refused, RecordError::Compression { .. }), "{told}");
    assert!(told.contains("lz4") && told.contains("mcap compress --compression zstd"), "{told}");
    let later = contents(&put_in(record_end(first_chunk))).expect("it begins with zstd");
    assert_eq!(later.entries, contents(&bytes).expect("readable").entries);
    let said: Vec<&str> = later.losses.iter().map(|loss| loss.reason.as_str()).collect();
    assert!(said.len() == 1 && said[0].contains("is compressed with lz4, which is not read here"), "{said:?}");
    // A head that is damaged is no other compression.
    let mut damaged = bytes.clone();
    let name = bytes[first_chunk..].windows(4).position(|window| window == b"zstd").expect("its compression") + first_chunk;
    damaged[name] ^= 0x55;
    assert!(!contents(&damaged).expect("opens").losses.is_empty());
}

/// A log of so many images, each in a chunk of its own.
fn images_in_chunks(count: i64) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("chunks.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    let noise: Vec<f32> = (0..1_500_000u32).map(|i| f32::from_bits(0x3f00_0000 | (i.wrapping_mul(2_654_435_761) >> 9))).collect();
    for index in 0..count {
        let image = Image { width: 1500, height: 1000, pixels: noise.clone() };
        recorder.drr(&format!("{index}"), &image, index).expect("recorded");
    }
    recorder.finish().expect("finished");
    std::fs::read(&path).expect("bytes")
}

/// Several chunks, the middle one damaged: the others stay.
#[test]
fn a_damaged_chunk_is_skipped_and_the_rest_is_read() {
    let mut bytes = images_in_chunks(3);
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0xff;
    let log = contents(&bytes).expect("readable");
    let images = log.entries.iter().filter(|entry| &*entry.topic == topic::DRR).count();
    assert_eq!(images, 2, "{:?}", log.losses);
    assert_eq!(log.losses.len(), 2, "{:?}", log.losses);
    assert!(log.losses[0].reason.contains("skipped"), "{:?}", log.losses);
    assert!(log.losses[1].reason.contains("had been recorded"), "{:?}", log.losses);
}

/// Where each record of the file begins, with its kind.
fn records(bytes: &[u8]) -> Vec<(usize, u8)> {
    let mut at = mcap::MAGIC.len();
    let mut found = Vec::new();
    while let Some(head) = bytes.get(at..at + 9) {
        found.push((at, head[0]));
        at += 9 + u64::from_le_bytes(head[1..].try_into().expect("eight")) as usize;
        if head[0] == mcap::records::op::FOOTER {
            break;
        }
    }
    found
}

/// One page of zeros, or one that is gone, over the head of a chunk: all that came behind it was lost although it was whole.
#[test]
fn behind_a_page_that_is_gone_the_log_is_read_on() {
    let bytes = images_in_chunks(5);
    // Of images: on a crowded machine a small chunk with what is announced lies before them, and without that nothing can be read.
    let records = records(&bytes);
    let large = records.windows(2).filter(|pair| pair[1].0 - pair[0].0 > 100_000 && pair[0].1 == mcap::records::op::CHUNK);
    let chunks: Vec<usize> = large.map(|pair| pair[0].0).collect();
    assert!(chunks.len() >= 5, "{chunks:?}");
    let images = |bytes: &[u8]| {
        let log = contents(bytes).expect("readable");
        (log.entries.iter().filter(|entry| &*entry.topic == topic::DRR).count(), log.losses)
    };
    assert_eq!(images(&bytes), (5, Vec::new()));
    let page = chunks[2] - 2000..chunks[2] + 2096;
    let mut zeroed = bytes.clone();
    zeroed[page.clone()].fill(0);
    let cut = [&bytes[..page.start], &bytes[page.end..]].concat();
    let inside = [&bytes[..chunks[1] + 2000], &bytes[chunks[1] + 6096..]].concat();
    let mut long = bytes.clone();
    long[chunks[2] + 4] ^= 1;
    // The channels are announced there, and once more at the end, which then lies before the place that the footer names.
    let start = [&bytes[..100], &bytes[4196..]].concat();
    let cases =
        [("zeros", &zeroed, 3), ("gone", &cut, 3), ("gone inside", &inside, 4), ("a length", &long, 4), ("start", &start, 4)];
    for (what, damaged, least) in cases {
        let (found, losses) = images(damaged);
        assert!(found >= least && !losses.is_empty() && losses.len() < 8, "{what}: {found} images, {losses:#?}");
        let said = ["up to the next whole chunk", "damaged and was skipped"];
        assert!(losses.iter().any(|loss| said.iter().any(|said| loss.reason.contains(said))), "{what}: {losses:#?}");
    }
}

#[test]
fn what_is_older_than_the_flush_interval_survives_a_kill() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("killed.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    fill(&recorder).expect("recorded");
    let watch = sidecarm::time::Stopwatch::start();
    while recorder.health().flushed < recorder.health().accepted {
        assert!(watch.ms() < 10_000.0, "the flush never came");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    // What a kill would leave is what is in the file now; the recorder is still open.
    let log = contents(&std::fs::read(&path).expect("bytes")).expect("readable");
    assert_eq!(log.entries.len(), 15);
    assert!(log.losses[0].reason.contains("not closed"), "{:?}", log.losses);
}

#[test]
fn logs_are_not_overwritten_and_end_once() {
    let folder = tempfile::tempdir().expect("folder");
    let path = recorded(folder.path());
    assert!(matches!(Recorder::create(&path, &provenance()), Err(RecordError::Exists { .. })));
    let missing = folder.path().join("none/x.mcap");
    assert!(matches!(Recorder::create(&missing, &provenance()), Err(RecordError::Io { .. })));
    let recorder = Recorder::create(&folder.path().join("two.mcap"), &provenance()).expect("created");
    recorder.finish().expect("finished");
    assert!(matches!(recorder.finish(), Err(RecordError::Finished { .. })));
    assert!(matches!(recorder.raw_bytes("carm", 1, 0, &[1]), Err(RecordError::Finished { .. })));
}

/// A disk with `room` bytes.
struct SmallDisk {
    content: Arc<Mutex<Cursor<Vec<u8>>>>,
    room: usize,
}

impl Write for SmallDisk {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let mut content = self.content.lock().expect("not poisoned");
        let free = self.room.saturating_sub(content.get_ref().len());
        if free == 0 {
            return Err(std::io::Error::new(std::io::ErrorKind::StorageFull, "no space left on device"));
        }
        content.write(&bytes[..bytes.len().min(free)])
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Seek for SmallDisk {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.content.lock().expect("not poisoned").seek(to)
    }
}

#[test]
fn a_full_disk_stops_the_recording_and_keeps_what_was_recorded() {
    let content = Arc::new(Mutex::new(Cursor::new(Vec::new())));
    let disk = SmallDisk { content: Arc::clone(&content), room: 40_000 };
    let recorder = Recorder::to_target(Path::new("small.mcap"), Box::new(disk), &provenance()).expect("started");
    let watch = sidecarm::time::Stopwatch::start();
    let mut sent = 0u32;
    let error = loop {
        let noise: Vec<u8> = (0..2000u32).map(|i| ((i + sent).wrapping_mul(2_654_435_761) >> 13) as u8).collect();
        match recorder.raw_bytes("carm", 1, i64::from(sent), &noise) {
            Ok(()) => sent += 1,
            Err(error) => break error,
        }
        assert!(watch.ms() < 30_000.0, "the disk never filled");
        std::thread::sleep(std::time::Duration::from_millis(10));
    };
    assert!(error.to_string().contains("no space left") && error.to_string().contains("small.mcap"), "{error}");
    assert!(recorder.health().failure.is_some());
    let flushed = recorder.health().flushed;
    assert!(matches!(recorder.finish(), Err(RecordError::Stopped { .. })));
    let bytes = content.lock().expect("not poisoned").get_ref().clone();
    let log = contents(&bytes).expect("readable");
    assert!(log.entries.len() as u64 >= flushed && flushed > 0, "{} read, {flushed} flushed", log.entries.len());
    assert!(!log.losses.is_empty());
}

#[test]
fn senders_on_several_threads_lose_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("threads.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    std::thread::scope(|scope| {
        for device in ["carm", "robot"] {
            let recorder = &recorder;
            scope.spawn(move || (0..5_000).for_each(|n| recorder.raw_bytes(device, 1, n, &n.to_le_bytes()).expect("recorded")));
        }
    });
    assert_eq!(recorder.finish().expect("finished").messages, 10_001);
    let log = read_log(&path).expect("readable");
    for name in [topic::CARM_RAW, topic::ROBOT_RAW] {
        let times: Vec<i64> = log.entries.iter().filter(|entry| &*entry.topic == name).map(|entry| entry.host_us).collect();
        assert_eq!(times, (0..5_000).collect::<Vec<_>>());
    }
}

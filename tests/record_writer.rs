//! The writer of logs under stress: large frames, slow, full and vanished disks; and logs that lie about themselves.
#![cfg(unix)]

use std::io::{Read, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use sidecarm::image::Image;
use sidecarm::record::{FrameAssembler, LogReader, Provenance, RecordError, Recorder, Tolerance, read_log, topic};

use crate::live_lab::{HANG_S, eventually};

/// [`HANG_S`] for a flush.
const HANG: Duration = Duration::from_secs(HANG_S as u64);

fn provenance() -> Provenance {
    Provenance::of_this_program(1_000, serde_json::json!({}))
}

fn noise(width: usize, height: usize) -> Image<f32> {
    let value = |i: u32| f32::from_bits(0x3f00_0000 | (i.wrapping_mul(2_654_435_761) >> 9));
    Image { width, height, pixels: (0..(width * height) as u32).map(value).collect() }
}

/// A disk that can be slow, stand still or be full.
#[derive(Clone, Default)]
struct Disk {
    content: Arc<Mutex<Vec<u8>>>,
    stands_still: Arc<AtomicBool>,
    full: Arc<AtomicBool>,
    writes: Arc<AtomicU64>,
}

impl Write for Disk {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        while self.stands_still.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(2));
        }
        if self.full.load(Ordering::Relaxed) {
            return Err(std::io::Error::new(std::io::ErrorKind::StorageFull, "no space left on device"));
        }
        self.content.lock().expect("not poisoned").extend_from_slice(bytes);
        self.writes.fetch_add(1, Ordering::Relaxed);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

fn on(disk: &Disk) -> Recorder {
    Recorder::to_target(Path::new("disk.mcap"), Box::new(disk.clone()), &provenance()).expect("started")
}

/// Frames of 9 MB are prepared and recorded one after the other; telemetry reaches the file while a frame is being prepared.
#[test]
fn large_frames_do_not_delay_telemetry() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("frames.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    let image = noise(1536, 1536);
    // Odd while a frame is being prepared.
    let (turns, stop) = (AtomicU64::new(0), AtomicBool::new(false));
    let (mut sent, mut within) = (0, 0);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for index in 0..6 {
                turns.fetch_add(1, Ordering::SeqCst);
                let prepared = recorder.prepare_drr(&format!("{index}"), &image, index);
                turns.fetch_add(1, Ordering::SeqCst);
                recorder.wait_for_room(prepared.bytes()).expect("room");
                recorder.record(prepared).expect("recorded");
            }
            stop.store(true, Ordering::SeqCst);
        });
        while !stop.load(Ordering::SeqCst) {
            let turn = turns.load(Ordering::SeqCst);
            recorder.raw_bytes("robot", 1, sent, &[0; 158]).expect("recorded");
            recorder.flush_now(HANG).expect("in the file");
            within += u64::from(turn % 2 == 1 && turns.load(Ordering::SeqCst) == turn);
            sent += 1;
        }
    });
    recorder.finish().expect("finished");
    println!("{within} of {sent} messages came into the file within the preparation of a frame");
    assert!(within > 0, "of {sent}");
    assert_eq!(read_log(&path).expect("readable").entries.iter().filter(|entry| &*entry.topic == topic::DRR).count(), 6);
}

/// What is prepared takes its place in the log where it is recorded, pixels directly behind their tags.
#[test]
fn prepared_frames_stand_where_they_were_recorded() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("order.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    let frame = |name: &str| {
        sidecarm::acquire::Frame::from_pixels(name, noise(40, 30), sidecarm::acquire::Domain::Linear).expect("a frame")
    };
    let first = recorder.prepare_frame(&frame("first"), 10).expect("prepared");
    let second = recorder.prepare_frame(&frame("second"), 20).expect("prepared");
    recorder.json("/order", 1, &1).expect("recorded");
    recorder.record(second).expect("recorded");
    recorder.json("/order", 2, &2).expect("recorded");
    recorder.wait_for_room(first.bytes()).expect("room");
    recorder.record(first).expect("recorded");
    recorder.json("/order", 3, &3).expect("recorded");
    recorder.finish().expect("finished");
    let log = read_log(&path).expect("readable");
    assert!(log.losses.is_empty(), "{:?}", log.losses);
    let topics: Vec<&str> = log.entries.iter().skip(1).map(|entry| &*entry.topic).collect();
    let (tags, pixels) = (topic::FRAME_TAGS, topic::FRAME_PIXELS);
    assert_eq!(topics, ["/order", tags, pixels, "/order", tags, pixels, "/order"]);
    let mut assembler = FrameAssembler::default();
    let names: Vec<String> =
        log.entries.iter().filter_map(|entry| assembler.push(entry).expect("sound")).map(|frame| frame.name).collect();
    assert_eq!(names, ["second", "first"]);
}

#[test]
fn flush_now_means_that_it_is_in_the_file() {
    let disk = Disk::default();
    let recorder = on(&disk);
    for round in 0..20 {
        recorder.raw_bytes("carm", 1, round, &[7; 100]).expect("recorded");
        recorder.flush_now(HANG).expect("flushed");
        let bytes = disk.content.lock().expect("not poisoned").clone();
        let log = LogReader::from_bytes(Path::new("disk.mcap"), bytes).expect("a log");
        assert_eq!(log.filter(|entry| &*entry.topic == topic::CARM_RAW).count() as i64, round + 1);
    }
    disk.stands_still.store(true, Ordering::Relaxed);
    recorder.raw_bytes("carm", 1, 99, &[7; 100]).expect("recorded");
    let error = recorder.flush_now(Duration::from_millis(300)).expect_err("the disk stands still");
    assert!(matches!(error, RecordError::Behind { .. }), "{error}");
    disk.stands_still.store(false, Ordering::Relaxed);
    recorder.finish().expect("finished");
}

/// A disk that stands still is seen, telemetry is taken all the while, and nothing is lost when it goes on. Producers of large messages
/// wait.
#[test]
fn a_disk_that_stands_still_is_seen_and_blocks_no_telemetry() {
    let disk = Disk::default();
    let recorder = on(&disk);
    recorder.flush_now(HANG).expect("flushed");
    disk.stands_still.store(true, Ordering::Relaxed);
    let flushed = recorder.health().flushed;
    // The disk goes on only behind this: a sender that waited for it would wait for ever.
    (0..200).for_each(|sent| recorder.raw_bytes("robot", 1, sent, &[1; 158]).expect("recorded"));
    std::thread::sleep(Duration::from_millis(500));
    let health = recorder.health();
    assert!(health.behind_ms >= 500.0 && health.flushed == flushed, "what waits grows older: {health:?}");
    std::thread::scope(|scope| {
        let (recorder, disk) = (&recorder, &disk);
        let large =
            scope.spawn(move || (0..4).for_each(|index| recorder.drr("large", &noise(1536, 1536), index).expect("recorded")));
        std::thread::sleep(Duration::from_millis(1_000));
        assert!(!large.is_finished(), "36 MB of pictures wait for room");
        disk.stands_still.store(false, Ordering::Relaxed);
        large.join().expect("no panic");
    });
    recorder.flush_now(HANG).expect("the disk goes on");
    assert_eq!(recorder.health().behind_ms, 0.0, "nothing waits any more");
    let summary = recorder.finish().expect("finished");
    assert_eq!((summary.topics[topic::ROBOT_RAW], summary.topics[topic::DRR]), (200, 4));
}

#[test]
fn a_full_disk_is_said_unasked_and_blocks_nobody() {
    let disk = Disk::default();
    let recorder = on(&disk);
    recorder.flush_now(HANG).expect("flushed");
    disk.full.store(true, Ordering::Relaxed);
    recorder.raw_bytes("robot", 1, 1, &[1; 158]).expect("nobody knows yet");
    let failure = eventually(HANG_S, || recorder.health().failure).expect("said");
    assert!(failure.contains("no space left"), "{failure}");
    for outcome in [
        recorder.raw_bytes("robot", 1, 2, &[1; 158]),
        recorder.drr("any", &noise(8, 8), 3),
        recorder.wait_for_room(100 << 20),
        recorder.flush_now(HANG),
    ] {
        assert!(matches!(outcome, Err(RecordError::Stopped { .. })), "{outcome:?}");
    }
    assert!(recorder.health().refused >= 2, "what is lost is counted: {:?}", recorder.health());
    assert!(matches!(recorder.finish(), Err(RecordError::Stopped { .. })));
}

#[cfg(unix)]
#[test]
fn a_log_that_is_deleted_is_said_and_one_that_is_moved_goes_on() {
    let folder = tempfile::tempdir().expect("folder");
    let (path, elsewhere) = (folder.path().join("a.mcap"), folder.path().join("b.mcap"));
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    recorder.flush_now(HANG).expect("flushed");
    std::fs::rename(&path, &elsewhere).expect("moved");
    assert!(eventually(HANG_S, || recorder.health().moved.then_some(())).is_some(), "moved");
    recorder.raw_bytes("robot", 1, 1, &[1; 158]).expect("recorded");
    recorder.finish().expect("finished");
    assert!(read_log(&elsewhere).expect("readable").losses.is_empty());

    let recorder = Recorder::create(&path, &provenance()).expect("created");
    std::fs::remove_file(&path).expect("deleted");
    let failure = eventually(HANG_S, || recorder.health().failure).expect("said");
    assert!(failure.contains("deleted"), "{failure}");
    assert!(recorder.raw_bytes("robot", 1, 1, &[1; 158]).is_err());
}

/// One malformed message used to refuse the whole log.
#[test]
fn a_malformed_message_is_one_loss() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("odd.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    for value in [serde_json::json!({"rms_px": 1.0}), serde_json::json!("no pose"), serde_json::json!({"rms_px": 2.0})] {
        recorder.json(topic::POSE, 1, &value).expect("recorded");
    }
    recorder.json(topic::FRAME_TAGS, 2, &serde_json::json!(["no tags"])).expect("recorded");
    recorder.finish().expect("finished");
    #[derive(serde::Deserialize)]
    struct Known {
        rms_px: f64,
    }
    let mut tolerance = Tolerance::default();
    let mut assembler = FrameAssembler::default();
    let mut sound = Vec::new();
    for entry in LogReader::open(&path).expect("a log") {
        if &*entry.topic == topic::POSE {
            sound.extend(tolerance.take(entry.json::<Known>()).map(|known| known.rms_px));
        }
        assert!(tolerance.take(assembler.push(&entry)).flatten().is_none());
    }
    assert_eq!(sound, [1.0, 2.0]);
    assert_eq!(tolerance.count(), 2);
    let losses = tolerance.losses();
    assert!(losses.len() == 2 && losses.iter().any(|loss| loss.contains("/pose")), "{losses:?}");
}

/// A chunk of some kilobytes that says that it unpacks to gigabytes, or does.
#[test]
fn a_chunk_that_unpacks_to_gigabytes_is_one_loss() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("sound.mcap");
    let recorder = Recorder::create(&path, &provenance()).expect("created");
    recorder.finish().expect("finished");
    let sound = std::fs::read(&path).expect("bytes");
    let zeros = zstd::encode_all(std::io::repeat(0).take(600 << 20), 1).expect("compressed");
    assert!(zeros.len() < 1 << 20, "{} bytes", zeros.len());
    for (promised, words) in [(16u64, "unpacks to 17 bytes"), (3 << 30, "more than any chunk"), (u64::MAX, "more than any chunk")]
    {
        let mut chunk = vec![0u8; 16];
        chunk.extend(promised.to_le_bytes());
        chunk.extend(0u32.to_le_bytes());
        chunk.extend(4u32.to_le_bytes());
        chunk.extend(b"zstd");
        chunk.extend((zeros.len() as u64).to_le_bytes());
        chunk.extend(&zeros);
        // Directly behind the header record.
        let header = 9 + u64::from_le_bytes(sound[9..17].try_into().expect("eight bytes")) as usize;
        let mut bytes = sound[..8 + header].to_vec();
        bytes.push(6);
        bytes.extend((chunk.len() as u64).to_le_bytes());
        bytes.extend(&chunk);
        bytes.extend(&sound[8 + header..]);
        let mut reader = LogReader::from_bytes(Path::new("bomb.mcap"), bytes).expect("a log");
        assert_eq!(reader.by_ref().count(), 1, "the provenance is there");
        // Of 600 MB no byte is unpacked behind the first that should not be there.
        let losses = reader.losses();
        assert!(losses.len() == 1 && losses[0].reason.contains(words), "{promised}: {losses:?}");
    }
}

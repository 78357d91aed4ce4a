//! Scripted sources through the task that drives ports: openings, losses and retries, without a device.

use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

use sidecarm::telemetry::{ByteSource, Closing, DeviceKind, Heard, Link, PortError, PortEvent, Script, spawn_source};
use tokio::sync::mpsc;

use crate::live_lab::{HANG_S, eventually};
use crate::telemetry_frames::plain;

/// Bytes with their time of arrival.
type Piece = (i64, Vec<u8>);

/// What comes of one opening: whole packets, cut where they do not end.
fn pieces(sequences: Range<u32>) -> Vec<Piece> {
    let first_us = i64::from(sequences.start) * 33_333;
    let bytes: Vec<u8> = sequences.flat_map(plain).collect();
    (first_us..).step_by(7).zip(bytes.chunks(61).map(<[u8]>::to_vec)).collect()
}

/// An attempt that succeeds, and ends where there is a reason.
fn opens(pieces: &[Piece], end: Option<&str>) -> Result<Vec<Heard>, PortError> {
    let bytes = pieces.iter().map(|(host_us, bytes)| Heard::Bytes { host_us: *host_us, bytes: bytes.clone() });
    Ok(bytes.chain(end.map(|reason| Heard::Lost { reason: reason.to_owned() })).collect())
}

fn fails() -> Result<Vec<Heard>, PortError> {
    Err(PortError::NotFound { path: PathBuf::from("script") })
}

/// What a port says besides bytes.
fn words(event: &PortEvent) -> String {
    match event {
        PortEvent::Opened { epoch, .. } => format!("opened {epoch}"),
        PortEvent::Lost { epoch, reason, .. } => format!("lost {epoch}: {reason}"),
        PortEvent::Retry { attempt, wait_ms, .. } => format!("failed {attempt}, next in {wait_ms} ms"),
        PortEvent::Said { words, .. } => words.clone(),
        PortEvent::Bytes { .. } => String::new(),
    }
}

/// Everything up to the `count`th piece of bytes. Nobody listens until reading waits; then the source is closed, and nothing follows.
fn heard(source: impl ByteSource + 'static, count: usize) -> Vec<PortEvent> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().expect("a runtime");
    let (sink, mut events) = mpsc::channel(1);
    let task = spawn_source(runtime.handle(), DeviceKind::Carm, PathBuf::from("script"), source, sink);
    eventually(HANG_S, || (task.stalls() > 0).then_some(())).expect("the receiver is full and reading waits");
    let hang = Duration::from_secs_f64(HANG_S);
    let mut next = || runtime.block_on(async { tokio::time::timeout(hang, events.recv()).await }).expect("an event");
    let (mut heard, mut pieces, mut bytes_read) = (Vec::new(), 0, 0);
    while pieces < count {
        let (device, event) = next().expect("the task runs");
        assert_eq!(device, DeviceKind::Carm);
        if let PortEvent::Bytes { bytes, .. } = &event {
            (pieces, bytes_read) = (pieces + 1, bytes_read + bytes.len() as u64);
        }
        heard.push(event);
    }
    assert_eq!(task.bytes(), bytes_read, "all that was read was handed on");
    task.finish();
    assert_eq!(next(), None, "closed, and not opened again");
    heard
}

#[test]
fn a_source_that_dies_and_comes_back_is_opened_anew_and_loses_no_byte() {
    let [first, second, third] = [pieces(0..10), pieces(10..20), pieces(20..30)];
    let script = Script::new([
        opens(&first, Some("unplugged")),
        fails(),
        // It dies before anything comes, and must not be hammered.
        opens(&[], Some("dead")),
        fails(),
        opens(&second, Some("unplugged again")),
        fails(),
        fails(),
        opens(&third, None),
    ]);
    let events = heard(script, first.len() + second.len() + third.len());
    let told: Vec<String> = events.iter().map(words).filter(|words| !words.is_empty()).collect();
    let expected = [
        "opened 0",
        "lost 0: unplugged",
        "failed 1, next in 100 ms",
        "opened 1",
        "lost 1: dead",
        "failed 1, next in 400 ms",
        "opened 2",
        "lost 2: unplugged again",
        "failed 1, next in 100 ms",
        "failed 2, next in 200 ms",
        "opened 3",
    ];
    assert_eq!(told, expected);

    // Every byte, with its own time, of the opening in which it came.
    let mut in_log: Vec<(i64, u32, Vec<u8>)> = Vec::new();
    for (epoch, pieces) in [(0, first), (2, second), (3, third)] {
        in_log.extend(pieces.into_iter().map(|(host_us, bytes)| (host_us, epoch, bytes)));
    }
    let (mut live, mut replay) = (Link::new(DeviceKind::Carm), Link::new(DeviceKind::Carm));
    let (mut of_port, mut of_live, mut of_replay) = (Vec::new(), Vec::new(), Vec::new());
    for event in &events {
        live.handle(event, &mut |received| of_live.push(received));
        if let PortEvent::Bytes { host_us, epoch, bytes } = event {
            of_port.push((*host_us, *epoch, bytes.clone()));
        }
    }
    assert_eq!(of_port, in_log);
    // As a log holds them, they decode to the same.
    for (host_us, epoch, bytes) in &in_log {
        replay.feed(*host_us, *epoch, bytes, &mut |received| of_replay.push(received));
    }
    assert_eq!(of_live, of_replay);
    let health = live.health();
    assert_eq!((health.frames, health.epochs, health.lost_in_all()), (30, 3, 0));
}

/// Keeps what comes while it is not open, as a socket does.
struct Keeping(Script);

impl ByteSource for Keeping {
    const KEEPS_BYTES: bool = true;

    async fn open(&mut self) -> Result<PathBuf, PortError> {
        self.0.open().await
    }

    async fn next(&mut self, closing: &mut Closing) -> Heard {
        self.0.next(closing).await
    }
}

#[test]
fn a_source_that_keeps_bytes_is_opened_again_at_once() {
    let pieces = pieces(0..2);
    let script = || Script::new([opens(&pieces, Some("gone")), fails(), opens(&pieces, None)]);
    let waited = |events: Vec<PortEvent>| {
        events.iter().map(words).find(|words| words.starts_with("failed")).expect("it failed to open once")
    };
    // The wait after a loss, which doubles the next one, is left out.
    assert_eq!(waited(heard(Keeping(script()), 2 * pieces.len())), "failed 1, next in 50 ms");
    assert_eq!(waited(heard(script(), 2 * pieces.len())), "failed 1, next in 100 ms", "the control");
}

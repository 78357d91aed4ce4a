//! Logs that a process of their own writes: what was handed over survives a kill −9 of the program while the disk stands still, and a
//! keeper that is killed is replaced.
#![cfg(target_os = "linux")]

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::process::{kill_process, kill_process_group};
use sidecarm::image::{Image, sha256_file};
use sidecarm::record::{Provenance, RecordError, Recorder, read_log, topic};
use sidecarm::time::host_now_us;

use crate::live_lab::{HANG_S, Live, Signal, deliver, eventually, keeper, quiet_lab};

/// Half of the time that the disk stands still: what comes in the first half has the second to be handed over.
const HALF_STILL: Duration = Duration::from_millis(1_250);

/// What the person hears of it.
const KEEPER_DIED: &str = "the process that writes the log died";

fn signal_keeper(log: &Path, signal: Signal) {
    let pid = keeper(log).unwrap_or_else(|| panic!("{} has no keeper", log.display()));
    kill_process(pid, signal).expect("the keeper is there");
}

/// The keeper of a log stands still, as one does whose disk does, until this is dropped.
struct Stopped<'a>(&'a Path);

impl<'a> Stopped<'a> {
    fn of(log: &'a Path) -> Self {
        signal_keeper(log, Signal::STOP);
        Self(log)
    }
}

impl Drop for Stopped<'_> {
    fn drop(&mut self) {
        if let Some(pid) = keeper(self.0) {
            let _ = kill_process(pid, Signal::CONT);
        }
    }
}

fn kept(path: &Path, program: &Path) -> (Recorder, Option<std::io::Error>) {
    let provenance = Provenance::of_this_program(1_000, serde_json::json!({}));
    Recorder::create_kept(path, program, &provenance).expect("created")
}

fn program() -> PathBuf {
    PathBuf::from(env!("CARGO_BIN_EXE_sidecarm"))
}

/// A write of a frame was under way for 340 ms when the program was killed, and the telemetry that came meanwhile was gone.
#[test]
fn a_kill_while_the_disk_stands_still_costs_neither_telemetry_nor_a_frame() {
    let Some((lab, frame, folder)) = quiet_lab("40") else { return };
    let lab = lab.without_ct();
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    let log = live.log.clone();
    let stopped = Stopped::of(&log);
    let length = || std::fs::metadata(&log).expect("the log").len();
    std::thread::sleep(Duration::from_millis(100));
    let still = length();
    deliver(std::slice::from_ref(&frame), &lab);
    std::thread::sleep(HALF_STILL);
    let half_us = host_now_us();
    std::thread::sleep(HALF_STILL);
    assert_eq!(length(), still, "the disk stood still");
    let kill_us = live.program.kill();
    drop(stopped);
    assert!(eventually(HANG_S, || keeper(&log).is_none().then_some(())).is_some(), "the keeper leaves");
    let heard = live.heard();
    let sent = lab.sent();
    println!("killed while the disk stood still: {:?}", heard.missing(&sent, live.recording_us, kill_us));
    let missing = heard.missing(&sent, live.recording_us, half_us);
    assert!(missing.sent > 100 && missing.lost == 0, "{missing:?}");
    assert!(heard.frames.contains(&sha256_file(&frame).expect("readable")), "the frame that was delivered is there");
    assert!(length() > still && !heard.losses.is_empty(), "a log that was not closed says so");
}

#[test]
fn a_keeper_that_is_killed_is_said_and_replaced() {
    let Some((lab, _, folder)) = quiet_lab("40") else { return };
    let lab = lab.without_ct();
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    let first = keeper(&live.log);
    let stopped = Stopped::of(&live.log);
    // What it has not written when it dies must come from the next one.
    std::thread::sleep(Duration::from_millis(300));
    signal_keeper(&live.log, Signal::KILL);
    drop(stopped);
    let said = eventually(HANG_S, || live.stderr().contains(KEEPER_DIED).then_some(()));
    assert!(said.is_some(), "nobody said it: {}", live.stderr());
    assert!(keeper(&live.log).is_some_and(|next| Some(next) != first), "another one goes on");
    let signal_us = live.signalled(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let heard = live.heard();
    assert_eq!(status.code(), Some(0), "{} {}", live.stdout(), live.stderr());
    assert!(heard.losses.is_empty(), "{:?}", heard.losses);
    let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
    assert!(missing.lost == 0 && missing.sent > 0, "{missing:?}");
    assert!(keeper(&live.log).is_none(), "the second left with the session");
}

/// A disk that stood still was said to nobody, and whoever left at once waited for it for ever.
#[test]
fn whoever_leaves_at_once_does_not_wait_for_a_disk_that_stands_still() {
    let Some((lab, _, folder)) = quiet_lab("60") else { return };
    let lab = lab.without_ct();
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    let stopped = Stopped::of(&live.log);
    let said = eventually(HANG_S, || live.stderr().contains("its disk is slow or stands still").then_some(()));
    assert!(said.is_some(), "nobody said it: {}", live.stderr());
    let signal_us = live.signalled(Signal::INT);
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let words = live.stderr();
    assert!(words.contains("goes on until it is written") && !words.contains("left without a report"), "{words}");
    assert!(status.code() == Some(0) && live.report().contains("</html>"), "{status:?} {words} {}", live.stdout());
    drop(stopped);
    assert!(eventually(HANG_S, || keeper(&live.log).is_none().then_some(())).is_some(), "the keeper leaves");
    let heard = live.heard();
    assert!(heard.losses.is_empty() && heard.end_us.is_some(), "{:?}", heard.losses);
    let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
    assert!(missing.lost == 0 && missing.sent > 0, "{missing:?}");
}

/// Ctrl-C goes to the whole group of the terminal.
#[test]
fn an_interrupt_of_the_group_leaves_a_finished_log() {
    let Some((lab, _, folder)) = quiet_lab("40") else { return };
    let lab = lab.without_ct();
    let mut live = Live::start_in_own_group(&lab.kit.join("session.json"), &folder.path().join("session"));
    // And what ends a service goes to all of its processes.
    [Signal::INT, Signal::TERM, Signal::HUP].into_iter().for_each(|signal| signal_keeper(&live.log, signal));
    let group = rustix::process::Pid::from_raw(live.program.id() as i32).expect("a process");
    // Ctrl-Z, too, is meant for the group of the terminal alone.
    assert_ne!(rustix::process::getpgid(keeper(&live.log)).expect("it is there"), group);
    let signal_us = host_now_us();
    kill_process_group(group, Signal::INT).expect("the group is there");
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let heard = live.heard();
    assert_eq!(status.code(), Some(0), "{} {}", live.stdout(), live.stderr());
    assert!(heard.losses.is_empty() && heard.end_us.is_some(), "{:?}", heard.losses);
    assert!(!live.stderr().contains(KEEPER_DIED), "the keeper heard none of it: {}", live.stderr());
    assert_eq!(heard.missing(&lab.sent(), live.recording_us, signal_us).lost, 0);
}

/// A keeper that stands still is seen as a slow disk is: telemetry is taken, large messages wait, nothing is lost when it goes on. What a
/// kill would lose does not grow with it.
#[test]
fn health_tells_what_is_in_the_file_from_what_a_kill_would_lose() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("kept.mcap");
    let (recorder, unkept) = kept(&path, &program());
    assert!(unkept.is_none(), "{unkept:?}");
    for round in 0..10 {
        recorder.raw_bytes("carm", 1, round, &[7; 100]).expect("recorded");
        recorder.flush_now(Duration::from_secs(30)).expect("flushed");
        let log = read_log(&path).expect("a log");
        assert_eq!(log.entries.iter().filter(|entry| &*entry.topic == topic::CARM_RAW).count() as i64, round + 1);
    }
    let stopped = Stopped::of(&path);
    recorder.raw_bytes("robot", 1, 1, &[1; 158]).expect("recorded");
    let kept = eventually(HANG_S, || (recorder.health().kill_loses_ms == 0.0).then_some(()));
    assert!(kept.is_some(), "the keeper has it: {:?}", recorder.health());
    std::thread::sleep(Duration::from_millis(500));
    let health = recorder.health();
    assert!(health.behind_ms >= 500.0 && health.kill_loses_ms == 0.0, "not in the file, and safe from a kill: {health:?}");
    let flushed = health.flushed;
    assert!(matches!(recorder.flush_now(Duration::from_millis(200)), Err(RecordError::Behind { .. })));
    let value = |i: u32| f32::from_bits(0x3f00_0000 | (i.wrapping_mul(2_654_435_761) >> 9));
    let noise = Image { width: 1536, height: 1536, pixels: (0..1536 * 1536).map(value).collect() };
    std::thread::scope(|scope| {
        let (recorder, noise) = (&recorder, &noise);
        let large = scope.spawn(move || (0..4).for_each(|index| recorder.drr("large", noise, index).expect("recorded")));
        std::thread::sleep(Duration::from_millis(1_500));
        assert!(!large.is_finished(), "36 MB of pictures wait for room");
        assert_eq!(recorder.health().flushed, flushed, "nothing reached the file");
        drop(stopped);
        large.join().expect("no panic");
    });
    recorder.flush_now(Duration::from_secs(30)).expect("flushed");
    // The keeper's standard input is the memory that both hold: what is in the file takes none of it.
    let memory = format!("/proc/{}/fd/0", keeper(&path).expect("it is there").as_raw_nonzero());
    let memory = std::fs::metadata(memory).expect("shared memory");
    assert!(memory.len() > 24 << 20 && 512 * memory.blocks() < 1 << 20, "{} bytes, {} blocks", memory.len(), memory.blocks());
    let summary = recorder.finish().expect("finished");
    assert_eq!((summary.topics[topic::ROBOT_RAW], summary.topics[topic::DRR]), (1, 4));
    let log = read_log(&path).expect("readable");
    assert!(log.losses.is_empty(), "{:?}", log.losses);
    assert_eq!(log.entries.len() as u64, summary.messages);
}

#[test]
fn a_kept_log_that_is_moved_goes_on_and_one_that_is_deleted_is_said() {
    let folder = tempfile::tempdir().expect("folder");
    let (path, elsewhere) = (folder.path().join("a.mcap"), folder.path().join("b.mcap"));
    let (recorder, _) = kept(&path, &program());
    recorder.flush_now(Duration::from_secs(30)).expect("flushed");
    std::fs::rename(&path, &elsewhere).expect("moved");
    assert!(eventually(HANG_S, || recorder.health().moved.then_some(())).is_some(), "moved");
    // The next keeper finds the file where it is.
    signal_keeper(&path, Signal::KILL);
    recorder.raw_bytes("robot", 1, 1, &[1; 158]).expect("recorded");
    recorder.finish().expect("finished");
    assert!(read_log(&elsewhere).expect("readable").losses.is_empty());

    let (recorder, _) = kept(&path, &program());
    std::fs::remove_file(&path).expect("deleted");
    let failure = eventually(HANG_S, || recorder.health().failure).expect("said");
    assert!(failure.contains("deleted"), "{failure}");
    assert!(recorder.raw_bytes("robot", 1, 1, &[1; 158]).is_err());
    assert!(matches!(recorder.finish(), Err(RecordError::Stopped { .. })));

    let (recorder, _) = kept(&path, &program());
    recorder.flush_now(Duration::from_secs(30)).expect("flushed");
    std::fs::OpenOptions::new().write(true).open(&path).and_then(|log| log.set_len(20)).expect("cut");
    let failure = eventually(HANG_S, || recorder.health().failure).expect("said");
    assert!(failure.contains("cut short"), "{failure}");
    assert!(matches!(recorder.finish(), Err(RecordError::Stopped { .. })));
}

/// No program, and one that is no keeper: the log is written all the same, and it is known why by whom.
#[test]
fn without_a_keeper_the_program_writes_its_log_itself() {
    let folder = tempfile::tempdir().expect("folder");
    for (index, program) in ["/nowhere/sidecarm", "/bin/true"].into_iter().enumerate() {
        let path = folder.path().join(format!("{index}.mcap"));
        let (recorder, unkept) = kept(&path, Path::new(program));
        assert!(unkept.is_some(), "{program} keeps no log");
        recorder.raw_bytes("carm", 1, 1, &[7; 100]).expect("recorded");
        recorder.finish().expect("finished");
        let log = read_log(&path).expect("readable");
        assert!(log.losses.is_empty() && log.entries.len() == 2, "{:?}", log.losses);
    }
}

#[test]
fn a_keeper_that_cannot_be_replaced_is_the_end_of_the_recording() {
    let folder = tempfile::tempdir().expect("folder");
    let (path, link) = (folder.path().join("kept.mcap"), folder.path().join("program"));
    std::os::unix::fs::symlink(program(), &link).expect("a link");
    let (recorder, unkept) = kept(&path, &link);
    assert!(unkept.is_none(), "{unkept:?}");
    recorder.flush_now(Duration::from_secs(30)).expect("flushed");
    std::fs::remove_file(&link).expect("removed");
    signal_keeper(&path, Signal::KILL);
    let failure = eventually(HANG_S, || recorder.health().failure).expect("said");
    assert!(failure.contains("died") && failure.contains("No such file"), "{failure}");
    assert!(matches!(recorder.finish(), Err(RecordError::Stopped { .. })));
    assert_eq!(read_log(&path).expect("readable").entries.len(), 1, "what was written stays");
}

//! Threads of a session that die: what stands in front of them goes on, it is said at once and ends in exit code 3, and a replay of the log
//! makes what is missing. They die because they are asked to (`src/session/fault.rs`), which only a build with debug assertions hears.
#![cfg(all(unix, debug_assertions))]

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use rustix::process::{Pid, kill_process};
use serde_json::Value;
use sidecarm::record::{LogEntry, read_log, topic};
use sidecarm::time::host_now_us;

use crate::live_lab::{HANG_S, Heard, Lab, Signal, copies, deliver, eventually, pairs_in, quiet_lab};
use crate::log_lab::replay;

/// A part that died is said within a second, at the next tick of a tenth of one; a machine that gives no core for another second is forgiven.
const SAID_MS: f64 = 2_000.0;

/// Frames of each session: one before the fault, the one that it befalls, and one after it.
const FRAMES: usize = 3;

/// A thread that dies with the second frame: what is said at once, how the loss is put, and what is said of its neighbour where that dies.
struct Part {
    name: &'static str,
    said: &'static str,
    lost: &'static str,
    others: &'static str,
    /// Whether there is still who writes the report.
    reports: bool,
}

const PARTS: [Part; 2] = [
    Part {
        name: "workshop",
        said: "warning: the rendering thread died; recording and registration go on, replay the log for the DRRs",
        lost: "the rendering thread died: frames after that have no DRR; a replay of the log makes them",
        others: "the thread that writes files died",
        reports: true,
    },
    Part {
        name: "scribe",
        said: "warning: the thread that writes files died; recording goes on, replay the log for pairs and report",
        lost: "the thread that writes files died; a replay of the log makes what is missing",
        others: "the rendering thread died",
        reports: false,
    },
];

/// A thread that reads and dies: when it does, and what is said at once, in the end and in the report.
struct Reading {
    name: &'static str,
    breaks: &'static str,
    said: &'static str,
    /// Frames that come before it dies: the last of them is its end.
    frames: usize,
}

const READINGS: [Reading; 2] = [
    Reading {
        name: "lines",
        breaks: "lines:200",
        said: "the thread that reads the serial lines died: no telemetry is recorded any more; end the session and start it again",
        frames: 0,
    },
    Reading {
        name: "frames",
        breaks: "frames:2",
        said: "the thread that reads frames died: no frame is taken any more; end the session, start it again, and attach what came meanwhile",
        frames: 2,
    },
];

/// A `sidecarm live` one of whose threads dies; what it prints goes to files. Ends with the test.
struct Broken {
    child: Child,
    out: PathBuf,
}

impl Broken {
    /// `breaks` names the thread and when it dies.
    fn start(session: &Path, out: PathBuf, breaks: &str) -> Self {
        std::fs::create_dir_all(&out).expect("a folder");
        let print = |name: &str| File::create(out.with_extension(name)).expect("created");
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        command.arg("live").arg(session).arg("--out").arg(&out).arg("--headless").env("SIDECARM_BREAKS", breaks);
        let child = command.stdin(Stdio::null()).stdout(print("stdout")).stderr(print("stderr")).spawn().expect("starts");
        Self { child, out }
    }

    /// What it printed so far on `stdout` or `stderr`.
    fn printed(&self, name: &str) -> String {
        std::fs::read_to_string(self.out.with_extension(name)).unwrap_or_default()
    }

    fn log(&self) -> PathBuf {
        self.out.join("session.mcap")
    }

    fn pairs(&self) -> usize {
        pairs_in(&self.out)
    }

    /// Numbers of the frames whose pose is in the log.
    fn posed(&self) -> Vec<u64> {
        let entries = read_log(&self.log()).map(|log| log.entries).unwrap_or_default();
        let poses = entries.iter().filter(|entry| &*entry.topic == topic::POSE);
        let numbers = poses.filter_map(|entry| entry.json::<Value>().ok()?["number"].as_u64());
        numbers.collect()
    }

    /// Waits until the thread dies; gives the host time at which that was seen.
    fn death_us(&self) -> i64 {
        self.waits("its death", || self.printed("stderr").contains("src/session/fault.rs"));
        host_now_us()
    }

    /// That the log has `words` once, by its own stamp soon after `death_us`.
    fn is_said_soon(&self, words: &str, death_us: i64) {
        let entries = read_log(&self.log()).map(|log| log.entries).unwrap_or_default();
        let says = |entry: &&LogEntry| &*entry.topic == topic::EVENTS && String::from_utf8_lossy(&entry.data).contains(words);
        let said_us: Vec<i64> = entries.iter().filter(says).map(|entry| entry.host_us).collect();
        let after_ms: Vec<f64> = said_us.iter().map(|us| (us - death_us) as f64 * 1e-3).collect();
        println!("'{words}': {after_ms:.0?} ms after the death was seen, {SAID_MS} allowed");
        assert!(matches!(after_ms.as_slice(), [ms] if *ms <= SAID_MS), "{after_ms:?}: {words}: {}", self.printed("stderr"));
    }

    fn waits(&self, what: &str, mut fact: impl FnMut() -> bool) {
        let found = eventually(HANG_S, || fact().then_some(()));
        assert!(found.is_some(), "never: {what}: {}", self.printed("stderr"));
    }
}

impl Drop for Broken {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A session whose `part` dies with the second of `files`.
fn dies(lab: &Lab, files: &[PathBuf], part: &Part) {
    let breaks = format!("{}:2", part.name);
    let mut live = Broken::start(&lab.kit.join("session.json"), lab.kit.with_file_name(part.name), &breaks);
    live.waits("a log", || live.log().exists());
    deliver(&files[..1], lab);
    live.waits("the first pair", || live.pairs() == 1);
    assert!(!live.printed("stderr").contains("died"), "the control: {}", live.printed("stderr"));
    deliver(&files[1..2], lab);
    let death_us = live.death_us();
    live.waits(part.said, || live.printed("stderr").contains(part.said));
    let said_us = host_now_us();
    deliver(&files[2..], lab);
    live.waits("a pose of every frame", || live.posed().len() == FRAMES);
    live.waits("telemetry after that", || Heard::of(&live.log()).packets.values().any(|host_us| *host_us > said_us));
    kill_process(Pid::from_child(&live.child), Signal::INT).expect("it is there");
    let status = eventually(HANG_S, || live.child.try_wait().expect("a child can be asked"));

    let (stdout, stderr) = (live.printed("stdout"), live.printed("stderr"));
    let words = format!("{}: {stdout} {stderr}", part.name);
    live.is_said_soon(part.said.trim_start_matches("warning: "), death_us);
    assert_eq!(status.and_then(|status| status.code()), Some(3), "{words}");
    let heard = Heard::of(&live.log());
    assert!(heard.end_us.is_some() && heard.losses.is_empty(), "{:?} {words}", heard.losses);
    assert_eq!((heard.images, live.posed()), (FRAMES, vec![1, 2, 3]), "{words}");
    assert!(stdout.contains(&format!("lost: {}", part.lost)), "{words}");
    assert!(!words.contains(part.others), "a neighbour that ended with it is said to have died: {words}");
    let report = std::fs::read_to_string(live.out.join("report.html")).unwrap_or_default();
    assert_eq!(report.contains(part.lost), part.reports, "{words}");
    assert!(part.reports || stdout.contains("no report could be written"), "{words}");

    let again = lab.kit.with_file_name(format!("{}-again", part.name));
    let (code, found) = replay(&live.log(), &lab.kit, &again);
    assert_eq!(code, Some(0), "{found}");
    // The first frame's DRR is in the log; that of no other came so far.
    let same = ["frames", "poses_identical", "images_identical"].map(|key| found[key].as_u64());
    assert_eq!(same, [Some(3), Some(3), Some(1)], "{found}");
    let missing: Vec<String> = (2..=FRAMES).map(|number| format!("DRR of frame {number}")).collect();
    assert_eq!(found["not_in_log"], serde_json::json!(missing), "{found}");
    for name in ["strips/002.png", "strips/003.png", "drr/001.tif", "drr/002.tif", "drr/003.tif", "report.html"] {
        assert!(again.join(name).is_file(), "{name}: {found}");
    }
}

#[test]
fn a_thread_that_dies_costs_what_it_makes_and_a_replay_makes_it() {
    let Some((lab, frame, folder)) = quiet_lab("900") else { return };
    let lab = lab.without_ct();
    let files = copies(&frame, FRAMES * PARTS.len(), &folder.path().join("copies"));
    for (part, files) in PARTS.iter().zip(files.chunks(FRAMES)) {
        dies(&lab, files, part);
    }
}

/// A session whose `thread` dies; the other goes on to the end, which tells the loss.
fn reading_dies(lab: &Lab, files: &[PathBuf], thread: &Reading) {
    let mut live = Broken::start(&lab.kit.join("session.json"), lab.kit.with_file_name(thread.name), thread.breaks);
    live.waits("a log", || live.log().exists());
    if thread.frames > 0 {
        deliver(&files[..1], lab);
        live.waits("the first pair", || live.pairs() == 1);
        assert!(!live.printed("stderr").contains("died"), "the control: {}", live.printed("stderr"));
        deliver(&files[1..thread.frames], lab);
    }
    let death_us = live.death_us();
    live.waits(thread.said, || live.printed("stderr").contains(thread.said));
    let said_us = host_now_us();
    let later = || Heard::of(&live.log()).packets.values().any(|host_us| *host_us > said_us);
    if thread.frames > 0 {
        live.waits("telemetry after that", later);
    } else {
        deliver(&files[..1], lab);
        live.waits("a pair after that", || live.pairs() == 1);
        assert!(!later() && !Heard::of(&live.log()).packets.is_empty(), "telemetry until then, and none after that");
    }
    kill_process(Pid::from_child(&live.child), Signal::INT).expect("it is there");
    let status = eventually(HANG_S, || live.child.try_wait().expect("a child can be asked"));

    let (stdout, stderr) = (live.printed("stdout"), live.printed("stderr"));
    let words = format!("{}: {stdout} {stderr}", thread.name);
    live.is_said_soon(thread.said, death_us);
    assert_eq!(status.and_then(|status| status.code()), Some(3), "{words}");
    let heard = Heard::of(&live.log());
    assert!(heard.end_us.is_some() && heard.losses.is_empty(), "{:?} {words}", heard.losses);
    // The frame with which the thread died is in no log; its file is where it was.
    assert_eq!((heard.images, live.pairs()), (1, 1), "{words}");
    assert!(stdout.contains(&format!("lost: {}", thread.said)), "{words}");
    let report = std::fs::read_to_string(live.out.join("report.html")).unwrap_or_default();
    assert!(report.contains(thread.said), "{words}");
    for other in READINGS.iter().filter(|other| other.name != thread.name) {
        assert!(!words.contains(other.said), "the other is said to have died: {words}");
    }
}

#[test]
fn a_reading_thread_that_dies_is_said_at_once_and_is_a_loss() {
    let Some((lab, frame, folder)) = quiet_lab("900") else { return };
    let lab = lab.without_ct();
    let files = copies(&frame, 1 + 2, &folder.path().join("copies"));
    reading_dies(&lab, &files[..1], &READINGS[0]);
    reading_dies(&lab, &files[1..], &READINGS[1]);
}

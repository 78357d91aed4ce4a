//! Sessions in a lab that goes wrong: losses are said and end in exit code 3, disks fail, and recording goes on or says at once why not.
#![cfg(unix)]

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use sidecarm::time::host_now_us;

use crate::lab_truth::hand_on;
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};

/// A session of four seconds; its words and how it ended.
fn short_session(lab: &Lab, session: &Path) -> (Live, Option<i32>) {
    let out = lab.kit.with_file_name("session");
    let mut live = Live::launch(session, &out, &["--seconds", "4"]);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    (live, status.code())
}

/// Exit code 3, and nobody says that nothing was lost.
fn says_what_was_lost(name: &str, live: &Live, code: Option<i32>, words: &[&str]) {
    let (out, err, report) = (live.stdout(), live.stderr(), live.report());
    assert!(!err.contains("panicked"), "{name}: {err}");
    assert_eq!(code, Some(3), "{name}: {out} {err}");
    assert!(out.contains("lost"), "{name}: {out}");
    assert!(report.contains("</html>"), "{name}: no report");
    for text in [&out, &report] {
        assert!(!text.to_lowercase().contains("nothing was lost"), "{name}");
        assert!(words.iter().any(|word| text.to_lowercase().contains(word)), "{name}: none of {words:?} in {out}");
    }
}

#[test]
fn half_of_the_packets_missing_is_a_loss() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "12", "--faults", "none", "--exposures", "0", "--missing", "0.5"])
    else {
        return;
    };
    let (live, code) = short_session(&lab, &lab.kit.join("session.json"));
    says_what_was_lost("half missing", &live, code, &["lost", "missing"]);
}

/// It was 259 300 messages of the wrong device, exit 0.
#[test]
fn swapped_ports_are_a_loss() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "12", "--faults", "none", "--exposures", "0"]) else { return };
    let session = lab.session("swapped.json", |session| {
        session["carm"]["port"] = "ttyROBOT".into();
        session["robot"]["port"] = "ttyCARM".into();
    });
    let (live, code) = short_session(&lab, &session);
    says_what_was_lost("swapped ports", &live, code, &["wrong device", "other device", "swapped"]);
}

#[test]
fn garbage_on_a_port_is_a_loss() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "12", "--faults", "none", "--exposures", "0", "--garbage", "robot"])
    else {
        return;
    };
    let (live, code) = short_session(&lab, &lab.kit.join("session.json"));
    says_what_was_lost("garbage", &live, code, &["corrupt", "garbage", "no packet"]);
}

/// The control: without faults nothing is lost, and the exit code is 0.
#[test]
fn a_sound_session_has_no_loss() {
    // A pseudo-terminal holds a second of bytes: on a machine that gives the kernel no core for so long, packets are really lost.
    for attempt in 1..=3 {
        let Some(lab) = Lab::start_without_ct(&["--duration-s", "12", "--faults", "none", "--exposures", "0"]) else { return };
        let (live, code) = short_session(&lab, &lab.kit.join("session.json"));
        let lost = live.stdout().contains("lost:");
        assert_eq!(code, Some(if lost { 3 } else { 0 }), "{} {}", live.stdout(), live.stderr());
        if !lost {
            return;
        }
        assert!(attempt < 3, "{}", live.stdout());
    }
}

/// Unplugged for a second: the line comes back, the log has both parts, what was missed is a loss.
#[test]
fn an_unplugged_line_comes_back_and_is_said() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "20", "--faults", "robot:unplug@0.15", "--exposures", "0"]) else {
        return;
    };
    let out = lab.kit.with_file_name("session");
    let mut live = Live::start(&lab.kit.join("session.json"), &out, &["--seconds", "7"]);
    let status = live.program.end(HANG_S).expect("ends");
    let heard = live.heard();
    let robot: Vec<u32> =
        heard.packets.keys().filter(|(device, _)| *device == sidecarm::telemetry::DeviceKind::Robot).map(|(_, n)| *n).collect();
    let gap = robot.windows(2).map(|pair| pair[1] - pair[0]).max().expect("packets");
    assert!((50..400).contains(&gap), "one gap of about a second, found {gap}");
    assert!(robot.last() > Some(&500), "the line came back: {:?}", robot.last());
    says_what_was_lost("unplugged", &live, status.code(), &["unplugged", "missed", "lost"]);
}

/// A file system of its own; unmounted when the test ends.
pub struct Mount(pub PathBuf);

impl Mount {
    pub fn tmpfs(at: &Path, options: &str) -> Option<Self> {
        std::fs::create_dir_all(at).expect("a folder");
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(at).output();
        if !mounted.is_ok_and(|output| output.status.success()) {
            println!("skipped: no file system can be mounted here (root is needed)");
            return None;
        }
        Some(Self(at.to_owned()))
    }
}

impl Drop for Mount {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).output();
    }
}

/// Frames that come when the log has stopped have their poses, which stand nowhere but on the screen.
#[test]
fn a_full_disk_is_said_while_the_session_goes_on_and_the_log_stays_readable() {
    const FRAMES: usize = 2;
    let exposures = FRAMES.to_string();
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "30", "--faults", "none", "--exposures", &exposures]) else { return };
    let Some(mount) = Mount::tmpfs(&lab.kit.with_file_name("disk"), "size=8m") else { return };
    let folder = lab.kit.join("exported");
    std::fs::create_dir(&folder).expect("a folder");
    let session = lab.session("full.json", |session| session["frames"]["folder"] = "exported".into());
    let mut live = Live::start(&session, &mount.0.join("session"), &[]);
    let filled_us = host_now_us();
    let ballast = vec![1u8; 16 << 20];
    let full = std::fs::write(mount.0.join("ballast"), ballast).expect_err("the disk is full");
    assert_eq!(full.kind(), std::io::ErrorKind::StorageFull);
    // Before any frame has come: whoever looks on has time to make room.
    let why = |line: &str| line.contains("go on without a log") && line.to_lowercase().contains("no space left");
    let said = eventually(HANG_S, || live.stderr().lines().any(why).then_some(()));
    assert!(said.is_some(), "nobody said that recording stopped because the disk is full: {}", live.stderr());
    hand_on(&lab, &folder, FRAMES, |_, object, to| object.write_to_file(to).expect("written"));
    for counter in 1..=FRAMES {
        let words = format!("(frame-{counter:03}): accepted, rms ");
        let posed = eventually(HANG_S, || live.stderr().contains(&words).then_some(()));
        assert!(posed.is_some(), "no '{words}': {}", live.stderr());
    }
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("hangs on a full disk: {}", live.stderr()));
    assert!(matches!(status.code(), Some(1 | 3)), "{status:?}");
    assert!(!live.stderr().contains("panicked"), "{}", live.stderr());
    assert_eq!(live.stderr().lines().filter(|line| why(line)).count(), 1, "once: {}", live.stderr());
    let heard = live.heard();
    assert_eq!((heard.images, heard.end_us), (0, None), "control: the log had stopped before");
    let missing = heard.missing(&lab.sent(), live.recording_us, filled_us - 200_000);
    assert_eq!(missing.lost, 0, "{missing:?}");
}

#[test]
fn a_read_only_disk_is_refused_in_one_sentence() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "8", "--faults", "none", "--exposures", "0"]) else { return };
    let Some(mount) = Mount::tmpfs(&lab.kit.with_file_name("disk"), "ro,size=1m") else { return };
    let mut live = Live::launch(&lab.kit.join("session.json"), &mount.0.join("session"), &[]);
    let status = live.program.end(HANG_S).expect("ends");
    let words = live.stderr();
    assert_eq!(status.code(), Some(1), "{words}");
    assert!(words.to_lowercase().contains("read-only") && !words.contains("panicked"), "{words}");
}

#[test]
fn a_folder_that_is_deleted_is_said_while_the_session_goes_on() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "30", "--faults", "none", "--exposures", "0"]) else { return };
    let out = lab.kit.with_file_name("session");
    let mut live = Live::start(&lab.kit.join("session.json"), &out, &[]);
    std::fs::remove_dir_all(&out).expect("removed");
    let said = eventually(HANG_S, || live.stderr().contains("recording stopped").then_some(()));
    assert!(said.is_some(), "nobody said that the folder is gone: {}", live.stderr());
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("hangs: {}", live.stderr()));
    assert!(matches!(status.code(), Some(1 | 3)), "{status:?}");
    assert!(!live.stderr().contains("panicked"), "{}", live.stderr());
}

/// Another program cut the log short, the session ended with 0, and a replay found no frame.
#[test]
fn a_log_that_is_cut_short_is_said_while_the_session_goes_on() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "30", "--faults", "none", "--exposures", "0"]) else { return };
    let out = lab.kit.with_file_name("session");
    let mut live = Live::start(&lab.kit.join("session.json"), &out, &[]);
    let recorded = eventually(HANG_S, || std::fs::metadata(&live.log).is_ok_and(|log| log.len() > 20_000).then_some(()));
    assert!(recorded.is_some(), "{}", live.stderr());
    std::fs::OpenOptions::new().write(true).open(&live.log).and_then(|log| log.set_len(10_000)).expect("cut");
    let said = eventually(HANG_S, || live.stderr().contains("cut short while it was being written").then_some(()));
    assert!(said.is_some(), "nobody said that the log was cut: {}", live.stderr());
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("hangs: {}", live.stderr()));
    assert_eq!(status.code(), Some(3), "{}", live.stderr());
}

/// Where strips, DRRs, `pairs.json` and the report should be, something else stands: recording goes on to its end, each is said once and is a
/// loss, and a replay of the log makes all of it.
#[test]
fn files_that_cannot_be_written_do_not_end_the_recording_and_a_replay_makes_them() {
    let Some(lab) = Lab::start(&["--duration-s", "10", "--faults", "none", "--exposures", "2"]) else { return };
    let lab = lab.without_ct();
    let out = lab.kit.with_file_name("session");
    let mut live = Live::start(&lab.kit.join("session.json"), &out, &[]);
    for folder in ["strips", "drr"] {
        std::fs::rename(out.join(folder), out.join(format!("{folder}-away"))).expect("moved");
        std::fs::write(out.join(folder), "no folder").expect("written");
    }
    for file in ["pairs.json", "report.html"] {
        std::fs::create_dir(out.join(file)).expect("a folder in its place");
    }
    // Two frames come and cannot be drawn.
    let frames = eventually(HANG_S, || (live.heard().frames.len() >= 2).then_some(()));
    assert!(frames.is_some(), "the lab delivers: {}", live.stderr());
    let signal_us = host_now_us();
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("hangs: {}", live.stderr()));
    let heard = live.heard();
    let (strips, drrs) = made_again(&live, heard.images, &out.with_file_name("again"));
    let (stdout, stderr) = (live.stdout(), live.stderr());
    let words = format!("{stdout} {stderr}");
    assert!(heard.end_us.is_some() && heard.losses.is_empty(), "the recording ended early: {:?} {words}", heard.losses);
    assert_eq!(heard.missing(&lab.sent(), live.recording_us, signal_us).lost, 0, "{words}");
    assert!(heard.frames.len() >= 2, "{words}");
    assert_eq!(status.code(), Some(3), "{words}");
    assert!(!words.contains("panicked"), "{words}");
    assert!(strips == heard.images && drrs > 0, "{strips} strips and {drrs} DRRs of {} frames: {words}", heard.images);

    // The first of each is said while something can be done about it; what is not written after that is counted.
    for file in ["strips/", "drr/", "pairs.json"] {
        let start = format!("warning: {file}");
        let is_new = |line: &&str| line.starts_with(&start) && line.contains("is not written: ") && !line.contains("so far)");
        assert_eq!(stderr.lines().filter(is_new).count(), 1, "{file}: {words}");
    }
    let lost: Vec<&str> = stdout.lines().filter(|line| line.starts_with("lost: ")).collect();
    let others = format!(" and {} other files could not be written", strips + drrs - 1);
    for what in [others.as_str(), "pairs.json", "report.html"] {
        assert_eq!(lost.iter().filter(|line| line.contains(what)).count(), 1, "'{what}': {words}");
    }
    // It named the folder that stands in its place.
    assert!(stdout.contains("no report could be written"), "{words}");
}

/// Replays the log of a session of so many frames; how many strips and DRRs there are then.
fn made_again(live: &Live, frames: usize, again: &Path) -> (usize, usize) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let output = command.arg("replay").arg(&live.log).arg("--json").arg("--out").arg(again).output().expect("starts");
    let words = format!("{} {}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(0), "{words}");
    let told: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let pairs: Value = serde_json::from_slice(&std::fs::read(again.join("pairs.json")).expect("pairs")).expect("JSON");
    let report = std::fs::read_to_string(again.join("report.html")).expect("a report");
    let pairs = pairs["pairs"].as_array().expect("a list");
    assert!(told["frames"] == frames && pairs.len() == frames && report.contains("</html>"), "{words}");
    let written = |key: &str| {
        let named = pairs.iter().filter_map(|pair| pair[key].as_str());
        named.filter(|name| std::fs::metadata(again.join(name)).is_ok_and(|file| file.is_file() && file.len() > 0)).count()
    };
    let (strips, drrs) = (written("strip"), written("drr"));
    // The log had them, although the session could write none.
    assert!(told["images_identical"] == drrs && told["not_in_log"] == serde_json::json!([]), "{drrs} DRRs: {words}");
    (strips, drrs)
}

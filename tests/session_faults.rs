//! Sessions in a lab that goes wrong: losses are said and end in exit code 3, disks fail, and recording goes on or says at once why not.
#![cfg(unix)]

use std::path::{Path, PathBuf};
use std::process::Command;

use sidecarm::time::host_now_us;

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
    let Some(lab) = Lab::start(&["--duration-s", "12", "--faults", "none", "--exposures", "0", "--missing", "0.5"]) else {
        return;
    };
    let (live, code) = short_session(&lab, &lab.kit.join("session.json"));
    says_what_was_lost("half missing", &live, code, &["lost", "missing"]);
}

/// It was 259 300 messages of the wrong device, exit 0.
#[test]
fn swapped_ports_are_a_loss() {
    let Some(lab) = Lab::start(&["--duration-s", "12", "--faults", "none", "--exposures", "0"]) else { return };
    let session = lab.session("swapped.json", |session| {
        session["carm"]["port"] = "ttyROBOT".into();
        session["robot"]["port"] = "ttyCARM".into();
    });
    let (live, code) = short_session(&lab, &session);
    says_what_was_lost("swapped ports", &live, code, &["wrong device", "other device", "swapped"]);
}

#[test]
fn garbage_on_a_port_is_a_loss() {
    let Some(lab) = Lab::start(&["--duration-s", "12", "--faults", "none", "--exposures", "0", "--garbage", "robot"]) else {
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
        let Some(lab) = Lab::start(&["--duration-s", "12", "--faults", "none", "--exposures", "0"]) else { return };
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
    let Some(lab) = Lab::start(&["--duration-s", "20", "--faults", "robot:unplug@0.15", "--exposures", "0"]) else { return };
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
struct Mount(PathBuf);

impl Mount {
    fn tmpfs(at: &Path, options: &str) -> Option<Self> {
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

#[test]
fn a_full_disk_is_said_while_the_session_goes_on_and_the_log_stays_readable() {
    let Some(lab) = Lab::start(&["--duration-s", "30", "--faults", "none", "--exposures", "0"]) else { return };
    let Some(mount) = Mount::tmpfs(&lab.kit.with_file_name("disk"), "size=8m") else { return };
    let mut live = Live::start(&lab.kit.join("session.json"), &mount.0.join("session"), &[]);
    let filled_us = host_now_us();
    let ballast = vec![1u8; 16 << 20];
    let full = std::fs::write(mount.0.join("ballast"), ballast).expect_err("the disk is full");
    assert_eq!(full.kind(), std::io::ErrorKind::StorageFull);
    let said = eventually(HANG_S, || live.stderr().to_lowercase().contains("no space left").then_some(()));
    assert!(said.is_some(), "nobody said that the disk is full: {}", live.stderr());
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("hangs on a full disk: {}", live.stderr()));
    assert!(matches!(status.code(), Some(1 | 3)), "{status:?}");
    assert!(!live.stderr().contains("panicked"), "{}", live.stderr());
    let missing = live.heard().missing(&lab.sent(), live.recording_us, filled_us - 200_000);
    assert_eq!(missing.lost, 0, "{missing:?}");
}

#[test]
fn a_read_only_disk_is_refused_in_one_sentence() {
    let Some(lab) = Lab::start(&["--duration-s", "8", "--faults", "none", "--exposures", "0"]) else { return };
    let Some(mount) = Mount::tmpfs(&lab.kit.with_file_name("disk"), "ro,size=1m") else { return };
    let mut live = Live::launch(&lab.kit.join("session.json"), &mount.0.join("session"), &[]);
    let status = live.program.end(HANG_S).expect("ends");
    let words = live.stderr();
    assert_eq!(status.code(), Some(1), "{words}");
    assert!(words.to_lowercase().contains("read-only") && !words.contains("panicked"), "{words}");
}

#[test]
fn a_folder_that_is_deleted_is_said_while_the_session_goes_on() {
    let Some(lab) = Lab::start(&["--duration-s", "30", "--faults", "none", "--exposures", "0"]) else { return };
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
    let Some(lab) = Lab::start(&["--duration-s", "30", "--faults", "none", "--exposures", "0"]) else { return };
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

/// Where strips should be there is a file: pairs cannot be written, recording goes on to its end, and the loss is said.
#[test]
fn strips_that_cannot_be_written_do_not_end_the_recording() {
    let Some(lab) = Lab::start(&["--duration-s", "10", "--faults", "none"]) else { return };
    let out = lab.kit.with_file_name("session");
    let mut live = Live::start(&lab.kit.join("session.json"), &out, &[]);
    std::fs::rename(out.join("strips"), out.join("strips-away")).expect("moved");
    std::fs::write(out.join("strips"), "no folder").expect("written");
    // Two frames come and cannot be drawn.
    let frames = eventually(HANG_S, || (live.heard().frames.len() >= 2).then_some(()));
    assert!(frames.is_some(), "the lab delivers: {}", live.stderr());
    let signal_us = host_now_us();
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("hangs: {}", live.stderr()));
    let heard = live.heard();
    let words = format!("{} {}", live.stdout(), live.stderr());
    assert!(heard.end_us.is_some(), "the recording ended early: {words}");
    assert_eq!(heard.missing(&lab.sent(), live.recording_us, signal_us).lost, 0, "{words}");
    assert!(heard.frames.len() >= 2, "{words}");
    assert_eq!(status.code(), Some(3), "{words}");
    assert!(words.contains("strips") && !words.contains("panicked"), "{words}");
}

//! Disks that fill up, folders that are deleted or may not be written any more, and files that may not grow, while frames come, through `live`: it is
//! said within seconds, by the stamps of what was recorded last, and telemetry and frames go on.
#![cfg(target_os = "linux")]

use std::fs::{File, Permissions};
use std::os::fd::AsRawFd;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use sidecarm::time::host_now_us;

use crate::live_lab::{HANG_S, Heard, Lab, Live, Signal, copies, deliver, eventually, quiet_lab};
use crate::session_faults::Mount;

/// From the last packet in the log to the word that no more comes: whoever writes it finds out at the next write, or at its next look after four
/// tenths of a second, and a crowded machine may take its time.
const SAID_US: i64 = 5_000_000;
/// A burst that does not end before anything is said.
const FRAMES: usize = 60;

/// Delivers frames, three a second, until `fact` holds.
fn while_frames_come<T>(lab: &Lab, files: &[PathBuf], fact: impl FnMut() -> Option<T>) -> Option<T> {
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for file in files.iter().take_while(|_| !over.load(Ordering::Relaxed)) {
                deliver(std::slice::from_ref(file), lab);
                std::thread::sleep(Duration::from_millis(300));
            }
        });
        let found = eventually(HANG_S, fact);
        over.store(true, Ordering::Relaxed);
        found
    })
}

/// Whether the frame that came last was accepted; frames are numbered as they come, from one.
fn is_last_accepted(lab: &Lab, live: &Live) -> bool {
    let last = format!("frame {} (", lab.delivered().len());
    live.stderr().lines().any(|line| line.starts_with(&last) && line.contains(": accepted, "))
}

/// When recording was said to have stopped for this reason, while frames come.
fn stops(lab: &Lab, live: &Live, files: &[PathBuf], why: &str) -> i64 {
    let says = |line: &str| line.contains("go on without a log") && line.to_lowercase().contains(why);
    let said = while_frames_come(lab, files, || live.stderr().lines().any(says).then(host_now_us));
    said.unwrap_or_else(|| panic!("nobody says that recording stopped ({why}): {}", live.stderr()))
}

/// That what `log` holds goes on until shortly before it was said that recording had stopped.
fn was_said_soon(log: &Path, said_us: i64, live: &Live) {
    let last_us = Heard::of(log).packets.values().max().copied().expect("packets");
    let after_ms = (said_us - last_us) / 1000;
    println!("said {after_ms} ms after the last packet in the log");
    assert!(said_us - last_us <= SAID_US, "said {after_ms} ms after the last packet in the log: {}", live.stderr());
}

/// Frames have their poses, which stand nowhere but on the screen, and the session ends when it is asked to.
fn goes_on_and_ends(lab: &Lab, live: &mut Live, frame: &Path) {
    deliver(&[frame.to_owned()], lab);
    // Those that came before may still be posed when it comes: they show nothing.
    let posed = eventually(HANG_S, || is_last_accepted(lab, live).then_some(()));
    assert!(posed.is_some(), "no frame is posed any more: {}", live.stderr());
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("hangs: {}", live.stderr()));
    assert!(matches!(status.code(), Some(1 | 3)), "{status:?} {}", live.stderr());
    assert!(!live.stderr().contains("panicked"), "{}", live.stderr());
}

/// A lab, and frames of which the last is kept for later.
fn lab_with_frames() -> Option<(Lab, Vec<PathBuf>, PathBuf, tempfile::TempDir)> {
    let (lab, frame, folder) = quiet_lab("300")?;
    let mut files = copies(&frame, FRAMES, &folder.path().join("copies"));
    let last = files.pop().expect("frames");
    Some((lab.without_ct(), files, last, folder))
}

#[test]
fn a_disk_that_fills_up_while_frames_come_is_said_within_seconds() {
    let Some((lab, files, last, _folder)) = lab_with_frames() else { return };
    let Some(mount) = Mount::tmpfs(&lab.kit.with_file_name("disk"), "size=16m") else { return };
    let mut live = Live::start(&lab.kit.join("session.json"), &mount.0.join("session"), &[]);
    let full = std::fs::write(mount.0.join("ballast"), vec![1u8; 32 << 20]).expect_err("the disk is full");
    assert_eq!(full.kind(), std::io::ErrorKind::StorageFull);
    let said_us = stops(&lab, &live, &files, "no space left");
    was_said_soon(&live.log, said_us, &live);
    goes_on_and_ends(&lab, &mut live, &last);
}

#[test]
fn a_folder_that_is_deleted_while_frames_come_is_said_within_seconds() {
    let Some((lab, files, last, folder)) = lab_with_frames() else { return };
    let out = folder.path().join("session");
    let mut live = Live::start(&lab.kit.join("session.json"), &out, &[]);
    // What is deleted can be read as long as somebody has it open.
    let kept = File::open(&live.log).expect("the log");
    let deleted = eventually(HANG_S, || {
        // Files are written into it meanwhile.
        let _ = std::fs::remove_dir_all(&out);
        (!out.exists()).then_some(())
    });
    assert!(deleted.is_some(), "it is deleted");
    let said_us = stops(&lab, &live, &files, "the log was deleted");
    was_said_soon(Path::new(&format!("/proc/self/fd/{}", kept.as_raw_fd())), said_us, &live);
    goes_on_and_ends(&lab, &mut live, &last);
}

/// Needs no root: the system refuses what goes beyond a file's limit, as a quota does.
#[test]
fn a_log_that_may_not_grow_any_more_is_said_within_seconds() {
    let lab = ["--duration-s", "120", "--faults", "none", "--exposures", "0", "--linger-s", "30", "--rate", "10"];
    let (Some(lab), Some((_, frame, folder))) = (Lab::start_without_ct(&lab), quiet_lab("30")) else { return };
    let mut files = copies(&frame, FRAMES, &folder.path().join("copies"));
    let last = files.pop().expect("frames");
    let mut live = Live::with_small_files(&lab.kit.join("session.json"), &folder.path().join("session"), 4000).recording();
    let said_us = stops(&lab, &live, &files, "file too large");
    was_said_soon(&live.log, said_us, &live);
    goes_on_and_ends(&lab, &mut live, &last);
}

/// Folders that may be written by nobody, until this is dropped.
struct Locked(Vec<PathBuf>);

impl Locked {
    fn of(folders: Vec<PathBuf>) -> Self {
        let locked = Self(folders);
        locked.set(0o555);
        locked
    }

    fn set(&self, mode: u32) {
        for folder in &self.0 {
            std::fs::set_permissions(folder, Permissions::from_mode(mode)).expect("it is ours");
        }
    }
}

impl Drop for Locked {
    fn drop(&mut self) {
        self.set(0o755);
    }
}

/// What is open can be written on: the log goes on, and what cannot be written beside it is said and made by a replay.
#[test]
fn a_folder_that_becomes_read_only_while_frames_come_costs_what_is_beside_the_log() {
    let Some((lab, files, _, folder)) = lab_with_frames() else { return };
    let out = folder.path().join("session");
    let mut live = Live::start(&lab.kit.join("session.json"), &out, &[]);
    let locked = Locked::of(vec![out.join("strips"), out.join("drr"), out.clone()]);
    if File::create(out.join("probe")).is_ok() {
        println!("skipped: this user may write anywhere (root)");
        return;
    }
    let says = |line: &str| line.starts_with("warning: ") && line.contains("is not written: ");
    let said_us = while_frames_come(&lab, &files, || live.stderr().lines().any(says).then(host_now_us));
    let said_us = said_us.unwrap_or_else(|| panic!("nobody says that files cannot be written: {}", live.stderr()));
    let later = eventually(HANG_S, || live.heard().packets.values().any(|host_us| *host_us > said_us).then_some(()));
    assert!(later.is_some() && !live.stderr().contains("recording stopped"), "the log goes on: {}", live.stderr());
    let signal_us = live.signalled(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("hangs: {}", live.stderr()));
    drop(locked);
    let (heard, words) = (live.heard(), format!("{} {}", live.stdout(), live.stderr()));
    assert!(status.code() == Some(3) && !words.contains("panicked"), "{status:?} {words}");
    assert!(heard.end_us.is_some() && heard.losses.is_empty() && heard.images > 0, "{:?} {words}", heard.losses);
    let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
    assert_eq!(missing.lost, 0, "{missing:?} {words}");
    assert!(words.contains("a replay of the log makes what is missing"), "{words}");
}

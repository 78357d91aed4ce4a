//! Commands that a signal ends while they write: nothing half-written is left, and no helper process.
#![cfg(target_os = "linux")]

use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::Duration;

use sidecarm::record::{Provenance, Recorder};
use sidecarm::time::Stopwatch;

use crate::live_lab::{HANG_S, Running, Signal, eventually};
use crate::telemetry_frames::plain;

/// Gone within a tenth of a second where nothing else runs; so long on a crowded machine, before it is killed by itself.
const GONE_MS: f64 = 4_000.0;
/// A command that was done before it was stopped is begun again.
const TRIES: usize = 10;
const PACKETS: u32 = 40_000;
/// What `log csv` writes.
const TABLES: usize = 6;

/// A log whose tables take a while.
fn long_log(folder: &Path) -> PathBuf {
    let path = folder.join("long.mcap");
    let provenance = Provenance::of_this_program(1_000_000, serde_json::Value::Null);
    let recorder = Recorder::create(&path, &provenance).expect("a log");
    for number in 0..PACKETS {
        recorder.raw_bytes("carm", 1, 1_000_000 + i64::from(number) * 10_000, &plain(number)).expect("recorded");
        if number % 1_000 == 999 {
            recorder.flush_now(Duration::from_secs(60)).expect("written");
        }
    }
    recorder.finish().expect("finished");
    path
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

fn unnamed(folder: &Path) -> usize {
    names(folder).iter().filter(|name| name.starts_with(".sidecarm-")).count()
}

/// `sidecarm log csv` that stands still in the middle of its tables, started by `shell` where one is given, and the folder of these.
fn stopped(log: &Path, shell: Option<&str>) -> (Running, PathBuf) {
    for attempt in 0..TRIES {
        let out = log.with_file_name(format!("tables-{attempt}"));
        let mut command = match shell {
            Some(words) => {
                let mut command = Command::new("sh");
                command.args(["-c", words, "sh", env!("CARGO_BIN_EXE_sidecarm")]);
                command
            }
            None => Command::new(env!("CARGO_BIN_EXE_sidecarm")),
        };
        command.args(["log", "csv"]).arg(log).arg("--out").arg(&out).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut running = Running(command.spawn().expect("starts"));
        let begun = || (unnamed(&out) == TABLES).then_some(true).or_else(|| running.0.try_wait().expect("asked").map(|_| false));
        if eventually(HANG_S, begun) == Some(true) {
            running.signal(Signal::STOP);
            std::thread::sleep(Duration::from_millis(20));
            if running.0.try_wait().expect("asked").is_none() && unnamed(&out) == TABLES {
                return (running, out);
            }
        }
        let _ = std::fs::remove_dir_all(&out);
    }
    panic!("the tables were done {TRIES} times before they were seen");
}

/// Lets a stopped command go on with a signal; how it ended, what it said, and after how many milliseconds it was gone.
fn ended_by(mut running: Running, signal: Signal) -> (ExitStatus, String, f64) {
    let watch = Stopwatch::start();
    running.signal(signal);
    running.signal(Signal::CONT);
    let status = running.end(HANG_S).expect("it goes on");
    let ms = watch.ms();
    let mut said = String::new();
    let mut err = running.0.stderr.take().expect("a pipe");
    std::io::Read::read_to_string(&mut err, &mut said).expect("text");
    (status, said, ms)
}

/// Each left files named `.sidecarm-…` beside what it was asked for.
#[test]
fn a_command_that_a_signal_ends_leaves_nothing_half_written() {
    // Whoever runs the tests in the background of a shell has them ignore Ctrl-C.
    let status = std::fs::read_to_string("/proc/self/status").expect("its status");
    let mask =
        status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok()).expect("a mask");
    let folder = tempfile::tempdir().expect("a folder");
    let log = long_log(folder.path());
    let mut cases = 0;
    for (signal, number) in [(Signal::HUP, 1), (Signal::INT, 2), (Signal::TERM, 15)] {
        if mask & (1u64 << (number - 1)) != 0 {
            continue;
        }
        let (running, out) = stopped(&log, None);
        let (status, said, ms) = ended_by(running, signal);
        println!("{signal:?}: gone after {ms:.0} ms");
        // Of the signal itself: a shell ends the loop in which it runs the program, and makes it 128 and the number.
        assert_eq!(status.signal(), Some(number), "{signal:?}: {said}");
        assert_eq!(names(&out), Vec::<String>::new(), "{signal:?}: {said}");
        assert!(said.lines().count() == 1 && said.contains("nothing half-written is left"), "{signal:?}: {said}");
        assert!(ms <= GONE_MS, "{signal:?}: gone after {ms:.0} ms, {GONE_MS} allowed");
        std::fs::remove_dir(&out).expect("empty");
        cases += 1;
    }
    assert!(cases > 0);
    // The control: what nobody removes is there.
    let (running, out) = stopped(&log, None);
    let (status, said, _) = ended_by(running, Signal::KILL);
    assert_eq!((status.signal(), unnamed(&out)), (Some(9), TABLES), "{said}");
}

/// `nohup` and a shell's background mean that the command goes on.
#[test]
fn a_signal_that_was_to_be_ignored_is_ignored() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = long_log(folder.path());
    let (running, out) = stopped(&log, Some("trap '' HUP; exec \"$@\""));
    let (status, said, _) = ended_by(running, Signal::HUP);
    // A log of a few bytes of one device may lack what a session has.
    assert!(matches!(status.code(), Some(0 | 3)), "{status:?} {said}");
    assert_eq!((names(&out).len(), unnamed(&out)), (TABLES, 0), "{said}");
    std::fs::remove_dir_all(&out).expect("removed");
    // The control: it is ended by another one.
    let (running, out) = stopped(&log, Some("trap '' HUP; exec \"$@\""));
    let (status, said, _) = ended_by(running, Signal::TERM);
    assert_eq!((status.signal(), names(&out).len()), (Some(15), 0), "{said}");
}

/// A helper that was long at a file went on after the program that wanted it had gone: of a CT, for three minutes of a processor.
#[test]
fn a_helper_ends_when_nobody_hears_it() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let command = command.arg("read-foreign").stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut helper = Running(command.spawn().expect("starts"));
    // It waits for a request, as it would work on one.
    assert!(helper.end(0.5).is_none(), "the control: it goes on while it is heard");
    drop(helper.0.stdout.take());
    assert!(helper.end(HANG_S).is_some_and(|status| status.code() == Some(1)), "it goes on unheard");
    assert!(helper.0.stdin.is_some(), "it was not the end of its input");
}

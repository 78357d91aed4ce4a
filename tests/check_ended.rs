//! `sidecarm check` that ends before its checks have: nothing of it is left.
#![cfg(all(unix, feature = "vision"))]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::live_lab::{HANG_S, Running, Signal, eventually};

/// The check of a session whose video does not come, as from a pipe that nobody opens, and the folder of its temporary files.
fn hanging(folder: &Path, limit_s: &str) -> (Command, PathBuf) {
    let (pipe, temporary) = (folder.join("monitor.y4m"), folder.join("temporary"));
    assert!(Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
    for path in [&folder.join("frames"), &temporary] {
        std::fs::create_dir(path).expect("a folder");
    }
    std::fs::write(folder.join("scene.json"), "{}").expect("written");
    let session = serde_json::json!({"frames": {"folder": "frames", "video": {"from": pipe}}, "scene": "scene.json"});
    std::fs::write(folder.join("session.json"), session.to_string()).expect("written");
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("check").arg(folder.join("session.json")).args(["--limit", limit_s]).env("TMPDIR", &temporary);
    (command, temporary)
}

fn listed(folder: &Path) -> Vec<PathBuf> {
    std::fs::read_dir(folder).expect("listed").flatten().map(|entry| entry.path()).collect()
}

/// Starts it and waits until a check has made a temporary folder.
fn at_work(command: &mut Command, temporary: &Path) -> Running {
    let check = Running(command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("starts"));
    let wanted = eventually(HANG_S, || listed(temporary).iter().any(|own| !listed(own).is_empty()).then_some(()));
    assert!(wanted.is_some(), "no check wanted a temporary folder");
    check
}

/// What it says until its end, and its exit code.
fn ended(mut check: Running) -> (String, Option<i32>) {
    let status = check.end(HANG_S).expect("it goes on");
    let mut said = String::new();
    let mut out = check.0.stdout.take().expect("a pipe");
    std::io::Read::read_to_string(&mut out, &mut said).expect("text");
    (said, status.code())
}

/// The temporary folder of the check that was still at work was left.
#[test]
fn a_check_that_gives_up_leaves_no_temporary_files() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut command, temporary) = hanging(folder.path(), "3");
    let (said, _) = ended(at_work(&mut command, &temporary));
    assert!(said.contains("pass  session file") && said.contains("not all checks were done within 3 s"), "{said}");
    assert_eq!(listed(&temporary), Vec::<PathBuf>::new(), "{said}");
}

/// Whoever logged out ended what was to go on without a terminal.
#[test]
fn a_check_under_nohup_hears_nothing_of_its_terminal_s_end() {
    let folder = tempfile::tempdir().expect("a folder");
    let (command, temporary) = hanging(folder.path(), "3");
    let mut under = Command::new("sh");
    under.args(["-c", "trap '' HUP; exec \"$@\"", "sh"]).arg(command.get_program()).args(command.get_args());
    let check = at_work(under.env("TMPDIR", &temporary), &temporary);
    check.signal(Signal::HUP);
    let (said, _) = ended(check);
    assert!(said.contains("not all checks were done within 3 s"), "{said}");
}

/// Ctrl-C killed it where it was, and its temporary folder was left.
#[test]
fn ctrl_c_ends_a_check_with_what_it_found_and_without_temporary_files() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut command, temporary) = hanging(folder.path(), "1000");
    let check = at_work(&mut command, &temporary);
    check.signal(Signal::INT);
    let (said, code) = ended(check);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("pass  session file") && said.contains("ended before all checks were done"), "{said}");
    assert_eq!(listed(&temporary), Vec::<PathBuf>::new(), "{said}");
}

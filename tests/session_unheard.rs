//! Sessions and commands to which nobody listens, and what a report says of a port that is not there.
#![cfg(unix)]

use std::process::{Command, Stdio};

use rustix::process::{Pid, kill_process};
use serde_json::json;

use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually, pairs_in};

/// The writing end of a pipe that nobody reads.
fn closed() -> Stdio {
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    writer.into()
}

/// A terminal that is closed, `| head`, a full disk under a redirection: the session ended with whoever listened.
#[test]
fn a_session_goes_on_when_nobody_listens_any_more() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "8", "--exposures", "3", "--faults", "none"]) else { return };
    let out = lab.kit.with_file_name("session");
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("live").arg(lab.kit.join("session.json")).arg("--out").arg(&out).args(["--headless", "--include-existing"]);
    let mut live = command.stdin(Stdio::null()).stdout(closed()).stderr(closed()).spawn().expect("the program starts");
    let pairs = || pairs_in(&out);
    assert!(eventually(HANG_S, || (pairs() >= 3).then_some(())).is_some(), "{} pairs: {:?}", pairs(), live.try_wait());
    kill_process(Pid::from_child(&live), Signal::INT).expect("it goes on");
    let ended = eventually(HANG_S, || live.try_wait().expect("a child can be asked")).expect("it ends");
    // 3: on a crowded machine the first exposure may be over before the lines are open.
    assert!(matches!(ended.code(), Some(0 | 3)), "{ended:?}");
    let report = std::fs::read_to_string(out.join("report.html")).expect("a report");
    assert!(report.contains("frame-003") || report.matches("<img").count() >= 3, "three frames");
    let log = sidecarm::record::read_log(&out.join("session.mcap")).expect("the log opens");
    assert!(log.losses.is_empty() && log.entries.iter().any(|entry| &*entry.topic == "/session/end"), "{:?}", log.losses);
}

#[test]
fn commands_end_without_a_fault_when_nobody_listens() {
    let ran = |stdout: Stdio, stderr: Stdio, args: &[&str]| {
        let run = Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(args).stdout(stdout).stderr(stderr).output();
        let run = run.expect("the program starts");
        (run.status.code(), String::from_utf8_lossy(&run.stderr).into_owned())
    };
    // What is said on standard error changes nothing.
    assert_eq!(ran(Stdio::piped(), closed(), &["info", "nowhere.dcm"]).0, Some(1));
    let (code, words) = ran(closed(), Stdio::piped(), &["materials"]);
    assert!(code.is_some_and(|code| code < 3) && !words.contains("fault"), "{code:?} {words}");
    if let Ok(full) = std::fs::OpenOptions::new().write(true).open("/dev/full") {
        let (code, words) = ran(full.into(), Stdio::piped(), &["devices", "--json"]);
        assert!(code == Some(1) && words.contains("standard output cannot be written"), "{code:?} {words}");
    }
}

#[test]
fn a_report_names_no_folder_of_a_port_that_is_not_there() {
    let Some(lab) = Lab::start(&["--duration-s", "8", "--exposures", "0", "--faults", "none", "--linger-s", "20"]) else {
        return;
    };
    let lab = lab.without_ct();
    let session = lab.session("named.json", |session| session["carm"]["port"] = json!("Quaxwelk/ttyCARM"));
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &["--seconds", "5"]);
    assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());
    assert!(live.stderr().contains("Quaxwelk"), "on screen it is named: {}", live.stderr());
    let report = live.report();
    assert!(report.contains("C-arm line not open") && !report.contains("Quaxwelk"), "{report}");
}

//! What the robot's line says that cannot be, through `live`.
#![cfg(unix)]

use serde_json::Value;

use crate::lab_truth::wait_for_pairs;
use crate::live_lab::{HANG_S, Lab, Live, Signal};

/// Angles beyond what the robot can bend were drawn at its limit without a word.
#[test]
fn a_robot_that_reports_more_than_it_can_bend_is_said() {
    let lab = ["--duration-s", "8", "--faults", "none", "--exposures", "2", "--idle-s", "300"];
    let Some(lab) = Lab::start(&lab) else { return };
    let lab = lab.without_ct();
    // The same room with a robot that bends less than its line reports.
    let model = lab.kit.join("robot.json");
    let mut robot: Value = serde_json::from_slice(&std::fs::read(&model).expect("the model")).expect("JSON");
    let limit = robot["max_bend_deg"].as_f64().expect("a limit");
    robot["max_bend_deg"] = (0.01 * limit).into();
    std::fs::write(&model, robot.to_string()).expect("written");
    let folder = tempfile::tempdir().expect("temporary folder");
    let out = folder.path().join("out");
    let mut live = Live::start(&lab.kit.join("session.json"), &out, &["--include-existing"]);
    wait_for_pairs(&live, 2);
    live.signalled(Signal::INT);
    live.program.end(HANG_S).expect("it ends");
    let pairs: Value = serde_json::from_slice(&std::fs::read(out.join("pairs.json")).expect("pairs")).expect("JSON");
    let flags = pairs["pairs"].to_string();
    let words = "notches of the robot were clamped";
    assert!(flags.contains(words), "{flags}\n{}", live.stderr());
    assert!(live.stderr().contains(words), "it is a warning too: {}", live.stderr());
}

//! Devices that can no longer be heard, through `live`: what has cost frames their telemetry is a loss, and is said while it happens.

use serde_json::Value;

use crate::live_lab::{HANG_S, Lab, Live};
use crate::log_lab::replay;

/// Plays a session with `faults`; the exit code, what was printed, the report.
fn played(faults: &str) -> Option<(Option<i32>, String, String)> {
    let lab = Lab::start(&["--duration-s", "9", "--faults", faults, "--exposures", "4", "--linger-s", "5"])?.without_ct();
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut live = Live::launch(&lab.kit.join("session.json"), &folder.path().join("out"), &["--seconds", "11"]);
    let code = live.program.end(HANG_S).expect("it ends").code();
    Some((code, live.stderr(), live.report()))
}

/// Frames stayed unbound, the report said that nothing was lost, and the program ended with 0.
#[test]
fn a_device_that_cannot_be_heard_is_said_at_once_and_costs_what_it_costs() {
    let (unheard, without) = ("nothing to be used from the C-arm for 3 s", "frames that came meanwhile have no telemetry of it");
    // What is played, what is said while it happens, what the report says was lost.
    let cases: [(&str, &[&str], Option<&str>); 8] = [
        ("carm:mute@0.3", &[unheard], Some(without)),
        ("carm:gone@0.3", &[unheard], Some(without)),
        ("carm:freeze@0.3", &["the C-arm's clock stands still"], Some("C-arm: its clock stood still for")),
        ("carm:stuck@0.3", &["the C-arm's clock stands still"], Some("C-arm: its clock stood still for")),
        (
            "carm:millis@0",
            &["the C-arm's clock advances", "where 1 s passes", "does it send milliseconds?"],
            Some("C-arm: its clock advanced"),
        ),
        ("robot:mute@0.3", &["nothing to be used from the robot for 3 s"], Some("robot: silent for")),
        (
            "robot:restart@0.5,carm:jump@0.4",
            &["the robot began anew, with its clock and all that it counts", "the C-arm's clock jumped by +"],
            None,
        ),
        // The control: what is no silence and no step.
        ("carm:reorder@0,robot:mute@0.99", &[], None),
    ];
    // Two at a time: three labs on two cores would hear each other.
    cases.chunks(2).for_each(|cases| {
        std::thread::scope(|scope| {
            let runs: Vec<_> = cases.iter().map(|case| (case, scope.spawn(move || played(case.0)))).collect();
            for ((faults, said, lost), run) in runs {
                let Some((code, words, report)) = run.join().expect("played") else { return };
                let all = format!("{faults}: exit code {code:?}\n{words}");
                assert!(said.iter().all(|said| words.contains(said)), "{all}");
                let any = ["began anew", "clock jumped", "nothing to be used", "stands still", "clock advances"];
                assert!(!said.is_empty() || !any.iter().any(|any| words.contains(any)), "{all}");
                match lost {
                    Some(lost) => assert!(code == Some(3) && report.contains(lost), "{all}\n{report}"),
                    // A crowded machine may lose packets, which is said as such.
                    None => {
                        let jumped = faults.contains("jump");
                        assert_eq!(steps_of(&report, "carm"), Some(u64::from(jumped)), "{all}\n{report}");
                        let silent = ["silent for", "not one packet", "stood still"].iter().any(|words| report.contains(words));
                        assert!(!silent && report.contains("Losses"), "{all}\n{report}");
                    }
                }
            }
        })
    });
}

/// Frames that counted on while all that the arm measured was frozen were asked to be pictures of another day or another room.
#[test]
fn an_arm_whose_counter_stands_still_while_frames_count_on_is_asked_after() {
    // Between the third exposure and the fourth.
    let faults = "carm:stale@0.34";
    let lab = ["--duration-s", "12", "--faults", faults, "--exposures", "6", "--await-all", "--linger-s", "8"];
    let Some(lab) = Lab::start_without_ct(&lab) else { return };
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut live = Live::launch(&lab.kit.join("session.json"), &folder.path().join("out"), &["--seconds", "15"]);
    let code = live.program.end(HANG_S).expect("it ends").code();
    let words = format!("exit code {code:?}\n{}\n{}", live.stdout(), live.stderr());
    let stood = "count on where the C-arm's counter has stood still at 3";
    assert!(live.stderr().contains(&format!("3 frames {stood}")), "while it happens: {words}");
    assert!(live.stdout().contains(&format!("3 frames {stood}")), "in the end: {words}");
    assert!(!words.contains("another day or another room"), "{words}");
    let pairs: Value = serde_json::from_slice(&std::fs::read(live.out.join("pairs.json")).expect("pairs")).expect("JSON");
    let pairs = pairs["pairs"].as_array().expect("a list");
    assert_eq!(pairs.len(), 6, "{words}");
    for (pair, counter) in pairs.iter().zip(1..) {
        let said =
            pair["flags"].to_string().contains(&format!("the frame counts {counter}, and the C-arm's counter stood still at 3"));
        assert_eq!((said, pair["binding"] == "none"), (counter > 3, counter > 3), "{pair:#} {words}");
    }
}

/// Another C-arm behind the port was a warning: the session ended with 0, and its report said that nothing was lost.
#[test]
fn another_device_in_the_place_of_the_first_is_a_loss() {
    for (faults, device) in [("carm:other@0.4", Some("C-arm")), ("robot:other@0.4", Some("robot")), ("none", None)] {
        let lab = ["--duration-s", "6", "--faults", faults, "--exposures", "2", "--linger-s", "5"];
        let Some(lab) = Lab::start_without_ct(&lab) else { return };
        let folder = tempfile::tempdir().expect("temporary folder");
        let mut live = Live::launch(&lab.kit.join("session.json"), &folder.path().join("out"), &["--seconds", "8"]);
        let code = live.program.end(HANG_S).expect("it ends").code();
        let (words, told) =
            (format!("{faults}: exit code {code:?}\n{}{}", live.stdout(), live.stderr()), "is another one than before");
        let lost = |text: &str| text.lines().filter(|line| line.contains("lost: the ") && line.contains(told)).count();
        assert_eq!(lost(&words), usize::from(device.is_some()), "{words}");
        // Of two devices the one that it is; of nobody the number.
        let report = live.report();
        let losses = report.split("Losses").nth(1).and_then(|rest| rest.split("Warnings").next()).expect("the report's list");
        assert!(device.is_none_or(|device| code == Some(3) && losses.contains(&format!("the {device} {told}"))), "{words}");
        assert!(!report.contains("-OTHER") && !words.contains("-OTHER"), "{words}");
        // The log tells of it as well: a replay says the same.
        let (_, replayed) = replay(&live.log, &lab.kit, &folder.path().join("replayed"));
        let again = replayed["session_losses"].as_array().expect("a list").iter().filter_map(|loss| loss.as_str());
        assert_eq!(again.filter(|loss| loss.contains(told)).count(), usize::from(device.is_some()), "{replayed:#}");
    }
}

/// Steps of the device's clock, as the report's table of links has them.
pub fn steps_of(report: &str, device: &str) -> Option<u64> {
    let head = report.split("<th class=\"l\">link</th>").nth(1)?;
    let column = head.split("</tr>").next()?.split("<th>").position(|name| name.starts_with("clock_steps"))?;
    let row = head.split(&format!("<td class=\"l\">{device}</td>")).nth(1)?;
    row.split("<td>").nth(column)?.split('<').next()?.parse().ok()
}

/// The console wrote into another folder than the session watched: exit code 0, and the report said that nothing was lost.
#[test]
fn exposures_without_a_frame_are_said() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "8", "--faults", "none", "--exposures", "2"]) else { return };
    std::fs::create_dir(lab.kit.join("elsewhere")).expect("made");
    let session = lab.session("elsewhere.json", |session| session["frames"]["folder"] = "elsewhere".into());
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut live = Live::launch(&session, &folder.path().join("out"), &["--seconds", "8"]);
    let code = live.program.end(HANG_S).expect("it ends").code();
    let words = live.stderr();
    assert!(words.contains("2 of 2 exposures have no frame (exposure 1, exposure 2)"), "{code:?} {words}");
    assert!(live.report().contains("exposures have no frame"), "it stands in the report");
    assert!(code == Some(3) && live.report().contains("2 exposures, and no frame came"), "{code:?} {words} {}", live.stdout());
}

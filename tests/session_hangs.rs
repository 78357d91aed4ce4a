//! Parts of a session that hang, because they are asked to (`src/session/fault.rs`, which only a build with debug assertions hears): each is said
//! while it does, telemetry is recorded, Ctrl-C ends the session, and a hang that is over costs nothing.
#![cfg(all(unix, debug_assertions))]

use std::path::Path;

use sidecarm::record::{read_log, topic};
use sidecarm::time::host_now_us;

use crate::live_lab::{HANG_S, Lab, Live, Signal, copies, deliver, eventually, quiet_lab};

/// A part of a session.
struct Part {
    /// As it is asked to hang.
    name: &'static str,
    /// What its warnings are counted as.
    kind: &'static str,
    /// What is said of it, up to the seconds that it has taken.
    said: &'static str,
    /// What is lost where it hangs to the end.
    lost: &'static str,
}

/// In the order in which a frame comes to them.
const PARTS: [Part; 4] = [
    Part {
        name: "folder",
        kind: "frame folder slow",
        said: "the frame folder does not answer (",
        lost: "the frame folder did not answer at the end: attach what came into it meanwhile",
    },
    Part {
        name: "register",
        kind: "registration slow",
        said: "registering it takes long (",
        lost: "left at once: 1 frames were not finished",
    },
    Part {
        name: "render",
        kind: "rendering slow",
        said: "making its DRR takes long (",
        lost: "left at once: 1 frames were not finished",
    },
    Part {
        name: "strip",
        kind: "writing slow",
        said: "writing its files takes long (",
        lost: "the thread that writes files stands still; a replay of the log makes what is missing",
    },
];

/// After how many seconds of its work each warning of the part came, as it says itself.
fn said_after_s(part: &Part, words: &str) -> Vec<u64> {
    let seconds = |line: &str| line.strip_prefix("warning: ")?.split(part.said).nth(1)?.split(' ').next()?.parse().ok();
    words.lines().filter_map(seconds).collect()
}

/// Waits for a fact, or says what never came and what the program said.
fn waits(live: &Live, what: &str, mut fact: impl FnMut() -> bool) {
    let found = eventually(HANG_S, || fact().then_some(()));
    assert!(found.is_some(), "never: {what}: {}", live.stderr());
}

fn is_said(live: &Live, part: &Part) -> bool {
    !said_after_s(part, &live.stderr()).is_empty()
}

fn hanging(lab: &Lab, out: &Path, breaks: &str) -> Live {
    Live::breaking(&lab.kit.join("session.json"), out, breaks).recording()
}

/// The terminal said it after three to four seconds, the report after twelve.
#[test]
fn a_part_that_hangs_is_said_once_while_all_else_goes_on_and_then_its_frame_is_finished() {
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let lab = lab.without_ct();
    let files = copies(&frame, 2, &folder.path().join("copies"));
    let breaks = PARTS.each_ref().map(|part| format!("{}:2500", part.name)).join(",");
    let mut live = hanging(&lab, &folder.path().join("session"), &breaks);
    let strips = [1, 2].map(|number| live.out.join(format!("strips/{number:03}.png")));
    deliver(&files[..1], &lab);
    for (place, part) in PARTS.iter().enumerate() {
        waits(&live, part.said, || is_said(&live, part));
        // It hangs still; and the control: nothing is said of those to which the frame has not come.
        assert!(!strips[0].exists(), "{} is over: {}", part.name, live.stderr());
        let early: Vec<&str> = PARTS[place + 1..].iter().filter(|part| is_said(&live, part)).map(|part| part.name).collect();
        assert!(early.is_empty(), "{early:?} said while the {} hangs: {}", part.name, live.stderr());
    }
    waits(&live, "the first frame's strip", || strips[0].exists());
    deliver(&files[1..], &lab);
    waits(&live, "the second frame's strip", || strips[1].exists() && live.pairs() == 2);
    let signal_us = live.signalled(Signal::INT);
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();

    let (words, report, heard) = (live.stderr(), live.report(), live.heard());
    assert!(live.lacks_exposures_alone(code), "{code:?} {} {words}", live.stdout());
    assert!(heard.end_us.is_some() && heard.losses.is_empty(), "{:?} {words}", heard.losses);
    let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
    assert!(missing.sent > 500 && missing.lost == 0, "{missing:?}");
    let log = read_log(&live.log).expect("the log opens");
    let events: Vec<_> = log.entries.iter().filter(|entry| &*entry.topic == topic::EVENTS).collect();
    for part in &PARTS {
        let after_s = said_after_s(part, &words);
        // It was 3 s; a machine that gives no core for a second is forgiven.
        assert!(matches!(after_s.as_slice(), [1 | 2]), "{}: said after {after_s:?} s: {words}", part.name);
        assert!(report.contains(part.kind), "{}: not in the report: {words}", part.name);
        let logged = events.iter().filter(|event| String::from_utf8_lossy(&event.data).contains(part.said)).count();
        assert_eq!(logged, 1, "{}: {words}", part.name);
    }
}

/// A folder whose server was gone held up the end of its session until a second Ctrl-C, and a disk that stood still for ten seconds after that.
#[test]
fn ctrl_c_ends_a_session_of_which_a_part_hangs_for_ever() {
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let lab = lab.without_ct();
    let files = copies(&frame, PARTS.len(), &folder.path().join("copies"));
    for (part, file) in PARTS.iter().zip(&files) {
        let is_folder = part.name == "folder";
        let mut live = hanging(&lab, &folder.path().join(part.name), &format!("{}:3600000", part.name));
        deliver(std::slice::from_ref(file), &lab);
        waits(&live, part.said, || is_said(&live, part));
        let said_us = host_now_us();
        waits(&live, "telemetry after that", || live.heard().packets.values().any(|host_us| *host_us > said_us));
        let signal_us = live.signalled(Signal::INT);
        // One is enough where nothing is there to be finished.
        if !is_folder {
            waits(&live, "the end of what comes in", || live.stderr().contains("Ctrl-C again leaves at once"));
            live.program.signal(Signal::INT);
        }
        let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("{}: still there: {}", part.name, live.stderr())).code();

        let words = format!("{}: exit code {code:?}: {} {}", part.name, live.stdout(), live.stderr());
        assert!(code == Some(3) && !words.contains("left without a report"), "{words}");
        assert!(live.stdout().contains(&format!("lost: {}", part.lost)), "{words}");
        assert_eq!(live.report().contains(part.kind), part.name != "strip", "who hangs writes no report: {words}");
        let heard = live.heard();
        assert!(heard.end_us.is_some() && heard.losses.is_empty(), "{:?} {words}", heard.losses);
        assert_eq!(heard.images, usize::from(!is_folder), "{words}");
        let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
        assert!(missing.sent > 0 && missing.lost == 0, "{missing:?} {words}");
    }
}

/// The program heard no Ctrl-C while it listed a folder that did not answer.
#[test]
fn a_folder_that_does_not_answer_at_the_start_is_said_and_ctrl_c_leaves_without_a_session() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "1"]) else { return };
    let mut live = Live::breaking(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), "watch:3600000");
    waits(&live, PARTS[0].said, || is_said(&live, &PARTS[0]));
    live.program.signal(Signal::INT);
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();
    let words = live.stderr();
    assert!(code == Some(1) && words.contains("ended before the session began"), "{code:?} {words}");
    assert!(!live.log.exists(), "nothing was recorded");
}

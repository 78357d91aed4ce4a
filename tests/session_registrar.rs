//! The thread that registers frames dies because it is asked to (`src/session/fault.rs`, which only a build with debug assertions hears): what is
//! in front of it goes on, one Ctrl-C ends the session, and a replay poses what was not posed.
#![cfg(all(unix, debug_assertions))]

use crate::live_lab::{HANG_S, Live, Signal, copies, deliver, eventually, quiet_lab};
use crate::log_lab::replay;

const SAID: &str =
    "the thread that registers frames died: no frame is posed any more; recording goes on, and a replay of the log poses them";

/// The session waited for the frame that the thread had until a second Ctrl-C, and without one for ever.
#[test]
fn a_registrar_that_dies_costs_poses_and_a_replay_makes_them() {
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let lab = lab.without_ct();
    let files = copies(&frame, 3, &folder.path().join("copies"));
    let mut live = Live::breaking(&lab.kit.join("session.json"), &folder.path().join("session"), "registrar:2").recording();
    let waits = |what: &str, fact: &dyn Fn() -> bool| {
        let found = eventually(HANG_S, || fact().then_some(()));
        assert!(found.is_some(), "never: {what}: {}", live.stderr());
    };
    deliver(&files[..1], &lab);
    waits("the first pair", &|| live.pairs() == 1);
    assert!(!live.stderr().contains(SAID), "the control: {}", live.stderr());
    deliver(&files[1..2], &lab);
    waits(SAID, &|| live.stderr().contains(SAID));
    deliver(&files[2..], &lab);
    waits("a frame after that", &|| live.heard().images == 3);
    live.signalled(Signal::INT);
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();

    let words = format!("{code:?}: {} {}", live.stdout(), live.stderr());
    assert!(code == Some(3) && live.stdout().contains(&format!("lost: {SAID}")), "{words}");
    assert!(live.report().contains(SAID) && live.pairs() == 1, "{words}");
    let heard = live.heard();
    assert!(heard.end_us.is_some() && heard.losses.is_empty(), "{:?} {words}", heard.losses);

    let (code, found) = replay(&live.log, &lab.kit, &folder.path().join("again"));
    assert_eq!(code, Some(0), "{found}");
    assert_eq!(["frames", "poses_identical"].map(|key| found[key].as_u64()), [Some(3), Some(1)], "{found}");
    for number in [2, 3] {
        let pose = format!("pose of frame {number}");
        assert!(found["not_in_log"].as_array().is_some_and(|missing| missing.contains(&pose.as_str().into())), "{pose}: {found}");
    }
}

//! A device that falls silent in mid-session, as a client of OpenIGTLink hears it.
#![cfg(unix)]

use std::sync::{Arc, Mutex};

use serde_json::json;

use crate::igtl_client::{Client, Told};
use crate::igtl_session::address;
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};

/// The tip stood where the robot had it when it was last heard, and the status went on to say that all was accepted.
#[test]
fn a_robot_that_falls_silent_is_told_for_as_long_as_it_is() {
    let args = ["--duration-s", "8", "--exposures", "2", "--faults", "robot:mute@0.5", "--idle-s", "60"];
    let Some(lab) = Lab::start_without_ct(&args) else { return };
    let session = lab.session("heard.json", |session| session["igtl"] = json!({ "port": 0 }));
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut live = Live::launch(&session, &folder.path().join("out"), &[]);
    let address = eventually(HANG_S, || address(&live.stderr())).expect("it says where it listens");
    let told = Arc::new(Mutex::new(Vec::<Told>::new()));
    let listener = {
        let (told, mut client) = (Arc::clone(&told), Client::connect(address));
        std::thread::spawn(move || {
            std::iter::from_fn(|| client.next()).for_each(|message| told.lock().expect("not poisoned").push(message));
        })
    };
    let is_silent = |told: &Told| told.device == "Telemetry" && told.text().starts_with("the robot is not heard any more");
    // The status comes once a second: three that come after it.
    let enough = eventually(HANG_S, || {
        let told = told.lock().expect("not poisoned");
        let from = told.iter().rposition(is_silent)?;
        (told[from..].iter().filter(|told| told.device == "Sidecarm").count() > 3).then_some(())
    });
    assert!(enough.is_some(), "nothing is said of the silence: {}", live.stderr());
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "the session ends");
    listener.join().expect("the client is well");
    let told = std::mem::take(&mut *told.lock().expect("not poisoned"));
    // On a crowded machine it may have been so before, for a moment.
    let [first, from] = [told.iter().position(is_silent), told.iter().rposition(is_silent)].map(|at| at.expect("said"));
    let statuses = |told: &[Told]| -> Vec<(u16, String)> {
        told.iter().filter(|told| told.device == "Sidecarm").map(Told::status).collect()
    };
    let names_it = |(code, words): &(u16, String)| *code == 2 && words.starts_with("the robot is not heard any more");
    // The control: nobody misses a robot that speaks.
    assert!(!statuses(&told[..first]).iter().any(names_it), "before it fell silent");
    let after = statuses(&told[from..]);
    let (last, silent) = after.split_last().expect("statuses");
    assert_eq!((last.0, silent.len() >= 3), (19, true), "{after:?}");
    let of_robot = |(code, words): &(u16, String)| {
        *code == 2 && words.contains("the robot is not heard any more") && !words.contains("the C-arm is not heard")
    };
    assert!(silent.iter().all(of_robot), "{after:?}");
    let tips = told[from..].iter().filter(|told| told.device == "TipToLps").count();
    assert_eq!(tips, 0, "of a robot that says nothing");
}

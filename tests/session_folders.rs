//! Consoles that write a folder for each study, through `live`.
#![cfg(unix)]

use std::time::Duration;

use crate::live_lab::{HANG_S, Live, Signal, copies, eventually, quiet_lab};

/// Frames in folders that were there, that came, and that went again: all are the session's, each once.
#[test]
fn what_comes_into_folders_below_is_read_where_the_session_says_so() {
    let Some((lab, frame, folder)) = quiet_lab("60") else { return };
    let files = copies(&frame, 4, &folder.path().join("copies"));
    let session = lab.session("session-tree.json", |session| session["frames"]["sub_folders"] = true.into());
    let there = lab.frames().join("there before");
    std::fs::create_dir(&there).expect("made");
    // What was there before the start is not the session's.
    std::fs::copy(&files[0], there.join("old.dcm")).expect("copied");
    let mut live = Live::start(&session, &folder.path().join("session"), &[]);
    let frames = |count: usize| {
        let all = eventually(HANG_S, || (live.heard().images == count).then_some(()));
        assert!(all.is_some(), "{} of {count} frames: {}", live.heard().images, live.stderr());
    };
    std::fs::copy(&files[0], there.join("frame.dcm")).expect("copied");
    frames(1);
    let deep = lab.frames().join("day").join("study").join("series");
    std::fs::create_dir_all(&deep).expect("made");
    std::fs::copy(&files[1], deep.join("frame.dcm")).expect("copied");
    frames(2);
    // Written elsewhere, then moved into place with its folder.
    let elsewhere = folder.path().join("export");
    std::fs::create_dir(&elsewhere).expect("made");
    std::fs::copy(&files[2], elsewhere.join("frame.dcm")).expect("copied");
    std::fs::rename(&elsewhere, lab.frames().join("day").join("export")).expect("moved");
    frames(3);
    std::fs::remove_dir_all(lab.frames().join("day")).expect("removed");
    std::thread::sleep(Duration::from_millis(700));
    std::fs::copy(&files[3], lab.frames().join("frame.dcm")).expect("copied");
    frames(4);
    live.signalled(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let words = live.stdout() + &live.stderr();
    assert_eq!((status.code(), live.heard().frames.len()), (Some(0), 4), "{words}");
    // Folders may be named after patients.
    assert!(!words.contains("there before") && !live.report().contains("there before"), "{words}");
}

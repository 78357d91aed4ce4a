//! A C-arm that nobody calibrated, through `live`: the frame's own header says what it was taken with.
#![cfg(unix)]

use crate::lab_truth::{poses, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};

#[test]
fn without_a_calibrated_arm_the_frames_header_gives_its_camera() {
    let Some(lab) = Lab::start_without_ct(&["--duration-s", "6", "--exposures", "2", "--faults", "none", "--idle-s", "300"])
    else {
        return;
    };
    let session = lab.session("bare.json", |session| drop(session.as_object_mut().expect("an object").remove("carm")));
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    wait_for_pairs(&live, 2);
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}{}", live.stdout(), live.stderr());
    let poses = poses(&live);
    assert_eq!(poses.len(), 2);
    for told in poses {
        let pose = &told["pose"];
        assert_eq!(pose["intrinsics_source"], "given", "not solved: {told:#}");
        let notes = pose["notes"].to_string();
        assert!(notes.contains("K is taken from the header") && notes.contains("give intrinsics in the session"), "{notes}");
        assert!(notes.contains("nobody has measured K") && notes.contains("1 σ"), "landmarks' sigma count that: {notes}");
        assert!(!notes.contains("--intrinsics"), "that is no word of a session: {notes}");
    }
}

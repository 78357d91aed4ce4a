//! Consoles whose counter says nothing, through `live`.
#![cfg(unix)]

use std::path::PathBuf;

use dicom_core::VR;
use dicom_dictionary_std::tags;

use crate::lab_truth::{hand_on, has_its_own_exposure, prior_is_right, put, robot_is_right, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};

/// A quiet lab, the folder that its frames are handed on into, and a session that reads it.
fn exporting(script: &[&str]) -> Option<(Lab, PathBuf, Live)> {
    let always = ["--faults", "none", "--await-all", "--idle-s", "300"];
    let lab = Lab::start(&[script, &always].concat())?.without_ct();
    let folder = lab.kit.join("exported");
    std::fs::create_dir(&folder).expect("a folder");
    let session = lab.session("exported.json", |session| session["frames"]["folder"] = "exported".into());
    let live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    Some((lab, folder, live))
}

/// A session whose console writes 1 wherever it could count, with stamps or without.
fn numbered_one(stamped: bool) {
    let Some((lab, folder, mut live)) = exporting(&["--duration-s", "16"]) else { return };
    hand_on(&lab, &folder, 8, |_, mut object, to| {
        put(&mut object, tags::ACQUISITION_NUMBER, VR::IS, "1");
        put(&mut object, tags::INSTANCE_NUMBER, VR::IS, "1");
        if !stamped {
            object.remove_element(tags::ACQUISITION_DATE);
            object.remove_element(tags::ACQUISITION_TIME);
        }
        object.write_to_file(to).expect("written");
    });
    wait_for_pairs(&live, 8);
    live.signalled(Signal::INT);
    let words = |live: &Live| format!("stamped {stamped}: {} {}", live.stdout(), live.stderr());
    assert!(live.program.end(HANG_S).is_some(), "{}", words(&live));

    let frames = told_frames(&live);
    assert!(frames.len() == 8, "{} frames: {}", frames.len(), words(&live));
    let mut unbound = 0;
    for (pair, pose, counter) in &frames {
        // Without a stamp only arrival is left, which on a crowded machine tells nothing: what is not known is bound to nothing, never to a wrong one.
        if !stamped && pose["binding"]["exposure"].is_null() {
            unbound += 1;
            continue;
        }
        assert!(*counter == 1 || pair["binding"] == "time", "{pair:#}");
        has_its_own_exposure(&lab, pose, *counter);
        robot_is_right(pose, *counter);
        if pair["pose_source"] == "beads" {
            prior_is_right(pair);
        }
    }
    if !stamped {
        let all = format!("{}{}", live.stdout(), live.stderr());
        let none_is_said = all.contains("not one of 8 frames could be tied");
        assert!(unbound < 8 || none_is_said, "{}", words(&live));
        return;
    }
    let dropped = "the console's counter does not move (1 in ";
    let said = frames.iter().filter(|(pair, ..)| pair["binding_evidence"].to_string().contains(dropped)).count();
    assert!(said >= 5, "said of {said} frames: {}", words(&live));
    assert!(live.report().contains(dropped), "the report says it as well");
}

/// Acquisition Number and Instance Number are 1 in every file of some consoles: an equal number would make each of them the first exposure's.
#[test]
fn a_console_that_numbers_every_picture_one_binds_none_but_the_first_to_the_first_exposure() {
    std::thread::scope(|scope| {
        let runs = [true, false].map(|stamped| scope.spawn(move || numbered_one(stamped)));
        runs.into_iter().for_each(|run| run.join().expect("bound"));
    });
}

/// Two frames without a count, their console's clock at some other time of the day: what each pair says of it is what was known at the end.
#[test]
fn why_a_frame_has_no_exposure_is_said_as_it_is_known_at_the_end() {
    let Some((lab, folder, mut live)) = exporting(&["--duration-s", "8", "--exposures", "2"]) else { return };
    hand_on(&lab, &folder, 2, |counter, mut object, to| {
        for tag in [tags::ACQUISITION_NUMBER, tags::INSTANCE_NUMBER] {
            object.remove_element(tag);
        }
        put(&mut object, tags::ACQUISITION_TIME, VR::TM, &format!("0312{counter:02}"));
        object.write_to_file(to).expect("written");
    });
    wait_for_pairs(&live, 2);
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}{}", live.stdout(), live.stderr());
    for (pair, pose, _) in &told_frames(&live) {
        let evidence = pair["binding_evidence"].to_string();
        assert!(pose["binding"]["exposure"].is_null(), "{pair:#}");
        assert!(!evidence.contains("when this frame was judged"), "{evidence}");
    }
}

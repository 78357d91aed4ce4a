//! Files that carry the time of another clock, through `live`: that of a share, or of a host whose clock was set in mid-session.
#![cfg(unix)]

use std::time::Duration;

use crate::lab_truth::{file_of, hand_on, has_its_own_exposure, robot_is_right, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};

const FRAMES: u32 = 4;
const HOUR: Duration = Duration::from_secs(3600);

/// A frame came when it was seen to come: files of an hour ago are no old ones, and nobody waits an hour for those of an hour hence.
#[test]
fn frames_whose_files_are_an_hour_off_are_bound_as_they_come() {
    let frames = FRAMES.to_string();
    let args = ["--duration-s", "10", "--exposures", &frames, "--faults", "none", "--await-all", "--idle-s", "300"];
    let Some(lab) = Lab::start_without_ct(&args) else { return };
    let folder = lab.kit.join("shared");
    std::fs::create_dir(&folder).expect("a folder");
    let session = lab.session("mtimes.json", |session| session["frames"]["folder"] = "shared".into());
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    hand_on(&lab, &folder, FRAMES as usize, |counter, object, path| {
        object.write_to_file(path).expect("written");
        let file = std::fs::File::options().write(true).open(path).expect("opened");
        let modified = file.metadata().and_then(|metadata| metadata.modified()).expect("a time");
        let set = if counter % 2 == 0 { modified + HOUR } else { modified - HOUR };
        file.set_modified(set).expect("set");
    });
    wait_for_pairs(&live, FRAMES as usize);
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());

    let frames = told_frames(&live);
    assert!(frames.len() == FRAMES as usize, "{} frames: {}", frames.len(), live.stderr());
    let mut numbers = Vec::new();
    for (pair, pose, counter) in &frames {
        // What the test is about: the file's time is an hour from when the lab wrote it.
        let written = |path: &std::path::Path| std::fs::metadata(path).and_then(|of| of.modified()).expect("a time");
        let (at, own) = (written(&folder.join(format!("frame-{counter:03}.dcm"))), written(&file_of(&lab, *counter)));
        let apart = if at > own { at.duration_since(own) } else { own.duration_since(at) };
        assert!(apart.expect("a time") > HOUR / 2, "frame {counter}");
        assert!(pair["binding"] != "none", "{pair:#}");
        assert!(!pair["flags"].to_string().contains("after its exposure"), "it came at once: {pair:#}");
        has_its_own_exposure(&lab, pose, *counter);
        robot_is_right(pose, *counter);
        numbers.push((pair["number"].as_u64(), *counter));
    }
    assert!(numbers.is_sorted_by_key(|(number, _)| *number), "in the order of their numbers: {numbers:?}");
    assert!(numbers.is_sorted_by_key(|(_, counter)| *counter), "and in that in which they came: {numbers:?}");
}

//! A console that exports everything long after it was taken, through `live`: the samples of the exposures are forgotten by then.
#![cfg(unix)]

use std::path::PathBuf;

use dicom_core::VR;
use dicom_dictionary_std::tags;
use sidecarm::telemetry::DeviceKind;

use crate::lab_truth::{counter_of, has_its_own_exposure, prior_is_right, put, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Sent, Signal, eventually};

/// Samples of a device that the timeline keeps: ten minutes at 300 Hz. At a hundred times the C-arm's rate that is a minute and some
/// seconds, which a test can wait for.
const KEPT: usize = 200_000;
const FRAMES: usize = 6;
/// Of the frame whose tags say another voltage than telemetry, and the one whose tags say another distance.
const OTHER_KVP: u32 = 3;
const OTHER_SID: u32 = 5;

fn of_the_arm(sent: &[Sent], after_us: i64) -> usize {
    sent.iter().filter(|packet| packet.device == DeviceKind::Carm && packet.host_us > after_us).count()
}

/// Joints, prior and beam were those of the samples: frames that came when these were forgotten had none, and tags of another voltage were
/// held against nothing.
#[test]
fn frames_that_come_when_their_samples_are_forgotten_keep_exposure_joints_and_beam() {
    let frames = FRAMES.to_string();
    let lab = [
        "--duration-s",
        "12",
        "--exposures",
        &frames,
        "--rate",
        "100",
        "--no-robot",
        "--faults",
        "none",
        "--await-all",
        "--idle-s",
        "400",
    ];
    let Some(lab) = Lab::start(&lab) else { return };
    let folder = lab.kit.join("exported");
    std::fs::create_dir(&folder).expect("a folder");
    let session = lab.session("export.json", |session| session["frames"]["folder"] = "exported".into());
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    let delivered = eventually(HANG_S, || Some(lab.delivered()).filter(|files| files.len() == FRAMES));
    let last_us = delivered.expect("all frames").into_iter().map(|(_, at_us)| at_us).max().expect("frames");
    let forgotten = eventually(HANG_S, || {
        std::thread::sleep(std::time::Duration::from_secs(2));
        (of_the_arm(&lab.sent(), last_us) > KEPT + KEPT / 50).then_some(())
    });
    assert!(forgotten.is_some(), "the C-arm goes on");
    let exported_us = sidecarm::time::host_now_us();
    let mut files: Vec<PathBuf> = std::fs::read_dir(lab.frames()).expect("frames").flatten().map(|entry| entry.path()).collect();
    files.sort();
    for file in &files {
        let name = file.file_name().expect("a name").to_str().expect("UTF-8");
        let mut object = dicom_object::open_file(file).expect("a frame");
        match counter_of(name) {
            OTHER_KVP => put(&mut object, tags::KVP, VR::DS, "70"),
            OTHER_SID => put(&mut object, tags::DISTANCE_SOURCE_TO_DETECTOR, VR::DS, "1100"),
            _ => {}
        }
        let to = folder.join(name);
        object.write_to_file(to.with_extension("part")).expect("written");
        std::fs::rename(to.with_extension("part"), to).expect("renamed");
    }
    wait_for_pairs(&live, FRAMES);
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());

    let words = live.stderr();
    // What the test is about: between the last exposure and the export more samples came than are kept.
    let came = live.heard().packets;
    let came = came.iter().filter(|((device, _), at_us)| *device == DeviceKind::Carm && (last_us..exported_us).contains(*at_us));
    assert!(came.count() > KEPT + 1000, "too few samples to forget any: {words}");
    let frames = told_frames(&live);
    assert!(frames.len() == FRAMES, "{} frames: {words}", frames.len());
    for (pair, pose, counter) in &frames {
        let flags = pair["flags"].to_string();
        assert!(pair["binding"] != "none" && flags.contains("after its exposure"), "{pair:#}");
        has_its_own_exposure(&lab, pose, *counter);
        assert!(pair["gap_us"].as_i64().is_some_and(|gap_us| gap_us < 100_000), "joints of its own samples: {pair:#}");
        prior_is_right(pair);
        let (kvp, sid) =
            ("telemetry says 90 kVp, the frame 70", "the frame says 1100 mm from focal spot to detector, telemetry says 1020 mm");
        assert_eq!(flags.contains(kvp), *counter == OTHER_KVP, "{flags}");
        assert_eq!(flags.contains(sid), *counter == OTHER_SID, "{flags}");
    }
    assert!(
        words.contains("telemetry says 90 kVp, the frame 70") && words.contains("check that the frame belongs to this exposure"),
        "{words}"
    );
}

//! Files of many images that were taken during one exposure, or each during its own, through `live`.
#![cfg(unix)]

use std::collections::BTreeMap;

use dicom_core::VR;
use dicom_dictionary_std::tags;
use serde_json::Value;

use crate::lab_truth::{TIME_US, began_us, hand_on, pairs, poses, put, scripted, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually, many_images};

const DURATION_S: f64 = 20.0;
const EXPOSURE_S: f64 = 1.2;
const IMAGES: usize = 5;
/// From image to image of the first run, as its file says it: the run is over before the beam is off.
const FRAME_TIME_S: f64 = 0.2;

/// What the mock adds to the robot's angles when it sways: up and down by 4 degrees in 4 s.
fn sway_deg(at_s: f64) -> f64 {
    4.0 * (4.0 * ((at_s / 4.0).rem_euclid(1.0) - 0.5).abs() - 1.0)
}

/// A run was one exposure of which every image had the middle's joints, or five exposures of which four were missing.
#[test]
fn images_of_a_run_share_their_exposure_and_have_each_its_own_time_and_robot() {
    let exposure_s = EXPOSURE_S.to_string();
    let duration_s = DURATION_S.to_string();
    let lab = ["--duration-s", &duration_s, "--exposures", "2", "--exposure-s", &exposure_s, "--odd", "swaying"];
    let Some(lab) = Lab::start(&[&lab[..], &["--faults", "none", "--await-all", "--idle-s", "300"]].concat()) else {
        return;
    };
    let lab = lab.without_ct();
    let folder = lab.kit.join("exported");
    std::fs::create_dir(&folder).expect("a folder");
    let session = lab.session("runs.json", |session| session["frames"]["folder"] = "exported".into());
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    hand_on(&lab, &folder, 2, |counter, _, to| {
        many_images(&lab.frames().join(format!("frame-{counter:03}.dcm")), IMAGES, to);
        let mut run = dicom_object::open_file(to).expect("a run");
        // The second run does not say its pace: it is spread over the exposure.
        if counter == 1 {
            put(&mut run, tags::FRAME_TIME, VR::DS, &(1e3 * FRAME_TIME_S).to_string());
        }
        run.write_to_file(to).expect("written");
    });
    wait_for_pairs(&live, 2 * IMAGES);
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());

    let (pairs, poses) = (pairs(&live), poses(&live));
    assert_eq!((pairs.len(), poses.len()), (2 * IMAGES, 2 * IMAGES), "{}", live.stderr());
    let mut runs: BTreeMap<u32, Vec<(&Value, &Value)>> = BTreeMap::new();
    for (pair, pose) in pairs.iter().zip(&poses) {
        let counter = pose["binding"]["exposure"]["counter"].as_u64().unwrap_or_else(|| panic!("not bound: {pair:#}"));
        runs.entry(counter as u32).or_default().push((pair, pose));
    }
    assert_eq!(runs.keys().copied().collect::<Vec<_>>(), [1, 2], "{}", live.stderr());
    for (counter, images) in runs {
        let (name, step_s) = (format!("frame-{counter:03}"), if counter == 1 { FRAME_TIME_S } else { EXPOSURE_S / 5.0 });
        let began_us = began_us(&lab.frames().join(format!("{name}.dcm")));
        let scripted = scripted(counter);
        let began_s = DURATION_S * scripted["at"].as_f64().expect("a share");
        assert_eq!(images.len(), IMAGES, "{name}");
        let mut angles = Vec::new();
        for (image, (pair, pose)) in images.into_iter().enumerate() {
            let words = format!("image {} of {IMAGES} of one run", image + 1);
            assert!(pair["frame"].as_str().is_some_and(|frame| frame.starts_with(&name)), "{pair:#}");
            assert!(pair["flags"].to_string().contains(&words), "{name}: no '{words}' in {}", pair["flags"]);
            let after_us = pose["binding"]["time_us"].as_i64().expect("a time") - began_us;
            let expected_us = (1e6 * step_s * (image as f64 + 0.5)) as i64;
            assert!((after_us - expected_us).abs() < TIME_US, "{name}, image {image}: {after_us} µs, not {expected_us}");
            let found = pose["control_angles_deg"][2].as_f64().unwrap_or_else(|| panic!("no robot: {pair:#}"));
            let still = scripted["control_deg"][2].as_f64().expect("an angle");
            let swayed = still + sway_deg(began_s + 1e-6 * expected_us as f64);
            // A degree in a quarter of a second.
            assert!((found - swayed).abs() < 0.4, "{name}, image {image}: {found} instead of {swayed}");
            angles.push(found);
        }
        let apart = angles.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
        assert!(apart > 0.5, "{name}: the robot moved from image to image: {angles:?}");
    }
    assert!(!live.stderr().contains("exposures have no frame"), "{}", live.stderr());
}

/// A series of three exposures in one file with one stamp: all three pictures were of the first, with its joints. With the times from image to
/// image each has its own, without them none has one, and that is said.
#[test]
fn images_of_a_series_in_one_file_have_each_its_own_exposure_or_none() {
    for says_times in [true, false] {
        let lab = ["--duration-s", "20", "--exposures", "6", "--faults", "none", "--await-all", "--idle-s", "300"];
        let Some(lab) = Lab::start_without_ct(&lab) else { return };
        let folder = lab.kit.join("exported");
        std::fs::create_dir(&folder).expect("a folder");
        let session = lab.session("series.json", |session| session["frames"]["folder"] = "exported".into());
        let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
        hand_on(&lab, &folder, 3, |_, frame, to| frame.write_to_file(to).expect("written"));
        let file = |counter: u32| lab.frames().join(format!("frame-{counter:03}.dcm"));
        let is_there = eventually(HANG_S, || dicom_object::open_file(file(6)).is_ok().then_some(()));
        assert!(is_there.is_some(), "{}", live.stderr());
        let staged = lab.kit.join("series.part");
        many_images(&file(4), 3, &staged);
        if says_times {
            let mut series = dicom_object::open_file(&staged).expect("a series");
            let began_us = [4, 5, 6].map(|counter| began_us(&file(counter)));
            let [second_ms, third_ms] = [1, 2].map(|image| (began_us[image] - began_us[image - 1]) / 1000);
            put(&mut series, tags::FRAME_TIME_VECTOR, VR::DS, &format!("0\\{second_ms}\\{third_ms}"));
            series.write_to_file(&staged).expect("written");
        }
        std::fs::rename(staged, folder.join("series.dcm")).expect("renamed");
        wait_for_pairs(&live, 6);
        live.signalled(Signal::INT);
        assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());

        let counters = |poses: &[Value]| -> Vec<Option<u64>> {
            poses.iter().map(|pose| pose["binding"]["exposure"]["counter"].as_u64()).collect()
        };
        let (pairs, found) = (pairs(&live), counters(&poses(&live)));
        let untold = pairs.iter().filter(|pair| {
            pair["binding"] == "none"
                && pair["binding_evidence"].to_string().contains("one file of 3 images came when 3 exposures")
        });
        match says_times {
            true => assert_eq!(found, [1, 2, 3, 4, 5, 6].map(Some), "{pairs:#?} {}", live.stderr()),
            false => {
                assert_eq!(found, [Some(1), Some(2), Some(3), None, None, None], "{pairs:#?} {}", live.stderr());
                assert_eq!(untold.count(), 3, "{pairs:#?}");
            }
        }
    }
}

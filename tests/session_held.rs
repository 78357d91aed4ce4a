//! The last image held of a beam that was on for seconds, through `live`: what it shows is the end of the beam.
#![cfg(unix)]

use dicom_core::VR;
use dicom_dictionary_std::tags;

use crate::lab_truth::{TIME_US, began_us, file_of, hand_on, put, scripted, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};

const DURATION_S: f64 = 20.0;
const BEAM_S: f64 = 1.3;
/// The last pulses are of so long before the beam's end.
const PULSES_S: f64 = 0.1;
/// The frame whose header says that it was taken at the dose of fluoroscopy; of the other nothing is said.
const HELD: u32 = 1;

/// What the mock adds to the robot's angles when it sways: up and down by 4 degrees in 4 s.
fn sway_deg(at_s: f64) -> f64 {
    4.0 * (4.0 * ((at_s / 4.0).rem_euclid(1.0) - 0.5).abs() - 1.0)
}

/// A last image held was drawn with the robot of the middle of its beam, and nothing but how far the robot had moved was said.
#[test]
fn a_last_image_held_has_the_time_and_the_robot_of_the_end_of_its_beam() {
    let (duration_s, beam_s) = (DURATION_S.to_string(), BEAM_S.to_string());
    let args = ["--duration-s", &duration_s, "--exposures", "2", "--exposure-s", &beam_s, "--odd", "swaying"];
    let Some(lab) = Lab::start_without_ct(&[&args[..], &["--faults", "none", "--await-all", "--idle-s", "300"]].concat()) else {
        return;
    };
    let folder = lab.kit.join("exported");
    std::fs::create_dir(&folder).expect("a folder");
    let session = lab.session("held.json", |session| session["frames"]["folder"] = "exported".into());
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    hand_on(&lab, &folder, 2, |counter, mut object, to| {
        if counter == HELD {
            put(&mut object, tags::RADIATION_SETTING, VR::CS, "SC");
        }
        object.write_to_file(to).expect("written");
    });
    wait_for_pairs(&live, 2);
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}", live.stderr());

    let frames = told_frames(&live);
    assert!(frames.len() == 2, "{} frames: {}", frames.len(), live.stderr());
    for (pair, pose, counter) in &frames {
        let is_held = *counter == HELD;
        assert_eq!(pose["binding"]["exposure"]["counter"], *counter, "{pair:#}");
        let after_us = pose["binding"]["time_us"].as_i64().expect("a time") - began_us(&file_of(&lab, *counter));
        let (middle_s, end_s) = (0.5 * BEAM_S, BEAM_S - PULSES_S);
        let expected_s = if is_held { end_s } else { middle_s };
        assert!((after_us - (1e6 * expected_s) as i64).abs() < TIME_US, "frame {counter}: {after_us} µs after beam on");
        let told = scripted(*counter);
        let began_s = DURATION_S * told["at"].as_f64().expect("a share");
        let still = told["control_deg"][2].as_f64().expect("an angle");
        let found = pose["control_angles_deg"][2].as_f64().unwrap_or_else(|| panic!("no robot: {pair:#}"));
        let off = |at_s: f64| (found - still - sway_deg(began_s + at_s)).abs();
        // A degree in a quarter of a second.
        assert!(off(expected_s) < 0.4, "frame {counter}: {found}, off by {}", off(expected_s));
        let (flags, cautions) = (pair["flags"].to_string(), pair["robot_cautions"].to_string());
        assert_eq!(flags.contains("the last image held of a beam of 1."), is_held, "{flags}");
        assert_eq!(cautions.contains("in the middle of a beam of 1."), !is_held, "{cautions}");
    }
}

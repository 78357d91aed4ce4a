//! A panel that reads more than nothing without X-rays, and nobody calibrated it, through `live`: what stands behind the blades tells how much, it is
//! taken away, and said.
#![cfg(unix)]

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use dicom_object::DefaultDicomObject;
use serde_json::json;
use sidecarm::random::{Purpose, Stream};

use crate::lab_truth::{hand_on, pairs, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};

/// Stored value without X-rays, of 40 000 in air, and electronic noise about it.
const PEDESTAL: f64 = 900.0;
const NOISE: f64 = 3.0;
/// Columns behind a blade, and what it lets through.
const SHUT_PX: f64 = 90.0;
const LEAK: f64 = 1e-3;

/// The lab's picture with a blade over its left columns, on a panel that reads `pedestal` without X-rays.
fn behind_a_blade(object: &mut DefaultDicomObject, pedestal: f64) {
    let columns: usize = object.element(tags::COLUMNS).expect("columns").to_int().expect("a number");
    let values = object.element(tags::PIXEL_DATA).expect("pixels").to_multi_int::<u16>().expect("words");
    let mut random = Stream::new(11, 0, 0, Purpose::Evaluation);
    let stored = |(at, value): (usize, &u16)| {
        // A penumbra of four pixels.
        let share = (((at % columns) as f64 - SHUT_PX) / 4.0 + 0.5).clamp(0.0, 1.0);
        let open = share * share * (3.0 - 2.0 * share);
        let signal = f64::from(*value) * (open + LEAK * (1.0 - open));
        (pedestal + signal + NOISE * random.normal()).round().clamp(0.0, 65_535.0) as u16
    };
    let values: Vec<u16> = values.iter().enumerate().map(stored).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
}

/// The second frame, whose panel reads nothing there, is the control.
#[test]
fn a_pedestal_is_estimated_behind_the_blades_of_a_session_s_frames_and_said() {
    const PEDESTALS: [f64; 2] = [PEDESTAL, 0.0];
    let lab = ["--duration-s", "10", "--faults", "none", "--exposures", "2", "--idle-s", "300"];
    let Some(lab) = Lab::start(&lab) else { return };
    let exported = lab.kit.join("exported");
    std::fs::create_dir(&exported).expect("a folder");
    let session = lab.session("pedestal.json", |session| session["frames"]["folder"] = json!("exported"));
    let mut live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    hand_on(&lab, &exported, PEDESTALS.len(), |counter, mut object, to| {
        behind_a_blade(&mut object, PEDESTALS[counter as usize - 1]);
        object.write_to_file(to).expect("written");
    });
    wait_for_pairs(&live, PEDESTALS.len());
    live.signalled(Signal::INT);
    let ended = live.program.end(HANG_S);
    assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{}", live.stderr());

    let (rows, report) = (pairs(&live), live.report());
    assert_eq!(rows.len(), PEDESTALS.len(), "{}", live.stderr());
    for pair in &rows {
        let pedestal = PEDESTALS[if pair["frame"] == "frame-001" { 0 } else { 1 }];
        let shut = pair["masks"]["causes"]["collimation"].as_f64().unwrap_or(0.0);
        assert!((0.12..0.18).contains(&shut), "the blade covers {shut} of the frame: {pair:#}");
        let offset = &pair["air"]["offset"];
        let flags = pair["flags"].to_string();
        if pedestal > 0.0 {
            let (value, sigma) = (offset["value"].as_f64().expect("a number"), offset["sigma"].as_f64().expect("a number"));
            assert!(offset["rule"] == "shutters" && (value - pedestal).abs() < 4.0 + 4.0 * sigma, "{offset}");
            assert!(flags.contains("pedestal of") && flags.contains("estimated behind the shutters"), "{flags}");
        } else {
            assert!(offset["rule"] == "none" && offset["value"] == 0.0 && !flags.contains("pedestal of"), "{offset} {flags}");
        }
    }
    assert!(report.contains("pedestal of"), "it stands in the report");
}

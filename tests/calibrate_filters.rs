//! Air frames behind several filters: `sidecarm calibrate detector` keeps each apart, and a frame is freed of the field of its own filter.

use serde_json::{Value, json};
use sidecarm::acquire::{DetectorCalibration, FilterForm, FilterLayer, FilterMaterial, FilterTags, Frame, read_frame};
use sidecarm::geometry::PanelWindow;
use sidecarm::telemetry::CarmSample;

use crate::calibrate_detector::{Panel, errors, panel, within_limits};
use crate::calibrate_session::session;
use crate::crosscheck_facts::sample;
use crate::live_lab::Lab;

/// What a header says of copper in the beam.
fn copper(mm: f64) -> Option<FilterTags> {
    let layers = vec![FilterLayer { material: FilterMaterial::Copper, thickness_mm: Some([mm; 2]) }];
    Some(FilterTags { form: Some(FilterForm::Flat), layers })
}

fn told(aluminium_mm: f64, copper_mm: f64) -> CarmSample {
    CarmSample { filter_mm_al: aluminium_mm, filter_mm_cu: copper_mm, ..sample() }
}

/// Mean of the first eighth of the columns over that of the last: 1 of a flat field.
fn tilt(frame: &Frame) -> f64 {
    let width = frame.pixels.width;
    let mean = |from: usize| {
        let rows = frame.pixels.pixels.chunks_exact(width);
        rows.flat_map(|row| &row[from..from + width / 8]).map(|value| f64::from(*value)).sum::<f64>()
    };
    mean(0) / mean(width - width / 8)
}

/// What became of a frame: how flat it is, its air level or why that is not known, and the doubt about its flood.
fn corrected(
    calibration: &DetectorCalibration,
    frame: &Frame,
    told: Option<&CarmSample>,
) -> (f64, Result<f64, String>, Option<String>) {
    let corrected = calibration.correct_told(frame, PanelWindow::WHOLE, told).expect("applies");
    let correction = corrected.correction.clone().expect("noted");
    let air = correction.air_value.ok_or(correction.air_evidence);
    (tilt(&corrected), air, correction.flood_doubt)
}

#[test]
fn a_frame_is_freed_of_the_field_of_its_own_filter_and_of_no_other_without_a_word() {
    // With and without 0.2 mm of copper, which loses more towards the heel's soft end.
    let Some(panel) = panel(&["--seed", "120", "--coppers-mm", "0,0.2"]) else { return };
    let calibration = panel.calibrated(&["--bits", "14", "--counting"]);
    let off = errors(&calibration, &panel.truth);
    assert!(off.len() == 2 && within_limits(&off), "gain, air, quanta off by {off:?}");
    let filters: Vec<String> =
        calibration.record.beams.iter().filter_map(|beam| Some(beam.added_filter.as_ref()?.words())).collect();
    assert_eq!(filters, ["no added filter", "0.20 mm of copper"]);
    let pages = &calibration.record.maps.as_ref().expect("written").pages;
    assert!(pages[3].contains("90 kVp, 0.20 mm of copper"), "{pages:?}");

    let expected: Vec<f64> = panel.truth["beams"]
        .as_array()
        .expect("beams")
        .iter()
        .map(|beam| 8.0 * beam["air_value_per_mas"].as_f64().expect("a number"))
        .collect();
    let is_flat = |tilt: f64| (tilt - 1.0).abs() < 0.01;
    for (name, expected) in [("air-90kvp-0.00cu-8.00mas-01", expected[0]), ("air-90kvp-0.20cu-8.00mas-01", expected[1])] {
        let frame = read_frame(&panel.files(name)[0], None).expect("reads");
        let (tilt, air, doubt) = corrected(&calibration, &frame, None);
        assert!(is_flat(tilt) && doubt.is_none(), "{name}: {tilt}, {doubt:?}");
        assert!((air.expect("known") / expected - 1.0).abs() < 0.005, "{name}");
    }

    let frame = read_frame(&panel.files("air-90kvp-0.20cu-8.00mas-01")[0], None).expect("reads");
    let with = |filter: Option<FilterTags>| {
        let mut changed = frame.clone();
        changed.tags.filter = filter;
        changed
    };
    // A header that does not say it leaves it to telemetry.
    let silent = with(None);
    let (tilt, air, doubt) = corrected(&calibration, &silent, Some(&told(f64::NAN, 0.2)));
    assert!(is_flat(tilt) && air.is_ok() && doubt.is_none(), "{tilt}, {air:?}, {doubt:?}");
    // The control: the field without copper is another one.
    let (tilt, air, doubt) = corrected(&calibration, &silent, Some(&told(4.3, 0.0)));
    assert!(!is_flat(tilt) && air.is_ok() && doubt.is_none(), "{tilt}, {air:?}, {doubt:?}");
    // A header that says it counts before telemetry.
    let (tilt, ..) = corrected(&calibration, &with(copper(0.2)), Some(&told(4.3, 0.0)));
    assert!(is_flat(tilt), "{tilt}");

    let cases: [(Frame, Option<CarmSample>, &[&str]); 3] = [
        (silent.clone(), None, &["filters no added filter, 0.20 mm of copper at 90 kVp", "does not say which was in"]),
        (silent, Some(told(f64::NAN, f64::NAN)), &["perhaps those of another filter", "does not say which was in"]),
        (with(copper(0.5)), None, &["the frame was taken with 0.50 mm of copper", "take air frames with this filter"]),
    ];
    for (frame, told, words) in cases {
        let (_, air, doubt) = corrected(&calibration, &frame, told.as_ref());
        let (reason, doubt) = (air.expect_err("not known"), doubt.expect("said"));
        assert!(reason.starts_with("air level unknown: "), "{reason}");
        words.iter().for_each(|word| assert!(doubt.contains(word), "'{word}' is not in: {doubt}"));
    }
    files_without_filters_doubt_nothing(&panel, &calibration, &frame);
}

/// A calibration may say nothing of filters: two beams of one voltage leave the air level open, and nothing is doubted aloud.
fn files_without_filters_doubt_nothing(panel: &Panel, calibration: &DetectorCalibration, frame: &Frame) {
    let old = |keep: &dyn Fn(usize) -> bool| {
        let mut record = serde_json::to_value(&calibration.record).expect("JSON");
        let beams = record["beams"].as_array_mut().expect("beams");
        beams.iter_mut().for_each(|beam| drop(beam.as_object_mut().expect("an object").remove("added_filter")));
        *beams = beams.drain(..).enumerate().filter(|(at, _)| keep(*at)).map(|(_, beam)| beam).collect();
        record["maps"] = Value::Null;
        let path = panel.folder.path().join("old.json");
        std::fs::write(&path, record.to_string()).expect("written");
        DetectorCalibration::read(&path).expect("an older file")
    };
    let (_, air, doubt) = corrected(&old(&|_| true), frame, None);
    assert!(air.is_err_and(|reason| reason.contains("does not say which was in")) && doubt.is_none(), "{doubt:?}");
    let (_, air, doubt) = corrected(&old(&|at| at == 0), frame, Some(&told(4.3, 0.5)));
    assert!(air.is_ok() && doubt.is_none(), "{air:?} {doubt:?}");
}

#[test]
fn filters_that_are_not_stated_are_typed_and_a_total_is_one() {
    let Some(plain) = panel(&["--seed", "121", "--levels-mas", "2,4", "--frames", "2"]) else { return };
    let found = plain.calibrated(&["--bits", "14", "--counting", "--added-filter", "copper=0.1"]);
    let stated = found.record.beams[0].added_filter.as_ref().expect("typed");
    assert_eq!(serde_json::to_value(stated).expect("JSON")["stated_by"], "person");
    assert_eq!(stated.words(), "0.10 mm of copper");

    let args = ["--seed", "122", "--energy", "--gain", "0.0057", "--coppers-mm", "0,0.2", "--levels-mas", "2,4", "--frames", "2"];
    let Some(energy) = panel(&args) else { return };
    let found = energy.calibrated(&["--bits", "14", "--filter", "aluminium=4.3"]);
    let totals: Vec<&str> = found.record.beams.iter().filter_map(|beam| beam.filter.as_deref()).collect();
    assert_eq!(totals, ["aluminium=4.3", "aluminium=4.3,copper=0.2"]);
    // A harder beam's photons differ less in energy.
    let [soft, hard] = [0, 1].map(|at| found.record.beams[at].photons_per_quantum.expect("a spectrum"));
    assert!(soft > hard && hard > 1.0, "{soft}, {hard}");
    std::fs::remove_file(energy.out()).expect("removed");
    energy
        .refused(&["--bits", "14", "--filter", "aluminium=4.3", "--filter", "copper=0.2"], &["names copper", "leave copper out"]);

    // One frame without a word among those that have one.
    let lone = plain.files("air-").remove(0);
    std::fs::copy(&lone, energy.folder.path().join("air-zz.dcm")).expect("copied");
    energy.refused(&["--bits", "14"], &["does not state its added filter", "--added-filter"]);
}

/// A session's frames are corrected by the beam of their own filter; the second one says 0.3 mm of copper, of which there are no air frames.
#[test]
fn a_frame_behind_a_filter_that_was_not_calibrated_is_doubted_in_its_pair() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "2", "--tags-lie", "filter@2"]) else { return };
    let layer = |material: &str, mm: f64| json!({"material": material, "thickness_mm": [mm, mm]});
    // The kit's frames of 1.05 mAs have 40000 in air; behind 1 mm of copper there would be another level.
    let beam = |layers: Vec<Value>, form: &str, air: f64| {
        json!({"tube_kvp": 90.0, "source_to_detector_mm": 1020.0, "air_value_per_mas": air / 1.05, "air_relative_sigma": 0.002,
            "added_filter": {"stated_by": "header", "form": form, "layers": layers}})
    };
    let own = beam(vec![layer("ALUMINUM", 4.3)], "FLAT", 40_000.0);
    let other = beam(vec![layer("ALUMINUM", 4.3), layer("COPPER", 1.0)], "MULTIPLE", 20_000.0);
    let detector = json!({"origin": "test", "columns_px": 620, "rows_px": 480, "offset_value": 0.0, "beams": [other, own]});
    std::fs::write(lab.kit.join("filters.json"), detector.to_string()).expect("written");
    let (_, pairs, said) = session(&lab, |session| session["detector"] = json!("filters.json"));
    let pair = |frame: &str| pairs.iter().find(|pair| pair["frame"] == frame).unwrap_or_else(|| panic!("{frame}: {said}"));
    let (first, second) = (pair("frame-001"), pair("frame-002"));
    let level = first["air"]["level"].as_f64().unwrap_or(f64::NAN);
    assert!(first["air"]["rule"] == "calibration" && (level / 40_000.0 - 1.0).abs() < 1e-9, "{:#}", first["air"]);
    assert!(first["air"]["reason"].to_string().contains("4.30 mm of aluminium"), "{:#}", first["air"]);
    let doubts = |pair: &Value| pair["flags"].to_string().contains("air frames of another filter");
    assert!(!doubts(first) && doubts(second), "{:#} {:#}", first["flags"], second["flags"]);
    assert_ne!(second["air"]["rule"], "calibration", "{:#}", second["air"]);
    let named = "the frame was taken with 4.30 mm of aluminium and 0.30 mm of copper";
    assert!(second["flags"].to_string().contains(named) && said.contains(named), "{:#}", second["flags"]);
}

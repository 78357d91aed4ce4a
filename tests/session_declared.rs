//! Tone and air level that a session declares, for each frame as its domain allows, through `live`; and what is said without the declaration.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::Path;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::{Value, json};
use sidecarm::acquire::read_frame;

use crate::calibrate_session::write_png8;
use crate::lab_truth::{file_of, pairs, put};
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};

/// What the session declares, and what the mock's detector reads in air.
const DECLARED_AIR: f64 = 36_000.0;
const TRUE_AIR: f64 = 40_000.0;
/// Scores that a curve between the two images leaves their meaning.
const OF_A_TONE: [&str; 6] = ["zncc", "rank_ncc", "gradient_ncc", "ssim", "local_ncc", "edge_distance_mm"];
/// Scores that need nepers, and those that need a tone where the values are grey.
const OF_NEPERS: [&str; 3] = ["rmse_nepers", "bias_nepers", "noise_nepers"];
const OF_A_FITTED_TONE: [&str; 2] = ["zncc", "ssim"];
const UNSUITABLE: &str = "of the session does not suit this frame";

/// What a console shows of a signal: a curve of it in 256 grey values.
fn shown(value: f64) -> f64 {
    (255.0 * (value / TRUE_AIR).clamp(0.0, 1.0).powf(0.4)).round()
}

/// The frame at `from` as a console exports it for eyes, by its tags.
fn for_presentation(from: &Path, to: &Path) {
    let mut object = dicom_object::open_file(from).expect("a frame");
    let values = object.element(tags::PIXEL_DATA).expect("pixels").to_multi_int::<u16>().expect("words");
    let grey: Vec<u16> = values.iter().map(|value| shown(f64::from(*value)) as u16).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(grey.into())));
    object.put(DataElement::new(tags::BITS_STORED, VR::US, PrimitiveValue::from(8u16)));
    object.put(DataElement::new(tags::HIGH_BIT, VR::US, PrimitiveValue::from(7u16)));
    put(&mut object, tags::PRESENTATION_INTENT_TYPE, VR::CS, "FOR PRESENTATION");
    put(&mut object, tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, "DISP");
    object.write_to_file(to).expect("written");
}

/// A session that has ended: its pairs by the names of their frames, its report.
struct Ended {
    pairs: BTreeMap<String, Value>,
    report: String,
}

impl Ended {
    fn pair(&self, frame: &str) -> &Value {
        self.pairs.get(frame).unwrap_or_else(|| panic!("no {frame} in {:?}", self.pairs.keys()))
    }
}

/// Runs a session on the `count` frames that lie in `folder`.
fn session(lab: &Lab, name: &str, (folder, count): (&str, usize), declare: impl FnOnce(&mut Value)) -> Ended {
    let file = lab.session(&format!("{name}.json"), |session| {
        session["robot"] = Value::Null;
        session["frames"]["folder"] = json!(folder);
        declare(session);
    });
    let mut live = Live::launch(&file, &lab.kit.join(name), &["--include-existing"]);
    let is_posed = |number: usize| live.stderr().lines().any(|line| line.starts_with(&format!("frame {number} (")));
    let all = eventually(HANG_S, || (1..=count).all(is_posed).then_some(()));
    assert!(all.is_some(), "{name}: {}", live.stderr());
    live.signalled(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("{name}: still there: {}", live.stderr()));
    // The C-arm, of which nothing is there but its calibration, is lost.
    assert!(matches!(status.code(), Some(0 | 3)), "{name}: {status:?} {}", live.stderr());
    let named = |pair: Value| (pair["frame"].as_str().expect("a name").to_owned(), pair);
    let found = Ended { pairs: pairs(&live).into_iter().map(named).collect(), report: live.report() };
    assert_eq!(found.pairs.len(), count, "{name}: {}", live.stderr());
    found
}

fn says(pair: &Value, words: &str) -> bool {
    pair["flags"].as_array().into_iter().flatten().filter_map(Value::as_str).any(|flag| flag.contains(words))
}

/// That there are the scores `there`, and none of `gone`, with a reason for each.
fn has_scores(pair: &Value, there: &[&str], gone: &[&str]) {
    let scores = &pair["scores"];
    for name in there {
        assert!(scores[name].is_f64() && scores["reasons"][name].is_null(), "{name}: {scores:#}");
    }
    for name in gone {
        let reason = scores["reasons"][name].as_str();
        assert!(scores[name].is_null() && reason.is_some_and(|reason| !reason.is_empty()), "{name}: {scores:#}");
    }
}

/// That a frame of grey values has no air level, whatever is declared, and no score that needs one.
fn is_grey(pair: &Value, domain: &str) {
    let air = &pair["air"];
    let reason = air["reason"].as_str().is_some_and(|reason| reason.contains(&format!("domain is {domain}")));
    assert!(air["rule"] == "unknown" && air["level"].is_null() && reason, "{air:#}");
    has_scores(pair, &[], &OF_NEPERS);
}

/// That a picture for eyes is compared through a curve that was fitted, which leaves all scores but those in nepers.
fn is_compared_through_a_curve(pair: &Value) {
    is_grey(pair, "display");
    let tone = &pair["tone"];
    assert!(tone["tone"] == "monotone" && tone["degrees_of_freedom"].as_u64().is_some_and(|count| count >= 2), "{tone:#}");
    has_scores(pair, &OF_A_TONE, &[]);
    assert!(pair["scores"]["zncc"].as_f64().is_some_and(|zncc| zncc > 0.9), "{:#}", pair["scores"]);
    assert!(pair["scores_without_tone"]["zncc"].is_null() && says(pair, "a monotone curve absorbs errors of kVp"), "{pair:#}");
}

/// That a picture of which nobody says what its values mean is compared without a tone: only scores that no curve changes are left.
fn is_compared_by_its_ranks(pair: &Value) {
    is_grey(pair, "unknown");
    assert_eq!(pair["tone"]["tone"], "none", "{:#}", pair["tone"]);
    has_scores(pair, &["rank_ncc", "gradient_ncc", "local_ncc", "edge_distance_mm"], &OF_A_FITTED_TONE);
    assert!(says(pair, "domain unknown: larger values are taken as more signal"), "{:#}", pair["flags"]);
}

fn bias_nepers(scores: &Value) -> f64 {
    scores["bias_nepers"].as_f64().unwrap_or_else(|| panic!("{scores:#}"))
}

/// One session has a linear frame, one that its tags say is for eyes, and an 8-bit PNG of which nothing says what its values mean. What is
/// declared is used for each as far as its domain allows; the rest is said, and is not said where nothing was declared.
#[test]
fn declared_tone_and_air_level_are_used_where_they_are_legal_and_said_where_not() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "3"]) else { return };
    for folder in ["mixed", "shown"] {
        std::fs::create_dir(lab.kit.join(folder)).expect("a folder");
    }
    let mixed = lab.kit.join("mixed");
    std::fs::copy(file_of(&lab, 1), mixed.join("frame-001.dcm")).expect("copied");
    for_presentation(&file_of(&lab, 2), &mixed.join("frame-002.dcm"));
    let grey = read_frame(&file_of(&lab, 3), None).expect("a frame").pixels.map(|value| shown(f64::from(*value)) as f32);
    for folder in ["mixed", "shown"] {
        write_png8(&lab.kit.join(folder).join("frame-003.png"), &grey);
    }

    let declared = session(&lab, "declared", ("mixed", 3), |session| {
        session["tone"] = json!("gain");
        session["air_level"] = json!(DECLARED_AIR);
    });
    let bare = session(&lab, "bare", ("mixed", 3), |_| ());
    let for_eyes = session(&lab, "for-eyes", ("shown", 1), |session| {
        session["domain"] = json!("display");
        session["tone"] = json!("monotone");
        session["air_level"] = json!(DECLARED_AIR);
    });

    // Linear: in nepers, on the declared level; one too low by 10 % is seen, and the declared gain takes it back.
    let [with, without] = [&declared, &bare].map(|ended| ended.pair("frame-001"));
    assert!(with["air"]["rule"] == "value" && with["air"]["level"] == DECLARED_AIR, "{:#}", with["air"]);
    assert!(with["tone"]["tone"] == "gain" && with["tone"]["degrees_of_freedom"] == 1, "{:#}", with["tone"]);
    assert!(without["air"]["rule"] == "open" && without["tone"]["tone"] == "none", "{:#} {:#}", without["air"], without["tone"]);
    let open = without["air"]["level"].as_f64().expect("a level");
    assert!((open / TRUE_AIR - 1.0).abs() < 0.01, "{open}");
    for pair in [with, without] {
        has_scores(pair, &OF_A_TONE, &[]);
        has_scores(pair, &OF_NEPERS, &[]);
        assert!(!says(pair, UNSUITABLE), "{:#}", pair["flags"]);
    }
    let apart = bias_nepers(&with["scores_without_tone"]) - bias_nepers(&without["scores_without_tone"]);
    assert!((apart - (DECLARED_AIR / open).ln()).abs() < 0.02, "{apart} nepers apart");
    assert!(bias_nepers(&with["scores"]).abs() < 0.04, "{:#}", with["scores"]);

    // For eyes by its tags: through a curve, whether a gain was declared or nothing.
    let [with, without] = [&declared, &bare].map(|ended| ended.pair("frame-002"));
    is_compared_through_a_curve(with);
    is_compared_through_a_curve(without);
    let said = format!("tone gain {UNSUITABLE}, whose domain is display: compared with monotone");
    assert!(says(with, &said) && !says(without, UNSUITABLE), "{:#} {:#}", with["flags"], without["flags"]);

    // Of unknown meaning, and the same picture in a session that says it.
    let [with, without] = [&declared, &bare].map(|ended| ended.pair("frame-003"));
    is_compared_by_its_ranks(with);
    is_compared_by_its_ranks(without);
    let unknown = format!("tone gain {UNSUITABLE}, whose domain is unknown: compared with none");
    assert!(says(with, &unknown) && !says(without, UNSUITABLE), "{:#} {:#}", with["flags"], without["flags"]);
    let told = for_eyes.pair("frame-003");
    is_compared_through_a_curve(told);
    assert!(!says(told, UNSUITABLE) && !says(told, "domain unknown"), "{:#}", told["flags"]);

    for words in [&*said, &*unknown, "air level 36000.0000 by rule value", "tone gain: 1 fitted numbers"] {
        assert!(declared.report.contains(words) && !bare.report.contains(words), "'{words}'");
    }
    assert!(bare.report.contains("by rule open") && !for_eyes.report.contains("by rule value"));
}

//! A session whose CT is a DICOM series: nothing of its patient and its names is written, and a replay finds the slices by their content.
#![cfg(unix)]

use std::path::Path;

use dicom_dictionary_std::tags;
use serde_json::{Value, json};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{VolumeSource, read_volume};

use crate::acquire_identity::{hits, written};
use crate::lab_truth::wait_for_pairs;
use crate::live_lab::{HANG_S, Lab, Live, Signal};
use crate::scene_support::tell_costs;
use crate::session_names::{far_copy, replay};
use crate::volume_files::{Sample, number, save_series};

/// The patient of the slices, their study, and what the folder is called.
const PERSONAL: [&str; 5] = ["quaxwelk", "annegrund", "pfriemk", "2.25.7777777", "wimmelrath"];

/// The CT of the kit as a series in `folder`.
fn as_series(ct: &Path, folder: &Path) {
    let volume = read_volume(ct, &Reporter::silent()).expect("the kit's CT");
    let hu = volume.values.iter().map(|hu| hu.round() as i16).collect();
    let mut slices = Sample { size: volume.size, lps_from_voxel: volume.lps_from_voxel, hu }.slices();
    for slice in &mut slices {
        number(slice, tags::BITS_STORED, 16);
        number(slice, tags::HIGH_BIT, 15);
    }
    save_series(&slices, folder);
}

#[test]
fn a_session_with_a_series_says_nothing_of_its_patient_and_replays() {
    let Some(lab) = Lab::start(&["--duration-s", "8", "--faults", "none", "--exposures", "3", "--idle-s", "300"]) else { return };
    let series = lab.kit.join("Wimmelrath");
    as_series(&lab.kit.join("ct.nii.gz"), &series);
    let mut scene: Value = serde_json::from_slice(&std::fs::read(lab.kit.join("scene.json")).expect("a scene")).expect("JSON");
    for object in scene["objects"].as_array_mut().expect("a list") {
        if let Some(path) = object.pointer_mut("/ct/path") {
            *path = json!("Wimmelrath");
        }
    }
    std::fs::write(lab.kit.join("scene-series.json"), scene.to_string()).expect("written");
    let session = lab.session("session-series.json", |session| session["scene"] = json!("scene-series.json"));
    let home = tempfile::tempdir().expect("a folder");
    let out = home.path().join("session");
    let mut live = Live::launch(&session, &out, &["--include-existing"]);
    wait_for_pairs(&live, 3);
    live.signalled(Signal::INT);
    let ended = live.program.end(HANG_S);
    assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{}", live.stderr());
    let outputs = written(&out);
    let found: Vec<_> = PERSONAL.iter().map(|word| (word, hits(&outputs, word))).filter(|(_, hits)| !hits.is_empty()).collect();
    assert!(found.is_empty(), "{found:?}");
    // The control: the hash of the series stands in log, report and beside every DRR.
    let sha256 = VolumeSource::open(&series).and_then(|source| source.content()).expect("the series").sha256;
    assert!(hits(&outputs, &sha256).len() >= 3, "{:?}", hits(&outputs, &sha256));

    let (elsewhere, nothing) = (tempfile::tempdir().expect("a folder"), tempfile::tempdir().expect("a folder"));
    tell_costs(nothing.path());
    let log = far_copy(&live.log, home.path());
    let data = elsewhere.path().join("data/below");
    std::fs::create_dir_all(&data).expect("folders");
    std::fs::copy(lab.kit.join("robot.json"), elsewhere.path().join("robot.json")).expect("copied");
    let (code, words) = replay(&log, Some(elsewhere.path()), nothing.path(), &elsewhere.path().join("none"));
    assert!(code == Some(1) && words.contains(&sha256), "the slices are not there yet, {code:?}: {words}");
    for (index, file) in std::fs::read_dir(&series).expect("slices").flatten().enumerate() {
        std::fs::copy(file.path(), data.join(format!("{index}"))).expect("copied");
    }
    let (code, words) = replay(&log, Some(elsewhere.path()), nothing.path(), &elsewhere.path().join("one"));
    assert!(code == Some(0), "{code:?}: {words}");
}

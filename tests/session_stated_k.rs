//! K in a session without a C-arm line, of frames whose header has none: what the session states, else what the beads tell, which is said.
#![cfg(unix)]

use std::path::Path;

use dicom_dictionary_std::tags;
use serde_json::{Value, json};

use crate::lab_truth::{pairs, poses, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal};
use crate::session_names::{far_copy, replay_words};

/// A session on the frame that lies there, with this file of K.
fn session(lab: &Lab, name: &str, k: Option<&str>) -> Live {
    let file = lab.session(&format!("{name}.json"), |session| {
        (session["carm"], session["robot"]) = (Value::Null, Value::Null);
        if let Some(k) = k {
            session["intrinsics"] = json!(k);
        }
    });
    let mut live = Live::launch(&file, &lab.kit.with_file_name(name), &["--include-existing"]);
    wait_for_pairs(&live, 1);
    live.signalled(Signal::INT);
    assert!(live.program.end(HANG_S).is_some(), "{}{}", live.stdout(), live.stderr());
    live
}

fn read(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("there")).expect("JSON")
}

/// A session said "accepted, rms 0.048 px" in green of a pose that was millimetres off in depth: K came from nine beads, and there was nowhere to
/// state it.
#[test]
fn a_session_states_k_and_says_where_nobody_did() {
    let Some(mut lab) = Lab::start_without_ct(&["--kit-only", "--exposures", "1"]) else { return };
    lab.mock.end(HANG_S).expect("it ends when it has drawn");
    let frame = std::fs::read_dir(lab.frames()).expect("frames").flatten().next().expect("a frame").path();
    let mut object = dicom_object::open_file(&frame).expect("a DICOM file");
    assert!(object.remove_element(tags::DISTANCE_SOURCE_TO_DETECTOR), "the control: its header has a distance");
    std::fs::remove_file(&frame).expect("removed");
    object.write_to_file(&frame).expect("written");

    let solved = session(&lab, "solved", None);
    let (words, pair) = (solved.stderr(), pairs(&solved).remove(0));
    assert!(words.contains("waiting for frames") && words.contains("listening to no line"), "{words}");
    let line = words.lines().find(|line| line.contains(": accepted, ")).unwrap_or_else(|| panic!("{words}"));
    assert!(line.contains("; K solved from the beads (f ") && line.contains(" ± "), "{line}");
    assert_ne!(pair["status"], "accepted", "{pair:#}");
    assert!(pair["flags"].to_string().contains("give intrinsics in the session, or the C-arm's calibration"), "{pair:#}");
    assert_eq!(pair["k_source"], "beads");
    assert!(pair["flags"].to_string().contains("K solved from the beads (f "), "{pair:#}");
    assert!(solved.report().contains("K solved from the beads"), "the report says it");

    let stated = session(&lab, "stated", Some("k.json"));
    let (pair, told) = (pairs(&stated).remove(0), poses(&stated).remove(0));
    assert!(!stated.stderr().contains("K solved"), "{}", stated.stderr());
    let k = read(&lab.kit.join("k.json"));
    assert_eq!((&told["pose"]["intrinsics_source"], &told["pose"]["intrinsics"]), (&json!("given"), &k["intrinsics"]));
    assert_eq!(pair["k_source"], "intrinsics");
    assert!(stated.report().contains("K of the session"), "the report says it");
    // A replay knows K by the log alone.
    let far = tempfile::tempdir().expect("a folder");
    let again = far.path().join("again");
    let log = far_copy(&stated.log, far.path());
    std::fs::rename(lab.kit.join("k.json"), lab.kit.join("elsewhere.json")).expect("renamed");
    let words = replay_words(&log, &again);
    assert_eq!(read(&again.join("pairs.json"))["pairs"][0]["k_source"], "intrinsics", "{words}");

    let mut other = k;
    other["size_px"] = json!([600, 470]);
    std::fs::write(lab.kit.join("other.json"), other.to_string()).expect("written");
    let refused = session(&lab, "refused", Some("other.json"));
    let pair = pairs(&refused).remove(0);
    assert_eq!(pair["status"], "refused", "{pair:#}");
    assert!(pair["reason"].as_str().is_some_and(|words| words.contains("which no binning gives")), "{pair:#}");
}

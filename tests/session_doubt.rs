//! Poses that fit and may be another one: a session says so and shows nothing in green.
#![cfg(unix)]

use serde_json::{Value, json};

use crate::crosscheck_session::{edit, live};
use crate::session_demo::mock_is_built;

/// All beads 3 % farther apart than they are, and nothing in the room tells: the beads fit 3 % deeper, the image does not.
#[test]
fn a_layout_of_another_scale_is_amber() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, report, words) = live(folder.path(), &["--no-robot"], |lab| {
        edit(lab, "beads.mrk.json", |beads| {
            for point in beads["markups"][0]["controlPoints"].as_array_mut().expect("a list") {
                for mm in point["position"].as_array_mut().expect("three numbers") {
                    *mm = json!(mm.as_f64().expect("a number") * 1.03);
                }
            }
        });
        edit(lab, "session.json", |session| session["world_from_lps"] = Value::Null);
    });
    for pair in &pairs {
        assert_eq!((&pair["status"], &pair["pose_source"]), (&json!("accepted_image_disagrees"), &json!("beads")), "{pair:#}");
        assert!(pair["reason"].as_str().is_some_and(|reason| reason.contains("image disagrees")), "{pair:#}");
    }
    assert!(pairs.len() >= 2 && words.contains(" 0 accepted") && !report.contains("badge good"), "{words}");
}

/// The session says that the specimen lies a hand's breadth from where it does.
#[test]
fn a_pose_far_from_where_it_is_expected_is_amber() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, report, words) = live(folder.path(), &["--no-robot"], |lab| {
        edit(lab, "session.json", |session| {
            let mm = session["world_from_lps"][1][3].as_f64().expect("a number");
            session["world_from_lps"][1][3] = json!(mm + 120.0);
        });
    });
    for pair in &pairs {
        assert_eq!(
            (&pair["status"], &pair["pose_source"]),
            (&json!("accepted_telemetry_disagrees"), &json!("beads")),
            "{pair:#}"
        );
        // What the pose itself doubts is not lost behind what telemetry says.
        assert!(pair["flags"].to_string().contains("away from it: check the prior"), "{pair:#}");
    }
    assert!(pairs.len() >= 2 && words.contains(" 0 accepted") && !report.contains("badge good"), "{words}");
    assert!(words.contains("doubtful pose"), "{words}");
}

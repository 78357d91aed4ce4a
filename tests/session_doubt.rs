//! Poses that fit and may be another one: a session says so, draws nothing green, and ties nothing to them.
#![cfg(unix)]

use serde_json::{Value, json};

use crate::crosscheck_session::{edit, live};
use crate::session_demo::mock_is_built;

/// All beads 3 % farther apart than they are, and nothing else that tells: no spheres in the scene, no place in the room.
#[test]
fn a_layout_of_another_scale_is_amber_and_ties_nothing() {
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
        println!(
            "{}",
            json!({"status": pair["status"], "reason": pair["reason"], "source": pair["pose_source"], "flags": pair["flags"]})
        );
    }
    println!("{words}");
    assert!(report.is_empty());
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
        println!(
            "{}",
            json!({"status": pair["status"], "reason": pair["reason"], "source": pair["pose_source"], "flags": pair["flags"]})
        );
    }
    println!("{words}");
    assert!(report.is_empty());
}

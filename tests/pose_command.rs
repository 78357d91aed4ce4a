//! `sidecarm pose convert` as it is typed.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};

use crate::pose_convert::{data, get};

fn convert(folder: &Path, words: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(["pose", "convert"]).args(words).current_dir(folder).output().expect("runs")
}

fn complaint(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(output.stdout.is_empty(), "{output:?}");
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A folder with POSE.json and K.json of a reference case.
fn folder() -> (tempfile::TempDir, Value) {
    let folder = tempfile::tempdir().expect("a folder");
    let file = data("opencv.json");
    let case = &file["cases"][0];
    let pose = json!({
        "status": "accepted", "projection": case["projection"], "intrinsics": case["intrinsics"], "size_px": case["size_px"],
        "pitch_mm": case["pitch_mm"], "camera_from_lps": case["camera_from_lps"]
    });
    let k = json!({"intrinsics": case["intrinsics"], "size_px": case["size_px"], "pitch_mm": case["pitch_mm"]});
    for (name, value) in [("POSE.json", &pose), ("K.json", &k)] {
        std::fs::write(folder.path().join(name), value.to_string()).expect("written");
    }
    (folder, pose)
}

fn rows(pose: &Value) -> [[f64; 4]; 3] {
    get(pose, "projection")
}

/// Largest difference relative to the largest entry.
fn off(found: &[[f64; 4]; 3], truth: &[[f64; 4]; 3]) -> f64 {
    let largest = truth.iter().flatten().fold(0.0f64, |largest, x| largest.max(x.abs()));
    found.iter().flatten().zip(truth.iter().flatten()).map(|(a, b)| (a - b).abs() / largest).fold(0.0, f64::max)
}

#[test]
fn a_pose_goes_out_and_comes_back_through_every_format() {
    let (folder, pose) = folder();
    let mut seen = 0;
    for format in ["matrix", "kr", "kr-json", "opencv", "rtk", "deepdrr", "xreg", "xreg-neg-z", "xreg-on-detector", "slicer"] {
        let out = convert(folder.path(), &["POSE.json", "--to", format, "--out", "there"]);
        assert_eq!(out.status.code(), Some(0), "{format}: {out:?}");
        assert!(out.stdout.is_empty() && !out.stderr.is_empty(), "the conventions are said: {out:?}");
        let back = convert(folder.path(), &["there", "--to", "pose", "--intrinsics", "K.json", "--out", "back.json"]);
        assert_eq!(back.status.code(), Some(0), "{format}: {back:?}");
        let found: Value =
            serde_json::from_slice(&std::fs::read(folder.path().join("back.json")).expect("written")).expect("JSON");
        let off = off(&rows(&found), &rows(&pose));
        assert!(off <= 1e-9, "{format}: {off:.1e}");
        assert_eq!(found["size_px"], pose["size_px"], "{format}");
        assert!(found["notes"][0].as_str().expect("a note").contains("no beads were judged"));
        seen += 1;
    }
    assert_eq!(seen, 10);
}

#[test]
fn the_answer_in_json_has_camera_angles_and_losses() {
    let (folder, pose) = folder();
    let out = convert(folder.path(), &["POSE.json", "--to", "slicer", "--json", "--position", "ffs"]);
    assert_eq!(out.status.code(), Some(0), "{out:?}");
    let answer: Value = serde_json::from_slice(&out.stdout).expect("one JSON object");
    assert_eq!((&answer["from"], &answer["to"], &answer["patient_position"]), (&json!("pose"), &json!("slicer"), &json!("FFS")));
    assert!(answer["text"].as_str().expect("text").starts_with("#Insight Transform File V1.0"));
    assert!(answer["loses"].as_str().expect("a loss").contains("--intrinsics"));
    for (convention, angle) in [("dicom", "primary"), ("device", "orbital"), ("deepdrr", "alpha"), ("xreg", "orbital")] {
        assert!(answer["angles_deg"][convention][angle].is_f64(), "{answer}");
    }
    assert!(off(&rows(&answer), &rows(&pose)) <= 1e-12);
    let written = convert(folder.path(), &["POSE.json", "--to", "slicer", "--json", "--out", "t.tfm"]);
    let answer: Value = serde_json::from_slice(&written.stdout).expect("one JSON object");
    assert_eq!(answer["out"], "t.tfm");
    assert!(answer.get("text").is_none());
}

#[test]
fn what_cannot_be_converted_is_said_in_one_sentence() {
    let (folder, pose) = folder();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("written");
    let changed = |key: &str, value: Value| {
        let mut pose = pose.clone();
        pose[key] = value;
        pose.to_string()
    };
    write("refused.json", r#"{"status": "refused", "reason": "too_few: 3 beads"}"#);
    write("unknown.json", &changed("colour", json!("red")));
    write("empty.json", r#"{"status": "accepted"}"#);
    let mut other = rows(&pose);
    other[0][3] += 10.0;
    write("contradiction.json", &changed("projection", json!(other)));
    write("prior.json", &json!({"camera_from_lps": pose["camera_from_lps"]}).to_string());
    write(
        "far.json",
        &json!({"intrinsics": pose["intrinsics"], "size_px": pose["size_px"], "R": [[1,0,0],[0,1,0],[0,0,1]], "t": [0, 0, 1e9]})
            .to_string(),
    );
    write("noise.bin", "what is this");
    let cases: [(&[&str], &str); 11] = [
        (
            &["refused.json", "--to", "matrix"],
            "refused.json: the pose was refused, so there is no projection to convert: too_few: 3 beads",
        ),
        (&["unknown.json", "--to", "matrix"], "unknown field `colour`"),
        (&["empty.json", "--to", "matrix"], "neither projection nor camera_from_lps"),
        (&["contradiction.json", "--to", "matrix"], "projection and intrinsics with camera_from_lps differ"),
        (&["prior.json", "--to", "matrix"], "matrix needs K; give --intrinsics K.json"),
        (&["far.json", "--to", "pose"], "is the pose in mm?"),
        (&["noise.bin", "--to", "pose"], "no pose in a format that is known here"),
        (&["absent.json", "--to", "pose"], "absent.json"),
        (&["POSE.json", "--to", "pose"], "is a pose file already"),
        (&["POSE.json", "--to", "matrix", "--out", "POSE.json"], "would overwrite an input"),
        (&["POSE.json", "--to", "rtk", "--pitch", "nan"], "--pitch is [NaN], expected one or two positive numbers"),
    ];
    for (words, expected) in cases {
        let found = complaint(&convert(folder.path(), words));
        assert!(found.contains(expected), "{words:?}: `{found}` does not say `{expected}`");
    }
    let usage = convert(folder.path(), &["POSE.json", "--to", "collada"]);
    assert_eq!(usage.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&usage.stderr).contains("expected one of pose, matrix"));
}

#[test]
fn a_pose_without_k_takes_it_from_the_option() {
    let (folder, pose) = folder();
    std::fs::write(folder.path().join("prior.json"), json!({"camera_from_lps": pose["camera_from_lps"]}).to_string())
        .expect("written");
    let out = convert(folder.path(), &["prior.json", "--to", "matrix", "--intrinsics", "K.json"]);
    assert_eq!(out.status.code(), Some(0), "{out:?}");
    assert_eq!(String::from_utf8_lossy(&out.stdout).lines().filter(|line| !line.starts_with('#')).count(), 3);
}

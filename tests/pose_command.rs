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
    let femur = json!({"name": "femur", "lps_from_body": [[1,0,0,5],[0,1,0,0],[0,0,1,0],[0,0,0,1]], "beads": 5, "used": 5});
    write("twice.json", &changed("bodies", json!([femur, femur])));
    let cases: [(&[&str], &str); 13] = [
        (
            &["refused.json", "--to", "matrix"],
            "refused.json: the pose was refused, so there is no projection to convert: too_few: 3 beads",
        ),
        (&["twice.json", "--to", "matrix"], "twice.json: at bodies[1].name: body \"femur\" stands there twice"),
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
        (
            &["POSE.json", "--to", "rtk", "--pitch", "1e30"],
            "--pitch is [1e30], expected one or two positive numbers, at most 100 mm",
        ),
    ];
    for (words, expected) in cases {
        let found = complaint(&convert(folder.path(), words));
        assert!(found.contains(expected), "{words:?}: `{found}` does not say `{expected}`");
    }
    let usage = convert(folder.path(), &["POSE.json", "--to", "collada"]);
    assert_eq!(usage.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&usage.stderr).contains("expected one of pose, matrix"));
}

/// As other systems' editors and tables write it: text with a byte order mark was of no format, or had an unknown key; so had semicolons.
#[test]
fn a_byte_order_mark_and_semicolons_are_read() {
    let (folder, pose) = folder();
    let read = |text: &str, what: &str| {
        std::fs::write(folder.path().join("marked"), text).expect("written");
        let back = convert(folder.path(), &["marked", "--to", "pose", "--intrinsics", "K.json", "--out", "back.json"]);
        assert_eq!(back.status.code(), Some(0), "{what}: {back:?}");
        let found: Value =
            serde_json::from_slice(&std::fs::read(folder.path().join("back.json")).expect("written")).expect("JSON");
        let off = off(&rows(&found), &rows(&pose));
        assert!(off <= 1e-9, "{what}: {off:.1e}");
    };
    let mut seen = 0;
    for format in ["matrix", "kr", "kr-json", "opencv", "rtk", "deepdrr", "xreg", "slicer"] {
        let out = convert(folder.path(), &["POSE.json", "--to", format]);
        let text = String::from_utf8(out.stdout).expect("text");
        read(&format!("\u{feff}{text}"), format);
        if matches!(format, "matrix" | "kr") {
            let numbers = |line: &str| if line.starts_with('#') { line.to_owned() } else { line.replace(' ', ";") };
            let lines = |end: &str| text.lines().map(|line| numbers(line) + end).collect::<Vec<_>>().join("\r\n");
            read(&lines(""), "semicolons");
            read(&lines(";"), "semicolons at the ends");
        }
        seen += 1;
    }
    assert_eq!(seen, 8);
    let pose_text = std::fs::read_to_string(folder.path().join("POSE.json")).expect("there");
    std::fs::write(folder.path().join("marked.json"), format!("\u{feff}{pose_text}")).expect("written");
    assert_eq!(convert(folder.path(), &["marked.json", "--to", "matrix"]).status.code(), Some(0));
    // Decimal commas between semicolons are no two numbers each.
    std::fs::write(folder.path().join("comma.txt"), "1,5;2\n1,5;2\n".repeat(2)).expect("written");
    assert!(complaint(&convert(folder.path(), &["comma.txt", "--from", "matrix", "--to", "pose"])).contains("1,5"));
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

/// Lengths in metres and a pose turned round are cameras as well, of another room.
#[test]
fn a_focal_spot_at_the_patient_and_a_patient_behind_it_are_said() {
    let (folder, pose) = folder();
    let right: [[f64; 4]; 4] = get(&pose, "camera_from_lps");
    let said = |rows: [[f64; 4]; 4]| {
        std::fs::write(folder.path().join("prior.json"), json!({"camera_from_lps": rows}).to_string()).expect("written");
        let out = convert(folder.path(), &["prior.json", "--to", "kr", "--intrinsics", "K.json"]);
        assert_eq!(out.status.code(), Some(0), "{out:?}");
        String::from_utf8_lossy(&out.stderr).into_owned()
    };
    let changed = |change: fn(&mut f64), rows: std::ops::Range<usize>| {
        let mut changed = right;
        changed[rows].iter_mut().for_each(|row| change(&mut row[3]));
        changed
    };
    assert!(!said(right).contains("warning: "), "control: {}", said(right));
    assert!(said(changed(|mm| *mm *= 1e-3, 0..3)).contains("are its lengths in metres?"));
    assert!(said(changed(|mm| *mm *= 10.0, 2..3)).contains("beyond the panel at"));
    assert!(said(changed(|mm| *mm *= -1.0, 2..3)).contains("mm behind the focal spot: is it the inverse of a pose"));
}

/// The pose of a mirrored frame went out as if its columns ran as stored: every overlay was left-right reversed.
#[test]
fn what_another_format_has_no_word_for_is_said() {
    let (folder, pose) = folder();
    let changed = |key: &str, value: Value| {
        let mut pose = pose.clone();
        pose[key] = value;
        std::fs::write(folder.path().join("other.json"), pose.to_string()).expect("written");
        let out = convert(folder.path(), &["other.json", "--to", "opencv", "--json"]);
        assert_eq!(out.status.code(), Some(0), "{out:?}");
        let answer: Value = serde_json::from_slice(&out.stdout).expect("one JSON object");
        (String::from_utf8_lossy(&out.stderr).into_owned(), answer["warnings"].as_array().expect("a list").len())
    };
    let (plain, none) = changed("mirrored", json!(false));
    assert!(!plain.contains("warning: ") && none == 0, "control: {plain}");
    let body = json!([{"name": "left femur", "lps_from_body": [[1,0,0,5],[0,1,0,0],[0,0,1,0],[0,0,0,1]], "beads": 5, "used": 5}]);
    let cases = [
        ("mirrored", json!(true), "warning: the frame is stored mirrored"),
        ("console", json!({"rotation_deg": 90.0}), "console's doing undone (turned back by 90 degrees)"),
        ("bodies", body, "where left femur moved since the scan is not kept"),
        ("cautions", json!(["few beads"]), "not kept: few beads"),
    ];
    for (key, value, expected) in cases {
        let (said, count) = changed(key, value);
        assert!(said.contains(expected) && count == 1, "{key}: {said}");
    }
}

/// One pitch beside a K of unequal focal lengths stood in files as if pixels were square; two that K contradicts were taken as well.
#[test]
fn pixels_that_are_not_square_are_said() {
    let (folder, pose) = folder();
    let pitch_mm: f64 = get(&pose, "pitch_mm");
    let mut k: [[f64; 3]; 3] = get(&pose, "intrinsics");
    let write = |name: &str, k: &[[f64; 3]; 3], pitch: Option<f64>| {
        let pose =
            json!({"intrinsics": k, "size_px": pose["size_px"], "pitch_mm": pitch, "camera_from_lps": pose["camera_from_lps"]});
        std::fs::write(folder.path().join(name), pose.to_string()).expect("written");
    };
    write("square.json", &k, Some(pitch_mm));
    k[1][1] *= 0.8;
    write("oblong.json", &k, Some(pitch_mm));
    write("bare.json", &k, None);
    let answer = |words: &[&str]| {
        let out = convert(folder.path(), &[words, &["--json"]].concat());
        assert_eq!(out.status.code(), Some(0), "{words:?}: {out:?}");
        let answer: Value = serde_json::from_slice(&out.stdout).expect("one JSON object");
        (get::<[f64; 2]>(&answer, "pitch_mm"), String::from_utf8_lossy(&out.stderr).into_owned())
    };
    let ([_, rows_mm], said) = answer(&["square.json", "--to", "xreg"]);
    assert!((rows_mm - pitch_mm).abs() < 1e-12 && !said.contains("warning: "), "control: {said}");
    for format in ["xreg", "rtk", "deepdrr", "kr-json", "opencv"] {
        let ([columns_mm, rows_mm], said) = answer(&["oblong.json", "--to", format]);
        assert!((columns_mm - pitch_mm).abs() < 1e-12 && (rows_mm / pitch_mm - 1.25).abs() < 1e-9, "{format}: {rows_mm}");
        assert!(said.contains("warning: pixels are not square by K"), "{format}: {said}");
    }
    let fitting = format!("0.2,{}", 0.2 * 1.25);
    let ([_, rows_mm], said) = answer(&["bare.json", "--to", "kr-json", "--pitch", &fitting, "--out", "kr.json"]);
    assert!((rows_mm - 0.25).abs() < 1e-12 && !said.contains("warning: "), "two that fit: {said}");
    let (_, said) = answer(&["kr.json", "--to", "pose"]);
    assert!(said.contains("a pose file keeps one pitch_mm, that between columns (0.2 mm)"), "{said}");
    let (_, said) = answer(&["square.json", "--to", "xreg", "--pitch", "9"]);
    assert!(said.contains("--pitch 9,9 is not used: POSE has its own"), "{said}");
    std::fs::write(folder.path().join("other-k.json"), json!({"intrinsics": k}).to_string()).expect("written");
    let (_, said) = answer(&["square.json", "--to", "kr-json", "--size", "9,7", "--intrinsics", "other-k.json"]);
    assert!(said.contains("--size 9,7 is not used: POSE has its own"), "{said}");
    assert!(said.contains("K of --intrinsics") && said.contains("is not used: POSE has its own (fx"), "{said}");
    let refused = complaint(&convert(folder.path(), &["bare.json", "--to", "xreg", "--pitch", "0.2,0.3"]));
    assert!(refused.contains("pixels of 0.2 by 0.3 mm contradict K, by which rows are 0.250000 mm apart"), "{refused}");
}

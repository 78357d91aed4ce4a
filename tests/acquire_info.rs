//! `sidecarm info`: every kind of file is recognised, unknown and damaged ones are refused with words.

use std::path::Path;

use sidecarm::cli::info::{InfoArgs, InfoError, examine, run};
use sidecarm::record::{Provenance, Recorder};
use sidecarm::reporter::Reporter;

use crate::acquire_frames::{fluoroscopy, save};

fn write(folder: &Path, name: &str, text: &str) -> std::path::PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, text).expect("file");
    path
}

#[test]
fn text_files_are_recognised_by_what_they_hold() {
    let folder = tempfile::tempdir().expect("folder");
    let markups =
        r#"{"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [{"label": "b1"}, {"label": "b2"}]}]}"#;
    let fcsv = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n\
                1,1.5,2,3,0,0,0,1,1,1,0,tip,,\n";
    let cases = [
        ("beads.mrk.json", markups, "markups"),
        ("points.fcsv", fcsv, "markups"),
        ("scene.json", r#"{"objects": [{"sphere": {}}], "beam": {"tube_kvp": 90}}"#, "scene"),
        ("pose.json", r#"{"status": "refused", "reason": "too few beads", "beads": []}"#, "pose"),
        ("k.json", r#"{"intrinsics": [[1,0,0],[0,1,0],[0,0,1]], "size_px": [2, 2]}"#, "intrinsics"),
        ("session.json", r#"{"frames": {"folder": "x"}, "scene": "s.json"}"#, "session"),
        ("pairs.json", r#"{"pairs": []}"#, "pairs"),
        ("arm.json", r#"{"origin": "nominal", "detector": {}}"#, "calibration"),
    ];
    for (name, text, kind) in cases {
        let info = examine(&write(folder.path(), name, text)).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(info.facts["kind"], kind, "{name}");
        assert!(info.losses.is_empty());
    }
    let info = examine(&folder.path().join("points.fcsv")).expect("known");
    assert_eq!(info.facts["names"], serde_json::json!(["tip"]));
}

#[test]
fn what_is_not_known_is_said() {
    let folder = tempfile::tempdir().expect("folder");
    let cases = [
        ("x.json", r#"{"colour": "blue"}"#, "keys colour"),
        ("cut.json", r#"{"objects": ["#, "line 1"),
        ("list.json", "[1, 2]", "no object"),
        ("x.fcsv", "1,a,b,c\n", "line 1"),
        ("x.bin", "some bytes", "not a kind of file"),
        ("empty", "", "an empty file"),
        ("x.nii", "short", "NIfTI volume is damaged"),
        ("x.stl", "solid", "STL mesh is damaged"),
    ];
    for (name, text, words) in cases {
        let error = examine(&write(folder.path(), name, text)).expect_err(name).to_string();
        assert!(error.contains(words) && error.contains(name), "{name}: {error}");
    }
    assert!(matches!(examine(folder.path()), Err(InfoError::NoVolume { .. })));
    assert!(matches!(examine(&folder.path().join("none")), Err(InfoError::Io { .. })));
}

#[test]
fn a_cut_log_gives_exit_code_3_and_a_frame_0() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("s.mcap");
    let recorder = Recorder::create(&path, &Provenance::of_this_program(5, serde_json::Value::Null)).expect("created");
    recorder.raw_bytes("carm", 1, 2_000_005, &[1, 2]).expect("recorded");
    recorder.finish().expect("finished");
    let code = |file: &Path| run(&InfoArgs { file: file.to_owned(), json: true }, &Reporter::silent()).expect("readable");
    assert_eq!(code(&path), 0);
    let info = examine(&path).expect("readable");
    assert_eq!(info.facts["topics"]["/carm/raw"]["messages"], 1);
    assert_eq!(info.facts["duration_s"], 2.0);
    let bytes = std::fs::read(&path).expect("bytes");
    std::fs::write(&path, &bytes[..bytes.len() - 3]).expect("cut");
    assert_eq!(code(&path), 3);
    assert_eq!(code(&save(fluoroscopy(), &folder.path().join("f.dcm"))), 0);
}

#[test]
fn a_volume_shows_its_size_orientation_and_range() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("v.nii.gz");
    let header = nifti::NiftiHeader {
        qform_code: 0,
        sform_code: 1,
        srow_x: [-2.0, 0.0, 0.0, 10.0],
        srow_y: [0.0, 0.0, -3.0, 20.0],
        srow_z: [0.0, 4.0, 0.0, 30.0],
        ..Default::default()
    };
    let values = ndarray::Array3::from_shape_fn((2, 3, 4), |(i, j, k)| (i + 10 * j + 100 * k) as f32 - 1000.0);
    nifti::writer::WriterOptions::new(&path).reference_header(&header).write_nifti(&values).expect("written");
    let info = examine(&path).expect("readable");
    assert_eq!(info.facts["size"], serde_json::json!([2, 3, 4]));
    assert_eq!(info.facts["orientation"], "LSP");
    assert_eq!(info.facts["spacing_mm"], serde_json::json!([2.0, 4.0, 3.0]));
    assert_eq!(info.facts["value_range"], serde_json::json!([-1000.0, -679.0]));
    let bytes = std::fs::read(&path).expect("bytes");
    for length in [0, 10, 40, bytes.len() - 9] {
        std::fs::write(&path, &bytes[..length]).expect("cut");
        assert!(matches!(examine(&path), Err(InfoError::Damaged { .. })), "{length} of {}", bytes.len());
    }
}

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
        // What a session, a kit and the other commands write; a kit's truth has beads and frames, as a session has.
        (
            "truth.json",
            r#"{"frames": [{"frame": "a"}], "landmarks": [], "beads": [], "air_value": 40000, "world_from_lps": []}"#,
            "truth",
        ),
        ("timings.json", r#"{"frames": [{"number": 1, "stages_ms": {"render": 5}}]}"#, "timings"),
        ("timings.json", r#"{"frames": []}"#, "timings"),
        ("POSES.json", r#"{"status": "accepted", "frames": ["a"], "views": [], "beads": [], "bumps": []}"#, "poses"),
        (
            "compare.json",
            r#"{"version": "1", "acquired": {}, "simulated": {}, "comparison": {}, "image_prefers": null}"#,
            "comparison",
        ),
        ("trade.json", r#"{"size_px": [2, 2], "adapter": "cpu", "judged_rays": 4, "judged": "x", "rows": [1, 2]}"#, "trade"),
        ("score.json", r#"{"beads": 8, "extents_mm": [3, 2, 1], "flatness": 0.3, "views": [], "notes": []}"#, "layout_score"),
        ("attached.json", r#"{"exposures": 8, "frames_in_log": 0, "console": null, "frames": [{}], "losses": []}"#, "attachment"),
        ("tags.json", r#"{"family": "tag36h11", "tags": [{"id": 1}]}"#, "tags"),
        ("marks.json", r#"{"correspondences": [{"bead": "B1", "image_px": [1, 2]}]}"#, "correspondences"),
        ("net.json", r#"{"weights_sha256": "00", "held_out": []}"#, "network"),
        ("console.json", r#"{"rotation_deg": 90, "flip": "horizontal"}"#, "console"),
        ("scatter.tif.checkpoint", r#"{"tally": {}, "histories_per_batch": 9, "seed": 1}"#, "scatter_checkpoint"),
        ("arm.report.json", r#"{"origin": "x", "shots": [], "left_out": [], "chi2_per_dof": 1.0}"#, "calibration_report"),
        ("robot.report.json", r#"{"calibration": {}, "shots": [], "left_out": [], "chi2_per_dof": 1.0}"#, "calibration_report"),
        ("phantom.report.json", r#"{"frame": "x", "beads": [], "shots": [], "scale": {}}"#, "phantom_report"),
        ("joints.csv", "shot,orbital_deg\na,1\nb,2\n", "table"),
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
fn what_a_bead_s_description_probably_means_is_said() {
    let folder = tempfile::tempdir().expect("folder");
    let file = |name: &str, words: &str| {
        let point = format!(r#"{{"label": "b1", "position": [1, 2, 3], "description": "{words}"}}"#);
        let text = format!(r#"{{"markups": [{{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [{point}]}}]}}"#);
        examine(&write(folder.path(), name, &text)).expect("known").facts
    };
    let doubted = file("wrong.mrk.json", "radius=0.75");
    assert!(doubted["doubts"][0].as_str().is_some_and(|words| words.contains("radius_mm=0.75")), "{doubted:?}");
    assert!(file("right.mrk.json", "radius_mm=0.75").get("doubts").is_none(), "the control");
}

/// Nothing said of beads in metres that they lie within less than a millimetre.
#[test]
fn how_far_beads_reach_is_said() {
    let folder = tempfile::tempdir().expect("folder");
    let point = |name: &str, x: f64| format!(r#"{{"label": "{name}", "position": [{x}, 2, 3]}}"#);
    let points = [point("a", 0.0), point("b", 30.0), point("c", 60.0)].join(", ");
    let text = format!(r#"{{"markups": [{{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [{points}]}}]}}"#);
    let facts = examine(&write(folder.path(), "beads.mrk.json", &text)).expect("known").facts;
    assert_eq!((&facts["beads"], &facts["span_mm"]), (&serde_json::json!(3), &serde_json::json!(60.0)));
    // √((30² + 0 + 30²) / 3)
    assert_eq!(facts["extents_mm"], serde_json::json!([24.495, 0.0, 0.0]));
    assert!(facts["extent"].as_str().is_some_and(|words| words.contains("3 beads, 60 mm between")), "{facts:?}");
}

/// Counts kept as floats were not saturated where the same picture in 16 bits was.
#[test]
fn floats_that_end_in_a_spike_at_the_end_of_digits_are_saturated_there() {
    let folder = tempfile::tempdir().expect("folder");
    let share = |full: f32| {
        let path = folder.path().join("counts.tif");
        let image = sidecarm::image::Image { width: 4, height: 2, pixels: vec![full, full, full, full, full, full, 100.5, 7.0] };
        sidecarm::image::write_tiff_f32(&path, &[image]).expect("written");
        let info = examine(&path).expect("known");
        let image = &info.facts["images"][0];
        let is_said = image["notes"].to_string().contains(&format!("many stand at {full}, the most that"));
        let share = image["clipping"]["saturated_share"].as_f64();
        assert_eq!(is_said, share > Some(0.0), "who saturates what was stored as floats says so: {image:#}");
        share
    };
    assert_eq!(share(65535.0), Some(0.75));
    // Grey values that were scaled until air is flat.
    assert_eq!(share(255.0), Some(0.75));
    assert_eq!(share(65000.0), Some(0.0), "the control");
    // The most signal is at the other end, of which the spike says nothing.
    write(folder.path(), "counts.tif.json", r#"{"quantity": "line_integral", "unit": "1"}"#);
    assert_eq!(share(65535.0), Some(0.0), "a logarithm");
}

/// A label with a comma was cut at it, and the column behind it was taken for the next; a spreadsheet's file was damaged.
#[test]
fn labels_in_quotes_are_listed_as_they_are_meant() {
    let folder = tempfile::tempdir().expect("folder");
    let text = "\u{feff}# Markups fiducial file version = 4.11\r\n# CoordinateSystem = LPS\r\n# columns = id,x,y,z,desc,label\r\n\
                1,1.5,2,3,\"steel, 1.5 mm\",\"hip, \"\"left\"\"\"\r\n\r\n2, 4,5 ,6,,knee\r\n \r\n";
    let info = examine(&write(folder.path(), "points.fcsv", text)).expect("known");
    assert_eq!(info.facts["names"], serde_json::json!(["hip, \"left\"", "knee"]));
    assert_eq!((&info.facts["points"], &info.facts["coordinate_system"]), (&serde_json::json!(2), &serde_json::json!("LPS")));
    let error = examine(&write(folder.path(), "wrong.fcsv", &text.replace("2, 4,5 ,6", "\"2,4,5,6\""))).expect_err("one cell");
    assert!(error.to_string().contains("line 6"), "{error}");
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
        ("x.csv", "a,b\n1,2,3\n", "table is damaged"),
        ("x.safetensors", "12345678{}", "longer than the file"),
    ];
    for (name, text, words) in cases {
        let error = examine(&write(folder.path(), name, text)).expect_err(name).to_string();
        assert!(error.contains(words) && error.contains(name), "{name}: {error}");
    }
    assert!(matches!(examine(folder.path()), Err(InfoError::NoVolume { .. })));
    assert!(matches!(examine(&folder.path().join("none")), Err(InfoError::Io { .. })));
}

/// `info` called the network that comes with the program "not a kind of file that is known here".
#[test]
fn networks_that_come_with_the_program_are_known_and_a_cut_one_is_a_loss() {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/networks");
    let folder = tempfile::tempdir().expect("folder");
    for name in ["scatter", "materials"] {
        let weights = shipped.join(format!("{name}.safetensors"));
        let info = examine(&weights).expect("known");
        assert_eq!(info.facts["kind"], "tensors");
        assert!(info.losses.is_empty() && info.facts["values"].as_u64().is_some_and(|values| values > 1000), "{:?}", info.facts);
        assert_eq!(examine(&shipped.join(format!("{name}.json"))).expect("known").facts["kind"], "network");
        let (cut, bytes) = (folder.path().join(format!("{name}.safetensors")), std::fs::read(&weights).expect("readable"));
        std::fs::write(&cut, &bytes[..bytes.len() - 7]).expect("written");
        assert_eq!(examine(&cut).expect("its header is there").losses.len(), 1);
    }
}

/// `info` called the spectra that come with the program damaged: their rows hold as many fluences as the tube voltage has bins.
#[test]
fn spectra_that_come_with_the_program_are_a_table() {
    let spectra = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/spectra/tungsten.csv");
    let info = examine(&spectra).expect("known");
    assert_eq!((&info.facts["kind"], info.facts["columns"].as_array().map(Vec::len)), (&"table".into(), Some(5)));
    let lines = std::fs::read_to_string(&spectra).expect("readable").lines().filter(|line| !line.starts_with('#')).count();
    assert_eq!(info.facts["rows"].as_u64(), Some(lines as u64 - 1));
    let folder = tempfile::tempdir().expect("folder");
    let short = examine(&write(folder.path(), "short.csv", "kvp,fluence...\n40,1,2\n50\n")).expect_err("no fluence").to_string();
    assert!(short.contains("line 3 has 1 cells, the line of names 2"), "{short}");
}

/// A byte order mark before the text is no part of it.
#[test]
fn a_byte_order_mark_hides_no_kind() {
    let folder = tempfile::tempdir().expect("folder");
    let cases = [
        ("k.json", r#"{"intrinsics": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "size_px": [2, 2]}"#, "intrinsics"),
        ("joints.csv", "shot,orbital_deg\na,1\n", "table"),
        ("camera.txt", "1000 0 300 0\n0 1000 200 0\n0 0 1 500\n", "camera"),
    ];
    for (name, text, kind) in cases {
        let info =
            examine(&write(folder.path(), name, &format!("\u{feff}{text}"))).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(info.facts["kind"], kind, "{name}");
    }
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

//! `sidecarm info` knows what this program itself writes: a file of each writer, made by that writer.

use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};
use sidecarm::calibrate::beads::point_list;
use sidecarm::calibrate::layout::{PlannedView, map};
use sidecarm::cli::info::{Info, InfoError, examine};
use sidecarm::geometry::Rigid;
use sidecarm::geometry::formats::{Format, write};
use sidecarm::image::plot::{Axis, Plot, Scale, Series};
use sidecarm::image::{Image, write_png_rgb};
use sidecarm::pose::{Pose, Refusal};
use sidecarm::record::{Provenance, Recorder};
use sidecarm::render::trade::Trade;
use sidecarm::report::{Pair, SessionReport, write_session};

use crate::pose_convert::Draw;

fn known(path: &Path) -> Info {
    examine(path).unwrap_or_else(|error| panic!("{error}"))
}

/// What is there of a whole file, which loses nothing.
fn facts(path: &Path) -> Value {
    let info = known(path);
    assert!(info.losses.is_empty(), "{:?}", info.losses);
    Value::Object(info.facts)
}

/// The same file without its last bytes.
fn cut(path: &Path, by: usize) -> std::path::PathBuf {
    let (bytes, cut) = (std::fs::read(path).expect("readable"), path.with_file_name("cut"));
    std::fs::write(&cut, &bytes[..bytes.len() - by]).expect("written");
    cut
}

#[test]
fn a_report_is_told_from_other_pages() {
    let folder = tempfile::tempdir().expect("folder");
    let title = "The <left> hip & \"the right\"";
    let mut report = SessionReport { title: title.into(), ..SessionReport::default() };
    report.pairs = ["frame-1", "frame-2"].map(|frame| Pair::unmatched(frame, "no beads")).to_vec();
    report.provenance.version = "9.8".into();
    assert!(write_session(folder.path(), &report).is_empty());
    let page = folder.path().join("report.html");
    let found = facts(&page);
    assert_eq!((&found["kind"], &found["title"]), (&json!("report"), &json!(title)));
    assert_eq!((&found["exposures"], &found["version"]), (&json!(2), &json!("9.8")));
    assert_eq!(known(&cut(&page, 30)).losses.len(), 1);
    let pairs = facts(&folder.path().join("pairs.json"));
    assert_eq!((&pairs["kind"], &pairs["pairs"]), (&json!("pairs"), &json!(2)));
    let other = folder.path().join("other.html");
    std::fs::write(&other, "<!doctype HTML>\n<html><title>Weather</title></html>\n").expect("written");
    assert!(matches!(examine(&other), Err(InfoError::Unknown { found, .. }) if found.contains("HTML")), "the control");
}

#[test]
fn drawings_have_their_title_and_pictures_in_colour_their_size() {
    let folder = tempfile::tempdir().expect("folder");
    let at = |name: &str| folder.path().join(name);
    let axis = |label: &str| Axis::new(label, Scale::Linear);
    let series = vec![Series { points: vec![[0.0, 1.0], [1.0, 3.0]], ..Series::default() }];
    let plot = Plot { title: "Error & <time>".into(), x: axis("time / ms"), y: axis("error"), series, ..Plot::default() };
    std::fs::write(at("trade.svg"), plot.svg().expect("drawn")).expect("written");
    let found = facts(&at("trade.svg"));
    assert_eq!((&found["kind"], &found["title"]), (&json!("drawing"), &json!("Error & <time>")));
    assert_eq!(found["size"], json!([760.0, 460.0]));
    let view = PlannedView {
        orbital_deg: 30.0,
        angulation_deg: 0.0,
        in_view: 7,
        turn_deg: None,
        centroid_mm: Some([0.1, 0.2, 0.9]),
        landmarks_mm: Vec::new(),
    };
    std::fs::write(at("map"), map(&[view]).expect("a map")).expect("written");
    let found = facts(&at("map"));
    assert!(found["kind"] == "drawing" && found["title"].as_str().is_some_and(|title| title.starts_with("predicted")), "{found}");
    assert!(found["size"].as_array().is_some_and(|size| size.len() == 2), "{found}");
    assert!(matches!(examine(&cut(&at("trade.svg"), 20)), Err(InfoError::Damaged { kind: "SVG drawing", .. })));

    // A strip; a grey picture is a frame, whoever wrote it.
    write_png_rgb(&at("strip.png"), &Image::filled(5, 3, [200, 30, 30])).expect("written");
    let found = facts(&at("strip.png"));
    assert_eq!((&found["kind"], &found["size_px"]), (&json!("picture"), &json!([5, 3])));
    write_png_rgb(&at("grey.png"), &Image::filled(5, 3, [200; 3])).expect("written");
    assert_eq!(facts(&at("grey.png"))["kind"], "frame");
}

#[cfg(feature = "vision")]
#[test]
fn a_video_says_how_long_it_is() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("pairs.avi");
    let mut video = sidecarm::image::VideoFile::create(&path, [64, 48], 2.0).expect("begun");
    video.add(&Image::filled(64, 48, [200, 30, 30]), 3).expect("added");
    video.finish().expect("written");
    let found = facts(&path);
    assert_eq!((&found["kind"], &found["compression"]), (&json!("video"), &json!("MJPG")));
    assert_eq!((&found["size_px"], &found["pictures"], &found["duration_s"]), (&json!([64, 48]), &json!(3), &json!(1.5)));
    assert_eq!(known(&cut(&path, 9)).losses.len(), 1);
    std::fs::write(&path, b"RIFF\x04\0\0\0AVI ").expect("written");
    assert!(matches!(examine(&path), Err(InfoError::Damaged { kind: "AVI video", .. })));
}

/// Whatever they are called: `pose convert` writes to any name.
#[test]
fn cameras_of_other_programs_are_known_by_what_they_hold() {
    let folder = tempfile::tempdir().expect("folder");
    let camera = Draw(17).camera(None);
    for format in Format::ALL {
        let path = folder.path().join(format!("camera-{format}"));
        std::fs::write(&path, write(format, &camera, format.usual_axes()).expect("can be written")).expect("written");
        let found = facts(&path);
        assert_eq!((&found["kind"], &found["format"]), (&json!("camera"), &json!(format.name())));
        let placed: Rigid = serde_json::from_value(found["camera_from_lps"].clone()).expect("a pose");
        let off_mm = placed.translation_mm.distance(camera.camera_from_lps.translation_mm);
        assert!(off_mm < 1e-6 && placed.angle_to_rad(&camera.camera_from_lps) < 1e-9, "{format}: {off_mm} mm");
        // K is told where the file has it, and is not made up where it has not.
        assert_eq!(found["intrinsics"].is_null(), matches!(format, Format::Rtk | Format::Slicer), "{format}: {found}");
        assert_eq!(found["lacks"].is_null(), format.loses().is_none(), "{format}");
    }
    let refused = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).expect("written");
        examine(&path).expect_err(name)
    };
    let error = refused("camera.yml", "%YAML:1.0\n---\ncamera_matrix: 3\n");
    assert!(matches!(error, InfoError::Damaged { kind: "camera of another program", .. }), "{error}");
    for (name, text) in [("compose.yml", "services:\n  a: 1\n"), ("notes.txt", "[1, 2, \"three\"]"), ("words.xml", "<a>1</a>")] {
        let error = refused(name, text);
        assert!(matches!(error, InfoError::Unknown { .. }), "{name}: {error}");
    }
}

/// They came out as calibrations.
#[test]
fn adapters_of_telemetry_say_which_lines_of_what_device() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration");
    let of = |name: &str| facts(&folder.join("telemetry").join(name));
    for (name, lines, time, device) in [
        ("generic-robot-csv.json", "csv", "of the device's clock", "robot"),
        ("generic-robot-json.json", "json", "of arrival", "robot"),
        ("generic-carm-regex.json", "regex", "of the device's clock", "carm"),
    ] {
        let found = of(name);
        assert_eq!((&found["kind"], &found["lines"], &found["time"]), (&json!("adapter"), &json!(lines), &json!(time)), "{name}");
        for other in ["carm", "robot"] {
            assert_eq!(found[other].is_array(), other == device, "{name}: {found}");
        }
    }
    assert!(of("generic-robot-csv.json")["robot"].to_string().contains("sensed_angles"));
    assert_eq!(facts(&folder.join("robot/cdm.json"))["kind"], "calibration", "the control");
}

#[test]
fn what_commands_leave_behind_is_known() {
    let folder = tempfile::tempdir().expect("folder");
    let at = |name: &str| folder.path().join(name);
    let scene = json!({
        "objects": [{"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 20, "material": "water"}}],
        "view": {"size_px": [32, 24], "intrinsics": [[1000, 0, 15.5], [0, 1000, 11.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
        "beam": {"mono_kev": 60, "photons_per_pixel": 1e5},
        "detector": {"response": "energy", "pitch_mm": 1.0}
    });
    std::fs::write(at("scene.json"), scene.to_string()).expect("written");
    for words in [
        "render scene.json --device cpu --out drr.tif --png drr.png --dicom drr.dcm",
        "render scene.json --device cpu --quantity line_integral --out line.tif",
        "scatter scene.json --device cpu --histories 65536 --grid-px 4x3 --out scatter.tif --dose dose.nii.gz",
        "attenuation water --kev 20,60 --plot water.svg",
    ] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        let ran = command.args(words.split(' ')).current_dir(folder.path()).output().expect("it starts");
        assert_eq!(ran.status.code(), Some(0), "{words}: {}", String::from_utf8_lossy(&ran.stderr));
    }
    let (adapter, judged) = ("a processor".to_owned(), "line integrals".to_owned());
    let trade = Trade { size_px: [32, 24], adapter, judged_rays: 768, judged, rows: Vec::new() };
    std::fs::write(at("trade.txt"), trade.table()).expect("written");
    std::fs::write(at("trade.json"), serde_json::to_string(&trade).expect("JSON")).expect("written");
    Pose::default().refused_for(Refusal::Unsolved).write(&at("POSE.json")).expect("written");
    let points = point_list(std::iter::once(("b1".to_owned(), [1.0, 2.0, 3.0], "radius_mm=0.75".to_owned())));
    std::fs::write(at("beads.mrk.json"), points.to_string()).expect("written");
    Recorder::create(&at("s.mcap"), &Provenance::of_this_program(5, Value::Null)).expect("begun").finish().expect("finished");
    for (name, kind) in [
        ("scene.json", "scene"),
        ("drr.tif", "frame"),
        ("drr.tif.json", "image_description"),
        ("drr.png", "frame"),
        ("drr.dcm", "frame"),
        ("line.tif", "frame"),
        ("scatter.tif", "frame"),
        ("dose.nii.gz", "volume"),
        ("dose.nii.gz.error.nii.gz", "volume"),
        ("dose.nii.gz.json", "image_description"),
        ("scatter.tif.json", "image_description"),
        ("water.svg", "drawing"),
        ("trade.txt", "trade"),
        ("trade.json", "trade"),
        ("POSE.json", "pose"),
        ("beads.mrk.json", "markups"),
        ("s.mcap", "log"),
    ] {
        assert_eq!(facts(&at(name))["kind"], kind, "{name}");
    }
    assert_eq!(facts(&at("trade.txt"))["size"], "32 x 24");
    check_what_images_show(folder.path());
}

/// Eight images of scatter without names, and a map of dose that was taken for labels, for all that the description beside them says.
fn check_what_images_show(folder: &Path) {
    let at = |name: &str| folder.join(name);
    for (name, domain, unit) in [("drr.tif", "linear", "1"), ("line.tif", "log", "neper"), ("scatter.tif", "linear", "1")] {
        let found = facts(&at(name));
        let images = found["images"].as_array().expect("images");
        assert!(images.iter().all(|image| image["domain"] == domain && image["unit"] == unit), "{name}: {found}");
        assert!(images.iter().all(|image| image.get("number").is_none()), "{name}: {found}");
    }
    let pages = || -> Vec<Value> {
        facts(&at("scatter.tif"))["images"].as_array().expect("images").iter().map(|image| image["page"].clone()).collect()
    };
    let described: Value = serde_json::from_slice(&std::fs::read(at("scatter.tif.json")).expect("beside it")).expect("JSON");
    assert_eq!(json!(pages()), described["pages"]);
    assert!(pages().len() == 8 && pages()[7] == "multiple_standard_error", "{:?}", pages());

    let is_doubted = |found: &Value| found["notes"].to_string().contains("Hounsfield");
    for (name, quantity) in [("dose.nii.gz", "dose"), ("dose.nii.gz.error.nii.gz", "standard error of the dose")] {
        let found = facts(&at(name));
        assert_eq!((&found["quantity"], &found["unit"]), (&json!(quantity), &json!("Gy")), "{name}");
        assert!(!is_doubted(&found), "{found}");
    }
    // Names of other pages, and a map of another size, are not believed.
    for (name, key, other) in [("scatter.tif.json", "pages", json!(["one"])), ("dose.nii.gz.json", "size", json!([1, 2, 3]))] {
        let mut told: Value = serde_json::from_slice(&std::fs::read(at(name)).expect("there")).expect("JSON");
        told[key] = other;
        std::fs::write(at(name), told.to_string()).expect("written");
    }
    assert!(pages().iter().all(Value::is_null), "the control");
    let found = facts(&at("dose.nii.gz"));
    assert!(found["quantity"].is_null() && is_doubted(&found), "the control: {found}");
}

//! Bad input through the program itself: exit code, one clear sentence, no panic, nothing written.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};

use crate::scene_support::NiftiFile;

const INPUTS: [&str; 3] = ["tool.stl", "ct.nii", "beam.csv"];

fn scene() -> Value {
    json!({
        "objects": [
            {"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 20, "material": "water"}},
            {"ct": {"path": "ct.nii"}},
            {"robot": {"model": "calibration/robot/cdm.json",
                       "lps_from_base": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}},
            {"mesh": {"path": "tool.stl", "material": "titanium",
                      "lps_from_mesh": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}],
        "view": {"size_px": [16, 12], "intrinsics": [[500, 0, 7.5], [0, 500, 5.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
        "beam": {"tube_kvp": 80, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
        "detector": {"response": "energy", "pitch_mm": 2.0}
    })
}

fn cube(shift: f32) -> Vec<[[f32; 3]; 3]> {
    let corner = |bits: u32| [0, 1, 2].map(|axis| shift + if bits >> axis & 1 == 1 { 2.0 } else { -2.0 });
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    quads.iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]].map(|t| t.map(|v| corner(*v)))).collect()
}

fn stl(triangles: &[[[f32; 3]; 3]]) -> Vec<u8> {
    let mut bytes = vec![0; 80];
    bytes.extend_from_slice(&(triangles.len() as u32).to_le_bytes());
    for triangle in triangles {
        bytes.extend_from_slice(&[0; 12]);
        triangle.iter().flatten().for_each(|x| bytes.extend_from_slice(&x.to_le_bytes()));
        bytes.extend_from_slice(&[0; 2]);
    }
    bytes
}

/// A folder with the good inputs.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("tool.stl"), stl(&cube(0.0))).expect("writes");
    std::fs::write(folder.path().join("beam.csv"), "energy_kev,fluence\n30,1\n31,2\n32,1\n").expect("writes");
    // Tissue with air around it: nothing is cut off.
    let inside = |index: usize| [index % 4, index / 4 % 4, index / 16].iter().all(|at| (1..3).contains(at));
    let voxels: Vec<i16> = (0..64).map(|index| if inside(index) { 0 } else { -1000 }).collect();
    NiftiFile::int16([4, 4, 4], &voxels).write(&folder.path().join("ct.nii"));
    folder
}

struct Ran {
    code: Option<i32>,
    stderr: String,
    stdout: String,
    /// Files that were not there before, in the folder and everything below it.
    made: BTreeSet<String>,
}

fn render(folder: &Path, scene: &str, out: &str, more: &[&str]) -> Ran {
    std::fs::write(folder.join("scene.json"), scene).expect("writes");
    let list = || -> BTreeSet<String> {
        let entries = std::fs::read_dir(folder).expect("lists").flatten();
        entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
    };
    let before = list();
    let output = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .args(["render", "scene.json", "--out", out, "--device", "cpu"])
        .args(more)
        .current_dir(folder)
        .output()
        .expect("runs");
    Ran {
        code: output.status.code(),
        stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
        made: list().difference(&before).cloned().collect(),
    }
}

/// Exit code 1, one sentence that holds `words`, perhaps a hint, and not a byte more.
fn assert_refused(what: &str, ran: &Ran, words: &[&str]) {
    let Ran { code, stderr, stdout, made } = ran;
    assert_eq!(*code, Some(1), "{what}: {stderr}");
    assert!(made.is_empty() && stdout.is_empty(), "{what} left {made:?} and {stdout}");
    let lines: Vec<&str> = stderr.lines().filter(|line| !line.starts_with("hint: ")).collect();
    assert_eq!(lines.len(), 1, "{what}: {stderr}");
    assert!(lines[0].starts_with("sidecarm: ") && !stderr.contains("panicked"), "{what}: {stderr}");
    assert!(words.iter().all(|word| stderr.contains(word)), "{what}: {words:?} in {stderr}");
}

/// The scene with the value at a JSON pointer replaced; the text `1e999` stands for what JSON cannot hold.
fn changed(pointer: &str, value: Value) -> String {
    let mut scene = scene();
    *scene.pointer_mut(pointer).unwrap_or_else(|| panic!("{pointer}")) = value;
    scene.to_string().replace("\"1e999\"", "1e999")
}

#[test]
fn the_good_scene_renders() {
    let folder = folder();
    let ran = render(folder.path(), &scene().to_string(), "drr.tif", &[]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(ran.made.contains("drr.tif") && ran.made.contains("drr.tif.json"), "{:?}", ran.made);
    assert_eq!(ran.stderr, "");
}

/// A TIFF was written under the name of a picture, which nothing opens, and into a file called `-`.
#[test]
fn names_that_are_none_for_a_tiff_are_a_usage_error() {
    let folder = folder();
    let mut refused = 0;
    let cases: [(&str, &[&str], &str); 5] = [
        ("x.png", &[], "--png x.png writes a picture"),
        ("x.JPG", &[], "name it .tif"),
        ("x.dcm", &[], "name it .tif"),
        ("-", &[], "standard output takes no image"),
        ("x.tif", &["--png", "-"], "standard output takes no image"),
    ];
    for (out, more, words) in cases {
        let ran = render(folder.path(), &scene().to_string(), out, more);
        assert_eq!(ran.code, Some(2), "{out}: {}", ran.stderr);
        assert!(ran.stderr.contains(words), "{out}: {}", ran.stderr);
        assert!(ran.stdout.is_empty() && ran.made.is_subset(&BTreeSet::from(["scene.json".to_owned()])), "{out}: {:?}", ran.made);
        refused += 1;
    }
    assert_eq!(refused, 5);
    let ran = render(folder.path(), &scene().to_string(), "x.tiff", &["--png", "x.png"]);
    assert!(ran.code == Some(0) && ran.made.contains("x.png"), "control: {}", ran.stderr);
}

/// A pose in metres puts the focal spot into the patient, and draws a picture all the same.
#[test]
fn a_focal_spot_within_the_ct_is_said() {
    let folder = folder();
    let words = "warning: the focal spot lies within objects[0].sphere and objects[1].ct";
    for (depth_mm, is_within) in [(4.0, false), (2.0, true)] {
        let ran = render(folder.path(), &changed("/view/camera_from_lps/2/3", json!(depth_mm)), "drr.tif", &[]);
        assert_eq!(ran.code, Some(0), "{}", ran.stderr);
        assert_eq!(ran.stderr.matches(words).count(), usize::from(is_within), "{depth_mm} mm: {}", ran.stderr);
    }
}

/// Noise that was asked for was left out of a naive image without a word.
#[test]
fn noise_that_a_naive_image_has_not_is_said() {
    let folder = folder();
    let rendered = |formation: &str, noise: Value| {
        let mut scene = scene();
        scene["model"] = json!({"formation": formation, "noise": noise});
        let ran = render(folder.path(), &scene.to_string(), "drr.tif", &["--explain"]);
        assert_eq!(ran.code, Some(0), "{}", ran.stderr);
        let text = std::fs::read_to_string(folder.path().join("drr.tif.json")).expect("beside it");
        (ran, serde_json::from_str::<Value>(&text).expect("JSON"))
    };
    let words = "naive formation (Eq. 8) has no noise: model.noise is left out";
    for noise in [json!(true), json!("paper")] {
        let (ran, json) = rendered("naive", noise);
        assert_eq!(ran.stderr.matches(words).count(), 1, "a warning, said once: {}", ran.stderr);
        assert!(ran.stderr.contains(&format!("warning: {words}")), "{}", ran.stderr);
        assert!(ran.stdout.contains(&format!("quantum noise: {words}")), "{}", ran.stdout);
        assert!(json["notes"].to_string().contains(words), "{}", json["notes"]);
        assert_eq!(json["plan"]["noise"], "off");
    }
    for (formation, noise) in [("naive", json!(false)), ("deepdrr", json!(true))] {
        let (ran, json) = rendered(formation, noise);
        assert!(!ran.stderr.contains(words) && !json["notes"].to_string().contains(words), "control: {}", ran.stderr);
    }
}

#[test]
fn numbers_that_make_no_sense() {
    let rows = |m: [[f64; 4]; 4]| json!(m);
    let scaled = rows([[2.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]]);
    let sheared = rows([[1.0, 0.3, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]);
    let reflected = rows([[-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]);
    let far = rows([[1.0, 0.0, 0.0, 1e12], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]);
    let mesh = "/objects/3/mesh/lps_from_mesh";
    let base = "/objects/2/robot/lps_from_base";
    let k = |row: usize, column: usize| format!("/view/intrinsics/{row}/{column}");
    let cases: Vec<(String, Value, Vec<&str>)> = vec![
        ("/beam/filtration_mm/aluminium".into(), json!(-1), vec!["beam.filtration_mm.aluminium", "-1", "0 or more"]),
        ("/beam/filtration_mm/aluminium".into(), json!("1e999"), vec!["beam.filtration_mm"]),
        ("/beam/filtration_mm/aluminium".into(), json!(1e6), vec!["spectrum is empty", "filters"]),
        ("/beam/tube_kvp".into(), json!(0), vec!["beam.tube_kvp", "0 kV", "40 to 140"]),
        ("/beam/tube_kvp".into(), json!(500), vec!["beam.tube_kvp", "500 kV", "40 to 140"]),
        ("/beam/tube_kvp".into(), json!("1e999"), vec!["beam.tube_kvp", "out of range"]),
        ("/beam/photons_per_pixel".into(), json!("1e999"), vec!["beam.photons_per_pixel"]),
        ("/objects/0/sphere/radius_mm".into(), json!("1e999"), vec!["objects[0].sphere.radius_mm"]),
        ("/objects/0/sphere/centre_lps_mm/1".into(), json!("1e999"), vec!["objects[0].sphere.centre_lps_mm[1]"]),
        ("/objects/0/sphere/centre_lps_mm/1".into(), json!(1e12), vec!["objects[0].sphere.centre_lps_mm", "1e6 mm"]),
        (mesh.into(), scaled.clone(), vec!["objects[3].mesh.lps_from_mesh", "not rigid", "determinant 8"]),
        (mesh.into(), sheared.clone(), vec!["objects[3].mesh.lps_from_mesh", "not rigid"]),
        (mesh.into(), reflected.clone(), vec!["objects[3].mesh.lps_from_mesh", "not rigid", "determinant -1"]),
        (mesh.into(), far.clone(), vec!["objects[3].mesh.lps_from_mesh", "1e6 mm"]),
        (base.into(), scaled, vec!["objects[2].robot.lps_from_base", "not rigid"]),
        (base.into(), sheared, vec!["objects[2].robot.lps_from_base", "not rigid"]),
        (base.into(), reflected, vec!["objects[2].robot.lps_from_base", "not rigid"]),
        (base.into(), far, vec!["objects[2].robot.lps_from_base", "1e6 mm"]),
        ("/view/camera_from_lps/2/3".into(), json!(1e12), vec!["view", "focal spot lies 1.000e12 mm", "1e6 mm"]),
        ("/view/camera_from_lps/2/3".into(), json!("1e999"), vec!["view.camera_from_lps"]),
        (k(0, 0), json!(0), vec!["view.intrinsics", "focal length is (0, 500) px", "positive"]),
        (k(1, 1), json!(-500), vec!["view.intrinsics", "(500, -500)"]),
        (k(0, 1), json!("1e999"), vec!["view.intrinsics[0][1]", "out of range"]),
        (k(0, 1), Value::Null, vec!["view.intrinsics[0][1]"]),
        (k(0, 1), json!(1e300), vec!["view", "pixel (0, 0)", "skew"]),
        (k(0, 2), json!(1e300), vec!["view", "pixel (0, 0)", "principal point"]),
        (k(1, 1), json!(1e-300), vec!["view", "pixel (0, 0)"]),
        (k(1, 1), json!(1e300), vec!["view", "focal lengths", "square"]),
        ("/detector/pitch_mm".into(), json!(1e-9), vec!["source-to-detector", "pitch"]),
        ("/objects/3/mesh/path".into(), json!("none.stl"), vec!["objects[3].mesh.path", "none.stl", "not there"]),
        ("/objects/1/ct/path".into(), json!("none.nii.gz"), vec!["objects[1].ct.path", "none.nii.gz", "not there"]),
        ("/objects/2/robot/model".into(), json!("none.json"), vec!["objects[2].robot.model", "none.json", "not there"]),
        (
            "/objects/2/robot".into(),
            json!({"model": "calibration/robot/cdm.json", "control_angles_deg": [0, 0, "1e999", 0, 0]}),
            vec!["control_angles_deg[2]"],
        ),
    ];
    let folder = folder();
    let mut count = 0;
    for (pointer, value, words) in cases {
        let what = format!("{pointer} = {value}");
        assert_refused(&what, &render(folder.path(), &changed(&pointer, value), "drr.tif", &[]), &words);
        count += 1;
    }
    assert_eq!(count, 33);
}

#[test]
fn beams_and_counts_off_the_tables() {
    let folder = folder();
    let mut count = 0;
    for (beam, words) in [
        (json!({"mono_kev": 0.5}), vec!["beam.mono_kev", "0.5 keV", "1 to 150 keV"]),
        (json!({"mono_kev": 151}), vec!["beam.mono_kev", "151 keV"]),
        (json!({"mono_kev": -60}), vec!["beam.mono_kev", "-60 keV"]),
        (json!({"spectrum_csv": "none.csv"}), vec!["beam.spectrum_csv", "none.csv", "not there"]),
    ] {
        let ran = render(folder.path(), &changed("/beam", beam.clone()), "drr.tif", &[]);
        assert_refused(&beam.to_string(), &ran, &words);
        count += 1;
    }
    for (rows, words) in [
        ("30,1\n31,nan\n", vec!["row 3", "NaN"]),
        ("30,1\n31,inf\n", vec!["row 3", "inf"]),
        ("30,1\n31,-1\n", vec!["row 3", "-1"]),
        ("nan,1\n31,1\n", vec!["row 2"]),
        ("3000000,1\n3000001,1\n", vec!["row 2", "outside the tables"]),
        ("30,0\n31,0\n", vec!["empty"]),
    ] {
        std::fs::write(folder.path().join("beam.csv"), format!("energy_kev,fluence\n{rows}")).expect("writes");
        let ran = render(folder.path(), &changed("/beam", json!({"spectrum_csv": "beam.csv"})), "drr.tif", &[]);
        assert_refused(rows, &ran, &[words, vec!["beam.spectrum_csv"]].concat());
        count += 1;
    }
    for (key, value) in [("gain", 1e300), ("gain", 0.0), ("offset", -1e300)] {
        let detector = json!({"pitch_mm": 2.0, key: value});
        let ran = render(folder.path(), &changed("/detector", detector), "drr.tif", &["--quantity", "counts"]);
        assert_refused(key, &ran, &[&format!("detector.{key}")]);
        count += 1;
    }
    assert_eq!(count, 13);
}

#[test]
fn projections_that_are_no_camera() {
    let folder = folder();
    let good = [[500.0, 0.0, 7.5, 4500.0], [0.0, 500.0, 5.5, 3300.0], [0.0, 0.0, 1.0, 600.0]];
    let with = |rows: Value| changed("/view", json!({"size_px": [16, 12], "projection": rows}));
    for scale in [-1.0, 1e200] {
        let ran = render(folder.path(), &with(json!(good.map(|row| row.map(|x| x * scale)))), "drr.tif", &[]);
        assert_eq!((ran.code, ran.stderr.as_str()), (Some(0), ""), "{scale}: the scale of P is free");
        ["drr.tif", "drr.tif.json"].iter().for_each(|name| std::fs::remove_file(folder.path().join(name)).expect("was made"));
    }
    let mut mirrored = good;
    mirrored[0] = mirrored[0].map(|x| -x);
    mirrored[0][2] += 15.0;
    let mut count = 0;
    for (rows, words) in [
        (json!([[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 600]]), ["singular", "infinity"]),
        (json!([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]), ["singular", "infinity"]),
        (json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]), ["singular", "infinity"]),
        (json!(mirrored), ["behind its focal spot", "fx and fy of one sign"]),
        (json!([[500, 0, 7.5, 4500], [0, 500, 5.5, 3300], [0, 0, 1, "1e999"]]), ["number out of range", "line"]),
    ] {
        let text = with(rows.clone()).replace("\"1e999\"", "1e999");
        let ran = render(folder.path(), &text, "drr.tif", &[]);
        assert_refused(&rows.to_string(), &ran, &[words.as_slice(), &["view.projection"]].concat());
        count += 1;
    }
    assert_eq!(count, 5);
}

#[test]
fn volumes_and_meshes_with_nan() {
    let folder = folder();
    let nifti = |value: f32| {
        let mut file = NiftiFile::int16([2, 2, 2], &[]);
        (file.datatype, file.voxels) =
            (16, [0.0, 1.0, value, 3.0, 4.0, 5.0, 6.0, 7.0].iter().flat_map(|v| v.to_le_bytes()).collect());
        file.write(&folder.path().join("ct.nii"));
    };
    let text = scene().to_string();
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        nifti(value);
        assert_refused(
            "CT",
            &render(folder.path(), &text, "drr.tif", &[]),
            &["ct.nii", "1 of 8 voxels are NaN or infinite", "-1000 HU"],
        );
    }
    nifti(2.0);
    let mut bad = cube(0.0);
    bad[3][1][2] = f32::NAN;
    std::fs::write(folder.path().join("tool.stl"), stl(&bad)).expect("writes");
    assert_refused("mesh", &render(folder.path(), &text, "drr.tif", &[]), &["tool.stl", "not finite"]);
    std::fs::write(folder.path().join("tool.stl"), stl(&cube(0.0)[1..])).expect("writes");
    assert_refused("hole", &render(folder.path(), &text, "drr.tif", &[]), &["tool.stl", "3 open edges", "close it"]);
    std::fs::write(folder.path().join("tool.stl"), &stl(&cube(0.0))[..300]).expect("writes");
    assert_refused("cut short", &render(folder.path(), &text, "drr.tif", &[]), &["tool.stl"]);
}

#[test]
fn repairs_and_crossings_of_meshes_are_reported() {
    let folder = folder();
    let text = scene().to_string();
    let mut inverted = cube(0.0);
    inverted[3].swap(0, 1);
    let both: Vec<_> = cube(0.0).into_iter().chain(cube(1.3)).collect();
    let inside_out: Vec<_> = cube(0.0).iter().map(|[a, b, c]| [*a, *c, *b]).collect();
    let mut count = 0;
    for (triangles, words) in [
        (inverted, "tool.stl: 1 inverted faces were turned"),
        (inside_out, "tool.stl: all faces pointed inward and were turned"),
        (both, "tool.stl: the surface crosses itself"),
    ] {
        std::fs::write(folder.path().join("tool.stl"), stl(&triangles)).expect("writes");
        let ran = render(folder.path(), &text, "drr.tif", &[]);
        assert_eq!(ran.code, Some(0), "{}", ran.stderr);
        assert!(ran.stderr.starts_with(&format!("warning: {words}")) && ran.stderr.lines().count() == 1, "{}", ran.stderr);
        count += 1;
    }
    assert_eq!(count, 3);
}

#[test]
fn outputs_that_cannot_be_written_are_refused_before_rendering() {
    let folder = folder();
    std::fs::create_dir(folder.path().join("folder.tif")).expect("makes");
    let text = scene().to_string();
    let mut count = 0;
    for (out, more, words) in [
        ("nowhere/drr.tif", vec![], vec!["nowhere/drr.tif", "cannot be written", "nowhere is not a folder", "create it"]),
        ("scene.json/drr.tif", vec![], vec!["scene.json/drr.tif", "scene.json is not a folder"]),
        ("folder.tif", vec![], vec!["folder.tif", "it is a folder"]),
        ("drr.tif", vec!["--png", "nowhere/drr.png"], vec!["nowhere/drr.png", "not a folder"]),
        #[cfg(target_os = "linux")]
        ("/proc/drr.tif", vec![], vec!["/proc/drr.tif: cannot be written"]),
    ] {
        let ran = render(folder.path(), &text, out, &more);
        assert_refused(out, &ran, &words);
        assert!(!ran.stderr.contains(".sidecarm-"), "{}", ran.stderr);
        count += 1;
    }
    assert!(count >= 4);
    let output = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .args(["render", "none.json", "--out", "drr.tif"])
        .current_dir(folder.path())
        .output()
        .expect("runs");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && stderr.contains("none.json: cannot be read"), "{stderr}");
    assert!(INPUTS.iter().all(|name| folder.path().join(name).is_file()), "inputs are untouched");
}

/// Matter beyond the detector is not seen: the image is right, and one sentence says why it is empty.
#[test]
fn a_detector_before_the_specimen_is_said_once() {
    let folder = folder();
    let ran = render(folder.path(), &changed("/detector/pitch_mm", json!(1.0)), "drr.tif", &[]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(ran.stderr.contains("behind the detector at 500 mm") && ran.stderr.contains("pitch_mm"), "{}", ran.stderr);
    assert_eq!(ran.stderr.lines().count(), 1, "{}", ran.stderr);
    let image = sidecarm::image::read_tiff_f32(&folder.path().join("drr.tif")).expect("a TIFF");
    assert!(image[0].pixels.iter().all(|value| *value == 1.0));
}

#[test]
fn the_hidden_flag_counts_what_is_not_finite() {
    let folder = folder();
    let ran = render(folder.path(), &scene().to_string(), "drr.tif", &["--count-non-finite"]);
    assert_eq!((ran.code, ran.stderr.as_str()), (Some(0), ""));
    let text = std::fs::read_to_string(folder.path().join("drr.tif.json")).expect("beside it");
    let json: Value = serde_json::from_str(&text).expect("JSON");
    let zero = json!({"integrate_density": 0, "attenuate_spectrum": 0, "add_noise": 0, "detect": 0});
    assert_eq!(json["non_finite"], zero);
}

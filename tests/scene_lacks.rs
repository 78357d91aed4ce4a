//! What a scene lacks is said: matter, bone, where the detector is.

use std::cell::RefCell;
use std::path::Path;

use clap::Parser;
use serde_json::{Value, json};
use sidecarm::cli::{render, scatter};
use sidecarm::reporter::Reporter;
use sidecarm::scene;

use crate::render_scatter::{Follow, Render};
use crate::scene_support::NiftiFile;

/// Eight voxels along each edge, room air around what `inside` gives the inner six.
fn ct(folder: &Path, voxel_mm: f32, inside: impl Fn(usize) -> i16) {
    let is_inside = |index: usize| [index % 8, index / 8 % 8, index / 64].iter().all(|at| (1..7).contains(at));
    let voxels: Vec<i16> = (0..512).map(|index| if is_inside(index) { inside(index) } else { -1000 }).collect();
    let mut file = NiftiFile::int16([8; 3], &voxels);
    file.pixdim = [1.0, voxel_mm, voxel_mm, voxel_mm, 1.0, 1.0, 1.0, 1.0];
    file.sform = Some([[voxel_mm, 0.0, 0.0, 0.0], [0.0, voxel_mm, 0.0, 0.0], [0.0, 0.0, voxel_mm, 0.0]]);
    file.write(&folder.join("ct.nii"));
}

/// All that is said, warnings and notes, while the scene with that CT is loaded; `air` is what becomes of thin voxels.
fn said(folder: &Path, air: &str) -> Vec<String> {
    let path = folder.join("scene.json");
    let scene = json!({
        "objects": [{"ct": {"path": "ct.nii", "air": air}}],
        "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 1.0}
    });
    std::fs::write(&path, scene.to_string()).expect("written");
    let reporter = Reporter::silent().holding();
    scene::load(&path, false, &reporter).unwrap_or_else(|error| panic!("{error}"));
    let words = RefCell::new(Vec::new());
    reporter.release(|one| {
        words.borrow_mut().push(one.to_owned());
        one.to_owned()
    });
    words.into_inner()
}

fn holds(said: &[String], words: &str) -> bool {
    said.iter().any(|one| one.contains("ct.nii") && one.contains(words))
}

#[test]
fn a_ct_of_air_alone_is_said_to_be_empty() {
    let folder = tempfile::tempdir().expect("folder");
    let words = "no voxel is matter: everything is air";
    ct(folder.path(), 1.0, |_| -1000);
    let found = said(folder.path(), "ambient");
    assert!(holds(&found, words), "{found:?}");
    // A scan of lung, all of whose thin voxels were to be dropped.
    ct(folder.path(), 1.0, |_| -850);
    let found = said(folder.path(), "drop");
    assert!(holds(&found, words), "{found:?}");
    ct(folder.path(), 1.0, |index| if index == 219 { 0 } else { -1000 });
    let found = said(folder.path(), "ambient");
    assert!(!holds(&found, words), "the control, a voxel of water: {found:?}");
}

/// Units of density, or a scan of something else: of a specimen that is large enough to have bone.
#[test]
fn a_specimen_without_bone_is_remarked_on() {
    let folder = tempfile::tempdir().expect("folder");
    let words = "no voxel is dense enough for bone";
    ct(folder.path(), 10.0, |_| 40);
    let found = said(folder.path(), "ambient");
    assert!(holds(&found, words), "216 cm³ of tissue: {found:?}");
    ct(folder.path(), 10.0, |index| if index == 219 { 900 } else { 40 });
    let found = said(folder.path(), "ambient");
    assert!(!holds(&found, words), "the control, a voxel of bone: {found:?}");
    ct(folder.path(), 2.0, |_| 40);
    let found = said(folder.path(), "ambient");
    assert!(!holds(&found, words), "a phantom of 2 cm³ needs none: {found:?}");
}

/// Scatter needs to know where the detector is, and nobody guesses it: one sentence that says what to add, whatever was asked, and no file.
#[test]
fn scatter_without_the_detectors_place_is_refused_in_one_sentence() {
    let folder = tempfile::tempdir().expect("folder");
    let good = json!({
        "objects": [{"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 20, "material": "water"}}],
        "view": {"size_px": [16, 12], "intrinsics": [[500, 0, 7.5], [0, 500, 5.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
        "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 2.0}, "model": {"scatter": "monte_carlo"}
    });
    let [scene, image, pages] = ["scene.json", "drr.tif", "scatter.tif"].map(|name| folder.path().join(name));
    let [scene_name, image_name, pages_name] = [&scene, &image, &pages].map(|path| path.display().to_string());
    let refusals = |value: &Value| -> [Option<String>; 2] {
        std::fs::write(&scene, value.to_string()).expect("written");
        let words = ["render", &scene_name, "--device", "cpu", "--out", &image_name, "--scatter-error", "0.5"];
        let rendered = render::run(&Render::try_parse_from(words).expect("parses").args, &Reporter::silent());
        let words = ["scatter", &scene_name, "--device", "cpu", "--histories", "4096", "--grid-px", "4x3", "--out", &pages_name];
        let followed = scatter::run(&Follow::try_parse_from(words).expect("parses").args, &Reporter::silent());
        [rendered.err().map(|error| error.to_string()), followed.err().map(|error| error.to_string())]
    };
    let mut refused = 0;
    for model in ["monte_carlo", "network"] {
        for (section, key, words) in [
            ("", "view", "view: the scene does not say where it is seen from; add a view"),
            ("detector", "pitch_mm", "detector: pitch_mm is missing; with the focal length it says where the detector is"),
            ("view", "intrinsics", "intrinsics"),
        ] {
            let mut value = good.clone();
            value["model"]["scatter"] = json!(model);
            let holder = if section.is_empty() { &mut value } else { &mut value[section] };
            holder.as_object_mut().expect("an object").remove(key).expect("there");
            for said in refusals(&value) {
                let said = said.unwrap_or_else(|| panic!("{model} without {key} is made"));
                assert!(said.contains("scene.json") && said.contains(words) && !said.contains('\n'), "{key}: {said}");
                assert!(!said.contains("NaN") && !image.exists() && !pages.exists(), "{said}");
                refused += 1;
            }
        }
    }
    assert_eq!(refused, 12);
    assert_eq!(refusals(&good), [None, None], "the control");
}

//! Numbers that hardly are Hounsfield units, and grids that hardly show anatomy: whoever loads the scene is told in one sentence, by the file's name.

use std::path::Path;

use serde_json::json;
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::{Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{self, Scene, SceneError};

use crate::scene_support::NiftiFile;

/// Air, tissue and bone, as a CT of HU has them.
fn hu(index: usize) -> f32 {
    [-1000.0, -990.5, 40.0, 55.0, -90.0, 30.0, 20.0, 900.0][index % 8]
}

/// Kinds of what is doubted of a CT of these voxels, each with its sentence.
fn doubts(folder: &Path, size: [i16; 3], spacing_mm: f32, value: &dyn Fn(usize) -> f32) -> Vec<(String, String)> {
    let mut file = NiftiFile::int16(size, &[]);
    let count = size.iter().map(|n| *n as usize).product::<usize>();
    (file.datatype, file.voxels) = (16, (0..count).flat_map(|index| value(index).to_le_bytes()).collect());
    file.pixdim = [1.0, spacing_mm, spacing_mm, spacing_mm, 1.0, 1.0, 1.0, 1.0];
    file.sform = Some([[spacing_mm, 0.0, 0.0, 0.0], [0.0, spacing_mm, 0.0, 0.0], [0.0, 0.0, spacing_mm, 0.0]]);
    file.write(&folder.join("ct.nii"));
    let path = folder.join("scene.json");
    let scene = json!({"objects": [{"ct": {"path": "ct.nii"}}], "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 1.0}});
    std::fs::write(&path, scene.to_string()).expect("written");
    let reporter = Reporter::silent();
    scene::load(&path, false, &reporter).unwrap_or_else(|error| panic!("{error}"));
    let asked = ["not HU", "single slice", "coarse CT"];
    let said = reporter.warnings().into_iter().filter(|(kind, _)| asked.contains(&kind.as_str()));
    said.map(|(kind, counted)| (kind, counted.latest)).collect()
}

/// The CT is taken as it is, and the person is told: what nobody says is a silent guess.
#[test]
fn a_ct_that_hardly_is_one_is_said_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    let usual = [8, 8, 8];
    assert!(doubts(folder.path(), usual, 1.0, &hu).is_empty(), "the control");
    let mut cases = 0;
    for (size, spacing_mm, value, kind, words) in [
        (usual, 1.0, &(|index| hu(index) + 1024.0) as &dyn Fn(usize) -> f32, "not HU", "rescale of -1024 left out?"),
        (usual, 1.0, &|index| (hu(index) + 1000.0) / 1000.0, "not HU", "densities"),
        (usual, 1.0, &|index| (index * 37 % 256) as f32, "not HU", "grey levels of 8 bits?"),
        (
            usual,
            1.0,
            &|index| f32::from((hu(index) as i16).swap_bytes()),
            "not HU",
            "have 2 different values below -1200 HU (down to -31741)",
        ),
        ([8, 8, 1], 1.0, &hu, "single slice", "one slice only"),
        (usual, 5.0, &hu, "coarse CT", "voxels of 5.0 mm"),
    ] {
        let said = doubts(folder.path(), size, spacing_mm, value);
        let [(found, sentence)] = said.as_slice() else { panic!("{kind}: {said:?}") };
        assert!(found == kind && sentence.contains("ct.nii: ") && sentence.contains(words), "{said:?}");
        assert!(!sentence.contains('\n'), "{sentence}");
        cases += 1;
    }
    assert_eq!(cases, 6);
}

/// A block of water with another of `inner` in it, seen by 8 x 8 pixels, at so many photons a pixel; and what is said of air.
fn block(folder: &Path, inner: &serde_json::Value, photons: f64) -> (Result<Scene, SceneError>, Option<String>) {
    let mut inner = inner.clone();
    inner["centre_lps_mm"] = json!([0, 0, 0]);
    inner["size_mm"] = json!([60, 60, 20]);
    let outer = json!({"centre_lps_mm": [0, 0, 0], "size_mm": [60, 60, 60], "material": "water"});
    let scene = json!({
        "objects": [{"box": outer}, {"box": inner}],
        "view": {
            "size_px": [8, 8],
            "intrinsics": [[1000, 0, 3.5], [0, 1000, 3.5], [0, 0, 1]],
            "camera_from_lps": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 600], [0, 0, 0, 1]],
        },
        "beam": {"mono_kev": 60, "photons_per_pixel": photons},
        "detector": {"pitch_mm": 1.0},
        "model": {"noise": false},
    });
    let path = folder.join("block.json");
    std::fs::write(&path, scene.to_string()).expect("written");
    let reporter = Reporter::silent();
    let scene = scene::load(&path, true, &reporter);
    (scene, reporter.warnings().get("air displaces nothing").map(|counted| counted.latest.clone()))
}

/// A hole of `air` was no hole, and nothing said so; what the warning offers instead is one.
#[test]
fn a_hole_of_air_is_said_to_be_none_and_what_is_offered_cuts_one() {
    let folder = tempfile::tempdir().expect("folder");
    let line = |inner: serde_json::Value| {
        let (scene, said) = block(folder.path(), &inner, 1e5);
        let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
        let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
        (renderer.render(&scene.expect("good"), &options).expect("renders").pages[0].pixels[27], said)
    };
    let (whole, none) = line(json!({"material": "water"}));
    assert_eq!(none, None, "the control");
    let (filled, said) = line(json!({"material": "AIR"}));
    let said = said.expect("said");
    assert!(said.contains("objects[1].box.material") && said.contains("displaces nothing"), "{said}");
    let offered = json!({"material": "N2", "density_g_per_cm3": 0.0012});
    assert!(said.contains("\"material\": \"N2\", \"density_g_per_cm3\": 0.0012"), "{said}");
    let (cut, none) = line(offered);
    assert_eq!(none, None);
    assert!((filled / whole - 1.0).abs() < 2e-3 && (cut / whole - 2.0 / 3.0).abs() < 2e-3, "{whole} {filled} {cut}");
}

/// At 1e15 photons a pixel, 32-bit floats rounded the noise away: its variance over its mean was 1.74.
#[test]
fn more_photons_than_a_float_counts_are_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let water = json!({"material": "water"});
    assert!(block(folder.path(), &water, 1e12).0.is_ok(), "the control");
    let error = block(folder.path(), &water, 1.1e12).0.expect_err("refused").to_string();
    assert!(error.contains("photons_per_pixel") && error.contains("at most 1e12"), "{error}");
}

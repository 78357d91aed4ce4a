//! Numbers that hardly are Hounsfield units, and grids that hardly show anatomy: whoever loads the scene is told in one sentence, by the file's name.

use std::path::Path;

use serde_json::json;
use sidecarm::reporter::Reporter;
use sidecarm::scene;

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

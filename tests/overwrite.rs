//! No command writes over its input, whatever the input is called: `render --png SCENE.json` used to replace the scene.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

const SCENE: &str = r#"{
    "objects": [{"mesh": {"path": "data/tool.stl", "material": "titanium",
                          "lps_from_mesh": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}],
    "view": {"size_px": [16, 12], "intrinsics": [[500, 0, 7.5], [0, 500, 5.5], [0, 0, 1]],
             "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
    "beam": {"tube_kvp": 80, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
    "detector": {"response": "energy", "pitch_mm": 2.0}
}"#;

/// A tetrahedron as ASCII STL.
fn tetrahedron() -> String {
    let corners = [[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]];
    let faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
    let facet = |face: &[usize; 3]| {
        let vertices: String =
            face.iter().map(|at| format!("vertex {} {} {}\n", corners[*at][0], corners[*at][1], corners[*at][2])).collect();
        format!("facet normal 0 0 0\nouter loop\n{vertices}endloop\nendfacet\n")
    };
    format!("solid t\n{}endsolid t\n", faces.iter().map(facet).collect::<String>())
}

fn files(folder: &Path, found: &mut BTreeMap<String, Vec<u8>>) {
    for entry in std::fs::read_dir(folder).expect("lists").flatten() {
        if entry.path().is_dir() {
            files(&entry.path(), found);
        } else {
            found.insert(entry.path().display().to_string(), std::fs::read(entry.path()).expect("reads"));
        }
    }
}

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("folder");
    let at = folder.path();
    std::fs::create_dir_all(at.join("data")).expect("made");
    std::fs::create_dir_all(at.join("trade")).expect("made");
    std::fs::write(at.join("scene.json"), SCENE).expect("writes");
    std::fs::write(at.join("data/tool.stl"), tetrahedron()).expect("writes");
    std::fs::hard_link(at.join("data/tool.stl"), at.join("hard.tif")).expect("links");
    std::fs::hard_link(at.join("scene.json"), at.join("trade/trade.json")).expect("links");
    // IMAGE.tif.json beside an image that would be written.
    std::fs::hard_link(at.join("scene.json"), at.join("drr.tif.json")).expect("links");
    #[cfg(unix)]
    std::os::unix::fs::symlink("scene.json", at.join("soft.png")).expect("links");
    folder
}

fn run(folder: &Path, args: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(args).current_dir(folder).output().expect("runs");
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// A shot or a frame that was named twice counted twice: twice the certainty, and a gain measured from noise that is not there.
#[test]
fn what_would_count_twice_is_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    for (name, text) in [("a.json", "{}"), ("b.json", "{}"), ("c.json", "[]")] {
        std::fs::write(folder.path().join(name), text).expect("writes");
    }
    let cases: [&[&str]; 5] = [
        &["calibrate", "carm", "c.json", "a.json", "b.json", "--calibration", "c.json", "--out", "new.json"],
        &["calibrate", "layout", "a.json", "c.json", "b.json", "--prior", "c.json", "--out", "new.mrk.json"],
        &["calibrate", "detector", "a.json", "c.json", "--dark", "b.json", "--out", "new.json"],
        &["calibrate", "intensifier", "a.json", "b.json", "--pitch-mm", "10", "--out", "new.json"],
        &["calibrate", "robot", "a.json", "c.json", "b.json", "--scene", "c.json", "--out", "new.json"],
    ];
    for args in cases {
        let (code, words) = run(folder.path(), args);
        assert_eq!(code, Some(1), "{args:?}: {words}");
        assert!(words.contains("b.json: has the same content as a.json"), "{args:?}: {words}");
        assert!(!folder.path().join("new.json").exists());
    }
}

/// Of two outputs of one name the later replaced the earlier: `calibrate carm --out arm.svg` wrote a calibration, and its drawing over it.
#[test]
fn outputs_of_one_name_are_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    for name in ["a.json", "b.json", "c.json"] {
        std::fs::write(folder.path().join(name), format!("{{\"{name}\": 1}}")).expect("writes");
    }
    let cases: [(&[&str], &str); 5] = [
        (&["calibrate", "carm", "a.json", "b.json", "--calibration", "c.json", "--out"], "new.svg"),
        (&["calibrate", "robot", "a.json", "b.json", "--scene", "c.json", "--out"], "new.svg"),
        (&["calibrate", "detector", "a.json", "--dark", "b.json", "--out"], "new.tif"),
        (&["calibrate", "layout", "--score", "a.json", "--intrinsics", "b.json", "--map", "new.svg", "--out"], "new.svg"),
        (&["register", "a.json", "--beads", "b.json", "--intrinsics", "c.json", "--overlay", "new.png", "--out"], "new.png"),
    ];
    for (args, name) in cases {
        let (code, said) = run(folder.path(), &[args, &[name][..]].concat());
        assert_eq!(code, Some(1), "{args:?}: {said}");
        assert!(said.contains(&format!("{name}: is named for two outputs")), "{args:?}: {said}");
        assert!(!folder.path().join(name).exists(), "{args:?}");
        // The control: with another name it fails for what its inputs are.
        let (code, said) = run(folder.path(), &[args, &["other.json"][..]].concat());
        assert!(code == Some(1) && !said.contains("two outputs"), "{args:?}: {said}");
    }
}

#[test]
fn no_command_writes_over_its_inputs() {
    let folder = folder();
    let mut before = BTreeMap::new();
    files(folder.path(), &mut before);
    let mut cases: Vec<&[&str]> = vec![
        &["render", "scene.json", "--out", "new.tif", "--dicom", "scene.json"],
        &["render", "scene.json", "--out", "scene.json"],
        &["render", "scene.json", "--out", "data/../scene.json"],
        &["render", "scene.json", "--out", "data/tool.stl"],
        &["render", "scene.json", "--out", "hard.tif"],
        &["render", "scene.json", "--out", "drr.tif"],
        &["trade", "scene.json", "--out", "trade"],
    ];
    if cfg!(unix) {
        cases.push(&["render", "scene.json", "--out", "new.tif", "--png", "soft.png"]);
    }
    for args in &cases {
        let (code, words) = run(folder.path(), args);
        assert_eq!(code, Some(1), "{args:?}: {words}");
        assert!(words.contains("would overwrite an input") && words.contains("choose another"), "{args:?}: {words}");
        assert_eq!(words.trim().lines().count(), 1, "{args:?}: {words}");
        let mut after = BTreeMap::new();
        files(folder.path(), &mut after);
        assert!(before == after, "{args:?} changed a file");
    }
    assert!(cases.len() >= 7);
    // The control: another name is written.
    let (code, words) = run(folder.path(), &["render", "scene.json", "--out", "new.tif", "--png", "new.png", "--device", "cpu"]);
    assert_eq!(code, Some(0), "{words}");
    assert!(folder.path().join("new.tif").exists() && folder.path().join("new.png").exists());
}

//! `sidecarm register FRAME… --together`, as it is typed.

use std::process::Command;

use glam::DVec3;
use serde_json::json;
use sidecarm::image::write_tiff_f32;
use sidecarm::pose::{Pose, Together};

use crate::pose_synthetic as synthetic;
use crate::pose_together::Lab;

/// Three drawn frames, a bead that has migrated, K with its standard deviations.
#[test]
fn frames_are_registered_together_by_the_command() {
    let seed = 5;
    let mut layout = synthetic::layout(9, 1.2, seed);
    layout.beads.iter_mut().for_each(|bead| bead.sigma_mm = Some(0.1));
    let lab = Lab::new(3, layout, seed);
    let mut drawn = lab.layout.clone();
    drawn.beads[2].lps_mm += DVec3::new(1.2, -1.0, 0.8);
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    for (n, view) in lab.views.iter().enumerate() {
        let drawing = synthetic::radiograph(*view, &drawn, 50000.0, n as u64);
        let pixels = synthetic::Radiograph { anatomy: false, metal: false, ..drawing }.draw();
        write_tiff_f32(std::path::Path::new(&path(&format!("f{n}.tif"))), std::slice::from_ref(&pixels)).expect("written");
    }
    let description = "radius_mm=1.2 sigma_mm=0.1";
    let point = |bead: &sidecarm::beads::Bead| json!({"label": bead.name, "position": bead.lps_mm.to_array(), "description": description});
    let points: Vec<_> = lab.layout.beads.iter().map(point).collect();
    let markups =
        json!({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}]});
    std::fs::write(path("beads.mrk.json"), markups.to_string()).expect("written");
    let k = lab.views[0].intrinsics;
    let file = json!({"intrinsics": [[k.fx + 5.0, 0, k.cx + 2.0], [0, k.fy + 5.0, k.cy - 2.0], [0, 0, 1]], "size_px": [1024, 1024],
        "pitch_mm": 1020.0 / k.fx, "sigma": {"source_to_detector_mm": 3, "principal_point_px": 5}});
    std::fs::write(path("K.json"), file.to_string()).expect("written");
    let run_on = |frames: &[&str], words: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_sidecarm"))
            .arg("register")
            .args(frames)
            .args(["--domain", "linear", "--beads", "beads.mrk.json", "--intrinsics", "K.json"])
            .args(words)
            .current_dir(folder.path())
            .output()
            .expect("runs")
    };
    let run = |words: &[&str]| run_on(&["f0.tif", "f1.tif", "f2.tif"], words);
    let out = run(&["--together", "--out", "solved"]);
    assert_eq!(out.status.code(), Some(0), "{out:?}");
    let words = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(words.contains("K solved") && words.contains("b2 has migrated by"), "{words}");
    let text = std::fs::read_to_string(path("solved/POSES.json")).expect("written");
    let together: Together = serde_json::from_str(&text).expect("reads what it writes");
    assert!(together.beads[2].migrated && together.views.len() == 3);
    let off = together.beads[2].lps_mm.distance(drawn.beads[2].lps_mm);
    assert!(off < 0.5, "{off} mm");
    let sigma = together.intrinsics_sigma_px.expect("solved");
    let found = together.intrinsics.expect("shared");
    assert!((found.fx - k.fx).abs() < 3.0 * sigma[0] && (found.cx - k.cx).abs() < 3.0 * sigma[2], "{found:?} ± {sigma:?}");
    let own = Pose::read(std::path::Path::new(&path("solved/02-f1.json"))).expect("each frame's own");
    assert!(own.is_accepted() && own.beads.len() == 9 && own.intrinsics_sigma_px.is_some());

    // One of the views shows two beads: the others are solved without it, which passed for a success of all.
    let mut few = drawn.clone();
    few.beads.truncate(2);
    let drawing = synthetic::radiograph(lab.views[2], &few, 50000.0, 9);
    let pixels = synthetic::Radiograph { anatomy: false, metal: false, ..drawing }.draw();
    write_tiff_f32(std::path::Path::new(&path("few.tif")), std::slice::from_ref(&pixels)).expect("written");
    let out = run_on(&["f0.tif", "f1.tif", "f2.tif", "few.tif"], &["--together", "--out", "lossy"]);
    let words = String::from_utf8_lossy(&out.stdout).into_owned();
    assert_eq!(out.status.code(), Some(3), "{out:?}");
    assert!(words.contains("3 of 4 views together") && words.contains("view 4: few.tif: refused: "), "{words}");

    // Several frames with nothing said, priors that do not pair, and a lens that one view has.
    for (words, expected) in [
        (&["--out", "P.json"][..], "3 frames are given"),
        (&["--together", "--prior", "solved/02-f1.json", "--out", "P.json"], "1 priors are given for 3 frames"),
        (&["--together", "--out", "f1.tif/POSES.json"], "f1.tif"),
        (&["--together", "--distortion", "ii.json", "--out", "P.json"], "--distortion can be none alone"),
    ] {
        let out = run(words);
        let complaint = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.code() == Some(1) && complaint.contains(expected), "{complaint}");
    }
}

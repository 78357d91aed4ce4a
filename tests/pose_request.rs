//! What a person may say about a registration, and what a refusal says back.

use std::process::Command;

use glam::{DVec2, DVec3};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::{BeadLayout, Correspondence, Detection};
use sidecarm::geometry::View;
use sidecarm::image::write_tiff_f32;
use sidecarm::pose::{Pose, Prior, Refusal, Registration, Rival, Status, register, register_shadows};

use crate::pose_registration::{landmark_error_px, matching, shadows};
use crate::pose_synthetic as synthetic;

/// A box looks the same after half a turn about each of its axes.
fn symmetric() -> BeadLayout {
    let corner = |n: i32| DVec3::new(f64::from(n & 1) * 70.0, f64::from(n >> 1 & 1) * 50.0, f64::from(n >> 2) * 40.0);
    let places: Vec<DVec3> = (0..8).map(|n| corner(n) - DVec3::new(35.0, 25.0, 20.0)).collect();
    synthetic::layout_of(&places, 0.75)
}

fn marks(view: &View, layout: &BeadLayout, pairs: &[(usize, usize)]) -> Vec<Correspondence> {
    let place = |bead: usize| view.projection().project(layout.beads[bead].lps_mm).0 + DVec2::new(1.5, -1.0);
    pairs.iter().map(|(named, at)| Correspondence { bead: layout.beads[*named].name.clone(), image_px: place(*at) }).collect()
}

/// A frame full of what looks like beads: the best forty are tried, and the others were not in the pose's file.
#[test]
fn every_shadow_is_told_of_tried_or_not() {
    let (view, layout) = (synthetic::view(620, 480, 8), synthetic::layout(9, 0.75, 3));
    let mut found = shadows(&view, &layout, 0.05, 0.0, 2);
    let beads = found.len();
    let stray = |n: usize| DVec2::new(20.0 + 37.0 * (n % 15) as f64, 15.0 + 53.0 * (n / 15) as f64 + 3.0 * (n % 7) as f64);
    let model = found[0];
    found.extend((0..60).map(|n| Detection { image_px: stray(n), snr: 1.0, ..model }));
    let pose = register_shadows(&matching(&view, &layout), &found);
    assert_eq!((pose.shadows.len(), pose.detections), (beads + 60, beads + 60), "{:?}", pose.reason);
    assert!(pose.notes.iter().any(|note| note.starts_with(&format!("{} more shadows", beads + 20))), "{:?}", pose.notes);
    assert!(!pose.doubt.as_ref().is_some_and(|doubt| doubt.contains("as clear as")), "faint ones: {:?}", pose.doubt);
    // The same forty are tried; the others are as clear as the beads.
    let mut clear = found.clone();
    clear[40..].iter_mut().for_each(|shadow| shadow.snr = model.snr);
    let pose = register_shadows(&matching(&view, &layout), &clear);
    let is_said = pose.cautions.iter().any(|caution| caution.contains("as clear as those of the beads"));
    assert!(pose.is_accepted() && is_said && pose.doubt.is_some(), "{:?} {:?}", pose.reason, pose.cautions);
    let few = register_shadows(&matching(&view, &layout), &found[..beads]);
    assert_eq!(few.doubt, None, "the control");
    assert!(few.is_accepted() && !few.notes.iter().any(|note| note.contains("more shadows")), "{:?} {:?}", few.reason, few.notes);
}

#[test]
fn named_shadows_settle_what_a_symmetric_layout_leaves_open() {
    let layout = symmetric();
    let view = synthetic::view(620, 480, 8);
    let found = shadows(&view, &layout, 0.1, 0.0, 2);
    let alone = register_shadows(&matching(&view, &layout), &found);
    assert!(matches!(alone.refusal, Some(Refusal::Ambiguous { rival: Rival::OtherNames, .. })), "{:?}", alone.reason);

    let right = marks(&view, &layout, &[(0, 0), (1, 1), (2, 2)]);
    let named = register_shadows(&Registration { correspondences: &right, ..matching(&view, &layout) }, &found);
    assert!(named.is_accepted() && landmark_error_px(&named, &view) < 1.0, "{:?}", named.reason);

    let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: None };
    let rests_on_prior = |correspondences: &[Correspondence]| {
        let request = Registration { correspondences, prior: Some(&prior), ..matching(&view, &layout) };
        register_shadows(&request, &found).cautions.iter().any(|caution| caution.contains("rests on the prior alone"))
    };
    assert!(rests_on_prior(&[]) && !rests_on_prior(&right));
    // What leaves open whether the pose is this one is set apart from what makes it less certain.
    let guided = register_shadows(&Registration { prior: Some(&prior), ..matching(&view, &layout) }, &found);
    assert!(guided.is_accepted() && guided.doubt.as_ref() == guided.cautions.first(), "{:?} {:?}", guided.doubt, guided.cautions);

    // Two names exchanged: no rigid box has its corners so.
    let wrong = marks(&view, &layout, &[(0, 1), (1, 0), (2, 2)]);
    let named = register_shadows(&Registration { correspondences: &wrong, ..matching(&view, &layout) }, &found);
    assert_eq!(named.status, Status::Refused);

    let nowhere = [Correspondence { bead: layout.beads[0].name.clone(), image_px: DVec2::new(1.0, 1.0) }];
    let unknown = [Correspondence { bead: "nobody".to_owned(), image_px: found[0].image_px }];
    let twice = marks(&view, &layout, &[(0, 0), (0, 1)]);
    for bad in [&nowhere[..], &unknown, &twice] {
        let pose = register_shadows(&Registration { correspondences: bad, ..matching(&view, &layout) }, &found);
        assert!(matches!(pose.refusal, Some(Refusal::Correspondences { .. })), "{:?}", pose.reason);
    }
}

#[test]
fn a_prior_that_contradicts_is_ignored_only_when_told() {
    let (view, layout) = (synthetic::view(1024, 1024, 3), synthetic::layout(9, 0.75, 3));
    let found = shadows(&view, &layout, 0.1, 0.05, 3);
    let mut covariance = [[0.0; 6]; 6];
    (0..6).for_each(|n| covariance[n][n] = if n < 3 { 1e-6 } else { 1e-2 });
    let off = sidecarm::geometry::Rigid::translation(DVec3::new(0.0, 0.0, 60.0)) * view.camera_from_lps;
    let prior = Prior { camera_from_lps: off, covariance: Some(covariance) };
    let strict = register_shadows(&Registration { prior: Some(&prior), ..matching(&view, &layout) }, &found);
    assert!(matches!(strict.refusal, Some(Refusal::PriorContradicted { .. })), "{:?}", strict.reason);
    let told = Registration { prior: Some(&prior), ignore_prior: true, ..matching(&view, &layout) };
    let pose = register_shadows(&told, &found);
    assert!(pose.is_accepted() && landmark_error_px(&pose, &view) < 1.0, "{:?}", pose.reason);
    assert!(pose.cautions.iter().any(|caution| caution.contains("check the prior")), "{:?}", pose.cautions);
    let unknown = register_shadows(&matching(&view, &layout), &found);
    assert!(unknown.is_accepted() && unknown.cautions.is_empty(), "the control: {:?}", unknown.cautions);
}

/// A refused frame says what it saw, in its file and in its picture.
#[test]
fn a_refusal_says_what_was_expected_and_what_was_found() {
    let (view, layout) = (synthetic::view(620, 480, 3), synthetic::layout(9, 1.5, 3));
    let drawing = synthetic::radiograph(view, &layout, 20000.0, 3);
    let pixels = synthetic::Radiograph { anatomy: false, metal: false, ..drawing }.draw();
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    write_tiff_f32(std::path::Path::new(&path("frame.tif")), std::slice::from_ref(&pixels)).expect("written");
    let other = synthetic::layout(9, 1.5, 77);
    let points: Vec<_> = other
        .beads
        .iter()
        .map(|bead| serde_json::json!({"label": bead.name, "position": bead.lps_mm.to_array(), "description": "radius_mm=1.5"}))
        .collect();
    let markups = serde_json::json!({"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}]});
    std::fs::write(path("beads.mrk.json"), markups.to_string()).expect("written");
    let k = view.intrinsics;
    let file = serde_json::json!({"intrinsics": [[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]], "size_px": [620, 480]});
    std::fs::write(path("K.json"), file.to_string()).expect("written");
    let run = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .args(["register", &path("frame.tif"), "--domain", "linear", "--beads", &path("beads.mrk.json")])
        .args(["--intrinsics", &path("K.json"), "--out", &path("POSE.json"), "--overlay", &path("seen.png"), "--explain"])
        .output()
        .expect("runs");
    let words = String::from_utf8_lossy(&run.stdout).into_owned() + &String::from_utf8_lossy(&run.stderr);
    assert_eq!(run.status.code(), Some(1), "{words}");
    assert!(words.contains("belongs to no bead"), "{words}");

    let text = std::fs::read_to_string(path("POSE.json")).expect("written");
    let pose: Pose = serde_json::from_str(&text).expect("reads what it writes");
    let refusal = pose.refusal.clone().expect("a refusal in parts");
    assert_eq!(pose.reason.as_deref(), Some(refusal.to_string().as_str()));
    assert!(text.contains(&format!("\"code\": \"{}\"", refusal.code())) && refusal.to_string().starts_with(&refusal.code()));
    // Every bead of the frame is among the shadows, and has a ring in the picture.
    let picture = image::open(path("seen.png")).expect("a picture").to_rgb8();
    let grey = |at: DVec2| picture.get_pixel(at.x.round() as u32, at.y.round() as u32).0;
    for bead in &layout.beads {
        let at = view.projection().project(bead.lps_mm).0;
        let near = |shadow: &&sidecarm::pose::Shadow| DVec2::from_array(shadow.image_px).distance(at) < 1.0;
        let shadow = pose.shadows.iter().find(near).unwrap_or_else(|| panic!("{} is not among the shadows", bead.name));
        let rim = DVec2::from_array(shadow.image_px) + DVec2::new(shadow.radius_px + 4.0, 0.0);
        assert!(grey(rim).iter().all(|value| *value > 150), "{:?} around {}", grey(rim), bead.name);
    }
    let frame = Frame::from_pixels("drawn", pixels, Domain::Linear).expect("finite");
    assert!(register(&matching(&view, &layout), &frame).is_accepted(), "the control");
}

/// With K or layout as given, σ speaks of the beads' shadows alone; how far a wrong one moves the specimen is said, and is so.
#[test]
fn what_sigma_leaves_out_is_said_and_true() {
    let (view, layout) = (synthetic::view(1024, 1024, 3), synthetic::layout(9, 0.75, 3));
    let found = shadows(&view, &layout, 0.1, 0.0, 3);
    let at = |pose: &Pose| pose.camera_from_lps.expect("accepted").transform_point(pose.centroid_lps_mm.expect("beads"));
    let right = register_shadows(&matching(&view, &layout), &found);
    let words = right.beyond_sigma().expect("K is given");
    let number = |before: &str| -> f64 {
        let from = words.find(before).unwrap_or_else(|| panic!("{before} is not in {words}")) + before.len();
        words[from..].split(' ').next().expect("a number").parse().expect("a number")
    };
    let (along_mm, across_mm) = (number("moves the specimen "), number("wrong by 10 px "));
    let with = |k: sidecarm::geometry::Intrinsics| {
        let pose = register_shadows(&Registration { intrinsics: Some(k), ..matching(&view, &layout) }, &found);
        assert!(pose.is_accepted(), "{:?}", pose.reason);
        at(&pose) - at(&right)
    };
    let k = view.intrinsics;
    let longer = with(sidecarm::geometry::Intrinsics { fx: 1.01 * k.fx, fy: 1.01 * k.fy, ..k });
    assert!((longer.z - along_mm).abs() < 0.15 * along_mm, "{longer} for {along_mm} mm");
    let aside = with(sidecarm::geometry::Intrinsics { cx: k.cx + 10.0, ..k });
    assert!((aside.x.abs() - across_mm).abs() < 0.15 * across_mm, "{aside} for {across_mm} mm");
    assert!(Pose::default().beyond_sigma().is_none());
}

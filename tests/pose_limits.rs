//! The limits at which a pose is flagged, refused or sought no further: beads nearly in a plane, a focal length that they hardly determine,
//! thousands of shadows that are none.

use glam::{DVec2, DVec3};
use nalgebra::DMatrix;
use sidecarm::beads::{BeadLayout, Detection, Landmark};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::pose::{Pose, Prior, Refusal, Registration, fuse, register_shadows};

use crate::pose_mistakes::about_beads;
use crate::pose_registration::{clutter, landmark_error_px, matching, shadows};
use crate::pose_synthetic as synthetic;

/// Of the shadows, as drawn and as stated: small beside what is stated of the beads' places.
pub const NOISE_PX: f64 = 0.02;
/// Numbers of a pose, and of a pose with focal length and principal point.
const POSE: usize = 6;
const POSE_AND_K: usize = 9;

/// The layout's z axis is tilted against the line of sight.
pub fn tilted_view(tilt_deg: f64) -> View {
    let intrinsics = Intrinsics { fx: 3480.0, fy: 3480.0, skew: 0.0, cx: 511.5, cy: 511.5 };
    let turn = Rigid::exp(DVec3::X * tilt_deg.to_radians(), DVec3::ZERO);
    View { size_px: [1024, 1024], intrinsics, camera_from_lps: Rigid::translation(DVec3::Z * 680.0) * turn }
}

/// By differences: how a place moves in the picture with turns and shifts of the camera about `centre_lps`, then with f, cx and cy.
fn by_camera(view: &View, centre_lps: DVec3, lps_mm: DVec3, numbers: usize) -> DMatrix<f64> {
    let centre = view.camera_from_lps.transform_point(centre_lps);
    let at = |n: usize, step: f64| {
        let mut k = view.intrinsics;
        let along = DVec3::AXES[n % 3] * step;
        let moved = match n / 3 {
            0 => Rigid::exp(along, DVec3::ZERO),
            1 => Rigid::translation(along),
            _ => Rigid::IDENTITY,
        };
        match n {
            6 => (k.fx, k.fy) = (k.fx + step, k.fy + step),
            7 => k.cx += step,
            8 => k.cy += step,
            _ => {}
        }
        let camera_from_lps = Rigid::translation(centre) * moved * Rigid::translation(-centre) * view.camera_from_lps;
        k.project(camera_from_lps.transform_point(lps_mm))
    };
    let column = |n: usize| {
        let step = if n < 3 { 1e-5 } else { 1e-2 };
        (at(n, step) - at(n, -step)) / (2.0 * step)
    };
    let columns: Vec<DVec2> = (0..numbers).map(column).collect();
    DMatrix::from_fn(2, numbers, |row, n| columns[n][row])
}

/// The same with the place itself, mm.
fn by_place(view: &View, lps_mm: DVec3) -> DMatrix<f64> {
    let at = |lps_mm: DVec3| view.intrinsics.project(view.camera_from_lps.transform_point(lps_mm));
    let step = 1e-2;
    let columns = DVec3::AXES.map(|axis| (at(lps_mm + axis * step) - at(lps_mm - axis * step)) / (2.0 * step));
    DMatrix::from_fn(2, 3, |row, n| columns[n][row])
}

/// Covariance of the first `numbers` of a camera that is solved from beads known to `sigma_mm` per axis: the inverse of Σ JᵀΣ⁻¹J.
fn covariance(view: &View, layout: &BeadLayout, sigma_mm: f64, numbers: usize) -> DMatrix<f64> {
    let mut information = DMatrix::<f64>::zeros(numbers, numbers);
    for bead in &layout.beads {
        let jacobian = by_camera(view, layout.centroid_lps_mm(), bead.lps_mm, numbers);
        let place = by_place(view, bead.lps_mm);
        let spread = DMatrix::<f64>::identity(2, 2) * NOISE_PX.powi(2) + &place * place.transpose() * sigma_mm.powi(2);
        information += jacobian.transpose() * spread.try_inverse().expect("positive") * &jacobian;
    }
    information.try_inverse().expect("enough beads")
}

/// Along the worst direction, of the worst of some places.
pub fn worst_px(view: &View, layout: &BeadLayout, sigma_mm: f64, places: &[DVec3]) -> f64 {
    let covariance = covariance(view, layout, sigma_mm, POSE);
    let sigma_px = |lps_mm: &DVec3| {
        let jacobian = by_camera(view, layout.centroid_lps_mm(), *lps_mm, POSE);
        (&jacobian * &covariance * jacobian.transpose()).symmetric_eigenvalues().max().sqrt()
    };
    places.iter().map(sigma_px).fold(0.0, f64::max)
}

/// The places one layout radius off the plane z = 0 above a bead or above their middle.
fn off_plane(layout: &BeadLayout) -> Vec<DVec3> {
    let middle = layout.centroid_lps_mm();
    let radius_mm = layout.beads.iter().map(|bead| bead.lps_mm.distance(middle)).fold(0.0, f64::max);
    let feet = layout.beads.iter().map(|bead| bead.lps_mm).chain([middle]);
    feet.flat_map(|foot| [1.0, -1.0].map(|side| foot + DVec3::Z * (side * radius_mm))).collect()
}

/// Relative, of the focal length where it is solved.
fn focal_share(view: &View, layout: &BeadLayout, sigma_mm: f64) -> f64 {
    covariance(view, layout, sigma_mm, POSE_AND_K)[(POSE, POSE)].sqrt() / view.intrinsics.fx
}

/// How well the beads must be known for an uncertainty that is `of` it to be `wanted`: it grows with theirs, nearly in proportion.
fn sigma_mm_for(wanted: f64, of: impl Fn(f64) -> f64) -> f64 {
    (0..4).fold(0.1, |sigma_mm, _| sigma_mm * wanted / of(sigma_mm))
}

pub fn known_to(mut layout: BeadLayout, sigma_mm: f64) -> BeadLayout {
    layout.beads.iter_mut().for_each(|bead| bead.sigma_mm = Some(sigma_mm));
    layout
}

/// The pixels that one of `all`, which contains `words`, says something is uncertain by.
fn stated_px(all: &[String], words: &str) -> Option<f64> {
    let (_, rest) = all.iter().find(|said| said.contains(words))?.split_once("uncertain by ")?;
    rest.split(' ').next()?.parse().ok()
}

/// A plate that is tilted against the line of sight, its shadows, and a prior that tells it from its mirror image about that line.
fn tilted_plate() -> (View, BeadLayout, Vec<Detection>, Prior) {
    let view = tilted_view(25.0);
    let places = [(-30.0, -20.0), (25.0, -28.0), (31.0, 14.0), (-8.0, 30.0), (-26.0, 12.0), (4.0, -6.0), (12.0, 22.0)]
        .map(|(x, y)| DVec3::new(x, y, 0.0));
    let plate = synthetic::layout_of(&places, 0.75);
    let found = shadows(&view, &plate, NOISE_PX, 0.0, 1);
    assert_eq!(found.len(), places.len(), "all in the picture");
    let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: Some(about_beads(&view.camera_from_lps, 1.0, 5.0)) };
    (view, plate, found, prior)
}

fn landmark(lps_mm: DVec3) -> Landmark {
    Landmark { name: "screw".to_owned(), lps_mm }
}

/// A plate holds what lies in it, and what lies a hand's breadth above it much worse: residuals are small all the same.
#[test]
fn a_pose_that_is_loose_off_its_beads_plane_is_flagged() {
    let (view, plate, found, prior) = tilted_plate();
    let said = |sigma_mm: f64, landmarks: &[Landmark]| {
        let layout = known_to(plate.clone(), sigma_mm);
        let pose = register_shadows(&Registration { prior: Some(&prior), landmarks, ..matching(&view, &layout) }, &found);
        assert!(pose.is_accepted(), "{sigma_mm} mm: {:?}", pose.reason);
        println!("{sigma_mm:.3} mm: {:?} {:?} {:?}", pose.notes, pose.cautions, pose.doubt);
        let loosely = "hold the pose loosely";
        let off_plane = stated_px(&pose.cautions, &format!("{loosely}: off their plane"));
        [stated_px(&pose.notes, "nearly flat"), off_plane, stated_px(pose.doubt.as_slice(), loosely)]
    };
    // Among the beads: certain, whatever is off their plane. Beside it: what somebody wants there.
    let middle = plate.centroid_lps_mm();
    let beside = middle + DVec3::Z * 80.0;
    let mut cases = 0;
    // From 1.5 px on it is a note, so that nothing above 2 px escapes; above 2 px a caution, and at a landmark a doubt.
    for (wanted_px, is_flagged, is_loose) in [(1.0, false, false), (1.75, true, false), (2.6, true, true)] {
        // Said to a tenth of a pixel.
        let near = |stated: f64| (stated - wanted_px).abs() <= 0.05 + 0.1 * wanted_px;
        let sigma_mm = sigma_mm_for(wanted_px, |sigma_mm| worst_px(&view, &plate, sigma_mm, &off_plane(&plate)));
        let [note, caution, doubt] = said(sigma_mm, &[]);
        assert_eq!((note.is_some(), caution.is_some(), doubt), (is_flagged && !is_loose, is_loose, None), "{wanted_px} px");
        assert!(note.or(caution).is_none_or(near), "{wanted_px} px: {note:?} {caution:?}");
        let [note, caution, doubt] = said(sigma_mm, &[landmark(middle)]);
        assert_eq!((note.is_some(), caution, doubt), (is_flagged, None, None), "{wanted_px} px, and a landmark among the beads");
        assert!(note.is_none_or(near), "{wanted_px} px: {note:?}");
        let sigma_mm = sigma_mm_for(wanted_px, |sigma_mm| worst_px(&view, &plate, sigma_mm, &[beside]));
        let [_, caution, doubt] = said(sigma_mm, &[landmark(middle), landmark(beside)]);
        assert_eq!((caution, doubt.is_some()), (None, is_loose), "{wanted_px} px at a landmark beside the beads");
        assert!(doubt.is_none_or(near), "{wanted_px} px: {doubt:?}");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

/// Where telemetry holds what a plate's beads leave loose, the fused pose is in no doubt for it.
#[test]
fn a_fused_pose_is_as_loose_as_both_leave_it() {
    let (view, plate, found, prior) = tilted_plate();
    let beside = plate.centroid_lps_mm() + DVec3::Z * 80.0;
    let layout = known_to(plate.clone(), sigma_mm_for(2.6, |sigma_mm| worst_px(&view, &plate, sigma_mm, &[beside])));
    let landmarks = [landmark(beside)];
    let request = Registration { prior: Some(&prior), landmarks: &landmarks, ..matching(&view, &layout) };
    let alone = register_shadows(&request, &found);
    let is_loose = |pose: &Pose| pose.doubt.as_ref().is_some_and(|words| words.contains("loosely"));
    assert!(alone.is_accepted() && is_loose(&alone), "the control: {:?} {:?}", alone.reason, alone.doubt);
    let measured = Prior { covariance: Some(about_beads(&view.camera_from_lps, 0.02, 0.1)), ..prior };
    // What both leave is not in doubt by itself.
    let firm = Pose { doubt: None, ..alone.clone() };
    let both = |by_beads: Pose| fuse(by_beads, &measured, &|_| firm.clone());
    let fused = both(alone.clone());
    assert!(fused.innovation.is_some() && fused.doubt.is_none(), "{:?} {:?}", fused.doubt, fused.notes);
    let twins = Some("the prior alone tells it from its twin".to_owned());
    let twin = Pose { doubt: twins.clone(), ..alone.clone() };
    assert_eq!(both(twin.clone()).doubt, twins, "the control");
    assert_eq!(
        fuse(twin.clone(), &measured, &|_| alone.clone()).doubt,
        twins,
        "what is loose with telemetry too does not hide it"
    );
    // What is loose is no other pose: it may tie the specimen to the room, and as a prior it is as good as it says.
    assert!(!alone.may_be_another() && twin.may_be_another());
    let folder = tempfile::tempdir().expect("a folder");
    let doubt_of = |pose: &Pose| {
        let path = folder.path().join("POSE.json");
        pose.write(&path).expect("written");
        Prior::read_with_doubt(&path).expect("a prior").1
    };
    assert_eq!([doubt_of(&alone), doubt_of(&twin)], [None, twins]);
}

/// K free: what a small cloud or a nearly flat one leaves open, focal length against distance, no residual shows.
#[test]
fn a_cloud_that_does_not_determine_the_focal_length_is_refused() {
    let view = tilted_view(30.0);
    let cloud = |scale: DVec3| {
        let places: Vec<DVec3> = synthetic::layout(12, 0.75, 1).beads.iter().map(|bead| bead.lps_mm * scale).collect();
        synthetic::layout_of(&places, 0.75)
    };
    let seen = |layout: &BeadLayout| {
        let found = shadows(&view, layout, NOISE_PX, 0.0, 1);
        assert_eq!(found.len(), layout.beads.len(), "all in the picture");
        found
    };
    let free = |layout: &BeadLayout| {
        let request = Registration { intrinsics: None, pitch_mm: None, ..matching(&view, layout) };
        register_shadows(&request, &seen(layout))
    };
    let is_degenerate = |pose: &Pose| matches!(pose.refusal, Some(Refusal::FocalDegenerate { .. }));
    let mut cases = 0;
    for (name, scale) in [("small", DVec3::splat(0.25)), ("flat", DVec3::new(1.0, 1.0, 0.1))] {
        let plain = cloud(scale);
        // A fifth; a tenth is allowed.
        let sigma_mm = sigma_mm_for(0.2, |sigma_mm| focal_share(&view, &plain, sigma_mm));
        let pose = free(&known_to(plain.clone(), sigma_mm));
        println!("{name}, beads known to {sigma_mm:.3} mm: {:?}", pose.reason);
        let Some(Refusal::FocalDegenerate { focal_px, sigma_px }) = pose.refusal else {
            panic!("{name}: {:?} {:?}", pose.reason, pose.intrinsics)
        };
        assert!((0.14..=0.28).contains(&(sigma_px / focal_px)), "{name}: {focal_px} ± {sigma_px} px");
        assert!(!pose.is_accepted() && pose.projection.is_none() && pose.camera_from_lps.is_none(), "{name}");
        // Beads known no better, but over twelve centimetres each way.
        let large = known_to(cloud(DVec3::ONE), sigma_mm);
        assert!(focal_share(&view, &large, sigma_mm) < 0.08, "{name}: {sigma_mm} mm");
        assert!(!is_degenerate(&free(&large)), "{name}, the control");
        cases += 1;
    }
    assert_eq!(cases, 2);

    let small = cloud(DVec3::splat(0.25));
    let sigma_mm = sigma_mm_for(0.2, |sigma_mm| focal_share(&view, &small, sigma_mm));
    let large = known_to(cloud(DVec3::ONE), sigma_mm);
    let pose = free(&large);
    assert!(pose.is_accepted(), "the control: {:?}", pose.reason);
    assert!(landmark_error_px(&pose, &view) < 0.5, "{} px", landmark_error_px(&pose, &view));
    let (stated, expected) = (
        pose.intrinsics_sigma_px.expect("solved")[0] / pose.intrinsics.expect("solved").fx,
        focal_share(&view, &large, sigma_mm),
    );
    assert!((stated / expected - 1.0).abs() < 0.3, "{stated} for {expected}");
    // What the refusal asks for.
    let small = known_to(small, sigma_mm);
    let known = register_shadows(&matching(&view, &small), &seen(&small));
    assert!(known.is_accepted(), "the small cloud with K: {:?}", known.reason);
}

/// Shadows that look least like beads are not tried: forty are, and it is said how many are not, however many there are.
#[test]
fn ten_thousand_false_shadows_leave_a_bounded_search() {
    const TRIED: usize = 40;
    let (view, layout) = (synthetic::view(1024, 1024, 3), synthetic::layout(6, 0.75, 3));
    let beads = shadows(&view, &layout, 0.05, 0.0, 3);
    assert!(beads.len() >= 5, "{} in the picture", beads.len());
    let strays = clutter(&view, 10_000, beads[0].radius_px, 3);
    let of = |found: &[Detection]| register_shadows(&matching(&view, &layout), found);
    let mut cases = 0;
    for (beads_first, found) in [(true, [&beads[..], &strays].concat()), (false, [&strays[..], &beads].concat())] {
        let pose = of(&found);
        println!("beads first {beads_first}: {:?} {:?} {:?}", pose.status, pose.reason, pose.cautions);
        assert_eq!((pose.detections, pose.shadows.len()), (found.len(), found.len()), "all are told of");
        let untried =
            format!("{} more shadows, which look less like beads than the {TRIED} others, were not tried", found.len() - TRIED);
        assert!(pose.notes.iter().any(|note| note.starts_with(&untried)), "{:?}", pose.notes);
        assert!(pose.shadows.iter().skip(TRIED).all(|shadow| shadow.bead.is_none()), "what was not tried is no bead's");
        if beads_first {
            // Random shadows may be taken for a second reading, which is a refusal; but not for the pose.
            assert!(!pose.is_accepted() || landmark_error_px(&pose, &view) < 2.0, "{} px", landmark_error_px(&pose, &view));
        } else {
            assert!(!pose.is_accepted(), "none of the beads is among those tried: {:?}", pose.chance);
        }
        cases += 1;
    }
    assert_eq!(cases, 2);
    let alone = of(&beads);
    assert!(alone.is_accepted() && landmark_error_px(&alone, &view) < 1.0, "the control: {:?}", alone.reason);
    assert!(!alone.notes.iter().any(|note| note.contains("more shadows")), "{:?}", alone.notes);
}

//! Matches that fit and are wrong: what else the frame shows speaks against them.

use glam::DVec3;
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::{BeadLayout, Detection};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::image::Image;
use sidecarm::pose::{Covariance, Prior, Refusal, Registration, register, register_shadows};

use crate::pose_registration::{landmark_error_px, matching, reason, shadows};
use crate::pose_synthetic as synthetic;

/// The view with the specimen turned by `turn_deg` about an oblique axis and moved across by `shift_mm`.
fn beside(view: &View, layout: &BeadLayout, turn_deg: f64, shift_mm: f64) -> View {
    let centre = view.camera_from_lps.transform_point(layout.centroid_lps_mm());
    let turn = Rigid::exp(DVec3::new(0.3, 0.5, 0.8).normalize() * turn_deg.to_radians(), DVec3::ZERO);
    let about = Rigid::translation(centre + DVec3::new(shift_mm, 0.4 * shift_mm, 0.0)) * turn * Rigid::translation(-centre);
    View { camera_from_lps: about * view.camera_from_lps, ..*view }
}

/// Standard deviations of turns and shifts about `centre`, in `camera`, written for the camera's origin.
pub fn covariance_about(centre: DVec3, turn_deg: [f64; 3], shift_mm: [f64; 3]) -> Covariance {
    let mut local = nalgebra::Matrix6::<f64>::zeros();
    (0..3).for_each(|n| (local[(n, n)], local[(n + 3, n + 3)]) = (turn_deg[n].to_radians().powi(2), shift_mm[n].powi(2)));
    let mut shift = nalgebra::Matrix6::<f64>::identity();
    let cross = nalgebra::Matrix3::new(0.0, -centre.z, centre.y, centre.z, 0.0, -centre.x, -centre.y, centre.x, 0.0);
    shift.fixed_view_mut::<3, 3>(3, 0).copy_from(&cross);
    let covariance = shift * local * shift.transpose();
    std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i, j)]))
}

/// A second set of the same beads, or their ghost, must be told, whichever of the two fits better.
#[test]
fn a_copy_of_the_layout_makes_a_frame_ambiguous() {
    let mut cases = 0;
    for seed in 0..2 {
        let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(9, 0.75, seed));
        for (turn_deg, shift_mm, own) in [(25.0, 30.0, 9), (25.0, 30.0, 6), (0.0, 4.0, 6), (0.0, 9.0, 5)] {
            let mut found: Vec<Detection> = shadows(&view, &layout, 0.1, 0.05, seed);
            found.truncate(own);
            found.extend(shadows(&beside(&view, &layout, turn_deg, shift_mm), &layout, 0.1, 0.05, seed + 50));
            let pose = register_shadows(&matching(&view, &layout), &found);
            let told = reason(&pose);
            assert!(told.starts_with("ambiguous"), "seed {seed}, {turn_deg}°, {shift_mm} mm: {told}");
            cases += 1;
        }
        let alone = register_shadows(&matching(&view, &layout), &shadows(&view, &layout, 0.1, 0.05, seed));
        assert!(alone.is_accepted(), "control: {:?}", alone.reason);
    }
    assert_eq!(cases, 8);
}

/// A former frame's ghost: the same beads a little beside, `times` times fainter, each by a little more or less.
fn ghost(view: &View, layout: &BeadLayout, times: f64, seed: u64) -> Vec<Detection> {
    let mut found = shadows(&beside(view, layout, 1.5, 4.0), layout, 0.1, 0.02, seed + 50);
    for (n, shadow) in found.iter_mut().enumerate() {
        shadow.contrast *= (0.15 * (1.7 * n as f64).sin()).exp() / times;
        shadow.snr = (shadow.snr / times).max(7.0);
    }
    found
}

/// Frames of a detector that lags were refused as ambiguous, and lag was never named: a second specimen is as deep as the first one, a ghost is
/// fainter throughout.
#[test]
fn a_ghost_that_is_far_fainter_throughout_is_set_aside_with_a_doubt_and_a_copy_is_not() {
    const WORDS: &str = "times fainter";
    let (mut set_aside, mut named, mut cases) = (0, 0, 0);
    for seed in 0..3 {
        let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(9, 0.75, seed));
        let own = shadows(&view, &layout, 0.05, 0.02, seed);
        let with = |others: Vec<Detection>| {
            let all: Vec<Detection> = others.into_iter().chain(own.iter().copied()).collect();
            register_shadows(&matching(&view, &layout), &all)
        };
        // As deep, whatever comes first: a second specimen.
        let told = with(ghost(&view, &layout, 1.0, seed));
        assert!(reason(&told).starts_with("ambiguous") && !reason(&told).contains(WORDS), "seed {seed}: {}", reason(&told));
        for times in [4.0, 6.0, 8.0] {
            let pose = with(ghost(&view, &layout, times, seed));
            assert!(pose.is_accepted(), "seed {seed}, {times} times: {:?}", pose.reason);
            assert!(pose.doubt.as_deref().is_some_and(|doubt| doubt.contains(WORDS)), "never green: {:?}", pose.cautions);
            assert!(landmark_error_px(&pose, &view) < 1.0, "the stronger one: {} px", landmark_error_px(&pose, &view));
            assert_eq!(pose.shadows.len(), pose.detections, "those of the ghost stay in the file");
            set_aside += 1;
        }
        // Not far enough fainter to be set aside: named all the same.
        let half = with(ghost(&view, &layout, 2.0, seed));
        assert!(reason(&half).starts_with("ambiguous"), "{}", reason(&half));
        named += usize::from(reason(&half).contains(WORDS));
        // A second specimen behind bone here and air there is fainter as well, but not throughout.
        let mut uneven = ghost(&view, &layout, 1.0, seed);
        for (n, shadow) in uneven.iter_mut().enumerate() {
            shadow.contrast /= [3.0, 5.0, 8.0, 13.0][n % 4];
            shadow.snr = 10.0;
        }
        let pose = with(uneven);
        assert!(!pose.is_accepted() || pose.doubt.is_some(), "seed {seed}: {:?}", pose.cautions);
        let told = [pose.reason, pose.doubt].into_iter().flatten().collect::<String>();
        assert!(!told.contains(WORDS), "seed {seed}: {told}");
        cases += 1;
    }
    assert!(cases == 3 && set_aside == 9 && named >= 2, "{cases}, {set_aside}, {named}");
}

/// A pose fits any K or scale; a prior that states its covariance does not fit the depth that comes out.
#[test]
fn a_wrong_k_or_scale_contradicts_a_prior_with_covariance() {
    let mut cases = 0;
    for seed in 0..4 {
        let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(9, 0.75, seed));
        let found = shadows(&view, &layout, 0.1, 0.05, seed);
        let centre = view.camera_from_lps.transform_point(layout.centroid_lps_mm());
        let covariance = covariance_about(centre, [1.0; 3], [3.0; 3]);
        let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: Some(covariance) };
        let k = view.intrinsics;
        let longer = Intrinsics { fx: 1.15 * k.fx, fy: 1.15 * k.fy, ..k };
        let shifted = Intrinsics { cx: k.cx + 150.0, ..k };
        let places: Vec<DVec3> = layout.beads.iter().map(|bead| bead.lps_mm * 1.1).collect();
        let stretched = synthetic::layout_of(&places, 0.75);
        for (name, k, layout) in [("K", longer, &layout), ("principal point", shifted, &layout), ("scale", k, &stretched)] {
            let request = Registration { intrinsics: Some(k), prior: Some(&prior), ..matching(&view, layout) };
            let pose = register_shadows(&request, &found);
            let told = reason(&pose);
            assert!(told.starts_with("prior_contradicted") || told.starts_with("no_match"), "seed {seed}, {name}: {told}");
            cases += 1;
        }
        let right = register_shadows(&Registration { prior: Some(&prior), ..matching(&view, &layout) }, &found);
        assert!(right.is_accepted() && landmark_error_px(&right, &view) < 1.0, "control: {:?}", right.reason);
    }
    assert_eq!(cases, 12);
}

/// A picture that a console had enlarged was accepted with K as it was, centimetres off in depth, without a word: six beads tell no K, and their
/// shadows grow with it.
#[test]
fn an_enlarged_picture_is_told_by_the_depth_of_the_prior() {
    const ZOOM: f64 = 1.075;
    const SAID: &str = "where the console has enlarged or cropped it declare that";
    let (mut told, mut controls) = (0, 0);
    for seed in 0..12 {
        let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(6, 0.75, seed));
        let found = shadows(&view, &layout, 0.7, 0.05, seed);
        let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: None };
        let request = Registration { prior: Some(&prior), ..matching(&view, &layout) };
        let middle = glam::DVec2::new(view.intrinsics.cx, view.intrinsics.cy);
        let enlarged: Vec<Detection> = found
            .iter()
            .map(|shadow| Detection {
                image_px: middle + ZOOM * (shadow.image_px - middle),
                radius_px: ZOOM * shadow.radius_px,
                ..*shadow
            })
            .collect();
        let says = |found: &[Detection]| {
            let pose = register_shadows(&request, found);
            pose.is_accepted().then(|| pose.cautions.iter().any(|caution| caution.contains(SAID)))
        };
        let (zoomed, plain) = (says(&enlarged), says(&found));
        assert!(zoomed != Some(false), "seed {seed}: accepted without a word");
        assert!(plain != Some(true), "seed {seed}: the control");
        told += usize::from(zoomed == Some(true));
        controls += usize::from(plain == Some(false));
    }
    println!("{told} told, {controls} controls");
    assert!(told >= 3 && controls >= 3, "{told} told, {controls} controls");
}

/// Without a prior that says better, the beads themselves tell a K that is far off.
#[test]
fn a_k_that_is_far_off_is_named() {
    let (mut named, mut cases) = (0, 0);
    for seed in 0..10 {
        if cases >= 6 && 2 * named >= cases {
            break;
        }
        let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(11, 0.75, seed));
        let found = shadows(&view, &layout, 0.1, 0.05, seed);
        assert!(found.len() >= 9, "{} in the picture", found.len());
        let k = view.intrinsics;
        for factor in [0.8, 1.25] {
            let wrong = Intrinsics { fx: factor * k.fx, fy: factor * k.fy, ..k };
            let pose = register_shadows(&Registration { intrinsics: Some(wrong), ..matching(&view, &layout) }, &found);
            if pose.is_accepted() {
                // What few beads cannot tell is small.
                assert!(landmark_error_px(&pose, &view) < 4.0, "seed {seed}, {factor}: {}", landmark_error_px(&pose, &view));
            } else {
                named += usize::from(["intrinsics", "missing"].iter().any(|word| reason(&pose).starts_with(word)));
            }
            cases += 1;
        }
        for noise_mm in [0.05, 0.15] {
            let found = shadows(&view, &layout, 0.1, noise_mm, seed + 70);
            let right = register_shadows(&matching(&view, &layout), &found);
            assert!(right.is_accepted(), "control, seed {seed}, {noise_mm} mm: {:?}", right.reason);
        }
    }
    assert!(cases >= 6 && 2 * named >= cases, "{named} of {cases}");
}

/// Beads that K contradicts most were left out as displaced, and what was left fitted: accepted, centimetres off, without a word.
#[test]
fn beads_that_another_k_explains_are_not_just_left_out() {
    const LEFT_OUT: &str = "those that were left out as displaced among them";
    let (mut cases, mut told, mut left_out) = (0, 0, 0);
    for seed in 0..24 {
        let (view, mut layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(11, 0.75, seed));
        layout.beads.iter_mut().for_each(|bead| bead.sigma_mm = Some(0.02));
        let found = shadows(&view, &layout, 0.05, 0.02, seed);
        if found.len() < 9 {
            continue;
        }
        let with = |k: Intrinsics| register_shadows(&Registration { intrinsics: Some(k), ..matching(&view, &layout) }, &found);
        let k = view.intrinsics;
        for wrong in [Intrinsics { cx: k.cx - 70.0, cy: k.cy - 144.0, ..k }, Intrinsics { fx: 0.9 * k.fx, fy: 0.9 * k.fy, ..k }] {
            let pose = with(wrong);
            let plain = pose.is_accepted() && pose.doubt.is_none();
            let off_px = if plain { landmark_error_px(&pose, &view) } else { 0.0 };
            assert!(off_px < 2.0, "seed {seed}: accepted {off_px} px off, {:?}", pose.cautions);
            told += usize::from(!plain);
            cases += 1;
        }
        // Off by so little that most beads fit all the same.
        for off in [0.93, 0.95, 0.97, 1.03, 1.05, 1.07] {
            let pose = with(Intrinsics { fx: off * k.fx, fy: off * k.fy, cx: k.cx + 60.0, ..k });
            left_out += usize::from(pose.cautions.iter().any(|caution| caution.contains(LEFT_OUT)));
        }
        let right = with(k);
        assert!(right.is_accepted() && right.doubt.is_none(), "seed {seed}, the control: {:?} {:?}", right.reason, right.doubt);
    }
    println!("{told} of {cases} told, {left_out} by beads that were left out");
    assert!(cases >= 20 && 10 * told >= 9 * cases && left_out >= 6, "{told} of {cases}, {left_out} by beads that were left out");
}

/// A prior that has nothing to do with the frame does not stop nine clear beads: the pose comes without it, and says so.
#[test]
fn an_unrelated_prior_does_not_stop_clear_beads() {
    let mut cases = 0;
    for seed in 0..12 {
        let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(9, 0.75, seed));
        let found = shadows(&view, &layout, 0.1, 0.05, seed);
        if found.len() < 9 {
            continue;
        }
        let unrelated = beside(&view, &layout, 100.0 + 5.0 * seed as f64, 60.0);
        let prior = Prior { camera_from_lps: unrelated.camera_from_lps, covariance: None };
        let pose = register_shadows(&Registration { prior: Some(&prior), ..matching(&view, &layout) }, &found);
        assert!(pose.is_accepted(), "seed {seed}: {:?}", pose.reason);
        assert!(landmark_error_px(&pose, &view) < 1.0, "seed {seed}");
        assert!(pose.cautions.iter().any(|caution| caution.contains("check the prior")), "seed {seed}: {:?}", pose.cautions);
        cases += 1;
    }
    assert!(cases >= 4, "{cases}");
}

#[test]
fn a_mirrored_frame_is_named_so() {
    let (view, layout) = (synthetic::view(620, 480, 3), synthetic::layout(9, 1.0, 3));
    let pixels = synthetic::radiograph(view, &layout, 50_000.0, 3).draw();
    let mirrored: Vec<f32> = pixels.pixels.chunks(pixels.width).flat_map(|row| row.iter().rev().copied()).collect();
    let frame = |pixels: Image<f32>| Frame::from_pixels("drawn", pixels, Domain::Linear).expect("finite");
    let upright = frame(pixels.clone());
    assert!(register(&matching(&view, &layout), &upright).is_accepted(), "control");
    let turned = frame(Image { pixels: mirrored, ..pixels });
    let pose = register(&matching(&view, &layout), &turned);
    assert!(reason(&pose).starts_with("mirrored"), "{:?}", pose.reason);
}

/// Six beads of thirteen fit, seven are certainly not where they should be, and clear shadows belong to nothing.
#[test]
fn beads_that_should_be_seen_and_are_not_refuse_a_pose() {
    let is_told = |seed: u64| {
        let (view, layout) = (synthetic::view(620, 480, seed), synthetic::layout(9, 1.0, seed));
        let mut drawing = synthetic::radiograph(view, &layout, 50_000.0, seed);
        (drawing.anatomy, drawing.metal) = (false, false);
        let frame = Frame::from_pixels("drawn", drawing.draw(), Domain::Linear).expect("finite");
        let other = synthetic::layout(7, 1.0, seed + 900);
        let places: Vec<DVec3> = layout.beads[..6].iter().chain(&other.beads).map(|bead| bead.lps_mm).collect();
        let wrong = synthetic::layout_of(&places, 1.0);
        let pose = register(&matching(&view, &wrong), &frame);
        let told = reason(&pose);
        assert!(["missing", "chance", "ambiguous", "no_match"].iter().any(|word| told.starts_with(word)), "{told}");
        println!("{told}");
        assert!(register(&matching(&view, &layout), &frame).is_accepted(), "control");
        told.starts_with("missing")
    };
    assert!([0, 3, 5].into_iter().any(is_told), "none is refused for them");
}

/// Beads clipped to black in a row are no writing.
#[test]
fn a_row_of_beads_clipped_to_black_is_found() {
    let view = synthetic::view(1024, 1024, 3);
    let rotation = view.camera_from_lps.inverse();
    // In a row along the frame's columns, a few diameters apart, and four off it.
    let row = (0..5).map(|n| DVec3::new(6.0 * f64::from(n) - 12.0, 0.0, 2.0 * f64::from(n % 2)));
    let off = [
        DVec3::new(-40.0, 30.0, -15.0),
        DVec3::new(35.0, -32.0, 12.0),
        DVec3::new(-20.0, -38.0, 20.0),
        DVec3::new(38.0, 25.0, -8.0),
    ];
    let places: Vec<DVec3> = row.chain(off).map(|place| rotation.transform_vector(place)).collect();
    let layout = synthetic::layout_of(&places, 1.2);
    let mut drawing = synthetic::radiograph(view, &layout, 50_000.0, 3);
    (drawing.anatomy, drawing.metal) = (false, false);
    let drawn = drawing.draw();
    let (low, high) = drawn.pixels.iter().fold((f32::MAX, 0.0f32), |(low, high), v| (low.min(*v), high.max(*v)));
    let grey = drawn.map(|v| (255.0 * (v - low - 0.3 * (high - low)) / (0.7 * (high - low))).clamp(0.0, 250.0).round());
    let mut frame = Frame::from_pixels("clipped", grey, Domain::Display).expect("a frame");
    frame.clipping.black_at = Some(0.0);
    let masks = sidecarm::mask::of_frame(&frame);
    assert!(masks.shares(1024, 1024).causes.contains_key(&sidecarm::mask::Cause::BurnedIn), "control: they look like writing");
    let pose = register(&matching(&view, &layout), &frame);
    assert!(pose.is_accepted(), "{:?}", pose.reason);
    assert_eq!(pose.beads.iter().filter(|bead| bead.used).count(), 9);
    assert!(landmark_error_px(&pose, &view) < 0.5, "{}", landmark_error_px(&pose, &view));
}

/// Inverted pictures whose file still says linear gave `chance` or `too few shadows`, which sends one to the collimator.
#[test]
fn a_picture_inverted_against_its_domain_is_named() {
    let (view, layout) = (synthetic::view(620, 480, 8), synthetic::layout(10, 0.75, 5));
    let pixels = synthetic::Radiograph { metal: false, ..synthetic::radiograph(view, &layout, 50_000.0, 3) }.draw();
    let highest = pixels.pixels.iter().copied().fold(0.0f32, f32::max);
    let inverted = pixels.map(|value| highest - value);
    let posed = |pixels: &Image<f32>, domain: Domain| {
        register(&matching(&view, &layout), &Frame::from_pixels("drawn", pixels.clone(), domain).expect("a frame"))
    };
    assert!(posed(&pixels, Domain::Linear).is_accepted(), "{:?}", posed(&pixels, Domain::Linear).reason);
    let pose = posed(&inverted, Domain::Linear);
    assert!(matches!(pose.refusal, Some(Refusal::Sense { dark: true, matched: 6.., .. })), "{:?}", pose.reason);
    assert!(posed(&inverted, Domain::Unknown).is_accepted());
    // Where nothing matches either way, that is said as before.
    let other = synthetic::layout(10, 0.75, 77);
    let pose = register(&matching(&view, &other), &Frame::from_pixels("drawn", inverted, Domain::Linear).expect("a frame"));
    assert!(!pose.is_accepted() && !matches!(pose.refusal, Some(Refusal::Sense { .. })), "{:?}", pose.reason);
}

/// A float picture whose offset was taken off until nothing was above zero gave `too few shadows`, which sends one to the collimator.
#[test]
fn linear_values_below_zero_are_named() {
    let (view, layout) = (synthetic::view(620, 480, 8), synthetic::layout(10, 0.75, 5));
    let pixels = synthetic::Radiograph { metal: false, ..synthetic::radiograph(view, &layout, 50_000.0, 3) }.draw();
    let highest = pixels.pixels.iter().copied().fold(0.0f32, f32::max);
    let posed = |pixels: Image<f32>, domain: Domain| {
        register(&matching(&view, &layout), &Frame::from_pixels("drawn", pixels, domain).expect("a frame"))
    };
    let below = pixels.map(|value| *value - highest - 10.0);
    let pose = posed(below.clone(), Domain::Linear);
    assert!(matches!(pose.refusal, Some(Refusal::NoSignal { highest }) if highest < 0.0), "{:?}", pose.reason);
    let words = reason(&pose);
    assert!(words.starts_with("no_signal: ") && words.contains("--domain log"), "{words}");
    // Of another domain the same numbers are as good as any, and a panel without X-rays has another remedy.
    assert!(!matches!(posed(below, Domain::Unknown).refusal, Some(Refusal::NoSignal { .. })));
    let dark = posed(Image::filled(620, 480, 0.0f32), Domain::Linear);
    assert!(matches!(dark.refusal, Some(Refusal::TooFewShadows { .. })), "{:?}", dark.reason);
}

/// One pixel of 1e13 in a float TIFF left no shadow in the frame: sums over pixels consisted of it.
#[test]
fn pixels_beyond_all_others_are_masked() {
    let (view, layout) = (synthetic::view(620, 480, 8), synthetic::layout(10, 0.75, 5));
    let pixels = synthetic::radiograph(view, &layout, 50_000.0, 3).draw();
    let plain = register(&matching(&view, &layout), &Frame::from_pixels("a", pixels.clone(), Domain::Linear).expect("a frame"));
    for far in [1e13f32, -1e20, 3e38] {
        let mut marked = pixels.clone();
        marked.pixels[620 * 30 + 40] = far;
        let frame = Frame::from_pixels("b", marked, Domain::Linear).expect("a frame");
        assert!(frame.altered.iter().any(|words| words.starts_with("1 of 297600 pixels masked")), "{far}: {:?}", frame.altered);
        let pose = register(&matching(&view, &layout), &frame);
        assert_eq!((pose.status, pose.projection.is_some()), (plain.status, true), "{far}: {:?}", pose.reason);
    }
    // What most pixels are not far from is part of the picture.
    let frame = Frame::from_pixels("c", pixels.map(|value| value * 1e-9), Domain::Linear).expect("a frame");
    assert!(frame.altered.is_empty(), "{:?}", frame.altered);
    let even = Frame::from_pixels("d", Image::filled(64, 64, 3.0f32), Domain::Linear).expect("a frame");
    assert!(even.altered.iter().any(|words| words.contains("the same value")), "{:?}", even.altered);
}

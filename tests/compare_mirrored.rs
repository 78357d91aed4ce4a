//! The null's other hypotheses: mirrored pictures, views along an axis, symmetric specimens.

use glam::{DQuat, DVec3};
use sidecarm::acquire::Frame;
use sidecarm::compare::{CompareInput, Comparison, NullError, compare, elsewhere};
use sidecarm::geometry::{Rigid, View};
use sidecarm::image::Image;

use crate::compare_synthetic::{acquired, line_integral, line_integral_of, spheres, view};

fn mirrored(frame: &Frame) -> Frame {
    let mut pixels = frame.pixels.clone();
    pixels.pixels.chunks_exact_mut(pixels.width).for_each(<[f32]>::reverse);
    Frame { pixels, ..frame.clone() }
}

/// Compared with what `stated` shows of `scene`, null included.
fn with_null(frame: &Frame, scene: &[(DVec3, f64, f64)], stated: &View) -> Comparison {
    let simulated = line_integral_of(scene, stated);
    let input = CompareInput { view: Some(stated), centre_lps_mm: Some(DVec3::ZERO), ..CompareInput::new(frame, &simulated) };
    let mut found = compare(&input).expect("comparable");
    found.add_null(&mut |small| Ok(line_integral_of(scene, small)), &|| false).expect("null");
    found.comparison
}

/// A frame that the console had mirrored passed for right wherever its pose was right for the true picture, and where beads had fitted it a
/// pose with depth reversed: no rotation draws such a picture, and only rotations were asked about.
#[test]
fn a_mirrored_frame_prefers_its_mirror_image() {
    let (truth, scene) = (view(), spheres());
    let right = acquired(&line_integral(&truth), 0.01);
    let prefers = |frame: &Frame, stated: &View| elsewhere(&with_null(frame, &scene, stated).null).map(|found| found.pose);
    assert_eq!(prefers(&right, &truth), None, "control");
    assert_eq!(prefers(&mirrored(&right), &truth).as_deref(), Some("picture mirrored left-right"));
    // What beads fit to the mirrored picture: x negated, and depth about their centroid with it.
    let half_turn = |about: DVec3| {
        let turn = Rigid::rotation(DQuat::from_rotation_y(std::f64::consts::PI));
        let motion = Rigid::translation(about) * turn * Rigid::translation(-about);
        View { camera_from_lps: motion * truth.camera_from_lps, ..truth }
    };
    let centroid = truth.camera_from_lps.transform_point(DVec3::ZERO);
    let fitted = half_turn(DVec3::Z * centroid.z);
    assert_eq!(prefers(&mirrored(&right), &fitted).as_deref(), Some("picture mirrored before it was registered"));
    let turned = half_turn(centroid);
    assert_eq!(prefers(&right, &turned).as_deref(), Some("half-turn about v"), "control: turned, not mirrored");
}

/// In a view along an axis the pose of the layout mirrored along it tied with the stated one, and every score of every right pose was
/// "not discriminating"; a specimen that is its own mirror image did the same to mirrored pictures.
#[test]
fn neither_a_view_along_an_axis_nor_a_symmetric_specimen_blinds_the_scores() {
    let along = View { camera_from_lps: Rigid::translation(DVec3::new(0.0, 0.0, 600.0)), ..view() };
    let symmetric: Vec<_> = spheres()
        .into_iter()
        .flat_map(|(centre, radius, mu)| [(centre, radius, 0.5 * mu), (DVec3 { x: -centre.x, ..centre }, radius, 0.5 * mu)])
        .collect();
    let mut cases = 0;
    for (scene, hidden) in [(spheres(), None), (symmetric, Some("picture mirrored left-right"))] {
        let frame = acquired(&line_integral_of(&scene, &along), 0.01);
        let found = with_null(&frame, &scene, &along);
        let plan = found.null_plan.as_ref().expect("null");
        assert_eq!(plan.same_pose, ["z of lps mirrored"]);
        assert_eq!(plan.same_picture.iter().map(String::as_str).collect::<Vec<_>>(), Vec::from_iter(hidden));
        for name in ["zncc", "gradient_ncc", "rmse_nepers", "local_ncc"] {
            let null = &found.null[name];
            assert!(null.discriminating && null.rank == 1, "{name}: {null:?}");
            cases += 1;
        }
        let said = found.flags.iter().any(|flag| flag.starts_with("the picture does not tell the stated pose from"));
        assert_eq!(said, hidden.is_some(), "{:?}", found.flags);
        assert_eq!(elsewhere(&found.null), None);
    }
    assert_eq!(cases, 8);
}

#[test]
fn a_null_about_another_picture_is_refused() {
    let (view, simulated) = (view(), line_integral(&view()));
    let frame = acquired(&simulated, 0.01);
    let input = CompareInput { view: Some(&view), centre_lps_mm: Some(DVec3::ZERO), ..CompareInput::new(&frame, &simulated) };
    let mut found = compare(&input).expect("comparable");
    let other = |small: &View| {
        let [width, height] = small.size_px.map(|n| n as usize);
        Ok(Image { width, height, pixels: (0..width * height).map(|at| (at % width) as f32 * 0.01).collect() })
    };
    assert!(matches!(found.add_null(&mut { other }, &|| false), Err(NullError::AnotherPicture { .. })));
    assert!(found.comparison.null.is_empty());
}

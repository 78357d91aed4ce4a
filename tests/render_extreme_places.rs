//! Extremes of DESIGN §10, places: where rays, sources, detectors and grids lie; every executor against the reference.

use std::sync::Arc;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use sidecarm::geometry::{CarmCalibration, CarmJoints, Rigid};
use sidecarm::scene::Scene;
use sidecarm::scene::model::Matter;

use crate::render_extremes::{executors, judge, small};
use crate::render_scenes::{With, cuboid, empty, placed, solids, sphere, volume};

const CENTRE: DVec3 = DVec3::new(0.0, 0.0, 600.0);

fn lumpy([i, j, k]: [usize; 3]) -> (u8, f32) {
    match (i * 5 + j * 3 + k * 7) % 11 {
        0 | 1 => (0, 0.0),
        n @ 2..7 => (1, 0.5 + 0.1 * n as f32),
        n => (2, 1.0 + 0.1 * n as f32),
    }
}

fn grid(size: [usize; 3], affine: DAffine3) -> Matter {
    Matter::Volume(Arc::new(volume(size, affine, &[0, 1], lumpy)))
}

fn with_grid(size: [usize; 3], affine: DAffine3) -> Scene {
    small(empty(&["water", "bone_cortical", "steel_316l"])).with(grid(size, affine))
}

/// The view with the centre of pixel (12, 12) on the axis: one ray runs along z, a row and a column of rays in planes of the axes.
fn on_axis(mut scene: Scene) -> Scene {
    let k = &mut scene.view.as_mut().expect("has one").intrinsics;
    (k.cx, k.cy) = (12.0, 12.0);
    scene
}

#[test]
fn rays_along_faces_edges_and_corners() {
    let mut executors = executors();
    let mut cases = 0;
    // The axis at voxel coordinates (x, y): a centre, a face, an edge, the outer half voxel, close to the outer face.
    for (x, y) in [(3.0, 3.0), (2.5, 3.0), (2.5, 4.5), (0.0, 0.0), (-0.25, 5.0), (-0.499, 5.499), (7.0, 7.0)] {
        let affine =
            DAffine3 { matrix3: DMat3::from_diagonal(DVec3::splat(5.0)), translation: CENTRE - 5.0 * DVec3::new(x, y, 3.5) };
        let line = judge(&format!("axis at ({x}, {y})"), &on_axis(with_grid([8, 8, 8], affine)), &mut executors);
        assert!(line[12 * 24 + 12] > 0.1, "({x}, {y})");
        cases += 1;
    }
    // Along the body diagonal, through corner after corner.
    let turn = DQuat::from_rotation_arc(DVec3::ONE.normalize(), DVec3::Z);
    judge("corners", &on_axis(with_grid([8, 8, 8], placed([8, 8, 8], CENTRE, DVec3::splat(5.0), turn))), &mut executors);
    // A box whose face, and one whose edge, holds the axis.
    for offset in [DVec3::new(20.0, 0.0, 0.0), DVec3::new(20.0, 20.0, 0.0)] {
        let block = cuboid(CENTRE + offset + 1e-3, DVec3::splat(20.0), 0, 1.0);
        judge("face of a box", &on_axis(small(empty(&["water"]).with(solids(&[block])))), &mut executors);
        cases += 1;
    }
    assert_eq!(cases, 9);
}

#[test]
fn a_source_inside_the_volume_and_inside_a_tool() {
    let mut executors = executors();
    let size = [12, 12, 12];
    let mut cases = 0;
    for z in [0.0, 20.0, -20.0] {
        let scene = with_grid(size, placed(size, DVec3::new(1.0, -2.0, z), DVec3::splat(5.0), DQuat::from_rotation_x(0.4)));
        let line = judge(&format!("source {z} mm from the volume's middle"), &scene, &mut executors);
        assert!(line.iter().any(|value| *value > 0.1));
        let tool = sphere(DVec3::new(0.5, 0.0, 1.0), 4.0, 2, 8.0);
        let inside = judge(&format!("source inside a tool, {z} mm"), &scene.with(solids(&[tool])), &mut executors);
        assert!(inside.iter().zip(&line).all(|(a, b)| a > b), "steel all around");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

#[test]
fn a_detector_inside_before_and_behind_the_volume() {
    let mut executors = executors();
    let size = [12, 12, 12];
    let at = |z: f64| with_grid(size, placed(size, DVec3::new(0.0, 0.0, z), DVec3::splat(5.0), DQuat::from_rotation_y(0.3)));
    let whole = judge("detector behind", &at(900.0), &mut executors);
    let inside = judge("detector inside", &at(1000.0), &mut executors);
    assert!(inside.iter().zip(&whole).filter(|(a, b)| *a < *b).count() > 100, "half is not seen");
    let before = judge("detector before the volume", &at(1100.0), &mut executors);
    assert!(before.iter().all(|value| *value == 0.0), "matter beyond is not seen");
}

#[test]
fn volumes_of_one_voxel_a_row_and_a_sheet() {
    let mut executors = executors();
    let mut cases = 0;
    for size in [[1, 1, 1], [1, 9, 1], [13, 1, 11]] {
        for turn in [DQuat::IDENTITY, DQuat::from_scaled_axis(DVec3::new(0.4, 0.7, -0.3))] {
            let affine = placed(size, CENTRE + DVec3::new(1.0, 2.0, 0.0), DVec3::new(7.0, 6.0, 5.0), turn);
            let full = Matter::Volume(Arc::new(volume(size, affine, &[1], |_| (1, 1.5))));
            let scene = small(empty(&["water", "bone_cortical"])).with(full);
            let line = judge(&format!("{size:?}"), &scene, &mut executors);
            // A homogeneous grid is a box.
            let mut block = cuboid(CENTRE + DVec3::new(1.0, 2.0, 0.0), DVec3::ZERO, 1, 1.5);
            block.shape = sidecarm::scene::model::Shape::Cuboid {
                half_size_mm: 0.5 * DVec3::new(7.0, 6.0, 5.0) * DVec3::from_array(size.map(|n| n as f64)),
            };
            block.lps_from_local.rotation = turn;
            let boxed = judge("box", &small(empty(&["water", "bone_cortical"])).with(solids(&[block])), &mut executors);
            assert!(line.iter().zip(&boxed).all(|(a, b)| (a - b).abs() < 1e-9) && line.iter().any(|value| *value > 0.1));
            cases += 1;
        }
    }
    assert_eq!(cases, 6);
}

#[test]
fn voxels_of_a_hundredth_and_of_ten_millimetres_and_one_to_twenty() {
    let mut executors = executors();
    let turn = DQuat::from_scaled_axis(DVec3::new(-0.3, 0.5, 0.8));
    let mut cases = 0;
    for (what, size, spacing, magnified) in [
        ("0.01 mm", [20, 20, 20], DVec3::splat(0.01), 400.0),
        ("10 mm", [12, 12, 12], DVec3::splat(10.0), 1.0),
        ("1:20", [40, 40, 4], DVec3::new(0.5, 0.5, 10.0), 1.0),
        ("20:1", [3, 30, 30], DVec3::new(20.0, 1.0, 1.0), 1.0),
    ] {
        for turn in [DQuat::IDENTITY, turn] {
            let mut scene = with_grid(size, placed(size, CENTRE, spacing, turn));
            let k = &mut scene.view.as_mut().expect("has one").intrinsics;
            (k.fx, k.fy) = (k.fx * magnified, k.fy * magnified);
            scene.detector.pitch_mm /= magnified;
            // Densities that make the smallest grid visible: a fifth of a millimetre of something very heavy.
            if spacing.x < 0.1 {
                let Matter::Volume(volume) = &mut scene.objects[0].matter else { panic!("a volume") };
                Arc::make_mut(volume).density_g_per_cm3.iter_mut().for_each(|density| *density *= 30.0);
            }
            let line = judge(what, &scene, &mut executors);
            assert!(line.iter().filter(|value| **value > 0.05).count() > 60, "{what}");
            cases += 1;
        }
    }
    assert_eq!(cases, 8);
}

#[test]
fn oblique_left_handed_and_sheared_affines() {
    let mut executors = executors();
    let size = [9, 11, 7];
    let turn = DQuat::from_scaled_axis(DVec3::new(0.7, 0.2, -0.5));
    let right = with_grid(size, placed(size, CENTRE, DVec3::new(4.0, 3.0, 5.0), turn));
    let line = judge("right-handed", &right, &mut executors);
    // The same voxels counted from the other end of j are the same matter.
    let flipped = placed(size, CENTRE, DVec3::new(4.0, -3.0, 5.0), turn);
    let mirrored = volume(size, flipped, &[0, 1], |[i, j, k]| lumpy([i, 10 - j, k]));
    let left = small(empty(&["water", "bone_cortical", "steel_316l"])).with(Matter::Volume(Arc::new(mirrored)));
    let same = judge("left-handed", &left, &mut executors);
    assert!(line.iter().zip(&same).all(|(a, b)| (a - b).abs() < 1e-9));
    assert!(judge("mirrored", &with_grid(size, flipped), &mut executors).iter().zip(&line).any(|(a, b)| (a - b).abs() > 1e-2));
    let sheared = DMat3::from_cols(DVec3::new(4.0, 0.5, 0.0), DVec3::new(1.0, 3.0, 0.0), DVec3::new(0.0, -1.5, 5.0));
    let middle = DVec3::from_array(size.map(|n| 0.5 * (n as f64 - 1.0)));
    judge("sheared", &with_grid(size, DAffine3 { matrix3: sheared, translation: CENTRE - sheared * middle }), &mut executors);
}

#[test]
fn half_turns_and_right_angles_of_tilt() {
    let mut executors = executors();
    let size = [9, 11, 7];
    let build = |turn: DQuat| {
        // Camera and matter turned together about the isocentre: the image is the same.
        let lps_from_old = Rigid { rotation: turn, translation_mm: CENTRE - turn * CENTRE };
        let base = placed(size, CENTRE, DVec3::splat(4.0), DQuat::from_rotation_z(0.2));
        let moved = DAffine3 { matrix3: DMat3::from_quat(turn), translation: lps_from_old.translation_mm } * base;
        let mut scene = with_grid(size, moved).with(solids(&[sphere(
            lps_from_old.transform_point(CENTRE + DVec3::new(4.0, 2.0, -6.0)),
            5.0,
            2,
            8.0,
        )]));
        let view = scene.view.as_mut().expect("has one");
        view.camera_from_lps = view.camera_from_lps * lps_from_old.inverse();
        scene
    };
    let straight = judge("0", &build(DQuat::IDENTITY), &mut executors);
    let mut cases = 0;
    for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
        for degrees in [180.0, -180.0, 90.0, -90.0, 179.999_999] {
            let turned = judge(
                &format!("{degrees} deg about {axis}"),
                &build(DQuat::from_axis_angle(axis, f64::to_radians(degrees))),
                &mut executors,
            );
            let apart = turned.iter().zip(&straight).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(apart < 1e-6, "{degrees} deg about {axis}: {apart:e}");
            cases += 1;
        }
    }
    assert_eq!(cases, 15);
    // Joints of a C-arm: −180° and 180° are one pose, ±90° of tilt are opposite ones.
    let text = include_str!("../calibration/carm/live-620x480.json");
    let calibration: CarmCalibration = serde_json::from_str(text).expect("a calibration");
    let pose = |orbital_deg: f64, angulation_deg: f64| {
        let (orbital_rad, angulation_rad) = (orbital_deg.to_radians(), angulation_deg.to_radians());
        let joints = CarmJoints { orbital_rad, angulation_rad, ..CarmJoints::ZERO };
        calibration.world_from_camera(&joints).expect("a pose")
    };
    assert!(pose(180.0, 0.0).angle_to_rad(&pose(-180.0, 0.0)) < 1e-9);
    assert!(pose(180.0, 0.0).translation_mm.distance(pose(-180.0, 0.0).translation_mm) < 1e-9);
    let (up, down) = (pose(0.0, 90.0), pose(0.0, -90.0));
    assert!((up.angle_to_rad(&down) - std::f64::consts::PI).abs() < 1e-6);
}

//! Poses that are known to be wrong, and those that are right where the layout of the beads is turned, negated or mirrored.

use glam::{DMat3, DQuat, DVec3};

use crate::geometry::Rigid;

pub(super) const SHIFTS_MM: [f64; 3] = [1.0, 3.0, 10.0];
pub(super) const TURNS_DEG: [f64; 2] = [1.0, 3.0];
/// Renders of a null: 18 shifts, 12 turns, 12 other poses, the optimum of all shifts and that of all turns, and the stated pose.
pub const NULL_RENDERS: usize = 45;

/// Whether the wrong pose of this name is that of a layout turned about, negated or mirrored: no small error of a right pose leads there.
pub(super) fn is_of_another_layout(name: &str) -> bool {
    name.starts_with("half-turn about ") || name.contains(" of lps ")
}

/// Wrong poses: name and camera_from_lps, given the stated one and the centre to turn about.
pub(super) fn wrong_poses(camera_from_lps: &Rigid, centre_lps_mm: DVec3) -> Vec<(String, Rigid)> {
    let centre_in_camera = camera_from_lps.transform_point(centre_lps_mm);
    let about =
        |turn: DQuat| Rigid::translation(centre_in_camera) * Rigid::rotation(turn) * Rigid::translation(-centre_in_camera);
    let axes = [("u", DVec3::X), ("v", DVec3::Y), ("depth", DVec3::Z)];
    let mut found = Vec::with_capacity(NULL_RENDERS);
    for (name, axis) in axes {
        for size in SHIFTS_MM.iter().flat_map(|size| [*size, -size]) {
            found.push((format!("{name} {size:+} mm"), Rigid::translation(axis * size) * *camera_from_lps));
        }
    }
    for (name, axis) in axes {
        for degrees in TURNS_DEG.iter().flat_map(|size| [*size, -size]) {
            let turn = DQuat::from_axis_angle(axis, degrees.to_radians());
            found.push((format!("turn about {name} {degrees:+} deg"), about(turn) * *camera_from_lps));
        }
    }
    for (name, axis) in axes {
        let turn = DQuat::from_axis_angle(axis, std::f64::consts::PI);
        found.push((format!("half-turn about {name}"), about(turn) * *camera_from_lps));
    }
    // Layouts are placed along the specimen's axes, which in an oblique view are not the camera's.
    for (name, axis) in [("x", DVec3::X), ("y", DVec3::Y), ("z", DVec3::Z)] {
        let turn = DQuat::from_axis_angle(camera_from_lps.rotation * axis, std::f64::consts::PI);
        found.push((format!("half-turn about {name} of lps"), about(turn) * *camera_from_lps));
    }
    found.extend(negated(camera_from_lps));
    found.extend(mirrored(camera_from_lps, centre_in_camera));
    found
}

/// The poses that are right where the layout has two of its coordinates negated: it was registered as N·p, so camera_from_lps · N is what
/// maps p.
fn negated(camera_from_lps: &Rigid) -> [(String, Rigid); 3] {
    let turn = |axis: DVec3| *camera_from_lps * Rigid::rotation(DQuat::from_axis_angle(axis, std::f64::consts::PI));
    [
        ("y and z of lps negated", DVec3::X),
        ("x and z of lps negated", DVec3::Y),
        ("x and y of lps negated (RAS for LPS)", DVec3::Z),
    ]
    .map(|(name, axis)| (name.to_owned(), turn(axis)))
}

/// The poses that are right where the layout is mirrored. With nearly parallel rays a layout mirrored along n (S = 1 − 2 n nᵀ) is seen
/// like itself mirrored in depth about its centre c (D = 1 − 2 z zᵀ): D R S is a rotation again, and that of the true pose.
fn mirrored(camera_from_lps: &Rigid, centre_in_camera: DVec3) -> [(String, Rigid); 3] {
    let depth = DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
    [("x", DVec3::X), ("y", DVec3::Y), ("z", DVec3::Z)].map(|(name, axis)| {
        let mirror = DMat3::from_diagonal(1.0 - 2.0 * axis);
        let rotation = DQuat::from_mat3(&(depth * camera_from_lps.rotation_matrix() * mirror)).normalize();
        // The mirrored layout's centre, S·c, is where c really is.
        let centre_lps = mirror * camera_from_lps.inverse().transform_point(centre_in_camera);
        let translation_mm = centre_in_camera - rotation * centre_lps;
        (format!("{name} of lps mirrored"), Rigid { rotation, translation_mm })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stated() -> Rigid {
        let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 1.3, -0.4, 0.2);
        Rigid { rotation, translation_mm: DVec3::new(10.0, -20.0, 600.0) }
    }

    #[test]
    fn there_are_forty_two_wrong_poses_and_turns_keep_the_centre() {
        let centre = DVec3::new(3.0, -7.0, 12.0);
        let wrong = wrong_poses(&stated(), centre);
        assert_eq!(wrong.len() + 3, NULL_RENDERS);
        let turns: Vec<_> = wrong.iter().filter(|(name, _)| name.contains("turn about")).collect();
        assert_eq!(turns.len(), 18);
        let there = stated().transform_point(centre);
        assert!(turns.iter().all(|(_, pose)| pose.transform_point(centre).distance(there) < 1e-9));
        assert!(wrong.iter().any(|(name, _)| name == "depth -10 mm"));
        assert_eq!(wrong.iter().filter(|(name, _)| is_of_another_layout(name)).count(), 12);
        assert!(wrong.iter().all(|(_, pose)| (pose.rotation.length() - 1.0).abs() < 1e-12));
    }

    #[test]
    fn a_half_turn_of_the_layout_about_its_centre_is_among_the_wrong_ones() {
        let centre = DVec3::new(3.0, -7.0, 12.0);
        let turned = |axis: DVec3| {
            let turn = Rigid::rotation(DQuat::from_axis_angle(axis, std::f64::consts::PI));
            stated() * Rigid::translation(centre) * turn * Rigid::translation(-centre)
        };
        for (name, axis) in [("x", DVec3::X), ("y", DVec3::Y), ("z", DVec3::Z)] {
            let name = format!("half-turn about {name} of lps");
            let (_, found) = wrong_poses(&stated(), centre).into_iter().find(|(listed, _)| *listed == name).expect("listed");
            let expected = turned(axis);
            assert!(found.angle_to_rad(&expected) < 1e-9 && found.translation_mm.distance(expected.translation_mm) < 1e-9);
        }
    }

    #[test]
    fn a_swapped_layout_s_pose_is_among_the_wrong_ones() {
        // Registered on (−x, −y, z): the pose found maps those where (x, y, z) really is.
        let swapped = stated() * Rigid::rotation(DQuat::from_rotation_z(std::f64::consts::PI));
        let wrong = wrong_poses(&swapped, DVec3::new(3.0, -7.0, 12.0));
        let right = wrong.iter().find(|(name, _)| name.contains("RAS for LPS")).expect("listed");
        assert!(right.1.angle_to_rad(&stated()) < 1e-9 && right.1.translation_mm.distance(stated().translation_mm) < 1e-9);
    }

    #[test]
    fn a_mirrored_layout_s_pose_is_among_the_wrong_ones() {
        // Parallel rays: mirrored points under the wrong pose and true points under the right one have the same u and v.
        let centre = DVec3::new(3.0, -7.0, 12.0);
        let mirror = DVec3::new(-1.0, 1.0, 1.0);
        let (_, right) =
            wrong_poses(&stated(), mirror * centre).into_iter().find(|(name, _)| name == "x of lps mirrored").expect("listed");
        let mut cases = 0;
        for p in [centre, DVec3::new(40.0, 8.0, -30.0), DVec3::new(-25.0, 33.0, 7.0)] {
            let (seen, true_place) = (stated().transform_point(mirror * p), right.transform_point(p));
            assert!(seen.truncate().distance(true_place.truncate()) < 1e-9, "{seen} {true_place}");
            cases += 1;
        }
        assert_eq!(cases, 3);
    }
}

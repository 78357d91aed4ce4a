//! What else might be true than the stated pose: poses that are a little off, those that are right where the layout of the beads is turned,
//! negated or mirrored, and pictures that are mirrored.

use glam::{DMat3, DQuat, DVec3};

use super::displacement::farthest_apart_px;
use crate::geometry::{Intrinsics, Rigid, View};

pub(super) const SHIFTS_MM: [f64; 3] = [1.0, 3.0, 10.0];
pub(super) const TURNS_DEG: [f64; 2] = [1.0, 3.0];
/// Renders of a null at most: 18 shifts, 12 turns, 12 other poses, 3 mirrored pictures, the optimum of all shifts and that of all turns, and
/// the stated pose.
pub const NULL_RENDERS: usize = 48;

/// Whether the hypothesis of this name is that of a layout turned about, negated or mirrored, or of a mirrored picture: no small error of a
/// right pose leads there.
pub(super) fn is_of_another_layout(name: &str) -> bool {
    name.starts_with("half-turn about ") || name.contains(" of lps ") || name.starts_with(MIRRORED)
}

const MIRRORED: &str = "picture mirrored";
/// Columns that lie closer together, in pixels of the null, mirror alike.
const SAME_COLUMN_PX: f64 = 0.5;

/// What the acquired frame would show if something else than the stated pose were true.
pub(super) struct Hypothesis {
    pub name: String,
    /// From where the scene is rendered.
    pub view: View,
    /// The columns of the render are then reversed.
    pub mirrored: bool,
}

/// What is put against the stated pose.
pub(super) struct Hypotheses {
    /// The shifts and turns first, in the order of [`wrong_poses`].
    pub asked: Vec<Hypothesis>,
    /// Other layouts whose pose is the stated one here.
    pub same_pose: Vec<String>,
}

/// What to put against `stated`, the view of the null; `frame_columns` says how many of its pixels the whole frame is wide, what binning
/// leaves over at the edge included.
///
/// In a view along an axis of lps a layout mirrored along it has the stated pose, because reflections are seen up to one in depth. An other
/// layout's pose that shows all of the field within the smallest shift of the stated one is therefore no other pose, and one that repeats
/// another's is asked about once.
pub(super) fn hypotheses(stated: &View, frame_columns: f64, centre_lps_mm: DVec3) -> Hypotheses {
    let centre_in_camera = stated.camera_from_lps.transform_point(centre_lps_mm);
    let mm_per_px = centre_in_camera.z / stated.intrinsics.fx;
    let is_nearly = |a: &View, b: &View| farthest_apart_px(a, b, centre_in_camera.z) * mm_per_px < SHIFTS_MM[0];
    let (mut asked, mut same_pose, mut others) = (Vec::with_capacity(NULL_RENDERS), Vec::new(), Vec::new());
    for (name, camera_from_lps) in wrong_poses(&stated.camera_from_lps, centre_lps_mm) {
        let view = View { camera_from_lps, ..*stated };
        if is_of_another_layout(&name) {
            if is_nearly(stated, &view) {
                same_pose.push(name);
                continue;
            }
            if others.iter().any(|other| is_nearly(other, &view)) {
                continue;
            }
            others.push(view);
        }
        asked.push(Hypothesis { name, view, mirrored: false });
    }
    asked.extend(mirror_images(stated, frame_columns, centre_in_camera.z));
    Hypotheses { asked, same_pose }
}

/// Mirrored pictures, which no rotation gives: the stated one about the frame's middle, as a console flips it, and about the principal column
/// where that is another (P with a negative fx); and the one whose mirror image gave the stated pose. With nearly parallel rays beads that are
/// seen in a mirrored picture fit a pose with x negated, and depth with it, because it is a rotation: what such a picture shows is the
/// specimen reversed in depth about its centre, diag(1, 1, −1) = diag(−1, 1, 1) · (half a turn about v).
fn mirror_images(stated: &View, frame_columns: f64, centre_depth_mm: f64) -> Vec<Hypothesis> {
    let (k, middle) = (stated.intrinsics, 0.5 * (frame_columns - 1.0));
    let to_centre = Rigid::translation(DVec3::Z * centre_depth_mm);
    let turned = to_centre * Rigid::rotation(DQuat::from_rotation_y(std::f64::consts::PI)) * to_centre.inverse();
    let reversed =
        View { intrinsics: Intrinsics { skew: -k.skew, ..k }, camera_from_lps: turned * stated.camera_from_lps, ..*stated };
    let mut found = vec![("left-right", *stated, middle), ("before it was registered", reversed, k.cx)];
    if (k.cx - middle).abs() > SAME_COLUMN_PX {
        found.push(("about the principal column", *stated, k.cx));
    }
    // u → 2 c − u is u → 2 m − u about the render's own middle m, once the render is moved by 2 (c − m).
    let own_middle = 0.5 * (f64::from(stated.size_px[0]) - 1.0);
    let mirrored = |(how, view, column): (&str, View, f64)| {
        let intrinsics = Intrinsics { cx: view.intrinsics.cx - 2.0 * (column - own_middle), ..view.intrinsics };
        Hypothesis { name: format!("{MIRRORED} {how}"), view: View { intrinsics, ..view }, mirrored: true }
    };
    found.into_iter().map(mirrored).collect()
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
        assert_eq!(wrong.len() + 6, NULL_RENDERS);
        let turns: Vec<_> = wrong.iter().filter(|(name, _)| name.contains("turn about")).collect();
        assert_eq!(turns.len(), 18);
        let there = stated().transform_point(centre);
        assert!(turns.iter().all(|(_, pose)| pose.transform_point(centre).distance(there) < 1e-9));
        assert!(wrong.iter().any(|(name, _)| name == "depth -10 mm"));
        assert_eq!(wrong.iter().filter(|(name, _)| is_of_another_layout(name)).count(), 12);
        assert!(wrong.iter().all(|(_, pose)| (pose.rotation.length() - 1.0).abs() < 1e-12));
    }

    fn view(camera_from_lps: Rigid) -> View {
        let intrinsics = Intrinsics { fx: 880.0, fy: 880.0, skew: 0.3, cx: 49.0, cy: 41.0 };
        View { size_px: [103, 80], intrinsics, camera_from_lps }
    }

    /// Along an axis of lps the pose of a mirrored layout is the stated one. It was rendered and ranked all the same, tied with the stated
    /// pose, and no score discriminated.
    #[test]
    fn in_a_view_along_an_axis_no_layout_s_pose_is_the_stated_one_and_none_is_asked_about_twice() {
        let (centre, mut cases) = (DVec3::new(3.0, -0.4, 12.0), 0);
        let anterior = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, DVec3::Z, -DVec3::Y));
        for (turn_deg, left_out) in [(0.0, 1), (0.2, 1), (8.0, 0)] {
            let rotation = DQuat::from_rotation_x(f64::to_radians(turn_deg)) * anterior;
            let stated = view(Rigid { rotation, translation_mm: DVec3::new(0.0, 0.0, 600.0) - rotation * centre });
            let Hypotheses { asked, same_pose } = hypotheses(&stated, 103.3, centre);
            let expected: Vec<&str> = ["y of lps mirrored"].into_iter().take(left_out).collect();
            assert_eq!(same_pose, expected, "{turn_deg} degrees off the axis");
            let others: Vec<&Hypothesis> = asked.iter().filter(|h| is_of_another_layout(&h.name) && !h.mirrored).collect();
            // Along the axis half turns about u, v, depth are those about x, z, y, and a mirrored layout's pose that of a negated one.
            assert_eq!(others.len(), if turn_deg == 8.0 { 11 } else { 6 }, "{turn_deg} degrees off the axis");
            for (at, other) in others.iter().enumerate() {
                let apart = |b: &View| farthest_apart_px(&other.view, b, 600.0) * 600.0 / 880.0;
                assert!(apart(&stated) > 0.9 && others[..at].iter().all(|earlier| apart(&earlier.view) > 0.9), "{}", other.name);
                cases += 1;
            }
        }
        assert_eq!(cases, 23);
    }

    /// Where each render shows a point, after its columns are reversed.
    #[test]
    fn mirrored_pictures_show_points_mirrored_or_reversed_in_depth() {
        let (centre, stated) = (DVec3::new(3.0, -7.0, 12.0), view(stated()));
        let frame_columns = 310.0 / 3.0;
        let asked = hypotheses(&stated, frame_columns, centre).asked;
        let mirrored: Vec<&Hypothesis> = asked.iter().filter(|h| h.mirrored).collect();
        assert_eq!(mirrored.len(), 3);
        let depth_mm = stated.camera_from_lps.transform_point(centre).z;
        let mut cases = 0;
        for p in [centre, DVec3::new(40.0, 8.0, -30.0), DVec3::new(-25.0, 33.0, 7.0)] {
            let in_camera = stated.camera_from_lps.transform_point(p);
            let here = stated.intrinsics.project(in_camera);
            let deeper = DVec3 { z: 2.0 * depth_mm - in_camera.z, ..in_camera };
            for hypothesis in &mirrored {
                let mut seen = hypothesis.view.projection().project(p).0;
                seen.x = f64::from(stated.size_px[0]) - 1.0 - seen.x;
                let expected = match hypothesis.name.as_str() {
                    "picture mirrored left-right" => glam::DVec2::new(frame_columns - 1.0 - here.x, here.y),
                    "picture mirrored about the principal column" => glam::DVec2::new(2.0 * 49.0 - here.x, here.y),
                    _ => stated.intrinsics.project(deeper),
                };
                assert!(seen.distance(expected) < 1e-9, "{}: {seen}, expected {expected}", hypothesis.name);
                cases += 1;
            }
        }
        assert_eq!(cases, 9);
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

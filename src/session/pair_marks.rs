//! What is marked in the frame of a pair, by how it was posed.

use super::posed::Posed;
use crate::geometry::{Distortion, View};
use crate::report::PoseSource;
pub use crate::report::{BeadMark, LandmarkMark, PairMarks, RobotMark};
use crate::scene::Scene;

/// The marks of a posed frame; the robot is that of the scene that its DRR shows, and beads are where the pose of that DRR has them.
pub(super) fn marks_of(posed: &Posed, scene: Option<&Scene>) -> PairMarks {
    let distortion = posed.intensifier.as_deref().map(|intensifier| &intensifier.distortion);
    let marks = PairMarks::of(&posed.pose, distortion, posed.view.as_ref(), scene);
    match &posed.view {
        Some(view) if posed.pose_source == PoseSource::Telemetry => by_telemetry(marks, posed, view, distortion),
        _ => marks,
    }
}

/// Registration has refused its own pose, so that no bead has a place by it; telemetry's has. Shadows that are found are not the beads' by
/// telemetry, and there is no residual.
fn by_telemetry(mut marks: PairMarks, posed: &Posed, view: &View, distortion: Option<&Distortion>) -> PairMarks {
    let projection = view.projection();
    let [width, height] = view.size_px.map(f64::from);
    // The rows of the pose are those of the marks.
    for (mark, row) in marks.beads.iter_mut().zip(&posed.pose.beads) {
        let (pixel, depth_mm) = projection.project(posed.pose.place_of(&row.body, row.lps_mm));
        let shown = Distortion::shown(distortion, pixel);
        let is_within = |u: f64, v: f64| (-0.5..width - 0.5).contains(&u) && (-0.5..height - 0.5).contains(&v);
        mark.predicted_px = shown.filter(|at| depth_mm > 0.0 && is_within(at.x, at.y)).map(|at| at.to_array());
        mark.residual_px = None;
    }
    marks
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::beads::{Bead, BeadLayout};
    use crate::geometry::{Intrinsics, Rigid};
    use crate::pose::{Pose, Refusal, Registration};
    use crate::report::figures::Form;

    fn pose() -> Pose {
        let places = [
            ("middle", DVec3::ZERO),
            ("right", DVec3::new(3.0, 0.0, 0.0)),
            ("outside", DVec3::new(90.0, 0.0, 0.0)),
            ("behind", DVec3::new(0.0, 0.0, -700.0)),
        ];
        let layout = BeadLayout { beads: places.map(|(name, lps_mm)| Bead::new(name, lps_mm)).to_vec(), ..BeadLayout::none() };
        let few = Refusal::TooFewShadows { found: 1, required: 4, prior_puts_into_frame: None, hidden_by: Vec::new() };
        let mut pose = Registration::new([100, 80], &layout).refuse(&few);
        // What registration tried before it gave up.
        (pose.beads[0].image_px, pose.beads[0].predicted_px) = (Some([12.0, 13.0]), Some([11.0, 11.0]));
        pose
    }

    fn posed(pose_source: PoseSource, view: Option<View>) -> Posed {
        Posed { pose: pose(), pose_source, view, ..Posed::bare(1) }
    }

    /// Frames with a pose from telemetry showed a DRR with beads, and no name at any of them.
    #[test]
    fn beads_lie_where_the_pose_from_telemetry_has_them() {
        let intrinsics = Intrinsics { fx: 5000.0, fy: 5000.0, skew: 0.0, cx: 49.5, cy: 39.5 };
        let view = View { size_px: [100, 80], intrinsics, camera_from_lps: Rigid::translation(DVec3::Z * 600.0) };
        let marks = marks_of(&posed(PoseSource::Telemetry, Some(view)), None);
        // 3 mm at 600 mm are 25 px.
        let expected = [("middle", Some([49.5, 39.5])), ("right", Some([74.5, 39.5])), ("outside", None), ("behind", None)];
        assert_eq!(marks.beads.len(), expected.len());
        for (mark, (name, place)) in marks.beads.iter().zip(expected) {
            let off =
                mark.predicted_px.zip(place).map(|(at, place): ([f64; 2], [f64; 2])| (at[0] - place[0]).hypot(at[1] - place[1]));
            assert_eq!((mark.name.as_str(), mark.predicted_px.is_some()), (name, place.is_some()));
            assert!(off.is_none_or(|off| off < 1e-9), "{name}: {:?}", mark.predicted_px);
        }
        assert_eq!((marks.beads[0].found_px, marks.beads[0].residual_px), (Some([12.0, 13.0]), None));
        let named = |marks: &PairMarks, name: &str| {
            marks.figures().iter().any(|figure| matches!(&figure.form, Form::Words { text, .. } if text == name))
        };
        assert!(named(&marks, "right") && !named(&marks, "outside"));
        // The control: with no pose at all, what registration had tried is all there is.
        let without = marks_of(&posed(PoseSource::None, None), None);
        assert_eq!(
            without.beads.iter().map(|bead| bead.predicted_px).collect::<Vec<_>>(),
            [Some([11.0, 11.0]), None, None, None]
        );
        assert!(!named(&without, "right"));
    }
}

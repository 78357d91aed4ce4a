//! What the window draws over a frame: beads, landmarks and the robot where the frame shows them, the intensifier's distortion included.

use glam::{DVec2, DVec3};

use super::posing::Posed;
use crate::geometry::View;
use crate::scene::Scene;

/// A bead in the frame.
#[derive(Clone, Debug, PartialEq)]
pub struct BeadMark {
    /// As in the layout.
    pub name: String,
    /// Where its shadow was found.
    pub found_px: Option<[f64; 2]>,
    /// Radius of the shadow.
    pub radius_px: Option<f64>,
    /// Where P puts it.
    pub predicted_px: Option<[f64; 2]>,
    /// Observed minus predicted.
    pub residual_px: Option<[f64; 2]>,
    /// Whether P rests on it.
    pub used: bool,
}

/// A landmark in the frame.
#[derive(Clone, Debug, PartialEq)]
pub struct LandmarkMark {
    /// Its label.
    pub name: String,
    /// Where P puts it.
    pub image_px: Option<[f64; 2]>,
    /// Standard deviations along columns and rows.
    pub sigma_px: Option<[f64; 2]>,
    /// Standard deviations along the camera's axes; the last is depth.
    pub sigma_mm: [f64; 3],
}

/// The robot as the DRR draws it.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotMark {
    /// Its centreline from the base to the end of its body.
    pub centreline_px: Vec<[f64; 2]>,
    /// The drill's tip.
    pub tip_px: [f64; 2],
}

/// See the module; all places in pixels of the frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PairMarks {
    /// In the order of the layout.
    pub beads: Vec<BeadMark>,
    /// Shadows that belong to no bead: centre and radius.
    pub shadows: Vec<([f64; 2], f64)>,
    /// Those that the session names.
    pub landmarks: Vec<LandmarkMark>,
    /// Absent without a robot, and without a pose.
    pub robot: Option<RobotMark>,
}

impl PairMarks {
    /// Of a posed frame and the scene that its DRR shows.
    pub(super) fn of(posed: &Posed, scene: Option<&Scene>) -> Self {
        // What the intensifier's picture does not show has no place in it.
        let seen = |at: DVec2| match &posed.intensifier {
            None => Some(at),
            Some(intensifier) => intensifier.distortion.distorted(at).ok(),
        };
        let place = |px: [f64; 2]| seen(DVec2::from_array(px)).map(|at| at.to_array());
        let radius_at = |at: [f64; 2]| {
            let near = |shadow: &&crate::pose::Shadow| {
                DVec2::from_array(shadow.image_px).distance(DVec2::from_array(at)) < SAME_SHADOW_PX
            };
            posed.pose.shadows.iter().find(near).map(|shadow| shadow.radius_px)
        };
        let beads = posed.pose.beads.iter().map(|bead| BeadMark {
            name: bead.name.clone(),
            found_px: bead.image_px.and_then(place),
            radius_px: bead.image_px.and_then(radius_at),
            predicted_px: bead.predicted_px.and_then(place),
            residual_px: bead.residual_px,
            used: bead.used,
        });
        let others = posed.pose.shadows.iter().filter(|shadow| shadow.bead.is_none());
        let landmarks = posed.pose.landmarks.iter().map(|landmark| LandmarkMark {
            name: landmark.name.clone(),
            image_px: landmark.image_px.and_then(place),
            sigma_px: landmark.sigma_px,
            sigma_mm: landmark.sigma_mm,
        });
        let robot =
            posed.view.zip(scene).and_then(|(view, scene)| robot_in(scene, &view, &|at| seen(at).map(|at| at.to_array())));
        Self {
            beads: beads.collect(),
            shadows: others.filter_map(|shadow| Some((place(shadow.image_px)?, shadow.radius_px))).collect(),
            landmarks: landmarks.collect(),
            robot,
        }
    }
}

/// A bead's centre, corrected for its bias, lies no farther from that of its shadow.
const SAME_SHADOW_PX: f64 = 2.0;

fn robot_in(scene: &Scene, view: &View, place: &dyn Fn(DVec2) -> Option<[f64; 2]>) -> Option<RobotMark> {
    let robot = scene.robot.as_ref()?;
    let shape = robot.shape_at(&robot.control_angles_deg).ok()?;
    let in_frame = |p_in_base: DVec3| {
        let (at, depth_mm) = view.projection().project(robot.lps_from_base.transform_point(p_in_base));
        (depth_mm > 0.0 && at.is_finite()).then(|| place(at))?
    };
    let ends = [&shape.base_from_body_end];
    let along = shape.base_from_pieces.iter().map(|(piece, _)| piece).chain(ends);
    Some(RobotMark {
        centreline_px: along.filter_map(|piece| in_frame(piece.translation_mm)).collect(),
        tip_px: in_frame(shape.base_from_tip.translation_mm)?,
    })
}

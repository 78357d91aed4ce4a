//! What is marked in a frame: beads, shadows, landmarks and the robot where the frame shows them, the intensifier's distortion included.

use std::borrow::Cow;

use glam::{DVec2, DVec3};

use crate::geometry::{Distortion, View};
use crate::pose::Pose;
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
    /// Found minus predicted.
    pub residual_px: Option<[f64; 2]>,
    /// Whether P rests on it.
    pub used: bool,
    /// A hand put it, or named its shadow.
    pub by_hand: bool,
}

/// A shadow that looks like a bead's.
#[derive(Clone, Debug, PartialEq)]
pub struct ShadowMark {
    /// Its place among all shadows of the frame, the most bead-like first: from 1.
    pub rank: usize,
    /// Its centre.
    pub image_px: [f64; 2],
    /// Its radius.
    pub radius_px: f64,
    /// Contrast over the noise.
    pub snr: f64,
    /// Something speaks against its centre.
    pub flagged: bool,
    /// The bead whose it is, if P rests on that.
    pub bead: Option<String>,
}

/// A landmark in the frame.
#[derive(Clone, Debug, PartialEq)]
pub struct LandmarkMark {
    /// Its label.
    pub name: String,
    /// Where P puts it.
    pub image_px: Option<[f64; 2]>,
    /// Covariance of that place, columns and rows.
    pub covariance_px2: Option<[[f64; 2]; 2]>,
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
    /// All that were found, in the order of their ranks.
    pub shadows: Vec<ShadowMark>,
    /// Those that the session names.
    pub landmarks: Vec<LandmarkMark>,
    /// Absent without a robot, and without a pose.
    pub robot: Option<RobotMark>,
}

/// A bead's centre, corrected for its bias, lies no farther from that of its shadow.
const SAME_SHADOW_PX: f64 = 2.0;

impl PairMarks {
    /// Of a pose, accepted or refused. `distortion` is what an intensifier did to the frame; the robot is that of `scene` as `view` shows it.
    #[must_use]
    pub fn of(pose: &Pose, distortion: Option<&Distortion>, view: Option<&View>, scene: Option<&Scene>) -> Self {
        let pose = distortion.map_or(Cow::Borrowed(pose), |distortion| Cow::Owned(pose.drawn_on_distorted(distortion)));
        let apart_px = |a: [f64; 2], b: [f64; 2]| DVec2::from_array(a).distance(DVec2::from_array(b));
        let radius_at = |at: [f64; 2]| {
            let own = pose.shadows.iter().find(|shadow| apart_px(shadow.image_px, at) < SAME_SHADOW_PX);
            own.map(|shadow| shadow.radius_px)
        };
        let residual = |found: [f64; 2], predicted: [f64; 2]| [found[0] - predicted[0], found[1] - predicted[1]];
        let beads = pose.beads.iter().map(|bead| BeadMark {
            name: bead.name.clone(),
            found_px: bead.image_px,
            radius_px: bead.image_px.and_then(radius_at),
            predicted_px: bead.predicted_px,
            residual_px: bead.image_px.zip(bead.predicted_px).map(|(found, predicted)| residual(found, predicted)),
            used: bead.used,
            by_hand: pose.edited.as_ref().is_some_and(|edited| edited.is_of(&bead.name)),
        });
        let shadows = (1..).zip(&pose.shadows).map(|(rank, shadow)| ShadowMark {
            rank,
            image_px: shadow.image_px,
            radius_px: shadow.radius_px,
            snr: shadow.snr,
            flagged: shadow.flags.any(),
            bead: shadow.bead.clone(),
        });
        // Poses that were written without the covariance have its diagonal.
        let diagonal = |[u, v]: [f64; 2]| [[u * u, 0.0], [0.0, v * v]];
        let landmarks = pose.landmarks.iter().map(|landmark| LandmarkMark {
            name: landmark.name.clone(),
            image_px: landmark.image_px,
            covariance_px2: landmark.covariance_px2.or_else(|| landmark.sigma_px.map(diagonal)),
            sigma_mm: landmark.sigma_mm,
        });
        Self {
            beads: beads.collect(),
            shadows: shadows.collect(),
            landmarks: landmarks.collect(),
            robot: view.zip(scene).and_then(|(view, scene)| robot_in(scene, view, distortion)),
        }
    }

    /// Shadows that are no bead's.
    pub fn strays(&self) -> impl Iterator<Item = &ShadowMark> {
        self.shadows.iter().filter(|shadow| shadow.bead.is_none())
    }
}

fn robot_in(scene: &Scene, view: &View, distortion: Option<&Distortion>) -> Option<RobotMark> {
    let robot = scene.robot.as_ref()?;
    let shape = robot.shape_at(&robot.control_angles_deg).ok()?;
    let in_frame = |p_in_base: DVec3| {
        let (at, depth_mm) = view.projection().project(robot.lps_from_base.transform_point(p_in_base));
        (depth_mm > 0.0 && at.is_finite()).then(|| Distortion::shown(distortion, at).map(|at| at.to_array()))?
    };
    let ends = [&shape.base_from_body_end];
    let along = shape.base_from_pieces.iter().map(|(piece, _)| piece).chain(ends);
    Some(RobotMark {
        centreline_px: along.filter_map(|piece| in_frame(piece.translation_mm)).collect(),
        tip_px: in_frame(shape.base_from_tip.translation_mm)?,
    })
}

//! Where one frame shows the drill's tip, against where its DRR draws it.

use glam::DVec3;
use nalgebra::SMatrix;

use super::chain::{OWN, State, length_mm, on_axis, shape};
use super::fit::{Fitting, LEAST_MARKS};
use super::metal::Metal;
use super::shot::Shot;
use super::tips::tip_px;
use super::{Assumed, RobotFitError};
use crate::acquire::Frame;
use crate::geometry::Rigid;
use crate::mask::Masks;
use crate::pose::Pose;
use crate::scene::Scene;

/// Base, offsets and readings together may be off by so much before the robot is not found.
const ASSUMED: Assumed =
    Assumed { guess_sigma_mm: 4.0, guess_sigma_deg: 3.0, offset_sigma_deg: 1e-3, reading_sigma_deg: 0.3, tracked: false };
/// Profiles that agree only to so many times what they state do not show this robot.
const MOST_TIMES: f64 = 4.0;
/// Step for the effect of a bend on the tip, degrees.
const STEP_DEG: f64 = 1e-4;
/// What background, scatter and the shape of the drill's end leave beside noise, px: frames of the tests' own drawing show the tip 0.4 px
/// rms per axis from where it is.
const PLACE_PX: f64 = 0.5;
/// Base, own bend and the picture's shift.
const UNKNOWNS: usize = 6 + OWN + 2;

/// The drill's tip as a frame shows it.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SeenTip {
    /// Where it is seen.
    pub image_px: [f64; 2],
    /// Seen minus drawn along columns and rows, at the tip's depth: base, control angles, load and pose together.
    pub off_mm: [f64; 2],
    /// Standard deviations of where it is seen.
    pub sigma_mm: [f64; 2],
    /// Length.
    pub length_mm: f64,
    /// Profiles across and along the robot that it rests on.
    pub profiles: usize,
}

/// Steps of the centreline.
const STEPS: u32 = 32;

/// The robot as a frame shows it.
#[derive(Clone, Debug, PartialEq)]
pub struct SeenRobot {
    /// The end of the drill.
    pub tip: SeenTip,
    /// Its centreline from the base to there, with base, bend and picture as they are fitted, px of the frame.
    pub centreline_px: Vec<[f64; 2]>,
}

/// A tip seen further from where it is drawn is worth a word: mm, and standard deviations.
const ELSEWHERE: (f64, f64) = (1.0, 4.0);

impl SeenTip {
    /// Whether the DRR draws the tip where it is not.
    #[must_use]
    pub fn is_elsewhere(&self) -> bool {
        let sigma_mm = self.sigma_mm[0].max(self.sigma_mm[1]);
        self.length_mm > ELSEWHERE.0 && self.length_mm > ELSEWHERE.1 * sigma_mm
    }
}

/// The robot in `frame`, whose masks are given, as the robot of `scene` has it when its base, bend and picture are fitted to what is seen;
/// `None` where the robot is not seen, or the frame has no pose. `scene` is posed as the DRR was: robot and bodies at the exposure.
/// `cancelled` is asked now and then.
///
/// # Errors
/// When the scene has no robot, or its metals no attenuation, or it is cancelled.
pub fn tip_in_frame(
    frame: &Frame,
    masks: &Masks,
    pose: &Pose,
    scene: &Scene,
    cancelled: &dyn Fn() -> bool,
) -> Result<Option<SeenRobot>, RobotFitError> {
    let robot = scene.robot.as_ref().ok_or(RobotFitError::NoRobot)?;
    let readings_deg = robot.control_angles_deg;
    let Ok(shot) = Shot::masked(&frame.name, frame, masks, pose, readings_deg, Rigid::IDENTITY) else { return Ok(None) };
    let start =
        State { carrier_from_base: robot.lps_from_base, offsets_deg: robot.control_angle_offsets_deg, own_deg: vec![[0.0; OWN]] };
    let Some((drawn_px, _)) = tip_px(&robot.model, &shot, &start, &[0.0; OWN]) else { return Ok(None) };
    let fitting = Fitting { robot, metal: Metal::of(scene, robot)?, start, assumed: &ASSUMED };
    let (solution, marks) = match fitting.rounds(&[&shot], cancelled) {
        Ok(found) => found,
        Err(RobotFitError::Cancelled) => return Err(RobotFitError::Cancelled),
        // Too few profiles leave the equations without a solution.
        Err(_) => return Ok(None),
    };
    let (fitted, profiles) = (&solution.shots[0], marks[0].len());
    let chi2_per_dof = solution.chi2 / solution.degrees_of_freedom;
    if profiles < LEAST_MARKS || !marks[0].iter().any(|mark| mark.is_end) || !(chi2_per_dof.sqrt() <= MOST_TIMES) {
        return Ok(None);
    }
    let (state, own) = (&solution.state, solution.state.own_deg[0]);
    let at = |state: &State, own: &[f64; OWN]| tip_px(&robot.model, &shot, state, own);
    let Some((found_px, depth_mm)) = at(state, &own) else { return Ok(None) };
    let shift_px = glam::DVec2::from_array(fitted.shift_px);
    let seen_px = found_px + shift_px;
    let mut by = SMatrix::<f64, 2, UNKNOWNS>::zeros();
    let Some(shape) = shape(&robot.model, &shot, &state.offsets_deg, &own) else { return Ok(None) };
    let tip_in_lps = state.carrier_from_base.transform_point(shape.base_from_tip.translation_mm);
    let centre = state.carrier_from_base.transform_point(super::solve::middle(&robot.model));
    let in_camera = shot.view.camera_from_lps.transform_point(tip_in_lps);
    let to_lps = shot.view.camera_from_lps.rotation.conjugate();
    for (row, slope) in shot.view.intrinsics.slopes_px_per_mm(in_camera).into_iter().enumerate() {
        // ω turns about the middle of the robot, v shifts, in lps: δp = ω × (p − c) + v.
        let slope: DVec3 = to_lps * slope;
        let turning = (tip_in_lps - centre).cross(slope);
        for axis in 0..3 {
            by[(row, axis)] = turning[axis];
            by[(row, 3 + axis)] = slope[axis];
        }
        by[(row, 6 + OWN + row)] = 1.0;
    }
    for k in 0..OWN {
        let mut near = [own; 2];
        near[0][k] -= STEP_DEG;
        near[1][k] += STEP_DEG;
        let (Some((low, _)), Some((high, _))) = (at(state, &near[0]), at(state, &near[1])) else { return Ok(None) };
        let slope = (high - low) / (2.0 * STEP_DEG);
        (by[(0, 6 + k)], by[(1, 6 + k)]) = (slope.x, slope.y);
    }
    let joint = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_fn(|i, j| fitted.joint[(i, j)]);
    let covariance_px2 = by * joint * by.transpose() * chi2_per_dof.max(1.0);
    let mm_per_px = depth_mm / shot.view.intrinsics.fx;
    let off_mm = (seen_px - drawn_px) * mm_per_px;
    let on_centreline = |step: u32| {
        let s_mm = f64::from(step) / f64::from(STEPS) * length_mm(&robot.model);
        let (px, _) = shot.image(state.carrier_from_base.transform_point(on_axis(&shape, s_mm)))?;
        Some((px + shift_px).to_array())
    };
    let centreline_px = (0..=STEPS).filter_map(on_centreline).collect();
    let tip = SeenTip {
        image_px: seen_px.to_array(),
        off_mm: off_mm.to_array(),
        sigma_mm: [0, 1].map(|n| covariance_px2[(n, n)].sqrt().hypot(PLACE_PX) * mm_per_px),
        length_mm: off_mm.length(),
        profiles,
    };
    Ok(Some(SeenRobot { tip, centreline_px }))
}

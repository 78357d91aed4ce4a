//! A shot, and the residual of its beads against arm, joints and the specimen's place in the room.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::Matrix2;

use super::parameters::{Parameter, moved};
use crate::estimate::{BlockId, Evaluation, PoseBlock, Residual, State, VectorBlock, turned};
use crate::geometry::{CarmCalibration, CarmJoints, Intrinsics, Rigid};

/// A bead's image.
#[derive(Clone, Debug, PartialEq)]
pub struct ShotBead {
    /// As in the layout.
    pub name: String,
    /// Its place by the layout.
    pub lps_mm: DVec3,
    /// Where it was seen.
    pub image_px: DVec2,
    /// Covariance of `image_px`: uu, uv, vv.
    pub noise_px2: [f64; 3],
    /// Covariance of `lps_mm`, positive definite.
    pub place_mm2: DMat3,
}

/// A frame with its beads and the joints at its exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct Shot {
    /// How people call it.
    pub name: String,
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// As read from the encoders; the distance to the detector may be missing.
    pub joints: CarmJoints,
    /// Used beads.
    pub beads: Vec<ShotBead>,
    /// The specimen in the camera, by the beads alone.
    pub camera_from_lps: Rigid,
}

/// The six joints that move the camera.
pub(super) const JOINTS: usize = 6;

/// All beads of a shot: 2 n numbers from arm (in prior standard deviations), `world_from_lps`, the shot's true joints and the bead places.
pub(super) struct ShotBeads<'a> {
    pub nominal: &'a CarmCalibration,
    pub parameters: &'a [Parameter],
    pub shot: &'a Shot,
    pub arm: VectorBlock,
    pub tie: PoseBlock,
    pub joints: VectorBlock,
    /// Of each bead of the shot.
    pub places: Vec<VectorBlock>,
    pub ids: Vec<BlockId>,
}

/// Steps of central differences: prior standard deviations, radians, mm. The chain is smooth and at most quadratic over them to 1e-9.
pub(super) const STEP_SIGMAS: f64 = 1e-4;
pub(super) const STEP_RAD: f64 = 1e-5;
pub(super) const STEP_MM: f64 = 1e-2;

fn camera(carm: &CarmCalibration, joints: &CarmJoints) -> Option<(Rigid, Intrinsics)> {
    Some((carm.world_from_camera(joints).ok()?.inverse(), carm.intrinsics(joints).ok()?))
}

/// How a camera moves with a number: ω, v about the focal spot in rad and mm, and f, cx, cy in px.
#[derive(Clone, Copy)]
struct Slope {
    turn: DVec3,
    shift: DVec3,
    intrinsics: DVec3,
}

impl Slope {
    fn between(above: (Rigid, Intrinsics), below: (Rigid, Intrinsics), step: f64) -> Self {
        let (turn, shift) = (above.0 * below.0.inverse()).log();
        let of = |k: Intrinsics| DVec3::new(k.fx, k.cx, k.cy);
        let over = 0.5 / step;
        Self { turn: turn * over, shift: shift * over, intrinsics: (of(above.1) - of(below.1)) * over }
    }
}

impl ShotBeads<'_> {
    fn joints_at(&self, numbers: &[f64]) -> CarmJoints {
        let mut all = self.shot.joints.to_array();
        all[..JOINTS].copy_from_slice(numbers);
        CarmJoints::from_array(all)
    }

    fn slopes_of_arm(&self, carm: &CarmCalibration, joints: &CarmJoints) -> Option<Vec<Slope>> {
        let mut near = carm.clone();
        let slope = |parameter: &Parameter| {
            parameter.shift(&mut near, STEP_SIGMAS);
            let above = camera(&near, joints)?;
            parameter.shift(&mut near, -2.0 * STEP_SIGMAS);
            let below = camera(&near, joints)?;
            near.clone_from(carm);
            Some(Slope::between(above, below, STEP_SIGMAS))
        };
        self.parameters.iter().map(slope).collect()
    }

    fn slopes_of_joints(&self, carm: &CarmCalibration, joints: &CarmJoints) -> Option<Vec<Slope>> {
        let slope = |n: usize| {
            let step = if matches!(n, 0 | 2) { STEP_MM } else { STEP_RAD };
            let at = |by: f64| {
                let mut all = joints.to_array();
                all[n] += by;
                camera(carm, &CarmJoints::from_array(all))
            };
            Some(Slope::between(at(step)?, at(-step)?, step))
        };
        (0..JOINTS).map(slope).collect()
    }
}

impl Residual for ShotBeads<'_> {
    fn dimension(&self) -> usize {
        2 * self.shot.beads.len()
    }

    fn blocks(&self) -> &[BlockId] {
        &self.ids
    }

    fn evaluate(&self, state: &State, out: &mut Evaluation) -> bool {
        let n = self.dimension();
        let carm = moved(self.nominal, self.parameters, state.vector(self.arm));
        let joints = self.joints_at(state.vector(self.joints));
        let Some((camera_from_world, k)) = camera(&carm, &joints) else { return false };
        let tie = state.motion(self.tie);
        let slopes = [self.slopes_of_arm(&carm, &joints), self.slopes_of_joints(&carm, &joints)];
        let [Some(by_arm), Some(by_joints)] = slopes else { return false };
        let to_world = camera_from_world.rotation.conjugate();
        for (b, (bead, place)) in self.shot.beads.iter().zip(&self.places).enumerate() {
            let in_world = tie.pose.transform_point(state.point(*place));
            let p = camera_from_world.transform_point(in_world);
            if !(p.z > 1.0 && k.fx > 1.0) {
                return false;
            }
            let seen = k.project(p);
            out.offset()[2 * b..2 * b + 2].copy_from_slice(&(bead.image_px - seen).to_array());
            let [uu, uv, vv] = bead.noise_px2;
            let Some(information) = Matrix2::new(uu, uv, uv, vv).try_inverse() else { return false };
            for (row, column) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                out.information()[(2 * b + column) * n + 2 * b + row] = information[(row, column)];
            }
            let (x, y) = (p.x / p.z, p.y / p.z);
            // Rows of ∂(u, v)/∂p and ∂(u, v)/∂(f, cx, cy).
            let by_camera = [DVec3::new(k.fx, 0.0, -k.fx * x) / p.z, DVec3::new(0.0, k.fy, -k.fy * y) / p.z];
            let by_intrinsics = [DVec3::new(x, 1.0, 0.0), DVec3::new(y, 0.0, 1.0)];
            for (axis, (by_point, by_k)) in by_camera.into_iter().zip(by_intrinsics).enumerate() {
                let row = 2 * b + axis;
                let along = |slope: &Slope| by_point.dot(slope.turn.cross(p) + slope.shift) + by_k.dot(slope.intrinsics);
                let by_world = to_world * by_point;
                let by_tie = turned(by_world, in_world - tie.centre_mm());
                let by_place = (tie.pose.rotation.conjugate() * by_world).to_array();
                let columns: [(usize, Vec<f64>); 4] = [
                    (0, by_arm.iter().map(along).collect()),
                    (1, by_tie.to_vec()),
                    (2, by_joints.iter().map(along).collect()),
                    (3 + b, by_place.to_vec()),
                ];
                for (block, values) in columns {
                    if let Some(jacobian) = out.jacobian(block) {
                        values.iter().enumerate().for_each(|(column, value)| jacobian[column * n + row] = *value);
                    }
                }
            }
        }
        true
    }
}

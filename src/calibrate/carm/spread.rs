//! How far a camera by joint readings is off where no shot was taken: measured on shots that were left out, and taken from there to the whole
//! arm and to the true camera by the covariance of what was fitted.
//!
//! Beads seen through a K that is off make up for it by a turn and a shift of the camera, and an arm that was fitted to them makes up for it
//! alike: the two agree, and both are off. A pixel of 0.194 mm in the principal point is 0.12 mm at the isocentre and 0.011°, and beads that
//! are seen under a few degrees tell it to no better than some pixels.

use glam::DVec3;
use nalgebra::{DMatrix, Matrix6, Matrix6x3, RowVector3, Vector3, Vector6};

use super::Sensors;
use super::parameters::Parameter;
use super::shot::{JOINTS, STEP_MM, STEP_RAD, STEP_SIGMAS, Shot};
use super::solve::{CameraError, Solution, predicted};
use crate::estimate::{Motion, about, deviation, turned};
use crate::geometry::{CarmCalibrationError, CarmJoints, Intrinsics, Rigid};

/// Standard deviations, per axis, of a camera by joint readings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct CameraSigmas {
    /// Of the isocentre in it, against the camera that beads give with the arm's own K.
    pub mm: f64,
    /// Of its attitude, likewise.
    pub deg: f64,
    /// Of the isocentre in the true camera.
    pub true_mm: f64,
    /// Of the true camera's attitude.
    pub true_deg: f64,
}

/// Variances per axis of attitude (rad²) and isocentre (mm²).
#[derive(Clone, Copy, Debug, Default)]
struct Variances {
    /// Against the camera that beads give with the arm's own K.
    own: [f64; 2],
    /// Against the true camera.
    truth: [f64; 2],
}

impl Variances {
    fn plus(self, other: Self) -> Self {
        let sum = |a: [f64; 2], b: [f64; 2]| [a[0] + b[0], a[1] + b[1]];
        Self { own: sum(self.own, other.own), truth: sum(self.truth, other.truth) }
    }
}

/// Of an arm that is `whole` with all `shots`; `others` are the arms without each of them, and `held_out` is how far these are off there.
pub(super) fn camera_sigmas(
    whole: &Solution,
    others: &[Solution],
    shots: &[&Shot],
    held_out: &[CameraError],
    parameters: &[Parameter],
    sensors: &Sensors,
) -> Result<CameraSigmas, CarmCalibrationError> {
    let count = held_out.len().max(1) as f64;
    let measured = |of: &dyn Fn(&CameraError) -> f64| held_out.iter().map(of).sum::<f64>() / (3.0 * count);
    let measured = [
        measured(&|error| error.attitude_deg.to_radians().powi(2)),
        measured(&|error| error.isocentre_mm.iter().map(|mm| mm * mm).sum()),
    ];
    let (mut with, mut without) = (Variances::default(), Variances::default());
    for (shot, others) in shots.iter().zip(others) {
        with = with.plus(variances(whole, parameters, sensors, shot)?);
        without = without.plus(variances(others, parameters, sensors, shot)?);
    }
    // Joints between those of the shots are told better than by an arm that lacks the nearest shot, and worse than where a shot was taken.
    let between = with.plus(without);
    let own: [f64; 2] = std::array::from_fn(|n| measured[n] * 0.5 * between.own[n] / without.own[n]);
    let truth: [f64; 2] = std::array::from_fn(|n| own[n] + (0.5 * (between.truth[n] - between.own[n]) / count).max(0.0));
    Ok(CameraSigmas {
        mm: own[1].sqrt(),
        deg: own[0].sqrt().to_degrees(),
        true_mm: truth[1].sqrt(),
        true_deg: truth[0].sqrt().to_degrees(),
    })
}

/// What is expected of a reading like that of `shot`: the covariance of what was fitted, and the encoders' own noise.
fn variances(
    arm: &Solution,
    parameters: &[Parameter],
    sensors: &Sensors,
    shot: &Shot,
) -> Result<Variances, CarmCalibrationError> {
    let (camera, k) = predicted(&arm.calibration, &arm.world_from_lps, &shot.joints)?;
    let isocentre = DVec3::new(0.0, 0.0, arm.calibration.source_to_isocentre_mm);
    let (to_isocentre, by_intrinsics) = (about(isocentre), made_up_for(shot, &camera, &k, isocentre));
    // ξ about the isocentre for one unit of a number: of the true camera, and of the one that beads give with K as it is here.
    let slope = |above: (Rigid, Intrinsics), below: (Rigid, Intrinsics), step: f64| -> [Vector6<f64>; 2] {
        let of = |k: Intrinsics| Vector3::new(k.fx, k.cx, k.cy);
        let moved = to_isocentre * deviation(&above.0, &below.0) * (0.5 / step);
        [moved, moved + by_intrinsics * (of(above.1) - of(below.1)) * (0.5 / step)]
    };
    let mut fitted = Vec::with_capacity(parameters.len() + 6);
    for parameter in parameters {
        let at = |sigmas: f64| {
            let mut near = arm.calibration.clone();
            parameter.shift(&mut near, sigmas);
            predicted(&near, &arm.world_from_lps, &shot.joints)
        };
        fitted.push(slope(at(STEP_SIGMAS)?, at(-STEP_SIGMAS)?, STEP_SIGMAS));
    }
    let tie = Motion { pose: arm.world_from_lps, pivot_mm: arm.pivot_lps_mm };
    for n in 0..6 {
        let step = if n < 3 { STEP_RAD } else { STEP_MM };
        let at = |by: f64| {
            let mut xi = [0.0; 6];
            xi[n] = by;
            predicted(&arm.calibration, &tie.moved(&xi).pose, &shot.joints)
        };
        fitted.push(slope(at(step)?, at(-step)?, step));
    }
    let mut encoders = Vec::with_capacity(JOINTS);
    for (n, sigma) in sensors.sigmas().into_iter().enumerate() {
        let step = if matches!(n, 0 | 2) { STEP_MM } else { STEP_RAD };
        let at = |by: f64| {
            let mut all = shot.joints.to_array();
            all[n] += by;
            predicted(&arm.calibration, &arm.world_from_lps, &CarmJoints::from_array(all))
        };
        encoders.push(slope(at(step)?, at(-step)?, step).map(|moved| moved * sigma));
    }
    let of = |which: usize| -> [f64; 2] {
        let slopes = DMatrix::from_fn(6, fitted.len(), |row, column| fitted[column][which][row]);
        let spread = &slopes * &arm.covariance * slopes.transpose();
        let variance = |row: usize| spread[(row, row)] + encoders.iter().map(|moved| moved[which][row].powi(2)).sum::<f64>();
        [0, 3].map(|first| (first..first + 3).map(variance).sum::<f64>() / 3.0)
    };
    Ok(Variances { own: of(1), truth: of(0) })
}

/// ξ about `centre` by which beads make up for (f, cx, cy) that are larger than K has them. Beads that tell no pose were refused before.
fn made_up_for(shot: &Shot, camera: &Rigid, k: &Intrinsics, centre: DVec3) -> Matrix6x3<f64> {
    let (mut normal, mut mixed) = (Matrix6::<f64>::zeros(), Matrix6x3::<f64>::zeros());
    for bead in &shot.beads {
        let p = camera.transform_point(bead.lps_mm);
        let (x, y) = (p.x / p.z, p.y / p.z);
        // Rows of ∂(u, v)/∂p and ∂(u, v)/∂(f, cx, cy).
        let by_point = [DVec3::new(k.fx, 0.0, -k.fx * x) / p.z, DVec3::new(0.0, k.fy, -k.fy * y) / p.z];
        let by_k = [RowVector3::new(x, 1.0, 0.0), RowVector3::new(y, 0.0, 1.0)];
        for (by_point, by_k) in by_point.into_iter().zip(by_k) {
            let by_pose = Vector6::from_row_slice(&turned(by_point, p - centre));
            normal += by_pose * by_pose.transpose();
            mixed += by_pose * by_k;
        }
    }
    normal.cholesky().map_or_else(Matrix6x3::zeros, |normal| normal.solve(&mixed))
}

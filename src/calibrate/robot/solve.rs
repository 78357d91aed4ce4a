//! Base, offsets and each shot's own bend from marks, by the one least-squares core.

use glam::{DQuat, DVec3};
use nalgebra::{DMatrix, Matrix2, SMatrix};

use super::Assumed;
use super::chain::{OWN, State, length_mm, on_axis, shape};
use super::measure::Mark;
use super::shot::Shot;
use crate::estimate::{BlockId, EstimateError, Freedom, Loss, Numeric, Problem, Reading, Settings, VectorBlock, turned};
use crate::geometry::{CONTROL_COUNT, Rigid, RobotModel};

/// Marks count less from so many standard deviations on.
const DOUBTFUL: f64 = 3.0;
/// Times that the weights of marks are renewed.
const WEIGHINGS: usize = 3;
/// A shot's own bend counts less from so many standard deviations on.
const LOADED: f64 = 3.0;
/// Notches are stiff across their plane: of a reading's standard deviation, what they bend there without a load.
const ACROSS: f64 = 0.1;
/// No pose is known better, px; and what is taken where it does not say.
const POSE_PX: (f64, f64) = (0.02, 0.5);

/// What a solution says of a shot.
#[derive(Clone, Debug)]
pub(super) struct Fitted {
    /// Σ of squares over marks and the pose's shift, in standard deviations, gross errors counting less.
    pub chi2: f64,
    /// Of them.
    pub degrees_of_freedom: f64,
    /// √mean of squares of the marks' residuals, px.
    pub rms_px: f64,
    /// Residual of each mark along its normal, px.
    pub residuals_px: Vec<f64>,
    /// By how much its whole picture is shifted against its pose, px.
    pub shift_px: [f64; 2],
    /// Covariance of (ω, v) of the base about the robot's middle along the carrier's axes, rad and mm; of the own bend, deg; and of the
    /// picture's shift, px.
    pub joint: DMatrix<f64>,
}

/// A solution with its covariance, not scaled.
#[derive(Clone, Debug)]
pub(super) struct Solution {
    pub state: State,
    pub shots: Vec<Fitted>,
    /// Of (ω, v) in the base's own axes at its origin, rad and mm, then of offsets, rad.
    pub covariance: SMatrix<f64, 11, 11>,
    pub chi2: f64,
    pub degrees_of_freedom: f64,
}

/// Solves from `state`; marks of each shot, none where it was not seen.
pub(super) fn solve(
    shots: &[&Shot],
    marks: &[Vec<Mark>],
    model: &RobotModel,
    state: &State,
    start: &State,
    assumed: &Assumed,
) -> Result<Solution, EstimateError> {
    let mut weights: Vec<Vec<f64>> = marks.iter().map(|marks| vec![1.0; marks.len()]).collect();
    let mut last = weighed(shots, marks, &weights, model, state, start, assumed)?;
    for _ in 1..WEIGHINGS {
        for ((weights, marks), fitted) in weights.iter_mut().zip(marks).zip(&last.shots) {
            for ((weight, mark), residual) in weights.iter_mut().zip(marks).zip(&fitted.residuals_px) {
                *weight = Loss::Cauchy(DOUBTFUL).weight((residual / mark.sigma_px).powi(2));
            }
        }
        last = weighed(shots, marks, &weights, model, &last.state, start, assumed)?;
    }
    Ok(last)
}

/// The point about which the base is turned, in `base`.
pub(super) fn middle(model: &RobotModel) -> DVec3 {
    DVec3::new(0.0, 0.0, 0.5 * length_mm(model))
}

struct Blocks {
    own: VectorBlock,
    shift: VectorBlock,
    /// None of a shot without marks.
    marks: Option<usize>,
    pose: usize,
}

fn weighed(
    shots: &[&Shot],
    marks: &[Vec<Mark>],
    weights: &[Vec<f64>],
    model: &RobotModel,
    state: &State,
    start: &State,
    assumed: &Assumed,
) -> Result<Solution, EstimateError> {
    let mut problem = Problem::new();
    let middle = middle(model);
    let base = problem.pose("carrier_from_base", state.carrier_from_base, middle, true);
    let offsets = problem.vector("control_angle_offsets", &state.offsets_deg, Freedom::All);
    problem.add(Reading::with_sigmas(offsets, &start.offsets_deg, &[assumed.offset_sigma_deg; CONTROL_COUNT]), Loss::None);
    let guess = start.carrier_from_base;
    let (mm, rad) = (assumed.guess_sigma_mm.powi(-2), assumed.guess_sigma_deg.to_radians().powi(-2));
    let information = DMatrix::from_diagonal(&nalgebra::dvector![rad, rad, rad, mm, mm, mm]);
    let from_guess = move |at: &crate::estimate::State, out: &mut [f64]| {
        let pose = at.pose(base);
        let turn = (pose.rotation * guess.rotation.conjugate()).normalize();
        let turn = if turn.w < 0.0 { -turn } else { turn };
        out[..3].copy_from_slice(&DQuat::to_scaled_axis(turn).to_array());
        out[3..].copy_from_slice(&(pose.transform_point(middle) - guess.transform_point(middle)).to_array());
        true
    };
    let prior = Numeric::new(&problem, &[base.id()], &[0.0; 6], information, from_guess);
    problem.add(prior, Loss::None);
    let mut blocks = Vec::new();
    for (n, shot) in shots.iter().enumerate() {
        let own = problem.vector("own_bend", &state.own_deg[n], Freedom::All);
        for (chosen, sigma_deg) in [
            ((0..CONTROL_COUNT).collect::<Vec<_>>(), assumed.reading_sigma_deg),
            ((CONTROL_COUNT..OWN).collect(), ACROSS * assumed.reading_sigma_deg),
        ] {
            let information = DMatrix::from_diagonal_element(chosen.len(), chosen.len(), sigma_deg.powi(-2));
            problem.add(Reading::of_some(own, chosen.clone(), &vec![0.0; chosen.len()], information), Loss::Cauchy(LOADED));
        }
        let shift = problem.vector("image_shift", &[0.0; 2], Freedom::All);
        let place = shot.lps_from_carrier * state.carrier_from_base;
        let spread = shift_covariance_px2(shot, place.transform_point(middle));
        let information = spread.try_inverse().unwrap_or_else(Matrix2::identity);
        let information = DMatrix::from_fn(2, 2, |i, j| information[(i, j)]);
        let pose = problem.add(Reading::of_all(shift, &[0.0; 2], information), Loss::None);
        let ids: [BlockId; 4] = [base.id(), offsets.id(), own.id(), shift.id()];
        let of_shot = marks[n].clone();
        let observed: Vec<f64> = of_shot.iter().map(|mark| mark.normal.dot(mark.place_px)).collect();
        let information = DMatrix::from_diagonal(&nalgebra::DVector::from_fn(of_shot.len(), |k, _| {
            weights[n][k] * of_shot[k].sigma_px.powi(-2)
        }));
        let predict = move |at: &crate::estimate::State, out: &mut [f64]| {
            let Some(shape) = shape(model, shot, at.vector(offsets), at.vector(own)) else { return false };
            let lps_from_base = shot.lps_from_carrier * *at.pose(base);
            let shifted = at.vector(shift);
            for (mark, out) in of_shot.iter().zip(out) {
                let Some((seen, _)) = shot.image(lps_from_base.transform_point(on_axis(&shape, mark.s_mm))) else { return false };
                *out = mark.normal.dot(seen) + mark.normal.x * shifted[0] + mark.normal.y * shifted[1];
            }
            true
        };
        let residual = (!observed.is_empty()).then(|| Numeric::new(&problem, &ids, &observed, information, predict));
        let marks = residual.map(|residual| problem.add(residual, Loss::None));
        blocks.push(Blocks { own, shift, marks, pose });
    }
    let estimate = problem.solve(&Settings { step_sigmas: 1e-4, ..Settings::default() })?;
    let covariance = estimate.covariance()?;
    let found = estimate.state();
    let of_shot = |(n, blocks): (usize, &Blocks)| {
        let residuals_px = blocks.marks.map(|marks| estimate.offset(marks).to_vec()).unwrap_or_default();
        let squares: f64 = residuals_px.iter().map(|px| px * px).sum();
        let shift = found.vector(blocks.shift);
        Fitted {
            chi2: blocks.marks.map_or(0.0, |marks| estimate.chi2(marks)) + estimate.chi2(blocks.pose),
            degrees_of_freedom: weights[n].iter().sum::<f64>(),
            rms_px: (squares / residuals_px.len().max(1) as f64).sqrt(),
            residuals_px,
            shift_px: [shift[0], shift[1]],
            joint: covariance.of(&[base.id(), blocks.own.id(), blocks.shift.id()]),
        }
    };
    let fitted: Vec<Fitted> = blocks.iter().enumerate().map(of_shot).collect();
    let counted: f64 = weights.iter().flatten().sum();
    // Priors answer for the unknowns that they were given for; what shots share comes off the marks.
    let degrees_of_freedom = (counted - (6 + CONTROL_COUNT) as f64 - 4.0 * shots.len() as f64).max(1.0);
    let pose = *found.pose(base);
    let joint = covariance.of(&[base.id(), offsets.id()]);
    Ok(Solution {
        state: State {
            carrier_from_base: pose,
            offsets_deg: array(found.vector(offsets)),
            own_deg: blocks.iter().map(|blocks| array(found.vector(blocks.own))).collect(),
        },
        chi2: fitted.iter().map(|shot| shot.chi2).sum(),
        shots: fitted,
        covariance: in_base(&joint, &pose, pose.transform_point(middle)),
        degrees_of_freedom,
    })
}

fn array<const N: usize>(numbers: &[f64]) -> [f64; N] {
    std::array::from_fn(|n| numbers[n])
}

/// How far a pose's error shifts the robot's picture.
fn shift_covariance_px2(shot: &Shot, robot_in_lps: DVec3) -> Matrix2<f64> {
    let floor = Matrix2::identity() * POSE_PX.0.powi(2);
    let Some(covariance) = &shot.pose_covariance else { return Matrix2::identity() * POSE_PX.1.powi(2) };
    let p = shot.view.camera_from_lps.transform_point(robot_in_lps);
    // δp = ω × p + v about the focal spot.
    let rows = shot.view.intrinsics.slopes_px_per_mm(p).map(|slope| turned(slope, p));
    let by_pose = SMatrix::<f64, 2, 6>::from_fn(|i, j| rows[i][j]);
    let covariance = SMatrix::<f64, 6, 6>::from_fn(|i, j| covariance[i][j]);
    by_pose * covariance * by_pose.transpose() + floor
}

/// From (ω, v) in the carrier's axes about `centre`, and offsets in degrees, to the base's own axes about its origin, and rad.
fn in_base(joint: &DMatrix<f64>, pose: &Rigid, centre: DVec3) -> SMatrix<f64, 11, 11> {
    let mut to_base = SMatrix::<f64, 11, 11>::zeros();
    let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| pose.transform_vector(axis));
    for (row, axis) in axes.iter().enumerate() {
        // v at the base's origin o is v + ω × (o − c), along an axis e: e·v + ((o − c) × e)·ω.
        let lever = (pose.translation_mm - centre).cross(*axis);
        for column in 0..3 {
            to_base[(row, column)] = axis[column];
            to_base[(3 + row, 3 + column)] = axis[column];
            to_base[(3 + row, column)] = lever[column];
        }
    }
    for k in 6..11 {
        to_base[(k, k)] = 1f64.to_radians();
    }
    let joint = SMatrix::<f64, 11, 11>::from_fn(|i, j| joint[(i, j)]);
    to_base * joint * to_base.transpose()
}

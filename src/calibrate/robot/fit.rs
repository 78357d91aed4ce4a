//! From shots to a calibration: search, rounds of measuring and solving, which shots are left out, and what is refused.

use glam::{DMat3, DVec3};
use nalgebra::SMatrix;
use rayon::prelude::*;

use super::chain::{OWN, State, length_mm};
use super::measure::{Mark, measure};
use super::metal::Metal;
use super::search::search;
use super::shot::Shot;
use super::solve::{Solution, solve};
use super::tips::{self, SharedTip, Tip, spread_deg};
use super::{Assumed, RobotFitError};
use crate::geometry::{Rigid, RobotCalibration};
use crate::scene::Scene;
use crate::scene::model::Robot;

/// Fewer shots have no second direction.
const LEAST_SHOTS: usize = 2;
/// Beams of two directions.
const LEAST_SPREAD_DEG: f64 = 10.0;
/// A robot is seen in a shot that has as many marks.
pub(super) const LEAST_MARKS: usize = 12;
/// Of each round, how far from the prediction is looked, mm; what it brings is less than a step of the next.
const REACHES_MM: [f64; 8] = [5.0, 4.0, 3.0, 2.5, 2.0, 2.0, 2.0, 2.0];
/// Rounds without the drill's end, whose profile must lie on the drill.
const WITHOUT_END: usize = 2;
/// Squares over degrees of freedom from which on a shot does not belong to the others, and how many times theirs.
const EXCESS: (f64, f64) = (6.0, 4.0);
/// Of the shots, as many may be left out.
const MOST_LEFT_OUT: f64 = 0.5;
/// Residuals of so many times what profiles state are explained by no robot.
const MOST_TIMES: f64 = 5.0;
/// Of the guess's standard deviation, what a direction that is told keeps at most.
const UNDETERMINED: f64 = 0.7;
/// In standard deviations of the guess.
const MOST_FROM_GUESS: f64 = 3.0;

/// A shot on which nothing rests.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeftOutShot {
    /// Which.
    pub shot: String,
    /// Why.
    pub why: String,
}

/// A calibrated robot.
#[derive(Clone, Debug)]
pub struct RobotFit {
    /// The base and the offsets; its origin is to be written.
    pub calibration: RobotCalibration,
    /// Σ of squares in standard deviations over degrees of freedom; standard deviations are scaled by its root where above 1.
    pub chi2_per_dof: f64,
    /// Names of the shots that it rests on, in their order.
    pub shots: Vec<String>,
    /// Of each: why its pose is in doubt, where it is.
    pub doubts: Vec<Option<String>>,
    /// Of each: √mean of squares across the axis, px; that in standard deviations; profiles that found the robot; shift of its picture, px.
    pub residuals: Vec<(f64, f64, usize, [f64; 2])>,
    /// Of each: the tip; `None` behind the focal spot.
    pub tips: Vec<Option<Tip>>,
    /// Of shots of one shape from several sides.
    pub shared_tips: Vec<SharedTip>,
    /// Shots in which the robot is not seen, or that contradict the others.
    pub left_out: Vec<LeftOutShot>,
    /// Largest angle between beams at the robot, degrees.
    pub spread_deg: f64,
    /// Where it started.
    pub guess: Rigid,
    /// By how much each shot's own bend differs from readings and offsets, degrees.
    pub own_bends_deg: Vec<[f64; OWN]>,
}

/// What all rounds of a fit share.
pub(super) struct Fitting<'a> {
    pub robot: &'a Robot,
    pub metal: Metal,
    pub start: State,
    pub assumed: &'a Assumed,
}

/// Fits base and offsets to shots; `scene` has the robot, with its base where it is guessed to be.
///
/// # Errors
/// When there is no robot, it is seen in too few shots or from one side only, the shots leave something open, contradict each other or agree
/// with no robot.
pub fn calibrate(shots: &[Shot], scene: &Scene, assumed: &Assumed) -> Result<RobotFit, RobotFitError> {
    let robot = scene.robot.as_ref().ok_or(RobotFitError::NoRobot)?;
    let guess = if assumed.tracked { robot.marker_from_base } else { robot.lps_from_base };
    let start =
        State { carrier_from_base: guess, offsets_deg: robot.control_angle_offsets_deg, own_deg: vec![[0.0; OWN]; shots.len()] };
    let fitting = Fitting { robot, metal: Metal::of(scene, robot)?, start, assumed };
    let mut used: Vec<&Shot> = shots.iter().collect();
    let mut left_out: Vec<LeftOutShot> = Vec::new();
    let leave_out = |used: &mut Vec<&Shot>, left_out: &mut Vec<LeftOutShot>, n: usize, why: String| {
        left_out.push(LeftOutShot { shot: used.remove(n).name.clone(), why });
        if used.len() >= LEAST_SHOTS {
            return Ok(());
        }
        let why = left_out.iter().map(|shot| format!("{}: {}", shot.shot, shot.why)).collect();
        Err(RobotFitError::TooFewShots { found: used.len(), shots: shots.len(), required: LEAST_SHOTS, why })
    };
    if used.len() < LEAST_SHOTS {
        let (found, required) = (used.len(), LEAST_SHOTS);
        return Err(RobotFitError::TooFewShots { found, shots: shots.len(), required, why: Vec::new() });
    }
    let mut contradictory = Vec::new();
    loop {
        let (solution, marks) = fitting.rounds(&used, &|| false)?;
        let unseen =
            marks.iter().map(Vec::len).enumerate().filter(|(_, count)| *count < LEAST_MARKS).min_by_key(|(_, count)| *count);
        if let Some((n, count)) = unseen {
            let why = format!("the robot is not seen in it ({count} profiles with its contrast, {LEAST_MARKS} are needed)");
            leave_out(&mut used, &mut left_out, n, why)?;
            continue;
        }
        let spread = solution.shots.iter().map(|shot| shot.chi2 / shot.degrees_of_freedom.max(1.0));
        let mut spread: Vec<(usize, f64)> = spread.enumerate().collect();
        spread.sort_by(|a, b| b.1.total_cmp(&a.1));
        let others = spread[1..].iter().map(|(_, chi2)| chi2).sum::<f64>() / (spread.len() - 1) as f64;
        let (n, worst) = spread[0];
        if used.len() > LEAST_SHOTS && worst > EXCESS.0 && worst > EXCESS.1 * others {
            contradictory.push(used[n].name.clone());
            if contradictory.len() as f64 > MOST_LEFT_OUT * shots.len() as f64 {
                return Err(RobotFitError::Contradictory { named: contradictory, shots: shots.len() });
            }
            let why = format!("its robot lies {:.1} times as far from the others' as its profiles allow", worst.sqrt());
            leave_out(&mut used, &mut left_out, n, why)?;
            continue;
        }
        return fitting.finish(&used, &solution, &marks, left_out);
    }
}

impl Fitting<'_> {
    /// Searches, then measures and solves in turn; `cancelled` is asked before each.
    pub fn rounds(&self, shots: &[&Shot], cancelled: &dyn Fn() -> bool) -> Result<(Solution, Vec<Vec<Mark>>), RobotFitError> {
        let may_go_on = || if cancelled() { Err(RobotFitError::Cancelled) } else { Ok(()) };
        may_go_on()?;
        let (model, assumed) = (&self.robot.model, self.assumed);
        let start = State { own_deg: vec![[0.0; OWN]; shots.len()], ..self.start.clone() };
        let guess = (assumed.guess_sigma_mm, assumed.guess_sigma_deg);
        let coarse: Vec<Vec<Mark>> =
            shots.par_iter().enumerate().map(|(n, shot)| search(shot, self.robot, &start, n, guess)).collect();
        let mut solution = solve(shots, &coarse, model, &start, &start, assumed)?;
        // Own bends that a coarse search gave are no start for a fine one.
        let mut state = State { own_deg: start.own_deg.clone(), ..solution.state.clone() };
        let mut marks = coarse;
        for (round, reach_mm) in REACHES_MM.into_iter().enumerate() {
            may_go_on()?;
            let measured = |(n, shot): (usize, &&Shot)| match state.posed(model, shot, n) {
                Some(posed) => measure(shot, self.robot, &self.metal, &posed, reach_mm, round >= WITHOUT_END),
                None => Vec::new(),
            };
            marks = shots.par_iter().enumerate().map(measured).collect();
            solution = solve(shots, &marks, model, &state, &start, assumed)?;
            state = solution.state.clone();
        }
        Ok((solution, marks))
    }

    fn finish(
        &self,
        shots: &[&Shot],
        solution: &Solution,
        marks: &[Vec<Mark>],
        left_out: Vec<LeftOutShot>,
    ) -> Result<RobotFit, RobotFitError> {
        let model = &self.robot.model;
        let chi2_per_dof = solution.chi2 / solution.degrees_of_freedom;
        let times = chi2_per_dof.sqrt();
        let scale = chi2_per_dof.max(1.0);
        let covariance = solution.covariance * scale;
        let state = &solution.state;
        let middle = DVec3::new(0.0, 0.0, 0.5 * length_mm(model));
        let beam = |shot: &&Shot| shot.beam_in_carrier((shot.lps_from_carrier * state.carrier_from_base).transform_point(middle));
        let spread_deg = spread_deg(&shots.iter().map(beam).collect::<Vec<_>>());
        let of_base = DMat3::from_cols_array(&std::array::from_fn(|n| covariance[(3 + n / 3, 3 + n % 3)]));
        let depth_sigma_mm = tips::worst_sigma(of_base);
        if !(spread_deg >= LEAST_SPREAD_DEG) {
            return Err(RobotFitError::OneDirection { spread_deg, required_deg: LEAST_SPREAD_DEG, depth_sigma_mm });
        }
        if !(times <= MOST_TIMES) {
            return Err(RobotFitError::Residual { times, limit: MOST_TIMES });
        }
        let sigma = |n: usize| covariance[(n, n)].sqrt();
        self.check_determined(&sigma)?;
        self.check_guess(state)?;
        let seen: Vec<Option<tips::Seen>> =
            shots.iter().enumerate().map(|(n, shot)| tips::tip(model, shot, state, n, &solution.shots[n], scale)).collect();
        let shared_tips = tips::shared(shots, &seen);
        let residuals = solution.shots.iter().zip(marks).map(|(shot, marks)| {
            (shot.rms_px, (shot.chi2 / shot.degrees_of_freedom.max(1.0)).sqrt(), marks.len(), shot.shift_px)
        });
        let place = Some(state.carrier_from_base);
        Ok(RobotFit {
            calibration: RobotCalibration {
                origin: String::new(),
                lps_from_base: place.filter(|_| !self.assumed.tracked),
                marker_from_base: place.filter(|_| self.assumed.tracked),
                control_angle_offsets_deg: state.offsets_deg,
                control_angle_offsets_sigma_deg: std::array::from_fn(|k| sigma(6 + k).to_degrees()),
                base_sigma_mm: std::array::from_fn(|k| sigma(3 + k)),
                base_sigma_deg: std::array::from_fn(|k| sigma(k).to_degrees()),
                covariance: rows(&covariance),
            },
            chi2_per_dof,
            shots: shots.iter().map(|shot| shot.name.clone()).collect(),
            doubts: shots.iter().map(|shot| shot.doubt.clone()).collect(),
            residuals: residuals.collect(),
            tips: seen.iter().map(|seen| seen.as_ref().map(|seen| seen.tip)).collect(),
            shared_tips,
            left_out,
            spread_deg,
            guess: self.start.carrier_from_base,
            own_bends_deg: state.own_deg.clone(),
        })
    }

    fn check_determined(&self, sigma: &dyn Fn(usize) -> f64) -> Result<(), RobotFitError> {
        const TURNS: [&str; 3] =
            ["the base's turn about its x", "the base's turn about its y", "the base's turn about its shaft"];
        const SHIFTS: [&str; 3] =
            ["the base's place along its x", "the base's place along its y", "the base's place along its shaft"];
        let (guess_deg, guess_mm) = (self.assumed.guess_sigma_deg, self.assumed.guess_sigma_mm);
        for (k, (turn, shift)) in TURNS.into_iter().zip(SHIFTS).enumerate() {
            let (deg, mm) = (sigma(k).to_degrees(), sigma(3 + k));
            if !(deg <= UNDETERMINED * guess_deg) {
                return Err(RobotFitError::Undetermined { what: turn, sigma: deg, guess: guess_deg, unit: "degrees" });
            }
            if !(mm <= UNDETERMINED * guess_mm) {
                return Err(RobotFitError::Undetermined { what: shift, sigma: mm, guess: guess_mm, unit: "mm" });
            }
        }
        Ok(())
    }

    fn check_guess(&self, state: &State) -> Result<(), RobotFitError> {
        let (guess, found) = (&self.start.carrier_from_base, &state.carrier_from_base);
        let middle = DVec3::new(0.0, 0.0, 0.5 * length_mm(&self.robot.model));
        let mm = guess.transform_point(middle).distance(found.transform_point(middle));
        let deg = guess.angle_to_rad(found).to_degrees();
        // √3: each standard deviation is that of one direction.
        let times = (mm / self.assumed.guess_sigma_mm).max(deg / self.assumed.guess_sigma_deg) / 3f64.sqrt();
        if !(times <= MOST_FROM_GUESS) {
            return Err(RobotFitError::FarFromGuess { mm, deg, times, limit: MOST_FROM_GUESS });
        }
        Ok(())
    }
}

fn rows(covariance: &SMatrix<f64, 11, 11>) -> [[f64; 11]; 11] {
    std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i, j)]))
}

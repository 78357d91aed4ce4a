//! From shots to a calibration: what is solved, which shots are left out, and how well each is predicted by the others.

use super::parameters::Parameter;
use super::places::agreed;
use super::shot::Shot;
use super::solve::{CameraError, Solution, by_beads, predicted, solve};
use super::spread::{CameraSigmas, camera_sigmas};
use super::{CarmFitError, Sensors};
use crate::geometry::{CarmCalibration, JOINT_KEYS, Rigid};

/// Fewer shots than these say little of a sag.
const LEAST_SHOTS: usize = 4;
/// Fewer beads give no pose to compare with.
const LEAST_BEADS: usize = 4;
/// A parameter whose standard deviation shrinks by less than this share stays at nominal.
pub(super) const UNDETERMINED: f64 = 0.9;
/// A range of angles that tells where the arm turns.
const RANGE_DEG: f64 = 30.0;
/// A shot without which the squares fall by this many times its share does not belong to the others.
const EXCESS: f64 = 10.0;
/// Residuals of so many times what beads and encoders state are explained by no arm.
const MOST_TIMES: f64 = 10.0;
/// Of the shots, as many may be left out.
const MOST_LEFT_OUT: f64 = 0.34;

/// A shot that does not belong to the others.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct LeftOutShot {
    /// Which.
    pub shot: String,
    /// How far the others' prediction is from its beads.
    pub off: CameraError,
}

/// A calibrated arm.
#[derive(Clone, Debug)]
pub struct CarmFit {
    /// The arm, with the uncertainty of its predictions.
    pub calibration: CarmCalibration,
    /// Where the specimen lay in the room.
    pub world_from_lps: Rigid,
    /// What was fitted, with its standard deviation after the fit in its own unit.
    pub parameters: Vec<(Parameter, f64)>,
    /// Σ of squares in standard deviations over its degrees of freedom.
    pub chi2_per_dof: f64,
    /// Names of the shots that the arm rests on, in their order.
    pub shots: Vec<String>,
    /// Of each: √mean(dx² + dy²) of its beads after the fit, px; its readings' offset from the fitted joints, in standard deviations.
    pub residuals: Vec<(f64, f64)>,
    /// Of each: its camera by its readings and the arm that the other shots give, against its beads.
    pub held_out: Vec<CameraError>,
    /// Shots that do not belong to the others.
    pub left_out: Vec<LeftOutShot>,
}

/// Fits an arm to shots.
///
/// # Errors
/// When there are too few shots, a joint is missing, two shots state other places of one bead, the shots do not determine the arm, or too
/// many contradict each other.
pub fn calibrate(shots: &[Shot], nominal: &CarmCalibration, sensors: &Sensors) -> Result<CarmFit, CarmFitError> {
    check(shots, nominal)?;
    let shots = agreed(shots)?;
    let parameters = Parameter::all(nominal.pitch_mm);
    let mut used: Vec<&Shot> = shots.iter().collect();
    let mut left_out: Vec<LeftOutShot> = Vec::new();
    loop {
        let whole = solve(&used, nominal, &parameters, sensors)?;
        check_determined(&used, &parameters, &whole)?;
        let without = |k: usize| {
            let others: Vec<&Shot> = used.iter().enumerate().filter(|(n, _)| *n != k).map(|(_, shot)| *shot).collect();
            solve(&others, nominal, &parameters, sensors)
        };
        let others: Vec<Solution> = (0..used.len()).map(without).collect::<Result<_, CarmFitError>>()?;
        let outside = |(shot, arm): (&&Shot, &Solution)| held_out(shot, arm);
        let held_out: Vec<CameraError> = used.iter().zip(&others).map(outside).collect::<Result<_, CarmFitError>>()?;
        let excess = |k: usize| excess(&whole, &others[k], used[k]);
        let worst = (0..used.len()).max_by(|a, b| excess(*a).total_cmp(&excess(*b))).filter(|k| excess(*k) > EXCESS);
        let Some(worst) = worst else {
            let sigmas = camera_sigmas(&whole, &others, &used, &held_out, &parameters, sensors)?;
            let fit = finish(whole, sigmas, parameters, &used, held_out, left_out);
            // Where half of the shots are wrong none stands out from the others.
            let times = fit.chi2_per_dof.sqrt();
            return if times <= MOST_TIMES { Ok(fit) } else { Err(CarmFitError::Residual { times, limit: MOST_TIMES }) };
        };
        left_out.push(LeftOutShot { shot: used[worst].name.clone(), off: held_out[worst] });
        used.remove(worst);
        if left_out.len() as f64 > MOST_LEFT_OUT * shots.len() as f64 || used.len() < LEAST_SHOTS {
            let named = left_out.into_iter().map(|shot| shot.shot).collect();
            return Err(CarmFitError::Contradictory { named, shots: shots.len() });
        }
    }
}

/// By how many times its share the squares fall without a shot.
fn excess(whole: &Solution, others: &Solution, shot: &Shot) -> f64 {
    let scale = (others.chi2 / others.degrees_of_freedom.max(1) as f64).max(1.0);
    (whole.chi2 - others.chi2) / (2.0 * shot.beads.len() as f64 * scale)
}

fn check(shots: &[Shot], nominal: &CarmCalibration) -> Result<(), CarmFitError> {
    for shot in shots {
        let name = || shot.name.clone();
        let expected = [nominal.columns_px, nominal.rows_px];
        if shot.size_px != expected {
            return Err(CarmFitError::Size { shot: name(), found: shot.size_px, expected });
        }
        if shot.beads.len() < LEAST_BEADS {
            return Err(CarmFitError::TooFewBeads { shot: name(), found: shot.beads.len(), required: LEAST_BEADS });
        }
        let joints = |source| CarmFitError::Joints { shot: name(), source };
        nominal.world_from_camera(&shot.joints).map_err(joints)?;
        nominal.intrinsics(&shot.joints).map_err(joints)?;
    }
    if shots.len() < LEAST_SHOTS {
        return Err(CarmFitError::TooFewShots { found: shots.len(), required: LEAST_SHOTS });
    }
    Ok(())
}

/// Lowest and highest of a joint's readings, in the unit of its key.
fn limits(shots: &[&Shot], joint: usize) -> [f64; 2] {
    let values = shots.iter().map(|shot| shot.joints.to_array()[joint]);
    let limits = values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| [low.min(value), high.max(value)]);
    if JOINT_KEYS[joint].1 { limits.map(f64::to_degrees) } else { limits }
}

/// Range of a joint's readings, in the unit of its key.
fn range(shots: &[&Shot], joint: usize) -> f64 {
    let [low, high] = limits(shots, joint);
    high - low
}

/// Where the arm turns must be known: from one angle, the focal spot's distance to the isocentre and the specimen's place are one.
fn check_determined(shots: &[&Shot], parameters: &[Parameter], whole: &Solution) -> Result<(), CarmFitError> {
    let unknown = || parameters.iter().zip(&whole.sigmas).filter(|(_, sigma)| !(**sigma < UNDETERMINED));
    if unknown().all(|(parameter, _)| parameter.key != "source_to_isocentre_mm") {
        return Ok(());
    }
    let parameters =
        unknown().map(|(parameter, _)| parameter.key.clone()).filter(|key| !key.starts_with("gravity_sag")).collect();
    let (angulation_deg, orbital_deg) = (range(shots, 3), range(shots, 4));
    Err(CarmFitError::OneAngle { orbital_deg, angulation_deg, required_deg: RANGE_DEG, parameters })
}

fn held_out(shot: &Shot, arm: &Solution) -> Result<CameraError, CarmFitError> {
    let (camera, k) = predicted(&arm.calibration, &arm.world_from_lps, &shot.joints)?;
    let seen = by_beads(shot, &k)?;
    let CarmCalibration { source_to_isocentre_mm, pitch_mm, .. } = arm.calibration;
    Ok(CameraError::between((&camera, &k), (&seen, &k), source_to_isocentre_mm, pitch_mm))
}

fn finish(
    whole: Solution,
    sigmas: CameraSigmas,
    parameters: Vec<Parameter>,
    used: &[&Shot],
    held_out: Vec<CameraError>,
    left_out: Vec<LeftOutShot>,
) -> CarmFit {
    let calibration = CarmCalibration {
        camera_sigma_mm: Some(sigmas.mm),
        camera_sigma_deg: Some(sigmas.deg),
        true_camera_sigma_mm: Some(sigmas.true_mm),
        true_camera_sigma_deg: Some(sigmas.true_deg),
        calibrated_angles_deg: Some([limits(used, 4), limits(used, 3)]),
        ..whole.calibration
    };
    let in_unit = |(parameter, sigma): (Parameter, &f64)| {
        let sigma = parameter.prior_sigma * sigma;
        (parameter, sigma)
    };
    CarmFit {
        calibration,
        world_from_lps: whole.world_from_lps,
        parameters: parameters.into_iter().zip(&whole.sigmas).map(in_unit).collect(),
        chi2_per_dof: whole.chi2 / whole.degrees_of_freedom.max(1) as f64,
        shots: used.iter().map(|shot| shot.name.clone()).collect(),
        residuals: whole.shots,
        held_out,
        left_out,
    }
}

//! What a person reads of a calibrated arm: parameters with their standard deviations, residuals by shot, and a plot.

use serde::{Deserialize, Serialize};

use super::Sensors;
use super::fit::{CarmFit, LeftOutShot, UNDETERMINED};
use super::solve::CameraError;
use crate::geometry::{CarmCalibration, Rigid};
use crate::image::plot::{Axis, Plot, PlotError, Scale, Series, Stroke};

/// A fitted number of the calibration file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FittedParameter {
    /// Its key there; the last word is its unit.
    pub key: String,
    /// Before.
    pub nominal: f64,
    /// As fitted.
    pub value: f64,
    /// Standard deviation after the fit.
    pub sigma: f64,
    /// Standard deviation about nominal that was assumed before.
    pub prior_sigma: f64,
    /// The shots say something about it; else it stays near nominal.
    pub determined: bool,
}

/// So many of the standard deviations that were assumed from nominal is far.
const FAR_SIGMAS: f64 = 3.0;

impl FittedParameter {
    /// Whether the shots have moved it to where no arm was expected.
    #[must_use]
    pub fn is_far(&self) -> bool {
        !((self.value - self.nominal).abs() <= FAR_SIGMAS * self.prior_sigma)
    }
}

/// A shot that the arm rests on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShotReport {
    /// Its name.
    pub shot: String,
    /// √mean(dx² + dy²) of its beads after the fit, px.
    pub rms_px: f64,
    /// Its readings against the fitted joints, in standard deviations of the encoders, √mean over joints.
    pub readings_off_sigma: f64,
    /// Its camera, from its readings and the arm of all other shots, against its beads.
    pub held_out: CameraError,
}

/// The report beside a calibration file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CarmReport {
    /// As in the calibration file.
    pub origin: String,
    /// Held-out piercing point on the detector, √mean of squares over shots, mm: the headline.
    pub held_out_piercing_mm: f64,
    /// Held-out direction of the ray through the isocentre, the same, degrees.
    pub held_out_ray_deg: f64,
    /// Squares in standard deviations over degrees of freedom; far above 1 the arm does what the model does not know.
    pub chi2_per_dof: f64,
    /// Encoders as assumed.
    pub sensors: Sensors,
    /// Where the specimen lay in the room.
    pub world_from_lps: Rigid,
    /// Shots used, in their order.
    pub shots: Vec<ShotReport>,
    /// Shots that do not belong to the others.
    pub left_out: Vec<LeftOutShot>,
    /// What was fitted.
    pub parameters: Vec<FittedParameter>,
    /// Software that wrote it.
    pub version: String,
}

impl CarmReport {
    /// Of a fit that started from `nominal`.
    #[must_use]
    pub fn new(fit: &CarmFit, nominal: &CarmCalibration, sensors: &Sensors) -> Self {
        let rms = |of: &dyn Fn(&CameraError) -> f64| {
            let squares: f64 = fit.held_out.iter().map(|error| of(error).powi(2)).sum();
            (squares / fit.held_out.len().max(1) as f64).sqrt()
        };
        let shot = |((name, (rms_px, readings_off_sigma)), held_out): ((&String, &(f64, f64)), &CameraError)| ShotReport {
            shot: name.clone(),
            rms_px: *rms_px,
            readings_off_sigma: *readings_off_sigma,
            held_out: *held_out,
        };
        let parameter = |(parameter, sigma): &(super::Parameter, f64)| FittedParameter {
            key: parameter.key.clone(),
            nominal: parameter.value(nominal),
            value: parameter.value(&fit.calibration),
            sigma: *sigma,
            prior_sigma: parameter.prior_sigma,
            determined: *sigma < UNDETERMINED * parameter.prior_sigma,
        };
        Self {
            origin: fit.calibration.origin.clone(),
            held_out_piercing_mm: rms(&|error| error.piercing_mm),
            held_out_ray_deg: rms(&|error| error.ray_deg),
            chi2_per_dof: fit.chi2_per_dof,
            sensors: *sensors,
            world_from_lps: fit.world_from_lps,
            shots: fit.shots.iter().zip(&fit.residuals).zip(&fit.held_out).map(shot).collect(),
            left_out: fit.left_out.clone(),
            parameters: fit.parameters.iter().map(parameter).collect(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }
}

/// Held-out errors by shot.
///
/// # Errors
/// When no error is finite.
pub fn plot(report: &CarmReport) -> Result<String, PlotError> {
    let series = |label: &str, of: &dyn Fn(&CameraError) -> f64| Series {
        label: label.to_owned(),
        points: (1u32..).zip(&report.shots).map(|(n, shot)| [f64::from(n), of(&shot.held_out)]).collect(),
        stroke: Stroke::Points,
        ..Series::default()
    };
    let drawing = Plot {
        title: "Each shot predicted from its joint readings by the arm of the others".to_owned(),
        x: Axis::new("shot", Scale::Linear),
        y: Axis::new("error / mm, hundredths of a degree", Scale::Linear),
        series: vec![
            series("piercing point on the detector / mm", &|error| error.piercing_mm),
            series("ray through the isocentre / 0.01 degrees", &|error| 100.0 * error.ray_deg),
        ],
        ..Plot::default()
    };
    drawing.svg()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parameter_is_far_beyond_three_of_what_was_assumed_and_when_it_is_no_number() {
        let with = |value: f64| FittedParameter {
            key: "gravity_sag.source_mm[0][1]".to_owned(),
            nominal: 1.0,
            value,
            sigma: 0.1,
            prior_sigma: 5.0,
            determined: true,
        };
        assert_eq!([1.0, 15.9, -13.9, 16.1, f64::NAN].map(|value| with(value).is_far()), [false, false, false, true, true]);
    }
}

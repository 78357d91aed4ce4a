//! What a person reads of a calibrated robot: residuals and tip by shot, and a plot.

use serde::{Deserialize, Serialize};

use super::Assumed;
use super::fit::{LeftOutShot, RobotFit};
use super::tips::{SharedTip, Tip};
use crate::geometry::RobotCalibration;
use crate::image::plot::{Axis, Plot, PlotError, Scale, Series, Stroke};

/// An offset whose standard deviation shrinks by less than this share is not told by the shots.
const UNDETERMINED: f64 = 0.7;

/// A shot that the robot rests on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShotReport {
    /// Its name.
    pub shot: String,
    /// Why its pose is in doubt; absent where it is not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub doubt: Option<String>,
    /// Profiles in which the robot was found.
    pub profiles: usize,
    /// Axis as seen against the fit, √mean of squares across it, px.
    pub rms_px: f64,
    /// The same in standard deviations, the picture's shift included.
    pub rms_sigma: f64,
    /// By how much the robot's picture is shifted against the frame's pose, px.
    pub shift_px: [f64; 2],
    /// The drill's tip, seen minus predicted from readings and offsets: load, friction, encoders.
    pub tip: Option<Tip>,
    /// What that is in bends: five control angles, then across the plane at the first and the last notch, degrees.
    pub own_bend_deg: [f64; 7],
}

/// The report beside a calibration file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotReport {
    /// The file's content.
    pub calibration: RobotCalibration,
    /// Squares in standard deviations over degrees of freedom; the file's standard deviations are scaled by its root where above 1.
    pub chi2_per_dof: f64,
    /// Largest angle between beams at the robot.
    pub directions_deg: f64,
    /// What was believed before.
    pub assumed: Assumed,
    /// How far the base was from its guess, at its origin, mm and degrees.
    pub from_guess_mm: f64,
    /// See `from_guess_mm`.
    pub from_guess_deg: f64,
    /// Control angles, from 1, whose offsets the shots do not tell.
    pub undetermined_offsets: Vec<usize>,
    /// Shots used, in their order.
    pub shots: Vec<ShotReport>,
    /// Tips in space, of shots of one shape from several sides.
    pub shared_tips: Vec<SharedTip>,
    /// Shots on which nothing rests.
    pub left_out: Vec<LeftOutShot>,
    /// Software that wrote it.
    pub version: String,
}

impl RobotReport {
    /// Of a fit.
    #[must_use]
    pub fn new(fit: &RobotFit, assumed: &Assumed) -> Self {
        let calibration = fit.calibration.clone();
        let place = calibration.lps_from_base.or(calibration.marker_from_base).unwrap_or(fit.guess);
        let shot = |n: usize| {
            let (rms_px, rms_sigma, profiles, shift_px) = fit.residuals[n];
            let (shot, doubt) = (fit.shots[n].clone(), fit.doubts[n].clone());
            let (tip, own_bend_deg) = (fit.tips[n], fit.own_bends_deg[n]);
            ShotReport { shot, doubt, profiles, rms_px, rms_sigma, shift_px, tip, own_bend_deg }
        };
        let sigmas = calibration.control_angle_offsets_sigma_deg;
        let open = |k: &usize| !(sigmas[*k - 1] <= UNDETERMINED * assumed.offset_sigma_deg);
        Self {
            chi2_per_dof: fit.chi2_per_dof,
            directions_deg: fit.spread_deg,
            assumed: *assumed,
            from_guess_mm: place.translation_mm.distance(fit.guess.translation_mm),
            from_guess_deg: place.angle_to_rad(&fit.guess).to_degrees(),
            undetermined_offsets: (1..=sigmas.len()).filter(open).collect(),
            shots: (0..fit.shots.len()).map(shot).collect(),
            shared_tips: fit.shared_tips.clone(),
            left_out: fit.left_out.clone(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            calibration,
        }
    }
}

/// Tips by shot.
///
/// # Errors
/// When no tip is finite.
pub fn plot(report: &RobotReport) -> Result<String, PlotError> {
    let series = |label: &str, of: &dyn Fn(&Tip) -> f64| Series {
        label: label.to_owned(),
        points: (1u32..).zip(&report.shots).filter_map(|(n, shot)| Some([f64::from(n), of(shot.tip.as_ref()?)])).collect(),
        stroke: Stroke::Points,
        ..Series::default()
    };
    let drawing = Plot {
        title: "The drill's tip against readings and offsets, in the plane of each frame".to_owned(),
        x: Axis::new("shot", Scale::Linear),
        y: Axis::new("discrepancy / mm", Scale::Linear),
        series: vec![series("length", &|tip| tip.length_mm), series("its standard deviation", &|tip| tip.length_sigma_mm)],
        ..Plot::default()
    };
    drawing.svg()
}

//! Where a robot's base is and by how much its control angles are read wrong: what `calibrate robot` measures, and scenes take.

use serde::{Deserialize, Serialize};

use super::Rigid;
use super::robot::CONTROL_COUNT;

/// Unknowns of a calibrated robot: three turns and three shifts of the base, then the offsets.
const UNKNOWNS: usize = 6 + CONTROL_COUNT;

/// A calibration is of one robot in one mount; larger offsets are another robot's, or radians.
const MOST_OFFSET_DEG: f64 = 45.0;

/// Why a robot's calibration is unusable.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RobotCalibrationError {
    /// None of the two places, or both.
    #[error("a robot's calibration gives lps_from_base or marker_from_base, one of the two; found {found}")]
    Place {
        /// How many.
        found: usize,
    },
    /// An offset that is none.
    #[error("control_angle_offsets_deg[{index}] is {value_deg}, expected at most {MOST_OFFSET_DEG} either way")]
    Offset {
        /// Which of the five.
        index: usize,
        /// Value found.
        value_deg: f64,
    },
}

/// A file that `calibrate robot` writes; a scene's robot object names it as `calibration`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotCalibration {
    /// Who measured it, when, from what.
    pub origin: String,
    /// The base in the specimen, of a robot that nobody tracks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lps_from_base: Option<Rigid>,
    /// The base in the frame that the tracker reports as the base: the reported `tracker_from_base` times this is where the base is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub marker_from_base: Option<Rigid>,
    /// What is added to the angles that the robot reports.
    pub control_angle_offsets_deg: [f64; CONTROL_COUNT],
    /// Standard deviations.
    pub control_angle_offsets_sigma_deg: [f64; CONTROL_COUNT],
    /// Standard deviation of the base's origin along its own x, y, z.
    pub base_sigma_mm: [f64; 3],
    /// Of turns about them.
    pub base_sigma_deg: [f64; 3],
    /// Of (ω, v, offsets): base_true = base · exp(ξ̂) with ξ = (ω, v) in the base's own axes, rad and mm; offsets in rad.
    pub covariance: [[f64; UNKNOWNS]; UNKNOWNS],
}

impl RobotCalibration {
    /// Checks what JSON cannot.
    ///
    /// # Errors
    /// When it says not exactly one place of the base, or an offset is no offset.
    pub fn check(&self) -> Result<(), RobotCalibrationError> {
        let found = usize::from(self.lps_from_base.is_some()) + usize::from(self.marker_from_base.is_some());
        if found != 1 {
            return Err(RobotCalibrationError::Place { found });
        }
        let wrong = self.control_angle_offsets_deg.iter().position(|offset| !(offset.abs() <= MOST_OFFSET_DEG));
        match wrong {
            Some(index) => Err(RobotCalibrationError::Offset { index, value_deg: self.control_angle_offsets_deg[index] }),
            None => Ok(()),
        }
    }
}

//! A C-arm from a few bead shots: offsets, source–isocentre, detector, axes and gravity sag, by bundle adjustment with the joint readings
//! as observations.
//!
//! Unknown are the arm ([`Parameter`], each with a weak prior about nominal), the specimen's place in the room, the true joints of every
//! shot (their readings are observations) and the bead places (the CT's are observations). Observed are the beads' images. What the shots
//! cannot tell stays at nominal, with a standard deviation that says so. The figure to believe is that of each shot predicted, from its
//! joint readings alone, by the arm that the other shots give. The beads of that shot are seen through the arm's own K; how far K's error
//! takes the camera from the true one only the covariance of what was fitted tells, and it is stated beside.

mod parameters;
mod shot;
mod places;
mod shots_of;
mod solve;
mod spread;
mod fit;
mod report;

pub use fit::{CarmFit, LeftOutShot, calibrate};
pub use parameters::Parameter;
pub use report::{CarmReport, FittedParameter, ShotReport, plot};
pub use shot::{Shot, ShotBead};
pub use shots_of::{NoShot, shots_of_log};
pub use solve::CameraError;

use crate::estimate::EstimateError;
use crate::geometry::CarmCalibrationError;

/// How well the encoders tell the joints, one standard deviation.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Sensors {
    /// Of wig-wag, angulation, orbital angle and detector rotation.
    pub sigma_deg: f64,
    /// Of lift and longitudinal travel.
    pub sigma_mm: f64,
}

impl Default for Sensors {
    /// Sensors of a mobile C-arm: ±0.2°, half a millimetre.
    fn default() -> Self {
        Self { sigma_deg: 0.1, sigma_mm: 0.5 }
    }
}

impl Sensors {
    /// In the order of the joints that move the camera, mm and rad.
    fn sigmas(&self) -> [f64; 6] {
        let (mm, rad) = (self.sigma_mm, self.sigma_deg.to_radians());
        [mm, rad, mm, rad, rad, rad]
    }
}

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum CarmFitError {
    /// Too few shots.
    #[error("{found} usable shots, an arm needs at least {required}: take more, spread over the orbit and the angulation")]
    TooFewShots {
        /// How many there are.
        found: usize,
        /// How many are needed.
        required: usize,
    },
    /// A shot has too few beads.
    #[error("shot {shot}: {found} used beads, a shot needs at least {required}")]
    TooFewBeads {
        /// Which.
        shot: String,
        /// How many it has.
        found: usize,
        /// How many are needed.
        required: usize,
    },
    /// Joints without a camera.
    #[error("shot {shot}: {source}")]
    Joints {
        /// Which.
        shot: String,
        /// What is missing.
        source: CarmCalibrationError,
    },
    /// A shot of another panel or another binning.
    #[error(
        "shot {shot} is {} x {} px, the nominal calibration is for {} x {}: give that of this frame size",
        found[0], found[1], expected[0], expected[1]
    )]
    Size {
        /// Which.
        shot: String,
        /// Its columns and rows.
        found: [u32; 2],
        /// Those of the calibration.
        expected: [u32; 2],
    },
    /// Two shots state places of one bead that are not one.
    #[error(
        "bead {bead}: shots {} and {} state places {distance_mm:.2} mm apart, {sigmas:.1} standard deviations of both (limit {limit:.1}): \
         register all shots on one layout of one scan, or state the beads' sigma_mm",
        shots[0], shots[1]
    )]
    OtherPlace {
        /// Which.
        bead: String,
        /// Names of the two.
        shots: [String; 2],
        /// Between the places.
        distance_mm: f64,
        /// The same in standard deviations of both (three degrees of freedom).
        sigmas: f64,
        /// Most that is taken for one place.
        limit: f64,
    },
    /// All shots from one side.
    #[error(
        "the shots cannot tell where the arm turns: the orbital angle spans {orbital_deg:.1} degrees, the angulation {angulation_deg:.1}; not \
         determined are {}; spread the shots over at least {required_deg:.0} degrees",
        parameters.join(", ")
    )]
    OneAngle {
        /// Range of the orbital readings.
        orbital_deg: f64,
        /// Range of the angulation readings.
        angulation_deg: f64,
        /// What would do.
        required_deg: f64,
        /// Keys of what stays unknown.
        parameters: Vec<String>,
    },
    /// Too many shots disagree with the others.
    #[error(
        "{} of {shots} shots do not agree with the others ({}): their joints or poses are wrong, or the specimen was moved between the shots",
        named.len(), named.join(", ")
    )]
    Contradictory {
        /// Names of the shots.
        named: Vec<String>,
        /// All shots.
        shots: usize,
    },
    /// No arm explains the shots.
    #[error(
        "the shots agree only to {times:.0} times what beads and encoders allow (limit {limit:.0}): are their joints those of their exposures, did \
         the specimen lie still, and is the nominal arm the right one?"
    )]
    Residual {
        /// Root of the mean square residual in standard deviations.
        times: f64,
        /// Most that is believed.
        limit: f64,
    },
    /// A prediction needs what is not there.
    #[error(transparent)]
    Chain(#[from] CarmCalibrationError),
    /// The least-squares problem has no solution.
    #[error(transparent)]
    Estimate(#[from] EstimateError),
}

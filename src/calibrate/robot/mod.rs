//! Where the robot's base is, and by how much its control angles are read wrong, from frames in which the robot is seen.
//!
//! Unknown are the base (in the specimen, or in the frame of a tracker's marker) and five control-angle offsets, which all shots share,
//! and of each shot its own bend and a shift of its picture: readings and poses have errors, and load bends the robot. The own bends have a
//! narrow prior that gives way to gross ones, so that a loaded shot says so and does not pull the others. Observed is the robot's shadow: at
//! stations along the axis the frame's profile is laid over the one that the model casts there ([`measure`]), after a coarse search
//! ([`search`]); prediction, measurement and fit go round until they agree. What readings and offsets do not explain at the drill's tip is its
//! discrepancy, in the plane of the image in mm; where shots of one shape look from two sides, in space.

mod shot;
mod metal;
mod chain;
mod profile;
mod measure;
mod search;
mod solve;
mod tips;
mod fit;
mod in_frame;
mod report;
mod shots_of;

pub use fit::{LeftOutShot, RobotFit, calibrate};
pub use in_frame::{SeenRobot, SeenTip, tip_in_frame};
pub use report::{RobotReport, ShotReport, plot};
pub use shot::{NoShot, Shot};
pub use shots_of::{LoggedShot, shots_of_log};
pub use tips::{SharedTip, Tip};

use crate::estimate::EstimateError;
use crate::scene::physics::PhysicsError;

/// What is believed before any shot is seen; standard deviations.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Assumed {
    /// Of the guessed base, in each direction.
    pub guess_sigma_mm: f64,
    /// Of its turn about each axis.
    pub guess_sigma_deg: f64,
    /// Of control-angle offsets.
    pub offset_sigma_deg: f64,
    /// Of a control angle's reading from shot to shot.
    pub reading_sigma_deg: f64,
    /// The base is carried by a tracked marker, and not by the specimen.
    pub tracked: bool,
}

impl Default for Assumed {
    fn default() -> Self {
        Self { guess_sigma_mm: 10.0, guess_sigma_deg: 5.0, offset_sigma_deg: 2.0, reading_sigma_deg: 0.05, tracked: false }
    }
}

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum RobotFitError {
    /// The scene has none.
    #[error("the scene has no robot object: add {{\"robot\": …}} with the model and a rough lps_from_base")]
    NoRobot,
    /// Somebody cancelled.
    #[error("looking for the robot was cancelled")]
    Cancelled,
    /// Too few shots.
    #[error(
        "the robot is seen in {found} of {shots} shots, {required} are needed{}",
        if why.is_empty() { String::new() } else { format!(": {}", why.join("; ")) }
    )]
    TooFewShots {
        /// In how many it is seen.
        found: usize,
        /// All of them.
        shots: usize,
        /// How many are needed.
        required: usize,
        /// What was wrong with the others.
        why: Vec<String>,
    },
    /// All shots look from one side.
    #[error(
        "the shots see the robot from one direction (within {spread_deg:.1} degrees, at least {required_deg:.0} are needed): along the beam its \
         base is known to ± {depth_sigma_mm:.1} mm only; take a shot from another side"
    )]
    OneDirection {
        /// Largest angle between beams at the robot.
        spread_deg: f64,
        /// What would do.
        required_deg: f64,
        /// Standard deviation of the base in the direction known worst.
        depth_sigma_mm: f64,
    },
    /// Something about the base stays as it was guessed.
    #[error(
        "the shots do not tell {what}: ± {sigma:.1} {unit} after them, ± {guess:.1} {unit} before; a robot that is straight in all shots can be \
         turned about its shaft without being seen to: bend it"
    )]
    Undetermined {
        /// Which direction.
        what: &'static str,
        /// Afterwards.
        sigma: f64,
        /// Before.
        guess: f64,
        /// mm or degrees.
        unit: &'static str,
    },
    /// Too many shots disagree with the others.
    #[error(
        "{} of {shots} shots do not agree with the others ({}): their poses or control angles are wrong, or the base moved between the shots",
        named.len(), named.join(", ")
    )]
    Contradictory {
        /// Names of the shots.
        named: Vec<String>,
        /// All shots.
        shots: usize,
    },
    /// No robot explains the shots.
    #[error(
        "the shots agree only to {times:.1} times what their profiles allow (limit {limit:.0}): did the base stay where it was, are the control \
         angles those of the exposures, and is the model this robot's?"
    )]
    Residual {
        /// Root of the mean square residual in standard deviations.
        times: f64,
        /// Most that is believed.
        limit: f64,
    },
    /// The robot was found far from the guess.
    #[error(
        "the base was found {mm:.1} mm and {deg:.1} degrees from the guess, which is {times:.1} times what was said of it (limit {limit:.0}): give a \
         better lps_from_base in the scene, or say how rough it is"
    )]
    FarFromGuess {
        /// Distance at the robot's middle.
        mm: f64,
        /// Turn.
        deg: f64,
        /// In standard deviations.
        times: f64,
        /// Most that is believed.
        limit: f64,
    },
    /// Attenuation of the robot's metals.
    #[error(transparent)]
    Physics(#[from] PhysicsError),
    /// The least-squares problem has no solution.
    #[error(transparent)]
    Estimate(#[from] EstimateError),
}

//! Devices that say odd things in packets that are well formed: what a receiver has to notice by itself.

use crate::wire::{CarmMessage, RobotMessage};

/// What is odd, throughout unless said otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Oddity {
    /// The arm reports an emergency stop and a bit that the protocol does not know.
    CarmStopped,
    /// The arm reports 0.3 mm of copper in the beam.
    Copper,
    /// The arm tells the distance from focal spot to detector in metres.
    SidInMetres,
    /// The robot reports that it is homing.
    RobotHoming,
    /// The robot's base is tracked.
    Tracked,
    /// The robot's base is tracked during the first fifth.
    TrackedAtFirst,
    /// The robot's angles are sensed during the first fifth.
    SensedAtFirst,
    /// The robot is commanded 3 degrees more than it goes.
    Apart,
    /// The robot sways by a few degrees a second.
    Swaying,
}

/// Where [`Oddity::Tracked`] has the base: millimetres, and a unit quaternion.
const TRACKED: ([f64; 3], [f64; 4]) = ([100.5, -20.25, 1500.0], [0.0, 0.0, 0.0, 1.0]);
/// Of [`Oddity::Apart`].
const APART_DEG: f32 = 3.0;
/// What is so at first only ends after this share of the session: between the second of the lab's exposures and the third.
const AT_FIRST: f64 = 0.22;
/// Of [`Oddity::Swaying`]: up and down once in this time, by this much either way.
const SWAY_S: f64 = 4.0;
const SWAY_DEG: f64 = 4.0;

impl Oddity {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::CarmStopped,
        Self::Copper,
        Self::SidInMetres,
        Self::RobotHoming,
        Self::Tracked,
        Self::TrackedAtFirst,
        Self::SensedAtFirst,
        Self::Apart,
        Self::Swaying,
    ];

    /// Its name on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::CarmStopped => "carm-stopped",
            Self::Copper => "copper",
            Self::SidInMetres => "sid-in-metres",
            Self::RobotHoming => "robot-homing",
            Self::Tracked => "tracked",
            Self::TrackedAtFirst => "tracked-at-first",
            Self::SensedAtFirst => "sensed-at-first",
            Self::Apart => "apart",
            Self::Swaying => "swaying",
        }
    }

    /// Changes what the arm says.
    pub fn befall_carm(self, message: &mut CarmMessage) {
        match self {
            Self::CarmStopped => message.status |= 0b10_0010,
            Self::Copper => message.filter_mm[1] = 0.3,
            Self::SidInMetres => message.joints[6] *= 1e-3,
            _ => {}
        }
    }

    /// Changes what the robot says `at_s`, at this `share` of the session.
    pub fn befall_robot(self, at_s: f64, share: f64, message: &mut RobotMessage) {
        match self {
            Self::RobotHoming => message.status |= 0b100,
            Self::Tracked => message.tracker_from_base = Some(TRACKED),
            Self::TrackedAtFirst => message.tracker_from_base = Some(TRACKED).filter(|_| share < AT_FIRST),
            Self::SensedAtFirst => message.sensed_deg = message.sensed_deg.filter(|_| share < AT_FIRST),
            Self::Apart => message.commanded_deg = message.commanded_deg.map(|angle| angle + APART_DEG),
            Self::Swaying => {
                let phase = (at_s / SWAY_S).rem_euclid(1.0);
                let sway_deg = (SWAY_DEG * (4.0 * (phase - 0.5).abs() - 1.0)) as f32;
                message.commanded_deg = message.commanded_deg.map(|angle| angle + sway_deg);
                message.sensed_deg = message.sensed_deg.map(|angles| angles.map(|angle| angle + sway_deg));
            }
            _ => {}
        }
    }
}

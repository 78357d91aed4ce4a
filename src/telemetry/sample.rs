//! What devices say, in the units of the program: radians inside; NaN or `None` where something was not measured.

use serde::Serialize;

use super::device::DeviceKind;
use crate::geometry::{CarmJoints, Rigid};

/// A message of the C-arm.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CarmSample {
    /// Device time since an arbitrary start.
    pub device_us: u64,
    /// Counts all frames of the device.
    pub sequence: u32,
    /// Joints; NaN where there is no encoder.
    pub joints: CarmJoints,
    /// Tube voltage.
    pub tube_kvp: f64,
    /// Tube current.
    pub tube_ma: f64,
    /// X-ray pulse.
    pub pulse_width_ms: f64,
    /// Added filter, as aluminium.
    pub filter_mm_al: f64,
    /// Added filter, as copper.
    pub filter_mm_cu: f64,
    /// Collimated field at the detector: left, top, right, bottom from the panel's middle.
    pub field_mm: [f64; 4],
    /// Beam on.
    pub xray_on: bool,
    /// Counts exposures.
    pub exposure_counter: Option<u32>,
    /// Status bits of the device.
    pub status: u32,
}

impl CarmSample {
    /// The first message of a dark arm that tells nothing: its joints are zero.
    pub const UNTOLD: Self = Self {
        device_us: 0,
        sequence: 0,
        joints: CarmJoints::ZERO,
        tube_kvp: f64::NAN,
        tube_ma: f64::NAN,
        pulse_width_ms: f64::NAN,
        filter_mm_al: f64::NAN,
        filter_mm_cu: f64::NAN,
        field_mm: [f64::NAN; 4],
        xray_on: false,
        exposure_counter: None,
        status: 0,
    };
}

/// Where control angles come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum AngleSource {
    /// Measured.
    Sensed,
    /// What the robot's controller asked for.
    Commanded,
}

/// One of the robot's two tendons.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Tendon {
    /// Pulled length.
    pub position_mm: f64,
    /// Its rate.
    pub velocity_mm_per_s: f64,
    /// Pull.
    pub tension_n: f64,
    /// Motor current.
    pub current_a: f64,
}

/// A message of the robot.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RobotSample {
    /// Device time since an arbitrary start.
    pub device_us: u64,
    /// Counts all frames of the device.
    pub sequence: u32,
    /// Five control angles asked for, degrees.
    pub commanded_deg: [f64; 5],
    /// Five control angles measured, degrees.
    pub sensed_deg: Option<[f64; 5]>,
    /// Both tendons.
    pub tendons: [Tendon; 2],
    /// Tracked base, if there is a tracker and it sees the robot.
    pub tracker_from_base: Option<Rigid>,
    /// Drill speed.
    pub drill_rpm: f64,
    /// Status bits of the device.
    pub status: u32,
}

impl RobotSample {
    /// The control angles to be used, degrees: sensed where all five are measured, else commanded.
    #[must_use]
    pub fn control_angles_deg(&self) -> ([f64; 5], AngleSource) {
        match self.sensed_deg.filter(|angles| angles.iter().all(|angle| angle.is_finite())) {
            Some(sensed_deg) => (sensed_deg, AngleSource::Sensed),
            None => (self.commanded_deg, AngleSource::Commanded),
        }
    }

    /// Where sensed and commanded angles differ most: the control point, from 0, and sensed minus commanded in degrees. `None` where not
    /// all of both are known.
    #[must_use]
    pub fn sensed_from_commanded_deg(&self) -> Option<(usize, f64)> {
        let sensed_deg = self.sensed_deg?;
        let apart_deg: [f64; 5] = std::array::from_fn(|point| sensed_deg[point] - self.commanded_deg[point]);
        let largest = apart_deg.into_iter().enumerate().max_by(|(_, a), (_, b)| a.abs().total_cmp(&b.abs()));
        largest.filter(|_| apart_deg.iter().all(|apart| apart.is_finite()))
    }
}

/// Range of a joint, in the unit of the wire (mm, deg).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Limit {
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
}

/// What a device says of itself, once a second.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Metadata {
    /// Device time since an arbitrary start.
    pub device_us: u64,
    /// Counts all frames of the device.
    pub sequence: u32,
    /// Of whom.
    pub device: DeviceKind,
    /// Hash of the schema that it follows.
    pub schema: u32,
    /// Serial number.
    pub serial_number: String,
    /// Firmware version.
    pub firmware: String,
    /// Which calibration file belongs to it.
    pub calibration_id: String,
    /// Units of the wire, as the device states them.
    pub units: String,
    /// Ranges of the control points, or of the joints lift … source to detector.
    pub limits: Vec<Limit>,
}

impl Metadata {
    /// One line for people.
    #[must_use]
    pub fn summary(&self) -> String {
        format!("serial {}, firmware {}, calibration {}", self.serial_number, self.firmware, self.calibration_id)
    }
}

/// Any message.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case", tag = "message")]
pub enum Sample {
    /// From the C-arm.
    Carm(CarmSample),
    /// From the robot.
    Robot(RobotSample),
    /// From either.
    Metadata(Metadata),
}

impl Sample {
    /// Sequence number of its frame.
    #[must_use]
    pub fn sequence(&self) -> u32 {
        match self {
            Self::Carm(sample) => sample.sequence,
            Self::Robot(sample) => sample.sequence,
            Self::Metadata(metadata) => metadata.sequence,
        }
    }

    /// Device time of its frame.
    #[must_use]
    pub fn device_us(&self) -> u64 {
        match self {
            Self::Carm(sample) => sample.device_us,
            Self::Robot(sample) => sample.device_us,
            Self::Metadata(metadata) => metadata.device_us,
        }
    }

    /// Whose it is, where the message says so.
    #[must_use]
    pub fn device(&self) -> Option<DeviceKind> {
        match self {
            Self::Carm(_) => Some(DeviceKind::Carm),
            Self::Robot(_) => Some(DeviceKind::Robot),
            Self::Metadata(metadata) => Some(metadata.device),
        }
    }
}

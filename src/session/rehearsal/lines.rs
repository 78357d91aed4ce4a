//! What the devices send while a rehearsed exposure is taken, as bytes on their lines.

use std::ops::Range;

use crate::geometry::CarmJoints;
use crate::session::file::Setup;
use crate::session::input::Input;
use crate::telemetry::{CarmSample, DeviceKind, RobotSample, Tendon, carm_packet, robot_packet};

/// From the first packet to the last, and from one to the next.
const LENGTH_US: i64 = 2_000_000;
const STEP_US: i64 = 20_000;
/// When the beam is on, from the first packet.
const BEAM_US: Range<i64> = 800_000..1_100_000;
/// When the frame is there.
const FRAME_US: i64 = 1_400_000;
/// What the arm's exposure counter says of it.
pub(super) const COUNTER: u32 = 8;

/// What is told of the exposure.
pub(super) struct Told {
    /// Of an arm.
    pub joints: CarmJoints,
    /// Of its tube, if the scene has one.
    pub kvp: Option<f64>,
    /// Of a robot.
    pub control_angles_deg: [f64; 5],
    /// Host time of the first packet.
    pub begun_us: i64,
}

impl Told {
    /// Host time at which the frame is there.
    pub(super) fn frame_us(&self) -> i64 {
        self.begun_us + FRAME_US
    }

    /// Host time after the last packet.
    pub(super) fn ended_us(&self) -> i64 {
        self.begun_us + LENGTH_US + STEP_US
    }

    /// The bytes of every device of the session that sends packets, in their order.
    pub(super) fn inputs(&self, setup: &Setup) -> Vec<Input> {
        let mut inputs = Vec::new();
        for (sequence, us) in (0u32..).zip((0..LENGTH_US).step_by(STEP_US as usize)) {
            for device in setup.devices().filter(|device| sends_packets(setup, *device)) {
                let bytes = match device {
                    DeviceKind::Carm => carm_packet(&self.carm(sequence, us)),
                    DeviceKind::Robot => robot_packet(&self.robot(sequence, us)),
                };
                inputs.push(Input::Bytes { device, epoch: 0, host_us: self.begun_us + us, bytes });
            }
        }
        inputs
    }

    fn carm(&self, sequence: u32, us: i64) -> CarmSample {
        CarmSample {
            device_us: us.unsigned_abs(),
            sequence,
            joints: self.joints,
            tube_kvp: self.kvp.unwrap_or(f64::NAN),
            xray_on: BEAM_US.contains(&us),
            exposure_counter: Some(if us < BEAM_US.start { COUNTER - 1 } else { COUNTER }),
            ..CarmSample::UNTOLD
        }
    }

    fn robot(&self, sequence: u32, us: i64) -> RobotSample {
        let slack = Tendon { position_mm: f64::NAN, velocity_mm_per_s: f64::NAN, tension_n: f64::NAN, current_a: f64::NAN };
        RobotSample {
            device_us: us.unsigned_abs(),
            sequence,
            commanded_deg: self.control_angles_deg,
            sensed_deg: Some(self.control_angles_deg),
            tendons: [slack; 2],
            tracker_from_base: None,
            drill_rpm: f64::NAN,
            status: 0,
        }
    }
}

/// Lines of text are as each device declares them, and are not made up here.
pub(super) fn sends_packets(setup: &Setup, device: DeviceKind) -> bool {
    setup.adapters.of(device).is_none()
}

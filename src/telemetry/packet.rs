//! Packets as devices send them, for rehearsals of a session: what [`super::Decoder`] reads back. They go into this program's own decoder and
//! to no device.

use super::sample::{CarmSample, RobotSample};
use super::wire::{CARM, NO_COUNTER, ROBOT, SCHEMA_HASH, VERSION, seeded_crc};
use crate::geometry::Rigid;

/// A packet of the C-arm with its delimiter.
#[must_use]
pub fn carm_packet(sample: &CarmSample) -> Vec<u8> {
    let mut packet = Packet::new(CARM, u16::from(sample.xray_on), sample.sequence, sample.device_us);
    let joints = &sample.joints;
    let [angulation_deg, orbital_deg, detector_rotation_deg] =
        [joints.angulation_rad, joints.orbital_rad, joints.detector_rotation_rad].map(f64::to_degrees);
    packet.f64s([joints.lift_mm, joints.wig_wag_rad.to_degrees(), joints.longitudinal_mm]);
    packet.f64s([angulation_deg, orbital_deg, detector_rotation_deg, joints.source_to_detector_mm]);
    packet.f32s([sample.tube_kvp, sample.tube_ma, sample.pulse_width_ms, sample.filter_mm_al, sample.filter_mm_cu]);
    packet.f32s(sample.field_mm);
    packet.u32s([sample.exposure_counter.unwrap_or(NO_COUNTER), sample.status]);
    packet.sealed()
}

/// A packet of the robot with its delimiter.
#[must_use]
pub fn robot_packet(sample: &RobotSample) -> Vec<u8> {
    let flags = u16::from(sample.sensed_deg.is_some()) | u16::from(sample.tracker_from_base.is_some()) << 1;
    let mut packet = Packet::new(ROBOT, flags, sample.sequence, sample.device_us);
    packet.f32s(sample.commanded_deg);
    packet.f32s(sample.sensed_deg.unwrap_or([f64::NAN; 5]));
    for tendon in &sample.tendons {
        packet.f32s([tendon.position_mm, tendon.velocity_mm_per_s, tendon.tension_n, tendon.current_a]);
    }
    let Rigid { rotation, translation_mm } = sample.tracker_from_base.unwrap_or(Rigid::IDENTITY);
    packet.f64s(translation_mm.to_array());
    packet.f64s(rotation.to_array());
    packet.f32s([sample.drill_rpm]);
    packet.u32s([sample.status]);
    packet.sealed()
}

/// Header and fields, little-endian.
struct Packet(Vec<u8>);

impl Packet {
    fn new(id: u8, flags: u16, sequence: u32, device_us: u64) -> Self {
        let mut bytes = vec![VERSION, id];
        bytes.extend(flags.to_le_bytes());
        bytes.extend(sequence.to_le_bytes());
        bytes.extend(device_us.to_le_bytes());
        Self(bytes)
    }

    fn f64s<const N: usize>(&mut self, values: [f64; N]) {
        self.0.extend(values.into_iter().flat_map(f64::to_le_bytes));
    }

    fn f32s<const N: usize>(&mut self, values: [f64; N]) {
        self.0.extend(values.into_iter().flat_map(|value| (value as f32).to_le_bytes()));
    }

    fn u32s<const N: usize>(&mut self, values: [u32; N]) {
        self.0.extend(values.into_iter().flat_map(u32::to_le_bytes));
    }

    /// With its checksum, stuffed, and the delimiter.
    fn sealed(mut self) -> Vec<u8> {
        let crc = seeded_crc(SCHEMA_HASH, &self.0);
        self.0.extend(crc.to_le_bytes());
        let mut stuffed = cobs::encode_vec(&self.0);
        stuffed.push(0);
        stuffed
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::super::sample::Tendon;
    use super::super::{Decoder, DeviceKind, Event, Sample};
    use super::*;
    use crate::geometry::CarmJoints;

    fn decoded(device: DeviceKind, bytes: &[u8]) -> Vec<Event> {
        let (mut decoder, mut events) = (Decoder::new(device), Vec::new());
        decoder.push(bytes, &mut |event| events.push(event));
        events
    }

    #[test]
    fn packets_come_back_as_they_were_told() {
        let carm = CarmSample {
            device_us: 5_000_000_007,
            sequence: 41,
            joints: CarmJoints::from_array([1.5, 0.25, -3.0, 0.5, -0.75, 0.125, 1020.0]),
            tube_kvp: 90.0,
            tube_ma: 3.5,
            pulse_width_ms: 8.0,
            filter_mm_al: 4.25,
            filter_mm_cu: 0.5,
            field_mm: [-60.0, -50.0, 60.0, 50.5],
            xray_on: true,
            exposure_counter: Some(7),
            status: 3,
        };
        let events = decoded(DeviceKind::Carm, &carm_packet(&carm));
        let [Event::Sample(Sample::Carm(read), _)] = &events[..] else { panic!("{events:?}") };
        let apart = |a: &CarmJoints, b: &CarmJoints| {
            a.to_array().iter().zip(b.to_array()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        assert!(apart(&read.joints, &carm.joints) < 1e-12, "{read:?}");
        assert_eq!(*read, CarmSample { joints: read.joints, ..carm.clone() });
        // Without a counter, and dark.
        let dark = CarmSample { xray_on: false, exposure_counter: None, tube_kvp: f64::NAN, ..carm };
        let events = decoded(DeviceKind::Carm, &carm_packet(&dark));
        let [Event::Sample(Sample::Carm(read), _)] = &events[..] else { panic!("{events:?}") };
        assert!(!read.xray_on && read.exposure_counter.is_none() && read.tube_kvp.is_nan(), "{read:?}");

        let tendon = Tendon { position_mm: 1.0, velocity_mm_per_s: 2.0, tension_n: 3.0, current_a: 0.5 };
        let base = Rigid { rotation: DQuat::from_rotation_x(0.5), translation_mm: DVec3::new(1.0, 2.0, 3.0) };
        let robot = RobotSample {
            device_us: 9,
            sequence: 2,
            commanded_deg: [1.0, -2.0, 3.0, -4.0, 5.0],
            sensed_deg: Some([0.5, 0.25, 0.125, 0.0, -0.5]),
            tendons: [tendon, Tendon { current_a: 0.25, ..tendon }],
            tracker_from_base: Some(base),
            drill_rpm: 1000.0,
            status: 4,
        };
        let events = decoded(DeviceKind::Robot, &robot_packet(&robot));
        let [Event::Sample(Sample::Robot(read), _)] = &events[..] else { panic!("{events:?}") };
        let seen = read.tracker_from_base.expect("tracked");
        assert!(seen.angle_to_rad(&base) < 1e-9 && seen.translation_mm == base.translation_mm, "{seen:?}");
        assert_eq!(*read, RobotSample { tracker_from_base: Some(seen), ..robot.clone() });
        let untracked = RobotSample { tracker_from_base: None, sensed_deg: None, ..robot };
        let events = decoded(DeviceKind::Robot, &robot_packet(&untracked));
        assert!(matches!(&events[..], [Event::Sample(Sample::Robot(read), _)] if *read == untracked), "{events:?}");
    }
}

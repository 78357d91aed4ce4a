//! Numbers that no device should send: whatever arrives with a valid checksum, nothing overflows, nothing is NaN that was measured, and the
//! program goes on.

use proptest::prelude::*;
use sidecarm::geometry::CarmJoints;
use sidecarm::telemetry::{CarmSample, DeviceKind, Sample, SequenceTracker, Sequenced};
use sidecarm::timeline::{Binder, ClockMap, DeviceClock, FrameEvidence};

use crate::timeline_joints::{Fed, T0_US, carm_sample, robot};

/// Ordinary, small, huge, and the edges in between.
fn device_us() -> impl Strategy<Value = u64> {
    prop_oneof![
        4 => 0u64..100_000_000,
        1 => any::<u64>(),
        1 => (0u32..64).prop_map(|bit| 1u64 << bit),
        1 => (0u64..64).prop_map(|steps| steps << 57),
        1 => Just(u64::MAX),
        1 => (1u64 << 53) - 3..(1u64 << 53) + 3,
    ]
}

fn host_us() -> impl Strategy<Value = i64> {
    prop_oneof![4 => T0_US..T0_US + 100_000_000, 1 => any::<i64>(), 1 => Just(i64::MIN), 1 => Just(i64::MAX), 1 => -3i64..3]
}

fn sequence() -> impl Strategy<Value = u32> {
    prop_oneof![4 => 0u32..50, 1 => any::<u32>(), 1 => u32::MAX - 3..=u32::MAX]
}

fn number() -> impl Strategy<Value = f64> {
    prop_oneof![4 => -400.0..400.0, 1 => Just(f64::NAN), 1 => Just(f64::INFINITY), 1 => Just(-f64::MAX), 1 => any::<f64>()]
}

#[derive(Clone, Debug)]
struct Message {
    robot: bool,
    device_us: u64,
    host_us: i64,
    sequence: u32,
    epoch: u32,
    joint: f64,
    kvp: f64,
    on: bool,
    counter: Option<u32>,
}

fn message() -> impl Strategy<Value = Message> {
    let counter = prop_oneof![Just(None), (0u32..5).prop_map(Some), sequence().prop_map(Some)];
    (any::<bool>(), device_us(), host_us(), sequence(), 0u32..3, number(), number(), any::<bool>(), counter).prop_map(
        |(robot, device_us, host_us, sequence, epoch, joint, kvp, on, counter)| Message {
            robot,
            device_us,
            host_us,
            sequence,
            epoch,
            joint,
            kvp,
            on,
            counter,
        },
    )
}

fn carm(message: &Message) -> Sample {
    Sample::Carm(CarmSample {
        joints: CarmJoints { lift_mm: message.joint, orbital_rad: message.joint, ..CarmJoints::ZERO },
        tube_kvp: message.kvp,
        ..carm_sample(message.sequence, message.device_us, message.joint, message.on, message.counter)
    })
}

fn evidence(frame: u32, message: &Message) -> FrameEvidence {
    FrameEvidence {
        frame,
        content: format!("{}", message.sequence),
        image_of_file: [message.epoch, message.counter.unwrap_or(1)],
        counter: message.counter,
        console_us: message.on.then_some(message.device_us as i64),
        console_resolution_us: message.host_us,
        arrival_us: (!message.robot).then_some(message.host_us),
        frame_time_us: Some(message.host_us),
        image_times_us: Vec::new(),
        stated_length_us: None,
        last_image: false,
        completes: None,
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_samples_leave_the_timeline_sound(messages in prop::collection::vec(message(), 1..60)) {
        let mut fed = Fed::default();
        for message in &messages {
            let (device, sample) = if message.robot {
                (DeviceKind::Robot, robot(message.sequence, message.device_us, message.joint, None))
            } else {
                (DeviceKind::Carm, carm(message))
            };
            if let Some(stamps) = fed.push_sample(device, message.host_us, message.epoch, sample) {
                prop_assert!(stamps.uncertainty_us >= 0.0, "{stamps:?}");
            }
        }
        let asked: Vec<i64> = messages.iter().map(|message| message.host_us).chain([i64::MIN, 0, i64::MAX]).collect();
        for host_us in asked {
            if let Some(answer) = fed.joints_at(host_us) {
                prop_assert!(answer.gap_us >= 0 && answer.age_us >= 0 && answer.uncertainty_us >= 0.0, "{answer:?}");
                prop_assert_eq!(answer.value.wig_wag_rad, 0.0);
            }
            let _ = fed.robot_and_source_at(host_us);
            let _ = fed.tracker_from_base_at(host_us);
            let _ = fed.freshness(DeviceKind::Carm, host_us, sidecarm::timeline::FreshLimits::default());
        }
        for interval in fed.exposures() {
            prop_assert!(interval.start_us <= interval.mid_us() && interval.mid_us() <= interval.end_us, "{interval:?}");
            prop_assert!(interval.start_uncertainty_us >= 0.0 && interval.end_uncertainty_us >= 0.0, "{interval:?}");
        }
        let _ = fed.summaries();
    }

    #[test]
    fn any_frames_leave_the_binder_sound(messages in prop::collection::vec(message(), 1..40)) {
        let mut fed = Fed::default();
        let mut binder = Binder::new();
        for (frame, message) in messages.iter().enumerate() {
            fed.push_sample(DeviceKind::Carm, message.host_us, message.epoch, carm(message));
            binder.push(evidence(frame as u32, message));
            binder.update(&fed, message.host_us);
        }
        binder.finish(&fed);
        for frame in 0..messages.len() as u32 {
            let binding = binder.binding(frame).expect("every frame has one");
            prop_assert!(binding.settled && !binding.evidence.is_empty(), "{binding:?}");
            if let (Some(exposure), Some(time_us)) = (&binding.exposure, binding.time_us) {
                prop_assert!((exposure.start_us..=exposure.end_us).contains(&time_us), "{binding:?}");
            }
        }
    }

    #[test]
    fn any_stamps_leave_clock_and_map_sound(stamps in prop::collection::vec((any::<i64>(), host_us(), sequence()), 1..60)) {
        let mut clock = DeviceClock::default();
        let mut tracker = SequenceTracker::default();
        let mut map = ClockMap::new(stamps[0].0, stamps[0].1, None);
        for (device_us, host_us, sequence) in &stamps {
            let sequenced = tracker.take(*sequence, *device_us as u64);
            clock.observe(0, sequenced, *sequence, *device_us, *host_us);
            map.push(*device_us, *host_us);
            let _ = map.device_from_host_us(map.host_from_device_us(*device_us));
            prop_assert!(map.uncertainty_us(*device_us) >= 0.0 && !map.delay_us(*device_us, *host_us).is_nan());
        }
        let (drift, sigma) = map.drift();
        prop_assert!(drift.abs() <= sidecarm::timeline::MAX_DRIFT && sigma >= 0.0);
        for summary in clock.summaries() {
            prop_assert!(summary.clock.uncertainty_us >= 0.0, "{summary:?}");
        }
    }
}

/// A few valid packets, the device's clock in steps of 2⁵⁷ µs, then a gap: period times gap overflowed, and so did every replay of the log.
fn steps_of_centuries() -> Vec<(u32, u64)> {
    let steps = (0..8u32).map(|i| (i, u64::from(i) << 57));
    let after_a_gap = (0..40u32).map(|i| (200 + i, (9 << 57) + u64::from(i) * 33_333));
    steps.chain(after_a_gap).collect()
}

#[test]
fn centuries_from_sample_to_sample_are_no_times_and_no_crash() {
    let mut clock = DeviceClock::default();
    let mut tracker = SequenceTracker::default();
    for (sequence, device_us) in steps_of_centuries() {
        let sequenced = tracker.take(sequence, device_us);
        assert_ne!(sequenced, Sequenced::Duplicate);
        clock.observe(0, sequenced, sequence, device_us as i64, T0_US + i64::from(sequence) * 33_333);
    }
    let mut fed = Fed::default();
    for (sequence, device_us) in steps_of_centuries() {
        let host_us = T0_US + i64::from(sequence) * 33_333;
        fed.push_sample(DeviceKind::Carm, host_us, 0, crate::timeline_joints::carm(sequence, device_us, 0.0, false, None));
    }
    assert_eq!(fed.summaries()[0].unusable, 47, "all but the one at zero");
}

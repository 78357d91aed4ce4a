//! Interpolation, gaps, freshness and bounded memory.

use glam::{DQuat, DVec3};
use sidecarm::geometry::{CarmJoints, Rigid};
use sidecarm::telemetry::{CarmSample, DeviceKind, RobotSample, Sample, SequenceTracker, Sequenced, Tendon};
use sidecarm::timeline::{FreshLimits, Freshness, Retention, Stamps, Support, Timeline};

pub const T0_US: i64 = 1_700_000_000_000_000;

/// A timeline fed as the decoder feeds it: the verdict on each sequence number comes from the tracker of its device.
#[derive(Default)]
pub struct Fed {
    pub timeline: Timeline,
    trackers: [SequenceTracker; 2],
    epochs: [u32; 2],
}

impl Fed {
    pub fn with_retention(retention: Retention) -> Self {
        Self { timeline: Timeline::with_retention(retention), ..Self::default() }
    }

    pub fn push_sample(&mut self, device: DeviceKind, host_us: i64, epoch: u32, sample: Sample) -> Option<Stamps> {
        let line = device as usize;
        if std::mem::replace(&mut self.epochs[line], epoch) != epoch {
            self.trackers[line].reopen();
        }
        let sequenced = self.trackers[line].take(sample.sequence(), sample.device_us());
        if sequenced == Sequenced::Duplicate {
            return None;
        }
        self.timeline.push_sample(device, host_us, epoch, sequenced, sample)
    }
}

impl std::ops::Deref for Fed {
    type Target = Timeline;

    fn deref(&self) -> &Timeline {
        &self.timeline
    }
}

/// A C-arm sample at `device_us` with this orbital angle, beam and counter.
pub fn carm(sequence: u32, device_us: u64, orbital_deg: f64, xray_on: bool, counter: Option<u32>) -> Sample {
    Sample::Carm(carm_sample(sequence, device_us, orbital_deg.to_radians(), xray_on, counter))
}

/// The same, by itself.
pub fn carm_sample(sequence: u32, device_us: u64, orbital_rad: f64, xray_on: bool, counter: Option<u32>) -> CarmSample {
    CarmSample {
        device_us,
        sequence,
        joints: CarmJoints { orbital_rad, ..CarmJoints::ZERO },
        tube_kvp: 74.0,
        tube_ma: f64::NAN,
        pulse_width_ms: 8.0,
        filter_mm_al: 0.0,
        filter_mm_cu: 0.0,
        field_mm: [f64::NAN; 4],
        xray_on,
        exposure_counter: counter,
        status: 0,
    }
}

/// A robot sample whose first control angle is `first_deg`.
pub fn robot(sequence: u32, device_us: u64, first_deg: f64, tracker_from_base: Option<Rigid>) -> Sample {
    let tendon = Tendon { position_mm: 0.0, velocity_mm_per_s: 0.0, tension_n: 0.0, current_a: 0.0 };
    Sample::Robot(RobotSample {
        device_us,
        sequence,
        commanded_deg: [first_deg + 1.0, 0.0, 0.0, 0.0, 0.0],
        sensed_deg: (sequence % 7 != 6).then_some([first_deg, 0.0, 0.0, 0.0, 0.0]),
        tendons: [tendon; 2],
        tracker_from_base,
        drill_rpm: 0.0,
        status: 0,
    })
}

/// Pushes a C-arm sample whose device clock runs with the host's.
fn push(timeline: &mut Fed, index: u32, at_us: i64, orbital_deg: f64) {
    timeline.push_sample(DeviceKind::Carm, T0_US + at_us, 0, carm(index, at_us as u64, orbital_deg, false, None)).expect("taken");
}

#[test]
fn joints_are_linear_and_angles_go_the_short_way_round() {
    let mut timeline = Fed::default();
    assert!(timeline.joints_at(T0_US).is_none());
    push(&mut timeline, 0, 0, 170.0);
    push(&mut timeline, 1, 40_000, -170.0);
    push(&mut timeline, 2, 80_000, -150.0);
    let mut cases = 0;
    for (at_us, expected_deg) in [(0, 170.0f64), (10_000, 175.0), (30_000, -175.0), (60_000, -160.0), (80_000, -150.0)] {
        let answer = timeline.joints_at(T0_US + at_us).expect("there");
        assert!((answer.value.orbital_rad.to_degrees() - expected_deg).abs() < 1e-6, "{at_us}: {answer:?}");
        assert!(answer.value.source_to_detector_mm.is_nan(), "not measured stays so");
        assert!(answer.uncertainty_us >= 1_000.0);
        cases += 1;
    }
    assert_eq!(cases, 5);
    let middle = timeline.joints_at(T0_US + 20_000).expect("there");
    assert!((middle.value.orbital_rad.to_degrees().abs() - 180.0).abs() < 1e-6);
    assert_eq!((middle.gap_us, middle.age_us, middle.support), (40_000, 20_000, Support::Between));
    assert!(timeline.joints_at(T0_US - 1).is_none(), "nothing before the first sample");
    let held = timeline.joints_at(T0_US + 1_080_000).expect("held");
    assert_eq!((held.support, held.gap_us, held.age_us), (Support::Held, 1_000_000, 1_000_000));
}

#[test]
fn dropouts_and_breaks_show_in_the_gap() {
    let mut timeline = Fed::default();
    for i in 0..30 {
        push(&mut timeline, i, i64::from(i) * 33_000, 0.0);
    }
    // 20 frames lost.
    push(&mut timeline, 50, 50 * 33_000, 10.0);
    let lost = timeline.joints_at(T0_US + 40 * 33_000).expect("there");
    assert_eq!(lost.gap_us, 21 * 33_000);
    assert!(!lost.across_break);
    // Unplugged for 5 s; the device's clock begins anew.
    let later_us = T0_US + 7_000_000;
    timeline.push_sample(DeviceKind::Carm, later_us, 1, carm(0, 1_000, 20.0, false, None)).expect("taken");
    let across = timeline.joints_at(T0_US + 4_000_000).expect("there");
    assert!(across.across_break);
    assert_eq!(across.gap_us, 7_000_000 - 50 * 33_000);
    assert_eq!(timeline.summaries()[0].segments.len(), 2);
}

#[test]
fn robot_angles_are_linear_and_the_base_follows_the_geodesic() {
    let mut timeline = Fed::default();
    let pose = |deg: f64, x_mm: f64| Rigid {
        rotation: DQuat::from_rotation_z(deg.to_radians()),
        translation_mm: DVec3::new(x_mm, 0.0, 0.0),
    };
    timeline.push_sample(DeviceKind::Robot, T0_US, 0, robot(0, 0, 2.0, Some(pose(170.0, 0.0))));
    timeline.push_sample(DeviceKind::Robot, T0_US + 10_000, 0, robot(1, 10_000, 4.0, Some(pose(-170.0, 10.0))));
    timeline.push_sample(DeviceKind::Robot, T0_US + 20_000, 0, robot(2, 20_000, 4.0, None));
    let angles = timeline.robot_at(T0_US + 2_500).expect("there");
    assert!((angles.value[0] - 2.5).abs() < 1e-9);
    let base = timeline.tracker_from_base_at(T0_US + 5_000).expect("tracked on both sides");
    assert!(base.value.angle_to_rad(&pose(180.0, 5.0)) < 1e-9 && (base.value.translation_mm.x - 5.0).abs() < 1e-9);
    assert!(timeline.tracker_from_base_at(T0_US + 15_000).is_none(), "not tracked on one side");
    // Where one side is not sensed, both are taken as commanded: no mixture.
    for i in 3..=7u32 {
        timeline.push_sample(DeviceKind::Robot, T0_US + i64::from(i) * 10_000, 0, robot(i, u64::from(i) * 10_000, 4.0, None));
    }
    let (mixed, source) = timeline.robot_and_source_at(T0_US + 65_000).expect("there");
    assert_eq!((mixed.value[0], source), (5.0, sidecarm::telemetry::AngleSource::Commanded));
}

#[test]
fn late_samples_find_their_place_and_duplicates_do_not_count() {
    let mut timeline = Fed::default();
    for i in [0u32, 1, 2, 3, 5, 6] {
        push(&mut timeline, i, i64::from(i) * 33_000, f64::from(i));
    }
    let late = carm(4, 4 * 33_000, 40.0, false, None);
    timeline.push_sample(DeviceKind::Carm, T0_US + 7 * 33_000, 0, late).expect("taken");
    assert!((timeline.joints_at(T0_US + 4 * 33_000).unwrap().value.orbital_rad.to_degrees() - 40.0).abs() < 1e-3);
    assert!(timeline.push_sample(DeviceKind::Carm, T0_US + 7 * 33_000, 0, carm(6, 6 * 33_000, 9.0, false, None)).is_none());
    assert_eq!(timeline.carm().entries().len(), 7);
    assert_eq!(timeline.summaries()[0].late, 1);
}

#[test]
fn stale_looks_stale() {
    let mut timeline = Fed::default();
    let limits = FreshLimits::default();
    assert_eq!(timeline.freshness(DeviceKind::Carm, T0_US, limits), Freshness::Absent);
    push(&mut timeline, 0, 0, 0.0);
    assert_eq!(timeline.freshness(DeviceKind::Carm, T0_US + 500_000, limits), Freshness::Fresh { age_us: 500_000 });
    assert_eq!(timeline.freshness(DeviceKind::Carm, T0_US + 500_001, limits), Freshness::Stale { age_us: 500_001 });
    assert_eq!(timeline.freshness(DeviceKind::Robot, T0_US, limits), Freshness::Absent);
}

#[test]
fn memory_is_bounded_and_says_what_it_forgot() {
    let retention = Retention { age_us: 60_000_000, samples: 1_000 };
    let mut timeline = Fed::with_retention(retention);
    for i in 0..5_000u32 {
        push(&mut timeline, i, i64::from(i) * 33_000, 0.0);
    }
    assert_eq!(timeline.carm().entries().len(), 1_000);
    assert_eq!(timeline.summaries()[0].dropped, 4_000);
    // By age: 40 s later hardly anything is left.
    push(&mut timeline, 5_000, 5_000 * 33_000 + 59_000_000, 0.0);
    assert!(timeline.carm().entries().len() < 40);
}

#[test]
fn impossible_times_and_wrong_devices_are_not_taken() {
    let mut timeline = Fed::default();
    assert!(timeline.push_sample(DeviceKind::Robot, T0_US, 0, carm(0, 0, 0.0, false, None)).is_none());
    assert!(timeline.joints_at(T0_US).is_none());
    assert!(timeline.push_sample(DeviceKind::Carm, T0_US, 0, carm(0, 5_000_000, 0.0, false, None)).is_some());
    assert!(timeline.push_sample(DeviceKind::Carm, T0_US + 33_000, 0, carm(1, u64::MAX, 0.0, false, None)).is_none());
    assert_eq!((timeline.summaries()[0].unusable, timeline.summaries()[0].no_time), (1, 1));
}

/// Times of such a clock were none, and all exposures with them, without a word.
#[test]
fn a_clock_of_any_epoch_and_one_that_runs_over_have_times() {
    for first_us in [1u64 << 63, u64::MAX - 1_000_000, 1 << 52] {
        let mut timeline = Fed::default();
        for i in 0..100u32 {
            let device_us = first_us.wrapping_add(u64::from(i) * 33_000);
            let host_us = T0_US + i64::from(i) * 33_000;
            assert!(timeline.push_sample(DeviceKind::Carm, host_us, 0, carm(i, device_us, 0.0, false, None)).is_some(), "{i}");
        }
        let summary = &timeline.summaries()[0];
        assert_eq!((summary.samples, summary.unusable, summary.clock_steps), (100, 0, 0), "from {first_us}");
        // A device that starts over counts from zero.
        let restarted = timeline.push_sample(DeviceKind::Carm, T0_US + 4_000_000, 1, carm(0, 1_000, 0.0, false, None));
        assert!(restarted.is_some(), "from {first_us}");
    }
}

#[test]
fn drift_does_not_shift_answers() {
    // A device clock 200 ppm fast for five minutes would be off by 60 ms, two sample periods.
    let mut timeline = Fed::default();
    let mut worst_deg = 0.0f64;
    for i in 0..9_000u32 {
        let true_us = i64::from(i) * 33_333;
        let device_us = (true_us as f64 * 1.0002) as u64;
        let delay_us = 500 + i64::from(i * 7919 % 23) * 100;
        let sample = carm(i, device_us, true_us as f64 * 1e-6, false, None);
        timeline.push_sample(DeviceKind::Carm, T0_US + true_us + delay_us, 0, sample).expect("taken");
        if i > 900 {
            // The sweep is 1 deg/s, so an error in time shows as degrees.
            let wanted_us = true_us - 1_000_000;
            let found = timeline.joints_at(T0_US + wanted_us).expect("there").value.orbital_rad.to_degrees();
            let off = (found - wanted_us as f64 * 1e-6 + 180.0).rem_euclid(360.0) - 180.0;
            worst_deg = worst_deg.max(off.abs());
        }
    }
    assert!(worst_deg < 0.002, "off by {} ms", worst_deg * 1e3);
    assert_eq!(timeline.summaries()[0].clock_steps, 0);
}

#[test]
fn answers_depend_only_on_what_was_pushed() {
    let run = || {
        let mut timeline = Fed::default();
        for i in 0..500u32 {
            push(&mut timeline, i, i64::from(i) * 33_000 + i64::from(i % 5) * 100, f64::from(i));
        }
        format!("{:?} {:?}", timeline.joints_at(T0_US + 5_000_000), timeline.summaries())
    };
    assert_eq!(run(), run());
}

/// A cable that was out for two seconds: what the devices sent meanwhile had waited in front of the port and comes at once. An exposure among
/// it has the time, the joints and the robot of when it was.
#[test]
fn what_had_waited_in_front_of_a_port_keeps_its_times() {
    let mut timeline = Fed::default();
    let (delay_us, [open_us, again_us]) = (2_000, [2_000_000, 4_000_000]);
    let arrival_us = |at_us: i64| match at_us {
        _ if at_us < open_us => Some((at_us + delay_us, 0)),
        // Half a second had waited.
        _ if at_us >= again_us - 500_000 => Some(((at_us + delay_us).max(again_us), 1)),
        _ => None,
    };
    let on_us = again_us - 400_000..again_us - 100_000;
    let mut events: Vec<(i64, u32, i64, DeviceKind)> = Vec::new();
    for n in 0..600i64 {
        if let Some((host_us, epoch)) = arrival_us(10_000 * n) {
            events.push((host_us, epoch, 10_000 * n, DeviceKind::Robot));
        }
        if n < 180
            && let Some((host_us, epoch)) = arrival_us(33_000 * n)
        {
            events.push((host_us, epoch, 33_000 * n, DeviceKind::Carm));
        }
    }
    events.sort_by_key(|(host_us, _, at_us, _)| (*host_us, *at_us));
    for (host_us, epoch, at_us, device) in events {
        // The devices' clocks began elsewhere.
        let (device_us, degrees) = (at_us as u64 + 77_000_000, 10.0 * at_us as f64 * 1e-6);
        let sample = match device {
            DeviceKind::Robot => robot((at_us / 10_000) as u32, device_us, degrees, None),
            DeviceKind::Carm => {
                let counter = 6 + u32::from(at_us >= on_us.start);
                carm((at_us / 33_000) as u32, device_us, degrees, on_us.contains(&at_us), Some(counter))
            }
        };
        timeline.push_sample(device, T0_US + host_us, epoch, sample);
        if device == DeviceKind::Carm && host_us == again_us {
            assert!(
                timeline.told_until_us(device).is_none_or(|us| us <= T0_US + open_us + delay_us),
                "nobody knows yet how long it waited"
            );
        }
    }
    let exposures = timeline.exposures();
    let [exposure] = &exposures[..] else { panic!("{exposures:?}") };
    for (found_us, true_us) in [(exposure.start_us, on_us.start), (exposure.end_us, on_us.end)] {
        assert!((found_us - T0_US - true_us).abs() < 40_000, "{found_us} {true_us}");
    }
    let mid_deg = 10.0 * 0.5 * (on_us.start + on_us.end) as f64 * 1e-6;
    let orbital_deg = exposure.joints.expect("joints").value.orbital_rad.to_degrees();
    let robot_deg = exposure.control_angles_deg.expect("a robot").value[0];
    // What is commanded is a degree ahead of what is sensed.
    assert!(
        (orbital_deg - mid_deg).abs() < 0.4 && (-0.4..1.4).contains(&(robot_deg - mid_deg)),
        "{orbital_deg} {robot_deg} {mid_deg}"
    );
}

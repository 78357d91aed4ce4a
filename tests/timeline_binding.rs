//! Exposures from flag and counter, and frames bound to them, or not.

use sidecarm::telemetry::DeviceKind;
use sidecarm::timeline::{Binding, BindingHow, ExposureInterval, FrameStamp};

use crate::timeline_joints::{Fed, T0_US, carm, robot};

const PERIOD_US: i64 = 33_333;

/// A C-arm that exposes in these intervals (seconds), with its counter starting at `counter`; `skip` tells which samples are lost.
struct Script<'a> {
    exposures_s: &'a [(f64, f64)],
    counter: Option<u32>,
    seconds: f64,
    skip: fn(f64) -> bool,
    epoch: u32,
    start_us: i64,
}

impl Default for Script<'_> {
    fn default() -> Self {
        Self { exposures_s: &[], counter: None, seconds: 20.0, skip: |_| false, epoch: 0, start_us: 0 }
    }
}

impl Script<'_> {
    fn play(&self, timeline: &mut Fed) {
        for i in 0..(self.seconds * 1e6) as i64 / PERIOD_US {
            let at_s = (i * PERIOD_US) as f64 * 1e-6;
            let begun = self.exposures_s.iter().filter(|(start, _)| at_s >= *start).count() as u32;
            let on = self.exposures_s.iter().any(|(start, end)| at_s >= *start && at_s < *end);
            let counter = self.counter.map(|counter| counter.wrapping_add(begun));
            if (self.skip)(at_s) {
                continue;
            }
            let host_us = T0_US + self.start_us + i * PERIOD_US + 800;
            let sample = carm(i as u32, (i * PERIOD_US) as u64, at_s, on, counter);
            timeline.push_sample(DeviceKind::Carm, host_us, self.epoch, sample);
        }
    }

    fn timeline(&self) -> Fed {
        let mut timeline = Fed::default();
        self.play(&mut timeline);
        timeline
    }
}

fn frame(counter: Option<u32>, arrival_s: f64, acquired_s: Option<f64>) -> FrameStamp {
    let us = |s: f64| T0_US + (s * 1e6) as i64;
    FrameStamp { exposure_counter: counter, host_arrival_us: us(arrival_s), acquired_us: acquired_s.map(us) }
}

fn start_s(interval: &ExposureInterval) -> f64 {
    (interval.start_us - T0_US) as f64 * 1e-6
}

/// Where the bound exposure starts, if there is one.
fn bound_s(binding: &Binding) -> Option<f64> {
    assert_eq!(binding.exposure.is_none(), binding.how == BindingHow::None);
    assert!(!binding.evidence.is_empty(), "every verdict has its evidence");
    binding.exposure.as_ref().map(|interval| (start_s(interval) * 10.0).round() / 10.0)
}

const THREE: [(f64, f64); 3] = [(3.0, 3.4), (8.0, 8.5), (15.0, 15.3)];

#[test]
fn exposures_are_found_with_their_bounds_and_joints() {
    let mut timeline = Fed::default();
    for i in 0..2_100u32 {
        timeline.push_sample(
            DeviceKind::Robot,
            T0_US + i64::from(i) * 10_000,
            0,
            robot(i, u64::from(i) * 10_000, 0.01 * f64::from(i), None),
        );
    }
    Script { exposures_s: &THREE, counter: Some(16), ..Script::default() }.play(&mut timeline);
    let exposures = timeline.exposures();
    assert_eq!(exposures.iter().map(|e| e.counter).collect::<Vec<_>>(), [Some(17), Some(18), Some(19)]);
    for (exposure, (start, end)) in exposures.iter().zip(THREE) {
        assert!((start_s(exposure) - start).abs() < 0.035, "{exposure:?}");
        assert!(((exposure.end_us - T0_US) as f64 * 1e-6 - end).abs() < 0.035);
        assert!(exposure.start_uncertainty_us > 16_000.0 && exposure.start_uncertainty_us < 20_000.0);
        assert!(exposure.start_seen && exposure.end_seen && !exposure.open && exposure.samples >= 8);
        let joints = exposure.joints.expect("samples are near");
        assert!((joints.value.orbital_rad.to_degrees() - 0.5 * (start + end)).abs() < 0.04);
        assert!((exposure.joint_range[4].to_degrees() - (end - start)).abs() < 0.07, "it moved by a degree per second");
        let angles = exposure.control_angles_deg.expect("the robot was there");
        assert!((angles.value[0] - 0.5 * (start + end)).abs() < 1.1);
        assert!((exposure.tube_kvp - 74.0).abs() < 1e-9 && exposure.tube_ma.is_nan());
    }
}

#[test]
fn the_counter_binds_whenever_the_frame_arrives() {
    let timeline = Script { exposures_s: &THREE, counter: Some(16), ..Script::default() }.timeline();
    let mut cases = 0;
    for (counter, start) in [(17, 3.0), (18, 8.0), (19, 15.0)] {
        for arrival_s in [19.0, 7_200.0] {
            let binding = timeline.bind(&frame(Some(counter), arrival_s, None));
            assert_eq!((binding.how, bound_s(&binding)), (BindingHow::Counter, Some(start)));
            cases += 1;
        }
    }
    assert_eq!(cases, 6);
}

#[test]
fn a_counter_that_telemetry_did_not_see_binds_nothing() {
    // Even though an exposure ended just before the frame arrived: it has another counter.
    let timeline = Script { exposures_s: &THREE, counter: Some(16), ..Script::default() }.timeline();
    let binding = timeline.bind(&frame(Some(23), 15.5, Some(15.1)));
    assert_eq!(bound_s(&binding), None);
    assert!(binding.evidence.iter().any(|line| line.contains("17 to 19")), "{:?}", binding.evidence);
}

#[test]
fn a_frame_cannot_come_before_its_exposure() {
    let timeline = Script { exposures_s: &THREE, counter: Some(16), ..Script::default() }.timeline();
    assert_eq!(bound_s(&timeline.bind(&frame(Some(19), 9.0, None))), None);
}

#[test]
fn without_counters_prompt_arrival_binds_if_nothing_competes() {
    let timeline = Script { exposures_s: &THREE, ..Script::default() }.timeline();
    let binding = timeline.bind(&frame(None, 8.9, None));
    assert_eq!((binding.how, bound_s(&binding)), (BindingHow::Time, Some(8.0)));
    // A counter in the frame alone does not help.
    assert_eq!(bound_s(&timeline.bind(&frame(Some(4), 8.9, None))), Some(8.0));
    // Hours later, or in the middle of nothing: no.
    for arrival_s in [7_200.0, 14.5, 2.0] {
        assert_eq!(bound_s(&timeline.bind(&frame(None, arrival_s, None))), None, "{arrival_s}");
    }
}

#[test]
fn two_exposures_within_a_second_are_told_apart_by_counter_only() {
    let close = [(9.0, 9.2), (9.7, 9.9)];
    let uncounted = Script { exposures_s: &close, ..Script::default() }.timeline();
    for stamp in [frame(None, 10.5, None), frame(None, 10.5, Some(9.0)), frame(None, 900.0, Some(9.0))] {
        let binding = uncounted.bind(&stamp);
        assert_eq!(bound_s(&binding), None);
        assert!(binding.evidence.last().unwrap().contains("ambiguous"), "{:?}", binding.evidence);
    }
    // Between the two only the first can be meant.
    assert_eq!(bound_s(&uncounted.bind(&frame(None, 9.5, None))), Some(9.0));
    let counted = Script { exposures_s: &close, counter: Some(0), ..Script::default() }.timeline();
    assert_eq!(bound_s(&counted.bind(&frame(Some(1), 10.5, None))), Some(9.0));
    assert_eq!(bound_s(&counted.bind(&frame(Some(2), 10.5, None))), Some(9.7));
}

#[test]
fn the_consoles_stamp_binds_late_frames_and_contradictions_bind_nothing() {
    let timeline = Script { exposures_s: &THREE, ..Script::default() }.timeline();
    let binding = timeline.bind(&frame(None, 7_200.0, Some(8.0)));
    assert_eq!((binding.how, bound_s(&binding)), (BindingHow::Time, Some(8.0)));
    // The stamp says the second exposure, the arrival the third.
    let contradictory = timeline.bind(&frame(None, 15.6, Some(8.0)));
    assert_eq!(bound_s(&contradictory), None);
    assert!(contradictory.evidence.last().unwrap().contains("contradictory"));
    // A console whose clock is off by minutes fits nothing, and says so.
    let off = timeline.bind(&frame(None, 15.6, Some(400.0)));
    assert!(bound_s(&off).is_none() && off.evidence.last().unwrap().contains("clock may be off"));
}

#[test]
fn a_silence_that_may_hide_an_exposure_binds_nothing() {
    // Samples between 15.5 s and 17 s are lost: an exposure may have happened there.
    let script = Script { exposures_s: &THREE, skip: |s| (15.5..17.0).contains(&s), ..Script::default() };
    let binding = script.timeline().bind(&frame(None, 17.5, None));
    assert_eq!(bound_s(&binding), None);
    assert!(binding.evidence.last().unwrap().contains("silent"), "{:?}", binding.evidence);
    // With a counter in telemetry that did not move, nothing can have happened.
    let counted = Script { counter: Some(3), ..script }.timeline();
    assert_eq!(bound_s(&counted.bind(&frame(None, 17.5, None))), Some(15.0));
}

#[test]
fn an_exposure_that_only_the_counter_shows_is_known_and_competes() {
    let timeline =
        Script { exposures_s: &THREE, counter: Some(0), skip: |s| (7.9..8.7).contains(&s), ..Script::default() }.timeline();
    let exposures = timeline.exposures();
    assert_eq!(exposures.iter().map(|e| e.counter).collect::<Vec<_>>(), [Some(1), Some(2), Some(3)]);
    let unseen = &exposures[1];
    assert!(unseen.samples == 0 && !unseen.start_seen && unseen.end_us - unseen.start_us > 700_000);
    assert_eq!(timeline.bind(&frame(Some(2), 9.0, None)).how, BindingHow::Counter);
}

#[test]
fn a_counter_that_repeats_after_a_reset_is_ambiguous_unless_time_decides() {
    let mut timeline = Fed::default();
    Script { exposures_s: &[(3.0, 3.4)], counter: Some(0), seconds: 10.0, ..Script::default() }.play(&mut timeline);
    let again = Script {
        exposures_s: &[(2.0, 2.4)],
        counter: Some(0),
        seconds: 5.0,
        epoch: 1,
        start_us: 60_000_000,
        ..Script::default()
    };
    again.play(&mut timeline);
    assert_eq!(timeline.exposures().iter().map(|e| e.counter).collect::<Vec<_>>(), [Some(1), Some(1)]);
    assert_eq!(bound_s(&timeline.bind(&frame(Some(1), 5_000.0, None))), None);
    assert_eq!(bound_s(&timeline.bind(&frame(Some(1), 63.0, None))), Some(62.0));
    assert_eq!(bound_s(&timeline.bind(&frame(Some(1), 5_000.0, Some(3.0)))), Some(3.0));
    assert_eq!(bound_s(&timeline.bind(&frame(Some(1), 10.0, None))), Some(3.0), "the other one had not begun");
}

#[test]
fn a_running_exposure_is_not_settled() {
    let timeline = Script { exposures_s: &[(3.0, 99.0)], counter: Some(0), seconds: 5.0, ..Script::default() }.timeline();
    assert!(timeline.exposures()[0].open);
    let binding = timeline.bind(&frame(Some(1), 4.9, None));
    assert!(bound_s(&binding).is_none() && !binding.settled);
}

#[test]
fn an_unplugged_moment_within_an_exposure_keeps_it_whole_by_its_counter() {
    let script = Script { exposures_s: &[(3.0, 4.0)], counter: Some(6), skip: |s| (3.3..3.6).contains(&s), ..Script::default() };
    let exposures = script.timeline().exposures();
    assert_eq!(exposures.len(), 1);
    // Without a counter it could have been two, and is told as two.
    let uncounted = Script { counter: None, ..script }.timeline();
    assert_eq!(uncounted.exposures().len(), 2);
    assert_eq!(bound_s(&uncounted.bind(&frame(None, 4.5, None))), None);
}

#[test]
fn without_any_exposure_nothing_is_bound() {
    let timeline = Script::default().timeline();
    let binding = timeline.bind(&frame(Some(1), 5.0, Some(5.0)));
    assert_eq!(bound_s(&binding), None);
    assert_eq!(bound_s(&Fed::default().bind(&frame(None, 5.0, None))), None);
}

//! Whether each line can still be heard. A device that falls silent while its port is open, a port that does not come back, a clock that
//! stands still or runs at another rate: each reaches the person while something can be done, and the report where frames went without
//! telemetry for it.

use std::collections::BTreeMap;

use super::bound::Bound;
use crate::telemetry::{DeviceKind, Health, Sample};
use crate::timeline::unit_of_clock;

/// A line from which nothing could be used for so long is silent, µs.
pub(super) const SILENT_US: i64 = 3_000_000;
/// A clock that shows the same time for so long stands still, µs: one that counts whole seconds, behind a line that delays, does not.
const STILL_US: i64 = 2_500_000;
/// A frame takes at most this long from its exposure into the folder when it is exported at once, µs.
const PROMPT_US: i64 = 2_000_000;

/// A time without a sample that could be used, host time.
#[derive(Clone, Copy, Debug)]
struct Silence {
    start_us: i64,
    end_us: i64,
}

/// One device.
#[derive(Debug)]
struct Line {
    /// The latest sample, or the session's first input.
    last_us: Option<i64>,
    ever: bool,
    told: bool,
    silences: Vec<Silence>,
    /// What the device's clock shows, and since when.
    clock: Option<(u64, i64)>,
    clock_told: bool,
    still_us: i64,
    /// The stretch of its clock that was looked at last.
    stretch: Option<u32>,
    /// Seconds that its clock advances in one, where that was said.
    rate: Option<f64>,
}

impl Line {
    /// The silence that has lasted until `now_us`, if it is one.
    fn silence_until(&self, now_us: i64) -> Option<Silence> {
        let start_us = self.last_us?;
        (now_us.saturating_sub(start_us) > SILENT_US).then_some(Silence { start_us, end_us: now_us })
    }

    /// All silences up to `end_us`.
    fn silences_until(&self, end_us: i64) -> Vec<Silence> {
        self.silences.iter().copied().chain(self.silence_until(end_us)).collect()
    }
}

/// Whether a frame that came at `at_us` may be of an exposure in one of `silences`.
fn fell_into(silences: &[Silence], at_us: i64) -> bool {
    silences.iter().any(|silence| (silence.start_us..silence.end_us.saturating_add(PROMPT_US)).contains(&at_us))
}

/// See the module.
#[derive(Debug)]
pub(super) struct Hearing {
    lines: BTreeMap<DeviceKind, Line>,
    /// Arrival of each frame, and the devices that say nothing of its exposure.
    frames: BTreeMap<u32, (i64, Vec<DeviceKind>)>,
}

impl Hearing {
    pub(super) fn new(devices: impl IntoIterator<Item = DeviceKind>) -> Self {
        let line = || Line {
            last_us: None,
            ever: false,
            told: false,
            silences: Vec::new(),
            clock: None,
            clock_told: false,
            still_us: 0,
            stretch: None,
            rate: None,
        };
        Self { lines: devices.into_iter().map(|device| (device, line())).collect(), frames: BTreeMap::new() }
    }

    /// Takes a sample; what there is to say about the device's clock.
    pub(super) fn sample(&mut self, device: DeviceKind, host_us: i64, sample: &Sample) -> Option<String> {
        let line = self.lines.get_mut(&device)?;
        line.silences.extend(line.silence_until(host_us));
        (line.last_us, line.ever, line.told) = (Some(host_us), true, false);
        // What a device says of itself may be stamped anew while all that it measures has the same time for ever.
        if matches!(sample, Sample::Metadata(_)) {
            return None;
        }
        let device_us = sample.device_us();
        let since_us = match line.clock {
            Some((shown_us, since_us)) if shown_us == device_us => since_us,
            _ => {
                (line.clock, line.clock_told) = (Some((device_us, host_us)), false);
                return None;
            }
        };
        let still_us = host_us.saturating_sub(since_us);
        if still_us < STILL_US {
            return None;
        }
        line.still_us = line.still_us.max(still_us);
        (!std::mem::replace(&mut line.clock_told, true))
            .then(|| format!("the {device}'s clock stands still: nothing it says can be tied to an exposure; restart the device"))
    }

    /// Takes the number of the running stretch of the device's clock, and by how much the clock jumped at its beginning; what there is to say
    /// about it.
    pub(super) fn clock(&mut self, device: DeviceKind, stretch: Option<(u32, Option<i64>)>) -> Option<String> {
        let line = self.lines.get_mut(&device)?;
        let (number, step_us) = stretch?;
        if line.stretch.replace(number) == Some(number) {
            return None;
        }
        let step_us = step_us?;
        Some(format!(
            "the {device}'s clock jumped by {:+.3} s: its times are mapped anew from there, and what it said across the jump is less certain",
            step_us as f64 * 1e-6
        ))
    }

    /// Takes how many seconds the device's clock advances in one, where that is wrong; what there is to say about it, once.
    pub(super) fn rate(&mut self, device: DeviceKind, wrong: Option<f64>) -> Option<String> {
        let line = self.lines.get_mut(&device).filter(|line| line.rate.is_none())?;
        let rate = wrong?;
        line.rate = Some(rate);
        let remedy = match unit_of_clock(rate) {
            Some(unit) => {
                format!(
                    "does it send {unit}? Have it send microseconds, or declare the unit where its lines are declared (`device_time`)"
                )
            }
            None if rate > 1.0 => "it is fast, or counts in a unit of its own; set the device's clock right".to_owned(),
            None => {
                "it is slow, or its data come later and later; check the device's clock, and the speed of its line".to_owned()
            }
        };
        Some(format!(
            "the {device}'s clock advances {} where 1 s passes, so what it says is tied to exposures at wrong times or not at all: {remedy}",
            advance(rate)
        ))
    }

    /// Time has come to `now_us`; the session begins with the first call.
    pub(super) fn advance(&mut self, now_us: i64) {
        self.lines.values_mut().filter(|line| line.last_us.is_none()).for_each(|line| line.last_us = Some(now_us));
    }

    /// Takes a frame with what telemetry knows of its exposure.
    pub(super) fn bound(&mut self, number: u32, arrived_us: i64, bound: &Bound) {
        let unknown = self.lines.keys().copied().filter(|device| !bound.is_known_to(*device)).collect();
        self.frames.insert(number, (arrived_us, unknown));
    }

    /// What there is to say, once per silence, about lines that cannot be heard.
    pub(super) fn look(&mut self, now_us: i64, health: impl Fn(DeviceKind) -> Option<Health>) -> Vec<(DeviceKind, String)> {
        let mut words = Vec::new();
        for (device, line) in self.lines.iter_mut().filter(|(_, line)| !line.told && line.silence_until(now_us).is_some()) {
            line.told = true;
            let health = health(*device).unwrap_or_default();
            let useless = health.lost_in_all() + health.duplicate;
            let why = match (line.ever, health.bytes > 0) {
                (true, _) => "check the device, its cable and its port".to_owned(),
                (false, false) => "nothing ever came: is it on, and is this its port?".to_owned(),
                (false, true) => {
                    format!(
                        "bytes come ({}, {useless} packets of no use): is the baud rate right, and is this its port?",
                        health.bytes
                    )
                }
            };
            let silent_s = SILENT_US as f64 * 1e-6;
            let sentence = format!(
                "nothing to be used from the {device} for {silent_s:.0} s, frames that come now have no telemetry of it; {why}"
            );
            words.push((*device, sentence));
        }
        words
    }

    /// Whether the frame came while nothing was heard of `device`, which says nothing of it; time has come to `end_us`.
    pub(super) fn came_unheard(&self, number: u32, device: DeviceKind, end_us: i64) -> bool {
        let of_frame = self.frames.get(&number).filter(|(_, unknown)| unknown.contains(&device));
        let silences = || self.lines.get(&device).map(|line| line.silences_until(end_us)).unwrap_or_default();
        of_frame.is_some_and(|(at_us, _)| fell_into(&silences(), *at_us))
    }

    /// What silence and clocks have cost, a sentence each. A device that is switched off after the last frame has cost nothing, and nothing is
    /// lost with a frame that is no exposure of its own (`stands_for_another`: a copy, a picture that was taken back).
    pub(super) fn losses(&self, end_us: i64, stands_for_another: impl Fn(u32) -> bool) -> Vec<String> {
        let mut words = Vec::new();
        for (device, line) in &self.lines {
            let silences = line.silences_until(end_us);
            let lacks = |(number, (at_us, unknown)): &(&u32, &(i64, Vec<DeviceKind>))| {
                unknown.contains(device) && fell_into(&silences, *at_us) && !stands_for_another(**number)
            };
            let without = self.frames.iter().filter(lacks).count();
            let silent_s =
                silences.iter().map(|s| s.end_us.saturating_sub(s.start_us)).fold(0, i64::saturating_add) as f64 * 1e-6;
            match (line.ever, without) {
                (false, _) if !silences.is_empty() => words.push(format!("{device}: not one packet in {silent_s:.0} s")),
                (_, 1..) => words.push(format!(
                    "{device}: silent for {silent_s:.0} s in all; {without} frames that came meanwhile have no telemetry of it"
                )),
                _ => {}
            }
            if line.still_us > 0 {
                let still_s = line.still_us as f64 * 1e-6;
                words.push(format!("{device}: its clock stood still for {still_s:.0} s; what it said then has no time"));
            }
            if let Some(rate) = line.rate {
                let advance = advance(rate);
                words.push(format!(
                    "{device}: its clock advanced {advance} where 1 s passed; what it said meanwhile has no time to rely on"
                ));
            }
        }
        words
    }
}

/// So many seconds in words.
fn advance(seconds: f64) -> String {
    if seconds >= 0.1 {
        format!("{seconds:.3} s")
    } else if seconds >= 1e-4 {
        format!("{:.3} ms", seconds * 1e3)
    } else {
        format!("{:.3} us", seconds * 1e6)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::acquire::{Domain, Frame};
    use crate::image::Image;
    use crate::telemetry::{CarmSample, Metadata};
    use crate::timeline::{Binding, Timeline};

    /// A C-arm whose measurements had the time of the first for ever was not said, because its metadata had another one each second.
    #[test]
    fn a_clock_that_stands_still_is_said_whatever_time_the_metadata_have() {
        let of_arm = |sequence, device_us| Sample::Carm(CarmSample { device_us, sequence, ..CarmSample::UNTOLD });
        let of_itself = |sequence, device_us| {
            let text = String::new;
            Sample::Metadata(Metadata {
                device_us,
                sequence,
                device: DeviceKind::Carm,
                schema: 0,
                serial_number: text(),
                firmware: text(),
                calibration_id: text(),
                units: text(),
                limits: Vec::new(),
            })
        };
        let played = |arm_us: fn(u64) -> u64, itself_us: fn(u64) -> u64| {
            let mut hearing = Hearing::new([DeviceKind::Carm]);
            let mut said = Vec::new();
            for n in 0..150_u32 {
                let at_us = 40_000 * u64::from(n);
                let sample = if n % 25 == 0 { of_itself(n, itself_us(at_us)) } else { of_arm(n, arm_us(at_us)) };
                said.extend(hearing.sample(DeviceKind::Carm, at_us as i64, &sample));
            }
            (said.len(), hearing.losses(6_000_000, |_| false).len())
        };
        assert_eq!(played(|_| 7, |at_us| at_us), (1, 1));
        assert_eq!(played(|_| 7, |_| 7), (1, 1));
        assert_eq!(played(|at_us| at_us, |_| 7), (0, 0), "what it says of itself has no time that counts");
        assert_eq!(played(|at_us| at_us, |at_us| at_us), (0, 0));
        assert_eq!(played(|at_us| at_us / 1_000_000 * 1_000_000, |at_us| at_us), (0, 0), "whole seconds");
        assert_eq!(played(|at_us| at_us / 2_000_000 * 2_000_000, |at_us| at_us), (0, 0), "some of which come late");
    }

    #[test]
    fn a_clock_of_another_rate_is_said_once_with_its_unit_and_is_a_loss() {
        let mut hearing = Hearing::new(DeviceKind::ALL);
        assert_eq!(hearing.rate(DeviceKind::Carm, None), None);
        assert!(hearing.losses(1_000_000, |_| false).is_empty());
        let words = hearing.rate(DeviceKind::Carm, Some(0.001_000_1)).expect("said");
        assert!(words.contains("the C-arm's clock advances 1.000 ms where 1 s passes"), "{words}");
        assert!(words.contains("does it send milliseconds?") && words.contains("`device_time`"), "{words}");
        assert_eq!(hearing.rate(DeviceKind::Carm, Some(0.001)), None, "said already");
        let words = hearing.rate(DeviceKind::Robot, Some(1.06)).expect("said");
        assert!(words.contains("the robot's clock advances 1.060 s where 1 s passes") && words.contains("it is fast"), "{words}");
        assert!(!words.contains("does it send"), "no unit is so near");
        assert_eq!(
            hearing.losses(1_000_000, |_| false),
            [
                "C-arm: its clock advanced 1.000 ms where 1 s passed; what it said meanwhile has no time to rely on",
                "robot: its clock advanced 1.060 s where 1 s passed; what it said meanwhile has no time to rely on",
            ]
        );
    }

    /// All that came while the C-arm was unplugged was said to be of another day or another room.
    #[test]
    fn a_frame_that_came_while_nothing_was_heard_is_told_from_one_that_fits_nothing() {
        let pixels = Image::from_pixels(2, 2, vec![1.0, 2.0, 3.0, 4.0]).expect("size");
        let frame = Arc::new(Frame::from_pixels("frame", pixels, Domain::Linear).expect("finite"));
        let mut hearing = Hearing::new([DeviceKind::Carm]);
        hearing.advance(0);
        for (number, arrived_us) in [(1, 9_000_000), (2, 12_500_000)] {
            let bound = Bound::new(Arc::clone(&frame), arrived_us, Binding::default(), &Timeline::new());
            hearing.bound(number, arrived_us, &bound);
        }
        let unheard = |number, device, end_us| hearing.came_unheard(number, device, end_us);
        assert!(unheard(1, DeviceKind::Carm, 10_000_000));
        assert!(!unheard(1, DeviceKind::Carm, 2_000_000), "two seconds are no silence");
        assert!(!unheard(2, DeviceKind::Carm, 10_000_000), "long after it");
        assert!(!unheard(1, DeviceKind::Robot, 10_000_000) && !unheard(3, DeviceKind::Carm, 10_000_000));
        assert_eq!(hearing.losses(10_000_000, |_| false), ["C-arm: not one packet in 10 s"]);
    }

    /// An arm that was switched off after the last exposure had cost the copies that were exported then their telemetry, and the session its
    /// exit code.
    #[test]
    fn a_copy_that_came_while_nothing_was_heard_has_lost_nothing() {
        let pixels = Image::from_pixels(2, 2, vec![1.0, 2.0, 3.0, 4.0]).expect("size");
        let frame = Arc::new(Frame::from_pixels("frame", pixels, Domain::Linear).expect("finite"));
        let mut hearing = Hearing::new([DeviceKind::Carm]);
        hearing.advance(0);
        assert_eq!(hearing.sample(DeviceKind::Carm, 0, &Sample::Carm(CarmSample::UNTOLD)), None);
        for number in [1, 2] {
            let bound = Bound::new(Arc::clone(&frame), 5_000_000, Binding::default(), &Timeline::new());
            hearing.bound(number, 5_000_000, &bound);
        }
        let without = |copies: &[u32]| hearing.losses(9_000_000, |number| copies.contains(&number));
        let of = |count: u32| format!("C-arm: silent for 9 s in all; {count} frames that came meanwhile have no telemetry of it");
        assert_eq!((without(&[]), without(&[2])), (vec![of(2)], vec![of(1)]));
        assert!(without(&[1, 2]).is_empty());
    }
}

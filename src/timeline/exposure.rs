//! Exposure intervals from the X-ray-on flag and the exposure counter.
//!
//! The flag says when, the counter says which. C-arms raise it when the beam goes on, but some a packet or two later and some when the beam
//! goes off; some count by other steps than one; and a flag may bounce. What has one beam and one count is one exposure.

use std::collections::VecDeque;

use serde::Serialize;

use super::track::{Answer, Stamps};
use super::travel::Travel;
use crate::geometry::{CarmJoints, Rigid};
use crate::telemetry::CarmSample;

/// Intervals kept: a long day at the C-arm.
const KEPT: usize = 10_000;
/// Silences kept.
const SILENCES_KEPT: usize = 10_000;
/// A silence longer than this can hide an exposure: the shortest last about 0.1 s.
pub const HIDING_SILENCE_US: i64 = 100_000;
/// A counter that runs ahead by more than this between two samples was set, not counted.
const MOST_UNSEEN: u32 = 16;
/// A flag that drops for no longer while the counter stands has bounced: nobody asks for two exposures within that time. So long an exposure
/// may get its count after it.
const BOUNCE_US: i64 = 150_000;
/// What the protocol sends for a counter that is none.
const NO_COUNT: u32 = u32::MAX;

/// One exposure: an interval of host time during which the beam was on.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ExposureInterval {
    /// Position in the session, from 0.
    pub index: u64,
    /// The C-arm's exposure counter, if it has one.
    pub counter: Option<u32>,
    /// Opening of the port.
    pub epoch: u32,
    /// Beam on, host time: between the last sample without and the first with X-rays.
    pub start_us: i64,
    /// Beam off, host time.
    pub end_us: i64,
    /// Segment of the C-arm's clock in which it began.
    pub segment: u32,
    /// Beam on and off by the C-arm's own clock; the end is in the segment in which it was seen.
    pub device_us: [i64; 2],
    /// Uncertainty of `start_us`: half the time between those two samples, and the clock map's.
    pub start_uncertainty_us: f64,
    /// Same for `end_us`.
    pub end_uncertainty_us: f64,
    /// The beam is still on as far as is known; `end_us` is the last sample with X-rays.
    pub open: bool,
    /// A sample without X-rays was seen right before it.
    pub start_seen: bool,
    /// A sample without X-rays was seen right after it.
    pub end_seen: bool,
    /// Samples with X-rays on; 0 where only the counter tells of the exposure.
    pub samples: u32,
    /// Mean over those samples; NaN where not measured.
    pub tube_kvp: f64,
    /// Mean over those samples; NaN where not measured.
    pub tube_ma: f64,
    /// Joints at the middle; `None` while open, or when no sample is near.
    pub joints: Option<Answer<CarmJoints>>,
    /// The sample nearest the middle: voltage, filter and field of a frame that comes when the samples are gone.
    #[serde(skip)]
    pub beam: Option<Box<CarmSample>>,
    /// How far each joint moved while the beam was on, beyond its encoder's noise (order of [`CarmJoints::to_array`], mm and rad).
    pub joint_range: [f64; 7],
    /// Robot's control angles in degrees at the middle, once the robot's samples have reached it.
    pub control_angles_deg: Option<Answer<[f64; 5]>>,
    /// Tracked robot base at the middle, same.
    pub tracker_from_base: Option<Answer<Rigid>>,
}

impl ExposureInterval {
    /// The middle of the interval, host time.
    #[must_use]
    pub fn mid_us(&self) -> i64 {
        self.start_us.saturating_add(self.end_us.saturating_sub(self.start_us) / 2)
    }

    /// `exposure 7`, or `exposure at 12 s` words for evidence lines.
    #[must_use]
    pub fn label(&self) -> String {
        match self.counter {
            Some(counter) => format!("exposure {counter}"),
            None => format!("exposure #{} of the session", self.index + 1),
        }
    }
}

/// A stretch without C-arm samples in which an exposure may have happened unseen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Silence {
    /// Last sample before, host time.
    pub from_us: i64,
    /// First sample after.
    pub to_us: i64,
}

#[derive(Clone, Copy, Debug)]
struct Seen {
    device_us: i64,
    segment: u32,
    mapped_us: i64,
    uncertainty_us: f64,
    epoch: u32,
    counter: Option<u32>,
    xray_on: bool,
}

#[derive(Clone, Debug)]
struct Open {
    interval: ExposureInterval,
    last_on: Seen,
    /// It still has the count that stood before the beam went on: the C-arm may yet count it.
    uncounted: bool,
    /// The beam is off since this sample, which may be a bounce.
    off: Option<Seen>,
    travel: Travel<7>,
    kvp: (f64, u32),
    ma: (f64, u32),
}

/// Finds exposures in a stream of samples that are in order.
#[derive(Clone, Debug, Default)]
pub struct ExposureTracker {
    closed: VecDeque<ExposureInterval>,
    open: Option<Open>,
    previous: Option<Seen>,
    silences: VecDeque<Silence>,
    first_us: Option<i64>,
    /// Some sample had X-rays.
    beam_seen: bool,
    /// The exposure that ended last was not counted yet.
    uncounted: bool,
    next_index: u64,
    counter_resets: u64,
    dropped: u64,
}

impl ExposureTracker {
    /// Takes the next sample in order.
    pub fn push(&mut self, sample: &CarmSample, stamps: &Stamps) {
        let Stamps { device_us, mapped_us, uncertainty_us, epoch, segment, .. } = *stamps;
        let (counter, xray_on) = (sample.exposure_counter, sample.xray_on);
        let now = Seen { device_us, segment, mapped_us, uncertainty_us, epoch, counter, xray_on };
        self.first_us.get_or_insert(mapped_us);
        self.beam_seen |= xray_on;
        self.note_silence(&now);
        match self.open.as_mut().map(|open| (open.goes(&now), open)) {
            Some((Goes::On, open)) => open.extend(sample, now),
            Some((Goes::PerhapsOn, open)) => _ = open.off.get_or_insert(now),
            Some((Goes::Over, _)) | None => {
                let ended = self.close(&now);
                let counted_from = ended.or_else(|| self.previous.and_then(|seen| seen.counter));
                self.add_unseen(counted_from, &now);
                if now.xray_on {
                    self.begin(sample, now);
                }
            }
        }
        self.previous = Some(now);
    }

    /// No more samples come: an exposure after which the beam was seen off has ended.
    pub fn finish(&mut self) {
        if let Some(off) = self.open.as_ref().and_then(|open| open.off) {
            self.close(&off);
        }
    }

    /// Closed exposures, oldest first.
    #[must_use]
    pub fn closed(&self) -> &VecDeque<ExposureInterval> {
        &self.closed
    }

    /// Closed exposures, to fill in what is measured elsewhere.
    pub fn closed_mut(&mut self) -> &mut VecDeque<ExposureInterval> {
        &mut self.closed
    }

    /// The running exposure.
    #[must_use]
    pub fn open(&self) -> Option<&ExposureInterval> {
        self.open.as_ref().map(|open| &open.interval)
    }

    /// Whether the C-arm has ever said that the beam is on: one that only counts does not.
    #[must_use]
    pub fn has_seen_beam(&self) -> bool {
        self.beam_seen
    }

    /// Whether it will be known shortly that an exposure has ended.
    #[must_use]
    pub fn is_ending(&self) -> bool {
        self.open.as_ref().is_some_and(|open| open.off.is_some())
    }

    /// A stretch that touches [`from_us`, `to_us`] in which an exposure may have happened unseen: before the first sample, a silence,
    /// or after the last sample.
    #[must_use]
    pub fn blind_spot(&self, from_us: i64, to_us: i64) -> Option<Silence> {
        let (Some(first_us), Some(previous)) = (self.first_us, self.previous) else {
            return Some(Silence { from_us, to_us });
        };
        if from_us < first_us {
            return Some(Silence { from_us, to_us: first_us });
        }
        if to_us > previous.mapped_us.saturating_add(HIDING_SILENCE_US) {
            return Some(Silence { from_us: previous.mapped_us, to_us });
        }
        self.silences.iter().find(|silence| silence.from_us < to_us && silence.to_us > from_us).copied()
    }

    /// Silences that began before `at_us`.
    #[must_use]
    pub fn silences_before(&self, at_us: i64) -> usize {
        self.silences.partition_point(|silence| silence.from_us < at_us)
    }

    /// Times the counter ran backwards, intervals forgotten to bound memory.
    #[must_use]
    pub fn resets_and_dropped(&self) -> (u64, u64) {
        (self.counter_resets, self.dropped)
    }

    fn note_silence(&mut self, now: &Seen) {
        let Some(previous) = self.previous else { return };
        let silent = now.mapped_us.saturating_sub(previous.mapped_us) > HIDING_SILENCE_US;
        // Counters on both sides prove that nothing was missed but what they count, as long as neither they nor the clock began anew.
        let ahead = previous.counter.zip(now.counter).map(|(before, after)| after.wrapping_sub(before));
        let kept = previous.epoch == now.epoch && previous.segment == now.segment;
        let counted = ahead.is_some_and(|ahead| ahead == 0 || kept && ahead <= MOST_UNSEEN);
        if silent && !counted {
            self.silences.push_back(Silence { from_us: previous.mapped_us, to_us: now.mapped_us });
            if self.silences.len() > SILENCES_KEPT {
                self.silences.pop_front();
            }
        }
    }

    fn begin(&mut self, sample: &CarmSample, now: Seen) {
        // A counter that ran ahead of the flag by a sample announced this very exposure.
        let is_announcement =
            |last: &ExposureInterval| last.samples == 0 && last.counter.is_some() && last.counter == now.counter;
        let announced = self.closed.pop_back_if(|last| is_announcement(last)).is_some();
        let before = self.previous.filter(|previous| !previous.xray_on && previous.epoch == now.epoch);
        self.uncounted = false;
        let (start_us, half_us) = match before {
            Some(off) => between(off.mapped_us, now.mapped_us),
            None => (now.mapped_us, 0.0),
        };
        let device_start_us = match before.filter(|off| off.segment == now.segment) {
            Some(off) => between(off.device_us, now.device_us).0,
            None => now.device_us,
        };
        let interval = ExposureInterval {
            index: self.next_index,
            counter: now.counter,
            epoch: now.epoch,
            start_us,
            end_us: now.mapped_us.max(start_us),
            segment: now.segment,
            device_us: [device_start_us, now.device_us],
            start_uncertainty_us: half_us.hypot(now.uncertainty_us),
            end_uncertainty_us: now.uncertainty_us,
            open: true,
            start_seen: before.is_some(),
            end_seen: false,
            samples: 0,
            tube_kvp: f64::NAN,
            tube_ma: f64::NAN,
            joints: None,
            beam: None,
            joint_range: [0.0; 7],
            control_angles_deg: None,
            tracker_from_base: None,
        };
        self.next_index += 1;
        let uncounted = !announced && now.counter.is_some() && before.is_some_and(|before| before.counter == now.counter);
        let travel = Travel::of_arm(sample.joints.to_array());
        let mut open = Open { interval, last_on: now, uncounted, off: None, travel, kvp: (0.0, 0), ma: (0.0, 0) };
        open.extend(sample, now);
        self.open = Some(open);
    }

    /// Ends the running exposure; returns its counter.
    fn close(&mut self, now: &Seen) -> Option<u32> {
        let Open { mut interval, last_on, uncounted, off, .. } = self.open.take()?;
        let now = off.as_ref().unwrap_or(now);
        self.uncounted = uncounted;
        interval.open = false;
        interval.end_seen = !now.xray_on && now.epoch == last_on.epoch;
        if now.epoch == last_on.epoch {
            let (end_us, half_us) = between(last_on.mapped_us, now.mapped_us);
            // A clock that was mapped anew may have set the end before the start.
            interval.end_us = end_us.max(interval.start_us);
            if now.segment == last_on.segment {
                interval.device_us[1] = between(last_on.device_us, now.device_us).0;
            }
            interval.end_uncertainty_us = half_us.hypot(last_on.uncertainty_us);
        }
        let counter = interval.counter;
        self.keep(interval);
        counter
    }

    /// Exposures of which only the counter tells: each lies somewhere between the previous sample and this one. Between two samples that
    /// follow each other at once there is room for one at most, and for none before one that is seen: a counter that has gone further there
    /// counts otherwise.
    fn add_unseen(&mut self, from: Option<u32>, now: &Seen) {
        let (Some(from), Some(to), Some(previous)) = (from, now.counter, self.previous) else { return };
        // The late count of the exposure that ended last: it keeps the number under which it is known.
        if !now.xray_on && raised(Some(from), now.counter) && std::mem::take(&mut self.uncounted) && now.follows(&previous) {
            return;
        }
        let seen = u32::from(now.xray_on);
        let ahead = to.wrapping_sub(from).wrapping_sub(seen);
        if ahead == 0 || (now.xray_on && ahead == u32::MAX) {
            return;
        }
        if ahead > MOST_UNSEEN {
            self.counter_resets += 1;
            return;
        }
        let room = if now.follows(&previous) { 1 - seen } else { ahead };
        let unseen = (0..ahead.min(room)).rev().map(|behind| to.wrapping_sub(seen).wrapping_sub(behind));
        for counter in unseen.filter(|counter| *counter != NO_COUNT) {
            let (_, half_us) = between(previous.mapped_us, now.mapped_us);
            let index = self.next_index;
            self.next_index += 1;
            self.keep(ExposureInterval {
                index,
                counter: Some(counter),
                epoch: now.epoch,
                start_us: previous.mapped_us,
                end_us: now.mapped_us.max(previous.mapped_us),
                segment: now.segment,
                device_us: [previous.device_us, now.device_us],
                start_uncertainty_us: half_us.hypot(previous.uncertainty_us),
                end_uncertainty_us: half_us.hypot(now.uncertainty_us),
                open: false,
                start_seen: false,
                end_seen: false,
                samples: 0,
                tube_kvp: f64::NAN,
                tube_ma: f64::NAN,
                joints: None,
                beam: None,
                joint_range: [f64::NAN; 7],
                control_angles_deg: None,
                tracker_from_base: None,
            });
        }
    }

    fn keep(&mut self, interval: ExposureInterval) {
        self.closed.push_back(interval);
        if self.closed.len() > KEPT {
            self.closed.pop_front();
            self.dropped += 1;
        }
    }
}

/// What a sample is to the running exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Goes {
    On,
    /// The beam is off; if it comes back soon it was not.
    PerhapsOn,
    Over,
}

impl Seen {
    /// Whether nothing fits in between.
    fn follows(&self, previous: &Self) -> bool {
        let silent = self.mapped_us.saturating_sub(previous.mapped_us) > HIDING_SILENCE_US;
        self.epoch == previous.epoch && self.segment == previous.segment && !silent
    }
}

/// Whether a counter went on, not anew.
fn raised(from: Option<u32>, to: Option<u32>) -> bool {
    from.zip(to).is_some_and(|(from, to)| (1..=MOST_UNSEEN).contains(&to.wrapping_sub(from)))
}

impl Open {
    fn goes(&mut self, now: &Seen) -> Goes {
        let (last, counter) = (self.last_on, self.interval.counter);
        let soon =
            now.epoch == last.epoch && now.segment == last.segment && now.mapped_us.saturating_sub(last.mapped_us) <= BOUNCE_US;
        if self.uncounted && soon && now.follows(self.off.as_ref().unwrap_or(&last)) && raised(counter, now.counter) {
            // By steps of whatever size.
            self.interval.counter = now.counter;
            self.uncounted = false;
        }
        let same = match (self.interval.counter, now.counter) {
            (Some(a), Some(b)) => a == b,
            // Without counters two exposures may hide behind one silence.
            _ => now.epoch == last.epoch && now.mapped_us.saturating_sub(last.mapped_us) <= HIDING_SILENCE_US,
        };
        match (now.xray_on, same, self.off.is_some()) {
            (true, true, false) => Goes::On,
            // A count that does not move does not say that it was one exposure.
            (true, true, true) if soon && !self.uncounted => Goes::On,
            (false, true, _) if soon && self.interval.counter.is_some() => Goes::PerhapsOn,
            _ => Goes::Over,
        }
    }

    fn extend(&mut self, sample: &CarmSample, now: Seen) {
        self.travel.push(sample.joints.to_array());
        for (sum, value) in [(&mut self.kvp, sample.tube_kvp), (&mut self.ma, sample.tube_ma)] {
            if value.is_finite() {
                *sum = (sum.0 + value, sum.1 + 1);
            }
        }
        let mean = |(sum, count): (f64, u32)| if count > 0 { sum / f64::from(count) } else { f64::NAN };
        self.interval.samples = self.interval.samples.saturating_add(1);
        self.interval.end_us = now.mapped_us.max(self.interval.start_us);
        self.interval.device_us[1] = now.device_us;
        self.interval.end_uncertainty_us = now.uncertainty_us;
        self.interval.tube_kvp = mean(self.kvp);
        self.interval.tube_ma = mean(self.ma);
        self.interval.joint_range = self.travel.range();
        (self.last_on, self.off) = (now, None);
    }
}

/// The middle of two times and half their distance.
fn between(a_us: i64, b_us: i64) -> (i64, f64) {
    let span_us = b_us.saturating_sub(a_us);
    (a_us.saturating_add(span_us / 2), 0.5 * span_us.saturating_abs() as f64)
}

#[cfg(test)]
impl ExposureInterval {
    /// Both ends of which telemetry has seen to 10 ms, for tests.
    pub(super) fn seen_for(beam_us: i64) -> Self {
        Self {
            index: 0,
            counter: Some(7),
            epoch: 0,
            start_us: 1_000_000,
            end_us: 1_000_000 + beam_us,
            segment: 0,
            device_us: [0, beam_us],
            start_uncertainty_us: 1e4,
            end_uncertainty_us: 1e4,
            open: false,
            start_seen: true,
            end_seen: true,
            samples: 30,
            tube_kvp: 70.0,
            tube_ma: 2.0,
            joints: None,
            beam: None,
            joint_range: [0.0; 7],
            control_angles_deg: None,
            tracker_from_base: None,
        }
    }
}

//! One device's clock over a session: a new map after each step, reset or re-opening.

use std::collections::VecDeque;

use super::clock::{ClockEstimate, ClockMap};
use super::rate::ClockRate;
use crate::telemetry::Sequenced;

/// Smaller disagreements than this are delay and jitter, not steps.
const LEAST_STEP_US: i64 = 10_000;
/// From here on a forward step needs no second witness.
const CLEAR_STEP_US: i64 = 200_000;
/// A clock may run back by this much from sample to sample without a step.
const BACKWARD_JITTER_US: i64 = 2_000;
/// Differences kept to know the sample period.
const PERIODS: usize = 31;
/// What had waited while the port was closed comes at once, each sample faster than the one before by more than this …
const FASTER_US: i64 = 5_000;
/// … until none has been for so long: then samples come as they are sent.
const CAUGHT_UP_US: i64 = 150_000;
/// Segments kept; older ones take their samples with them.
const SEGMENTS: usize = 256;

/// Why a new map began.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SegmentStart {
    /// The first sample ever.
    First,
    /// The port was opened again.
    Epoch,
    /// The device's clock jumped, or stood still for a while, and its sequence went on.
    Step,
    /// The device started over: its sequence did.
    Reset,
}

/// A stretch of one device's samples over which its clock ran evenly.
#[derive(Clone, Debug)]
pub struct Segment {
    /// Counts up over the session.
    pub id: u32,
    /// Opening of the port.
    pub epoch: u32,
    /// Why it began.
    pub start: SegmentStart,
    /// For [`SegmentStart::Step`]: by how much device time jumped beyond what the sequence explains; 0 otherwise.
    pub step_us: i64,
    /// Host arrival of its first sample.
    pub first_host_us: i64,
    /// Its clock.
    pub map: ClockMap,
    /// Samples come as they are sent: what had waited in front of the port has been read, and the map knows its offset.
    pub caught_up: bool,
    /// The least of host minus device time so far, and when it came.
    fastest_us: i64,
    fastest_at_us: i64,
    /// `None` where the device has no clock.
    rate: Option<ClockRate>,
}

impl Segment {
    fn push(&mut self, device_us: i64, host_us: i64) {
        self.map.push(device_us, host_us);
        if let Some(rate) = &mut self.rate {
            rate.push(device_us, host_us);
        }
        let behind_us = host_us.saturating_sub(device_us);
        if behind_us < self.fastest_us.saturating_sub(FASTER_US) {
            (self.fastest_us, self.fastest_at_us) = (behind_us, host_us);
        } else if host_us.saturating_sub(self.fastest_at_us) >= CAUGHT_UP_US {
            self.caught_up = true;
        }
    }

    /// How many seconds the clock advances in one, where that is known and no crystal's drift.
    #[must_use]
    pub fn wrong_rate(&self) -> Option<f64> {
        self.rate.as_ref()?.wrong()
    }
}

/// What a segment's clock did, for people and logs.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SegmentSummary {
    /// Counts up over the session.
    pub id: u32,
    /// Opening of the port.
    pub epoch: u32,
    /// Why it began.
    pub start: SegmentStart,
    /// See [`Segment::step_us`].
    pub step_us: i64,
    /// Host arrival of its first sample.
    pub first_host_us: i64,
    /// The map as it stands.
    pub clock: ClockEstimate,
}

/// The sample last seen in order.
#[derive(Clone, Copy, Debug)]
struct Last {
    epoch: u32,
    sequence: u32,
    device_us: i64,
    host_us: i64,
}

/// Where a sample belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Placed {
    /// In time order, at the end of this segment.
    InOrder(u32),
    /// Came late: belongs somewhere before the end of this segment.
    Late(u32),
    /// Came late, from before the last step of the clock: its time cannot be mapped.
    Stray,
}

/// All segments of a device.
#[derive(Clone, Debug, Default)]
pub struct DeviceClock {
    segments: VecDeque<Segment>,
    last: Option<Last>,
    periods: VecDeque<i64>,
    /// Sequence numbers since the last sample that belong to messages without a measurement.
    others: u32,
    /// Such a message was the first after the device started over.
    restarted: bool,
    next_id: u32,
    steps: u64,
    resets: u64,
    /// See [`ClockMap::of_host`].
    host_sigma_us: Option<f64>,
}

impl DeviceClock {
    /// Of a device without a clock: its times are the host's, with this standard deviation.
    #[must_use]
    pub fn of_host(sigma_us: f64) -> Self {
        Self { host_sigma_us: Some(sigma_us), ..Self::default() }
    }

    /// The standard deviation of the host's times, where the device has no clock.
    #[must_use]
    pub fn host_sigma_us(&self) -> Option<f64> {
        self.host_sigma_us
    }

    /// Takes the stamps of one sample and says where it belongs; `sequenced` is the decoder's verdict on its number.
    pub fn observe(&mut self, epoch: u32, sequenced: Sequenced, sequence: u32, device_us: i64, host_us: i64) -> Placed {
        let now = Last { epoch, sequence, device_us, host_us };
        let restarted = std::mem::take(&mut self.restarted);
        let Some(last) = self.last else { return self.begin(now, SegmentStart::First, 0) };
        if epoch != last.epoch {
            return self.begin(now, SegmentStart::Epoch, 0);
        }
        if sequenced == Sequenced::Reset || restarted {
            self.resets += 1;
            return self.begin(now, SegmentStart::Reset, 0);
        }
        let device_delta = device_us.saturating_sub(last.device_us);
        // The host's time does not step; what runs back in it has none.
        if self.host_sigma_us.is_some() && device_delta < 0 {
            return Placed::Stray;
        }
        if matches!(sequenced, Sequenced::Reordered | Sequenced::Early(_) | Sequenced::Duplicate) {
            let behind = last.sequence.wrapping_sub(sequence);
            return match self.segments.back_mut() {
                Some(segment) if explains(self.periods.iter(), behind, device_delta) => {
                    segment.push(device_us, host_us);
                    Placed::Late(segment.id)
                }
                _ => Placed::Stray,
            };
        }
        // Messages without a measurement took numbers, but no sample period.
        let ahead = sequence.wrapping_sub(last.sequence).saturating_sub(std::mem::take(&mut self.others)).max(1);
        if self.host_sigma_us.is_none()
            && let Some(step_us) = self.step(&last, &now, ahead)
        {
            self.steps += 1;
            return self.begin(now, SegmentStart::Step, step_us);
        }
        self.periods.push_back(device_delta / i64::from(ahead));
        if self.periods.len() > PERIODS {
            self.periods.pop_front();
        }
        self.last = Some(now);
        let Some(segment) = self.segments.back_mut() else { return self.begin(now, SegmentStart::First, 0) };
        segment.push(device_us, host_us);
        let placed = Placed::InOrder(segment.id);
        match segment.map.stood_still_us() {
            Some(stood_us) => {
                self.steps += 1;
                self.begin(now, SegmentStart::Step, -(stood_us as i64))
            }
            None => placed,
        }
    }

    /// Notes a message that measures nothing (metadata) but has a sequence number.
    pub fn skip(&mut self, epoch: u32, sequenced: Sequenced) {
        if self.last.is_some_and(|last| last.epoch == epoch) {
            match sequenced {
                Sequenced::Next | Sequenced::Gap(_) | Sequenced::GapWhileClosed(_) => self.others = self.others.saturating_add(1),
                Sequenced::Reset => self.restarted = true,
                Sequenced::Reordered | Sequenced::Early(_) | Sequenced::Duplicate => {}
            }
        }
    }

    /// The segment with this id, unless it is forgotten.
    #[must_use]
    pub fn segment(&self, id: u32) -> Option<&Segment> {
        let first = self.segments.front()?.id;
        self.segments.get(id.checked_sub(first)? as usize)
    }

    /// The running segment.
    #[must_use]
    pub fn latest(&self) -> Option<&Segment> {
        self.segments.back()
    }

    /// Forgets segments before `id`.
    pub fn forget_before(&mut self, id: u32) {
        while self.segments.len() > 1 && self.segments.front().is_some_and(|segment| segment.id < id) {
            self.segments.pop_front();
        }
    }

    /// Clock steps and restarts seen within epochs.
    #[must_use]
    pub fn steps_and_resets(&self) -> (u64, u64) {
        (self.steps, self.resets)
    }

    /// The segments, oldest first.
    #[must_use]
    pub fn summaries(&self) -> Vec<SegmentSummary> {
        let summary = |segment: &Segment| SegmentSummary {
            id: segment.id,
            epoch: segment.epoch,
            start: segment.start,
            step_us: segment.step_us,
            first_host_us: segment.first_host_us,
            clock: segment.map.estimate(),
        };
        self.segments.iter().map(summary).collect()
    }

    /// Usual device time between consecutive sequence numbers.
    #[must_use]
    pub fn period_us(&self) -> Option<i64> {
        median(self.periods.iter())
    }

    fn begin(&mut self, now: Last, start: SegmentStart, step_us: i64) -> Placed {
        // The same crystal goes on after a step or a re-opening; what was learnt of its rate stays, unless nothing was.
        let carried = self.segments.back().map(|s| s.map.drift()).filter(|(_, sigma)| *sigma < 20e-6).map(|(drift, _)| drift);
        let id = self.next_id;
        self.next_id = self.next_id.wrapping_add(1);
        let map = match self.host_sigma_us {
            Some(sigma_us) => ClockMap::of_host(now.device_us, sigma_us),
            None => ClockMap::new(now.device_us, now.host_us, carried),
        };
        // Only in front of a port that was just opened can samples have waited.
        let opened = matches!(start, SegmentStart::First | SegmentStart::Epoch);
        self.segments.push_back(Segment {
            id,
            epoch: now.epoch,
            start,
            step_us,
            first_host_us: now.host_us,
            map,
            caught_up: !opened || self.host_sigma_us.is_some(),
            fastest_us: now.host_us.saturating_sub(now.device_us),
            fastest_at_us: now.host_us,
            rate: self.host_sigma_us.is_none().then(|| ClockRate::new(now.device_us, now.host_us)),
        });
        if self.segments.len() > SEGMENTS {
            self.segments.pop_front();
        }
        self.last = Some(now);
        self.others = 0;
        Placed::InOrder(id)
    }

    /// By how much the device's clock jumped between two consecutive samples, if it did.
    fn step(&self, last: &Last, now: &Last, ahead: u32) -> Option<i64> {
        let device_delta = now.device_us.saturating_sub(last.device_us);
        let host_delta = now.host_us.saturating_sub(last.host_us);
        if device_delta < -BACKWARD_JITTER_US {
            let expected = self.period_us().map_or(host_delta, |period| period.saturating_mul(i64::from(ahead)));
            return Some(device_delta.saturating_sub(expected));
        }
        // Device time that the sequence does not account for is either a pause of the device, which the host sees as well,
        // or a step, which it does not. A delay on the way leaves device time and sequence in agreement. Steps back by less than a
        // period cannot be told from jitter; they show as excess delay in the map's uncertainty.
        let expected = self.period_us()?.saturating_mul(i64::from(ahead));
        let unexplained = device_delta.saturating_sub(expected);
        let against_host = device_delta.saturating_sub(host_delta);
        let stepped = unexplained >= LEAST_STEP_US
            && against_host >= LEAST_STEP_US
            && unexplained.saturating_mul(2) >= against_host
            && host_delta.saturating_sub(expected).saturating_abs() < against_host;
        if !stepped {
            return None;
        }
        // A small step must also arrive earlier than the old map allows; what had waited in front of the port does so as well.
        let segment = self.segments.back()?;
        let earlier_us = -segment.map.delay_us(now.device_us, now.host_us);
        let witnessed = unexplained >= CLEAR_STEP_US || (segment.caught_up && earlier_us > 0.5 * unexplained as f64);
        witnessed.then_some(unexplained)
    }
}

/// The median, once there are enough to know it.
fn median<'a>(periods: impl Iterator<Item = &'a i64>) -> Option<i64> {
    let mut sorted: Vec<i64> = periods.copied().collect();
    if sorted.len() < 5 {
        return None;
    }
    sorted.sort_unstable();
    Some(sorted[sorted.len() / 2])
}

/// Whether `behind` sequence numbers back account for so much device time back: else a step of the clock lies between.
fn explains<'a>(periods: impl Iterator<Item = &'a i64>, behind: u32, device_delta: i64) -> bool {
    let period = median(periods).unwrap_or(100_000);
    device_delta < 0 && device_delta >= period.saturating_mul(-2 * i64::from(behind)).saturating_sub(LEAST_STEP_US)
}

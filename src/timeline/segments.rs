//! One device's clock over a session: a new map after each step, reset or re-opening.

use std::collections::VecDeque;

use super::clock::{ClockEstimate, ClockMap};

/// Smaller disagreements than this are delay and jitter, not steps.
const LEAST_STEP_US: i64 = 10_000;
/// From here on a forward step needs no second witness.
const CLEAR_STEP_US: i64 = 200_000;
/// A clock may run back by this much from sample to sample without a step.
const BACKWARD_JITTER_US: i64 = 2_000;
/// Sequence numbers may be this far behind and still be reordered, not restarted.
const REORDER_DEPTH: i32 = 1000;
/// Differences kept to know the sample period.
const PERIODS: usize = 31;
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
    /// The device's clock jumped while its sequence went on.
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
    /// The same sequence number and time as the last one.
    Duplicate,
}

/// All segments of a device.
#[derive(Clone, Debug, Default)]
pub struct DeviceClock {
    segments: VecDeque<Segment>,
    last: Option<Last>,
    periods: VecDeque<i64>,
    /// Sequence numbers since the last sample that belong to messages without a measurement.
    others: i32,
    next_id: u32,
    steps: u64,
    resets: u64,
}

impl DeviceClock {
    /// Takes the stamps of one sample and says where it belongs.
    pub fn observe(&mut self, epoch: u32, sequence: u32, device_us: i64, host_us: i64) -> Placed {
        let now = Last { epoch, sequence, device_us, host_us };
        let Some(last) = self.last else { return self.begin(now, SegmentStart::First, 0) };
        if epoch != last.epoch {
            return self.begin(now, SegmentStart::Epoch, 0);
        }
        let ahead = sequence.wrapping_sub(last.sequence) as i32;
        let device_delta = device_us - last.device_us;
        if ahead == 0 && device_delta == 0 {
            return Placed::Duplicate;
        }
        if (-REORDER_DEPTH..0).contains(&ahead) && device_delta < 0 && self.explains(ahead, device_delta) {
            let Some(segment) = self.segments.back_mut() else { return self.begin(now, SegmentStart::First, 0) };
            segment.map.push(device_us, host_us);
            return Placed::Late(segment.id);
        }
        if ahead <= 0 {
            self.resets += 1;
            return self.begin(now, SegmentStart::Reset, 0);
        }
        // Messages without a measurement took numbers, but no sample period.
        let ahead = (ahead - std::mem::take(&mut self.others)).max(1);
        if let Some(step_us) = self.step(&last, &now, ahead) {
            self.steps += 1;
            return self.begin(now, SegmentStart::Step, step_us);
        }
        self.periods.push_back(device_delta / i64::from(ahead));
        if self.periods.len() > PERIODS {
            self.periods.pop_front();
        }
        self.last = Some(now);
        let Some(segment) = self.segments.back_mut() else { return self.begin(now, SegmentStart::First, 0) };
        segment.map.push(device_us, host_us);
        Placed::InOrder(segment.id)
    }

    /// Notes a message that measures nothing (metadata) but has a sequence number.
    pub fn skip(&mut self, epoch: u32, sequence: u32) {
        if let Some(last) = self.last
            && last.epoch == epoch
            && (1..REORDER_DEPTH).contains(&(sequence.wrapping_sub(last.sequence) as i32))
        {
            self.others += 1;
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
        if self.periods.len() < 5 {
            return None;
        }
        let mut sorted: Vec<i64> = self.periods.iter().copied().collect();
        sorted.sort_unstable();
        Some(sorted[sorted.len() / 2])
    }

    fn begin(&mut self, now: Last, start: SegmentStart, step_us: i64) -> Placed {
        // The same crystal goes on after a step or a re-opening; what was learnt of its rate stays, unless nothing was.
        let carried = self.segments.back().map(|s| s.map.drift()).filter(|(_, sigma)| *sigma < 20e-6).map(|(drift, _)| drift);
        let id = self.next_id;
        self.next_id += 1;
        let map = ClockMap::new(now.device_us, now.host_us, carried);
        self.segments.push_back(Segment { id, epoch: now.epoch, start, step_us, first_host_us: now.host_us, map });
        if self.segments.len() > SEGMENTS {
            self.segments.pop_front();
        }
        self.last = Some(now);
        self.others = 0;
        Placed::InOrder(id)
    }

    /// Whether `behind` sequence numbers back account for so much device time back.
    fn explains(&self, behind: i32, device_delta: i64) -> bool {
        let period = self.period_us().unwrap_or(100_000);
        device_delta >= i64::from(behind) * period * 2 - LEAST_STEP_US
    }

    /// By how much the device's clock jumped between two consecutive samples, if it did.
    fn step(&self, last: &Last, now: &Last, ahead: i32) -> Option<i64> {
        let device_delta = now.device_us - last.device_us;
        let host_delta = now.host_us - last.host_us;
        if device_delta < -BACKWARD_JITTER_US {
            let expected = self.period_us().map_or(host_delta, |period| period * i64::from(ahead));
            return Some(device_delta - expected);
        }
        // Device time that the sequence does not account for is either a pause of the device, which the host sees as well,
        // or a step, which it does not. A delay on the way leaves device time and sequence in agreement. Steps back by less than a
        // period cannot be told from jitter; they show as excess delay in the map's uncertainty.
        let expected = self.period_us()? * i64::from(ahead);
        let unexplained = device_delta - expected;
        let against_host = device_delta - host_delta;
        let stepped = unexplained >= LEAST_STEP_US
            && against_host >= LEAST_STEP_US
            && 2 * unexplained >= against_host
            && (host_delta - expected).abs() < against_host;
        if !stepped {
            return None;
        }
        // A small step must also arrive earlier than the old map allows.
        let map = &self.segments.back()?.map;
        let earlier_us = -map.delay_us(now.device_us, now.host_us);
        let witnessed = unexplained >= CLEAR_STEP_US || earlier_us > 0.5 * unexplained as f64;
        witnessed.then_some(unexplained)
    }
}

//! The samples of one device in bounded memory, found by host time.

use std::collections::VecDeque;

use serde::Serialize;

use super::segments::{DeviceClock, Placed};
use crate::telemetry::Sequenced;

/// What a track keeps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Retention {
    /// Samples that arrived longer before the newest are dropped.
    pub age_us: i64,
    /// Most samples.
    pub samples: usize,
}

impl Default for Retention {
    /// Ten minutes, and room for 300 Hz.
    fn default() -> Self {
        Self { age_us: 600_000_000, samples: 200_000 }
    }
}

/// A sample with all its times but the mapped one, which improves while data come in.
#[derive(Clone, Debug)]
pub struct Entry<T> {
    /// Segment of the device's clock.
    pub segment: u32,
    /// Opening of the port.
    pub epoch: u32,
    /// Sequence number.
    pub sequence: u32,
    /// Raw device time.
    pub device_us: i64,
    /// Host arrival.
    pub host_us: i64,
    /// What was measured.
    pub value: T,
}

/// The times of one sample.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Stamps {
    /// Raw device time.
    pub device_us: i64,
    /// Host arrival.
    pub host_us: i64,
    /// Host time at which it was measured, as the clock map has it now.
    pub mapped_us: i64,
    /// Uncertainty of `mapped_us`, one standard deviation.
    pub uncertainty_us: f64,
    /// Opening of the port.
    pub epoch: u32,
    /// Segment of the device's clock.
    pub segment: u32,
}

/// How an answer rests on samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Support {
    /// Interpolated between two samples.
    Between,
    /// The last sample, held: nothing newer is there.
    Held,
}

/// A value at a host time, and what it rests on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Answer<T> {
    /// Interpolated; entries that were not measured on either side are NaN.
    pub value: T,
    /// Interpolated or held.
    pub support: Support,
    /// Time between the two samples, or since the last one.
    pub gap_us: i64,
    /// Time to the nearer sample.
    pub age_us: i64,
    /// Of the samples' times, one standard deviation.
    pub uncertainty_us: f64,
    /// Whether the port was re-opened, or the clock stepped, between the two samples.
    pub across_break: bool,
}

impl<T> Answer<T> {
    /// The same with another value.
    pub fn map<U>(self, f: impl FnOnce(T) -> U) -> Answer<U> {
        Answer {
            value: f(self.value),
            support: self.support,
            gap_us: self.gap_us,
            age_us: self.age_us,
            uncertainty_us: self.uncertainty_us,
            across_break: self.across_break,
        }
    }
}

/// The samples around a host time.
pub struct Bracket<'a, T> {
    /// Last sample not after the time.
    pub left: &'a Entry<T>,
    /// First sample after it.
    pub right: Option<&'a Entry<T>>,
    /// From `left` (0) to `right` (1).
    pub fraction: f64,
    answer: Answer<()>,
}

impl<T> Bracket<'_, T> {
    /// `value` with what it rests on.
    pub fn answer<U>(&self, value: U) -> Answer<U> {
        self.answer.map(|()| value)
    }
}

/// Samples of one device in the order of its clock.
#[derive(Clone, Debug)]
pub struct Track<T> {
    clock: DeviceClock,
    entries: VecDeque<Entry<T>>,
    retention: Retention,
    dropped: u64,
    unusable: u64,
    no_time: u64,
    late: u64,
    /// What device times are counted from.
    origin_us: Option<u64>,
    last_host_us: Option<i64>,
}

/// Times beyond this (285 years), the device's from that of its first sample, are no times. Smaller ones are exact in an `f64`, and sums of a few
/// of them fit.
const LARGEST_US: u64 = 1 << 53;

impl<T> Track<T> {
    /// Empty.
    #[must_use]
    pub fn new(retention: Retention) -> Self {
        Self {
            clock: DeviceClock::default(),
            entries: VecDeque::new(),
            retention,
            dropped: 0,
            unusable: 0,
            no_time: 0,
            late: 0,
            origin_us: None,
            last_host_us: None,
        }
    }

    /// The device has no clock: the times of its samples are the host's, with this standard deviation. Before the first sample.
    pub fn keep_host_time(&mut self, sigma_us: f64) {
        self.clock = DeviceClock::of_host(sigma_us);
    }

    /// Notes a message that carries no sample (metadata).
    pub fn skip(&mut self, host_us: i64, epoch: u32, sequenced: Sequenced) {
        self.clock.skip(epoch, sequenced);
        if host_us.unsigned_abs() >= LARGEST_US {
            return;
        }
        self.last_host_us = Some(self.last_host_us.map_or(host_us, |last| last.max(host_us)));
    }

    /// Takes one sample with the decoder's verdict on its number; `None` if it was a duplicate or its time is unusable. The flag says
    /// whether it came in order.
    pub fn push(
        &mut self,
        host_us: i64,
        epoch: u32,
        (sequence, sequenced): (u32, Sequenced),
        device_us: u64,
        value: T,
    ) -> Option<(Stamps, bool)> {
        if sequenced == Sequenced::Duplicate {
            return None;
        }
        let device_us = self.counted_from_origin(
            device_us,
            sequenced == Sequenced::Reset || self.entries.back().is_some_and(|e| e.epoch != epoch),
        );
        let no_time = device_us.unsigned_abs() >= LARGEST_US;
        if no_time || host_us.unsigned_abs() >= LARGEST_US {
            self.unusable += 1;
            self.no_time += u64::from(no_time);
            return None;
        }
        self.last_host_us = Some(self.last_host_us.map_or(host_us, |last| last.max(host_us)));
        let placed = self.clock.observe(epoch, sequenced, sequence, device_us, host_us);
        let (segment, in_order) = match placed {
            Placed::InOrder(segment) => (segment, true),
            Placed::Late(segment) => (segment, false),
            Placed::Stray => {
                self.unusable += 1;
                return None;
            }
        };
        let entry = Entry { segment, epoch, sequence, device_us, host_us, value };
        if in_order {
            self.entries.push_back(entry);
        } else {
            self.late += 1;
            let at = self.entries.partition_point(|e| (e.segment, e.device_us) <= (segment, device_us));
            self.entries.insert(at, entry);
        }
        self.prune(host_us);
        Some((self.stamps_of(segment, epoch, device_us, host_us)?, in_order))
    }

    /// Device time from where it is counted: of usual epochs it stays as it is, one that runs over goes on. A device that `began` anew may do so
    /// in another epoch, and one time alone may have been none.
    fn counted_from_origin(&mut self, device_us: u64, began: bool) -> i64 {
        let own_us = if device_us < LARGEST_US / 2 { 0 } else { device_us };
        let origin_us = *self.origin_us.get_or_insert(own_us);
        let from = |origin_us: u64| match origin_us {
            0 => i64::try_from(device_us).unwrap_or(i64::MAX),
            origin_us => device_us.wrapping_sub(origin_us).cast_signed(),
        };
        if from(origin_us).unsigned_abs() >= LARGEST_US && (began || origin_us > 0 && self.entries.len() <= 1) {
            self.origin_us = Some(own_us);
            return from(own_us);
        }
        from(origin_us)
    }

    /// The samples around `host_us`; `None` before the first one.
    #[must_use]
    pub fn bracket(&self, host_us: i64) -> Option<Bracket<'_, T>> {
        // Mapped times ascend within a segment; segments are searched from the newest, so that of overlapping ones the newer wins.
        let mut end = self.entries.len();
        while end > 0 {
            let segment = self.entries[end - 1].segment;
            let begin = self.entries.partition_point(|e| e.segment < segment);
            let map = &self.clock.segment(segment)?.map;
            let wanted_device_us = map.device_from_host_us(host_us);
            let after = self.entries.partition_point(|e| (e.segment, e.device_us) <= (segment, wanted_device_us));
            if after > begin {
                return Some(self.bracket_at(after - 1, host_us));
            }
            end = begin;
        }
        None
    }

    fn bracket_at(&self, index: usize, host_us: i64) -> Bracket<'_, T> {
        let left = &self.entries[index];
        let (left_us, left_sigma) = self.mapped(left);
        let since_us = host_us.saturating_sub(left_us).max(0);
        let Some(right) = self.entries.get(index + 1) else {
            let answer = Answer {
                value: (),
                support: Support::Held,
                gap_us: since_us,
                age_us: since_us,
                uncertainty_us: left_sigma,
                across_break: false,
            };
            return Bracket { left, right: None, fraction: 0.0, answer };
        };
        let (right_us, right_sigma) = self.mapped(right);
        let gap_us = right_us.saturating_sub(left_us).max(0);
        let fraction = if gap_us > 0 { (since_us as f64 / gap_us as f64).clamp(0.0, 1.0) } else { 0.0 };
        let answer = Answer {
            value: (),
            support: Support::Between,
            gap_us,
            age_us: since_us.min(right_us.saturating_sub(host_us).max(0)),
            uncertainty_us: left_sigma.max(right_sigma),
            across_break: left.segment != right.segment,
        };
        Bracket { left, right: Some(right), fraction, answer }
    }

    /// Mapped host time of an entry, and its uncertainty.
    #[must_use]
    pub fn mapped(&self, entry: &Entry<T>) -> (i64, f64) {
        match self.clock.segment(entry.segment) {
            Some(segment) => (segment.map.host_from_device_us(entry.device_us), segment.map.uncertainty_us(entry.device_us)),
            None => (entry.host_us, f64::INFINITY),
        }
    }

    /// Mapped host time of the newest sample.
    #[must_use]
    pub fn newest_mapped_us(&self) -> Option<i64> {
        self.entries.back().map(|entry| self.mapped(entry).0)
    }

    /// Until when what was measured is known with its time: as [`Track::newest_mapped_us`], without samples that had waited in front of a port
    /// just opened, as long as nobody knows for how long.
    #[must_use]
    pub fn told_until_us(&self) -> Option<i64> {
        match self.clock.latest().filter(|segment| !segment.caught_up) {
            Some(latest) => {
                let begin = self.entries.partition_point(|entry| entry.segment < latest.id);
                self.entries.get(begin.checked_sub(1)?).map(|entry| self.mapped(entry).0)
            }
            None => self.newest_mapped_us(),
        }
    }

    /// The newest sample.
    #[must_use]
    pub fn newest(&self) -> Option<&Entry<T>> {
        self.entries.back()
    }

    /// All samples, oldest first.
    pub fn entries(&self) -> impl DoubleEndedIterator<Item = &Entry<T>> + ExactSizeIterator {
        self.entries.iter()
    }

    /// Host arrival of the newest message of any kind.
    #[must_use]
    pub fn last_arrival_us(&self) -> Option<i64> {
        self.last_host_us
    }

    /// The device's clock.
    #[must_use]
    pub fn clock(&self) -> &DeviceClock {
        &self.clock
    }

    /// Samples forgotten to bound memory, samples with unusable times, samples that came late.
    #[must_use]
    pub fn dropped_unusable_late(&self) -> (u64, u64, u64) {
        (self.dropped, self.unusable, self.late)
    }

    /// Samples whose device time is none.
    #[must_use]
    pub fn no_time(&self) -> u64 {
        self.no_time
    }

    /// The times of a sample, as they are known by now.
    pub(super) fn stamps_of(&self, segment: u32, epoch: u32, device_us: i64, host_us: i64) -> Option<Stamps> {
        let map = &self.clock.segment(segment)?.map;
        let (mapped_us, uncertainty_us) = (map.host_from_device_us(device_us), map.uncertainty_us(device_us));
        Some(Stamps { device_us, host_us, mapped_us, uncertainty_us, epoch, segment })
    }

    fn prune(&mut self, now_us: i64) {
        let oldest_us = now_us.saturating_sub(self.retention.age_us);
        while self.entries.len() > self.retention.samples.max(2)
            || (self.entries.len() > 2 && self.entries[0].host_us < oldest_us)
            || (self.entries.len() > 1 && self.clock.segment(self.entries[0].segment).is_none())
        {
            self.entries.pop_front();
            self.dropped += 1;
        }
        if let Some(first) = self.entries.front() {
            self.clock.forget_before(first.segment);
        }
    }
}

//! The exposures as the binder sees them: by time, by counter, and which frame has which.

use std::collections::BTreeMap;

use super::console::Pair;
use super::exposure::{ExposureInterval, ExposureTracker};

/// Arrivals from this long after the end of an exposure (or, of a picture stored while the beam is on, after its begin) …
const LEAST_DELAY_US: i64 = 50_000;
/// … up to this long are prompt.
pub(super) const PROMPT_US: i64 = 6_000_000;
/// Frames within this time of each other may be of a batch.
pub(super) const BATCH_US: i64 = 800_000;
/// A frame whose telemetry has not come after this long is judged without it.
pub(super) const PATIENCE_US: i64 = 1_000_000;
/// An exposure of which only the counter tells may still turn out to be the one that begins now.
const UNSEEN_GRACE_US: i64 = 500_000;

/// What the end of an exposure may lie earlier than the sample without X-rays that shows it, at usual rates.
const SLACK_US: i64 = 60_000;

/// Ends known worse than this teach nothing: where the C-arm counts, and where it does not, so that another exposure may hide there.
const SHARP_US: [f64; 2] = [300_000.0, 100_000.0];

/// What binding needs of an exposure.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shot {
    pub index: u64,
    /// The earliest and the latest that the beam can have been on: an end that fell into a gap lies anywhere in it.
    pub start_us: i64,
    pub end_us: i64,
    /// The earliest that it can have been over: a frame that came in the silence which hides its end may still be of it.
    pub over_us: i64,
    /// The latest that it can have begun.
    pub begun_us: i64,
    pub counter: Option<u32>,
    /// Both ends are known well enough: its times can teach the console's offset.
    pub whole: bool,
    /// The frame that has it.
    pub frame: Option<u32>,
    /// Frames that arrived promptly after it, or while it was on.
    pub prompt_frames: u32,
}

impl Shot {
    /// Whether it was over at `us`, as far as telemetry can tell.
    fn has_ended(&self, us: i64) -> bool {
        // Slow telemetry may show the end of an exposure only after its frame came.
        self.end_us.min(self.over_us.saturating_add(SLACK_US)) <= us
    }

    /// What a stamp with this resolution says of the console's offset if it is of this exposure.
    pub(super) fn pair(&self, console_us: i64, resolution_us: i64) -> Pair {
        Pair::of(console_us, resolution_us, [self.start_us, self.begun_us], [self.over_us, self.end_us])
    }
}

/// All exposures so far, in order of time.
#[derive(Clone, Debug, Default)]
pub(super) struct Shots {
    list: Vec<Shot>,
    by_number: BTreeMap<i64, Vec<usize>>,
    /// The C-arm counts its exposures.
    pub counted: bool,
    longest_us: i64,
}

impl Shots {
    /// Takes what the tracker has closed since; returns the positions of new exposures.
    pub(super) fn follow(&mut self, tracker: &ExposureTracker, newest_us: Option<i64>) -> std::ops::Range<usize> {
        let before = self.list.len();
        let known = self.list.last().map(|shot| shot.index);
        let closed = tracker.closed();
        let first = known.map_or(0, |known| closed.partition_point(|interval| interval.index <= known));
        for interval in closed.iter().skip(first) {
            let certain = newest_us.is_some_and(|newest_us| newest_us >= interval.end_us.saturating_add(UNSEEN_GRACE_US));
            if interval.samples == 0 && !certain {
                break;
            }
            self.take(interval);
        }
        before..self.list.len()
    }

    fn take(&mut self, interval: &ExposureInterval) {
        let at = self.list.len();
        self.counted |= interval.counter.is_some();
        let number = interval.counter.map_or(interval.index as i64, i64::from);
        self.by_number.entry(number).or_default().push(at);
        let (start_uncertainty_us, end_uncertainty_us) =
            (interval.start_uncertainty_us as i64, interval.end_uncertainty_us as i64);
        let (start_us, end_us, over_us, begun_us) = match interval.samples {
            // Anywhere in the silence that it is reported with.
            0 => (interval.start_us, interval.end_us, interval.start_us, interval.end_us),
            _ => (
                interval.start_us.saturating_sub(start_uncertainty_us),
                interval.end_us.saturating_add(end_uncertainty_us),
                interval.end_us.saturating_sub(end_uncertainty_us),
                interval.start_us.saturating_add(start_uncertainty_us),
            ),
        };
        let sharp_us = SHARP_US[usize::from(interval.counter.is_none())];
        let sharp = interval.start_uncertainty_us.max(interval.end_uncertainty_us) < sharp_us;
        // Telemetry that is too slow to see an exposure still tells between which two samples it was.
        let seen = interval.start_seen && interval.end_seen || interval.samples == 0 && interval.counter.is_some();
        self.longest_us = self.longest_us.max(end_us.saturating_sub(start_us));
        self.list.push(Shot {
            index: interval.index,
            start_us,
            end_us,
            over_us,
            begun_us,
            counter: interval.counter,
            whole: seen && sharp,
            frame: None,
            prompt_frames: 0,
        });
    }

    pub(super) fn get(&self, at: usize) -> Shot {
        self.list[at]
    }

    pub(super) fn get_mut(&mut self, at: usize) -> &mut Shot {
        &mut self.list[at]
    }

    pub(super) fn len(&self) -> usize {
        self.list.len()
    }

    /// Position of the exposure with this index.
    pub(super) fn position(&self, index: u64) -> Option<usize> {
        self.list.binary_search_by_key(&index, |shot| shot.index).ok()
    }

    /// The number that a console's counter is compared with: the C-arm's own, else the place in the session.
    pub(super) fn number(&self, at: usize) -> Option<i64> {
        let shot = self.list[at];
        if self.counted { shot.counter.map(i64::from) } else { Some(shot.index as i64) }
    }

    /// Positions with this number.
    pub(super) fn numbered(&self, number: i64) -> &[usize] {
        self.by_number.get(&number).map_or(&[], Vec::as_slice)
    }

    /// Positions of exposures that touch [`from_us`, `to_us`].
    pub(super) fn touching(&self, from_us: i64, to_us: i64) -> impl Iterator<Item = usize> + use<'_> {
        let reach_us = from_us.saturating_sub(self.longest_us);
        let first = self.list.partition_point(|shot| shot.start_us < reach_us);
        let last = self.list.partition_point(|shot| shot.start_us <= to_us);
        (first..last.max(first)).filter(move |at| self.list[*at].end_us >= from_us)
    }

    /// Positions of exposures after which an arrival at `arrival_us` is prompt.
    pub(super) fn prompt(&self, arrival_us: i64) -> Vec<usize> {
        let (from_us, to_us) = (arrival_us.saturating_sub(PROMPT_US), arrival_us.saturating_sub(LEAST_DELAY_US));
        self.touching(from_us, to_us).filter(|at| self.list[*at].has_ended(to_us)).collect()
    }

    /// Position of the exposure that was on at `arrival_us`, or had ended only just then.
    pub(super) fn on_at(&self, arrival_us: i64) -> Option<usize> {
        let to_us = arrival_us.saturating_sub(LEAST_DELAY_US);
        let on = |shot: &Shot| shot.begun_us <= to_us && !shot.has_ended(to_us);
        self.touching(to_us.saturating_sub(PROMPT_US), to_us).filter(|at| on(&self.list[*at])).last()
    }

    /// Whether an arrival at `arrival_us` is prompt after the exposure at this position, or came while that was on.
    pub(super) fn is_near(&self, at: usize, arrival_us: i64) -> bool {
        self.on_at(arrival_us) == Some(at) || self.prompt(arrival_us).contains(&at)
    }

    /// Whether a frame that came while the exposure at this position was on may be of it: consoles export the first image, or the last pulses,
    /// before the beam ends. A late frame of an exposure before is more likely, as long as one waits for its frame: the one right before, or
    /// one of those after which the arrival is `prompt`.
    pub(super) fn may_come_early(&self, at: usize, prompt: &[usize]) -> bool {
        let waits = |other: usize| self.list.get(other).is_some_and(|shot| shot.frame.is_none() && shot.prompt_frames == 0);
        !prompt.iter().copied().chain(at.checked_sub(1)).any(waits)
    }

    /// Whether an exposure is still to be taken that is over, or of which only the counter tells.
    pub(super) fn lags(&self, tracker: &ExposureTracker) -> bool {
        tracker.is_ending() || self.awaits_unseen(tracker)
    }

    /// Whether an exposure of which only the counter tells is still to be taken: stamps from a silence fit those that are here, for want of it.
    pub(super) fn awaits_unseen(&self, tracker: &ExposureTracker) -> bool {
        let last = tracker.closed().back();
        last.is_some_and(|last| last.samples == 0 && self.list.last().is_none_or(|shot| shot.index < last.index))
    }
}

/// Whether the exposure, which has not ended yet, was on at `arrival_us`, for long enough that a picture of it may have come.
pub(super) fn was_on(open: &ExposureInterval, arrival_us: i64) -> bool {
    let begun_us = open.start_us.saturating_add(open.start_uncertainty_us as i64);
    begun_us.saturating_add(LEAST_DELAY_US) <= arrival_us
}

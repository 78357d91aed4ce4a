//! What is known of frames, exposures and the console: the binder fills it, every judgement reads it.

use std::collections::{BTreeMap, BTreeSet};

use super::Timeline;
use super::agreement::OCCASION_US;
use super::console::{ConsoleClock, ConsoleOffset, Pair, SCATTER_US};
use super::counting::Counting;
use super::evidence::{Binding, BindingHow, FrameEvidence, flags_of, span_of, time_within};
use super::exposure::ExposureInterval;
use super::shots::Shots;

/// A stamp at a whole one of these may be all that the console writes.
pub(super) const MINUTE_US: i64 = 60_000_000;
/// Frames that take part in an agreement: the latest.
const VOTERS: usize = 48;
/// An offset is used from so many frames on.
pub(super) const KNOWN_FRAMES: u32 = 2;

/// A frame (or the first image of a run) and what is known of it.
#[derive(Clone, Debug)]
pub(super) struct Pending {
    pub evidence: FrameEvidence,
    /// Exposures after which it arrived promptly, once telemetry has reached its arrival.
    pub prompt: Option<Vec<usize>>,
    /// Index of the exposure that was on at its arrival and has not ended yet: it may be of that one.
    pub running: Option<u64>,
    pub binding: Binding,
    /// Images of the same run, itself not.
    pub images: Vec<u32>,
    /// The exposures of the file's images, where each has its own.
    pub apart: Vec<ExposureInterval>,
}

impl Pending {
    /// Its exposures are still to be met.
    pub fn new(evidence: FrameEvidence, binding: Binding) -> Self {
        Self { evidence, prompt: None, running: None, binding, images: Vec::new(), apart: Vec::new() }
    }

    /// The exposures that it has: one, or as many as the images of its file where each has its own.
    pub fn exposures(&self) -> &[ExposureInterval] {
        if self.apart.is_empty() { self.binding.exposure.as_slice() } else { &self.apart }
    }
}

/// What is known so far.
#[derive(Clone, Debug, Default)]
pub(super) struct Known {
    pub shots: Shots,
    pub frames: BTreeMap<u32, Pending>,
    /// Frames without an exposure that may still get one.
    pub open: BTreeSet<u32>,
    /// Latest frames with prompt exposures.
    pub voters: Vec<u32>,
    /// By content: the frame that stands for it, and the images seen.
    pub contents: BTreeMap<String, (u32, BTreeMap<u32, u32>)>,
    /// The console's offset, a new one whenever its clock was set.
    pub offsets: Vec<ConsoleOffset>,
    /// The time zone of its stamps where files state one, minutes east of UTC.
    pub zone_min: Option<i32>,
    pub counting: Counting,
    /// Frames by the console's stamp: a later stamp is a later exposure.
    pub by_stamp: BTreeMap<i64, Vec<u32>>,
    /// Stamps at a whole minute, and others.
    pub whole_minutes: u32,
    pub other_stamps: u32,
    /// Frames that came when no exposure was near.
    pub strays: u32,
    /// No more telemetry will come.
    pub finished: bool,
}

impl Known {
    /// The console's clock, once frames agree on it.
    pub fn clock(&self) -> Option<ConsoleClock> {
        self.offsets.iter().rev().find_map(ConsoleOffset::summary).filter(|clock| clock.frames >= KNOWN_FRAMES)
    }

    /// Ties the frame to the exposure at `shot` and learns from it; its binding.
    pub fn bind(
        &mut self,
        frame: u32,
        shot: usize,
        exposure: ExposureInterval,
        how: BindingHow,
        evidence: Vec<String>,
        teaches: bool,
    ) -> Option<Binding> {
        self.open.remove(&frame);
        self.counting.settled(frame);
        self.shots.get_mut(shot).frame = Some(frame);
        let said = self.frames.get(&frame)?.evidence.clone();
        if let Some(counter) = said.counter.filter(|_| teaches) {
            self.counting.learn(&self.shots, shot, counter);
        }
        if let Some(pair) = self.pair(&said, shot)
            && teaches
            && self.shots.get(shot).whole
        {
            match self.offsets.last_mut() {
                Some(offset) => {
                    offset.learn(&pair);
                }
                None => {
                    let mut offset = ConsoleOffset::default();
                    offset.learn(&pair);
                    self.offsets.push(offset);
                }
            }
        }
        let span_us = span_of(&said, &exposure, self.stamped_within(&said));
        let time_us = Some(time_within(&said, &exposure, span_us));
        let flags = flags_of(&said, &exposure, span_us);
        Some(Binding { exposure: Some(exposure), how, evidence, settled: true, time_us, flags })
    }

    /// Host times that a frame's stamp names, once the console's clock is known.
    fn stamped_within(&self, said: &FrameEvidence) -> Option<[i64; 2]> {
        let (clock, console_us) = (self.clock()?, said.console_us?);
        let (at_us, either_way_us) =
            (console_us.saturating_add(clock.offset_us), clock.uncertainty_us.saturating_add(SCATTER_US));
        let to_us = at_us.saturating_add(self.resolution_us(said)).saturating_add(either_way_us);
        Some([at_us.saturating_sub(either_way_us), to_us])
    }

    /// What stamp and exposure together say of the console's offset.
    pub fn pair(&self, said: &FrameEvidence, shot: usize) -> Option<Pair> {
        Some(self.shots.get(shot).pair(said.console_us?, self.resolution_us(said)))
    }

    /// Resolution of a frame's stamp: a console that writes whole minutes writes zeros for the seconds.
    pub fn resolution_us(&self, said: &FrameEvidence) -> i64 {
        let whole = said.console_us.is_some_and(|us| us.rem_euclid(MINUTE_US) == 0);
        if whole && self.whole_minutes >= self.other_stamps { MINUTE_US } else { said.console_resolution_us.max(1) }
    }

    /// Whether a frame lacks what most others have.
    pub fn others_say_more(&self, said: &FrameEvidence) -> bool {
        let standing = self.contents.len() as u32;
        let stamped = self.whole_minutes + self.other_stamps;
        said.console_us.is_none() && 2 * stamped > standing || said.counter.is_none() && 2 * self.counting.frames() > standing
    }

    /// Whether telemetry was silent between two exposures; a silence that hides the end of one may hide another exposure as well.
    pub fn hidden(&self, from: usize, to: usize, timeline: &Timeline) -> bool {
        let (from, to) = (self.shots.get(from), self.shots.get(to));
        timeline.exposure_tracker().blind_spot(from.over_us, to.begun_us.max(from.over_us)).is_some()
    }

    /// Whether the frame, whose counter names the exposure at `at`, may be of `other`, which waits for its frame.
    pub fn rival(&self, said: &FrameEvidence, at: usize, other: usize) -> bool {
        let may_be = || said.counter.is_none_or(|counter| self.counting.may_be(&self.shots, counter, at, other));
        other != at && self.shots.get(other).frame.is_none() && may_be()
    }

    /// Whether the counter may have begun anew: prompt frames wait whose counter is not what the known shifts say, and which are no late
    /// ones either, or which have another shift in common on two occasions.
    pub fn restless(&self) -> bool {
        let waiting = self.voters.iter().filter(|frame| self.open.contains(frame)).filter_map(|frame| self.frames.get(frame));
        let (mut strange, mut others) = (0, BTreeMap::<i64, Vec<i64>>::new());
        for pending in waiting {
            let (Some(counter), Some(arrival_us)) = (pending.evidence.counter, pending.evidence.arrival_us) else { continue };
            let shift = |at: &usize| self.shots.number(*at).map(|number| i64::from(counter) - number);
            let shifts: Vec<i64> = pending.prompt.iter().flatten().filter_map(shift).collect();
            if shifts.is_empty() || shifts.iter().any(|shift| self.counting.knows(*shift)) {
                continue;
            }
            let waits = |at: &usize| self.shots.get(*at).frame.is_none() && self.shots.get(*at).over_us <= arrival_us;
            if !self.counting.shifts().any(|shift| self.shots.numbered(i64::from(counter) - shift).iter().any(waits)) {
                strange += 1;
            }
            for shift in shifts {
                others.entry(shift).or_default().push(arrival_us);
            }
        }
        let apart = |times: &Vec<i64>| {
            times.iter().max().zip(times.iter().min()).is_some_and(|(last, first)| last.saturating_sub(*first) >= OCCASION_US)
        };
        strange > 1 || others.values().any(apart)
    }

    /// Takes the frame among those that agreements are made of.
    pub fn vote(&mut self, frame: u32) {
        self.voters.push(frame);
        if self.voters.len() > VOTERS {
            self.voters.remove(0);
        }
    }

    /// Whether the frame came before the exposure at `at` had ended.
    pub fn was_on_for(&self, said: &FrameEvidence, at: usize) -> bool {
        said.arrival_us.is_some_and(|arrival_us| arrival_us < self.shots.get(at).over_us)
    }

    /// Whether the frame's counter is the number of the exposure at `at`, the C-arm's own or by a shift that frames have shown.
    pub fn counter_names(&self, said: &FrameEvidence, at: usize) -> bool {
        let shift = said.counter.zip(self.shots.number(at)).map(|(counter, number)| i64::from(counter) - number);
        shift.is_some_and(|shift| self.shots.counted && shift == 0 || self.counting.knows(shift))
    }

    /// Whether any offset that is known, at that time, allows the pair.
    pub fn allowed(&self, pair: &Pair) -> bool {
        let known: Vec<&ConsoleOffset> = self.known_offsets().collect();
        known.iter().enumerate().any(|(i, offset)| {
            // Between the last frame of one setting and the first of the next either may hold.
            let after =
                i.checked_sub(1).and_then(|before| known[before].span_us()).is_none_or(|(_, last_us)| pair.any.at_us >= last_us);
            let before = known.get(i + 1).and_then(|next| next.span_us()).is_none_or(|(first_us, _)| pair.any.at_us <= first_us);
            after && before && offset.allows(pair)
        })
    }

    pub fn known_offsets(&self) -> impl Iterator<Item = &ConsoleOffset> {
        self.offsets.iter().filter(|offset| offset.summary().is_some_and(|clock| clock.frames >= KNOWN_FRAMES))
    }
}

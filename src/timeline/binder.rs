//! Frames to exposures, as they come: what console, counter and arrival say is weighed by what they have proved to be worth so far.
//!
//! Nothing about the console is assumed but that its clock drifts slowly. Its offset and the meaning of its counter are learnt from
//! frames that arrive promptly and agree with each other ([`super::agreement`]). A frame is then bound where exactly one exposure fits
//! everything that is known; whatever leaves two readings is left unbound and asked again when more is known. There is no binding by
//! elimination: that another exposure has its frame does not prove that a second picture is not of it too.
//!
//! Pure: no clock, no disk. The same calls give the same answers, live and in a replay.

use std::collections::{BTreeMap, BTreeSet};

use super::Timeline;
use super::agreement::OCCASION_US;
use super::console::{ConsoleClock, ConsoleOffset, Pair};
use super::counting::Counting;
use super::evidence::{Binding, BindingFlag, BindingHow, FrameEvidence, flags_of, time_within};
use super::judgement::{Judgement, Weighed};
use super::series::SeriesStamps;
use super::shots::{BATCH_US, PROMPT_US, Shots};

/// Frames that take part in an agreement: the latest.
const VOTERS: usize = 48;
/// A frame whose telemetry has not come after this long is judged without it.
const PATIENCE_US: i64 = 1_000_000;
const MINUTE_US: i64 = 60_000_000;
/// An offset is used from so many frames on.
pub(super) const KNOWN_FRAMES: u32 = 2;

/// A frame (or the first image of a run) and what is known of it.
#[derive(Clone, Debug)]
pub(super) struct Pending {
    pub evidence: FrameEvidence,
    /// Exposures after which it arrived promptly, once telemetry has reached its arrival.
    pub prompt: Option<Vec<usize>>,
    pub binding: Binding,
    /// Images of the same run, itself not.
    images: Vec<u32>,
}

/// Binds frames to the exposures of a [`Timeline`].
#[derive(Clone, Debug, Default)]
pub struct Binder {
    pub(super) shots: Shots,
    pub(super) frames: BTreeMap<u32, Pending>,
    /// Frames without an exposure that may still get one.
    pub(super) open: BTreeSet<u32>,
    /// Latest frames with prompt exposures.
    pub(super) voters: Vec<u32>,
    /// By content: the frame that stands for it, and the images seen.
    contents: BTreeMap<String, (u32, BTreeMap<u32, u32>)>,
    /// Images of a run (and copies) to the frame that stands for them.
    stands_for: BTreeMap<u32, (u32, Binding)>,
    /// The console's offset, a new one whenever its clock was set.
    pub(super) offsets: Vec<ConsoleOffset>,
    pub(super) counting: Counting,
    /// Frames by the console's stamp: a later stamp is a later exposure.
    pub(super) by_stamp: BTreeMap<i64, Vec<u32>>,
    /// Stamps at a whole minute, and others.
    whole_minutes: u32,
    other_stamps: u32,
    series: SeriesStamps,
    /// Frames that came when no exposure was near.
    pub(super) strays: u32,
    changed: BTreeSet<u32>,
    fresh: bool,
    pub(super) finished: bool,
}

impl Binder {
    /// Nothing known yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes a frame; frames are pushed in the order of their arrival, images of a run one by one.
    pub fn push(&mut self, mut evidence: FrameEvidence) {
        if self.series.found() {
            evidence.console_us = None;
        }
        let (frame, image) = (evidence.frame, evidence.image_of_file[0]);
        self.fresh = true;
        self.changed.insert(frame);
        if let Some((first, images)) = self.contents.get_mut(&evidence.content) {
            let first = *first;
            if let Some(same) = images.get(&image).copied() {
                let binding = Binding {
                    evidence: vec![format!("the content is that of frame {same}: a copy of its file, not another exposure")],
                    settled: true,
                    flags: vec![BindingFlag::Duplicate { of: same }],
                    ..Binding::default()
                };
                self.stands_for.insert(frame, (same, binding));
                return;
            }
            images.insert(image, frame);
            let mut own = Binding::default();
            if let Some(pending) = self.frames.get_mut(&first) {
                pending.images.push(frame);
                own = within_run(&pending.binding, &evidence);
            }
            self.stands_for.insert(frame, (first, own));
            // Kept for its own place within the run.
            self.frames.insert(frame, Pending { evidence, prompt: None, binding: Binding::default(), images: Vec::new() });
            return;
        }
        self.contents.insert(evidence.content.clone(), (frame, BTreeMap::from([(image, frame)])));
        if let Some(counter) = evidence.counter {
            self.counting.see(counter);
        }
        if let Some(console_us) = evidence.console_us {
            self.by_stamp.entry(console_us).or_default().push(frame);
        }
        match evidence.console_us {
            Some(us) if us.rem_euclid(MINUTE_US) == 0 => self.whole_minutes += 1,
            Some(_) => self.other_stamps += 1,
            None => {}
        }
        self.open.insert(frame);
        self.frames.insert(frame, Pending { evidence, prompt: None, binding: waiting(), images: Vec::new() });
    }

    /// Looks at what `timeline` has learnt; `now_us` is the host time. Returns the frames whose binding changed.
    pub fn update(&mut self, timeline: &Timeline, now_us: i64) -> Vec<u32> {
        let newest_us = timeline.carm().newest_mapped_us();
        let new_shots = !self.shots.follow(timeline.exposure_tracker(), newest_us).is_empty();
        let waits = self.open.iter().any(|frame| self.frames.get(frame).is_some_and(|pending| !pending.binding.settled));
        if self.fresh || new_shots || waits {
            self.fresh = false;
            self.meet(timeline, newest_us, now_us);
            self.settle(timeline, newest_us, now_us);
        }
        std::mem::take(&mut self.changed).into_iter().collect()
    }

    /// No more telemetry will come: judges every frame with what there is.
    pub fn finish(&mut self, timeline: &Timeline) -> Vec<u32> {
        self.finished = true;
        self.fresh = true;
        self.update(timeline, i64::MAX)
    }

    /// A frame's binding as it stands.
    #[must_use]
    pub fn binding(&self, frame: u32) -> Option<&Binding> {
        match self.stands_for.get(&frame) {
            Some((_, own)) => Some(own),
            None => self.frames.get(&frame).map(|pending| &pending.binding),
        }
    }

    /// The console's clock, once frames agree on it.
    #[must_use]
    pub fn clock(&self) -> Option<ConsoleClock> {
        self.offsets.iter().rev().find_map(ConsoleOffset::summary).filter(|clock| clock.frames >= KNOWN_FRAMES)
    }

    /// Finds the exposures shortly before frames whose arrival telemetry has reached.
    fn meet(&mut self, timeline: &Timeline, newest_us: Option<i64>, now_us: i64) {
        let open: Vec<u32> = self.open.iter().copied().collect();
        for frame in open {
            let before = frame.checked_sub(1).and_then(|before| self.frames.get(&before));
            let before_us = before.and_then(|before| before.evidence.arrival_us);
            let Some(pending) = self.frames.get_mut(&frame) else { continue };
            let Some(arrival_us) = pending.evidence.arrival_us else {
                pending.prompt = Some(Vec::new());
                continue;
            };
            let reached = newest_us.is_some_and(|newest_us| newest_us >= arrival_us);
            let patient = now_us.saturating_sub(arrival_us) < PATIENCE_US;
            if pending.prompt.is_some() || !reached && patient {
                continue;
            }
            let prompt = self.shots.prompt(arrival_us);
            let batch = before_us.is_some_and(|before_us| arrival_us.saturating_sub(before_us) <= BATCH_US);
            for at in &prompt {
                self.shots.get_mut(*at).prompt_frames += 1;
            }
            // One of a batch is late, whatever it comes after.
            if batch {
                self.counting.settled(frame.saturating_sub(1));
            } else if let ([at], Some(counter)) = (&prompt[..], pending.evidence.counter) {
                self.counting.doubt(&self.shots, *at, frame, counter);
            }
            if let (Some(last), Some(console_us)) = (prompt.last(), pending.evidence.console_us) {
                // A whole minute may be all that the console writes.
                let whole = console_us.rem_euclid(MINUTE_US) == 0;
                let resolution_us = if whole { MINUTE_US } else { pending.evidence.console_resolution_us };
                self.series.meet(console_us, resolution_us, self.shots.get(*last).end_us);
            }
            if prompt.is_empty() {
                self.strays += 1;
            } else if timeline.exposure_tracker().blind_spot(arrival_us.saturating_sub(PROMPT_US), arrival_us).is_none() {
                self.voters.push(frame);
                if self.voters.len() > VOTERS {
                    self.voters.remove(0);
                }
            }
            pending.prompt = Some(prompt);
        }
        if self.series.found() && !self.by_stamp.is_empty() {
            self.forget_stamps();
        }
    }

    /// Stamps do not tell one exposure of a series from another: what was learnt from them is forgotten, bindings stay.
    fn forget_stamps(&mut self) {
        for pending in self.frames.values_mut() {
            pending.evidence.console_us = None;
        }
        self.by_stamp.clear();
        self.offsets.clear();
        (self.whole_minutes, self.other_stamps) = (0, 0);
    }

    /// Judges until nothing more follows.
    fn settle(&mut self, timeline: &Timeline, newest_us: Option<i64>, now_us: i64) {
        if self.finished {
            self.align(timeline);
        }
        loop {
            self.agree_on_offset();
            self.agree_on_shift(timeline);
            let mut bound = false;
            for frame in self.open.iter().copied().collect::<Vec<u32>>() {
                let Some(pending) = self.frames.get(&frame) else { continue };
                let judgement = Weighed { binder: self, timeline, newest_us, now_us, pending }.judge();
                bound |= self.conclude(timeline, frame, judgement, newest_us, now_us);
            }
            if !bound {
                return;
            }
        }
    }

    fn conclude(&mut self, timeline: &Timeline, frame: u32, judgement: Judgement, newest_us: Option<i64>, now_us: i64) -> bool {
        let binding = match judgement {
            Judgement::Of { shot, how, evidence, teaches } => {
                let Some(exposure) = timeline.exposure(self.shots.get(shot).index) else { return false };
                self.bind(frame, shot, exposure.clone(), how, evidence, teaches);
                return true;
            }
            Judgement::Wait(reason) => Binding { evidence: vec![reason], settled: self.finished, ..Binding::default() },
            Judgement::None(evidence) => {
                let arrival_us = self.frames.get(&frame).and_then(|pending| pending.evidence.arrival_us);
                let reached = arrival_us.is_none_or(|arrival_us| {
                    newest_us.is_some_and(|newest_us| newest_us >= arrival_us) || now_us.saturating_sub(arrival_us) >= PATIENCE_US
                });
                Binding { evidence, settled: self.finished || reached, ..Binding::default() }
            }
        };
        self.tell(frame, binding);
        false
    }

    pub(super) fn bind(
        &mut self,
        frame: u32,
        shot: usize,
        exposure: super::ExposureInterval,
        how: BindingHow,
        evidence: Vec<String>,
        teaches: bool,
    ) {
        self.open.remove(&frame);
        self.counting.settled(frame);
        self.shots.get_mut(shot).frame = Some(frame);
        let Some(pending) = self.frames.get(&frame) else { return };
        let said = pending.evidence.clone();
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
        let time_us = Some(time_within(&said, &exposure));
        let flags = flags_of(&said, &exposure);
        self.tell(frame, Binding { exposure: Some(exposure), how, evidence, settled: true, time_us, flags });
    }

    /// Notes a frame's binding, and those of the images of its run, where it is another than before.
    fn tell(&mut self, frame: u32, binding: Binding) {
        let Some(pending) = self.frames.get_mut(&frame) else { return };
        if pending.binding == binding {
            return;
        }
        self.changed.insert(frame);
        pending.binding = binding;
        let (binding, images) = (pending.binding.clone(), pending.images.clone());
        for image in images {
            let Some(own) = self.frames.get(&image) else { continue };
            let own = within_run(&binding, &own.evidence);
            self.stands_for.insert(image, (frame, own));
            self.changed.insert(image);
        }
    }

    /// What stamp and exposure together say of the console's offset.
    pub(super) fn pair(&self, said: &FrameEvidence, shot: usize) -> Option<Pair> {
        Some(self.shots.get(shot).pair(said.console_us?, self.resolution_us(said)))
    }

    /// Resolution of a frame's stamp: a console that writes whole minutes writes zeros for the seconds.
    pub(super) fn resolution_us(&self, said: &FrameEvidence) -> i64 {
        let whole = said.console_us.is_some_and(|us| us.rem_euclid(MINUTE_US) == 0);
        if whole && self.whole_minutes >= self.other_stamps { MINUTE_US } else { said.console_resolution_us.max(1) }
    }

    /// Whether a frame lacks what most others have.
    pub(super) fn others_say_more(&self, said: &FrameEvidence) -> bool {
        let standing = self.contents.len() as u32;
        let stamped = self.whole_minutes + self.other_stamps;
        said.console_us.is_none() && 2 * stamped > standing || said.counter.is_none() && 2 * self.counting.frames() > standing
    }

    /// Whether the frame, whose counter names the exposure at `at`, may be of `other`, which waits for its frame.
    pub(super) fn rival(&self, said: &FrameEvidence, at: usize, other: usize) -> bool {
        let may_be = || said.counter.is_none_or(|counter| self.counting.may_be(&self.shots, counter, at, other));
        other != at && self.shots.get(other).frame.is_none() && may_be()
    }

    /// Whether the counter may have begun anew: prompt frames wait whose counter is not what the known shifts say, and which are no late
    /// ones either, or which have another shift in common on two occasions.
    pub(super) fn restless(&self) -> bool {
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

    /// Whether any offset that is known, at that time, allows the pair.
    pub(super) fn allowed(&self, pair: &Pair) -> bool {
        let known: Vec<&ConsoleOffset> = self.known_offsets().collect();
        known.iter().enumerate().any(|(i, offset)| {
            // Between the last frame of one setting and the first of the next either may hold.
            let after =
                i.checked_sub(1).and_then(|before| known[before].span_us()).is_none_or(|(_, last_us)| pair.any.at_us >= last_us);
            let before = known.get(i + 1).and_then(|next| next.span_us()).is_none_or(|(first_us, _)| pair.any.at_us <= first_us);
            after && before && offset.allows(pair)
        })
    }

    pub(super) fn known_offsets(&self) -> impl Iterator<Item = &ConsoleOffset> {
        self.offsets.iter().filter(|offset| offset.summary().is_some_and(|clock| clock.frames >= KNOWN_FRAMES))
    }
}

/// What a frame has before it was judged.
fn waiting() -> Binding {
    Binding { evidence: vec!["telemetry has not yet reached the frame's arrival".to_owned()], ..Binding::default() }
}

/// The binding of a run as it is for one of its images.
fn within_run(run: &Binding, image: &FrameEvidence) -> Binding {
    let mut own = run.clone();
    if let Some(exposure) = &own.exposure {
        own.time_us = Some(time_within(image, exposure));
        own.flags = flags_of(image, exposure);
    }
    own
}

//! Frames of one console to exposures, as they come: what console, counter and arrival say is weighed by what they have proved to be worth so far.
//!
//! Nothing about the console is assumed but that its clock drifts slowly. Its offset and the meaning of its counter are learnt from
//! frames that arrive promptly and agree with each other ([`super::agreement`]). A frame is then bound where exactly one exposure fits
//! everything that is known; whatever leaves two readings is left unbound and asked again when more is known. There is no binding by
//! elimination: that another exposure has its frame does not prove that a second picture is not of it too.
//!
//! Pure: no clock, no disk. The same calls give the same answers, live and in a replay.

use std::collections::{BTreeMap, BTreeSet};

use super::Timeline;
use super::apart::of_its_own;
use super::console::ConsoleClock;
use super::evidence::{Binding, BindingFlag, FrameEvidence, flags_of, time_within};
use super::judgement::{Judgement, Weighed};
use super::known::{Known, MINUTE_US, Pending};
use super::series::SeriesStamps;
use super::shots::{BATCH_US, PATIENCE_US, PROMPT_US, was_on};
use crate::telemetry::DeviceKind;

/// Frames without an exposure that are looked at as a batch, and how many more there must be until that is done again.
const ALIGNED: usize = 8;
const ALIGN_STEP: usize = 4;

/// Binds frames, taken to be of one console, to the exposures of a [`Timeline`].
#[derive(Clone, Debug, Default)]
pub(super) struct ConsoleBinder {
    known: Known,
    /// Images of a run (and copies) to the frame that stands for them.
    stands_for: BTreeMap<u32, (u32, Binding)>,
    series: SeriesStamps,
    changed: BTreeSet<u32>,
    fresh: bool,
    /// The batch of open frames is looked at as a whole when there are so many.
    align_at: usize,
}

impl ConsoleBinder {
    /// Takes a frame; frames are pushed in the order of their arrival, images of a run one by one.
    pub(super) fn push(&mut self, mut evidence: FrameEvidence) {
        if self.series.found() {
            evidence.console_us = None;
        }
        let (frame, image) = (evidence.frame, evidence.image_of_file[0]);
        self.fresh = true;
        self.changed.insert(frame);
        if evidence.completes.is_some_and(|before| self.take_place(before, &evidence)) {
            return;
        }
        if let Some((first, images)) = self.known.contents.get_mut(&evidence.content) {
            let first = *first;
            if let Some(same) = images.get(&image).copied() {
                let words = format!("the picture is that of frame {same}: a copy, not another exposure");
                self.stands_for.insert(frame, (same, aside(words, BindingFlag::Duplicate { of: same })));
                return;
            }
            images.insert(image, frame);
            let mut own = Binding::default();
            if let Some(pending) = self.known.frames.get_mut(&first) {
                pending.images.push(frame);
                own = of_image(pending, &evidence);
            }
            self.stands_for.insert(frame, (first, own));
            // Kept for its own place within the run.
            self.known.frames.insert(frame, Pending::new(evidence, Binding::default()));
            return;
        }
        self.known.contents.insert(evidence.content.clone(), (frame, BTreeMap::from([(image, frame)])));
        if let Some(counter) = evidence.counter {
            self.known.counting.see(counter);
        }
        if let Some(console_us) = evidence.console_us {
            self.known.by_stamp.entry(console_us).or_default().push(frame);
        }
        match evidence.console_us {
            Some(us) if us.rem_euclid(MINUTE_US) == 0 => self.known.whole_minutes += 1,
            Some(_) => self.known.other_stamps += 1,
            None => {}
        }
        self.known.open.insert(frame);
        self.known.frames.insert(frame, Pending::new(evidence, waiting()));
    }

    /// The picture of `content`, which says nothing of its exposure, came again as `frame`, which does: the first one is the copy, unless it has
    /// an exposure already.
    pub(super) fn was_copied_by(&mut self, content: &str, frame: u32) {
        let Some((first, _)) = self.known.contents.get(content) else { return };
        let first = *first;
        let Some(pending) = self.known.frames.get_mut(&first).filter(|pending| pending.binding.exposure.is_none()) else {
            return;
        };
        // It did not come for an exposure of its own.
        for at in pending.prompt.take().into_iter().flatten() {
            let shot = self.known.shots.get_mut(at);
            shot.prompt_frames = shot.prompt_frames.saturating_sub(1);
        }
        self.known.open.remove(&first);
        let words = format!("the picture is that of frame {frame}, which says of which exposure it is: a copy");
        self.stands_for.insert(first, (frame, aside(words, BindingFlag::Duplicate { of: frame })));
        self.changed.insert(first);
        self.fresh = true;
    }

    /// The frame takes the place of `before`, which was the same picture, unfinished: whatever that one is bound to, this one is. False
    /// where the two say different things of when they were taken.
    fn take_place(&mut self, before: u32, evidence: &FrameEvidence) -> bool {
        let first = self.stands_for.get(&before).map_or(before, |(first, _)| *first);
        let is_copy = self.binding(before).is_some_and(|binding| {
            binding.flags.iter().any(|flag| matches!(flag, BindingFlag::Duplicate { .. } | BindingFlag::Unfinished { .. }))
        });
        let Some(pending) = self.known.frames.get_mut(&first).filter(|_| !is_copy) else { return false };
        let of = |said: &FrameEvidence| (said.counter, said.console_us, said.image_of_file[1]);
        let known = self.known.contents.get(&evidence.content);
        let is_known = known.is_some_and(|(_, images)| images.contains_key(&evidence.image_of_file[0]));
        if of(&pending.evidence) != of(evidence) || is_known {
            return false;
        }
        let frame = evidence.frame;
        pending.images.retain(|image| *image != before);
        pending.images.push(frame);
        let own = of_image(pending, evidence);
        let images = &mut self.known.contents.entry(evidence.content.clone()).or_insert((first, BTreeMap::new())).1;
        images.insert(evidence.image_of_file[0], frame);
        self.stands_for.insert(frame, (first, own));
        let place = Pending::new(evidence.clone(), Binding::default());
        self.known.frames.insert(frame, place);
        let words = format!("the file was written on, or anew: frame {frame} is the whole picture and has its exposure");
        self.stands_for.insert(before, (first, aside(words, BindingFlag::Unfinished { replaced_by: frame })));
        self.changed.insert(before);
        true
    }

    /// Looks at what `timeline` has learnt; `now_us` is the host time. Returns the frames whose binding changed.
    pub(super) fn update(&mut self, timeline: &Timeline, now_us: i64) -> Vec<u32> {
        let newest_us = timeline.told_until_us(DeviceKind::Carm);
        let new_shots = !self.known.shots.follow(timeline.exposure_tracker(), newest_us).is_empty();
        let waits =
            self.known.open.iter().any(|frame| self.known.frames.get(frame).is_some_and(|pending| !pending.binding.settled));
        if self.fresh || new_shots || waits {
            self.fresh = false;
            self.meet_ended(timeline);
            self.meet(timeline, newest_us, now_us);
            self.settle(timeline, newest_us, now_us);
        }
        std::mem::take(&mut self.changed).into_iter().collect()
    }

    /// No more telemetry will come: judges every frame with what there is.
    pub(super) fn finish(&mut self, timeline: &Timeline) -> Vec<u32> {
        self.known.finished = true;
        self.fresh = true;
        self.update(timeline, i64::MAX)
    }

    /// A frame's binding as it stands.
    pub(super) fn binding(&self, frame: u32) -> Option<&Binding> {
        match self.stands_for.get(&frame) {
            Some((_, own)) => Some(own),
            None => self.known.frames.get(&frame).map(|pending| &pending.binding),
        }
    }

    /// The console's clock, once frames agree on it.
    pub(super) fn clock(&self) -> Option<ConsoleClock> {
        self.known.clock()
    }

    /// The time zone that the stamps are in, where files state one, minutes east of UTC: it is no error of the clock.
    pub(super) fn note_zone(&mut self, minutes: Option<i32>) {
        self.known.zone_min = minutes;
    }

    /// How many frames it was given, but for copies.
    pub(super) fn frames(&self) -> usize {
        self.known.frames.len()
    }

    /// Frames with an exposure, each of which stands for all images of its file.
    pub(super) fn tied(&self) -> impl Iterator<Item = (u32, &Pending)> {
        let tied = self.known.frames.iter().filter(|(_, pending)| pending.binding.exposure.is_some());
        tied.map(|(frame, pending)| (*frame, pending))
    }

    /// Whether so many of its frames fit exposures that these are theirs.
    pub(super) fn is_no_accident(&self) -> bool {
        self.known.is_no_accident()
    }

    /// Whether no frame that `other` has tied has another exposure here.
    pub(super) fn agrees_with(&self, other: &Self) -> bool {
        let index = |pending: &Pending| pending.binding.exposure.as_ref().map(|exposure| exposure.index);
        other.tied().all(|(frame, there)| {
            let own = self.known.frames.get(&frame).and_then(index);
            own.is_none() || own == index(there)
        })
    }

    /// Whether the frame stands for itself and may still get an exposure.
    pub(super) fn is_open(&self, frame: u32) -> bool {
        self.known.open.contains(&frame)
    }

    /// Ties an open frame as one that knows fewer frames has (`there`), for the reason in `words`, unless another frame has its exposure here.
    pub(super) fn adopt(&mut self, timeline: &Timeline, frame: u32, there: &Pending, words: &str) {
        let exposures = there.exposures().iter();
        let shots: Option<Vec<usize>> = exposures.map(|exposure| self.known.shots.position(exposure.index)).collect();
        let free = |at: &usize| self.known.shots.get(*at).frame.is_none();
        let Some(first) = shots.filter(|shots| shots.iter().all(free)).and_then(|shots| shots.first().copied()) else { return };
        if !self.is_open(frame) {
            return;
        }
        let (how, mut evidence) = (there.binding.how, there.binding.evidence.clone());
        evidence.insert(0, words.to_owned());
        let judgement = match there.apart.is_empty() {
            true => Judgement::Of { shot: first, how, evidence, teaches: false },
            false => Judgement::OfEach { first, how, evidence },
        };
        self.conclude(timeline, frame, judgement, None, 0);
        // What others say of that exposure is another thing now.
        self.fresh = true;
    }

    /// Frames whose binding has changed since the last update.
    pub(super) fn take_changed(&mut self) -> BTreeSet<u32> {
        std::mem::take(&mut self.changed)
    }

    /// Asks again of the frames that came while an exposure was on, which has ended since.
    fn meet_ended(&mut self, timeline: &Timeline) {
        for frame in &self.known.open.clone() {
            let Some(pending) = self.known.frames.get_mut(frame) else { continue };
            let Some(at) = pending.running.and_then(|index| self.known.shots.position(index)) else { continue };
            pending.running = None;
            let (arrival_us, shots) = (pending.evidence.arrival_us.unwrap_or(i64::MAX), &self.known.shots);
            // Where telemetry had fallen silent, the beam was perhaps off long before the frame came.
            let may_be = |prompt: &&mut Vec<usize>| shots.is_near(at, arrival_us) && shots.may_come_early(at, prompt);
            let Some(prompt) = pending.prompt.as_mut().filter(may_be) else { continue };
            if prompt.is_empty() {
                self.known.strays = self.known.strays.saturating_sub(1);
            }
            prompt.push(at);
            self.known.shots.get_mut(at).prompt_frames += 1;
            let blind = timeline.exposure_tracker().blind_spot(arrival_us.saturating_sub(PROMPT_US), arrival_us).is_some();
            if !blind && !self.known.voters.contains(frame) {
                self.known.vote(*frame);
            }
        }
    }

    /// Finds the exposures shortly before frames whose arrival telemetry has reached.
    fn meet(&mut self, timeline: &Timeline, newest_us: Option<i64>, now_us: i64) {
        let open: Vec<u32> = self.known.open.iter().copied().collect();
        let lags = self.known.shots.lags(timeline.exposure_tracker());
        let running = timeline.exposure_tracker().open();
        for frame in open {
            let before = frame.checked_sub(1).and_then(|before| self.known.frames.get(&before));
            let before_us = before.and_then(|before| before.evidence.arrival_us);
            let Some(pending) = self.known.frames.get_mut(&frame) else { continue };
            let Some(arrival_us) = pending.evidence.arrival_us else {
                pending.prompt = Some(Vec::new());
                continue;
            };
            let reached = !lags && newest_us.is_some_and(|newest_us| newest_us >= arrival_us);
            let patient = now_us.saturating_sub(arrival_us) < PATIENCE_US;
            if pending.prompt.is_some() || !reached && patient {
                continue;
            }
            let shots = &self.known.shots;
            let mut prompt = shots.prompt(arrival_us);
            let running = running.filter(|open| was_on(open, arrival_us) && shots.may_come_early(shots.len(), &prompt));
            if running.is_some() && patient {
                continue;
            }
            pending.running = running.map(|open| open.index);
            prompt.extend(shots.on_at(arrival_us).filter(|at| shots.may_come_early(*at, &prompt)));
            let batch = before_us.is_some_and(|before_us| arrival_us.saturating_sub(before_us) <= BATCH_US);
            for at in &prompt {
                self.known.shots.get_mut(*at).prompt_frames += 1;
            }
            // One of a batch is late, whatever it comes after.
            if batch {
                self.known.counting.settled(frame.saturating_sub(1));
            } else if let ([at], Some(counter)) = (&prompt[..], pending.evidence.counter) {
                self.known.counting.doubt(&self.known.shots, *at, frame, counter);
            }
            if let (Some(last), Some(console_us)) = (prompt.last(), pending.evidence.console_us) {
                // A whole minute may be all that the console writes.
                let whole = console_us.rem_euclid(MINUTE_US) == 0;
                let resolution_us = if whole { MINUTE_US } else { pending.evidence.console_resolution_us };
                self.series.meet(console_us, resolution_us, self.known.shots.get(*last).end_us);
            }
            if prompt.is_empty() {
                self.known.strays += 1;
            } else if timeline.exposure_tracker().blind_spot(arrival_us.saturating_sub(PROMPT_US), arrival_us).is_none() {
                pending.prompt = Some(prompt);
                self.known.vote(frame);
                continue;
            }
            pending.prompt = Some(prompt);
        }
        if self.series.found() && !self.known.by_stamp.is_empty() {
            self.forget_stamps();
        }
    }

    /// Stamps do not tell one exposure of a series from another: what was learnt from them is forgotten, bindings stay.
    fn forget_stamps(&mut self) {
        for pending in self.known.frames.values_mut() {
            pending.evidence.console_us = None;
        }
        self.known.by_stamp.clear();
        self.known.offsets.clear();
        (self.known.whole_minutes, self.known.other_stamps) = (0, 0);
    }

    /// Judges until nothing more follows.
    fn settle(&mut self, timeline: &Timeline, newest_us: Option<i64>, now_us: i64) {
        if self.known.finished || self.known.open.len() >= self.align_at.max(ALIGNED) {
            self.known.align(timeline);
            self.align_at = self.known.open.len() + ALIGN_STEP;
        }
        loop {
            self.known.agree_on_offset(timeline);
            for (frame, binding) in self.known.agree_on_shift(timeline) {
                self.tell(frame, binding);
            }
            let mut bound = false;
            for frame in self.known.open.iter().copied().collect::<Vec<u32>>() {
                let Some(pending) = self.known.frames.get(&frame) else { continue };
                let judgement = Weighed { known: &self.known, timeline, newest_us, now_us, pending }.judge();
                let judgement = self.known.judge_images(&pending.evidence, judgement, timeline);
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
                let Some(exposure) = timeline.exposure(self.known.shots.get(shot).index) else { return false };
                if let Some(binding) = self.known.bind(frame, shot, exposure.clone(), how, evidence, teaches) {
                    self.tell(frame, binding);
                }
                return true;
            }
            Judgement::OfEach { first, how, evidence } => {
                let Some(exposures) = self.known.bind_each(frame, first, timeline) else { return false };
                let said = self.known.frames.get(&frame).map(|pending| &pending.evidence);
                if let Some(binding) = said.map(|said| of_its_own((how, evidence.as_slice()), &exposures, said)) {
                    self.tell(frame, binding);
                }
                return true;
            }
            Judgement::Wait(reason) => Binding { evidence: vec![reason], settled: self.known.finished, ..Binding::default() },
            Judgement::None { evidence, taken_by } => {
                let arrival_us = self.known.frames.get(&frame).and_then(|pending| pending.evidence.arrival_us);
                let reached = arrival_us.is_none_or(|arrival_us| {
                    newest_us.is_some_and(|newest_us| newest_us >= arrival_us) || now_us.saturating_sub(arrival_us) >= PATIENCE_US
                });
                let flags = taken_by.into_iter().map(|of| BindingFlag::SecondPicture { of }).collect();
                Binding { evidence, settled: self.known.finished || reached, flags, ..Binding::default() }
            }
        };
        self.tell(frame, binding);
        false
    }

    /// Notes a frame's binding, and those of the images of its run, where it is another than before.
    fn tell(&mut self, frame: u32, binding: Binding) {
        let Some(pending) = self.known.frames.get_mut(&frame) else { return };
        if pending.binding == binding {
            return;
        }
        self.changed.insert(frame);
        pending.binding = binding;
        let run = pending.clone();
        for image in run.images.iter().copied() {
            let Some(own) = self.known.frames.get(&image) else { continue };
            let own = of_image(&run, &own.evidence);
            self.stands_for.insert(image, (frame, own));
            self.changed.insert(image);
        }
    }
}

/// What a frame has for which another one stands.
fn aside(words: String, flag: BindingFlag) -> Binding {
    Binding { evidence: vec![words], settled: true, flags: vec![flag], ..Binding::default() }
}

/// What a frame has before it was judged.
fn waiting() -> Binding {
    Binding { evidence: vec!["telemetry has not yet reached the frame's arrival".to_owned()], ..Binding::default() }
}

/// The binding of one image of the file for which `file` stands.
fn of_image(file: &Pending, image: &FrameEvidence) -> Binding {
    match file.apart.is_empty() {
        true => within_run(&file.binding, image),
        false => of_its_own((file.binding.how, file.binding.evidence.as_slice()), &file.apart, image),
    }
}

/// The binding of a run as it is for one of its images.
fn within_run(run: &Binding, image: &FrameEvidence) -> Binding {
    let mut own = run.clone();
    if let Some(exposure) = &own.exposure {
        let span_us = [exposure.start_us, exposure.end_us];
        own.time_us = Some(time_within(image, exposure, span_us));
        own.flags = flags_of(image, exposure, span_us);
    }
    own
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::{CarmSample, Sample, SequenceTracker};

    /// Of an arm that fell silent right after an exposure, a picture that came ten seconds later counted as one that came while the beam was on.
    #[test]
    fn what_comes_long_after_a_beam_did_not_come_while_it_was_on() {
        let mut met = Vec::new();
        for arrival_us in [1_500_000, 12_000_000] {
            let (mut timeline, mut sequence, mut binder) =
                (Timeline::new(), SequenceTracker::default(), ConsoleBinder::default());
            let mut hear = |timeline: &mut Timeline, numbers: std::ops::Range<u32>, skipped: u32| {
                for n in numbers {
                    let device_us = 20_000 * u64::from(n + skipped);
                    let (xray_on, exposure_counter) = ((50..100).contains(&n), Some(u32::from(n >= 50)));
                    let sample = CarmSample { device_us, sequence: n, xray_on, exposure_counter, ..CarmSample::UNTOLD };
                    let sequenced = sequence.take(n, device_us);
                    timeline.push_sample(DeviceKind::Carm, device_us as i64, 0, sequenced, Sample::Carm(sample));
                }
            };
            // The beam is seen off for two samples, which may be a bounce.
            hear(&mut timeline, 0..102, 0);
            let (content, arrival) = ("a".to_owned(), Some(arrival_us));
            binder.push(FrameEvidence {
                frame: 1,
                content,
                image_of_file: [0, 1],
                arrival_us: arrival,
                ..FrameEvidence::default()
            });
            binder.update(&timeline, arrival_us + 2 * PATIENCE_US);
            assert!(binder.known.frames[&1].running.is_some(), "nobody knows yet that it is over");
            hear(&mut timeline, 102..300, 1_900);
            binder.update(&timeline, 50_000_000);
            met.push(binder.known.frames[&1].prompt.clone());
        }
        assert_eq!(met, [Some(vec![0]), Some(vec![])]);
    }
}

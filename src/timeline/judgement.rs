//! One frame against everything that is known: bound, not bound and why, or not yet.

use super::Timeline;
use super::binder::{Binder, KNOWN_FRAMES, Pending};
use super::counting::Firmness;
use super::evidence::{BindingHow, FrameEvidence, seconds};

/// Telemetry must be this far past the moment that a stamp names, or another exposure may still come up there.
const AFTER_STAMP_US: i64 = 500_000;
/// A first frame that comes later than this after the only exposure before it may be of something that was not seen.
const SOON_US: i64 = 4_000_000;
/// Frames with stamps this near take part in the order of a burst.
const ORDER_US: i64 = 20_000_000;

/// Stamps within this time of each other show whether the clock was set.
const STRETCH_US: i64 = 3_600_000_000;

/// What came of it.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Judgement {
    /// Of the exposure at this position. `teaches`: two kinds of evidence agree, so console and counter may be learnt from it.
    Of { shot: usize, how: BindingHow, evidence: Vec<String>, teaches: bool },
    /// Telemetry or other frames may decide within a second.
    Wait(String),
    /// No exposure, with what was found.
    None(Vec<String>),
}

/// A frame with all that bears on it.
pub(super) struct Weighed<'a> {
    pub binder: &'a Binder,
    pub timeline: &'a Timeline,
    pub newest_us: Option<i64>,
    pub now_us: i64,
    pub pending: &'a Pending,
}

/// What stamp and known offset say.
struct ByStamp {
    fitting: Vec<usize>,
    from_us: i64,
    to_us: i64,
}

impl Weighed<'_> {
    pub(super) fn judge(&self) -> Judgement {
        if self.binder.shots.len() == 0 {
            return none("telemetry recorded no exposure");
        }
        let Some(prompt) = &self.pending.prompt else {
            return Judgement::Wait("telemetry has not yet reached the frame's arrival".to_owned());
        };
        let (candidates, counter_words) = self.by_counter();
        let mut words: Vec<String> = counter_words.into_iter().collect();
        match self.by_stamp() {
            Some(stamp) if !self.telemetry_covers(stamp.to_us) => {
                Judgement::Wait("telemetry has not yet passed the time that the console's stamp names".to_owned())
            }
            Some(mut stamp) => {
                if stamp.fitting.len() > 1 {
                    self.keep_order(&mut stamp);
                }
                self.with_stamp(&stamp, &candidates, prompt, words)
            }
            None if self.pending.evidence.console_us.is_none() && self.binder.clock().is_some() => {
                words.push("it lacks the stamp that other frames have".to_owned());
                self.counted_and_prompt(&candidates, prompt, words)
            }
            None => self.without_stamp(&candidates, prompt, words),
        }
    }

    /// Exposures that the counter allows, and what is to be said of it.
    fn by_counter(&self) -> (Vec<(usize, Firmness)>, Option<String>) {
        let Some(counter) = self.pending.evidence.counter else {
            return (Vec::new(), Some("the frame carries no exposure counter".to_owned()));
        };
        if let Some(reason) = self.binder.counting.useless() {
            return (Vec::new(), Some(reason));
        }
        let mut found = self.binder.counting.candidates(&self.binder.shots, counter, &|from, to| self.hidden(from, to));
        if let Some(arrival_us) = self.pending.evidence.arrival_us {
            found.retain(|(at, _)| self.binder.shots.get(*at).start_us <= arrival_us);
        }
        (found, None)
    }

    /// Whether telemetry was silent between two exposures.
    fn hidden(&self, from: usize, to: usize) -> bool {
        let (from, to) = (self.binder.shots.get(from), self.binder.shots.get(to));
        self.timeline.exposure_tracker().blind_spot(from.end_us, to.start_us.max(from.end_us)).is_some()
    }

    /// Leaves the exposures that the frame can have if later stamps are of later exposures: each stamp is of another exposure than every
    /// other stamp, so a burst whose frames are all there may leave each only one place.
    fn keep_order(&self, stamp: &mut ByStamp) {
        let Some(console_us) = self.pending.evidence.console_us else { return };
        let near = self.binder.by_stamp.range(console_us.saturating_sub(ORDER_US)..=console_us.saturating_add(ORDER_US));
        let mut places: Vec<(i64, Vec<usize>)> = Vec::new();
        for (other_us, frames) in near {
            let mut fitting: Vec<usize> = Vec::new();
            for other in frames.iter().filter_map(|frame| self.binder.frames.get(frame)) {
                match &other.binding.exposure {
                    Some(exposure) => fitting.extend(self.binder.shots.position(exposure.index)),
                    None => fitting.extend(self.fitting(&other.evidence).map(|found| self.places(found)).unwrap_or_default()),
                }
            }
            if *other_us == console_us {
                fitting.clone_from(&stamp.fitting);
            }
            fitting.sort_unstable();
            if !fitting.is_empty() {
                places.push((*other_us, fitting));
            }
        }
        let Some(own) = places.iter().position(|(us, _)| *us == console_us) else { return };
        let mut lowest: Option<usize> = None;
        for (_, fitting) in &places[..=own] {
            lowest = fitting.iter().copied().find(|at| lowest.is_none_or(|lowest| *at > lowest)).or(lowest);
        }
        let mut highest: Option<usize> = None;
        for (_, fitting) in places[own..].iter().rev() {
            highest = fitting.iter().rev().copied().find(|at| highest.is_none_or(|highest| *at < highest)).or(highest);
        }
        if let (Some(lowest), Some(highest)) = (lowest, highest)
            && lowest <= highest
        {
            stamp.fitting.retain(|at| (lowest..=highest).contains(at));
        }
    }

    /// Why the stamp does not tell although it fits `at`: the clock may have been set between the frames that confirm its offset and this
    /// one, because the arrival speaks for another exposure, or because other stamps from there fit nothing.
    fn may_be_set(&self, at: usize, prompt: &[usize]) -> Option<String> {
        let at_us = self.binder.shots.get(at).end_us;
        let pair = self.binder.pair(&self.pending.evidence, at)?;
        let spans: Vec<(i64, i64)> =
            self.binder.known_offsets().filter(|offset| offset.allows(&pair)).filter_map(|offset| offset.span_us()).collect();
        if prompt.contains(&at) || spans.iter().any(|(first_us, last_us)| (*first_us..=*last_us).contains(&at_us)) {
            return None;
        }
        if let Some(other) = prompt.last() {
            let (by_stamp, by_arrival) = (self.label(at), self.label(*other));
            return Some(format!(
                "the console's stamp points to {by_stamp}, the arrival to {by_arrival}, and its clock may have been set"
            ));
        }
        let (mut fitting, mut lost) = (0, 0);
        for frame in &self.binder.open {
            let Some(other) = self.binder.frames.get(frame).filter(|other| other.evidence.frame != self.pending.evidence.frame)
            else {
                continue;
            };
            let Some(stamp) = self.fitting(&other.evidence) else { continue };
            let within = spans.iter().any(|(first_us, last_us)| stamp.from_us >= *first_us && stamp.to_us <= *last_us);
            let apart_us = stamp.from_us.saturating_sub(at_us).saturating_abs();
            if !within && apart_us < STRETCH_US {
                *(if stamp.fitting.is_empty() { &mut lost } else { &mut fitting }) += 1;
            }
        }
        (lost > 1 + fitting / 2).then(|| {
            let label = self.label(at);
            format!(
                "the console's stamp fits {label}, but {lost} others from that time fit no exposure: its clock may have been set"
            )
        })
    }

    /// Exposures of which a frame with this stamp must have one: none where telemetry was silent, for it may be of one that was not seen.
    fn places(&self, stamp: ByStamp) -> Vec<usize> {
        let blind = self.timeline.exposure_tracker().blind_spot(stamp.from_us, stamp.to_us).is_some();
        if blind { Vec::new() } else { stamp.fitting }
    }

    fn by_stamp(&self) -> Option<ByStamp> {
        self.fitting(&self.pending.evidence)
    }

    /// Exposures at the time that the stamp names, once the console's offset is known.
    fn fitting(&self, said: &FrameEvidence) -> Option<ByStamp> {
        let console_us = said.console_us?;
        let mut found: Option<ByStamp> = None;
        for offset in self.binder.known_offsets() {
            // The offset barely drifts while exposures are looked up: a second round takes it where the stamp falls.
            let (first_us, last_us) = offset.span_us()?;
            let mut bounds = offset.bounds(first_us / 2 + last_us / 2)?;
            for _ in 0..2 {
                let at_us = console_us.saturating_add(bounds.low_us / 2 + bounds.high_us / 2);
                bounds = offset.bounds(at_us)?;
            }
            let from_us = console_us.saturating_add(bounds.low_us).saturating_sub(150_000);
            let resolution_us = self.binder.resolution_us(said);
            let to_us = console_us.saturating_add(resolution_us).saturating_add(bounds.high_us).saturating_add(150_000);
            let near = self.binder.shots.touching(from_us, to_us);
            let causal = |at: &usize| {
                let over_us = self.binder.shots.get(*at).over_us;
                said.arrival_us.is_none_or(|arrival_us| over_us <= arrival_us)
            };
            let fitting: Vec<usize> = near
                .filter(causal)
                .filter(|at| self.binder.pair(said, *at).is_some_and(|pair| self.binder.allowed(&pair)))
                .collect();
            match &mut found {
                Some(all) => {
                    all.fitting.extend(fitting);
                    all.fitting.sort_unstable();
                    all.fitting.dedup();
                    (all.from_us, all.to_us) = (all.from_us.min(from_us), all.to_us.max(to_us));
                }
                None => found = Some(ByStamp { fitting, from_us, to_us }),
            }
        }
        found
    }

    /// Telemetry has passed the time, or will not any more.
    fn telemetry_covers(&self, until_us: i64) -> bool {
        let said = &self.pending.evidence;
        let limit_us = said.arrival_us.map_or(until_us, |arrival_us| until_us.saturating_add(AFTER_STAMP_US).min(arrival_us));
        let gave_up = said.arrival_us.is_some_and(|arrival_us| self.now_us.saturating_sub(arrival_us) >= 2 * AFTER_STAMP_US);
        self.binder.finished || gave_up || self.newest_us.is_some_and(|newest_us| newest_us >= limit_us)
    }

    fn with_stamp(
        &self,
        stamp: &ByStamp,
        candidates: &[(usize, Firmness)],
        prompt: &[usize],
        mut words: Vec<String>,
    ) -> Judgement {
        let both: Vec<(usize, Firmness)> = candidates.iter().filter(|(at, _)| stamp.fitting.contains(at)).copied().collect();
        match (&both[..], &stamp.fitting[..]) {
            ([(at, firmness)], fitting) if fitting.len() == 1 || self.decides(*at, *firmness, fitting) => {
                words.push(format!("the counter names {} as well", self.label(*at)));
                words.push(format!("the console's stamp fits {}", self.label(*at)));
                self.of(*at, BindingHow::Counter, words, true)
            }
            (_, []) => {
                words.push(format!("the console's stamp fits no exposure{}", self.offset_words()));
                Judgement::None(words)
            }
            (_, [at]) => {
                if let Some(set) = self.may_be_set(*at, prompt) {
                    words.push(set);
                    return Judgement::None(words);
                }
                let free = |at: usize| self.binder.shots.get(at).frame.is_none();
                let firm = candidates.iter().find(|(other, firmness)| *firmness == Firmness::Enclosed && free(*other));
                if let Some((other, _)) = firm
                    && !prompt.contains(at)
                {
                    let (by_stamp, by_counter) = (self.label(*at), self.label(*other));
                    words.push(format!("the console's stamp points to {by_stamp}, the counter to {by_counter}: contradictory"));
                    return Judgement::None(words);
                }
                if self.pending.evidence.counter.is_some() && !both.iter().any(|(both, _)| both == at) && words.is_empty() {
                    words.push("the counter contradicts the stamp and is dropped for this frame".to_owned());
                }
                if let Some(blind) = self.blind(*at, stamp.from_us, stamp.to_us) {
                    words.push(blind);
                    return Judgement::None(words);
                }
                words.push(format!(
                    "{} is the only exposure that the console's stamp fits{}",
                    self.label(*at),
                    self.offset_words()
                ));
                self.of(*at, BindingHow::Time, words, prompt.contains(at))
            }
            (_, several) => {
                words.push(format!("the console's stamp fits {} exposures: ambiguous", several.len()));
                Judgement::None(words)
            }
        }
    }

    /// Whether the counter decides for `at` among `several` exposures: no other of them waits for its frame, or the counter's
    /// shift is the same before and after. A console that counts the pictures it stores names a neighbour as soon as one is missing or one more
    /// was stored.
    fn decides(&self, at: usize, firmness: Firmness, several: &[usize]) -> bool {
        let said = &self.pending.evidence;
        let mut rivals = several.iter().copied().filter(|other| self.binder.rival(said, at, *other));
        if firmness >= Firmness::OneSide && rivals.clone().next().is_none() {
            return true;
        }
        // One picture too few and one too many leave the same shift on either side; when the frame came shows it.
        let usual_us = self.usual_delay_us();
        let usual = |at: usize| {
            let delay_us = said.arrival_us.map(|arrival_us| arrival_us.saturating_sub(self.binder.shots.get(at).end_us));
            delay_us.zip(usual_us).is_some_and(|(delay_us, usual_us)| (usual_us[0]..=usual_us[1]).contains(&delay_us))
        };
        firmness == Firmness::Enclosed
            && self.binder.counting.counts_exposures(&self.binder.shots, &|from, to| self.hidden(from, to))
            && (usual(at) || !rivals.any(usual) && (usual_us.is_some() || said.console_us.is_some()))
    }

    /// Whether the frame came no later after the exposure than others do, or soon where that is not known yet.
    fn timely(&self, at: usize) -> bool {
        let latest_us = self.usual_delay_us().map_or(SOON_US, |usual_us| usual_us[1]);
        let end_us = self.binder.shots.get(at).end_us;
        self.pending.evidence.arrival_us.is_none_or(|arrival_us| arrival_us.saturating_sub(end_us) <= latest_us)
    }

    /// A frame unlike the others is bound only where counter and arrival name the same exposure, and last of all: the exposure's own frame
    /// may still come.
    fn counted_and_prompt(&self, candidates: &[(usize, Firmness)], prompt: &[usize], mut words: Vec<String>) -> Judgement {
        match candidates {
            [(at, firmness)] if *firmness >= Firmness::OneSide && prompt.contains(at) => {
                words.push(format!("counter and arrival name {}", self.label(*at)));
                if !self.binder.finished {
                    words.push("until the end of the session a frame like the others may come for it".to_owned());
                    return Judgement::None(words);
                }
                self.of(*at, BindingHow::Counter, words, false)
            }
            _ => {
                words.push("counter and arrival do not name one exposure".to_owned());
                Judgement::None(words)
            }
        }
    }

    fn without_stamp(&self, candidates: &[(usize, Firmness)], prompt: &[usize], mut words: Vec<String>) -> Judgement {
        let said = &self.pending.evidence;
        let free = |at: usize| self.binder.shots.get(at).frame.is_none();
        let open: Vec<(usize, Firmness)> = candidates.iter().filter(|(at, _)| free(*at)).copied().collect();
        if let ([(at, firmness)], Some(counter)) = (&open[..], said.counter) {
            // A value that came before may be one that does not move, or that began anew.
            let fresh = self.binder.counting.times_seen(counter) <= 1;
            // Where nothing is known yet, an equal number proves little beside a second exposure.
            let proved = self.decides(*at, *firmness, prompt) && (*firmness == Firmness::Enclosed || self.timely(*at))
                || fresh && prompt.len() == 1 && self.timely(*at)
                || fresh && self.orderly(*at, *firmness, prompt);
            if prompt.contains(at) && proved {
                words.push(format!("counter {counter} names {}, which ended shortly before the frame arrived", self.label(*at)));
                return self.of(*at, BindingHow::Counter, words, true);
            }
            // An exposure right before the arrival competes: always, if the frame came promptly for either; else unless the counter is
            // known not to have begun anew by then.
            let competes = |other: usize| match prompt.contains(at) {
                true => self.binder.rival(said, *at, other),
                false => free(other) && other != *at && !self.binder.counting.passed(other),
            };
            let rival = prompt.iter().find(|other| competes(**other));
            let steady = self.binder.counting.steady(&self.binder.shots) && !self.binder.restless();
            let firm = steady && *firmness == Firmness::Enclosed;
            if let Some(rival) = rival.filter(|_| firm) {
                words.push(format!("the counter names {}, the arrival {}: ambiguous", self.label(*at), self.label(*rival)));
                return Judgement::None(words);
            }
            if firm && candidates.len() == 1 && fresh && said.console_us.is_none() {
                words.push(format!("counter {counter} names {}, between frames with the same count", self.label(*at)));
                return self.of(*at, BindingHow::Counter, words, false);
            }
        }
        if let ([(at, _)], [], Some(counter)) = (candidates, &open[..], said.counter)
            && let Some(other) = self.binder.shots.get(*at).frame
        {
            words.push(format!("counter {counter} names {}, which frame {other} has already", self.label(*at)));
            return Judgement::None(words);
        }
        self.by_arrival(prompt, words)
    }

    /// The verdict for one exposure, unless another frame has it.
    pub(super) fn of(&self, shot: usize, how: BindingHow, mut evidence: Vec<String>, teaches: bool) -> Judgement {
        if let Some(other) = self.binder.shots.get(shot).frame {
            evidence.push(format!("{} has frame {other} already; one exposure has one frame", self.label(shot)));
            return Judgement::None(evidence);
        }
        Judgement::Of { shot, how, evidence, teaches }
    }

    /// Whether another exposure may hide in the window because telemetry was silent there.
    pub(super) fn blind(&self, shot: usize, from_us: i64, to_us: i64) -> Option<String> {
        let to_us = self.pending.evidence.arrival_us.map_or(to_us, |arrival_us| to_us.min(arrival_us));
        let spot = self.timeline.exposure_tracker().blind_spot(from_us, to_us)?;
        let silence_ms = spot.to_us.saturating_sub(spot.from_us) / 1000;
        Some(format!(
            "{} would fit, but telemetry was silent for {silence_ms} ms in the time in question: another exposure may have happened unseen",
            self.label(shot)
        ))
    }

    pub(super) fn label(&self, shot: usize) -> String {
        let shot = self.binder.shots.get(shot);
        match shot.counter {
            Some(counter) => format!("exposure {counter}"),
            None => format!("exposure #{} of the session", shot.index + 1),
        }
    }

    fn offset_words(&self) -> String {
        match self.binder.clock().filter(|clock| clock.frames >= KNOWN_FRAMES) {
            Some(clock) => format!(
                " (its clock is {} ± {} behind the host's, from {} frames)",
                seconds(clock.offset_us),
                seconds(clock.uncertainty_us),
                clock.frames
            ),
            None => String::new(),
        }
    }
}

fn none(reason: &str) -> Judgement {
    Judgement::None(vec![reason.to_owned()])
}

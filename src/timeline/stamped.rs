//! A frame whose stamp tells, once the console's offset is known: which exposures it fits, and whether it is to be believed.

use std::ops::RangeInclusive;

use super::console::ConsoleOffset;
use super::counting::Firmness;
use super::evidence::{BindingHow, FrameEvidence, seconds};
use super::judgement::{Judgement, Weighed, none};
use super::known::KNOWN_FRAMES;

/// Telemetry must be this far past the moment that a stamp names, or another exposure may still come up there.
const AFTER_STAMP_US: i64 = 500_000;
/// Frames with stamps this near take part in the order of a burst.
const ORDER_US: i64 = 20_000_000;
/// Stamps after a frame whose counter contradicts its stamp that must fit on before the stamp is believed.
const FITTING: usize = 3;
/// Frames that confirm the console's clock from which on its stamp is believed where another exposure waits as well.
const CONFIRMED: usize = 5;
/// From which on it is believed against the frame's own counter.
const CONFIRMED_AGAINST_COUNTER: usize = 8;
/// Stamps before one, and after it, that are asked.
const BESIDE: usize = 24;
/// Frames with stamps right before and right after one, each, that show whether the counter began anew there.
const WITNESSES: usize = 3;
/// Stamps within this time of each other show whether the clock was set.
const STRETCH_US: i64 = 3_600_000_000;

/// What stamp and known offset say.
pub(super) struct ByStamp {
    pub fitting: Vec<usize>,
    pub from_us: i64,
    pub to_us: i64,
}

impl Weighed<'_> {
    /// Leaves the exposures that the frame can have if later stamps are of later exposures: each stamp is of another exposure than every
    /// other stamp, so a burst whose frames are all there may leave each only one place.
    pub(super) fn keep_order(&self, stamp: &mut ByStamp) {
        let Some(console_us) = self.pending.evidence.console_us else { return };
        let near = self.known.by_stamp.range(console_us.saturating_sub(ORDER_US)..=console_us.saturating_add(ORDER_US));
        let mut places: Vec<(i64, Vec<usize>)> = Vec::new();
        for (other_us, frames) in near {
            let mut fitting: Vec<usize> = Vec::new();
            for other in frames.iter().filter_map(|frame| self.known.frames.get(frame)) {
                match &other.binding.exposure {
                    Some(exposure) => fitting.extend(self.known.shots.position(exposure.index)),
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
        // Where they do not all find a place, an exposure is not known, or a stamp is of something else: which one nobody knows.
        let mut lowest: Option<usize> = None;
        for (_, fitting) in &places[..=own] {
            let Some(next) = fitting.iter().copied().find(|at| lowest.is_none_or(|lowest| *at > lowest)) else { return };
            lowest = Some(next);
        }
        let mut highest: Option<usize> = None;
        for (_, fitting) in places[own..].iter().rev() {
            let Some(next) = fitting.iter().rev().copied().find(|at| highest.is_none_or(|highest| *at < highest)) else { return };
            highest = Some(next);
        }
        if let (Some(lowest), Some(highest)) = (lowest, highest)
            && lowest <= highest
        {
            stamp.fitting.retain(|at| (lowest..=highest).contains(at));
        }
    }

    /// Why the stamp does not tell although it fits `at`: the clock may have been set since the frames that confirm its offset, because
    /// arrival or counter speak for another exposure, or because other stamps from there fit nothing.
    fn may_be_set(
        &self,
        at: usize,
        candidates: &[(usize, Firmness)],
        prompt: &[usize],
        usual_us: Option<&RangeInclusive<i64>>,
    ) -> Option<String> {
        let at_us = self.known.shots.get(at).end_us;
        let pair = self.known.pair(&self.pending.evidence, at)?;
        let spans: Vec<(i64, i64)> =
            self.known.known_offsets().filter(|offset| offset.allows(&pair)).filter_map(|offset| offset.span_us()).collect();
        let confirmed = spans.iter().any(|(first_us, last_us)| (*first_us..=*last_us).contains(&pair.any.at_us));
        // A counter that has kept its shift names the neighbour: had its own exposure no picture, the stamps after it would fit on.
        let free = |other: usize| other != at && self.known.shots.get(other).frame.is_none();
        let counted =
            candidates.iter().find(|(other, firmness)| *firmness >= Firmness::OneSide && prompt.contains(other) && free(*other));
        // Frames before or after a setting may fit the neighbours throughout, but come sooner or later after them than frames do. Where the
        // setting is small, frames long after it still confirm the offset of before.
        let as_usual = |other: usize| usual_us.map(|usual_us| self.came_within(usual_us, other));
        if prompt.contains(&at)
            && !as_usual(at).unwrap_or(confirmed || !self.known.finished)
            && let Some(other) = prompt.iter().find(|other| free(**other) && as_usual(**other).unwrap_or(true))
        {
            let (by_stamp, by_arrival) = (self.label(at), self.label(*other));
            return Some(format!(
                "the console's stamp points to {by_stamp}, but frames usually come as this one did after {by_arrival}: its clock may have been set"
            ));
        }
        if confirmed || prompt.contains(&at) && counted.is_none() {
            return None;
        }
        if let Some(other) = prompt.last().filter(|_| !prompt.contains(&at)) {
            let (by_stamp, by_arrival) = (self.label(at), self.label(*other));
            return Some(format!(
                "the console's stamp points to {by_stamp}, the arrival to {by_arrival}, and its clock may have been set"
            ));
        }
        let (mut fitting, mut lost) = (0, 0);
        for frame in &self.known.open {
            let Some(other) = self.known.frames.get(frame).filter(|other| other.evidence.frame != self.pending.evidence.frame)
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
        if let Some((other, _)) = counted
            && (lost > 0 || fitting < FITTING)
        {
            let (by_stamp, by_counter) = (self.label(at), self.label(*other));
            return Some(format!(
                "the console's stamp points to {by_stamp}, the counter to {by_counter}, and its clock may have been set"
            ));
        }
        (lost > 1 + fitting / 2).then(|| {
            let label = self.label(at);
            format!(
                "the console's stamp fits {label}, but {lost} others from that time fit no exposure: its clock may have been set"
            )
        })
    }

    /// Why a frame is not believed to be of the exposure at `at`, which its stamp names: it came sooner after it than frames do, so it was in the
    /// making before, and its stamp is of when it was exported, or of another room's exposure.
    fn came_too_soon(&self, at: usize, usual_us: &RangeInclusive<i64>) -> Option<String> {
        // From the earliest that the beam can have been over, which is the latest that the frame can have come after it.
        let after_us = self.pending.evidence.arrival_us?.saturating_sub(self.known.shots.get(at).over_us);
        (after_us < *usual_us.start()).then(|| {
            let (label, from, to) = (self.label(at), seconds(*usual_us.start()), seconds(*usual_us.end()));
            let came = match after_us {
                0.. => format!("{} after {label}", seconds(after_us)),
                _ => format!("while {label} was on"),
            };
            format!("it came {came}, which its stamp names, others come after {from} to {to}: ambiguous")
        })
    }

    /// Why the stamp alone does not stand against what else there is: the console's clock, as it was then, rests on fewer than `needed` frames, and
    /// with those next to it whose stamps fit an exposure by it on fewer still, or too many of these fit none.
    fn few_confirm(&self, at: usize, needed: usize) -> Option<String> {
        let said = &self.pending.evidence;
        let (console_us, pair) = (said.console_us?, self.known.pair(said, at)?);
        let clocks = self.known.known_offsets().filter(|offset| offset.allows(&pair)).filter_map(ConsoleOffset::summary);
        let mut confirming = clocks.map(|clock| clock.frames as usize).max().unwrap_or(0);
        if confirming >= needed {
            return None;
        }
        let (before, after) =
            (self.known.by_stamp.range(..console_us).rev(), self.known.by_stamp.range(console_us.saturating_add(1)..));
        let mut lost = 0;
        for (_, frames) in before.take(BESIDE).chain(after.take(BESIDE)) {
            // Frames of one series may have one stamp.
            let open = frames.iter().find(|frame| self.known.open.contains(frame));
            let Some(stamp) = open.and_then(|frame| self.fitting(&self.known.frames.get(frame)?.evidence)) else { continue };
            if !stamp.fitting.is_empty() {
                confirming += 1;
            } else if self.timeline.exposure_tracker().blind_spot(stamp.from_us, stamp.to_us).is_none() {
                lost += 1;
            }
        }
        (confirming < needed || 4 * lost > confirming).then(|| {
            format!(
                "the console's stamp points to {}, but not all else does, and {confirming} frames confirm its clock, {lost} contradict it: ambiguous",
                self.label(at)
            )
        })
    }

    /// Whether the counter, which has never begun anew, contradicts that the frame is of the exposure at `at`, and no frame shortly before or
    /// after has the same new count: it may be of another room whose console keeps the same time.
    fn of_another_count(&self, at: usize, candidates: &[(usize, Firmness)]) -> bool {
        let (said, counting, shots) = (&self.pending.evidence, &self.known.counting, &self.known.shots);
        let (Some(console_us), Some(counter), Some(number)) = (said.console_us, said.counter, shots.number(at)) else {
            return false;
        };
        if counting.useless().is_some() || !counting.steady(shots) || candidates.iter().any(|(other, _)| *other == at) {
            return false;
        }
        let shift = i64::from(counter) - number;
        let (before, after) =
            (self.known.by_stamp.range(..console_us).rev(), self.known.by_stamp.range(console_us.saturating_add(1)..));
        let near = before.take(WITNESSES).chain(after.take(WITNESSES)).flat_map(|(_, frames)| frames);
        let same = |other: &FrameEvidence| {
            let fits = |own: i64| {
                let named = |shot: &usize| *shot != at && shots.number(*shot) == Some(own - shift);
                self.fitting(other).is_some_and(|stamp| stamp.fitting.iter().any(named))
            };
            other.counter.is_some_and(|own| fits(i64::from(own)))
        };
        !near.filter_map(|frame| self.known.frames.get(frame)).any(|other| same(&other.evidence))
    }

    /// Exposures of which a frame with this stamp must have one: none where telemetry was silent, for it may be of one that was not seen.
    fn places(&self, stamp: ByStamp) -> Vec<usize> {
        let blind = self.timeline.exposure_tracker().blind_spot(stamp.from_us, stamp.to_us).is_some();
        if blind { Vec::new() } else { stamp.fitting }
    }

    pub(super) fn by_stamp(&self) -> Option<ByStamp> {
        self.fitting(&self.pending.evidence)
    }

    /// Exposures at the time that the stamp names, once the console's offset is known.
    fn fitting(&self, said: &FrameEvidence) -> Option<ByStamp> {
        let console_us = said.console_us?;
        let mut found: Option<ByStamp> = None;
        for offset in self.known.known_offsets() {
            // The offset barely drifts while exposures are looked up: a second round takes it where the stamp falls.
            let (first_us, last_us) = offset.span_us()?;
            let mut bounds = offset.bounds(first_us / 2 + last_us / 2)?;
            for _ in 0..2 {
                let at_us = console_us.saturating_add(bounds.low_us / 2 + bounds.high_us / 2);
                bounds = offset.bounds(at_us)?;
            }
            let from_us = console_us.saturating_add(bounds.low_us).saturating_sub(150_000);
            let resolution_us = self.known.resolution_us(said);
            let to_us = console_us.saturating_add(resolution_us).saturating_add(bounds.high_us).saturating_add(150_000);
            let near = self.known.shots.touching(from_us, to_us);
            let causal = |at: &usize| !self.known.was_on_for(said, *at) || self.may_come_early(said, *at);
            let fitting: Vec<usize> = near
                .filter(causal)
                .filter(|at| self.known.pair(said, *at).is_some_and(|pair| self.known.allowed(&pair)))
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

    /// Whether the frame, which came while the exposure at `at` was on, may be of it: counter or arrival have to say so.
    fn may_come_early(&self, said: &FrameEvidence, at: usize) -> bool {
        let on = said.arrival_us.is_some_and(|arrival_us| self.known.shots.on_at(arrival_us) == Some(at));
        let prompt = self.known.frames.get(&said.frame).and_then(|pending| pending.prompt.as_deref()).unwrap_or_default();
        on && (self.known.counter_names(said, at) || prompt.contains(&at))
    }

    /// Telemetry has passed the time, or will not any more.
    pub(super) fn telemetry_covers(&self, until_us: i64) -> bool {
        let said = &self.pending.evidence;
        let limit_us = said.arrival_us.map_or(until_us, |arrival_us| until_us.saturating_add(AFTER_STAMP_US).min(arrival_us));
        let gave_up = said.arrival_us.is_some_and(|arrival_us| self.now_us.saturating_sub(arrival_us) >= 2 * AFTER_STAMP_US);
        self.known.finished || gave_up || self.newest_us.is_some_and(|newest_us| newest_us >= limit_us)
    }

    /// That counter and stamp name the exposure, to which a console that counts otherwise gives another number.
    fn both_words(&self, at: usize) -> String {
        let own =
            self.pending.evidence.counter.filter(|counter| self.known.shots.get(at).counter.is_some_and(|own| own != *counter));
        match own {
            Some(counter) => format!(
                "the counter, {counter}, means {0} by the console's count of other frames; the console's stamp fits {0}",
                self.label(at)
            ),
            None => format!("counter and stamp both name {}", self.label(at)),
        }
    }

    pub(super) fn with_stamp(
        &self,
        stamp: &ByStamp,
        candidates: &[(usize, Firmness)],
        prompt: &[usize],
        mut words: Vec<String>,
    ) -> Judgement {
        let both: Vec<(usize, Firmness)> = candidates.iter().filter(|(at, _)| stamp.fitting.contains(at)).copied().collect();
        match (&both[..], &stamp.fitting[..]) {
            ([(at, firmness)], fitting) if fitting.len() == 1 || self.decides(*at, *firmness, fitting) => {
                words.push(self.both_words(*at));
                self.of(*at, BindingHow::Counter, words, true)
            }
            (_, []) => {
                words.push(format!("the console's stamp fits no exposure{}", self.offset_words()));
                none(words)
            }
            (_, [at]) => {
                let usual_us = self.usual_delay_us();
                if let Some(set) = self.may_be_set(*at, candidates, prompt, usual_us.as_ref()) {
                    words.push(set);
                    return none(words);
                }
                let free = |at: usize| self.known.shots.get(at).frame.is_none();
                let firm = candidates.iter().find(|(other, firmness)| *firmness == Firmness::Enclosed && free(*other));
                if let Some((other, _)) = firm
                    && !prompt.contains(at)
                {
                    let (by_stamp, by_counter) = (self.label(*at), self.label(*other));
                    words.push(format!("the console's stamp points to {by_stamp}, the counter to {by_counter}: contradictory"));
                    return none(words);
                }
                let counts = self.known.counting.shifts().next().is_some();
                if counts
                    && self.pending.evidence.counter.is_some()
                    && !both.iter().any(|(both, _)| both == at)
                    && words.is_empty()
                {
                    if let Some(few) = self.few_confirm(*at, CONFIRMED_AGAINST_COUNTER) {
                        words.push(few);
                        return none(words);
                    }
                    words.push("the counter contradicts the stamp and is dropped for this frame".to_owned());
                }
                // How soon frames come would tell one from the other.
                let waits = |other: &&usize| *other != at && free(**other);
                if usual_us.is_none()
                    && prompt.contains(at)
                    && let Some(other) = prompt.iter().rfind(waits)
                {
                    // A stamp of the whole series names its first exposure, whose frame may be missing.
                    if other > at && !self.known.finished {
                        let (by_stamp, later) = (self.label(*at), self.label(*other));
                        words.push(format!(
                            "the console's stamp points to {by_stamp}, but the frame may be of {later} as well: how soon frames come is not known yet"
                        ));
                        return none(words);
                    }
                    if let Some(few) = self.few_confirm(*at, CONFIRMED) {
                        words.push(few);
                        return none(words);
                    }
                }
                if self.of_another_count(*at, candidates) {
                    words.push(format!(
                        "the console's stamp fits {}, but its counter never began anew and is at another number: contradictory",
                        self.label(*at)
                    ));
                    return none(words);
                }
                // At the end few frames are no measure against a stamp that nothing competes with.
                let few = || self.first_delays_us().filter(|_| !self.known.finished || prompt.iter().any(|other| other != at));
                if let Some(sooner) = usual_us.or_else(few).and_then(|usual_us| self.came_too_soon(*at, &usual_us)) {
                    words.push(sooner);
                    return none(words);
                }
                if let Some(blind) = self.blind(*at, stamp.from_us, stamp.to_us) {
                    words.push(blind);
                    return none(words);
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
                none(words)
            }
        }
    }

    fn offset_words(&self) -> String {
        match self.known.clock().filter(|clock| clock.frames >= KNOWN_FRAMES) {
            Some(clock) => {
                let words = clock.words_beside_zone(self.known.zone_min);
                format!(" (its clock is {words}, from {} frames)", clock.frames)
            }
            None => String::new(),
        }
    }
}

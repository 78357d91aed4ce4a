//! One frame against everything that is known: bound, not bound and why, or not yet.

use std::ops::RangeInclusive;

use super::Timeline;
use super::counting::Firmness;
use super::evidence::BindingHow;
use super::known::{Known, Pending};
use super::shots::{BATCH_US, PATIENCE_US, was_on};
use super::zone::{BESIDE_ZONE_US, off_zone_us};

/// A first frame that comes later than this after the only exposure before it may be of something that was not seen.
const SOON_US: i64 = 4_000_000;

/// Why no frame is bound where there is nothing to bind it to.
pub const NO_EXPOSURE: &str = "telemetry recorded no exposure";

/// What came of it.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Judgement {
    /// Of the exposure at this position. `teaches`: two kinds of evidence agree, so console and counter may be learnt from it.
    Of { shot: usize, how: BindingHow, evidence: Vec<String>, teaches: bool },
    /// Of a file whose images are each of an exposure of its own, the first of the one at this position.
    OfEach { first: usize, how: BindingHow, evidence: Vec<String> },
    /// Telemetry or other frames may decide within a second.
    Wait(String),
    /// No exposure, with what was found, and the frame that has the one that all names.
    None { evidence: Vec<String>, taken_by: Option<u32> },
}

/// A frame with all that bears on it.
pub(super) struct Weighed<'a> {
    pub known: &'a Known,
    pub timeline: &'a Timeline,
    pub newest_us: Option<i64>,
    pub now_us: i64,
    pub pending: &'a Pending,
}

impl Weighed<'_> {
    /// What the frame by itself gives, whatever others there are.
    pub(super) fn claim(&self) -> Judgement {
        if self.pending.prompt.is_none() && self.came_before_the_end() {
            return Judgement::Wait("an exposure was on when the frame arrived, and has not ended yet".to_owned());
        }
        // Not for one that falls silent once more.
        let is_told = self.newest_us.is_some_and(|newest_us| self.now_us.saturating_sub(newest_us) < PATIENCE_US);
        if !self.known.finished && is_told && self.known.shots.awaits_unseen(self.timeline.exposure_tracker()) {
            return Judgement::Wait("telemetry has just told of exposures that it did not see".to_owned());
        }
        if self.known.shots.len() == 0 {
            return none(vec![NO_EXPOSURE.to_owned()]);
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
            None if self.pending.evidence.console_us.is_none() && self.known.clock().is_some() => {
                words.push("it lacks the stamp that other frames have".to_owned());
                self.counted_and_prompt(&candidates, prompt, words)
            }
            None => self.without_stamp(&candidates, prompt, words),
        }
    }

    /// Whether the frame came while an exposure was on that still is.
    fn came_before_the_end(&self) -> bool {
        let open = self.timeline.exposure_tracker().open();
        open.zip(self.pending.evidence.arrival_us).is_some_and(|(open, arrival_us)| was_on(open, arrival_us))
    }

    /// Exposures that the counter allows, and what is to be said of it.
    fn by_counter(&self) -> (Vec<(usize, Firmness)>, Option<String>) {
        let Some(counter) = self.pending.evidence.counter else {
            return (Vec::new(), Some("the frame carries no exposure counter".to_owned()));
        };
        if let Some(reason) = self.known.counting.useless() {
            return (Vec::new(), Some(reason));
        }
        let mut found = self.known.counting.candidates(&self.known.shots, counter, &|from, to| self.hidden(from, to));
        if let Some(arrival_us) = self.pending.evidence.arrival_us {
            found.retain(|(at, _)| self.known.shots.get(*at).start_us <= arrival_us);
        }
        (found, None)
    }

    fn hidden(&self, from: usize, to: usize) -> bool {
        self.known.hidden(from, to, self.timeline)
    }

    /// Whether the counter decides for `at` among `several` exposures: no other of them waits for its frame, or the counter's
    /// shift is the same before and after. A console that counts the pictures it stores names a neighbour as soon as one is missing or one more
    /// was stored.
    pub(super) fn decides(&self, at: usize, firmness: Firmness, several: &[usize]) -> bool {
        let said = &self.pending.evidence;
        let mut rivals = several.iter().copied().filter(|other| self.known.rival(said, at, *other));
        if firmness >= Firmness::OneSide && rivals.clone().next().is_none() {
            return true;
        }
        // One picture too few and one too many leave the same shift on either side; when the frame came shows it.
        let usual_us = self.usual_delay_us();
        let usual = |at: usize| usual_us.as_ref().is_some_and(|usual_us| self.came_within(usual_us, at));
        firmness == Firmness::Enclosed
            && self.known.counting.counts_exposures(&self.known.shots, &|from, to| self.hidden(from, to))
            && (usual(at) || !rivals.any(usual) && (usual_us.is_some() || said.console_us.is_some()))
    }

    /// Whether an equal number may be believed although nothing is known of the console: its counter has moved, or its clock is the host's but
    /// for the zone, as a picture from hours before it would not show.
    fn credible(&self) -> bool {
        let said = &self.pending.evidence;
        let behind_us =
            said.console_us.zip(said.arrival_us).map(|(console_us, arrival_us)| arrival_us.saturating_sub(console_us));
        let beside_us = behind_us.map(|us| off_zone_us(us).abs());
        self.known.finished || self.known.counting.moves() || beside_us.is_some_and(|us| us <= BESIDE_ZONE_US)
    }

    /// Whether the arrival may be an older frame's, from before the counter began anew: another frame with the same count came promptly
    /// after the exposure as well, or one of a batch whose counts name no exposure shortly before it.
    fn contested(&self, at: usize, counter: u32) -> bool {
        let (said, shots) = (&self.pending.evidence, &self.known.shots);
        let (Some(arrival_us), Some(number)) = (said.arrival_us, shots.number(at)) else { return false };
        let shift = i64::from(counter) - number;
        self.known.frames.values().filter(|other| other.evidence.frame != said.frame).any(|other| {
            let (Some(other_us), Some(count)) = (other.evidence.arrival_us, other.evidence.counter) else { return false };
            let prompt = other.prompt.as_deref().unwrap_or_default();
            let named = prompt.iter().any(|shot| shots.number(*shot) == Some(i64::from(count) - shift));
            let batch = other_us.saturating_sub(arrival_us).saturating_abs() <= BATCH_US;
            count == counter && prompt.contains(&at) || batch && other.prompt.is_some() && !named
        })
    }

    /// Whether the frame came so long after the exposure, µs.
    pub(super) fn came_within(&self, delay_us: &RangeInclusive<i64>, at: usize) -> bool {
        let end_us = self.known.shots.get(at).end_us;
        self.pending.evidence.arrival_us.is_some_and(|arrival_us| delay_us.contains(&arrival_us.saturating_sub(end_us)))
    }

    /// Whether the frame came no later after the exposure than others do, or soon where that is not known yet.
    fn timely(&self, at: usize) -> bool {
        let latest_us = self.usual_delay_us().map_or(SOON_US, |usual_us| *usual_us.end());
        let end_us = self.known.shots.get(at).end_us;
        self.pending.evidence.arrival_us.is_none_or(|arrival_us| arrival_us.saturating_sub(end_us) <= latest_us)
    }

    /// Whether the frame came as long after another exposure as frames do, and not so after this one: one picture too few and one too many
    /// have all between them count on as if they were of the exposure before, whose frame each of them then takes.
    fn came_as_after_another(&self, at: usize, prompt: &[usize]) -> bool {
        let usual_us = self.usual_delay_us();
        let usual = |other: usize| usual_us.as_ref().is_some_and(|usual_us| self.came_within(usual_us, other));
        !usual(at) && prompt.iter().any(|other| usual(*other))
    }

    /// A frame unlike the others is bound only where counter and arrival name the same exposure, and last of all: the exposure's own frame
    /// may still come.
    fn counted_and_prompt(&self, candidates: &[(usize, Firmness)], prompt: &[usize], mut words: Vec<String>) -> Judgement {
        match candidates {
            [(at, firmness)] if *firmness >= Firmness::OneSide && prompt.contains(at) => {
                words.push(format!("counter and arrival name {}", self.label(*at)));
                if !self.known.finished {
                    words.push("until the end of the session a frame like the others may come for it".to_owned());
                    return none(words);
                }
                self.of(*at, BindingHow::Counter, words, false)
            }
            _ => {
                let said = &self.pending.evidence;
                let says_nothing = said.counter.is_none() && said.console_us.is_none() && said.arrival_us.is_none();
                words.push(match says_nothing {
                    true => "no time and no counter in this picture: nothing ties it".to_owned(),
                    false => "counter and arrival do not name one exposure".to_owned(),
                });
                none(words)
            }
        }
    }

    fn without_stamp(&self, candidates: &[(usize, Firmness)], prompt: &[usize], mut words: Vec<String>) -> Judgement {
        let said = &self.pending.evidence;
        let free = |at: usize| self.known.shots.get(at).frame.is_none();
        let open: Vec<(usize, Firmness)> = candidates.iter().filter(|(at, _)| free(*at)).copied().collect();
        if let ([(at, firmness)], Some(counter)) = (&open[..], said.counter) {
            // A value that came before may be one that does not move, or that began anew.
            let fresh = self.known.counting.times_seen(counter) <= 1;
            if *firmness == Firmness::Equal && !self.credible() {
                words.push(
                    "a count that has not moved yet may be one that does not move, of a picture of something else".to_owned(),
                );
                return none(words);
            }
            // Where nothing is known yet, an equal number proves little beside a second exposure, or an earlier one that waits for its frame.
            let waits = |other: usize| *firmness == Firmness::Equal && free(other);
            let timed = *firmness == Firmness::Enclosed || self.timely(*at);
            let proved = self.decides(*at, *firmness, prompt) && timed && !self.came_as_after_another(*at, prompt)
                || fresh && prompt.len() == 1 && self.timely(*at) && !(0..*at).any(waits)
                || fresh && self.orderly(*at, *firmness, prompt);
            if prompt.contains(at) && proved && !self.contested(*at, counter) {
                let was = match self.known.was_on_for(said, *at) {
                    true => "was on when",
                    false => "ended shortly before",
                };
                words.push(format!("counter {counter} names {}, which {was} the frame arrived", self.label(*at)));
                return self.of(*at, BindingHow::Counter, words, true);
            }
            // An exposure right before the arrival competes: always, if the frame came promptly for either; else unless the counter is
            // known not to have begun anew by then.
            let competes = |other: usize| match prompt.contains(at) {
                true => self.known.rival(said, *at, other),
                false => free(other) && other != *at && !self.known.counting.passed(other),
            };
            let rival = prompt.iter().find(|other| competes(**other));
            let steady = self.known.counting.steady(&self.known.shots) && !self.known.restless();
            let firm = steady && *firmness == Firmness::Enclosed;
            if let Some(rival) = rival.filter(|_| firm) {
                words.push(format!("the counter names {}, the arrival {}: ambiguous", self.label(*at), self.label(*rival)));
                return none(words);
            }
            let anew = self.known.counting.may_have_begun_anew(&self.known.shots, counter);
            if firm && !anew && candidates.len() == 1 && fresh && said.console_us.is_none() {
                words.push(format!("counter {counter} names {}, between frames with the same count", self.label(*at)));
                return self.of(*at, BindingHow::Counter, words, false);
            }
        }
        if let ([(at, _)], [], Some(counter)) = (candidates, &open[..], said.counter)
            && let Some(other) = self.known.shots.get(*at).frame
        {
            words.push(format!("counter {counter} names {}, which frame {other} has already", self.label(*at)));
            return Judgement::None { evidence: words, taken_by: Some(other) };
        }
        self.by_arrival(prompt, words)
    }

    /// The verdict for one exposure, unless another frame has it.
    pub(super) fn of(&self, shot: usize, how: BindingHow, mut evidence: Vec<String>, teaches: bool) -> Judgement {
        if let Some(other) = self.known.shots.get(shot).frame {
            let other_length = self.other_length_words(shot, other);
            let taken_by = other_length.is_none().then_some(other);
            evidence.extend(other_length);
            evidence.push(format!("{} has frame {other} already; one exposure has one frame", self.label(shot)));
            return Judgement::None { evidence, taken_by };
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
        let shot = self.known.shots.get(shot);
        match shot.counter {
            Some(counter) => format!("exposure {counter}"),
            None => format!("exposure #{} of the session", shot.index + 1),
        }
    }
}

/// No exposure, and no frame that has it.
pub(super) fn none(evidence: Vec<String>) -> Judgement {
    Judgement::None { evidence, taken_by: None }
}

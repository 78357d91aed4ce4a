//! What the binder learns before and beside single frames: the console's offset, anew whenever its clock was set, and the counter's shift.

use std::collections::BTreeSet;

use super::Timeline;
use super::agreement::{Suggestion, Topic, agreement};
use super::alignment::{Stamped, align};
use super::apart::Images;
use super::arrival::usual_us_of;
use super::console::{ConsoleOffset, Pair};
use super::evidence::{Binding, BindingHow, seconds};
use super::known::{KNOWN_FRAMES, Known, Pending};

/// Exposures farther apart than this have no common offset.
const APART_US: i64 = 4_000_000;
/// Frames that agree come after about the same time; one that comes so much later is doubted.
const LATER_US: i64 = 2_000_000;
/// Frames from whose agreement it is known how soon frames come.
const TIMED: usize = 8;
/// Beside the offset's bounds, an exposure is still looked for.
const BESIDE_US: i64 = 500_000;
/// Frames with two readings that show which of them is the more even.
const COMMON: usize = 4;

impl Known {
    /// What the latest prompt frames suggest, as far as it is not known already.
    fn suggestions(&self, topic: Topic) -> Vec<Suggestion> {
        let mut found = self.suggested_by(self.voters.iter().filter_map(|frame| self.frames.get(frame)));
        if topic == Topic::Offset && self.known_offsets().next().is_some() {
            // Only frames that no known offset explains can show that the clock was set.
            let explained: BTreeSet<u32> =
                found.iter().filter(|s| self.pair_of(s).is_some_and(|pair| self.allowed(&pair))).map(|s| s.frame).collect();
            let last_us = self.offsets.last().and_then(ConsoleOffset::span_us).map_or(i64::MIN, |(_, last_us)| last_us);
            found.retain(|s| !explained.contains(&s.frame) && s.at_us > last_us);
        }
        found
    }

    /// What these frames suggest.
    pub(super) fn suggested_by<'a>(&self, frames: impl Iterator<Item = &'a Pending>) -> Vec<Suggestion> {
        let mut found = Vec::new();
        for pending in frames {
            let said = &pending.evidence;
            for shot in pending.prompt.iter().flatten().copied() {
                let at = self.shots.get(shot);
                let taken = at.frame.is_some_and(|frame| frame != said.frame);
                let elsewhere = pending.binding.exposure.as_ref().is_some_and(|exposure| exposure.index != at.index);
                // Late frames come while another exposure is on: with some shift or offset two of them always agree.
                let early = self.was_on_for(said, shot) && !self.counter_names(said, shot);
                if taken || elsewhere || early {
                    continue;
                }
                let number = self.shots.number(shot);
                found.push(Suggestion {
                    frame: said.frame,
                    shot,
                    latest: pending.prompt.as_ref().and_then(|prompt| prompt.last()).copied(),
                    at_us: at.end_us,
                    offset: self.pair(said, shot).filter(|_| at.whole).map(|pair| pair.any),
                    shift: said.counter.zip(number).map(|(counter, number)| i64::from(counter) - number),
                });
            }
        }
        found
    }

    /// The pair that says what the suggestion says of the offset.
    fn pair_of(&self, suggestion: &Suggestion) -> Option<Pair> {
        suggestion.offset.and_then(|_| self.pair(&self.frames.get(&suggestion.frame)?.evidence, suggestion.shot))
    }

    /// With no offset known from prompt frames: the one at which the whole batch falls into place, if there is only one.
    pub(super) fn align(&mut self, timeline: &Timeline) {
        if self.known_offsets().next().is_some() {
            return;
        }
        let stamped = |frame: &u32| {
            let said = &self.frames.get(frame)?.evidence;
            let (console_us, resolution_us) = (said.console_us?, self.resolution_us(said));
            Some(Stamped { console_us, resolution_us, counter: said.counter, arrival_us: said.arrival_us })
        };
        let stamps: Vec<Stamped> = self.open.iter().filter_map(stamped).collect();
        let blind = |from_us: i64, to_us: i64| timeline.exposure_tracker().blind_spot(from_us, to_us).is_some();
        let pairs = align(stamps, &self.shots, &blind, self.finished);
        // A frame that came after the next exposure as well may be of that one, if the clock was set: it teaches only where there is no
        // other.
        let alone = |(stamped, at): &(Stamped, usize)| {
            let prompt = stamped.arrival_us.map(|arrival_us| self.shots.prompt(arrival_us)).unwrap_or_default();
            !prompt.contains(at) || prompt.last() == Some(at)
        };
        let only_alone = pairs.iter().filter(|pair| alone(pair)).count() > KNOWN_FRAMES as usize;
        let mut offset = ConsoleOffset::default();
        for (stamped, at) in pairs.iter().filter(|pair| !only_alone || alone(pair)) {
            offset.learn(&self.shots.get(*at).pair(stamped.console_us, stamped.resolution_us));
        }
        if offset.summary().is_some_and(|clock| clock.frames >= KNOWN_FRAMES) {
            self.offsets = vec![offset];
        }
    }

    pub(super) fn agree_on_offset(&mut self, timeline: &Timeline) {
        let known = self.known_offsets().next().is_some();
        let suggestions = self.suggestions(Topic::Offset);
        let learnt =
            agreement(Topic::Offset, &suggestions).is_some_and(|members| self.learn_offset(timeline, &members, known, false));
        if learnt || known {
            return;
        }
        let members = agreement(Topic::Both, &suggestions).or_else(|| self.kept(timeline));
        if let Some(members) = members {
            self.learn_offset(timeline, &members, known, true);
        }
    }

    /// Takes the offset that `members` agree on, unless they are too few; `counted`: more than their stamps says which exposure each has.
    fn learn_offset(&mut self, timeline: &Timeline, members: &[Suggestion], known: bool, counted: bool) -> bool {
        let frames: BTreeSet<u32> = members.iter().map(|member| member.frame).collect();
        if known && frames.len() < 3 || !known && self.outvoted(members, timeline) {
            return false;
        }
        let mut offset = ConsoleOffset::default();
        for member in members {
            // A frame that may be of two exposures seconds apart teaches nothing: its true one need not be the one that agrees, even where
            // another frame has that one (a second picture) or telemetry missed it.
            let other = |at: &usize| {
                let shot = self.shots.get(*at);
                *at != member.shot && (!shot.whole || shot.end_us.saturating_sub(member.at_us).saturating_abs() < APART_US)
            };
            let prompt = self.frames.get(&member.frame).and_then(|pending| pending.prompt.as_deref()).unwrap_or_default();
            let alone = counted || !prompt.iter().any(other);
            if let Some(pair) = self.pair_of(member).filter(|_| alone) {
                offset.learn(&pair);
            }
        }
        // Two frames of which the others of their party may each be of a neighbour prove nothing.
        let needed = if frames.len() <= KNOWN_FRAMES as usize { KNOWN_FRAMES } else { KNOWN_FRAMES + 1 };
        let enough = offset.summary().is_some_and(|clock| clock.frames >= needed);
        if enough {
            if !known {
                self.offsets.clear();
            }
            self.offsets.push(offset);
        }
        enough
    }

    /// Whether more of the other frames contradict what `members` agree on than support it: with the offset that follows, their stamps fit no
    /// exposure, at times that telemetry has seen.
    fn outvoted(&self, members: &[Suggestion], timeline: &Timeline) -> bool {
        let Some(common) = members.iter().filter_map(|member| member.offset).reduce(|all, own| all.and(&own)) else {
            return false;
        };
        // Stamps that contradict each other name no offset.
        if common.low_us > common.high_us {
            return false;
        }
        let (mut fitting, mut lost) = (members.len(), 0);
        for pending in self.frames.values().filter(|pending| pending.prompt.is_some()) {
            let said = &pending.evidence;
            let Some(console_us) = said.console_us.filter(|_| members.iter().all(|member| member.frame != said.frame)) else {
                continue;
            };
            let from_us = console_us.saturating_add(common.low_us).saturating_sub(BESIDE_US);
            let to_us =
                console_us.saturating_add(common.high_us).saturating_add(self.resolution_us(said)).saturating_add(BESIDE_US);
            let meets = |at: usize| self.pair(said, at).is_some_and(|pair| pair.any.meets(&common));
            if self.shots.touching(from_us, to_us).any(meets) {
                fitting += 1;
            } else if timeline.exposure_tracker().blind_spot(from_us, to_us).is_none() {
                lost += 1;
            }
        }
        lost > fitting
    }

    /// Without stamps, prompt frames that agree on the counter's shift are bound by it: which, and how.
    pub(super) fn agree_on_shift(&mut self, timeline: &Timeline) -> Vec<(u32, Binding)> {
        let mut bound = Vec::new();
        if self.known_offsets().next().is_some() || self.counting.useless().is_some() {
            return bound;
        }
        let suggestions = self.suggestions(Topic::Shift);
        let unbound = |s: &Suggestion| self.open.contains(&s.frame);
        if !suggestions.iter().any(unbound) {
            return bound;
        }
        // Where the C-arm does not count, a silence may have swallowed or torn an exposure: numbers before and after do not compare.
        let tracker = timeline.exposure_tracker();
        let stretch = |s: &Suggestion| if self.shots.counted { 0 } else { tracker.silences_before(s.at_us) };
        let stretches: BTreeSet<usize> = suggestions.iter().map(stretch).collect();
        let within = |at: usize| suggestions.iter().filter(|s| stretch(s) == at).copied().collect::<Vec<_>>();
        let agreed: Vec<Suggestion> =
            stretches.into_iter().filter_map(|at| agreement(Topic::Shift, &within(at))).flatten().collect();
        let delay_us = |member: &Suggestion| {
            let arrival_us = self.frames.get(&member.frame).and_then(|pending| pending.evidence.arrival_us);
            arrival_us.map_or(0, |arrival_us| arrival_us.saturating_sub(member.at_us))
        };
        let mut delays_us: Vec<i64> = agreed.iter().map(delay_us).collect();
        delays_us.sort_unstable();
        let usual_us = delays_us.get(delays_us.len().saturating_sub(1) / 2).copied().unwrap_or(0);
        // One that came much later than the others came for something else, or is of a later exposure.
        let agreed: Vec<Suggestion> =
            agreed.into_iter().filter(|member| delay_us(member) <= usual_us.saturating_add(LATER_US)).collect();
        if self.outvoted(&agreed, timeline) {
            return bound;
        }
        // One missing picture moves every later count to the exposure before; then those come after theirs at more even times.
        let rivals: BTreeSet<i64> = suggestions.iter().filter_map(|s| s.shift).collect();
        let doubted = |shift: i64| {
            let pairs: Vec<(i64, i64)> = suggestions
                .iter()
                .filter(|s| s.shift == Some(shift))
                .filter_map(|s| agreed.iter().find(|own| own.frame == s.frame && own.shift != s.shift).map(|own| (own, s)))
                .map(|(own, other)| (delay_us(own), delay_us(other)))
                .collect();
            let spread_us = |delays: &mut dyn Iterator<Item = i64>| {
                let (low_us, high_us) = delays.fold((i64::MAX, i64::MIN), |(low, high), us| (low.min(us), high.max(us)));
                high_us.saturating_sub(low_us)
            };
            let own_us = spread_us(&mut pairs.iter().map(|(own_us, _)| *own_us));
            pairs.len() >= COMMON && spread_us(&mut pairs.iter().map(|(_, other_us)| *other_us)) < own_us
        };
        if rivals.into_iter().any(doubted) {
            return bound;
        }
        let delays_us: Vec<i64> = agreed.iter().map(delay_us).collect();
        let usual_us = usual_us_of(delays_us).filter(|_| agreed.len() >= TIMED);
        for member in agreed {
            let Some(exposure) = timeline.exposure(self.shots.get(member.shot).index).cloned() else { continue };
            let free = |at: usize| self.shots.get(at).frame.is_none();
            let Some(pending) = self.frames.get(&member.frame).filter(|_| self.open.contains(&member.frame)) else { continue };
            // What other frames agreed on may not hold any more: it does not choose between two exposures that wait for their frames, unless
            // the frame would have come sooner or later after the other one than any that agreed.
            let timely = |other: usize| {
                let delay_us = pending.evidence.arrival_us.map(|us| us.saturating_sub(self.shots.get(other).end_us));
                usual_us.as_ref().zip(delay_us).is_none_or(|(usual_us, delay_us)| usual_us.contains(&delay_us))
            };
            let rival =
                pending.prompt.iter().flatten().any(|other| timely(*other) && self.rival(&pending.evidence, member.shot, *other));
            let is_of_one = self.images_of(&pending.evidence, member.shot, timeline) == Images::OfOne;
            if rival || !free(member.shot) || !is_of_one {
                continue;
            }
            let late_us = pending.evidence.arrival_us.map_or(0, |arrival_us| arrival_us.saturating_sub(exposure.end_us));
            let evidence = vec![
                match late_us {
                    0.. => format!("{} ended {} before the frame arrived", exposure.label(), seconds(late_us)),
                    _ => format!("{} was on when the frame arrived", exposure.label()),
                },
                format!(
                    "its counter differs from the exposure's number by {}, as that of other prompt frames",
                    member.shift.unwrap_or(0)
                ),
            ];
            let binding = self.bind(member.frame, member.shot, exposure, BindingHow::Counter, evidence, true);
            bound.extend(binding.map(|binding| (member.frame, binding)));
        }
        bound
    }
}

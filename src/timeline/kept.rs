//! A console that keeps the host's time, but for its zone: believed where nothing else explains what came.
//!
//! Where exposures follow each other evenly, stamps and counts agree with the exposure before or after as well, and where frames come late
//! nothing is prompt. A console whose clock is off by just the time between exposures is rare, but it exists; it leaves a mark: its first or
//! its last picture finds no exposure at the times of a kept clock, or one that had not yet ended when the picture came.

use std::collections::{BTreeMap, BTreeSet};

use super::Timeline;
use super::agreement::Suggestion;
use super::alignment::{Stamped, Stamps};
use super::console::Bounds;
use super::known::{Known, Pending};
use super::zone::off_zone_us;

/// A console that keeps the host's time is not farther off than this.
const KEPT_US: i64 = 500_000;
/// An offset known no better than this, either way, says nothing.
const WIDE_US: i64 = 1_500_000;
/// Frames that come so soon after an exposure are hardly of the one before.
const AT_ONCE_US: i64 = 1_500_000;
/// The farthest zone, either way.
const FARTHEST_US: i64 = 14 * 3_600_000_000;
/// The latest frames are asked whether it does.
const KEPT_LOOKED_AT: usize = 24;
/// Exposures whose frames must show that it does, and where their counts do not say the same.
const KEPT_SHOTS: usize = 3;
const KEPT_BY_STAMP: usize = 4;
/// Readings of more pairs of frame and exposure than this are not compared, while a session runs and when it is over.
const MOST_PAIRS: usize = 20_000;
const MOST_PAIRS_AT_END: usize = 1_000_000;

/// The zone (its offset, µs) that an offset within these bounds may be, if any.
fn zone_of(bounds: Bounds) -> Option<i64> {
    let half_us = bounds.high_us.saturating_sub(bounds.low_us) / 2;
    let middle_us = bounds.low_us.saturating_add(half_us);
    let off_us = off_zone_us(middle_us);
    let zone_us = middle_us.saturating_sub(off_us);
    (half_us <= WIDE_US && off_us.saturating_abs() <= half_us + KEPT_US && zone_us.saturating_abs() <= FARTHEST_US)
        .then_some(zone_us)
}

impl Known {
    /// What the frames suggest that speak for a console with the host's time; none where they may be read otherwise.
    pub(super) fn kept(&self, timeline: &Timeline) -> Option<Vec<Suggestion>> {
        self.kept_by_both().or_else(|| self.kept_alone(timeline))
    }

    /// A console that keeps the host's time and counts as the C-arm does: all frames that came carry number and time of the exposure that
    /// ended last before them. A console that has neither would have to be off by one exposure in both; where frames do not come at once, it is
    /// believed only if they do not fit the exposures before as well. What telemetry did not see does not matter here, so that the first frames
    /// of a session speak as well.
    fn kept_by_both(&self) -> Option<Vec<Suggestion>> {
        let suggestions = self.suggested_by(self.frames.values().rev().take(KEPT_LOOKED_AT));
        let voters: BTreeSet<u32> =
            suggestions.iter().filter(|s| s.offset.is_some() && s.shift.is_some()).map(|s| s.frame).collect();
        let kept = |s: &&Suggestion| {
            self.shots.counted && s.shift == Some(0) && s.latest == Some(s.shot) && s.offset.and_then(zone_of).is_some()
        };
        let members: Vec<Suggestion> = suggestions.iter().filter(kept).copied().collect();
        let frames: BTreeSet<u32> = members.iter().map(|member| member.frame).collect();
        let shots: BTreeSet<usize> = members.iter().map(|member| member.shot).collect();
        let late_us = |member: &Suggestion| {
            let arrival_us = self.frames.get(&member.frame).and_then(|pending| pending.evidence.arrival_us);
            arrival_us.map_or(0, |arrival_us| arrival_us.saturating_sub(member.at_us))
        };
        let at_once = members.iter().all(|member| late_us(member) <= AT_ONCE_US);
        (frames == voters && shots.len() >= KEPT_SHOTS && (at_once || !self.fit_the_exposures_before(&members)))
            .then_some(members)
    }

    /// Whether one other offset makes each of the frames one of the exposure before its own.
    fn fit_the_exposures_before(&self, members: &[Suggestion]) -> bool {
        let before = |member: &Suggestion| {
            let pending = self.frames.get(&member.frame)?;
            Some(self.pair(&pending.evidence, member.shot.checked_sub(1)?)?.any)
        };
        let offsets: Option<Vec<Bounds>> = members.iter().map(before).collect();
        let common = offsets.and_then(|offsets| offsets.into_iter().reduce(|all, own| all.and(&own)));
        common.is_some_and(|common| common.low_us <= common.high_us)
    }

    /// The same of frames that come late, or were exported afterwards: all that fall into the session carry time (and number, where the
    /// C-arm and the console count alike) of an exposure, and with no other offset as many of them do.
    fn kept_alone(&self, timeline: &Timeline) -> Option<Vec<Suggestion>> {
        let stands = |pending: &&Pending| {
            let said = &pending.evidence;
            said.console_us.is_some() && self.contents.get(&said.content).is_some_and(|(first, _)| *first == said.frame)
        };
        let stamped = (self.whole_minutes + self.other_stamps) as usize;
        let most = if self.finished { MOST_PAIRS_AT_END } else { MOST_PAIRS };
        if self.shots.len() == 0 || stamped.saturating_mul(self.shots.len()) > most {
            return None;
        }
        // Of two pictures of one exposure, as it came and processed, one speaks.
        let mut said = BTreeSet::new();
        let is_first = |pending: &&Pending| said.insert((pending.evidence.console_us, pending.evidence.counter));
        let frames: Vec<&Pending> = self.frames.values().filter(stands).filter(is_first).collect();
        let blind = |from_us: i64, to_us: i64| timeline.exposure_tracker().blind_spot(from_us, to_us).is_some();
        let mut members = self.of_one_zone(&frames, &blind)?;
        let strangers = frames.len() - members.len();
        let alike = self.shots.counted
            && self.counting.useless().is_none()
            && members.iter().all(|near| near.iter().any(|s| s.shift == Some(0)));
        if alike {
            members.iter_mut().for_each(|near| near.retain(|s| s.shift == Some(0)));
        }
        let enough = 4 * strangers <= members.len();
        let single: Vec<Suggestion> = members.iter().filter(|near| near.len() == 1).flatten().copied().collect();
        let shots: BTreeSet<usize> = single.iter().map(|member| member.shot).collect();
        let least = if alike { KEPT_SHOTS } else { KEPT_BY_STAMP + usize::from(!self.finished) };
        if !enough || shots.len() < least || shots.len() < single.len() || single.iter().any(|member| self.contradicted(member)) {
            return None;
        }
        let common = single.iter().filter_map(|member| member.offset).reduce(|all, own| all.and(&own))?;
        // An offset that fits the next exposure as well tells nothing of either.
        let least_step_us = single.iter().map(|member| self.step_us(member)).min()?;
        let width_us = common.high_us.saturating_sub(common.low_us);
        zone_of(common).filter(|_| (0..=least_step_us / 4 * 3).contains(&width_us))?;
        let stamped = |pending: &&Pending| {
            let (said, resolution_us) = (&pending.evidence, self.resolution_us(&pending.evidence));
            Some(Stamped { console_us: said.console_us?, resolution_us, counter: said.counter, arrival_us: said.arrival_us })
        };
        let stamps: Vec<Stamped> = frames.iter().filter_map(stamped).collect();
        let stamps = Stamps::new(stamps, &self.shots, false);
        (!stamps.has_rival(&common, alike, &blind)).then_some(single)
    }

    /// For each frame that has any, the exposures that it may be of in the zone that most frames agree on. `None` while telemetry may yet show
    /// more, and where a frame would have been taken when telemetry saw nothing: that shows another clock.
    fn of_one_zone(&self, frames: &[&Pending], blind: &dyn Fn(i64, i64) -> bool) -> Option<Vec<Vec<Suggestion>>> {
        let suggested: Option<Vec<Vec<Suggestion>>> =
            frames.iter().map(|pending| pending.prompt.as_ref().map(|_| self.kept_exposures(pending))).collect();
        let mut members = suggested?;
        let zone = |s: &Suggestion| s.offset.and_then(zone_of);
        let mut zones: BTreeMap<i64, usize> = BTreeMap::new();
        for zone_us in members.iter().flat_map(|near| near.iter().filter_map(zone).collect::<BTreeSet<i64>>()) {
            *zones.entry(zone_us).or_default() += 1;
        }
        let (zone_us, _) = zones.into_iter().max_by_key(|(_, frames)| *frames)?;
        members.iter_mut().for_each(|near| near.retain(|s| zone(s) == Some(zone_us)));
        let seen_without = |(pending, near): (&&Pending, &Vec<Suggestion>)| {
            let said = &pending.evidence;
            let from_us = said.console_us.unwrap_or_default().saturating_add(zone_us).saturating_sub(KEPT_US);
            let to_us = from_us.saturating_add(self.resolution_us(said)).saturating_add(2 * KEPT_US);
            near.is_empty() && !blind(from_us, to_us.min(said.arrival_us.unwrap_or(i64::MAX)))
        };
        if frames.iter().zip(&members).any(seen_without) {
            return None;
        }
        members.retain(|near| !near.is_empty());
        Some(members)
    }

    /// Whether the frame is bound to another exposure, or the exposure to another frame.
    fn contradicted(&self, member: &Suggestion) -> bool {
        let shot = self.shots.get(member.shot);
        let own = self.frames.get(&member.frame).and_then(|pending| pending.binding.exposure.as_ref());
        own.is_some_and(|exposure| exposure.index != shot.index) || shot.frame.is_some_and(|frame| frame != member.frame)
    }

    /// From the exposure to its nearest neighbour.
    fn step_us(&self, member: &Suggestion) -> i64 {
        let beside = [member.shot.checked_sub(1), Some(member.shot + 1).filter(|next| *next < self.shots.len())];
        let apart_us = |at: usize| self.shots.get(at).end_us.saturating_sub(member.at_us).saturating_abs();
        beside.into_iter().flatten().map(apart_us).min().unwrap_or(i64::MAX)
    }

    /// Exposures that a frame would be of if its console kept the host's time.
    fn kept_exposures(&self, pending: &Pending) -> Vec<Suggestion> {
        let said = &pending.evidence;
        let suggested = |shot: usize| {
            let at = self.shots.get(shot);
            let offset = self.pair(said, shot).filter(|_| at.whole).map(|pair| pair.any)?;
            let causal = said.arrival_us.is_none_or(|arrival_us| at.over_us <= arrival_us);
            let shift = said.counter.zip(self.shots.number(shot)).map(|(counter, number)| i64::from(counter) - number);
            (causal && zone_of(offset).is_some()).then_some(Suggestion {
                frame: said.frame,
                shot,
                latest: None,
                at_us: at.end_us,
                offset: Some(offset),
                shift,
            })
        };
        (0..self.shots.len()).filter_map(suggested).collect()
    }
}

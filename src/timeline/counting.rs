//! What the console's counter is worth: its shift against the exposures' numbers, learnt from frames bound by time.
//!
//! A counter that counts exposures keeps its shift from one known frame to the next; one that is constant, or counts something else,
//! has another shift at every frame.

use std::collections::{BTreeMap, BTreeSet};

use super::shots::Shots;

/// How well a shift is known at an exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Firmness {
    /// Nothing is known yet, but frame and C-arm carry the same number.
    Equal,
    /// The known frames on either side have different shifts, and this is one of them.
    Border,
    /// The nearest known frame on one side has it and no other, there is none on the other side: one frame is not yet a count.
    Once,
    /// The nearest known frames on one side have it, there is none on the other.
    OneSide,
    /// The known frames before and after have it.
    Enclosed,
}

/// Shifts at exposures whose frames are known.
#[derive(Clone, Debug, Default)]
pub(super) struct Counting {
    shifts: BTreeMap<usize, i64>,
    /// The same of frames that came promptly after one exposure and are bound to none, with their numbers of arrival.
    doubts: BTreeMap<usize, (u32, i64)>,
    /// How often the counter's values were seen, in frames of different content.
    seen: BTreeMap<u32, u32>,
}

impl Counting {
    /// Notes a value that a frame carries.
    pub(super) fn see(&mut self, counter: u32) {
        *self.seen.entry(counter).or_insert(0) += 1;
    }

    /// Frames with a counter.
    pub(super) fn frames(&self) -> u32 {
        self.seen.values().sum()
    }

    pub(super) fn times_seen(&self, counter: u32) -> u32 {
        self.seen.get(&counter).copied().unwrap_or(0)
    }

    /// Whether it has had two values at least.
    pub(super) fn moves(&self) -> bool {
        self.seen.len() > 1
    }

    /// A frame with `counter` is known, by other means, to be of the exposure at `shot`.
    pub(super) fn learn(&mut self, shots: &Shots, shot: usize, counter: u32) {
        if let Some(number) = shots.number(shot) {
            self.shifts.insert(shot, i64::from(counter) - number);
        }
    }

    /// A frame with `counter` came promptly after the exposure at `shot` and no other.
    pub(super) fn doubt(&mut self, shots: &Shots, shot: usize, frame: u32, counter: u32) {
        if let Some(number) = shots.number(shot) {
            self.doubts.insert(shot, (frame, i64::from(counter) - number));
        }
    }

    /// Whether a frame that is bound to none speaks for another shift at an exposure between two known frames: one picture too few and
    /// one too many leave the same shift on either side.
    fn doubted(&self, shots: &Shots, from: usize, to: usize, shift: i64) -> bool {
        self.doubts.range(from..=to).any(|(at, (_, other))| *other != shift && shots.get(*at).frame.is_none())
    }

    /// The frame is bound, to whichever exposure.
    pub(super) fn settled(&mut self, frame: u32) {
        self.doubts.retain(|_, (other, _)| *other != frame);
    }

    /// Neighbouring known frames with the same shift, and with different ones.
    fn agreements(&self) -> (usize, usize) {
        let shifts: Vec<i64> = self.shifts.values().copied().collect();
        let same = shifts.windows(2).filter(|pair| pair[0] == pair[1]).count();
        (same, shifts.len().saturating_sub(1) - same)
    }

    /// Why the counter is not used, if it is not.
    pub(super) fn useless(&self) -> Option<String> {
        if let Some((value, times)) = self.seen.iter().max_by_key(|(_, times)| **times)
            && *times >= 3
            && 2 * u64::from(*times) > self.seen.values().map(|times| u64::from(*times)).sum::<u64>()
        {
            return Some(format!("the console's counter does not move ({value} in {times} frames) and is not used"));
        }
        let (same, different) = self.agreements();
        (different >= 3 && different > same)
            .then(|| format!("the console's counter does not count exposures ({different} contradictions) and is not used"))
    }

    /// The shifts of the known frames, without repetition.
    pub(super) fn shifts(&self) -> impl Iterator<Item = i64> {
        self.shifts.values().copied().collect::<BTreeSet<i64>>().into_iter()
    }

    /// Whether any known frame has this shift.
    pub(super) fn knows(&self, shift: i64) -> bool {
        self.shifts.values().any(|known| *known == shift)
    }

    /// Whether a frame of a later exposure than `shot` is known.
    pub(super) fn passed(&self, shot: usize) -> bool {
        self.shifts.range(shot + 1..).next().is_some()
    }

    /// Whether the two known frames nearest to `at`, on a side that has any, both have the shift. A counter that began anew at the last
    /// known frame may do so again at the next, and then names a neighbour.
    fn twice(&self, at: usize, shift: i64) -> bool {
        let (mut before, mut after) = (self.shifts.range(..=at).rev(), self.shifts.range(at..));
        let two =
            |side: &mut dyn Iterator<Item = (&usize, &i64)>| side.take(2).filter(|(_, known)| **known == shift).count() == 2;
        two(&mut before) || two(&mut after)
    }

    /// Whether the counter counts exposures, nothing else, as far as is known: its shift stays wherever neither it nor the C-arm's begins
    /// anew, and nothing was missed (`blind`, between two positions, where the C-arm does not count).
    pub(super) fn counts_exposures(&self, shots: &Shots, blind: &dyn Fn(usize, usize) -> bool) -> bool {
        let known: Vec<(usize, i64, i64)> =
            self.shifts.iter().filter_map(|(shot, shift)| Some((*shot, shots.number(*shot)?, *shift))).collect();
        let kept = |pair: &[(usize, i64, i64)]| {
            let ((one, number, shift), (other, next_number, next_shift)) = (pair[0], pair[1]);
            let anew = next_number + next_shift <= number + shift || next_number <= number;
            shift == next_shift || anew || !shots.counted && blind(one, other)
        };
        self.agreements().0 >= 2 && known.windows(2).all(kept)
    }

    /// Whether a frame with `counter`, which names the exposure at `at`, may be of `other` instead: of a later one, if exposures without a
    /// picture are not counted; of an earlier one, if a picture between them was counted that is there, or if nothing is known of the
    /// counter before it.
    pub(super) fn may_be(&self, shots: &Shots, counter: u32, at: usize, other: usize) -> bool {
        let (Some(named), Some(number)) = (shots.number(at), shots.number(other)) else { return true };
        let own = u32::try_from(i64::from(counter) - named + number);
        let shift = i64::from(counter) - named;
        let known_before = self.shifts.range(..=other).next_back().is_some_and(|(_, known)| *known == shift);
        other > at || !known_before || own.is_ok_and(|own| self.times_seen(own) > 0)
    }

    /// Whether a counter that began anew after the last known frame may have come to `counter` by now.
    pub(super) fn may_have_begun_anew(&self, shots: &Shots, counter: u32) -> bool {
        let since = self.shifts.keys().next_back().map_or(shots.len(), |last| shots.len().saturating_sub(last + 1));
        usize::try_from(counter).is_ok_and(|counter| counter <= since)
    }

    /// Whether nothing but this shift is known, from one frame at least.
    pub(super) fn only(&self, shift: i64) -> bool {
        !self.shifts.is_empty() && self.shifts.values().all(|known| *known == shift)
    }

    /// Whether the counter has never begun anew, as far as is known: its shift stays, or changes by an exposure or two where telemetry
    /// missed or tore some and the C-arm does not count them.
    pub(super) fn steady(&self, shots: &Shots) -> bool {
        let most = if shots.counted { 0 } else { 3 };
        let shifts: Vec<i64> = self.shifts.values().copied().collect();
        let (same, different) = self.agreements();
        same >= 3 && same > 3 * different && shifts.windows(2).all(|pair| (pair[1] - pair[0]).abs() <= most)
    }

    /// Positions of exposures that a frame with `counter` may be of, and how firmly.
    /// Where the C-arm does not count, an exposure that fell into a gap of telemetry (`blind`, between two positions) shifts all
    /// numbers after it.
    pub(super) fn candidates(&self, shots: &Shots, counter: u32, blind: &dyn Fn(usize, usize) -> bool) -> Vec<(usize, Firmness)> {
        let mut shifts: BTreeSet<i64> = self.shifts.values().copied().collect();
        if shots.counted {
            shifts.insert(0);
        }
        let mut found = Vec::new();
        for shift in shifts {
            for at in shots.numbered(i64::from(counter) - shift) {
                if shots.number(*at) != Some(i64::from(counter) - shift) {
                    continue;
                }
                let known = |(shot, shift): (&usize, &i64)| {
                    (shots.counted || !blind((*shot).min(*at), (*shot).max(*at))).then_some(*shift)
                };
                let (before, after) = (self.shifts.range(..=*at).next_back(), self.shifts.range(*at..).next());
                let sides = [before, after];
                let doubted = before.zip(after).is_some_and(|(one, other)| self.doubted(shots, *one.0, *other.0, shift));
                let torn = doubted || sides.into_iter().flatten().any(|side| known(side).is_none());
                let (before, after) = (before.and_then(known), after.and_then(known));
                let firmness = match (before == Some(shift), after == Some(shift), before.is_none(), after.is_none()) {
                    (true, ..) | (_, true, ..) if torn => Firmness::Border,
                    (true, true, ..) => Firmness::Enclosed,
                    (true, _, _, true) | (_, true, true, _) if self.twice(*at, shift) => Firmness::OneSide,
                    (true, _, _, true) | (_, true, true, _) => Firmness::Once,
                    (true, ..) | (_, true, ..) => Firmness::Border,
                    (_, _, true, true) if shots.counted && shift == 0 => Firmness::Equal,
                    _ => continue,
                };
                found.push((*at, firmness));
            }
        }
        found
    }
}

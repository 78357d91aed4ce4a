//! What prompt frames agree on before anything is known: one offset of the console's clock, or one shift of its counter.
//!
//! A frame that arrives seconds after an exposure suggests that it is of it, which a late frame that happens to come then does as well.
//! Frames that suggest the truth agree with each other; the others suggest offsets at random.

use std::collections::{BTreeMap, BTreeSet};

use super::console::Bounds;

/// Exposures closer than this count as one occasion: a batch of late frames that meets one burst is one accident.
pub(super) const OCCASION_US: i64 = 10_000_000;
/// More frames than this after one exposure are a batch and suggest nothing; counted ones only if they are more than the exposures before
/// them, as a quick run's are not.
const CROWD: usize = 2;

/// A reading is another one if it gives one in so many frames another exposure.
const ANOTHER_READING: usize = 4;

/// That a frame is of an exposure, and what would follow from it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Suggestion {
    pub frame: u32,
    /// Position of the exposure.
    pub shot: usize,
    /// That of the last one that ended before the frame came.
    pub latest: Option<usize>,
    pub at_us: i64,
    /// For the offset of the console's clock.
    pub offset: Option<Bounds>,
    /// The console's counter minus the exposure's number.
    pub shift: Option<i64>,
}

/// What is being agreed on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Topic {
    Offset,
    Shift,
    /// Both at once: exposures seconds apart, as the demo's, are told apart by no shift and by hardly an offset alone.
    Both,
}

/// Frames that must agree on both, and by how many they must outweigh another reading.
const BOTH_FRAMES: usize = 4;
const BOTH_NEEDED: usize = 2;

impl Topic {
    /// Whether `other` holds as well if `one` is true (for the offset: at the lower end of `one`).
    fn agree(self, one: &Suggestion, other: &Suggestion) -> bool {
        match self {
            Self::Shift => one.shift.is_some() && one.shift == other.shift,
            Self::Offset => match (one.offset, other.offset) {
                (Some(one), Some(other)) => Bounds { high_us: one.low_us, ..one }.meets(&other),
                _ => false,
            },
            Self::Both => Self::Shift.agree(one, other) && Self::Offset.agree(one, other),
        }
    }

    fn speaks(self, suggestion: &Suggestion) -> bool {
        match self {
            Self::Shift => suggestion.shift.is_some(),
            Self::Offset => suggestion.offset.is_some(),
            Self::Both => Self::Shift.speaks(suggestion) && Self::Offset.speaks(suggestion),
        }
    }
}

struct Party<'a> {
    members: Vec<&'a Suggestion>,
    frames: BTreeSet<u32>,
    occasions: usize,
}

fn party<'a>(topic: Topic, founder: &Suggestion, all: &[&'a Suggestion]) -> Party<'a> {
    let members: Vec<&Suggestion> = all.iter().copied().filter(|other| topic.agree(founder, other)).collect();
    let frames: BTreeSet<u32> = members.iter().map(|member| member.frame).collect();
    let mut times: Vec<i64> = members.iter().map(|member| member.at_us).collect();
    times.sort_unstable();
    let mut occasions = 0;
    let mut last_us = None;
    for at_us in times {
        if last_us.is_none_or(|last_us: i64| at_us.saturating_sub(last_us) >= OCCASION_US) {
            occasions += 1;
            last_us = Some(at_us);
        }
    }
    Party { members, frames, occasions }
}

/// The suggestions that belong together and outweigh all others; none while two readings are possible.
pub(super) fn agreement(topic: Topic, suggestions: &[Suggestion]) -> Option<Vec<Suggestion>> {
    let mut came_after: BTreeMap<Option<usize>, (BTreeSet<u32>, BTreeSet<usize>)> = BTreeMap::new();
    for suggestion in suggestions {
        let (frames, shots) = came_after.entry(suggestion.latest).or_default();
        frames.insert(suggestion.frame);
        shots.insert(suggestion.shot);
    }
    let crowded = |s: &Suggestion| {
        came_after.get(&s.latest).is_some_and(|(frames, shots)| {
            let room = if topic == Topic::Shift { shots.len() } else { 0 };
            frames.len() > CROWD.max(room)
        })
    };
    let spoken: Vec<&Suggestion> = suggestions.iter().filter(|s| topic.speaks(s) && !crowded(s)).collect();
    let voters: BTreeSet<u32> = spoken.iter().map(|s| s.frame).collect();
    let parties: Vec<Party> = spoken.iter().map(|founder| party(topic, founder, &spoken)).collect();
    let best = parties.iter().max_by_key(|party| (party.occasions, party.frames.len()))?;
    let united = best.frames == voters;
    let enough = match topic {
        Topic::Both => best.occasions >= 2 && united && best.frames.len() >= BOTH_FRAMES,
        Topic::Offset | Topic::Shift => best.occasions >= 3 || best.occasions == 2 && united,
    };
    if !enough {
        return None;
    }
    let needed = if topic == Topic::Both { BOTH_NEEDED } else { best.occasions.min(3) };
    for other in &parties {
        // The same reading, founded by another member: all but a few of the frames that both have may have the same exposure in both.
        let of = |party: &Party, frame: u32| {
            party.members.iter().filter(|m| m.frame == frame).map(|m| m.shot).collect::<BTreeSet<_>>()
        };
        let common: Vec<u32> = best.frames.intersection(&other.frames).copied().collect();
        let elsewhere = common.iter().filter(|frame| of(other, **frame).is_disjoint(&of(best, **frame))).count();
        if !common.is_empty() && ANOTHER_READING * elsewhere < common.len() {
            continue;
        }
        let (for_best, for_other) =
            (best.frames.difference(&other.frames).count(), other.frames.difference(&best.frames).count());
        if for_best < for_other + needed {
            return None;
        }
    }
    Some(best.members.iter().map(|member| **member).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn suggestion(frame: u32, shot: usize, at_s: i64, shift: i64) -> Suggestion {
        Suggestion { frame, shot, latest: Some(frame as usize), at_us: at_s * 1_000_000, offset: None, shift: Some(shift) }
    }

    #[test]
    fn three_occasions_agree_and_an_alias_keeps_the_question_open() {
        let even: Vec<Suggestion> = (0..3).map(|i| suggestion(i, i as usize, 20 * i64::from(i), 7)).collect();
        assert_eq!(agreement(Topic::Shift, &even).map(|members| members.len()), Some(3));
        // Each of the frames may as well be of the exposure before.
        let mut alias = even.clone();
        alias.extend((0..3).map(|i| suggestion(i, i as usize + 10, 20 * i64::from(i) - 5, 8)));
        assert!(agreement(Topic::Shift, &alias).is_none());
        // One occasion is not enough, however many frames it has; nor are two if a third frame disagrees.
        let one: Vec<Suggestion> = (0..3).map(|i| suggestion(i, i as usize, i64::from(i), 7)).collect();
        assert!(agreement(Topic::Shift, &one).is_none());
        assert!(agreement(Topic::Shift, &[even[0], even[1]]).is_some());
        assert!(agreement(Topic::Shift, &[even[0], even[1], suggestion(5, 5, 90, -4)]).is_none());
    }
}

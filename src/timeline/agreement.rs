//! What prompt frames agree on before anything is known: one offset of the console's clock, or one shift of its counter.
//!
//! A frame that arrives seconds after an exposure suggests that it is of it, which a late frame that happens to come then does as well.
//! Frames that suggest the truth agree with each other; the others suggest offsets at random.

use std::collections::BTreeSet;

use super::console::Bounds;

/// Exposures closer than this count as one occasion: a batch of late frames that meets one burst is one accident.
const OCCASION_US: i64 = 10_000_000;
/// More frames than this after one exposure are a batch and suggest nothing.
const CROWD: usize = 2;

/// That a frame is of an exposure, and what would follow from it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Suggestion {
    pub frame: u32,
    /// Position of the exposure.
    pub shot: usize,
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
}

impl Topic {
    /// Whether `other` holds as well if `one` is true (for the offset: at the lower end of `one`).
    fn agree(self, one: &Suggestion, other: &Suggestion) -> bool {
        match self {
            Self::Shift => one.shift.is_some() && one.shift == other.shift,
            Self::Offset => match (one.offset, other.offset) {
                (Some(one), Some(other)) => Bounds { high_us: one.low_us, ..one }.meets(&other),
                _ => false,
            },
        }
    }

    fn speaks(self, suggestion: &Suggestion) -> bool {
        match self {
            Self::Shift => suggestion.shift.is_some(),
            Self::Offset => suggestion.offset.is_some(),
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
    let crowd = |shot: usize| {
        suggestions.iter().filter(|other| other.shot == shot).map(|other| other.frame).collect::<BTreeSet<_>>().len() > CROWD
    };
    let crowded: BTreeSet<usize> = suggestions.iter().map(|s| s.shot).filter(|shot| crowd(*shot)).collect();
    let spoken: Vec<&Suggestion> = suggestions.iter().filter(|s| topic.speaks(s) && !crowded.contains(&s.shot)).collect();
    let voters: BTreeSet<u32> = spoken.iter().map(|s| s.frame).collect();
    let parties: Vec<Party> = spoken.iter().map(|founder| party(topic, founder, &spoken)).collect();
    let best = parties.iter().max_by_key(|party| (party.occasions, party.frames.len()))?;
    let united = best.frames == voters;
    if !(best.occasions >= 3 || best.occasions == 2 && united) {
        return None;
    }
    let needed = best.occasions.min(3);
    for other in &parties {
        // The same reading, founded by another member.
        let shared = other.members.iter().filter(|m| best.members.iter().any(|b| b.frame == m.frame && b.shot == m.shot)).count();
        if 2 * shared > other.members.len() {
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
        Suggestion { frame, shot, at_us: at_s * 1_000_000, offset: None, shift: Some(shift) }
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

//! Frames that count on where the C-arm's own counter stands still: what the arm sends is frozen, though packets, clock and sequence go on.

use super::Engine;
use crate::telemetry::DeviceKind;
use crate::timeline::BindingFlag;

/// Frames of an equal count that prove that the console writes the arm's own.
const FEW: usize = 2;
/// Frames beyond it that are more than references which somebody has stored.
const LEAST_ON: usize = 3;
/// From one frame to the next, at most so many exposures are passed over: pictures that were not exported.
const MOST_MISSING: u32 = 3;

/// What is known of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct CountedOn {
    /// Where the arm's counter stands.
    pub stood_at: u32,
    /// The frames with what they count, in order of arrival.
    pub frames: Vec<(u32, u32)>,
}

/// A frame with this flag is no exposure of its own: a copy, or a picture that was taken back.
pub(super) fn is_no_exposure(flag: &BindingFlag) -> bool {
    matches!(flag, BindingFlag::Duplicate { .. } | BindingFlag::Unfinished { .. })
}

/// Of what unbound frames count, in order of arrival, those that go on from `stood_at` one by one, but for some that are missing.
fn going_on(stood_at: u32, counts: impl Iterator<Item = (u32, u32)>) -> Vec<(u32, u32)> {
    let mut latest = stood_at;
    let mut frames = Vec::new();
    for (number, counter) in counts {
        if counter.checked_sub(latest).is_some_and(|by| (1..=MOST_MISSING).contains(&by)) {
            latest = counter;
            frames.push((number, counter));
        }
    }
    frames
}

impl Engine {
    /// The frames that count on, where they are more than chance. The console must have written the arm's own counter so far: one that counts
    /// pictures is soon ahead of it.
    pub(super) fn counted_on(&self) -> Option<CountedOn> {
        let stood_at = self.timeline.carm().newest()?.value.exposure_counter?;
        let told_until_us = self.timeline.told_until_us(DeviceKind::Carm)?;
        let latest_us = self.timeline.exposures().last().filter(|latest| latest.counter == Some(stood_at))?.end_us;
        let same = |number: &u32| {
            let of_arm = self.binder.binding(*number)?.exposure.as_ref()?.counter?;
            Some(self.counts.get(number)?.0 == of_arm)
        };
        let same: Vec<bool> = self.tied.iter().filter_map(same).collect();
        if same.len() < FEW || same.contains(&false) {
            return None;
        }
        let end_us = self.ended_us.unwrap_or(self.now_us);
        let is_open = |number: &u32| {
            let may_be = self.binder.binding(*number).is_none_or(|binding| {
                binding.flags.iter().all(|flag| !is_no_exposure(flag) && !matches!(flag, BindingFlag::SecondPicture { .. }))
            });
            may_be && self.studies.of(*number).is_none() && !self.hearing.came_unheard(*number, DeviceKind::Carm, end_us)
        };
        let count = |number: u32| {
            let (counter, host_us) = *self.counts.get(&number)?;
            // What came before telemetry had passed it, or before the latest exposure was over, proves nothing.
            (latest_us..=told_until_us).contains(&host_us).then_some((number, counter))
        };
        let frames = going_on(stood_at, self.unbound.keys().copied().filter(is_open).filter_map(count));
        (frames.len() >= LEAST_ON).then_some(CountedOn { stood_at, frames })
    }

    /// That frames count on, in words.
    #[must_use]
    pub fn frames_that_count_on(&self) -> Option<String> {
        let CountedOn { stood_at, frames } = self.counted_on()?;
        Some(format!(
            "{} frames count on where the C-arm's counter has stood still at {stood_at}, though its packets came: is its telemetry frozen, or \
             does the console count pictures that it only stores? If the joints that are shown stand still while the arm moves, restart what sends \
             them. Their pairs have no joints, robot or beam of telemetry",
            frames.len()
        ))
    }

    /// The same of each of them, by its number.
    pub(in crate::session) fn words_of_those_that_count_on(&self) -> Vec<(u32, String)> {
        let Some(CountedOn { stood_at, frames }) = self.counted_on() else { return Vec::new() };
        let words = |counter: u32| {
            format!(
                "the frame counts {counter}, and the C-arm's counter stood still at {stood_at} when it came: is the C-arm's telemetry frozen?"
            )
        };
        frames.into_iter().map(|(number, counter)| (number, words(counter))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_go_on_from_where_the_counter_stands_one_by_one() {
        let of = |counts: &[u32]| {
            let counts = (1..).zip(counts.iter().copied());
            going_on(2, counts).into_iter().map(|(_, counter)| counter).collect::<Vec<u32>>()
        };
        assert_eq!(of(&[3, 4, 5]), [3, 4, 5]);
        assert_eq!(of(&[3, 5, 8]), [3, 5, 8], "some were not exported");
        assert!(of(&[57, 58, 59]).is_empty(), "another day's");
        assert_eq!(of(&[1, 2, 3, 3, 2, 4]), [3, 4], "exported again");
        assert_eq!(of(&[u32::MAX, 3]), [3]);
    }
}

//! A frame that is bound when it comes, although console and counter are hardly known yet: where every exposure has had its frame, in
//! order, and counter, stamp and arrival name the one that just ended.
//!
//! Such a frame cannot be of an earlier exposure: each has a frame with another count, or does not fit its stamp. It cannot be of one that
//! telemetry missed: there was no silence. A picture of something else would have to carry the very next number, at the right moment.

use super::counting::Firmness;
use super::judgement::Weighed;

/// Exposures before this one that must have their frames.
const EARLIER: usize = 12;

impl Weighed<'_> {
    /// Whether the exposure at `at`, which the counter names, is the only one that the frame can have.
    pub(super) fn orderly(&self, at: usize, firmness: Firmness, prompt: &[usize]) -> bool {
        let (said, shots) = (&self.pending.evidence, &self.known.shots);
        let (Some(arrival_us), Some(counter), Some(number)) = (said.arrival_us, said.counter, shots.number(at)) else {
            return false;
        };
        let shift = i64::from(counter) - number;
        let known = match firmness {
            Firmness::Equal => true,
            Firmness::Once | Firmness::OneSide => self.known.counting.only(shift),
            Firmness::Border | Firmness::Enclosed => false,
        };
        if !known || self.known.others_say_more(said) {
            return false;
        }
        let waits = |other: usize| shots.get(other).frame.is_none() && self.stamp_allows(other);
        let rival = prompt.iter().any(|other| *other != at && waits(*other));
        // One that still waits may be this frame's, unless the stamp excludes it.
        let lacking = (at.saturating_sub(EARLIER)..at).any(waits);
        let from_us = at.checked_sub(1).map_or(shots.get(at).start_us, |before| shots.get(before).start_us);
        let blind = self.timeline.exposure_tracker().blind_spot(from_us, arrival_us).is_some();
        prompt.contains(&at) && !rival && !lacking && !blind && self.stamp_allows(at) && !self.came_with_another(arrival_us)
    }

    /// Whether the stamp may be of the exposure, as far as the console's clock is known: from one frame as well.
    fn stamp_allows(&self, at: usize) -> bool {
        let pair = self.known.pair(&self.pending.evidence, at);
        pair.is_none_or(|pair| self.known.offsets.last().is_none_or(|offset| offset.allows(&pair)))
    }
}

//! The console's clock: host minus console time, bounded from frames whose exposure is known by other means.
//!
//! A stamp s of resolution r names an instant of its exposure, so the offset o = host − console lies in
//! (start − s − r, end − s]. Clocks drift by at most [`MOST_DRIFT`], so a bound at time t' holds at t, widened by drift · |t − t'|.
//! The offset at t is the intersection of all widened bounds: it holds for every drift within the limit, steady or not.

use serde::Serialize;

/// Fastest drift of console against host that is believed.
const MOST_DRIFT: f64 = 250e-6;
/// What a stamp may lie outside its exposure without a constant part, which the offset absorbs.
const SCATTER_US: i64 = 100_000;
/// Bounds are merged over this time.
const BUCKET_US: i64 = 20_000_000;
/// Buckets on either side of a time that are asked; farther ones are wider by 200 ms and more.
const REACH: usize = 60;

/// Offsets that a pair of stamp and exposure allows, at the exposure's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Bounds {
    pub at_us: i64,
    pub low_us: i64,
    pub high_us: i64,
}

impl Bounds {
    /// From a stamp and the interval that it names an instant of.
    pub(super) fn of(console_us: i64, resolution_us: i64, start_us: i64, end_us: i64) -> Self {
        let at_us = start_us.saturating_add(end_us.saturating_sub(start_us) / 2);
        let low_us = start_us.saturating_sub(console_us).saturating_sub(resolution_us).saturating_sub(SCATTER_US);
        let high_us = end_us.saturating_sub(console_us).saturating_add(SCATTER_US);
        Self { at_us, low_us, high_us }
    }

    /// The same offset at another time.
    pub(super) fn at(&self, at_us: i64) -> Self {
        let widened_us = (at_us.saturating_sub(self.at_us).saturating_abs() as f64 * MOST_DRIFT) as i64;
        Self { at_us, low_us: self.low_us.saturating_sub(widened_us), high_us: self.high_us.saturating_add(widened_us) }
    }

    /// What both allow, at this one's time; empty (low above high) where they contradict.
    fn and(&self, other: &Self) -> Self {
        let other = other.at(self.at_us);
        Self { at_us: self.at_us, low_us: self.low_us.max(other.low_us), high_us: self.high_us.min(other.high_us) }
    }

    /// Whether it allows this offset.
    pub(super) fn holds(&self, offset_us: i64) -> bool {
        (self.low_us..=self.high_us).contains(&offset_us)
    }

    pub(super) fn meets(&self, other: &Self) -> bool {
        let both = self.and(other);
        both.low_us <= both.high_us
    }
}

/// The console's offset as a stretch of the session bounds it.
#[derive(Clone, Debug, Default)]
pub(super) struct ConsoleOffset {
    /// By time, one a bucket.
    buckets: Vec<Bounds>,
    frames: u32,
}

/// The estimated clock of the console, for people and logs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct ConsoleClock {
    /// Host minus console time at the latest frame, time zone and error in one.
    pub offset_us: i64,
    /// Either way.
    pub uncertainty_us: i64,
    /// Frames it rests on.
    pub frames: u32,
}

impl ConsoleOffset {
    /// Offsets possible at `at_us`; `None` while nothing is known.
    pub(super) fn bounds(&self, at_us: i64) -> Option<Bounds> {
        let middle = self.buckets.partition_point(|bounds| bounds.at_us < at_us);
        let near = &self.buckets[middle.saturating_sub(REACH)..(middle + REACH).min(self.buckets.len())];
        let any = Bounds { at_us, low_us: i64::MIN, high_us: i64::MAX };
        (!near.is_empty()).then(|| near.iter().fold(any, |all, bounds| all.and(bounds)))
    }

    /// Whether a stamp and an exposure can belong together.
    pub(super) fn allows(&self, pair: &Bounds) -> bool {
        self.bounds(pair.at_us).is_some_and(|bounds| bounds.meets(pair))
    }

    /// Takes a pair that is known to belong together; refuses it (false) where it contradicts what is known.
    pub(super) fn learn(&mut self, pair: &Bounds) -> bool {
        if !self.buckets.is_empty() && !self.allows(pair) {
            return false;
        }
        self.frames += 1;
        let at = self.buckets.partition_point(|bounds| bounds.at_us < pair.at_us);
        let near = [at.checked_sub(1), Some(at)].into_iter().flatten().find(|i| {
            self.buckets.get(*i).is_some_and(|bounds| bounds.at_us.saturating_sub(pair.at_us).saturating_abs() < BUCKET_US)
        });
        match near {
            Some(i) => {
                let merged = self.buckets[i].and(pair);
                if merged.low_us <= merged.high_us {
                    self.buckets[i] = merged;
                }
            }
            None => self.buckets.insert(at, *pair),
        }
        true
    }

    /// First and last time it was confirmed.
    pub(super) fn span_us(&self) -> Option<(i64, i64)> {
        Some((self.buckets.first()?.at_us, self.buckets.last()?.at_us))
    }

    pub(super) fn summary(&self) -> Option<ConsoleClock> {
        let bounds = self.bounds(self.buckets.last()?.at_us)?;
        let half_us = bounds.high_us.saturating_sub(bounds.low_us) / 2;
        Some(ConsoleClock {
            offset_us: bounds.low_us.saturating_add(half_us),
            uncertainty_us: half_us.saturating_abs(),
            frames: self.frames,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_offset_is_bounded_by_every_frame_and_a_contradiction_is_refused() {
        let mut offset = ConsoleOffset::default();
        assert!(offset.bounds(0).is_none());
        // A console 100 s behind, stamps of whole seconds, exposures of 0.2 s at odd phases.
        for i in 0..40i64 {
            let start_us = 1_000_000_000 + i * 7_310_000;
            let console_us = (start_us - 100_000_000).div_euclid(1_000_000) * 1_000_000;
            assert!(offset.learn(&Bounds::of(console_us, 1_000_000, start_us, start_us + 200_000)));
        }
        let clock = offset.summary().expect("known");
        assert!((clock.offset_us - 100_000_000).abs() <= clock.uncertainty_us && clock.uncertainty_us < 300_000, "{clock:?}");
        assert!(!offset.learn(&Bounds::of(900_000_000, 1_000_000, 1_003_000_000, 1_003_200_000)), "three seconds off");
        // An hour later a drift of 200 ppm is within the bounds, one of a second beyond it is not.
        let later_us = 1_000_000_000 + 3_600_000_000;
        let pair = |off_us: i64| Bounds::of(later_us - 100_000_000 + off_us, 1, later_us, later_us + 200_000);
        assert!(offset.allows(&pair(720_000)) && !offset.allows(&pair(2_500_000)));
    }
}

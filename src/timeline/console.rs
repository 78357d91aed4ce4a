//! The console's clock: host minus console time, bounded from frames whose exposure is known by other means.
//!
//! A stamp s of resolution r names an instant of its exposure, so the offset o = host − console lies in
//! (start − s − r, end − s]. Clocks drift by at most [`MOST_DRIFT`], so a bound at time t' holds at t, widened by drift · |t − t'|.
//! The offset at t is the intersection of all widened bounds: it holds for every drift within the limit, steady or not.
//!
//! Consoles stamp the beginning of an exposure or its end, always the same. Either reading is followed beside the general one until frames
//! contradict it; the readings that many frames have left alive tell exposures apart that follow each other within a second.

use std::collections::BTreeSet;

use serde::Serialize;

use super::zone::{zone_beside, zone_label};

/// Fastest drift of console against host that is believed.
const MOST_DRIFT: f64 = 250e-6;
/// What a stamp may lie outside its exposure without a constant part, which the offset absorbs.
pub(super) const SCATTER_US: i64 = 100_000;
/// The same for the beginning or the end of the exposure: a console that scatters more is read as naming any instant.
const END_SCATTER_US: i64 = 50_000;
/// Bounds are merged over this time.
const BUCKET_US: i64 = 20_000_000;
/// Frames that a reading of the stamp must have survived before it is relied on.
const READ_FRAMES: u32 = 12;
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
    pub(super) fn and(&self, other: &Self) -> Self {
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

/// What a stamp says of the console's offset if it is of an exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Pair {
    /// If it names any instant of the exposure.
    pub any: Bounds,
    /// If it names its beginning, or its end.
    ends: [Bounds; 2],
}

impl Pair {
    /// From a stamp and an exposure whose beginning and end lie between two times each, µs.
    pub(super) fn of(console_us: i64, resolution_us: i64, begin_us: [i64; 2], end_us: [i64; 2]) -> Self {
        let any = Bounds::of(console_us, resolution_us, begin_us[0], end_us[1]);
        let ends = [begin_us, end_us].map(|[from_us, to_us]| Bounds {
            at_us: any.at_us,
            low_us: from_us.saturating_sub(console_us).saturating_sub(resolution_us).saturating_sub(END_SCATTER_US),
            high_us: to_us.saturating_sub(console_us).saturating_add(END_SCATTER_US),
        });
        Self { any, ends }
    }
}

/// Bounds of one offset from many frames.
#[derive(Clone, Debug, Default)]
struct Chain {
    /// By time, one a bucket.
    buckets: Vec<Bounds>,
}

impl Chain {
    /// Offsets possible at `at_us`; `None` while nothing is known.
    fn bounds(&self, at_us: i64) -> Option<Bounds> {
        let middle = self.buckets.partition_point(|bounds| bounds.at_us < at_us);
        let near = &self.buckets[middle.saturating_sub(REACH)..(middle + REACH).min(self.buckets.len())];
        let any = Bounds { at_us, low_us: i64::MIN, high_us: i64::MAX };
        (!near.is_empty()).then(|| near.iter().fold(any, |all, bounds| all.and(bounds)))
    }

    fn allows(&self, bounds: &Bounds) -> bool {
        self.bounds(bounds.at_us).is_some_and(|own| own.meets(bounds))
    }

    /// Takes bounds that hold; refuses them (false) where they contradict what is known.
    fn learn(&mut self, bounds: &Bounds) -> bool {
        if !self.buckets.is_empty() && !self.allows(bounds) {
            return false;
        }
        let at = self.buckets.partition_point(|own| own.at_us < bounds.at_us);
        let near = [at.checked_sub(1), Some(at)].into_iter().flatten().find(|i| {
            self.buckets.get(*i).is_some_and(|own| own.at_us.saturating_sub(bounds.at_us).saturating_abs() < BUCKET_US)
        });
        match near {
            Some(i) => {
                let merged = self.buckets[i].and(bounds);
                if merged.low_us <= merged.high_us {
                    self.buckets[i] = merged;
                }
            }
            None => self.buckets.insert(at, *bounds),
        }
        true
    }
}

/// The console's offset as a stretch of the session bounds it.
#[derive(Clone, Debug)]
pub(super) struct ConsoleOffset {
    any: Chain,
    /// If stamps name beginnings, or ends; `None` once frames have contradicted it.
    ends: [Option<Chain>; 2],
    frames: u32,
    /// Middles of their exposures: a frame may teach more than once.
    exposures: BTreeSet<i64>,
}

impl Default for ConsoleOffset {
    fn default() -> Self {
        Self {
            any: Chain::default(),
            ends: [Some(Chain::default()), Some(Chain::default())],
            frames: 0,
            exposures: BTreeSet::new(),
        }
    }
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

impl ConsoleClock {
    /// How it stands to the host's, such as `2.000 s ± 0.100 s behind the host's`.
    #[must_use]
    pub fn words(&self) -> String {
        let side = if self.offset_us < 0 { "ahead of" } else { "behind" };
        let (offset_s, either_way_s) = (self.offset_us as f64 * 1e-6, self.uncertainty_us as f64 * 1e-6);
        format!("{:.3} s ± {either_way_s:.3} s {side} the host's", offset_s.abs())
    }

    /// The same clock where its stamps are known to be in a zone so many minutes east of UTC: what is left is its own error.
    #[must_use]
    pub fn in_zone(self, minutes: i32) -> Self {
        Self { offset_us: self.offset_us.saturating_add(i64::from(minutes) * 60_000_000), ..self }
    }

    /// How it stands to the host's, apart from its time zone: that which its files state, minutes east of UTC, or the one beside which it would be
    /// off by a few minutes at most.
    #[must_use]
    pub fn words_beside_zone(self, stated_min: Option<i32>) -> String {
        match (stated_min, zone_beside(self.offset_us)) {
            (Some(minutes), _) => format!("{} in its zone, {}", self.in_zone(minutes).words(), zone_label(minutes)),
            (None, Some(minutes)) => {
                format!("{} if its zone is {}, which no file states", self.in_zone(minutes).words(), zone_label(minutes))
            }
            (None, None) => format!("{}, zone and all", self.words()),
        }
    }
}

impl ConsoleOffset {
    /// Offsets possible at `at_us`, whatever instant of its exposure a stamp names; `None` while nothing is known.
    pub(super) fn bounds(&self, at_us: i64) -> Option<Bounds> {
        self.any.bounds(at_us)
    }

    /// Whether a stamp and an exposure can belong together.
    pub(super) fn allows(&self, pair: &Pair) -> bool {
        let mut alive = self.ends.iter().zip(&pair.ends).filter_map(|(chain, bounds)| Some((chain.as_ref()?, bounds))).peekable();
        let read = self.frames >= READ_FRAMES && alive.peek().is_some();
        self.any.allows(&pair.any) && (!read || alive.any(|(chain, bounds)| chain.allows(bounds)))
    }

    /// Takes a pair that is known to belong together; refuses it (false) where it contradicts what is known.
    pub(super) fn learn(&mut self, pair: &Pair) -> bool {
        if !self.any.learn(&pair.any) {
            return false;
        }
        self.frames += 1;
        self.exposures.insert(pair.any.at_us);
        for (chain, bounds) in self.ends.iter_mut().zip(&pair.ends) {
            if chain.as_mut().is_some_and(|chain| !chain.learn(bounds)) {
                *chain = None;
            }
        }
        true
    }

    /// Middles of the first and the last exposure that confirm it.
    pub(super) fn span_us(&self) -> Option<(i64, i64)> {
        Some((*self.exposures.first()?, *self.exposures.last()?))
    }

    pub(super) fn summary(&self) -> Option<ConsoleClock> {
        let bounds = self.bounds(self.any.buckets.last()?.at_us)?;
        let half_us = bounds.high_us.saturating_sub(bounds.low_us) / 2;
        Some(ConsoleClock {
            offset_us: bounds.low_us.saturating_add(half_us),
            uncertainty_us: half_us.saturating_abs(),
            frames: self.exposures.len() as u32,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A clock in a zone east of UTC was so many seconds, less than none, behind the host's.
    #[test]
    fn a_clock_is_ahead_or_behind_and_its_zone_is_no_error() {
        let clock = |offset_us: i64| ConsoleClock { offset_us, uncertainty_us: 130_000, frames: 12 };
        assert_eq!(clock(2_000_000).words(), "2.000 s ± 0.130 s behind the host's");
        let india = clock(-20_022_520_000);
        assert_eq!(india.words(), "20022.520 s ± 0.130 s ahead of the host's");
        assert_eq!(india.in_zone(330).words(), "222.520 s ± 0.130 s ahead of the host's");
        assert_eq!(clock(18_000_500_000).in_zone(-300).words(), "0.500 s ± 0.130 s behind the host's");
        let beside = |offset_us: i64, stated_min: Option<i32>| clock(offset_us).words_beside_zone(stated_min);
        assert_eq!(beside(-3_602_000_000, Some(60)), "2.000 s ± 0.130 s ahead of the host's in its zone, UTC+01:00");
        let unstated = "2.000 s ± 0.130 s ahead of the host's if its zone is UTC+01:00, which no file states";
        assert_eq!(beside(-3_602_000_000, None), unstated);
        assert_eq!(beside(1_500_000_000, None), "1500.000 s ± 0.130 s behind the host's, zone and all");
    }

    #[test]
    fn the_offset_is_bounded_by_every_frame_and_a_contradiction_is_refused() {
        let mut offset = ConsoleOffset::default();
        assert!(offset.bounds(0).is_none());
        // A console 100 s behind, stamps of whole seconds, exposures of 0.2 s at odd phases.
        for i in 0..40i64 {
            let start_us = 1_000_000_000 + i * 7_310_000;
            let console_us = (start_us - 100_000_000).div_euclid(1_000_000) * 1_000_000;
            assert!(offset.learn(&Pair::of(console_us, 1_000_000, [start_us; 2], [start_us + 200_000; 2])));
        }
        let clock = offset.summary().expect("known");
        assert!((clock.offset_us - 100_000_000).abs() <= clock.uncertainty_us && clock.uncertainty_us < 300_000, "{clock:?}");
        assert!(!offset.learn(&Pair::of(900_000_000, 1_000_000, [1_003_000_000; 2], [1_003_200_000; 2])), "three seconds off");
        // An hour later a drift of 200 ppm is within the bounds, one of a second beyond it is not.
        let later_us = 1_000_000_000 + 3_600_000_000;
        let pair = |off_us: i64| Pair::of(later_us - 100_000_000 + off_us, 1, [later_us; 2], [later_us + 200_000; 2]);
        assert!(offset.allows(&pair(720_000)) && !offset.allows(&pair(2_500_000)));
    }
}

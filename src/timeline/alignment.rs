//! The console's offset from a whole batch of stamps, when no frame arrived promptly: the shift at which the most stamps find an
//! exposure of their own, in order.
//!
//! Every pair of stamp and exposure allows a short range of offsets; the true offset lies in one range of every frame, a wrong one only
//! in as many as chance (or a regular rhythm of exposures) provides. Unless the best outweighs every other clearly, nothing is known.

use std::collections::{BTreeMap, BTreeSet};

use super::console::Bounds;
use super::shots::Shots;

/// Offsets that are tried in full.
const TRIED: usize = 64;
/// Offsets are looked at this far around the best.
const SAME_US: i64 = 3_000_000;
/// Offsets that differ by this more than a stamp resolves are different ones.
const APART_US: i64 = 300_000;
/// More pairs than this are not compared (4000 frames with 1000 exposures).
const MOST_PAIRS: usize = 4_000_000;

/// One in so many stamps of a reading may be of exposures that were not seen.
const UNSEEN: usize = 2;
/// So many stamps that fit only another offset show that the clock was set.
const MOST_LOST: usize = 3;

/// A frame's stamp.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stamped {
    pub console_us: i64,
    pub resolution_us: i64,
    /// The console's count.
    pub counter: Option<u32>,
    /// It cannot be of an exposure that ended later.
    pub arrival_us: Option<i64>,
}

impl Stamped {
    /// Offsets with which the frame is of the exposure at `at`, brought to the time `middle_us`.
    fn range(&self, shots: &Shots, at: usize, middle_us: i64) -> Option<Bounds> {
        let shot = shots.get(at);
        let causal = self.arrival_us.is_none_or(|arrival_us| shot.over_us <= arrival_us);
        causal.then(|| Bounds::of(self.console_us, self.resolution_us, shot.start_us, shot.end_us).at(middle_us))
    }
}

/// Stamps in their order, and the offsets at which many of them may be of exposures.
pub(super) struct Stamps<'a> {
    list: Vec<Stamped>,
    shots: &'a Shots,
    /// Offsets are compared at this time.
    middle_us: i64,
    tried: Vec<Reading>,
}

/// What an offset makes of the stamps.
struct Reading {
    offset_us: i64,
    /// How many different stamps find an exposure of their own, each later than the one before.
    count: usize,
    /// Those that find none.
    lost: Vec<Stamped>,
}

impl<'a> Stamps<'a> {
    /// `sharp`: only exposures whose times are well known suggest offsets.
    pub(super) fn new(mut list: Vec<Stamped>, shots: &'a Shots, sharp: bool) -> Self {
        list.sort_by_key(|stamped| stamped.console_us);
        let middle_us = if shots.len() == 0 { 0 } else { shots.get(shots.len() / 2).end_us };
        let mut stamps = Self { list, shots, middle_us, tried: Vec::new() };
        if stamps.list.len().saturating_mul(shots.len()) > MOST_PAIRS {
            return stamps;
        }
        // Sweep over the ranges' ends: how many ranges hold at each lower end.
        let mut ends: Vec<(i64, i32)> = Vec::new();
        for stamped in &stamps.list {
            let whole = (0..shots.len()).filter(|at| !sharp || shots.get(*at).whole);
            for range in whole.filter_map(|at| stamped.range(shots, at, middle_us)) {
                ends.push((range.low_us, -1));
                ends.push((range.high_us, 1));
            }
        }
        ends.sort_unstable();
        let mut open = 0;
        let mut offsets: Vec<(i32, i64)> = Vec::new();
        for (at_us, end) in ends {
            open -= end;
            if end < 0 {
                offsets.push((open, at_us));
            }
        }
        offsets.sort_unstable_by_key(|(count, at_us)| (std::cmp::Reverse(*count), *at_us));
        for (_, offset_us) in offsets {
            let near = |other: &Reading| other.offset_us.saturating_sub(offset_us).saturating_abs() <= SAME_US / 6;
            if !stamps.tried.iter().any(near) {
                stamps.tried.push(stamps.read(&stamps.list, offset_us));
                if stamps.tried.len() >= TRIED {
                    break;
                }
            }
        }
        stamps
    }

    fn read(&self, list: &[Stamped], offset_us: i64) -> Reading {
        let (mut next, mut last) = (0, None);
        let mut reading = Reading { offset_us, count: 0, lost: Vec::new() };
        for stamped in list {
            if last == Some(stamped.console_us) {
                continue;
            }
            let fits = |at: &usize| stamped.range(self.shots, *at, self.middle_us).is_some_and(|range| range.holds(offset_us));
            let around_us = stamped.console_us.saturating_add(offset_us);
            let reach_us = stamped.resolution_us.saturating_add(SAME_US);
            let near = self.shots.touching(around_us.saturating_sub(reach_us), around_us.saturating_add(reach_us));
            if let Some(at) = near.filter(|at| *at >= next).find(fits) {
                (next, last) = (at + 1, Some(stamped.console_us));
                reading.count += 1;
            } else {
                reading.lost.push(*stamped);
            }
        }
        reading
    }

    /// How many stamps find the exposure that their counts name, if these are all shifted alike: with that shift with which the most do, and
    /// with none.
    fn counted(&self, offset_us: i64) -> (usize, usize) {
        let mut shifts: BTreeMap<i64, usize> = BTreeMap::new();
        let mut last = None;
        for stamped in &self.list {
            // Of two pictures of one exposure one speaks.
            let same = last.replace((stamped.console_us, stamped.counter)) == Some((stamped.console_us, stamped.counter));
            let Some(counter) = stamped.counter.filter(|_| !same) else { continue };
            let around_us = stamped.console_us.saturating_add(offset_us);
            let reach_us = stamped.resolution_us.saturating_add(SAME_US);
            let near = self.shots.touching(around_us.saturating_sub(reach_us), around_us.saturating_add(reach_us));
            let fits = |at: &usize| stamped.range(self.shots, *at, self.middle_us).is_some_and(|range| range.holds(offset_us));
            let of = |at: usize| self.shots.number(at).map(|number| i64::from(counter) - number);
            for shift in near.filter(fits).filter_map(of).collect::<BTreeSet<i64>>() {
                *shifts.entry(shift).or_default() += 1;
            }
        }
        (shifts.values().copied().max().unwrap_or(0), shifts.get(&0).copied().unwrap_or(0))
    }

    /// Exposures may follow each other within a second or two: an offset that is off by one of them is another one.
    fn apart_us(&self) -> i64 {
        let coarsest_us = self.list.iter().map(|stamped| stamped.resolution_us).max().unwrap_or(0);
        coarsest_us.saturating_add(APART_US).min(SAME_US)
    }

    /// Whether a frame with this stamp may be of an exposure that was not seen, with an offset that is known to `within_us`.
    fn unseen(stamped: &Stamped, offset_us: i64, within_us: i64, blind: &dyn Fn(i64, i64) -> bool) -> bool {
        let from_us = stamped.console_us.saturating_add(offset_us);
        let to_us = from_us.saturating_add(stamped.resolution_us);
        blind(from_us.saturating_sub(within_us), to_us.saturating_add(within_us).min(stamped.arrival_us.unwrap_or(i64::MAX)))
    }

    /// Whether another offset than `own` explains as many stamps, a few perhaps by exposures that were not seen (`blind`: whether telemetry was
    /// silent within two host times). `counts`: console and C-arm count alike with `own`, so that they do with a rival, but for a shift.
    pub(super) fn has_rival(&self, own: &Bounds, counts: bool, blind: &dyn Fn(i64, i64) -> bool) -> bool {
        let own = own.at(self.middle_us);
        let Reading { count, lost, .. } = self.read(&self.list, own.low_us / 2 + own.high_us / 2);
        // What falls out of the session with either offset tells nothing.
        let lost: BTreeSet<i64> = lost.iter().map(|stamped| stamped.console_us).collect();
        self.tried.is_empty()
            || self.tried.iter().any(|reading| {
                let after = reading.offset_us > own.high_us.saturating_add(APART_US);
                let before = reading.offset_us < own.low_us.saturating_sub(APART_US);
                let hidden = |stamped: &&Stamped| {
                    !lost.contains(&stamped.console_us) && Self::unseen(stamped, reading.offset_us, APART_US, blind)
                };
                let unseen = reading.lost.iter().filter(hidden).count();
                let explained = || if counts { self.counted(reading.offset_us).0 } else { reading.count };
                (after || before) && explained() + unseen.min((count / UNSEEN).max(1)) >= count
            })
    }
}

/// Pairs of stamp and exposure of which the offset can be learnt: positions in `stamps` and `shots`. Empty while two readings are possible.
/// `blind`: whether telemetry was silent within two host times. `whole`: whether no frame will follow; until then one reading must stand out
/// further, because later frames may yet contradict it.
pub(super) fn align(stamps: Vec<Stamped>, shots: &Shots, blind: &dyn Fn(i64, i64) -> bool, whole: bool) -> Vec<(Stamped, usize)> {
    let stamps = Stamps::new(stamps, shots, true);
    let (tried, middle_us) = (&stamps.tried, stamps.middle_us);
    let Some((best, offset_us)) = tried.iter().max_by_key(|own| own.count).map(|own| (own.count, own.offset_us)) else {
        return Vec::new();
    };
    let apart_us = stamps.apart_us();
    let elsewhere = tried.iter().filter(|other| other.offset_us.saturating_sub(offset_us).saturating_abs() > apart_us);
    // Where console and C-arm count alike by the best reading, they do by any other that is true, but for a shift.
    let counts = shots.counted && stamps.counted(offset_us).1 == best;
    let explained = |other: &Reading| if counts { stamps.counted(other.offset_us).0 } else { other.count };
    let second = elsewhere.map(explained).max().unwrap_or(0);
    let mut different: Vec<i64> = stamps.list.iter().map(|stamped| stamped.console_us).collect();
    different.dedup();
    let margin = if whole { (best / 5).max(3) } else { (best / 2).max(4) };
    if best < 3 || 2 * best < different.len() || best < second + margin {
        return Vec::new();
    }
    // Stamps that fit nothing, but many of them with one other offset: the clock was set in between, and either part fits exposures of
    // the other by chance.
    let fits = |stamped: &&Stamped| {
        (0..shots.len()).any(|at| stamped.range(shots, at, middle_us).is_some_and(|range| range.holds(offset_us)))
    };
    let lost: Vec<Stamped> = stamps.list.iter().filter(|stamped| !fits(stamped)).copied().collect();
    let elsewhere = tried.iter().map(|other| stamps.read(&lost, other.offset_us).count).max().unwrap_or(0);
    if elsewhere >= MOST_LOST && 2 * elsewhere >= lost.len() {
        return Vec::new();
    }
    // A frame that may be of an exposure that was not seen has no place in the order.
    let seen = |stamped: &&Stamped| !Stamps::unseen(stamped, offset_us, SAME_US / 2, blind);
    let seen: Vec<Stamped> = stamps.list.iter().filter(seen).copied().collect();
    pairs_in_order(&seen, shots, middle_us, offset_us)
}

/// Near a coarse offset, the exposures that stamps must have because every later stamp is of a later exposure.
fn pairs_in_order(stamps: &[Stamped], shots: &Shots, middle_us: i64, offset_us: i64) -> Vec<(Stamped, usize)> {
    let near = |stamped: &Stamped| -> Vec<usize> {
        let reaches = |range: Bounds| {
            range.low_us <= offset_us.saturating_add(SAME_US / 2) && range.high_us >= offset_us.saturating_sub(SAME_US / 2)
        };
        (0..shots.len()).filter(|at| stamped.range(shots, *at, middle_us).is_some_and(reaches)).collect()
    };
    let mut places: Vec<(Stamped, Vec<usize>)> = Vec::new();
    for stamped in stamps {
        if places.last().is_none_or(|(last, _)| last.console_us != stamped.console_us) {
            places.push((*stamped, near(stamped)));
        }
    }
    places.retain(|(_, fitting)| !fitting.is_empty());
    let mut lowest: Vec<Option<usize>> = Vec::new();
    let mut last = None;
    for (_, fitting) in &places {
        let at = fitting.iter().copied().find(|at| last.is_none_or(|last| *at > last));
        last = at.or(last);
        lowest.push(at);
    }
    let mut found = Vec::new();
    let mut next = None;
    for ((stamped, fitting), lowest) in places.iter().zip(lowest).rev() {
        let highest = fitting.iter().rev().copied().find(|at| next.is_none_or(|next| *at < next));
        next = highest.or(next);
        // An exposure that telemetry missed in part takes a place in the order, but its times teach nothing.
        if let Some(at) = lowest.filter(|at| Some(*at) == highest && shots.get(*at).whole) {
            found.push((*stamped, at));
        }
    }
    found
}

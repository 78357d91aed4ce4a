//! A frame told by its place in the sequence: pictures off a monitor come nearly equally long after their exposures, so that the times between
//! them are those between the exposures. Where these differ, only one delay makes them agree.
//!
//! What another delay explains nearly as well is not told: exposures as even as a clock's ticks stay ambiguous. Where a picture is missing, or
//! comes as none else does, the delay may have changed: what lies before it and what follows must tell each by its own times.

use std::ops::RangeInclusive;

use super::arrival::LAST_EXPOSURES;
use super::console::Bounds;
use super::evidence::{BindingHow, seconds};
use super::judgement::{Judgement, Weighed};
use super::known::Pending;
use super::shots::{BATCH_US, PROMPT_US};

/// What a delay may differ from the one that frames have in common, either way.
const BESIDE_US: i64 = 150_000;
/// Ends that are known worse than this tell nothing of times between exposures.
const SHARP_US: i64 = 200_000;
/// Frames before this one, and after it, that take part.
const AROUND: usize = 12;
/// Delays that are thought of: before the end of a beam, and long after it.
const EARLIEST_US: i64 = -2_000_000;
const LATEST_US: i64 = 30_000_000;
/// The shortest delay that is believed.
const SOONEST_US: i64 = 50_000;
/// Frames that agree, at least, of all that are there and of all exposures meanwhile, in tenths.
const LEAST: usize = 6;
const OF_FRAMES: usize = 8;
const OF_EXPOSURES: usize = 7;
/// Frames that no other delay explains, at least, and as a part: one in so many.
const NEEDED: usize = 4;
const PART_NEEDED: usize = 3;
const SHARE: usize = 5;
/// Risk that the exposure's own frame is missing and a stray came just then.
const RISK: f64 = 2e-5;
/// What a frame may come sooner or later than all others that agree.
const MARGIN_US: i64 = 20_000;

/// An exposure as the sequence sees it.
#[derive(Clone, Copy)]
struct Ended {
    /// Its position among all.
    shot: usize,
    /// The middle of the times at which it may have ended.
    end_us: i64,
    /// Frames that the delay gives it.
    frames: usize,
}

/// Frames around one, and exposures, with the delay that they have in common.
struct Sequence<'a> {
    frames: Vec<&'a Pending>,
    arrivals_us: Vec<i64>,
    ended: Vec<Ended>,
    /// The exposure of each frame, by its place in `ended`.
    own: Vec<Option<usize>>,
    delay_us: i64,
    /// Frames that have an exposure of their own with it, and the most that another delay explains.
    explained: usize,
    otherwise: usize,
}

/// Delays of all pairs of frame and exposure, in their order, each with the frame's place.
fn differences(arrivals_us: &[i64], ended: &[Ended]) -> Vec<(i64, usize)> {
    let mut found = Vec::new();
    for (at, arrival_us) in arrivals_us.iter().enumerate() {
        let delays_us = ended.iter().map(|ended| arrival_us.saturating_sub(ended.end_us));
        found.extend(delays_us.filter(|us| (EARLIEST_US..=LATEST_US).contains(us)).map(|us| (us, at)));
    }
    found.sort_unstable();
    found
}

/// How many of so many frames one delay explains at most, and the delay; with `but_us`, one that is not beside that.
fn most_explained(differences: &[(i64, usize)], frames: usize, but_us: Option<i64>) -> (usize, i64) {
    let mut counts = vec![0_usize; frames];
    let (mut explained, mut to, mut best) = (0, 0, (0, 0));
    for (from, (low_us, at)) in differences.iter().enumerate() {
        while let Some((_, frame)) = differences.get(to).filter(|(us, _)| *us <= low_us.saturating_add(2 * BESIDE_US)) {
            explained += usize::from(counts[*frame] == 0);
            counts[*frame] += 1;
            to += 1;
        }
        let is_beside = |us: i64| low_us.saturating_add(BESIDE_US).saturating_sub(us).saturating_abs() <= 2 * BESIDE_US;
        if explained > best.0 && !but_us.is_some_and(is_beside) {
            best = (explained, differences[from + (to - 1 - from) / 2].0);
        }
        counts[*at] -= 1;
        explained -= usize::from(counts[*at] == 0);
    }
    best
}

impl<'a> Sequence<'a> {
    /// `None` where the frames have no delay in common that nothing else explains.
    fn of(frames: Vec<&'a Pending>, mut ended: Vec<Ended>) -> Option<Self> {
        let arrivals_us: Vec<i64> = frames.iter().filter_map(|pending| pending.evidence.arrival_us).collect();
        if arrivals_us.len() < LEAST || arrivals_us.len() != frames.len() {
            return None;
        }
        let differences = differences(&arrivals_us, &ended);
        let (_, delay_us) = most_explained(&differences, frames.len(), None);
        let off_us =
            |arrival_us: i64, ended: &Ended| arrival_us.saturating_sub(ended.end_us).saturating_sub(delay_us).saturating_abs();
        let nearest = |arrival_us: &i64| {
            let beside = ended.iter().map(|ended| off_us(*arrival_us, ended)).enumerate().filter(|(_, us)| *us <= BESIDE_US);
            beside.min_by_key(|(_, us)| *us).map(|(at, _)| at)
        };
        let own: Vec<Option<usize>> = arrivals_us.iter().map(nearest).collect();
        for at in own.iter().flatten() {
            ended[*at].frames += 1;
        }
        let explained = ended.iter().filter(|ended| ended.frames > 0).count();
        let (otherwise, _) = most_explained(&differences, frames.len(), Some(delay_us));
        let enough = explained >= LEAST && 10 * explained >= OF_FRAMES * frames.len();
        let alone = explained >= otherwise + NEEDED.max(explained.div_ceil(SHARE));
        (enough && alone && (SOONEST_US..=PROMPT_US).contains(&delay_us)).then_some(Self {
            frames,
            arrivals_us,
            ended,
            own,
            delay_us,
            explained,
            otherwise,
        })
    }

    /// Places in `ended` of the exposures whose frames would have come from the first of the sequence on until `now_us`.
    fn due(&self, now_us: i64) -> Vec<usize> {
        let due_us = |at: usize| self.ended[at].end_us.saturating_add(self.delay_us).saturating_add(BESIDE_US);
        let first_us = self.arrivals_us.first().copied().unwrap_or(i64::MAX);
        (0..self.ended.len()).filter(|at| (first_us..now_us).contains(&due_us(*at))).collect()
    }

    /// The shortest and the longest delay of the frames that agree, but for the one at `frame`, with a margin.
    fn usual_us(&self, frame: usize) -> Option<RangeInclusive<i64>> {
        let others = self.own.iter().enumerate().filter(|(at, _)| *at != frame);
        let delays_us = others.filter_map(|(at, own)| Some(self.arrivals_us[at].saturating_sub(self.ended[(*own)?].end_us)));
        let (shortest_us, longest_us) = (delays_us.clone().min()?, delays_us.max()?);
        Some(shortest_us.saturating_sub(MARGIN_US)..=longest_us.saturating_add(MARGIN_US))
    }

    /// Whether the frames around the one at `frame`, as far as each exposure has its frame and each frame its exposure, have this delay in common
    /// and no other, whatever those farther off say. `due`: exposures whose frames are there if they come.
    fn tells_by_itself(&self, frame: usize, exposure: usize, due: &[usize]) -> bool {
        let is_odd = |at: &&usize| self.ended[**at].frames != 1;
        let before = due.iter().filter(is_odd).rfind(|at| **at < exposure).copied();
        let after = due.iter().filter(is_odd).find(|at| **at > exposure).copied();
        let within = |at: usize| before.is_none_or(|before| at > before) && after.is_none_or(|after| at < after);
        let from = (0..frame).rev().find(|at| self.own[*at].is_none()).map_or(0, |at| at + 1);
        let to = (frame..self.own.len()).find(|at| self.own[*at].is_none()).unwrap_or(self.own.len());
        let part_us: Vec<i64> =
            (from..to).filter(|at| self.own[*at].is_some_and(within)).map(|at| self.arrivals_us[at]).collect();
        let differences = differences(&part_us, &self.ended);
        let (otherwise, _) = most_explained(&differences, part_us.len(), Some(self.delay_us));
        part_us.len() >= LEAST && part_us.len() >= otherwise + PART_NEEDED.max(part_us.len().div_ceil(SHARE))
    }
}

impl Weighed<'_> {
    /// The verdict where the frame's place in the sequence of frames and exposures tells which it is of.
    pub(super) fn by_sequence(&self, arrival_us: i64) -> Option<Judgement> {
        let shots = &self.known.shots;
        let (sequence, place) = self.sequence(arrival_us)?;
        let exposure = sequence.own[place]?;
        let Ended { shot, end_us, frames } = sequence.ended[exposure];
        let waits = |at: usize| sequence.ended[at].frames == 0;
        let beside_us = |at: &usize| sequence.ended[*at].end_us.saturating_sub(end_us).saturating_abs();
        let beside = [exposure.checked_sub(1), Some(exposure + 1).filter(|next| *next < sequence.ended.len())];
        let crowded = beside.iter().flatten().any(|at| beside_us(at) <= 4 * BESIDE_US);
        // One that ended later and has no frame by now may be the frame's as well.
        let later = (exposure + 1..sequence.ended.len())
            .any(|at| waits(at) && sequence.ended[at].end_us <= arrival_us.saturating_sub(SOONEST_US));
        let blind = self.timeline.exposure_tracker().blind_spot(end_us.min(arrival_us.saturating_sub(PROMPT_US)), arrival_us);
        let taken = frames != 1 || shots.get(shot).frame.is_some() || shots.get(shot).over_us >= arrival_us;
        let usual_us = sequence.usual_us(place)?;
        let is_odd = !usual_us.contains(&arrival_us.saturating_sub(end_us));
        if crowded || later || taken || is_odd || blind.is_some() || self.came_with_another(arrival_us) {
            return None;
        }
        let now_us = if self.known.finished { i64::MAX } else { self.newest_us.unwrap_or(self.now_us).min(self.now_us) };
        let due = sequence.due(now_us);
        let first = sequence.own.iter().flatten().min().copied()?;
        let meanwhile = due.iter().filter(|at| **at >= first).count();
        if 10 * sequence.explained < OF_EXPOSURES * meanwhile || !self.is_of_one_console(&sequence) {
            return None;
        }
        let is_whole = sequence.own.iter().all(Option::is_some) && due.iter().all(|at| sequence.ended[*at].frames == 1);
        if !is_whole && !sequence.tells_by_itself(place, exposure, &due)
            || !(self.stray_risk(&sequence, &due, arrival_us, &usual_us) <= RISK)
        {
            return None;
        }
        if !self.known.finished && self.now_us.saturating_sub(arrival_us) < BATCH_US {
            return Some(Judgement::Wait("waiting whether more frames come with it".to_owned()));
        }
        let said = &self.pending.evidence;
        let evidence = vec![
            format!(
                "{} of {} frames around it came {} after exposures of their own; with any other delay {} would at most",
                sequence.explained,
                sequence.frames.len(),
                seconds(sequence.delay_us),
                sequence.otherwise
            ),
            format!("{} ended {} before the frame arrived", self.label(shot), seconds(arrival_us.saturating_sub(end_us))),
        ];
        Some(self.of(shot, BindingHow::Time, evidence, said.console_us.is_some() || said.counter.is_some()))
    }

    /// The frames around this one with what they have in common, and its place among them; `None` where that is nothing, or will not change any
    /// more.
    fn sequence(&self, arrival_us: i64) -> Option<(Sequence<'_>, usize)> {
        let (known, own) = (self.known, self.pending.evidence.frame);
        let stands = |pending: &&Pending| {
            let said = &pending.evidence;
            pending.prompt.is_some()
                && said.arrival_us.is_some()
                && known.contents.get(&said.content).is_some_and(|(first, _)| *first == said.frame)
        };
        let after: Vec<&Pending> =
            known.frames.range(own.saturating_add(1)..).map(|(_, pending)| pending).filter(stands).take(AROUND + 1).collect();
        if !known.finished && after.len() > AROUND {
            return None;
        }
        let mut frames: Vec<&Pending> =
            known.frames.range(..own).rev().map(|(_, pending)| pending).filter(stands).take(AROUND).collect();
        frames.reverse();
        let place = frames.len();
        frames.push(self.pending);
        frames.extend(after.into_iter().take(AROUND));
        let first_us = frames.first()?.evidence.arrival_us?.min(arrival_us);
        let last_us = frames.last()?.evidence.arrival_us?.max(arrival_us);
        let near = known.shots.touching(first_us.saturating_sub(LATEST_US), last_us).map(|at| (at, known.shots.get(at)));
        let mut ended = Vec::new();
        for (shot, at) in near {
            let width_us = at.end_us.saturating_sub(at.over_us);
            if !at.whole || width_us > SHARP_US {
                return None;
            }
            ended.push(Ended { shot, end_us: at.over_us.saturating_add(width_us / 2), frames: 0 });
        }
        Some((Sequence::of(frames, ended)?, place))
    }

    /// Whether nothing else that is known gives these frames other exposures: their stamps name one offset of the console's clock, and their
    /// counters one shift.
    fn is_of_one_console(&self, sequence: &Sequence) -> bool {
        let counts = self.known.counting.useless().is_none();
        let (mut offset, mut shift): (Option<Bounds>, Option<i64>) = (None, None);
        for (pending, at) in sequence.frames.iter().zip(&sequence.own) {
            let Some(Ended { shot, .. }) = at.map(|at| sequence.ended[at]) else { continue };
            let said = &pending.evidence;
            let index = self.known.shots.get(shot).index;
            // Of a file whose images have exposures of their own this is one image's. Beside another of them the file counts as elsewhere, and there
            // is no verdict: its stamp and count are not of that one. Other frames get none of them, for each exposure says whose it is.
            let elsewhere = pending.binding.exposure.as_ref().is_some_and(|exposure| exposure.index != index);
            if elsewhere || self.known.shots.get(shot).frame.is_some_and(|frame| frame != said.frame) {
                return false;
            }
            if let Some(pair) = self.known.pair(said, shot) {
                let common = offset.map_or(pair.any, |offset| offset.and(&pair.any));
                if common.low_us > common.high_us {
                    return false;
                }
                offset = Some(common);
            }
            let own = said.counter.zip(self.known.shots.number(shot)).map(|(counter, number)| i64::from(counter) - number);
            if let Some(own) = own.filter(|_| counts)
                && *shift.get_or_insert(own) != own
            {
                return false;
            }
        }
        true
    }

    /// As [`Self::risk_of`], of a stray within the time in which the frame would have come, `usual_us` after its exposure.
    fn stray_risk(&self, sequence: &Sequence, due: &[usize], arrival_us: i64, usual_us: &RangeInclusive<i64>) -> f64 {
        let last: Vec<usize> = due.iter().rev().take(LAST_EXPOSURES).copied().collect();
        let lacking = last.iter().filter(|at| sequence.ended[**at].frames == 0).count();
        let strays = self.known.strays + sequence.own.iter().filter(|own| own.is_none()).count() as u32;
        self.risk_of([lacking, last.len()], strays, arrival_us, usual_us.end().saturating_sub(*usual_us.start()))
    }
}

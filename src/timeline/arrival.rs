//! A frame of which nothing but its arrival tells: bound only where frames have come one by one, promptly, for every exposure.

use std::ops::RangeInclusive;

use super::evidence::{BindingHow, seconds};
use super::judgement::{Judgement, Weighed, none};
use super::known::Pending;
use super::shots::{BATCH_US, PROMPT_US};

/// Why frames of a console of which nothing is known are not bound.
pub const TOO_FEW_AGREE: &str = "too few frames agree on what the console's stamps and counter mean, or the exposures follow each other too evenly \
                                 for them to tell one from the next";

/// Risk at which arrival alone still binds: that the exposure's own frame is missing and a stray came just then.
const ARRIVAL_RISK: f64 = 1e-4;
/// Frames from which it is known how soon frames come.
const DELAYS: usize = 5;
/// Frames from which it is known whether one came sooner than they.
const FIRST_DELAYS: usize = 2;
/// One frame in so many may come sooner, and one later, than frames usually do.
const STRANGE: usize = 10;
/// Exposures from which it is known whether frames come promptly at present.
pub(super) const LAST_EXPOSURES: usize = 12;
/// Half a stray is taken to have come in so long before the session.
const BEFORE_US: i64 = 300_000_000;

impl Weighed<'_> {
    /// Arrival alone: bound only where frames have come one by one, promptly, for every exposure.
    pub(super) fn by_arrival(&self, prompt: &[usize], mut words: Vec<String>) -> Judgement {
        let said = &self.pending.evidence;
        let Some(arrival_us) = said.arrival_us else {
            words.push(match said.console_us.is_some() || said.counter.is_some() {
                true => TOO_FEW_AGREE.to_owned(),
                false => "without a stamp or counter a frame exported afterwards cannot be tied".to_owned(),
            });
            return none(words);
        };
        let unlearnt = said.console_us.is_some() || said.counter.is_some() && self.known.counting.useless().is_none();
        if self.known.others_say_more(said) {
            words.push("it lacks the stamp or counter that other frames have".to_owned());
            return none(words);
        }
        // Of exposures farther apart the arrival alone tells.
        let is_close = prompt.len() > 1 || prompt.iter().any(|at| self.known.shots.get(*at).prompt_frames > 1);
        if is_close && let Some(judgement) = self.by_sequence(arrival_us) {
            return judgement;
        }
        if unlearnt && !self.known.finished {
            words.push("what the console's clock and counter mean was not known when this frame was judged".to_owned());
            return none(words);
        }
        let at = match prompt {
            [] => {
                words.push(format!("no exposure ended within {} before the frame arrived", seconds(PROMPT_US)));
                return none(words);
            }
            [at] => *at,
            several => {
                let count = several.len();
                words.push(format!("{count} exposures ended within {} before the frame arrived: ambiguous", seconds(PROMPT_US)));
                return none(words);
            }
        };
        if self.known.was_on_for(said, at) {
            words.push(format!("{} was on when the frame arrived, which alone does not tell", self.label(at)));
            return none(words);
        }
        if !self.known.finished && self.now_us.saturating_sub(arrival_us) < BATCH_US {
            return Judgement::Wait("waiting whether more frames come with it".to_owned());
        }
        if self.known.shots.get(at).prompt_frames > 1 || self.came_with_another(arrival_us) {
            words.push(format!("several frames came after {}: ambiguous", self.label(at)));
            return none(words);
        }
        if let Some(blind) = self.blind(at, arrival_us.saturating_sub(PROMPT_US), arrival_us) {
            words.push(blind);
            return none(words);
        }
        let late_us = arrival_us.saturating_sub(self.known.shots.get(at).end_us);
        let Some(usual_us) = self.usual_delay_us() else {
            words.push(match self.known.finished {
                true => format!(
                    "how soon frames come after their exposures is not known: it takes {DELAYS} others that came promptly"
                ),
                false => "how soon frames come after their exposures was not known when this frame was judged".to_owned(),
            });
            return none(words);
        };
        if !usual_us.contains(&late_us) {
            let (late, from, to) = (seconds(late_us), seconds(*usual_us.start()), seconds(*usual_us.end()));
            words.push(format!("it came {late} after {}, others come after {from} to {to}: ambiguous", self.label(at)));
            return none(words);
        }
        let (risk, lacking, count) = self.arrival_risk(arrival_us, usual_us.end().saturating_sub(*usual_us.start()));
        if !(risk <= ARRIVAL_RISK) {
            let strays = self.known.strays;
            words.push(format!(
                "frames are missing or late here ({lacking} of the last {count} exposures had none promptly, {strays} frames came when none was near): arrival alone does not tell"
            ));
            return none(words);
        }
        words.push(format!("{} ended {} before the frame arrived, and no other was near", self.label(at), seconds(late_us)));
        self.of(at, BindingHow::Time, words, false)
    }

    /// Whether another picture came within the time of a batch.
    pub(super) fn came_with_another(&self, arrival_us: i64) -> bool {
        let said = &self.pending.evidence;
        self.known.frames.values().any(|other| {
            let apart_us = other.evidence.arrival_us.map_or(i64::MAX, |us| us.saturating_sub(arrival_us).saturating_abs());
            other.evidence.frame != said.frame && other.evidence.content != said.content && apart_us <= BATCH_US
        })
    }

    /// How long after their exposures the other frames come: the shortest and the longest with a margin; `None` while too few are known.
    pub(super) fn usual_delay_us(&self) -> Option<RangeInclusive<i64>> {
        let delays_us = self.delays_us();
        let enough = delays_us.len() >= DELAYS;
        usual_us_of(delays_us).filter(|_| enough)
    }

    /// The same from few frames, which may show that one came sooner than they, but not that none does.
    pub(super) fn first_delays_us(&self) -> Option<RangeInclusive<i64>> {
        let delays_us = self.delays_us();
        let enough = delays_us.len() >= FIRST_DELAYS;
        usual_us_of(delays_us).filter(|_| enough)
    }

    /// How long after their exposures the other frames came, as far as one came alone after one exposure, or is bound to one.
    fn delays_us(&self) -> Vec<i64> {
        let shots = &self.known.shots;
        let delay = |other: &Pending| {
            let prompt = other.prompt.as_deref()?;
            let bound = other.binding.exposure.as_ref().and_then(|exposure| shots.position(exposure.index));
            let at = match (bound, prompt) {
                (Some(at), _) if prompt.contains(&at) => at,
                (None, [at]) if shots.get(*at).prompt_frames == 1 && !self.known.was_on_for(&other.evidence, *at) => *at,
                _ => return None,
            };
            let (shot, arrival_us) = (shots.get(at), other.evidence.arrival_us?);
            (shot.whole && other.evidence.frame != self.pending.evidence.frame).then(|| arrival_us.saturating_sub(shot.end_us))
        };
        self.known.frames.values().filter_map(delay).collect()
    }

    /// Chance that the exposure's own frame is missing or late and a stray arrives in its place: share of the last exposures, so many of so many,
    /// without a frame (late ones come in runs), times rate of strays (before any was seen: one in ten minutes), times the length of the time in
    /// which frames usually come.
    pub(super) fn risk_of(&self, [lacking, count]: [usize; 2], strays: u32, arrival_us: i64, usual_us: i64) -> f64 {
        let share = (lacking as f64 + 0.5) / (count as f64 + 1.0);
        let elapsed_us = arrival_us.saturating_sub(self.known.shots.get(0).start_us).max(0).saturating_add(BEFORE_US);
        let rate = (f64::from(strays) + 0.5) / elapsed_us as f64;
        share * rate * usual_us as f64
    }

    /// The same by prompt frames, behind how many of the last exposures lack one.
    fn arrival_risk(&self, arrival_us: i64, usual_us: i64) -> (f64, usize, usize) {
        let shots = &self.known.shots;
        let settled_us = arrival_us.saturating_sub(PROMPT_US);
        let last: Vec<bool> = (0..shots.len())
            .rev()
            .map(|at| shots.get(at))
            .filter(|shot| shot.end_us < settled_us)
            .take(LAST_EXPOSURES)
            .map(|shot| shot.prompt_frames == 0)
            .collect();
        let lacking = last.iter().filter(|lacking| **lacking).count();
        (self.risk_of([lacking, last.len()], self.known.strays, arrival_us, usual_us), lacking, last.len())
    }
}

/// The delays of nearly all of these frames, with a margin: a tenth on either side may be of something else.
pub(super) fn usual_us_of(mut delays_us: Vec<i64>) -> Option<RangeInclusive<i64>> {
    delays_us.sort_unstable();
    let strange = delays_us.len() / STRANGE;
    let (shortest_us, longest_us) = (*delays_us.get(strange)?, *delays_us.iter().rev().nth(strange)?);
    let margin_us = (longest_us.saturating_sub(shortest_us) / 4).max(200_000);
    Some(shortest_us.saturating_sub(margin_us)..=longest_us.saturating_add(margin_us))
}

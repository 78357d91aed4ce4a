//! How likely it is that frames fit the exposures by accident: those of another room's console do so one by one, and hardly ever all together.
//!
//! The times at which a frame would fit cover a share p of the session. Of m frames n fit by accident with a chance of at most C(m, n) pⁿ, with one
//! frame less in the exponent for each number that was fitted to them, and times the readings among which that number was chosen. That holds where
//! the times of one console say nothing of the other's: of an even rhythm no such thing is believed.

use std::collections::BTreeSet;

use super::arrival::usual_us_of;
use super::console::SCATTER_US;
use super::evidence::{BindingFlag, FrameEvidence};
use super::known::Known;
use super::shots::Shot;

/// Chance of an accident up to which frames are taken to be of the exposures that they fit.
const CHANCE: f64 = 1e-6;
/// Ways in which it is asked: by their stamps, and by how soon they came.
const WAYS: f64 = 2.0;

/// Frames that fit exposures.
#[derive(Clone, Copy, Debug)]
struct Fit {
    /// So many do, of so many.
    fitting: usize,
    frames: usize,
    /// The share of the session in which one would fit.
    share: f64,
    /// Numbers that were fitted to them, and the readings among which each was chosen.
    fitted: usize,
    readings: usize,
}

impl Fit {
    /// Natural logarithm of the chance that it is an accident; not a number, or above 0, where nothing tells.
    fn log_chance(&self) -> f64 {
        let missing = self.frames.saturating_sub(self.fitting);
        let choices: f64 = (1..=missing).map(|i| ((self.fitting + i) as f64 / i as f64).ln()).sum();
        let free = self.fitting.saturating_sub(self.fitted) as f64;
        choices + free * self.share.ln() + self.fitted as f64 * (self.readings as f64).ln()
    }

    fn is_no_accident(&self) -> bool {
        self.log_chance() <= (CHANCE / WAYS).ln()
    }
}

impl Known {
    /// Whether so many of the frames fit exposures, by their stamps or by how soon they came, that these are theirs: frames of another room, whatever
    /// they were bound to, do not.
    pub(super) fn is_no_accident(&self) -> bool {
        [self.fit_by_stamps(), self.fit_by_delays()].iter().flatten().any(Fit::is_no_accident)
    }

    /// Frames with an exposure of their own whose times are known well, and its position.
    fn sharply_tied(&self) -> Vec<(&FrameEvidence, usize)> {
        let tied = self.frames.values().filter(|pending| pending.apart.is_empty()).filter_map(|pending| {
            let at = self.shots.position(pending.binding.exposure.as_ref()?.index)?;
            self.shots.get(at).whole.then_some((&pending.evidence, at))
        });
        tied.collect()
    }

    /// Frames of which each may have an exposure: no copies, and no second pictures.
    fn frames_of_their_own(&self) -> usize {
        let is_second = |frame: u32| {
            let flags = self.frames.get(&frame).map(|pending| pending.binding.flags.as_slice()).unwrap_or_default();
            flags.iter().any(|flag| matches!(flag, BindingFlag::SecondPicture { .. }))
        };
        let first: BTreeSet<u32> = self.contents.values().map(|(first, _)| *first).collect();
        first.into_iter().filter(|frame| !is_second(*frame)).count()
    }

    /// The share of the time from the first to the last of the exposures of these frames that the windows of all exposures meanwhile cover.
    fn covered(&self, tied: &[(&FrameEvidence, usize)], window_us: impl Fn(&Shot) -> i64) -> Option<f64> {
        let from_us = tied.iter().map(|(_, at)| self.shots.get(*at).start_us).min()?;
        let to_us = tied.iter().map(|(_, at)| self.shots.get(*at).end_us).max()?;
        let windows_us: f64 = self.shots.touching(from_us, to_us).map(|at| window_us(&self.shots.get(at)) as f64).sum();
        Some(windows_us / to_us.saturating_sub(from_us) as f64)
    }

    /// Whether the exposures of these frames follow each other too evenly to tell anything, frames fitting one within `wide_us` beside its length.
    fn is_too_even(&self, tied: &[(&FrameEvidence, usize)], wide_us: i64) -> bool {
        let begins_us: Vec<i64> = (0..self.shots.len()).map(|at| self.shots.get(at).start_us).collect();
        let own = tied.iter().map(|(_, at)| self.shots.get(*at));
        let longest_us = own.clone().map(|shot| shot.end_us.saturating_sub(shot.start_us)).max().unwrap_or(0);
        let own_us: Vec<i64> = own.map(|shot| shot.start_us).collect();
        are_too_even(&own_us, &begins_us, wide_us.saturating_add(longest_us))
    }

    /// Frames whose stamps name their exposures by a clock that all have in common, or by a few where it was set.
    fn fit_by_stamps(&self) -> Option<Fit> {
        let clock = self.clock()?;
        let mut tied = self.sharply_tied();
        tied.retain(|(said, at)| self.pair(said, *at).is_some_and(|pair| self.allowed(&pair)));
        let resolution_us = tied.iter().map(|(said, _)| self.resolution_us(said)).max()?;
        let either_way_us = SCATTER_US.saturating_add(clock.uncertainty_us);
        let wide_us = resolution_us.saturating_add(either_way_us.saturating_mul(2));
        if self.is_too_even(&tied, wide_us) {
            return None;
        }
        let share = self.covered(&tied, |shot| shot.end_us.saturating_sub(shot.start_us).saturating_add(wide_us))?;
        let frames = self.frames_of_their_own();
        let readings = self.shots.len().saturating_mul(frames);
        Some(Fit { fitting: tied.len(), frames, share, fitted: self.known_offsets().count(), readings })
    }

    /// Frames that came about as long after their exposures as the others did.
    fn fit_by_delays(&self) -> Option<Fit> {
        let mut tied = self.sharply_tied();
        let delay_us = |said: &FrameEvidence, at: usize| {
            said.arrival_us.map(|arrival_us| arrival_us.saturating_sub(self.shots.get(at).end_us))
        };
        let usual_us = usual_us_of(tied.iter().filter_map(|(said, at)| delay_us(said, *at)).collect())?;
        tied.retain(|(said, at)| delay_us(said, *at).is_some_and(|us| usual_us.contains(&us)));
        let wide_us = usual_us.end().saturating_sub(*usual_us.start());
        if self.is_too_even(&tied, wide_us) {
            return None;
        }
        let share = self.covered(&tied, |_| wide_us)?;
        let frames = self.frames_of_their_own();
        // The shortest delay and the longest.
        Some(Fit { fitting: tied.len(), frames, share, fitted: 2, readings: tied.len() })
    }
}

/// Whether over half of `own_us` come to lie on `all_us` as well, within `wide_us`, if they are all moved by as much.
fn are_too_even(own_us: &[i64], all_us: &[i64], wide_us: i64) -> bool {
    let apart_us = own_us.iter().flat_map(|own_us| all_us.iter().map(move |us| us.saturating_sub(*own_us)));
    let mut apart_us: Vec<i64> = apart_us.filter(|us| us.saturating_abs() > wide_us).collect();
    apart_us.sort_unstable();
    let most = own_us.len() / 2 + 1;
    apart_us.windows(most).any(|apart_us| apart_us[most - 1].saturating_sub(apart_us[0]) <= wide_us)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_that_fit_narrow_windows_are_no_accident_and_few_or_a_part_may_be() {
        let fit = |fitting: usize, frames: usize, share: f64| Fit { fitting, frames, share, fitted: 1, readings: 100 };
        let cases = [
            (fit(12, 12, 0.1), true),
            // 8 ln 0.1 + ln 100 = -13.8, short of ln 5e-7 = -14.5.
            (fit(9, 9, 0.1), false),
            // C(24, 12) is 2.7 million.
            (fit(12, 24, 0.1), false),
            (fit(12, 14, 0.1), true),
            // Windows that cover half of the time, or all of it, tell less, or nothing.
            (fit(12, 12, 0.5), false),
            (fit(40, 40, 0.5), true),
            (fit(400, 400, 1.0), false),
            (fit(400, 400, 3.0), false),
            (fit(400, 400, f64::NAN), false),
            (fit(0, 0, 0.1), false),
        ];
        for (fit, expected) in cases {
            assert_eq!(fit.is_no_accident(), expected, "{fit:?}: {}", fit.log_chance());
        }
        assert!((fit(3, 5, 0.5).log_chance() - (10.0 * 0.25 * 100.0_f64).ln()).abs() < 1e-12);
    }

    #[test]
    fn a_rhythm_fits_itself_moved_by_a_beat_and_irregular_times_do_not() {
        let even: Vec<i64> = (0..12).map(|n| 10_000_000 * n).collect();
        assert!(are_too_even(&even, &even, 300_000));
        // Every other one of them, and beats that are off by less than the window.
        let every_other: Vec<i64> = even.iter().step_by(2).copied().collect();
        assert!(are_too_even(&every_other, &even, 300_000));
        let nearly: Vec<i64> = (0..12).map(|n| 10_000_000 * n + 20_000 * (n * n % 7)).collect();
        assert!(are_too_even(&nearly, &nearly, 300_000) && !are_too_even(&nearly, &nearly, 20_000));
        let slower: Vec<i64> = (0..12).map(|n| 17_000_000 * n + 140_000 * n * n).collect();
        assert!(!are_too_even(&slower, &slower, 400_000));
        assert!(!are_too_even(&[], &even, 300_000));
    }
}

//! Rivals of a match: those that share shadows with it, and why those that were found on the way do not stand.

use super::case::Case;
use super::explained::{Reading, Rejected};
use super::propose::Candidate;
use super::search::{BUDGET, Hypothesis, Search};
use super::settle::Settled;
use super::verdict::MOST_CHANCE;
use crate::beads::Detection;
use crate::geometry::Rigid;

/// Beads of a rival that is sought among all shadows: with fewer, accident is one.
const FEWEST: usize = 5;
/// Poses from three points that are tried: all triples of shadows that the match leaves, as many as for a second reading, and those of its own.
const MOST: u64 = BUDGET + BUDGET / 8;
/// Rivals that are told of.
const TOLD: usize = 3;

impl Case<'_> {
    /// Matches elsewhere that explain as many beads as the candidate, but for one, far beyond accident, whichever shadows they take.
    ///
    /// Of a rival's five shadows or more three are the candidate's, or three are not: triples of either kind, each verified on all shadows, miss
    /// none. What lies so close to one of the candidate's shadows that it may be the same is in no triple.
    pub(super) fn sharing(&self, candidate: &Candidate, settled: &Settled) -> Vec<Hypothesis> {
        let (own, k) = (&candidate.hypothesis, &candidate.intrinsics);
        let taken = |n: usize| own.matches.iter().any(|m| m.detection == n);
        let close = |d: &Detection| own.matches.iter().any(|m| m.image_px.distance(d.image_px) < (0.7 * d.radius_px).max(1.5));
        let group = |(n, shadow): (usize, &Detection)| match (taken(n), close(shadow)) {
            (true, _) => Some(0),
            (false, true) => None,
            (false, false) => Some(1),
        };
        let groups: Vec<Option<usize>> = self.detections.iter().enumerate().map(group).collect();
        // Without others, all orders of its own shadows have been tried.
        if own.matches.len() < FEWEST || !groups.contains(&Some(1)) {
            return Vec::new();
        }
        let targets = self.targets();
        let gate = self.request.prior.filter(|_| !self.without_prior).map(|prior| self.gate(prior));
        let search = Search {
            groups,
            fewest: (own.matches.len() - 1).max(FEWEST),
            budget: MOST,
            slack_px: self.slack_px(),
            ..self.search(&targets, self.detections, Some, k, gate)
        };
        let found = search.run(|_, _| false);
        let is_rival = |other: &Hypothesis| {
            self.is_elsewhere(&other.camera_from_lps, settled) && self.chance_of(other, found.tried) < MOST_CHANCE
        };
        found.hypotheses.into_iter().filter(is_rival).collect()
    }

    /// Keeps why the best of the other matches that were found on the way do not stand.
    pub(super) fn hear_others(&self, candidate: &Candidate, settled: &Settled) {
        let (best, own) = (&candidate.hypothesis, &settled.solution.camera_from_lps);
        let mut told: Vec<&Hypothesis> = Vec::new();
        for other in &candidate.others {
            let is_known = |known: &&Hypothesis| self.is_one(&known.camera_from_lps, &other.camera_from_lps);
            if told.len() == TOLD || !self.is_elsewhere(&other.camera_from_lps, settled) || told.iter().any(is_known) {
                continue;
            }
            told.push(other);
            let (matched, against) = (other.matches.len(), best.matches.len());
            let why = match self.excluded(&other.camera_from_lps) {
                Some(why) => why,
                None if matched < against => Rejected::FewerBeads { against },
                None => Rejected::FitsWorse { chi2_more: other.score - best.score },
            };
            self.hear(Reading::OtherMatch, Some((&other.camera_from_lps, matched, other.rms_px)), own, why);
        }
        if told.is_empty() {
            self.hear(Reading::OtherMatch, None, own, Rejected::NotFound);
        }
    }

    /// That the prior, if it holds, says that a pose cannot be.
    pub(super) fn excluded(&self, pose: &Rigid) -> Option<Rejected> {
        let (squares, limit) = self.off_prior(pose).filter(|(squares, limit)| !(squares <= limit))?;
        Some(Rejected::OutsidePrior { sigmas: squares.sqrt(), limit: limit.sqrt() })
    }
}

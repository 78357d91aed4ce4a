//! The match that explains most of the frame, and what else was found on the way.

use super::case::Case;
use super::gate::{Gate, information_about_each};
use super::prior::Prior;
use super::search::{Found, Hypothesis, Search};
use super::solve::{Free, Match, Options, Solution, solve};
use super::transform;
use super::verdict::MOST_CHANCE;
use crate::beads::Detection;
use crate::geometry::{Intrinsics, Rigid};

/// Focal lengths tried when K is unknown, in frame widths.
const FOCAL_GUESSES: [f64; 6] = [1.6, 2.3, 3.3, 4.7, 6.7, 9.5];
/// How far a guessed K may put a bead off, px in a frame of 620, and a solved one.
const GUESS_SLACK_PX: (f64, f64) = (6.0, 1.0);

/// Standard deviations of a prior while K is a guess: turn (rad), across (mm), along the beam as a share of the depth; and the squared
/// deviation from it.
const GUESS_SIGMA: (f64, f64, f64) = (8.0 * std::f64::consts::PI / 180.0, 30.0, 0.3);
const GUESS_LIMIT: f64 = 20.0;

/// Poses from three points in a search whose result others judge.
const ROUGH_BUDGET: u64 = 400_000;

/// A match with what the search knows of it.
pub(super) struct Candidate {
    pub hypothesis: Hypothesis,
    pub others: Vec<Hypothesis>,
    pub intrinsics: Intrinsics,
    pub tried: u64,
}

impl Case<'_> {
    /// The best match, near `prior` if there is one.
    pub fn propose(&self, prior: Option<&Prior>) -> Option<Candidate> {
        match self.request.intrinsics {
            Some(k) => self.find(&k, self.slack_px(), prior.map(|prior| self.gate(prior))),
            // What fits near the prior goes before what fits better elsewhere.
            None => {
                prior.and_then(|prior| self.find_without_intrinsics(Some(prior))).or_else(|| self.find_without_intrinsics(None))
            }
        }
    }

    /// How far K's own uncertainty may put a bead off beyond what turn, shift and depth make up for: three σ of the focal length act on
    /// differences of depth, a tenth of the depth or so.
    pub(super) fn slack_px(&self) -> f64 {
        let [width, height] = self.request.size_px.map(f64::from);
        let relative = self.request.intrinsics_prior.map_or(0.0, |prior| prior.focal_sigma_px / prior.mean.fx);
        3.0 * relative * 0.1 * 0.5 * width.hypot(height)
    }

    /// Whether a match is so far beyond chance that no other is looked for.
    fn is_enough(&self, best: &Hypothesis, tried: u64) -> bool {
        let count = best.matches.len();
        count >= 5 && 10 * count >= 7 * best.in_view && self.chance_of(best, tried) < 1e-6
    }

    /// The best match, or the least accidental one where the best would be refused as an accident: few beads in view that fit so-so do not
    /// hide many of which some are not seen.
    fn first_worth_judging(&self, hypotheses: &[Hypothesis], tried: u64) -> Option<usize> {
        let chance = |n: &usize| self.chance_of(&hypotheses[*n], tried);
        let best = (!hypotheses.is_empty()).then_some(0)?;
        if chance(&best) <= MOST_CHANCE {
            Some(best)
        } else {
            (0..hypotheses.len()).min_by(|a, b| chance(a).total_cmp(&chance(b)))
        }
    }

    /// The pose of the best match that a short search finds, near the prior if there is one; K is known. Nobody has judged it.
    pub fn rough_pose(&self) -> Option<Rigid> {
        let k = self.request.intrinsics?;
        let targets = self.targets();
        let gate = self.request.prior.map(|prior| self.gate(prior));
        let search = Search {
            budget: ROUGH_BUDGET,
            barred: self.barred.clone(),
            ..self.search(&targets, self.detections, Some, &k, gate)
        };
        let found = search.run(|best, tried| self.is_enough(best, tried));
        found.hypotheses.first().map(|best| best.camera_from_lps)
    }

    fn find(&self, k: &Intrinsics, slack_px: f64, gate: Option<Gate>) -> Option<Candidate> {
        let targets = self.targets();
        let search = Search { slack_px, barred: self.barred.clone(), ..self.search(&targets, self.detections, Some, k, gate) };
        let Found { hypotheses: mut others, tried, .. } = search.run(|best, tried| self.is_enough(best, tried));
        let best = others.remove(self.first_worth_judging(&others, tried)?);
        // The shadows of the best match against every other order of beads: symmetric layouts show here.
        let matched: Vec<Detection> = best.matches.iter().map(|m| self.detections[m.detection]).collect();
        let own = |n: usize| best.matches.get(n).map(|m| m.detection);
        let narrow = Search { slack_px, ..self.search(&targets, &matched, own, k, gate) };
        for mut other in narrow.run(|_, _| false).hypotheses {
            for m in &mut other.matches {
                m.detection = best.matches[m.detection].detection;
            }
            others.push(other);
        }
        Some(Candidate { hypothesis: best, others, intrinsics: *k, tried })
    }

    /// K unknown: a few focal lengths with the principal point in the middle are close enough to find the match.
    fn find_without_intrinsics(&self, prior: Option<&Prior>) -> Option<Candidate> {
        let gate = prior.map(|prior| {
            let centre = prior.camera_from_lps.transform_point(self.request.layout.centroid_lps_mm());
            let information =
                information_about_each(centre, GUESS_SIGMA.0, [GUESS_SIGMA.1, GUESS_SIGMA.1, GUESS_SIGMA.2 * centre.z]);
            Gate { camera_from_lps: prior.camera_from_lps, information, limit: GUESS_LIMIT }
        });
        let [width, height] = self.request.size_px.map(f64::from);
        let mut best: Option<Candidate> = None;
        let mut tried = 0;
        for guess in FOCAL_GUESSES {
            let fx = guess * width.max(height);
            let k = Intrinsics { fx, fy: fx, skew: 0.0, cx: 0.5 * (width - 1.0), cy: 0.5 * (height - 1.0) };
            let Some(mut found) = self.find(&k, GUESS_SLACK_PX.0 * width.max(height) / 620.0, gate) else { continue };
            tried += found.tried;
            let key = |c: &Candidate| (c.hypothesis.matches.len() as f64) * 100.0 - c.hypothesis.rms_px;
            if let Some(solved) = solve_intrinsics(&found.hypothesis.matches, &found.hypothesis.camera_from_lps, &k) {
                found.intrinsics = solved.intrinsics;
                found.hypothesis.camera_from_lps = solved.camera_from_lps;
                let mean = solved.residuals_px.iter().map(|r| r.length_squared()).sum::<f64>() / solved.residuals_px.len() as f64;
                found.hypothesis.rms_px = mean.sqrt();
                found.hypothesis.roundness = solved.roundness(&found.hypothesis.matches);
                if best.as_ref().is_none_or(|b| key(&found) > key(b)) {
                    best = Some(found);
                }
            }
        }
        let mut best = best?;
        best.tried = tried;
        // With K near the truth, the beads that the guess put too far off are found as well.
        if let Some(again) = self.find(&best.intrinsics, GUESS_SLACK_PX.1, gate)
            && again.hypothesis.matches.len() >= best.hypothesis.matches.len()
        {
            best = Candidate { tried: tried + again.tried, ..again };
        }
        Some(best)
    }
}

fn solve_intrinsics(matches: &[Match], pose: &Rigid, k: &Intrinsics) -> Option<Solution> {
    if matches.len() < 6 {
        return None;
    }
    let options = Options { loss: 3.0, iterations: 60, ..Options::least_squares(Free::Square) };
    let direct = transform::direct(matches).map(|(found, pose)| {
        let f = 0.5 * (found.fx + found.fy);
        (pose, Intrinsics { fx: f, fy: f, skew: 0.0, cx: found.cx, cy: found.cy })
    });
    let total = |s: &Solution| s.chi2.iter().map(|c| c.min(50.0)).sum::<f64>();
    [Some((*pose, *k)), direct]
        .into_iter()
        .flatten()
        .filter_map(|(pose, k)| solve(matches, &pose, &k, &options))
        .min_by(|a, b| total(a).total_cmp(&total(b)))
}

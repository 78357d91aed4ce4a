//! The pose of a match: solved from every start there is, freed of beads that do not fit.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, Vector2};

use super::case::Case;
use super::propose::Candidate;
use super::search::MISSED;
use super::solve::{Match, Measured, Options, Solution, image_spread, left_out, solve};
use super::start;

/// Squared residual (in standard deviations, two degrees of freedom) beyond which a bead is left out.
const OUTLIER: f64 = 25.0;
/// From so many beads on, their own residuals say how well they stand, down to a share of the stated variance.
const AGREEING: usize = 7;
const SHARPEST: f64 = 0.02;
/// The lower three quarters of residuals that a pose was fitted to are smaller than all of them.
const AGREED: f64 = 2.5;

/// χ² per degree of freedom beyond which few beads may follow one that has moved, and up to which the others agree.
const DISAGREE: f64 = 2.5;
const AGREE: f64 = 1.5;

/// Two shadows run into one when their centres are closer than this share of both radii.
const OVERLAPPING: f64 = 0.9;

/// A solved match.
pub(super) struct Settled {
    pub solution: Solution,
    pub matches: Vec<Match>,
    /// Outliers, and how far off they are.
    pub left_out: Vec<(Match, DVec2)>,
    /// Shadows into which another bead's runs that has none of its own, and that bead: their centres are nobody's, and the pose rests on them only
    /// for want of others.
    pub merged: Vec<(Match, usize)>,
    pub chi2_per_dof: f64,
    /// How the solution was asked for, priors among it.
    pub options: Options,
}

impl Settled {
    /// Matched beads, outliers and merged ones: all whose shadow is known, some twice.
    pub fn known(&self) -> impl Iterator<Item = &Match> {
        self.matches.iter().chain(self.left_out.iter().map(|(m, _)| m)).chain(self.merged.iter().map(|(m, _)| m))
    }

    /// √mean(dx² + dy²) of the beads that the pose rests on, px.
    pub fn rms_px(&self) -> f64 {
        self.solution.rms_px()
    }

    /// `off_px`, of a bead that the pose does not rest on, in standard deviations of its place (covariance `place_mm2`), its shadow's
    /// (`noise_px2`: uu, uv, vv) and the prediction's; `covariance` is the solution's, scaled perhaps. `None` behind the source.
    pub fn off_sigmas(
        &self,
        covariance: &DMatrix<f64>,
        (lps_mm, place_mm2): (DVec3, DMat3),
        noise_px2: [f64; 3],
        off_px: DVec2,
    ) -> Option<f64> {
        let Solution { intrinsics, camera_from_lps, .. } = &self.solution;
        let spread = self.solution.sharpness(lps_mm, covariance).image_px2?
            + image_spread(intrinsics, camera_from_lps, lps_mm, &place_mm2, noise_px2);
        let off = Vector2::new(off_px.x, off_px.y);
        Some((off.transpose() * spread.try_inverse()? * off)[(0, 0)].sqrt()).filter(|sigmas| sigmas.is_finite())
    }
}

/// Few beads follow one that has moved, and its own residual hides it: the one without which all others agree, where that is one and no other.
fn the_one_that_moved(matches: &[Match], all: &Solution, plain: &Options, fewest: usize) -> Option<usize> {
    let (total, dof) = (all.chi2.iter().sum::<f64>() + all.prior_chi2, all.degrees_of_freedom as f64);
    // Of five, any one that is left out leaves too little to agree.
    if matches.len() < fewest + 2 || !(total > DISAGREE * dof) {
        return None;
    }
    // χ² falls by as much without a bead as that is off under the others.
    let falls = left_out(matches, all, plain).into_iter().enumerate().filter_map(|(n, out)| Some((out?.chi2, n)));
    let mut falls: Vec<(f64, usize)> = falls.collect();
    falls.sort_by(|a, b| b.0.total_cmp(&a.0));
    let [(most, moved), (next, _), ..] = falls[..] else { return None };
    let per_dof = (total - most) / (dof - 2.0);
    // Others that agree better than they need to leave less room.
    let limit = OUTLIER * per_dof.clamp(0.25, 1.0);
    (per_dof <= AGREE && most > limit && most - next > 0.5 * limit).then_some(moved)
}

impl Case<'_> {
    /// Solves from every start there is, leaves out beads that do not fit, weighs with what is left.
    pub fn settle(&self, candidate: &Candidate) -> Option<Settled> {
        let free = self.request.free();
        let fewest = self.request.fewest();
        let mut matches = candidate.hypothesis.matches.clone();
        if matches.len() < fewest {
            return None;
        }
        let measured = match (self.request.fuse, self.request.prior) {
            (true, Some(prior)) => {
                Some(Measured { camera_from_lps: prior.camera_from_lps, information: self.gate(prior).information })
            }
            _ => None,
        };
        let options = Options { loss: 3.0, measured, ..Options::least_squares(free) };
        let starts = [Some(candidate.hypothesis.camera_from_lps), start::opencv(&matches, &candidate.intrinsics)];
        let total = |s: &Solution| s.chi2.iter().map(|c| c.min(MISSED)).sum::<f64>();
        // What is found near the prior must not be carried away from it by another start.
        let is_kept = |found: &Solution| {
            self.gate_excludes(&candidate.hypothesis.camera_from_lps) || !self.gate_excludes(&found.camera_from_lps)
        };
        let mut best = starts
            .into_iter()
            .flatten()
            .filter_map(|pose| solve(&matches, &pose, &candidate.intrinsics, &options))
            .enumerate()
            .filter(|(start, found)| *start == 0 || is_kept(found))
            .map(|(_, found)| found)
            .min_by(|a, b| total(a).total_cmp(&total(b)))?;
        let mut left_out = Vec::new();
        loop {
            // The scale of what fits: the lower three quarters of the residuals, so that one bead does not excuse itself. Where many agree
            // far better than the layout's stated uncertainty, that uncertainty excuses nobody either.
            let mut sorted = best.chi2.clone();
            sorted.sort_by(f64::total_cmp);
            let kept = (3 * sorted.len()).div_ceil(4);
            let mean = sorted[..kept].iter().sum::<f64>() / kept as f64;
            let least = if matches.len() >= AGREEING { (AGREED * mean).clamp(SHARPEST, 1.0) } else { 1.0 };
            let scale = mean.max(least);
            let (worst, chi2) = best.chi2.iter().copied().enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
            if !(chi2 > OUTLIER * scale) || matches.len() <= fewest {
                break;
            }
            left_out.push((matches.remove(worst), best.residuals_px[worst]));
            best = solve(&matches, &best.camera_from_lps, &best.intrinsics, &options)?;
        }
        let plain = Options { loss: f64::INFINITY, ..options };
        let mut first = solve(&matches, &best.camera_from_lps, &best.intrinsics, &plain)?;
        if let Some(moved) = the_one_that_moved(&matches, &first, &plain, fewest) {
            left_out.push((matches.remove(moved), first.residuals_px[moved]));
            first = solve(&matches, &first.camera_from_lps, &first.intrinsics, &plain)?;
        }
        let merged = self.merged(&matches, &left_out, &first);
        if !merged.is_empty() && matches.len() >= fewest + merged.len() {
            matches.retain(|m| merged.iter().all(|(other, _)| other.bead != m.bead));
            first = solve(&matches, &first.camera_from_lps, &first.intrinsics, &plain)?;
        }
        // A fused prior is an observation like the beads.
        let dof = first.degrees_of_freedom.max(1) as f64;
        let chi2_per_dof = (first.chi2.iter().sum::<f64>() + first.prior_chi2) / dof;
        // Beads that fit better than their stated uncertainty are better than it: weigh them so, but do not claim it.
        let share = chi2_per_dof.sqrt().clamp(0.1, 1.0);
        let solution = if share < 0.8 && dof >= 4.0 {
            let sharper = Options { sigma_mm_share: share, ..plain };
            solve(&matches, &first.camera_from_lps, &first.intrinsics, &sharper).unwrap_or(first)
        } else {
            first
        };
        let left_out = left_out
            .into_iter()
            .map(|(m, _)| {
                let off = m.image_px - solution.intrinsics.project(solution.camera_from_lps.transform_point(m.lps_mm));
                (m, off)
            })
            .collect();
        Some(Settled { solution, matches, left_out, merged, chi2_per_dof, options: plain })
    }

    /// Of the matches those whose shadow, by the pose, is also that of a bead without a shadow of its own, and that bead.
    fn merged(&self, matches: &[Match], left_out: &[(Match, DVec2)], at: &Solution) -> Vec<(Match, usize)> {
        let targets = self.targets();
        let (pose, k) = (at.camera_from_lps, at.intrinsics);
        let own = |bead: usize| matches.iter().chain(left_out.iter().map(|(m, _)| m)).any(|m| m.bead == bead);
        let alone: Vec<(usize, DVec2, Option<f64>)> = (0..targets.len())
            .filter(|bead| !own(*bead))
            .filter_map(|bead| {
                let p = pose.transform_point(targets[bead].lps_mm);
                (p.z > 1.0).then(|| (bead, k.project(p), targets[bead].radius_mm.map(|radius_mm| k.fx * radius_mm / p.z)))
            })
            .filter(|(_, place, _)| self.can_show(*place))
            .collect();
        let merged = |m: &Match| {
            let place = k.project(pose.transform_point(m.lps_mm));
            let radius_px = self.detections[m.detection].radius_px;
            let runs_into = |(bead, other, other_px): &&(usize, DVec2, Option<f64>)| {
                // A bead that is listed twice is one.
                let apart_mm = targets[*bead].lps_mm.distance(m.lps_mm);
                apart_mm > targets[*bead].radius_mm.unwrap_or(1.0)
                    && other.distance(place) < OVERLAPPING * (radius_px + other_px.unwrap_or(radius_px))
            };
            alone.iter().find(runs_into).map(|(bead, ..)| (*m, *bead))
        };
        matches.iter().filter_map(merged).collect()
    }
}

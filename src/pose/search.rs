//! Which shadow is which bead, K known: triples of shadows against triples of beads, counted, refined and scored.
//!
//! Every triple gives up to two poses (`triangle`); a pose is worth what it predicts of the other beads. Triples are taken best shadows
//! first, in batches whose order does not depend on threads, until a match is far beyond chance or the budget is spent.

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use super::bead_triples::{BeadTriples, Windows};
use super::gate::Gate;
use super::side_by_side::Block;
use super::solve::{Free, Match, Options, Solution, solve};
use super::support::Seen;
use super::tables::{Depths, Tables, Target};
use super::triangle::{self, Images};
use crate::beads::Detection;
use crate::geometry::{Intrinsics, Rigid};

/// The task.
pub struct Search<'a> {
    pub targets: &'a [Target],
    pub detections: &'a [Detection],
    pub intrinsics: Intrinsics,
    pub size_px: [u32; 2],
    pub depth_mm: (f64, f64),
    pub gate: Option<Gate>,
    /// Pairs bead × detection that may match, row by row of beads.
    pub allowed: Vec<bool>,
    /// Depths at which the gate lets each bead be.
    pub in_gate: Vec<Depths>,
    /// Bead and shadow that belong together, whatever else seems to fit.
    pub pinned: Vec<(usize, usize)>,
    /// Shadows that are no bead's.
    pub barred: Vec<usize>,
    /// Extra slack where K is only a guess, px.
    pub slack_px: f64,
    /// Poses from three points, at most about so many.
    pub budget: u64,
    /// Shadows by which poses are sought: three of one group, and none of those in no group. Empty: any three.
    pub groups: Vec<Option<usize>>,
    /// Beads that a match must have, four at least.
    pub fewest: usize,
    /// Whether a bead could be seen at a place in the frame.
    pub shows: Box<dyn Fn(DVec2) -> bool + Sync + 'a>,
}

/// A refined match.
#[derive(Clone, Debug)]
pub struct Hypothesis {
    pub camera_from_lps: Rigid,
    pub matches: Vec<Match>,
    pub rms_px: f64,
    /// Area of the ellipses in which its shadows lie, over that of circles of the same mean square.
    pub roundness: f64,
    /// Σ over beads in view of min(χ², `MISSED`): smaller is better.
    pub score: f64,
    /// Beads that the pose puts where the frame could show them.
    pub in_view: usize,
}

/// What the search found.
pub struct Found {
    /// Best first, distinct poses.
    pub hypotheses: Vec<Hypothesis>,
    /// Poses that were verified: the number of chances an accident had.
    pub tried: u64,
    /// The budget ran out before all triples were tried.
    pub cut_short: bool,
}

/// Cost of a bead in view without a shadow (two degrees of freedom: beyond all noise).
pub const MISSED: f64 = 30.0;
/// Poses from three points allowed in one search.
pub const BUDGET: u64 = 3_000_000;
/// A gate is so much wider for poses from three points.
pub const ROUGH_GATE: f64 = 1.5;
/// Beads that a match has at least: three make a pose.
pub const FEWEST: usize = 4;
/// The others' noise moves a pose as well: a shadow is looked for as if the place of its bead were known no better than so, as a share of the
/// direction in which it is known worst.
const LEAST_SHARE: f64 = 0.5;
const BATCH: usize = 48;
const KEPT_PER_BATCH: usize = 40;
const KEPT_PER_TRIPLE: usize = 12;

struct Raw {
    pose: Rigid,
    worth: f64,
    order: (usize, usize),
}

impl Search<'_> {
    /// Runs the search over all detections, stopping early once `enough` says so of the best hypothesis so far.
    pub fn run(&self, enough: impl Fn(&Hypothesis, u64) -> bool) -> Found {
        let triples = self.triples();
        let widest_px = self.targets.iter().map(|target| self.reach_px(target, self.depth_mm.0)).fold(0.0, f64::max);
        let tables = Tables::new(self.targets, self.detections, &self.intrinsics, widest_px, &self.in_gate, |bead, n| {
            self.may_pair(bead, n)
        });
        let mut best: Vec<Hypothesis> = Vec::new();
        let (mut tried, mut solved, mut cut_short) = (0u64, 0u64, false);
        for (batch, chunk) in triples.chunks(BATCH).enumerate() {
            let first = batch * BATCH;
            let results: Vec<(Vec<Raw>, u64, u64)> = chunk
                .par_iter()
                .enumerate()
                .map_init(Block::new, |block, (n, triple)| self.try_triple(first + n, *triple, &tables, block))
                .collect();
            let mut raws: Vec<Raw> = Vec::new();
            for (list, verified, count) in results {
                raws.extend(list);
                tried += verified;
                solved += count;
            }
            raws.sort_by(|a, b| b.worth.total_cmp(&a.worth).then(a.order.cmp(&b.order)));
            raws.truncate(KEPT_PER_BATCH);
            let refined: Vec<Hypothesis> = raws.par_iter().filter_map(|raw| self.refine(&raw.pose, &tables)).collect();
            best.extend(refined);
            best = distinct(best);
            best.truncate(60);
            let spent = solved > self.budget;
            cut_short = spent && (batch + 1) * BATCH < triples.len();
            if best.first().is_some_and(|first| enough(first, tried)) || spent {
                break;
            }
        }
        Found { hypotheses: best, tried, cut_short }
    }

    /// How far from where a pose from three shadows puts a bead its shadow may be: errors of three shadows and three beads, extrapolated.
    fn reach_px(&self, target: &Target, depth_mm: f64) -> f64 {
        4.0 + self.slack_px + 8.0 * target.sigma_mm * self.intrinsics.fx / depth_mm
    }

    /// Whether a bead and a shadow may belong together by what a person has pinned.
    fn may_pair(&self, bead: usize, detection: usize) -> bool {
        !self.barred.contains(&detection) && self.pinned.iter().all(|(b, d)| (*b == bead) == (*d == detection))
    }

    /// Whether two shadows may be of one triple.
    fn go_together(&self, a: usize, b: usize) -> bool {
        self.groups.is_empty() || self.groups[a].is_some() && self.groups[a] == self.groups[b]
    }

    /// Index triples of detections, best first.
    fn triples(&self) -> Vec<[usize; 3]> {
        let count = self.detections.len();
        let mut triples = Vec::new();
        for c in 2..count {
            for b in (1..c).filter(|b| self.go_together(*b, c)) {
                for a in (0..b).filter(|a| self.go_together(*a, b)) {
                    triples.push([a, b, c]);
                }
            }
        }
        // Detections come best first; a triple is as good as its ranks.
        triples.sort_by_key(|t| (t[2], t[0] + t[1]));
        triples
    }

    fn try_triple(&self, number: usize, triple: [usize; 3], tables: &Tables, block: &mut Block) -> (Vec<Raw>, u64, u64) {
        let images = Images::new(triple.map(|n| tables.rays[n]));
        let apart = images.squares_apart();
        let longest = apart[0].max(apart[1]).max(apart[2]);
        // Three shadows in a row or close together say little about the rest.
        if !(longest * self.intrinsics.fx.powi(2) > 15.0 * 15.0 && images.twice_area() > 0.03 * longest) {
            return (Vec::new(), 0, 0);
        }
        let (near, far) = self.depth_mm;
        let least_mm2 = apart.map(|square| square * (0.97 * near).powi(2));
        let allowed =
            |bead: usize, n: usize| self.allowed[bead * self.detections.len() + triple[n]] && self.may_pair(bead, triple[n]);
        let open = [0, 1, 2].map(|n| (0..self.targets.len()).map(|bead| allowed(bead, n)).collect::<Vec<bool>>());
        let windows = Windows::new(&open, |bead, n| {
            let own = tables.in_gate(bead, triple[n]);
            if n == 0 { own.both(Depths { near, far }) } else { own }
        });
        let pose = |beads: [usize; 3], depths_mm: [f64; 3]| {
            triangle::pose(&beads.map(|bead| self.targets[bead].lps_mm), &images, depths_mm)
        };
        let seen = Seen { targets: self.targets, images: &images, intrinsics: &self.intrinsics, shadows: &tables.shadows };
        let (mut best, mut given, mut tried): (Vec<Raw>, _, _) = (Vec::new(), 0, 0u64);
        let mut verify = |block: &mut Block| {
            block.solve(&images, &windows);
            if self.gate.is_some() {
                block.retain(|beads, depths_mm| pose(beads, depths_mm).is_some_and(|pose| self.inside_gate(&pose, ROUGH_GATE)));
            }
            tried += block.solved() as u64;
            // A bead's agreement is worth 1 at most: with fewer none comes before the last of those that are kept.
            let last = best.get(KEPT_PER_TRIPLE - 1).map_or(0, |last| last.worth as usize + 1);
            block.each_supported(&seen, last.max(self.fewest_others()), |beads, depths_mm| {
                let points = beads.map(|bead| self.targets[bead].lps_mm);
                let at = triangle::turn_and_shift(&points, &images, depths_mm);
                given += 1;
                if let Some(worth) = self.support(&at, beads, triple, depths_mm[0], tables) {
                    let place = best.partition_point(|raw| raw.worth >= worth);
                    if place < KEPT_PER_TRIPLE
                        && let Some(pose) = pose(beads, depths_mm)
                    {
                        best.insert(place, Raw { pose, worth, order: (number, given) });
                        best.truncate(KEPT_PER_TRIPLE);
                    }
                }
            });
            block.clear();
        };
        block.clear();
        let solved = BeadTriples::new(tables, &images, &open, least_mm2, &windows).each(|beads, squares_mm2| {
            block.push(beads, squares_mm2);
            if block.is_full() {
                verify(block);
            }
        });
        verify(block);
        (best, tried, solved)
    }

    /// Beads that must agree with a pose from three others.
    fn fewest_others(&self) -> usize {
        self.fewest.min(self.targets.len()).saturating_sub(3).max(1)
    }

    /// Whether the pose is inside the gate, widened by `factor`.
    fn inside_gate(&self, pose: &Rigid, factor: f64) -> bool {
        self.gate.as_ref().is_none_or(|gate| gate.squares(pose) <= gate.limit * factor)
    }

    /// Worth of the other beads' agreement with a turn and shift; `None` when too few agree.
    fn support(
        &self,
        (turn, shift_mm): &(DMat3, DVec3),
        beads: [usize; 3],
        triple: [usize; 3],
        depth_mm: f64,
        tables: &Tables,
    ) -> Option<f64> {
        let (mut worth, mut agreeing) = (0.0, 0);
        for (bead, target) in self.targets.iter().enumerate() {
            if beads.contains(&bead) {
                continue;
            }
            let p = *turn * target.lps_mm + *shift_mm;
            if !(p.z > 1.0) {
                return None;
            }
            let at = self.intrinsics.project(p);
            let limit = self.reach_px(target, depth_mm);
            let mut nearest = limit * limit;
            for &n in tables.shadows.near(at) {
                let d2 = self.detections[n].image_px.distance_squared(at);
                if d2 < nearest && !triple.contains(&n) && tables.radius_fits(bead, n, p.z) {
                    nearest = d2;
                }
            }
            if nearest < limit * limit {
                agreeing += 1;
                worth += 1.0 - 0.5 * nearest / (limit * limit);
            }
        }
        (agreeing >= self.fewest_others()).then_some(worth)
    }

    /// Re-matches and re-solves from a rough pose, tightening.
    fn refine(&self, rough: &Rigid, tables: &Tables) -> Option<Hypothesis> {
        let mut pose = *rough;
        let depth = pose.transform_point(self.targets[0].lps_mm).z.max(1.0);
        let px_per_mm = self.intrinsics.fx / depth;
        let mut matches = Vec::new();
        let mut solution: Option<Solution> = None;
        for factor in [9.0, 5.0, 4.5] {
            matches = self.assign(&pose, tables, |sigma_mm| self.slack_px + (factor * sigma_mm * px_per_mm).max(0.4 * factor));
            if matches.len() < self.fewest {
                return None;
            }
            let options = Options { loss: 3.0, iterations: 12, ..Options::least_squares(Free::Pose) };
            let solved = solve(&matches, &pose, &self.intrinsics, &options)?;
            pose = solved.camera_from_lps;
            solution = Some(solved);
        }
        let solution = solution?;
        if !self.inside_gate(&pose, 1.0) {
            return None;
        }
        let mut score = 0.0;
        let mut in_view = 0;
        for (bead, target) in self.targets.iter().enumerate() {
            let p = pose.transform_point(target.lps_mm);
            let at = self.intrinsics.project(p);
            let margin = 2.0 + target.radius_mm.map_or(4.0, |r| r * px_per_mm);
            let inside = p.z > 1.0
                && at.x > margin
                && at.y > margin
                && at.x < f64::from(self.size_px[0]) - 1.0 - margin
                && at.y < f64::from(self.size_px[1]) - 1.0 - margin
                && (self.shows)(at);
            let matched = matches.iter().position(|m| m.bead == bead);
            in_view += usize::from(inside || matched.is_some());
            score += match matched {
                Some(n) => solution.chi2[n].min(MISSED),
                None if inside => MISSED,
                None => 0.0,
            };
        }
        let (rms_px, roundness) = (solution.rms_px(), solution.roundness(&matches));
        Some(Hypothesis { camera_from_lps: pose, matches, rms_px, roundness, score, in_view })
    }

    /// One-to-one, nearest pairs first, within `limit_px` of a bead's projection, which depends on how well the bead's place is known (mm) along
    /// what would take its image to the shadow.
    fn assign(&self, pose: &Rigid, tables: &Tables, limit_px: impl Fn(f64) -> f64) -> Vec<Match> {
        let lps_from_camera = pose.rotation.inverse();
        let mut pairs = Vec::new();
        for (bead, target) in self.targets.iter().enumerate() {
            let p = pose.transform_point(target.lps_mm);
            if !(p.z > 1.0) {
                continue;
            }
            let at = self.intrinsics.project(p);
            let [by_u, by_v] = self.intrinsics.slopes_px_per_mm(p).map(|row| lps_from_camera * row);
            let widest_px = limit_px(target.sigma_mm);
            for (n, detection) in self.detections.iter().enumerate() {
                let off = detection.image_px - at;
                let distance = off.length();
                // No centre is known 1.5 times worse along one direction than on the mean of two.
                if !(distance < widest_px + 6.0 * detection.sigma_px) || !tables.radius_fits(bead, n, p.z) {
                    continue;
                }
                let along_mm = target.sigma_along_mm(by_u * off.x + by_v * off.y).max(LEAST_SHARE * target.sigma_mm);
                if distance < limit_px(along_mm) + 4.0 * detection.sigma_along_px(off) {
                    pairs.push((distance, bead, n));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
        let mut matches: Vec<Match> = Vec::new();
        for (_, bead, detection) in pairs {
            if matches.iter().any(|m| m.bead == bead || m.detection == detection) {
                continue;
            }
            let (target, found) = (&self.targets[bead], &self.detections[detection]);
            let place = (target.lps_mm, target.place_mm2);
            matches.push(Match::new(bead, place, detection, found, unbiased(&self.intrinsics, found)));
        }
        matches.sort_by_key(|m| m.bead);
        matches
    }
}

/// The projected centre from the centre of the shadow. A sphere off the axis casts an ellipse that is shifted outwards by
/// ⅘ · e · (r/f)², e being the distance from the principal point (‖bias‖ ≈ ⅘ e A/(π f²) with the shadow's area A).
pub fn unbiased(intrinsics: &Intrinsics, found: &Detection) -> DVec2 {
    let principal = DVec2::new(intrinsics.cx, intrinsics.cy);
    found.image_px - 0.8 * (found.image_px - principal) * (found.radius_px / intrinsics.fx).powi(2)
}

/// How far apart two poses put the beads: largest rotation (rad) and shift at the centroid (mm).
pub fn apart(a: &Rigid, b: &Rigid, centroid_lps: DVec3) -> (f64, f64) {
    (a.angle_to_rad(b), a.transform_point(centroid_lps).distance(b.transform_point(centroid_lps)))
}

/// Shadows that both poses take for the same bead.
pub fn shared(a: &Hypothesis, b: &Hypothesis) -> usize {
    a.matches.iter().filter(|m| b.matches.iter().any(|n| n.bead == m.bead && n.detection == m.detection)).count()
}

fn distinct(mut all: Vec<Hypothesis>) -> Vec<Hypothesis> {
    let key = |h: &Hypothesis| -(h.matches.len() as f64) * MISSED + h.score.min(MISSED * h.matches.len() as f64);
    all.sort_by(|a, b| key(a).total_cmp(&key(b)));
    let mut kept: Vec<Hypothesis> = Vec::new();
    for hypothesis in all {
        let centroid = hypothesis.matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / hypothesis.matches.len().max(1) as f64;
        let known = |other: &Hypothesis| {
            let (angle, shift) = apart(&other.camera_from_lps, &hypothesis.camera_from_lps, centroid);
            // The same shadows otherwise named, or other shadows close by, are another reading.
            angle < 0.02 && shift < 10.0 && 2 * shared(other, &hypothesis) > hypothesis.matches.len().min(other.matches.len())
        };
        if !kept.iter().any(known) {
            kept.push(hypothesis);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_search_that_tried_every_triple_is_not_cut_short() {
        let places = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z].map(|p| 60.0 * p);
        let targets = places.map(|lps_mm| Target { lps_mm, sigma_mm: 0.1, place_mm2: DMat3::IDENTITY * 0.01, radius_mm: None });
        let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 255.5, cy: 255.5 };
        let found = |shadows: u32| {
            let at = |n: u32| intrinsics.project(Rigid::translation(DVec3::Z * 700.0).transform_point(places[n as usize % 4]));
            let detections: Vec<Detection> =
                (0..shadows).map(|n| Detection { image_px: at(n), sigma_px: 0.1, ..Detection::default() }).collect();
            let allowed = vec![true; targets.len() * detections.len()];
            let in_gate = vec![Depths::ALL; targets.len()];
            let (size_px, depth_mm) = ([512, 512], (300.0, 1200.0));
            let (gate, pinned, barred, slack_px) = (None, Vec::new(), Vec::new(), 0.0);
            let (targets, detections) = (&targets, &detections);
            Search {
                targets,
                detections,
                intrinsics,
                size_px,
                depth_mm,
                gate,
                allowed,
                in_gate,
                pinned,
                barred,
                slack_px,
                budget: 0,
                groups: Vec::new(),
                fewest: FEWEST,
                shows: Box::new(|_| true),
            }
            .run(|_, _| false)
        };
        // Four triples are one batch, 56 are two.
        assert!(!found(4).cut_short && found(8).cut_short);
    }
}

//! Which shadow is which bead, K known: triples of shadows against triples of beads, counted, refined and scored.
//!
//! Every triple gives up to two poses (`triangle`); a pose is worth what it predicts of the other beads. Triples are taken best shadows
//! first, in batches whose order does not depend on threads, until a match is far beyond chance or the budget is spent.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::gate::Gate;
use super::occupancy::Occupancy;
use super::solve::{Free, Match, Options, Solution, solve};
use super::triangle;
use crate::beads::Detection;
use crate::geometry::{Intrinsics, Rigid};

/// What is known of a bead during the search.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    pub lps_mm: DVec3,
    pub sigma_mm: f64,
    pub radius_mm: Option<f64>,
}

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
    /// Bead and shadow that belong together, whatever else seems to fit.
    pub pinned: Vec<(usize, usize)>,
    /// Extra slack where K is only a guess, px.
    pub slack_px: f64,
    /// Poses from three points, at most about so many.
    pub budget: u64,
}

/// A refined match.
#[derive(Clone, Debug)]
pub struct Hypothesis {
    pub camera_from_lps: Rigid,
    pub matches: Vec<Match>,
    pub rms_px: f64,
    /// Σ over beads in view of min(χ², `MISSED`): smaller is better.
    pub score: f64,
    /// Beads that the pose puts in the frame.
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
const BATCH: usize = 48;
const KEPT_PER_BATCH: usize = 40;
/// Factor by which rough depths may be off: 99 of 100 triangles are off by less even in a box of 180 mm at 450 mm from the source.
pub(super) const ROUGH: f64 = 1.5;

/// What every triple asks, once for all.
struct Tables {
    /// Of the shadows, on the plane z = 1.
    rays: Vec<DVec2>,
    /// Between beads, row by row.
    apart_mm: Vec<f64>,
    shadows: Occupancy,
}

struct Raw {
    pose: Rigid,
    worth: f64,
    order: (usize, usize),
}

impl Search<'_> {
    /// Runs the search over all detections, stopping early once `enough` says so of the best hypothesis so far.
    pub fn run(&self, enough: impl Fn(&Hypothesis, u64) -> bool) -> Found {
        let triples = self.triples();
        let tables = self.tables();
        let mut best: Vec<Hypothesis> = Vec::new();
        let (mut tried, mut solved, mut cut_short) = (0u64, 0u64, false);
        for (batch, chunk) in triples.chunks(BATCH).enumerate() {
            let results: Vec<(Vec<Raw>, u64, u64)> =
                chunk.par_iter().enumerate().map(|(n, triple)| self.try_triple(batch * BATCH + n, *triple, &tables)).collect();
            let mut raws: Vec<Raw> = Vec::new();
            for (list, verified, count) in results {
                raws.extend(list);
                tried += verified;
                solved += count;
            }
            raws.sort_by(|a, b| b.worth.total_cmp(&a.worth).then(a.order.cmp(&b.order)));
            raws.truncate(KEPT_PER_BATCH);
            let refined: Vec<Hypothesis> = raws.par_iter().filter_map(|raw| self.refine(&raw.pose)).collect();
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

    fn tables(&self) -> Tables {
        let ray = |d: &Detection| {
            let p = self.intrinsics.unproject(d.image_px);
            DVec2::new(p.x, p.y)
        };
        let place = |target: &Target| target.lps_mm;
        let apart_mm = self.targets.iter().flat_map(|a| self.targets.iter().map(move |b| place(a).distance(place(b)))).collect();
        let widest_px = self.targets.iter().map(|target| self.reach_px(target, self.depth_mm.0)).fold(0.0, f64::max);
        let rays = self.detections.iter().map(ray).collect();
        Tables { rays, apart_mm, shadows: Occupancy::new(self.detections, widest_px) }
    }

    /// How far from where a pose from three shadows puts a bead its shadow may be: errors of three shadows and three beads, extrapolated.
    fn reach_px(&self, target: &Target, depth_mm: f64) -> f64 {
        4.0 + self.slack_px + 8.0 * target.sigma_mm * self.intrinsics.fx / depth_mm
    }

    /// Whether a bead and a shadow may belong together by what a person has pinned.
    fn may_pair(&self, bead: usize, detection: usize) -> bool {
        self.pinned.iter().all(|(b, d)| (*b == bead) == (*d == detection))
    }

    /// Index triples of detections, best first.
    fn triples(&self) -> Vec<[usize; 3]> {
        let count = self.detections.len();
        let mut triples = Vec::new();
        for c in 2..count {
            for b in 1..c {
                for a in 0..b {
                    triples.push([a, b, c]);
                }
            }
        }
        // Detections come best first; a triple is as good as its ranks.
        triples.sort_by_key(|t| (t[2], t[0] + t[1]));
        triples
    }

    fn try_triple(&self, number: usize, triple: [usize; 3], tables: &Tables) -> (Vec<Raw>, u64, u64) {
        let images = triple.map(|n| tables.rays[n]);
        let (e01, e02, e12) = (images[0].distance(images[1]), images[0].distance(images[2]), images[1].distance(images[2]));
        let area = (images[1] - images[0]).perp_dot(images[2] - images[0]).abs();
        let longest = e01.max(e02).max(e12);
        // Three shadows in a row or close together say little about the rest.
        if !(longest * self.intrinsics.fx > 15.0 && area > 0.03 * longest * longest) {
            return (Vec::new(), 0, 0);
        }
        let near = self.depth_mm.0;
        let fits = |image: f64, world: f64| world >= 0.97 * image * near && world > 0.0;
        let allowed =
            |bead: usize, n: usize| self.allowed[bead * self.detections.len() + triple[n]] && self.may_pair(bead, triple[n]);
        let (mut raws, mut tried, mut solved) = (Vec::new(), 0u64, 0u64);
        let count = self.targets.len();
        let apart_mm = |i: usize, j: usize| tables.apart_mm[i * count + j];
        for i in 0..count {
            if !allowed(i, 0) {
                continue;
            }
            for j in 0..count {
                if j == i || !allowed(j, 1) || !fits(e01, apart_mm(i, j)) {
                    continue;
                }
                for k in 0..count {
                    if k == i || k == j || !fits(e02, apart_mm(i, k)) || !fits(e12, apart_mm(j, k)) || !allowed(k, 2) {
                        continue;
                    }
                    let points = [i, j, k].map(|n| self.targets[n].lps_mm);
                    solved += 1;
                    let beads = [i, j, k];
                    for rough in triangle::rough_depths(&points, &images).into_iter().flatten() {
                        // Far from any depth that counts, exact ones are not computed.
                        if !self.depths_fit(rough, beads, triple, ROUGH) {
                            continue;
                        }
                        let Some(depths) = triangle::depths(&points, &images, rough) else { continue };
                        if !self.depths_fit(depths, beads, triple, 1.0) {
                            continue;
                        }
                        let Some(pose) = triangle::pose(&points, &images, depths).filter(|pose| self.inside_gate(pose, 1.5))
                        else {
                            continue;
                        };
                        let depth = depths[0];
                        tried += 1;
                        if let Some(worth) = self.support(&pose, beads, triple, depth, &tables.shadows) {
                            raws.push(Raw { pose, worth, order: (number, raws.len()) });
                        }
                    }
                }
            }
        }
        raws.sort_by(|a, b| b.worth.total_cmp(&a.worth).then(a.order.cmp(&b.order)));
        raws.truncate(12);
        (raws, tried, solved)
    }

    /// Whether the pose is inside the gate, widened by `factor`.
    fn inside_gate(&self, pose: &Rigid, factor: f64) -> bool {
        self.gate.as_ref().is_none_or(|gate| gate.squares(pose) <= gate.limit * factor)
    }

    /// Whether beads at those depths are within reach and have the radii of their shadows; depths may be off by a factor `rough`.
    fn depths_fit(&self, depths_mm: [f64; 3], beads: [usize; 3], triple: [usize; 3], rough: f64) -> bool {
        let (near, far) = self.depth_mm;
        depths_mm[0] * rough > near
            && depths_mm[0] < far * rough
            && (0..3).all(|n| self.radius_fits(triple[n], beads[n], depths_mm[n], rough))
    }

    /// Whether a shadow has the radius that bead would have there, at a depth that may be off by a factor `rough`.
    fn radius_fits(&self, detection: usize, bead: usize, depth_mm: f64, rough: f64) -> bool {
        let Some(radius_mm) = self.targets[bead].radius_mm else { return true };
        let predicted = self.intrinsics.fx * radius_mm / depth_mm;
        // Blur, clipping and display curves move the fitted radius; a small shadow more than a large one.
        let slack = 0.35 + 0.5 / predicted;
        (self.detections[detection].radius_px / predicted).ln().abs() < slack + rough.ln()
    }

    /// Worth of the other beads' agreement with the pose; `None` when too few agree.
    fn support(&self, pose: &Rigid, beads: [usize; 3], triple: [usize; 3], depth_mm: f64, shadows: &Occupancy) -> Option<f64> {
        let (mut worth, mut agreeing) = (0.0, 0);
        for (bead, target) in self.targets.iter().enumerate() {
            if beads.contains(&bead) {
                continue;
            }
            let p = pose.transform_point(target.lps_mm);
            if !(p.z > 1.0) {
                return None;
            }
            let at = self.intrinsics.project(p);
            if !shadows.may_be_near(at) {
                continue;
            }
            let limit = self.reach_px(target, depth_mm);
            let mut nearest = limit * limit;
            for (n, detection) in self.detections.iter().enumerate() {
                let d2 = detection.image_px.distance_squared(at);
                if d2 < nearest && !triple.contains(&n) && self.may_pair(bead, n) && self.radius_fits(n, bead, p.z, 1.0) {
                    nearest = d2;
                }
            }
            if nearest < limit * limit {
                agreeing += 1;
                worth += 1.0 - 0.5 * nearest / (limit * limit);
            }
        }
        (agreeing >= 1 && agreeing + 3 >= 4.min(self.targets.len())).then_some(worth)
    }

    /// Re-matches and re-solves from a rough pose, tightening.
    pub fn refine(&self, rough: &Rigid) -> Option<Hypothesis> {
        let mut pose = *rough;
        let depth = pose.transform_point(self.targets[0].lps_mm).z.max(1.0);
        let px_per_mm = self.intrinsics.fx / depth;
        let mut matches = Vec::new();
        let mut solution: Option<Solution> = None;
        for factor in [9.0, 5.0, 4.5] {
            matches = self.assign(&pose, |target| self.slack_px + (factor * target.sigma_mm * px_per_mm).max(0.4 * factor));
            if matches.len() < 4 {
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
                && at.y < f64::from(self.size_px[1]) - 1.0 - margin;
            let matched = matches.iter().position(|m| m.bead == bead);
            in_view += usize::from(inside || matched.is_some());
            score += match matched {
                Some(n) => solution.chi2[n].min(MISSED),
                None if inside => MISSED,
                None => 0.0,
            };
        }
        let mean = solution.residuals_px.iter().map(|r| r.length_squared()).sum::<f64>() / matches.len() as f64;
        Some(Hypothesis { camera_from_lps: pose, matches, rms_px: mean.sqrt(), score, in_view })
    }

    /// One-to-one, nearest pairs first, within `limit_px` of a bead's projection.
    fn assign(&self, pose: &Rigid, limit_px: impl Fn(&Target) -> f64) -> Vec<Match> {
        let mut pairs = Vec::new();
        for (bead, target) in self.targets.iter().enumerate() {
            let p = pose.transform_point(target.lps_mm);
            if !(p.z > 1.0) {
                continue;
            }
            let at = self.intrinsics.project(p);
            for (n, detection) in self.detections.iter().enumerate() {
                let distance = detection.image_px.distance(at);
                if distance < limit_px(target) + 4.0 * detection.sigma_px
                    && self.may_pair(bead, n)
                    && self.radius_fits(n, bead, p.z, 1.0)
                {
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
            matches.push(Match {
                bead,
                detection,
                lps_mm: target.lps_mm,
                image_px: unbiased(&self.intrinsics, found),
                sigma_px: found.sigma_px.max(0.003),
                sigma_mm: target.sigma_mm,
            });
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
        let targets = places.map(|lps_mm| Target { lps_mm, sigma_mm: 0.1, radius_mm: None });
        let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 255.5, cy: 255.5 };
        let found = |shadows: u32| {
            let at = |n: u32| intrinsics.project(Rigid::translation(DVec3::Z * 700.0).transform_point(places[n as usize % 4]));
            let detections: Vec<Detection> =
                (0..shadows).map(|n| Detection { image_px: at(n), sigma_px: 0.1, ..Detection::default() }).collect();
            let allowed = vec![true; targets.len() * detections.len()];
            let (size_px, depth_mm) = ([512, 512], (300.0, 1200.0));
            let (gate, pinned, slack_px) = (None, Vec::new(), 0.0);
            let (targets, detections) = (&targets, &detections);
            Search { targets, detections, intrinsics, size_px, depth_mm, gate, allowed, pinned, slack_px, budget: 0 }
                .run(|_, _| false)
        };
        // Four triples are one batch, 56 are two.
        assert!(!found(4).cut_short && found(8).cut_short);
    }
}

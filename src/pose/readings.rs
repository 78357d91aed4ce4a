//! Other readings of the frame than the match: of all its shadows, of those that the match leaves, of its mirror image.

use std::sync::Arc;

use glam::{DVec2, DVec3};

use super::besides::Besides;
use super::case::Case;
use super::doubt::{LEAST_RMS_PX, ORDINARY};
use super::gate::{Gate, information_about};
use super::refusal::{Refusal, Rival};
use super::search::{Found, Hypothesis, Search};
use super::settle::Settled;
use super::solve::Match;
use super::twin::mirrored_k;
use super::verdict::{is_plate, spread};
use crate::beads::Detection;
use crate::geometry::{Intrinsics, Rigid};

/// Accidents expected behind a second reading of the frame, at most, for it to count: it would be accepted by itself.
const RIVAL_CHANCE: f64 = 0.01;
/// The same for shadows that look like beads, close to the pose: fewer could be tried, and each counts.
const NEAR_CHANCE: f64 = 0.05;
/// Close: rotation (rad) and shift (mm) about the beads, and the squared deviation allowed.
const NEAR_SIGMA: (f64, f64) = (3.0 * std::f64::consts::PI / 180.0, 10.0);
const NEAR_LIMIT: f64 = 20.0;
/// So many beads may carry a pose although more than usual are missing.
const SURE_MATCHED: usize = 6;
/// The mirror image must fit so many times as well as noise and bead positions allow.
const MIRROR_FIT: f64 = 2.0;
/// Degrees and millimetres within which two poses are one.
const SAME_POSE: (f64, f64) = (2.0, 15.0);
/// Cosine between a plate's normal and the line of sight below which it is seen from its edge.
const EDGE_ON: f64 = 0.1;
/// Poses from three points that are tried for a mirrored reading, and for a second one, which every acceptance waits for.
const BUDGET: u64 = 400_000;
const MOST: u64 = super::search::BUDGET;

impl Case<'_> {
    /// Whether no other reading of all shadows, wherever it puts the camera, explains as many beads. Where more shadows are left than
    /// matched, all must have been tried.
    pub fn is_best_of_all(&self, last: &Settled, besides: &Besides) -> bool {
        let matched = last.matches.len();
        if matched < SURE_MATCHED || besides.missing.len() >= matched {
            return false;
        }
        let found = self.everywhere(&last.solution.intrinsics);
        if found.cut_short && besides.unexplained.len() > matched {
            return false;
        }
        found.hypotheses.first().is_some_and(|best| !self.is_elsewhere(&best.camera_from_lps, last))
    }

    /// That a pose which the prior excludes explains more of the shadows, or as many with squared standard deviations that are less by
    /// `margin`: of a layout that resembles itself, a prior that is turned finds a wrong match close by.
    pub fn better_elsewhere(&self, last: &Settled, hypothesis: &Hypothesis, margin: f64) -> Option<Refusal> {
        let matched = last.matches.len();
        let found = self.everywhere(&last.solution.intrinsics);
        // Where K is solved as well, squares of another K do not compare.
        let k_known = self.request.intrinsics.is_some();
        let counts = |other: &&Hypothesis| {
            let more = other.matches.len() >= matched + ORDINARY;
            let as_good = k_known && other.matches.len() >= matched && other.score + margin < hypothesis.score;
            (more || as_good)
                && self.is_elsewhere(&other.camera_from_lps, last)
                && self.chance_of(other, found.tried) < RIVAL_CHANCE
        };
        let other = found.hypotheses.iter().find(counts)?;
        let own = (&last.solution.camera_from_lps, matched, last.rms_px());
        Some(self.ambiguous(Rival::OtherNames, own, (&other.camera_from_lps, other.matches.len(), other.rms_px)))
    }

    pub fn is_elsewhere(&self, pose: &Rigid, last: &Settled) -> bool {
        !self.is_one(pose, &last.solution.camera_from_lps)
    }

    /// Whether two poses are one, as far as other readings go.
    pub fn is_one(&self, a: &Rigid, b: &Rigid) -> bool {
        let (angle_deg, shift_mm) = self.distance(a, b);
        angle_deg < SAME_POSE.0 && shift_mm < SAME_POSE.1
    }

    /// The matches of all shadows, wherever they put the camera; sought once.
    fn everywhere(&self, k: &Intrinsics) -> Arc<Found> {
        if let Some((_, found)) = self.everywhere.borrow().as_ref().filter(|(of, _)| of == k) {
            return Arc::clone(found);
        }
        let found = Arc::new(self.search_all(self.detections, Some, k, None));
        *self.everywhere.borrow_mut() = Some((*k, Arc::clone(&found)));
        found
    }

    /// Whether beads that lie in a plane are seen from its other side than `expected` would: the mirror image of a plate, or of its picture, fits
    /// as well as the plate does, from behind.
    pub fn is_seen_from_behind(&self, found: &Hypothesis, expected: &Rigid) -> bool {
        let points: Vec<DVec3> = found.matches.iter().map(|m| m.lps_mm).collect();
        let (extents, normal) = spread(&points);
        let middle = points.iter().copied().sum::<DVec3>() / points.len().max(1) as f64;
        let side = |pose: &Rigid| pose.transform_vector(normal).dot(pose.transform_point(middle).normalize());
        let (found, expected) = (side(&found.camera_from_lps), side(expected));
        is_plate(extents) && found.abs() > EDGE_ON && expected.abs() > EDGE_ON && found * expected < 0.0
    }

    /// A match of the shadows that are left, far beyond chance: the layout, or one like it, stands in the frame a second time. And whether
    /// not all of them could be tried; those that look `alike` are tried first.
    pub fn second_reading(&self, last: &Settled, alike: &[usize]) -> (Option<Hypothesis>, bool) {
        let near = |d: &Detection| last.matches.iter().any(|m| m.image_px.distance(d.image_px) < (0.7 * d.radius_px).max(1.5));
        let mut left: Vec<usize> = (0..self.detections.len()).filter(|n| !near(&self.detections[*n])).collect();
        // What looks like the beads of the match is tried first.
        left.sort_by_key(|n| !alike.contains(n));
        let shadows: Vec<Detection> = left.iter().map(|n| self.detections[*n]).collect();
        self.reading_within(MOST, &shadows, |n| left.get(n).copied(), &last.solution.intrinsics, true)
    }

    /// The best match, close to the pose, of shadows that look like beads and belong to none.
    pub fn second_near(&self, last: &Settled, unexplained: &[usize]) -> Option<Hypothesis> {
        if unexplained.len() < 4 {
            return None;
        }
        let shadows: Vec<Detection> = unexplained.iter().map(|n| self.detections[*n]).collect();
        let camera_from_lps = last.solution.camera_from_lps;
        let information = information_about(last.solution.centroid_mm, NEAR_SIGMA.0, NEAR_SIGMA.1);
        let gate = Gate { camera_from_lps, information, limit: NEAR_LIMIT };
        let own = |n: usize| unexplained.get(n).copied();
        let found = self.search_all(&shadows, own, &last.solution.intrinsics, Some(gate));
        let best = found.hypotheses.into_iter().next()?;
        (self.chance_among(&best, found.tried, &shadows) < NEAR_CHANCE).then_some(best)
    }

    /// That the layout fits the frame's mirror image as well as beads should, with at least two beads more than the `matched` of the frame
    /// itself, or with as many far better than their `rms_px`; and the frame itself nowhere as well.
    pub fn mirrored(&self, k: &Intrinsics, matched: usize, rms_px: Option<f64>) -> Option<Refusal> {
        let (shadows, mirrored_k) = self.mirror_image(k);
        let found = self.reading(&shadows, Some, &mirrored_k, false)?;
        let mirrored = found.matches.len();
        let depth_mm = found.camera_from_lps.transform_point(self.request.layout.centroid_lps_mm()).z;
        let turn = found.camera_from_lps.rotation_matrix();
        // Variances along columns and rows together.
        let allowed_px = |m: &Match| {
            let in_camera = turn * m.place_mm2 * turn.transpose();
            (in_camera.x_axis.x + in_camera.y_axis.y) * (k.fx / depth_mm).powi(2) + m.noise_px2[0] + m.noise_px2[2]
        };
        let allowed_px = (found.matches.iter().map(allowed_px).sum::<f64>() / mirrored as f64).sqrt();
        let far_better = |rms_px: f64| mirrored >= matched && MIRROR_FIT * found.rms_px < rms_px;
        if !(found.rms_px <= (MIRROR_FIT * allowed_px).max(LEAST_RMS_PX))
            || !(mirrored >= matched + 2 || rms_px.is_some_and(far_better))
        {
            return None;
        }
        let itself = &self.everywhere(k).hypotheses;
        let as_well = itself
            .first()
            .is_some_and(|itself| itself.matches.len() + 1 >= mirrored && itself.rms_px < MIRROR_FIT * found.rms_px);
        (!as_well).then_some(Refusal::Mirrored { mirrored, rms_px: found.rms_px, matched })
    }

    /// That the mirror image fits near the prior, where the frame itself does not, with at least the `matched` beads that it has elsewhere: a
    /// flat layout is seen as well from behind.
    pub fn mirrored_near(&self, matched: usize) -> Option<Refusal> {
        let (shadows, mirrored_k) = self.mirror_image(&self.request.intrinsics?);
        let found = self.reading(&shadows, Some, &mirrored_k, true)?;
        let mirrored = found.matches.len();
        (mirrored >= matched).then_some(Refusal::Mirrored { mirrored, rms_px: found.rms_px, matched })
    }

    /// The shadows in the frame's mirror image, and its K.
    fn mirror_image(&self, k: &Intrinsics) -> (Vec<Detection>, Intrinsics) {
        let end = f64::from(self.request.size_px[0]) - 1.0;
        let turned = |d: &Detection| {
            let [[uu, uv], [vu, vv]] = d.covariance_px2;
            Detection { image_px: DVec2::new(end - d.image_px.x, d.image_px.y), covariance_px2: [[uu, -uv], [-vu, vv]], ..*d }
        };
        (self.detections.iter().map(turned).collect(), mirrored_k(k, end))
    }

    /// The best match of `shadows`, if it is beyond chance; `own` tells which each is among all.
    fn reading(
        &self,
        shadows: &[Detection],
        own: impl Fn(usize) -> Option<usize>,
        k: &Intrinsics,
        gated: bool,
    ) -> Option<Hypothesis> {
        self.reading_within(BUDGET, shadows, own, k, gated).0
    }

    /// The same after `budget` poses from three points at most, and whether that was too few to try all.
    fn reading_within(
        &self,
        budget: u64,
        shadows: &[Detection],
        own: impl Fn(usize) -> Option<usize>,
        k: &Intrinsics,
        gated: bool,
    ) -> (Option<Hypothesis>, bool) {
        if shadows.len() < 4 {
            return (None, false);
        }
        let targets = self.targets();
        let gate = self.request.prior.filter(|_| gated && !self.without_prior).map(|prior| self.gate(prior));
        let search = Search { budget, ..self.search(&targets, shadows, own, k, gate) };
        let accident = |found: &Hypothesis, tried: u64| self.chance_among(found, tried, shadows);
        let found = search.run(|best, tried| accident(best, tried) < 0.1 * RIVAL_CHANCE);
        let best = found.hypotheses.into_iter().find(|hypothesis| accident(hypothesis, found.tried) < RIVAL_CHANCE);
        (best, found.cut_short)
    }

    /// The matches of `shadows` after all tries that are allowed.
    fn search_all(
        &self,
        shadows: &[Detection],
        own: impl Fn(usize) -> Option<usize>,
        k: &Intrinsics,
        gate: Option<Gate>,
    ) -> Found {
        let targets = self.targets();
        Search { budget: BUDGET, ..self.search(&targets, shadows, own, k, gate) }.run(|_, _| false)
    }
}

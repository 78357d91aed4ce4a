//! What speaks against a match that fits: beads that should be seen and are not, shadows that belong to none, another reading of the
//! remaining shadows, a mirror image.
//!
//! A wrong match of a layout that resembles itself fits as well as a right one does. What tells them apart is what the frame would have to
//! show besides.

use glam::DVec2;

use super::case::Case;
use super::refusal::{Refusal, Rival};
use super::search::{Hypothesis, Search};
use super::settle::Settled;
use super::solve::{Free, Match, Options, solve};
use crate::beads::Detection;
use crate::geometry::Intrinsics;

/// A bead is missing for certain where its place is less deep than this share of the others' contrast …
const LEAST_SHARE: f64 = 0.3;
/// … by so many standard deviations.
const SIGMAS: f64 = 3.0;
/// Shadows closer than so many radii hide each other.
const APART_RADII: f64 = 2.5;
/// A shadow is another bead's if radius and contrast are within these factors of what a bead would have (natural logarithms).
const ALIKE: (f64, f64) = (0.25, 0.4);
/// Contrast over noise from which on a shadow is clear.
const CLEAR_SNR: f64 = 10.0;
/// So many beads may be missing, or migrated, from a sound layout.
const ORDINARY: usize = 2;
/// Accidents expected behind a second reading of the frame, at most, for it to count: it would be accepted by itself.
const RIVAL_CHANCE: f64 = 0.01;
/// Poses from three points that are tried for a second reading, and for a mirrored one.
const BUDGET: u64 = 400_000;

/// Degrees of freedom that are left with K free, and how many times more than chance each of its three numbers must then explain
/// (quantiles of F beyond 0.9999).
const SURE_RATIOS: [(usize, f64); 4] = [(11, 20.0), (7, 40.0), (5, 90.0), (3, 700.0)];
/// K is another from this relative difference of the focal length on, or this shift of the principal point as a share of the width; less
/// is an ordinary calibration.
const OTHER_FOCAL: f64 = 0.03;
const OTHER_CENTRE: f64 = 0.05;
/// Residuals below this are nobody's concern.
const LEAST_RMS_PX: f64 = 0.15;

/// What a frame shows besides the match.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Besides {
    /// Beads that the pose puts into the open field and that are certainly not there.
    missing: Vec<String>,
    /// Clear shadows like the matched ones that belong to no bead.
    unexplained: usize,
}

/// What is left to say of a match that is believed.
pub(super) struct Doubts {
    /// A person should look at these.
    pub cautions: Vec<String>,
}

impl Case<'_> {
    /// Refuses a match although it fits, or says what to look at.
    pub fn doubt(&self, last: &Settled, hypothesis: &Hypothesis) -> Result<Doubts, Refusal> {
        let matched = last.matches.len();
        let Besides { missing, unexplained } = self.besides(last);
        if missing.len() >= ORDINARY
            && unexplained >= ORDINARY
            && let Some(refusal) = self.mirrored(&last.solution.intrinsics, matched)
        {
            return Err(refusal);
        }
        if missing.len() > ORDINARY && (missing.len() >= matched || unexplained >= missing.len()) {
            return Err(Refusal::Missing { matched, missing, unexplained });
        }
        if let Some(refusal) = self.other_intrinsics(last) {
            return Err(refusal);
        }
        if let Some(second) = self.second_reading(last) {
            let (angle_deg, shift_mm) = self.distance(&second.camera_from_lps, &hypothesis.camera_from_lps);
            return Err(Refusal::Ambiguous {
                rival: Rival::SecondSet,
                angle_deg,
                shift_mm,
                matched,
                fit: hypothesis.rms_px,
                other_matched: second.matches.len(),
                other_fit: second.rms_px,
                prior_given: self.request.prior.is_some(),
            });
        }
        let mut cautions = Vec::new();
        if !missing.is_empty() {
            cautions.push(format!("not seen although their places are clear: {}", missing.join(", ")));
        }
        Ok(Doubts { cautions })
    }

    fn besides(&self, last: &Settled) -> Besides {
        let Some(probe) = &self.probe else { return Besides::default() };
        let own = |m: &Match| self.detections.get(m.detection).copied();
        let mut contrasts: Vec<f64> = last.matches.iter().filter_map(own).map(|detection| detection.contrast).collect();
        contrasts.sort_by(f64::total_cmp);
        let Some(usual) = contrasts.get(contrasts.len() / 2).copied() else { return Besides::default() };
        let (pose, k) = (last.solution.camera_from_lps, last.solution.intrinsics);
        let layout = self.request.layout;
        let mut besides = Besides::default();
        let radius_at = |depth_mm: f64, index: usize| {
            layout.radius_mm(index, self.request.bead_radius_mm).map(|radius_mm| k.fx * radius_mm / depth_mm)
        };
        let mut radii: Vec<f64> = last.matches.iter().filter_map(own).map(|detection| detection.radius_px).collect();
        radii.sort_by(f64::total_cmp);
        let usual_radius_px = radii[radii.len() / 2];
        for (index, bead) in layout.beads.iter().enumerate() {
            let p = pose.transform_point(bead.lps_mm);
            let known = last.known().any(|m| m.bead == index);
            if known || !(p.z > 1.0) {
                continue;
            }
            let (at, radius_px) = (k.project(p), radius_at(p.z, index).unwrap_or(usual_radius_px));
            let hidden = |d: &Detection| d.image_px.distance(at) < APART_RADII * radius_px.max(d.radius_px);
            if !probe.is_usable(at) || self.detections.iter().any(hidden) {
                continue;
            }
            // Beads stand where the layout has them to a fraction of their radius; nothing within that counts as there.
            if let Some((contrast, sigma)) = probe.contrast(at, radius_px)
                && contrast + SIGMAS * sigma < LEAST_SHARE * usual
            {
                besides.missing.push(bead.name.clone());
            }
        }
        let alike = |d: &Detection| {
            (d.radius_px / usual_radius_px).ln().abs() < ALIKE.0
                && (d.contrast / usual).ln().abs() < ALIKE.1
                && d.snr >= CLEAR_SNR
        };
        let explained = |n: usize| {
            let taken = last.known().any(|m| m.detection == n);
            let beside = |m: &Match| m.image_px.distance(self.detections[n].image_px) < usual_radius_px;
            taken || last.matches.iter().any(beside)
        };
        besides.unexplained = (0..self.detections.len()).filter(|n| alike(&self.detections[*n]) && !explained(*n)).count();
        besides
    }

    /// That the beads fit far better with another K than with the one given: a wrong focal length or principal point is made up for by depth
    /// and turn, but not without a trace.
    fn other_intrinsics(&self, last: &Settled) -> Option<Refusal> {
        let k = self.request.intrinsics?;
        let degrees = (2 * last.matches.len()).checked_sub(9)?;
        let (_, needed) = *SURE_RATIOS.iter().find(|(fewest, _)| degrees >= *fewest)?;
        let options = Options { iterations: 60, ..Options::least_squares(Free::Square) };
        let free = solve(&last.matches, &last.solution.camera_from_lps, &k, &options)?;
        let squares = |residuals: &[DVec2]| residuals.iter().map(|r| r.length_squared()).sum::<f64>();
        let (given, freed) = (squares(&last.solution.residuals_px), squares(&free.residuals_px));
        let ratio = ((given - freed) / 3.0) / (freed / degrees as f64);
        let focal_ratio = free.intrinsics.fx / k.fx;
        let shift_px = DVec2::new(free.intrinsics.cx - k.cx, free.intrinsics.cy - k.cy).length();
        let elsewhere = (focal_ratio - 1.0).abs() > OTHER_FOCAL || shift_px > OTHER_CENTRE * f64::from(self.request.size_px[0]);
        let rms = |squares: f64| (squares / last.matches.len() as f64).sqrt();
        let (given_px, freed_px) = (rms(given), rms(freed));
        (ratio > needed && elsewhere && given_px > LEAST_RMS_PX).then_some(Refusal::Intrinsics {
            given_px,
            freed_px,
            focal_ratio,
            shift_px,
        })
    }

    /// A match of the shadows that are left, far beyond chance: the layout, or one like it, stands in the frame a second time.
    fn second_reading(&self, last: &Settled) -> Option<Hypothesis> {
        let near = |d: &Detection| last.matches.iter().any(|m| m.image_px.distance(d.image_px) < (0.7 * d.radius_px).max(1.5));
        let left: Vec<usize> = (0..self.detections.len()).filter(|n| !near(&self.detections[*n])).collect();
        let shadows: Vec<Detection> = left.iter().map(|n| self.detections[*n]).collect();
        self.reading(&shadows, |n| left.get(n).copied(), &last.solution.intrinsics, true)
    }

    /// That the layout fits the frame's mirror image, with at least two beads more than the `matched` of the frame itself.
    pub fn mirrored(&self, k: &Intrinsics, matched: usize) -> Option<Refusal> {
        let end = f64::from(self.request.size_px[0]) - 1.0;
        let turned = |d: &Detection| Detection { image_px: DVec2::new(end - d.image_px.x, d.image_px.y), ..*d };
        let shadows: Vec<Detection> = self.detections.iter().map(turned).collect();
        let found = self.reading(&shadows, Some, &Intrinsics { cx: end - k.cx, ..*k }, false)?;
        let mirrored = found.matches.len();
        (mirrored >= matched + 2).then_some(Refusal::Mirrored { mirrored, rms_px: found.rms_px, matched })
    }

    /// The best match of `shadows`, if it is beyond chance; `own` tells which each is among all.
    fn reading(
        &self,
        shadows: &[Detection],
        own: impl Fn(usize) -> Option<usize>,
        k: &Intrinsics,
        gated: bool,
    ) -> Option<Hypothesis> {
        if shadows.len() < 4 {
            return None;
        }
        let targets = self.targets();
        let gate = self.request.prior.filter(|_| gated && !self.without_prior).map(|prior| self.gate(prior));
        let search = Search { budget: BUDGET, ..self.search(&targets, shadows, own, k, gate) };
        let accident = |found: &Hypothesis, tried: u64| self.chance_among(found, tried, shadows);
        let found = search.run(|best, tried| accident(best, tried) < 0.1 * RIVAL_CHANCE);
        found.hypotheses.into_iter().find(|hypothesis| accident(hypothesis, found.tried) < RIVAL_CHANCE)
    }
}

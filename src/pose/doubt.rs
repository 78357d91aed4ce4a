//! What speaks against a match that fits: beads that should be seen and are not, shadows that belong to none, another reading of the
//! remaining shadows, a mirror image.
//!
//! A wrong match of a layout that resembles itself fits as well as a right one does. What tells them apart is what the frame would have to
//! show besides.

use glam::DVec2;
use nalgebra::Matrix6;

use super::besides::Besides;
use super::case::{Case, GATE};
use super::prior::Prior;
use super::refusal::{Refusal, Rival};
use super::search::{Found, Gate, Hypothesis, Search, information_about};
use super::settle::Settled;
use super::solve::{Free, Match, Options, about, deviation, solve};
use crate::beads::{Detection, Probe};
use crate::geometry::{Intrinsics, Rigid};

/// So many beads may be missing, or migrated, from a sound layout.
const ORDINARY: usize = 2;
/// Accidents expected behind a second reading of the frame, at most, for it to count: it would be accepted by itself.
const RIVAL_CHANCE: f64 = 0.01;
/// The same for shadows that look like beads, close to the pose: fewer could be tried, and each counts.
const NEAR_CHANCE: f64 = 0.05;
/// Close: rotation (rad) and shift (mm) about the beads, and the squared deviation allowed.
const NEAR_SIGMA: (f64, f64) = (3.0 * std::f64::consts::PI / 180.0, 10.0);
const NEAR_LIMIT: f64 = 20.0;
/// A second reading is nearer the prior from this difference of squared standard deviations on.
const NEARER: f64 = 12.0;
/// So many beads may carry a pose although more than usual are missing.
const SURE_MATCHED: usize = 6;
/// χ² per degree of freedom beyond which residuals are a reason for doubt, where one shadow lies beside its bead's place, and where more do.
const LOOSE_CHI2: f64 = 4.0;
const LOOSE_CHI2_OF_SEVERAL: f64 = 2.25;
/// From here on the mirror image is looked at.
const UNEASY_CHI2: f64 = 1.5;
/// Fitted over true radius of a bead: blur of the intensity makes thick metal's shadow smaller than that of its line integral.
const USUAL_RADIUS: f64 = 0.97;
/// Relative differences of the radius from which on it is said, and refused. Of grey values of unknown scale it is only said: their curve
/// changes what half the depth is.
const OTHER_RADIUS: (f64, f64) = (0.10, 0.15);
/// Squared standard deviations from the prior (six degrees of freedom) beyond which it is said, and for so few beads refused.
const FAR_FROM_PRIOR: f64 = 14.0;
const FEW: usize = 5;
/// The mirror image must fit so many times as well as noise and bead positions allow.
const MIRROR_FIT: f64 = 2.0;
/// Poses from three points that are tried for a second reading, and for a mirrored one.
const BUDGET: u64 = 400_000;

/// Degrees of freedom that are left with K free, and how many times more than chance each of its three numbers must then explain
/// (quantiles of F beyond 0.9999).
const SURE_RATIOS: [(usize, f64); 4] = [(11, 20.0), (7, 40.0), (5, 90.0), (3, 700.0)];
/// Relative differences of the focal length from which on another K is said, and refused …
const OTHER_FOCAL: (f64, f64) = (0.01, 0.03);
/// … and shifts of the principal point, as a share of the width.
const OTHER_CENTRE: (f64, f64) = (0.02, 0.05);
/// Residuals below this are nobody's concern.
const LEAST_RMS_PX: f64 = 0.15;

/// A K that fits the beads better than the one given.
struct OtherK {
    given_px: f64,
    freed_px: f64,
    focal_ratio: f64,
    shift_px: f64,
}

impl Case<'_> {
    /// Refuses a match although it fits, or gives the cautions that a person should look at.
    pub fn doubt(&self, last: &Settled, hypothesis: &Hypothesis) -> Result<Vec<String>, Refusal> {
        let matched = last.matches.len();
        let besides = self.besides(last);
        let Besides { missing, displaced, unexplained } = &besides;
        let mut cautions = Vec::new();
        let strays = match &self.probe {
            Some(_) => missing.len() + displaced.len() >= ORDINARY && unexplained.len() + displaced.len() >= ORDINARY,
            // Without the picture nobody knows whether a bead is hidden, nor whether a shadow is like a bead's.
            None => hypothesis.in_view >= matched + ORDINARY && self.detections.len() >= matched + ORDINARY,
        };
        if (strays || last.chi2_per_dof > UNEASY_CHI2)
            && let Some(refusal) = self.mirrored(&last.solution.intrinsics, matched, Some(last.rms_px()))
        {
            return Err(refusal);
        }
        let many_missing = missing.len() > ORDINARY && (missing.len() >= matched || unexplained.len() >= missing.len());
        if many_missing && !self.is_best_of_all(last, &besides) {
            let (missing, unexplained) = (missing.clone(), unexplained.len());
            return Err(Refusal::Missing { matched, missing, unexplained });
        }
        self.check_residual(last, displaced, &mut cautions)?;
        self.check_given_intrinsics(last, &mut cautions)?;
        self.check_lens(last, &mut cautions)?;
        self.check_radii(last, &mut cautions)?;
        self.check_second(last, hypothesis, unexplained, &mut cautions)?;
        self.check_prior(last, &mut cautions)?;
        if !missing.is_empty() {
            cautions.push(format!("not seen although their places are clear: {}", missing.join(", ")));
        }
        Ok(cautions)
    }

    /// Whether no other reading of all shadows, wherever it puts the camera, explains as many beads. Where more shadows are left than
    /// matched, all must have been tried.
    fn is_best_of_all(&self, last: &Settled, besides: &Besides) -> bool {
        let matched = last.matches.len();
        if matched < SURE_MATCHED || besides.missing.len() >= matched {
            return false;
        }
        let found = self.search_all(self.detections, Some, &last.solution.intrinsics, None);
        if found.cut_short && besides.unexplained.len() > matched {
            return false;
        }
        let pose = &last.solution.camera_from_lps;
        found.hypotheses.first().is_some_and(|best| {
            let (angle_deg, shift_mm) = self.distance(&best.camera_from_lps, pose);
            angle_deg < 2.0 && shift_mm < 15.0
        })
    }

    /// Shadows beside the places of their beads are outliers where the others fit as they should, and a wrong layout or K where not.
    fn check_residual(&self, last: &Settled, displaced: &[String], cautions: &mut Vec<String>) -> Result<(), Refusal> {
        let (chi2, matched) = (last.chi2_per_dof, last.matches.len());
        let limit = match displaced.len() {
            0 => f64::INFINITY,
            1 => LOOSE_CHI2,
            _ => LOOSE_CHI2_OF_SEVERAL,
        };
        if !(chi2 <= limit) {
            return Err(Refusal::Displaced { matched, rms_px: last.rms_px(), times: chi2.sqrt(), displaced: displaced.to_vec() });
        }
        if chi2 > LOOSE_CHI2 {
            cautions.push(format!("residuals are {:.1} times what noise and bead positions allow", chi2.sqrt()));
        }
        Ok(())
    }

    /// The size of the shadows against depth and size of the beads: the same pose of a larger layout is farther away. Only values that
    /// are proportional to quanta, or their logarithms, show the size of what is in the beam.
    fn check_radii(&self, last: &Settled, cautions: &mut Vec<String>) -> Result<(), Refusal> {
        let Some(quantitative) = self.probe.as_ref().map(Probe::is_quantitative) else { return Ok(()) };
        let Some(ratio) = self.radius_ratio(last) else { return Ok(()) };
        let off = (ratio - 1.0).abs();
        if quantitative && !(off <= OTHER_RADIUS.1) {
            return Err(Refusal::Radii { ratio });
        }
        if off > OTHER_RADIUS.0 {
            cautions.push(format!(
                "the shadows are {:.0} % {} than the beads' radii give at their depth: check the layout's scale, the beads' radius, and SID and pitch",
                100.0 * off,
                if ratio < 1.0 { "smaller" } else { "larger" }
            ));
        }
        Ok(())
    }

    /// Fitted over stated radius of the matched beads, the median; `None` where fewer than four radii are known.
    fn radius_ratio(&self, last: &Settled) -> Option<f64> {
        let (pose, k) = (last.solution.camera_from_lps, last.solution.intrinsics);
        let ratio = |m: &Match| {
            let radius_mm = self.request.layout.radius_mm(m.bead, self.request.bead_radius_mm)?;
            let expected_px = k.fx * radius_mm / pose.transform_point(m.lps_mm).z;
            Some(self.detections.get(m.detection)?.radius_px / expected_px)
        };
        let mut ratios: Vec<f64> = last.matches.iter().filter_map(ratio).collect();
        if ratios.len() < 4 {
            return None;
        }
        ratios.sort_by(f64::total_cmp);
        Some(ratios[ratios.len() / 2] / USUAL_RADIUS)
    }

    /// A second reading of the shadows that are left.
    fn check_second(
        &self,
        last: &Settled,
        hypothesis: &Hypothesis,
        unexplained: &[usize],
        cautions: &mut Vec<String>,
    ) -> Result<(), Refusal> {
        let refusal = |second: &Hypothesis| {
            let (angle_deg, shift_mm) = self.distance(&second.camera_from_lps, &hypothesis.camera_from_lps);
            Refusal::Ambiguous {
                rival: Rival::SecondSet,
                angle_deg,
                shift_mm,
                matched: last.matches.len(),
                fit: hypothesis.rms_px,
                other_matched: second.matches.len(),
                other_fit: second.rms_px,
                prior_given: self.request.prior.is_some(),
            }
        };
        if let Some(second) = self.second_reading(last) {
            return Err(refusal(&second));
        }
        let Some(second) = self.second_near(last, unexplained) else { return Ok(()) };
        let explains = second.matches.len();
        let squares = |pose: &Rigid| self.off_prior(pose).map_or(0.0, |(squares, _)| squares);
        let nearer_the_prior = squares(&last.solution.camera_from_lps) - squares(&second.camera_from_lps) > NEARER;
        if nearer_the_prior || 3 * explains >= 2 * unexplained.len() {
            return Err(refusal(&second));
        }
        let (angle_deg, shift_mm) = self.distance(&second.camera_from_lps, &hypothesis.camera_from_lps);
        cautions.push(format!(
            "{explains} of {} clear shadows that belong to no bead fit the layout {angle_deg:.1}° and {shift_mm:.1} mm away",
            unexplained.len()
        ));
        Ok(())
    }

    /// A pose that few beads carry is not believed far from the prior; of others it is said.
    fn check_prior(&self, last: &Settled, cautions: &mut Vec<String>) -> Result<(), Refusal> {
        let pose = &last.solution.camera_from_lps;
        let Some((prior, (squares, _))) = self.request.prior.zip(self.off_prior(pose)) else { return Ok(()) };
        if squares <= FAR_FROM_PRIOR {
            return Ok(());
        }
        let (angle_deg, shift_mm) = self.distance(&prior.camera_from_lps, pose);
        let matched = last.matches.len();
        if (matched <= FEW || self.contradicts(last, prior)) && !self.request.ignore_prior {
            return Err(Refusal::PriorContradicted { matched, rms_px: last.rms_px(), angle_deg, shift_mm });
        }
        if let Some(refusal) = self.better_elsewhere(last) {
            return Err(refusal);
        }
        cautions.push(format!(
            "{angle_deg:.1}° and {shift_mm:.1} mm from the prior, {:.1} standard deviations: check K, SID, the layout's scale, and the prior",
            squares.sqrt()
        ));
        Ok(())
    }

    /// That a pose which the prior excludes explains more of the shadows: of a layout that resembles itself, a prior that is turned finds a
    /// wrong match close by.
    fn better_elsewhere(&self, last: &Settled) -> Option<Refusal> {
        let matched = last.matches.len();
        let found = self.search_all(self.detections, Some, &last.solution.intrinsics, None);
        let other = found.hypotheses.into_iter().next()?;
        if other.matches.len() < matched + ORDINARY || !(self.chance_of(&other, found.tried) < RIVAL_CHANCE) {
            return None;
        }
        let (angle_deg, shift_mm) = self.distance(&other.camera_from_lps, &last.solution.camera_from_lps);
        Some(Refusal::Ambiguous {
            rival: Rival::OtherNames,
            angle_deg,
            shift_mm,
            matched,
            fit: last.rms_px(),
            other_matched: other.matches.len(),
            other_fit: other.rms_px,
            prior_given: true,
        })
    }

    /// Whether a pose that was solved with K is outside a stated covariance, widened by its own: no gate has held it.
    fn contradicts(&self, last: &Settled, prior: &Prior) -> bool {
        let Some(rows) = prior.covariance.filter(|_| self.request.intrinsics.is_none()) else { return false };
        let stated = Matrix6::from_fn(|i, j| rows[i][j]);
        let own = last.solution.covariance.fixed_view::<6, 6>(0, 0) * last.chi2_per_dof.max(1.0);
        let Some(origin_from_centroid) = about(last.solution.centroid_mm).try_inverse() else { return true };
        let both = stated + origin_from_centroid * own * origin_from_centroid.transpose();
        let off = deviation(&last.solution.camera_from_lps, &prior.camera_from_lps);
        both.try_inverse().is_none_or(|information| !((off.transpose() * information * off)[(0, 0)] <= GATE.0))
    }

    /// The beads may fit far better with another K than with the one given: a wrong focal length or principal point is made up for by depth
    /// and turn, but not without a trace.
    fn check_given_intrinsics(&self, last: &Settled, cautions: &mut Vec<String>) -> Result<(), Refusal> {
        let Some(OtherK { given_px, freed_px, focal_ratio, shift_px }) = self.other_intrinsics(last) else { return Ok(()) };
        let focal_off = (focal_ratio - 1.0).abs();
        let width_px = f64::from(self.request.size_px[0]);
        let beyond = |focal: f64, centre: f64| focal_off > focal || shift_px > centre * width_px;
        if beyond(OTHER_FOCAL.1, OTHER_CENTRE.1) && given_px > LEAST_RMS_PX {
            return Err(Refusal::Intrinsics { given_px, freed_px, focal_ratio, shift_px });
        }
        if beyond(OTHER_FOCAL.0, OTHER_CENTRE.0) {
            let way = if focal_ratio < 1.0 { "shorter" } else { "longer" };
            cautions.push(format!(
                "the beads fit to {given_px:.3} px with K as given, to {freed_px:.3} px with a focal length {:.1} % {way} and the principal point {shift_px:.0} px away: check K, SID and pitch",
                100.0 * focal_off
            ));
        }
        Ok(())
    }

    /// The K that explains the beads better than chance would.
    fn other_intrinsics(&self, last: &Settled) -> Option<OtherK> {
        let k = self.request.intrinsics?;
        let degrees = (2 * last.matches.len()).checked_sub(9)?;
        let (_, needed) = *SURE_RATIOS.iter().find(|(fewest, _)| degrees >= *fewest)?;
        let alone = |free: Free| {
            let options = Options { iterations: 60, ..Options::least_squares(free) };
            solve(&last.matches, &last.solution.camera_from_lps, &k, &options)
        };
        let free = alone(Free::Square)?;
        let squares = |residuals: &[DVec2]| residuals.iter().map(|r| r.length_squared()).sum::<f64>();
        // A pose that a fused prior has drawn away would make another K look needed.
        let given =
            if self.request.fuse { squares(&alone(Free::Pose)?.residuals_px) } else { squares(&last.solution.residuals_px) };
        let freed = squares(&free.residuals_px);
        let ratio = ((given - freed) / 3.0) / (freed / degrees as f64);
        let focal_ratio = free.intrinsics.fx / k.fx;
        let shift_px = DVec2::new(free.intrinsics.cx - k.cx, free.intrinsics.cy - k.cy).length();
        let rms = |squares: f64| (squares / last.matches.len() as f64).sqrt();
        let found = OtherK { given_px: rms(given), freed_px: rms(freed), focal_ratio, shift_px };
        (ratio > needed).then_some(found)
    }

    /// A match of the shadows that are left, far beyond chance: the layout, or one like it, stands in the frame a second time.
    fn second_reading(&self, last: &Settled) -> Option<Hypothesis> {
        let near = |d: &Detection| last.matches.iter().any(|m| m.image_px.distance(d.image_px) < (0.7 * d.radius_px).max(1.5));
        let left: Vec<usize> = (0..self.detections.len()).filter(|n| !near(&self.detections[*n])).collect();
        let shadows: Vec<Detection> = left.iter().map(|n| self.detections[*n]).collect();
        self.reading(&shadows, |n| left.get(n).copied(), &last.solution.intrinsics, true)
    }

    /// The best match, close to the pose, of shadows that look like beads and belong to none.
    fn second_near(&self, last: &Settled, unexplained: &[usize]) -> Option<Hypothesis> {
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
        let allowed_px = |m: &Match| 2.0 * ((m.sigma_mm * k.fx / depth_mm).powi(2) + m.sigma_px.powi(2));
        let allowed_px = (found.matches.iter().map(allowed_px).sum::<f64>() / mirrored as f64).sqrt();
        let far_better = |rms_px: f64| mirrored >= matched && MIRROR_FIT * found.rms_px < rms_px;
        if !(found.rms_px <= (MIRROR_FIT * allowed_px).max(LEAST_RMS_PX))
            || !(mirrored >= matched + 2 || rms_px.is_some_and(far_better))
        {
            return None;
        }
        let itself = self.search_all(self.detections, Some, k, None).hypotheses;
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
        let turned = |d: &Detection| Detection { image_px: DVec2::new(end - d.image_px.x, d.image_px.y), ..*d };
        (self.detections.iter().map(turned).collect(), Intrinsics { cx: end - k.cx, ..*k })
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

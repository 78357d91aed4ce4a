//! The final solution of a match, and whether it may be believed.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, Matrix6};

use super::flat::off_plane;
use super::record::{BeadResidual, BodyPose, Covariance, LandmarkUncertainty, Pose, Status};
use super::register::{Attempt, Candidate};
use super::search::{Hypothesis, MISSED};
use super::solve::{Free, Match, Measured, Options, Solution, about, left_out, solve};
use super::start;
use super::verdict::{check_geometry, mirrored, rival};
use crate::beads::DEFAULT_SIGMA_MM;
use crate::geometry::{Projection, Rigid};

/// Accidents expected, at most, behind an accepted match.
const MOST_CHANCE: f64 = 0.01;
/// χ² per degree of freedom, at most, of an accepted match: residuals three times what image noise and bead uncertainty allow.
const MOST_CHI2_PER_DOF: f64 = 9.0;
/// Relative standard deviation of a solved focal length beyond which K is refused, and beyond which it is mentioned.
const FOCAL_SIGMA: (f64, f64) = (0.10, 0.02);
/// Standard deviations at the bead centroid, at most: rotation, shift across the beam, shift along it.
const MOST_SIGMA: (f64, f64, f64) = (3.0 * std::f64::consts::PI / 180.0, 3.0, 40.0);
/// Squared residual (in standard deviations, two degrees of freedom) beyond which a bead is left out.
const OUTLIER: f64 = 25.0;
/// From so many beads on, their own residuals say how well they stand, down to a share of the stated variance.
const AGREEING: usize = 7;
const SHARPEST: f64 = 0.02;
/// The lower three quarters of residuals that a pose was fitted to are smaller than all of them.
const AGREED: f64 = 2.5;

/// A solved match.
pub(super) struct Final {
    pub(super) solution: Solution,
    pub(super) matches: Vec<Match>,
    /// Outliers, and how far off they are.
    pub(super) left_out: Vec<(Match, DVec2)>,
    chi2_per_dof: f64,
    /// How the solution was asked for, priors among it.
    options: Options,
}

impl Attempt<'_> {
    pub(super) fn judge(&self, candidate: Candidate, mut notes: Vec<String>) -> Pose {
        let layout = self.matching.layout;
        if layout.beads.iter().any(|bead| bead.sigma_mm.is_none()) {
            notes.push(format!("bead positions without sigma_mm are taken to be good to {DEFAULT_SIGMA_MM} mm per axis"));
        }
        let known = self.matching.intrinsics.is_some();
        let Some(last) = self.finish(&candidate) else {
            return self.refuse("unsolved: the equations of the matched beads are singular".to_owned(), notes);
        };
        let points: Vec<DVec3> = last.matches.iter().map(|m| m.lps_mm).collect();
        if let Err(degenerate) = check_geometry(&points, known, "that were matched") {
            return self.refuse(degenerate.to_string(), notes);
        }
        let count = last.matches.len();
        let rms_px = rms(&last.solution.residuals_px);
        let pose = last.solution.camera_from_lps;
        let k = last.solution.intrinsics;
        let hypothesis =
            Hypothesis { camera_from_lps: pose, rms_px, matches: last.matches.clone(), ..candidate.hypothesis.clone() };
        let accident = self.chance_of(&hypothesis, candidate.tried);
        let in_view = candidate.hypothesis.in_view;
        if !(accident <= MOST_CHANCE) {
            if let Some(reason) = self.mirrored(&k, count) {
                return self.refuse(reason, notes);
            }
            let reason = format!(
                "chance: {count} of {in_view} beads agree to {rms_px:.2} px, but {accident:.2e} such matches are expected by accident among {} shadows (limit {MOST_CHANCE}); bring more beads into view or give --prior",
                self.detections.len()
            );
            return self.refuse(reason, notes);
        }
        if !(last.chi2_per_dof <= MOST_CHI2_PER_DOF) {
            let reason = format!(
                "residual: {count} beads agree only to {rms_px:.2} px, {:.1} times what noise and bead positions allow (limit {:.0}); the layout may have moved, or K is wrong",
                last.chi2_per_dof.sqrt(),
                MOST_CHI2_PER_DOF.sqrt()
            );
            return self.refuse(reason, notes);
        }
        if let Some(reason) = self.twin(&candidate, &last, &hypothesis) {
            return self.refuse(reason, notes);
        }
        if let Some(reason) = self.doubt(&last, &hypothesis, &mut notes) {
            return self.refuse(reason, notes);
        }
        let scale = last.chi2_per_dof.max(1.0);
        let covariance = &last.solution.covariance * scale;
        let sigma = |n: usize| covariance[(n, n)].sqrt();
        let (turn, across, along) = (sigma(0).max(sigma(1)).max(sigma(2)), sigma(3).max(sigma(4)), sigma(5));
        if !known {
            let relative = sigma(6) / k.fx;
            if !(relative <= FOCAL_SIGMA.0) {
                let reason = format!(
                    "focal_degenerate: the focal length is {:.0} ± {:.0} px: beads of so little depth do not determine it; give --intrinsics",
                    k.fx,
                    sigma(6)
                );
                return self.refuse(reason, notes);
            }
            if relative > FOCAL_SIGMA.1 {
                notes.push(format!(
                    "focal length {:.0} ± {:.0} px and depth are poorly separated; places near the beads are not affected",
                    k.fx,
                    sigma(6)
                ));
            }
        }
        // A solved principal point shifts with the beads, a solved focal length with their depth; FOCAL_SIGMA has judged those.
        let share = if known { 0.0 } else { FOCAL_SIGMA.0 * last.solution.centroid_mm.z };
        if !(turn <= MOST_SIGMA.0 && across <= MOST_SIGMA.1.max(share) && along <= MOST_SIGMA.2.max(share)) {
            let reason = format!(
                "uncertain: standard deviation at the beads is {:.2}°, {across:.2} mm across and {along:.1} mm along the beam (limits {:.0}°, {:.0} mm, {:.0} mm)",
                turn.to_degrees(),
                MOST_SIGMA.0.to_degrees(),
                MOST_SIGMA.1,
                MOST_SIGMA.2
            );
            return self.refuse(reason, notes);
        }
        if last.chi2_per_dof > 1.5 {
            notes.push(format!(
                "residuals are {:.1} times what was expected; all uncertainties are scaled up by that",
                last.chi2_per_dof.sqrt()
            ));
        }
        let off_plane = off_plane(&last.solution, &last.matches, &covariance);
        if off_plane.is_degenerate() {
            notes.push(format!(
                "the beads are nearly flat: off their plane the pose is uncertain by {:.1} px, which their own residuals do not show",
                off_plane.sigma_px
            ));
        }
        if count < in_view {
            notes.push(format!("{} of {in_view} beads that should be in view are matched", count));
        }
        self.accept(&last, &covariance, rms_px, accident, notes)
    }

    /// Solves from every start there is, leaves out beads that do not fit, weighs with what is left.
    fn finish(&self, candidate: &Candidate) -> Option<Final> {
        let free = self.matching.intrinsics.map_or_else(|| self.free(), |_| Free::Pose);
        let fewest = if free == Free::Pose { 4 } else { 6 };
        let mut matches = candidate.hypothesis.matches.clone();
        if matches.len() < fewest {
            return None;
        }
        let measured = match (self.matching.fuse, self.matching.prior) {
            (true, Some(prior)) => {
                Some(Measured { camera_from_lps: prior.camera_from_lps, information: self.gate(prior).information })
            }
            _ => None,
        };
        let options = Options { loss: 3.0, measured, ..Options::least_squares(free) };
        let starts = [Some(candidate.hypothesis.camera_from_lps), start::opencv(&matches, &candidate.intrinsics)];
        let total = |s: &Solution| s.chi2.iter().map(|c| c.min(MISSED)).sum::<f64>();
        let mut best = starts
            .into_iter()
            .flatten()
            .filter_map(|pose| solve(&matches, &pose, &candidate.intrinsics, &options))
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
        let first = solve(&matches, &best.camera_from_lps, &best.intrinsics, &plain)?;
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
        Some(Final { solution, matches, left_out, chi2_per_dof, options: plain })
    }

    /// Why the match is not unique, if it is not.
    fn twin(&self, candidate: &Candidate, last: &Final, hypothesis: &Hypothesis) -> Option<String> {
        let scale = last.chi2_per_dof.max(1.0);
        if let Some(other) = rival(&candidate.hypothesis, &candidate.others, scale) {
            let (angle, shift) = self.distance(&other.camera_from_lps, &hypothesis.camera_from_lps);
            return Some(format!(
                "ambiguous: another pose, {angle:.1}° and {shift:.1} mm away, puts {} beads within {:.2} px where this one puts {} within {:.2} px; give --prior or break the layout's symmetry",
                other.matches.len(),
                other.rms_px,
                hypothesis.matches.len(),
                hypothesis.rms_px
            ));
        }
        if self.matching.intrinsics.is_some()
            && let Some((twin, chi2)) = mirrored(&last.matches, &last.solution.camera_from_lps, &last.solution.intrinsics)
        {
            let own: f64 = last.solution.chi2.iter().sum();
            if chi2 - own < 12.0 * scale && !self.gate_excludes(&twin) {
                let (angle, shift) = self.distance(&twin, &hypothesis.camera_from_lps);
                return Some(format!(
                    "ambiguous: the beads are nearly flat, and the mirrored pose, {angle:.1}° and {shift:.1} mm away, fits as well (χ² {chi2:.1} against {own:.1}); give --prior"
                ));
            }
        }
        None
    }

    fn gate_excludes(&self, pose: &Rigid) -> bool {
        self.matching.prior.is_some_and(|prior| {
            let gate = self.gate(prior);
            let r = super::solve::deviation(pose, &gate.camera_from_lps);
            (r.transpose() * gate.information * r)[(0, 0)] > gate.limit
        })
    }

    /// Degrees and millimetres between two poses, at the beads.
    pub(super) fn distance(&self, a: &Rigid, b: &Rigid) -> (f64, f64) {
        let (angle, shift) = super::search::apart(a, b, self.matching.layout.centroid_lps_mm());
        (angle.to_degrees(), shift)
    }

    fn accept(&self, last: &Final, covariance: &DMatrix<f64>, rms_px: f64, accident: f64, mut notes: Vec<String>) -> Pose {
        let (pose, k) = (last.solution.camera_from_lps, last.solution.intrinsics);
        let layout = self.matching.layout;
        let centroid = last.solution.centroid_mm;
        let at_centroid = Matrix6::from_fn(|i, j| covariance[(i, j)]);
        let back = about(-centroid);
        let about_origin = back * at_centroid * back.transpose();
        let projection = Projection::compose(&k, &pose);
        let unseen = self.left_out(last);
        let beads: Vec<BeadResidual> =
            layout.beads.iter().enumerate().map(|(n, bead)| self.bead(last, &unseen, n, bead, &projection)).collect();
        let mut bodies: Vec<BodyPose> = Vec::new();
        for bead in &beads {
            match bodies.iter_mut().find(|body| body.name == bead.body) {
                Some(body) => {
                    body.beads += 1;
                    body.used += usize::from(bead.used);
                }
                None => bodies.push(BodyPose {
                    name: bead.body.clone(),
                    lps_from_body: Rigid::IDENTITY,
                    beads: 1,
                    used: usize::from(bead.used),
                }),
            }
        }
        if bodies.len() > 1 {
            notes.push("beads of several bodies are taken as one rigid specimen".to_owned());
        }
        let solved = self.matching.intrinsics.is_none();
        let landmarks = self.matching.landmarks.iter().map(|landmark| {
            let p = pose.transform_point(landmark.lps_mm);
            let sharpness = last.solution.sharpness(landmark.lps_mm, covariance);
            let place = sharpness.camera_mm2;
            let sigma_px = sharpness.image_px2.map(|image| [image[(0, 0)].sqrt(), image[(1, 1)].sqrt()]);
            LandmarkUncertainty {
                name: landmark.name.clone(),
                lps_mm: landmark.lps_mm,
                image_px: (p.z > 1.0).then(|| k.project(p).to_array()),
                sigma_mm: std::array::from_fn(|n| place[(n, n)].sqrt()),
                sigma_px,
            }
        });
        Pose {
            status: Status::Accepted,
            reason: None,
            projection: Some(projection),
            intrinsics: Some(k),
            intrinsics_source: Some(if solved { "solved" } else { "given" }.to_owned()),
            intrinsics_sigma_px: solved.then(|| {
                let sigma = |n: usize| covariance[(n, n)].sqrt();
                [sigma(6), sigma(6), sigma(7), sigma(8)]
            }),
            size_px: Some(self.matching.size_px),
            pitch_mm: self.matching.pitch_mm,
            camera_from_lps: Some(pose),
            bodies,
            rms_px: Some(rms_px),
            rms_mm: Some(rms_px * centroid.z / k.fx),
            chi2_per_dof: Some(last.chi2_per_dof),
            chance: Some(accident),
            covariance: Some(rows_of(&about_origin)),
            covariance_at_centroid: Some(rows_of(&at_centroid)),
            centroid_lps_mm: Some(pose.inverse().transform_point(centroid)),
            landmarks: landmarks.collect(),
            beads,
            detections: self.detections.len(),
            fused: self.matching.fuse,
            notes,
            version: Some(env!("CARGO_PKG_VERSION").to_owned()),
        }
    }

    fn bead(
        &self,
        last: &Final,
        unseen: &[Option<DVec2>],
        index: usize,
        bead: &crate::beads::Bead,
        projection: &Projection,
    ) -> BeadResidual {
        let (at, depth_mm) = projection.project(bead.lps_mm);
        let predicted = (depth_mm > 1.0).then_some(at);
        let used = last.matches.iter().position(|m| m.bead == index);
        let rejected = last.left_out.iter().find(|(m, _)| m.bead == index);
        let observed = used.map(|n| last.matches[n]).or_else(|| rejected.map(|(m, _)| *m));
        let [width, height] = self.matching.size_px.map(f64::from);
        let outside = at.x < 0.0 || at.y < 0.0 || at.x > width - 1.0 || at.y > height - 1.0;
        let reason = match (used, rejected) {
            (Some(_), _) => None,
            (None, Some((_, off))) => Some(format!("its shadow is {:.2} px from where the other beads put it", off.length())),
            (None, None) if predicted.is_none() => Some("behind the source".to_owned()),
            (None, None) if outside => Some("outside the frame".to_owned()),
            (None, None) => Some("no shadow found where it should be".to_owned()),
        };
        BeadResidual {
            name: bead.name.clone(),
            body: bead.body.clone(),
            lps_mm: bead.lps_mm,
            image_px: observed.map(|m| m.image_px.to_array()),
            predicted_px: predicted.map(|p| p.to_array()),
            residual_px: observed.zip(predicted).map(|(m, p)| (m.image_px - p).to_array()),
            sigma_px: observed.map(|m| m.sigma_px),
            left_out_px: used.and_then(|n| unseen[n]).map(|off| off.to_array()),
            used: used.is_some(),
            reason,
        }
    }

    /// Residual of each used bead under the pose of all others, the prior among them where it is fused.
    fn left_out(&self, last: &Final) -> Vec<Option<DVec2>> {
        // Seen by its own solution alone: at least one other bead must be left to contradict it.
        if last.solution.degrees_of_freedom < 4 {
            return vec![None; last.matches.len()];
        }
        let off = |found: crate::estimate::LeftOut| DVec2::new(found.offset[0], found.offset[1]);
        left_out(&last.matches, &last.solution, &last.options).into_iter().map(|found| found.map(off)).collect()
    }
}

fn rms(residuals: &[DVec2]) -> f64 {
    (residuals.iter().map(|r| r.length_squared()).sum::<f64>() / residuals.len().max(1) as f64).sqrt()
}

fn rows_of(m: &Matrix6<f64>) -> Covariance {
    std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (m[(i, j)] + m[(j, i)])))
}

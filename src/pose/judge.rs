//! Whether a settled match may be believed.

use glam::DVec3;
use nalgebra::DMatrix;

use super::case::Case;
use super::cautions::{Cautions, larger_residuals};
use super::doubt::ORDINARY;
use super::explained::{Reading, Rejected};
use super::flat::{Loose, hold, worst_landmark};
use super::nuisance::{Nuisance, Word};
use super::propose::Candidate;
use super::record::Pose;
use super::refusal::{Points, Refusal, Rival};
use super::request::Registration;
use super::search::Hypothesis;
use super::settle::Settled;
use super::solve::{Free, Options, solve};
use super::unstated::unstated;
use super::verdict::{MOST_CHANCE, check_geometry, extents_mm, is_plate, mirrored, rival};
use crate::beads::DEFAULT_SIGMA_MM;

/// χ² per degree of freedom, at most, of an accepted match: residuals three times what image noise and bead uncertainty allow.
pub(super) const MOST_CHI2_PER_DOF: f64 = 9.0;
/// The same for so few beads that an outlier among them cannot be told.
const MOST_CHI2_OF_FEW: (usize, f64) = (5, 4.0);
/// Relative standard deviation of a solved focal length beyond which K is refused, and beyond which it is mentioned.
const FOCAL_SIGMA: (f64, f64) = (0.10, 0.02);
/// Standard deviations from what is stated of K beyond which it is said, and refused.
const OFF_INTRINSICS: (f64, f64) = (3.3, 5.0);
/// Beads that are not seen, of which one for so many that are, speak against a pose whose prior is contradicted; fewer may have fallen out.
const MISSING_BESIDES: usize = 3;
/// Share of a prior's variance that the beads must take away before they can contradict it.
const LEAST_GAIN: f64 = 0.02;
/// Standard deviations at the bead centroid, at most: rotation (degrees), shift across the beam, shift along it (mm).
pub(super) const MOST_SIGMA: [f64; 3] = [3.0, 3.0, 40.0];

impl Case<'_> {
    /// The pose, or the refusal, that a candidate comes to.
    pub fn judge(&self, candidate: &Candidate, mut notes: Vec<String>) -> Pose {
        if self.request.layout.beads.iter().any(|bead| bead.sigma_mm.is_none()) {
            notes.push(format!("bead positions without sigma_mm are taken to be good to {DEFAULT_SIGMA_MM} mm per axis"));
        }
        match self.verdict(candidate, &mut notes) {
            Ok(Believed { settled, covariance, unstated, chance, cautions }) => {
                let Cautions { words, doubt, .. } = cautions;
                let explained = Some(self.explained(Some((&settled, &covariance))));
                Pose { cautions: words, doubt, explained, ..self.accept(&settled, &covariance, &unstated, chance, notes) }
            }
            Err(refusal) => self.refuse(&refusal, notes),
        }
    }

    fn verdict(&self, candidate: &Candidate, notes: &mut Vec<String>) -> Result<Believed, Refusal> {
        let settled = self.settle(candidate).ok_or(Refusal::Unsolved)?;
        let points: Vec<DVec3> = settled.matches.iter().map(|m| m.lps_mm).collect();
        check_geometry(&points, self.request.intrinsics.is_some(), Points::Matched)?;
        let is_plate = is_plate(extents_mm(&points));
        let hypothesis = Hypothesis {
            camera_from_lps: settled.solution.camera_from_lps,
            rms_px: settled.rms_px(),
            roundness: settled.solution.roundness(&settled.matches),
            matches: settled.matches.clone(),
            ..candidate.hypothesis.clone()
        };
        let chance = self.check_chance(candidate, &settled, &hypothesis)?;
        let (matched, rms_px) = (settled.matches.len(), hypothesis.rms_px);
        let off_intrinsics = self.check_intrinsics(&settled)?;
        let (few, limit_of_few) = MOST_CHI2_OF_FEW;
        let limit = if matched <= few { limit_of_few } else { MOST_CHI2_PER_DOF };
        if !(settled.chi2_per_dof <= limit) {
            let (times, limit) = (settled.chi2_per_dof.sqrt(), limit.sqrt());
            return Err(Refusal::Residual { matched, rms_px, times, limit });
        }
        self.check_twins(candidate, &settled, &hypothesis)?;
        let mut cautions = self.doubt(&settled, &hypothesis)?;
        off_intrinsics.into_iter().for_each(|words| cautions.doubt(words));
        // Doubts that the layout brings in every frame say nothing against this pose.
        let contradicted = self.contradicted(&settled, &cautions);
        let alone = self.request.prior.is_none() || self.without_prior;
        if alone && (is_plate || self.has_mirror_twin(&settled)) {
            let (why, remedy) = if is_plate {
                ("the beads lie in a plane", "a bead out of the plane")
            } else {
                ("the layout resembles its own mirror image", "a bead that no mirror puts onto another")
            };
            cautions.doubt(format!(
                "{why}: from the beads alone nobody can tell whether the picture is mirrored, and the pose with it; give --prior, or {remedy}"
            ));
        }
        if !alone && !is_plate && self.has_mirror_twin_near(&settled) {
            cautions.doubt(
                "the layout resembles its own mirror image, and the prior lets both be: whether the picture is mirrored nobody can tell",
            );
        }
        if let Some(words) = behind_detector(self.request, &settled) {
            cautions.doubt(words);
        }
        let covariance = &settled.solution.covariance * settled.chi2_per_dof.max(1.0);
        self.check_uncertainty(&settled, &covariance, notes)?;
        notes.extend(larger_residuals(settled.chi2_per_dof));
        let misstated = self.detections.iter().filter(|shadow| shadow.misstates_covariance()).count();
        if misstated > 0 {
            cautions.say(format!(
                "what is stated as the covariance of {misstated} of {} shadows is none: they are taken to be known alike along all directions, \
                 as badly as along the worst that is stated",
                self.detections.len()
            ));
        }
        if matched == self.request.fewest() {
            cautions.say(format!(
                "no more than {matched} beads carry the pose: if one of them has moved, nothing here can tell; bring more into view"
            ));
        }
        let places_mm: Vec<DVec3> = settled.matches.iter().map(|m| m.lps_mm).collect();
        let at_landmark = worst_landmark(&settled.solution, self.request.landmarks, &covariance);
        match hold(&settled.solution, &places_mm, at_landmark, &covariance) {
            Some(Loose::AtLandmark(words)) => cautions.doubt(words),
            Some(Loose::OffPlane(words)) => cautions.say(words),
            Some(Loose::NearlyFlat(words)) => notes.push(words),
            None => {}
        }
        let (unstated, said) = unstated(self.request, &settled);
        for word in said {
            match word {
                Word::Doubt(words) => cautions.doubt(words),
                Word::Note(words) => notes.push(words),
            }
        }
        if matched < candidate.hypothesis.in_view {
            notes.push(format!("{matched} of {} beads that should be in view are matched", candidate.hypothesis.in_view));
        }
        match contradicted {
            Some(refusal) => {
                notes.extend(cautions.words);
                Err(refusal)
            }
            None => Ok(Believed { settled, covariance, unstated, chance, cautions }),
        }
    }

    /// An unrelated prior alone does not stop a pose. With another doubt, beads that should be seen, or K that the shadows told, what speaks
    /// against the pose is more than the prior.
    fn contradicted(&self, settled: &Settled, cautions: &Cautions) -> Option<Refusal> {
        let prior = self.request.prior.filter(|_| !self.request.ignore_prior)?;
        let others = cautions.doubts - usize::from(cautions.is_far_from_prior);
        let is_far = self.without_prior || cautions.is_far_from_prior;
        if !(is_far
            && (others > 0 || MISSING_BESIDES * cautions.missing >= settled.matches.len() || self.request.intrinsics.is_none()))
        {
            return None;
        }
        let (angle_deg, shift_mm) = self.distance(&prior.camera_from_lps, &settled.solution.camera_from_lps);
        Some(Refusal::PriorContradicted { matched: settled.matches.len(), rms_px: settled.rms_px(), angle_deg, shift_mm })
    }

    /// The number of accidents expected behind the match.
    fn check_chance(&self, candidate: &Candidate, settled: &Settled, hypothesis: &Hypothesis) -> Result<f64, Refusal> {
        let expected = self.chance_of_solved(hypothesis, candidate.tried);
        if expected <= MOST_CHANCE {
            return Ok(expected);
        }
        let matched = settled.matches.len();
        Err(self.mirrored(&settled.solution.intrinsics, matched, None).unwrap_or(Refusal::Chance {
            matched,
            in_view: candidate.hypothesis.in_view,
            rms_px: hypothesis.rms_px,
            expected,
            shadows: self.detections.len(),
            limit: MOST_CHANCE,
            prior_given: self.request.prior.is_some(),
        }))
    }

    /// Refuses a match that is not unique.
    fn check_twins(&self, candidate: &Candidate, settled: &Settled, hypothesis: &Hypothesis) -> Result<(), Refusal> {
        let scale = settled.chi2_per_dof.max(1.0);
        let (matched, prior_given) = (hypothesis.matches.len(), self.request.prior.is_some());
        // With K unknown the search was not held to the prior.
        let others: Vec<Hypothesis> =
            candidate.others.iter().filter(|other| !self.gate_excludes(&other.camera_from_lps)).cloned().collect();
        let anywhere = !prior_given || self.without_prior;
        let best = |others: &[Hypothesis]| rival(&candidate.hypothesis, others, scale, anywhere).cloned();
        // Where the search has ended with the first good match, not all that share shadows with it are among the others.
        let sharing = || {
            let sharing = self.sharing(candidate, settled);
            best(&sharing).or_else(|| sharing.into_iter().find(|other| other.matches.len() >= matched + ORDINARY))
        };
        if let Some(other) = best(&others).or_else(sharing) {
            let own = (&hypothesis.camera_from_lps, matched, hypothesis.rms_px);
            // Two that fit as well are both wrong where the mirror image fits far better.
            let mirrored = self.mirrored(&settled.solution.intrinsics, matched, Some(hypothesis.rms_px));
            return Err(mirrored.unwrap_or_else(|| {
                self.ambiguous(Rival::OtherNames, own, (&other.camera_from_lps, other.matches.len(), other.rms_px))
            }));
        }
        self.hear_others(candidate, settled);
        if self.request.intrinsics.is_some()
            && let Some((twin, other_fit)) =
                mirrored(&settled.matches, &settled.solution.camera_from_lps, &settled.solution.intrinsics)
        {
            let fit: f64 = settled.solution.chi2.iter().sum();
            if other_fit - fit < 12.0 * scale && !self.gate_excludes(&twin) {
                let own = (&hypothesis.camera_from_lps, matched, fit);
                return Err(self.ambiguous(Rival::Flat, own, (&twin, matched, other_fit)));
            }
            let why = self.excluded(&twin).unwrap_or(Rejected::FitsWorse { chi2_more: other_fit - fit });
            self.hear(Reading::TiltedPlane, None, &hypothesis.camera_from_lps, why);
        }
        Ok(())
    }

    /// What the beads say of K against what is stated of it: a word where they differ, a refusal where they contradict each other.
    ///
    /// At the solution the deviation d of a number from its prior has the variance σ² − C, with σ of the prior and C after the beads; where
    /// the beads add nothing, neither says anything.
    fn check_intrinsics(&self, settled: &Settled) -> Result<Option<String>, Refusal> {
        let Free::Known(prior) = self.request.free() else { return Ok(None) };
        let full = Options { sigma_mm_share: 1.0, ..settled.options };
        let last = &settled.solution;
        let solution = solve(&settled.matches, &last.camera_from_lps, &last.intrinsics, &full).ok_or(Refusal::Unsolved)?;
        // Beads that are worse than stated move K farther than stated.
        let scale = (solution.chi2.iter().sum::<f64>() / (2 * settled.matches.len()) as f64).max(1.0);
        let mut word = None;
        for (n, (number, off_px, sigma_px)) in prior.deviations(&solution.intrinsics).into_iter().enumerate() {
            let gained = sigma_px.powi(2) - solution.covariance[(6 + n, 6 + n)];
            if !(gained > LEAST_GAIN * sigma_px.powi(2)) {
                continue;
            }
            let times = off_px.abs() / (gained * scale).sqrt();
            if !(times <= OFF_INTRINSICS.1) {
                return Err(Refusal::IntrinsicsContradicted { number, off_px, sigma_px, times, limit: OFF_INTRINSICS.1 });
            }
            if times > OFF_INTRINSICS.0 {
                word = Some(format!(
                    "the beads put the {number} {off_px:+.1} px from where it is stated to be within {sigma_px:.1} px: check K, SID and pitch"
                ));
            }
        }
        Ok(word)
    }

    fn check_uncertainty(&self, settled: &Settled, covariance: &DMatrix<f64>, notes: &mut Vec<String>) -> Result<(), Refusal> {
        let sigma = |n: usize| covariance[(n, n)].sqrt();
        let known = self.request.free() == Free::Pose;
        if !known {
            let (focal_px, sigma_px) = (settled.solution.intrinsics.fx, sigma(6));
            if !(sigma_px / focal_px <= FOCAL_SIGMA.0) {
                return Err(Refusal::FocalDegenerate { focal_px, sigma_px });
            }
            if sigma_px / focal_px > FOCAL_SIGMA.1 {
                notes.push(format!(
                    "focal length {focal_px:.0} ± {sigma_px:.0} px and depth are poorly separated; places near the beads are not affected"
                ));
            }
        }
        let turn_deg = sigma(0).max(sigma(1)).max(sigma(2)).to_degrees();
        let (across_mm, along_mm) = (sigma(3).max(sigma(4)), sigma(5));
        // A solved principal point shifts with the beads, a solved focal length with their depth; FOCAL_SIGMA has judged those.
        let share = if known { 0.0 } else { FOCAL_SIGMA.0 * settled.solution.centroid_mm.z };
        let limits = MOST_SIGMA;
        if !(turn_deg <= limits[0] && across_mm <= limits[1].max(share) && along_mm <= limits[2].max(share)) {
            return Err(Refusal::Uncertain { turn_deg, across_mm, along_mm, limits });
        }
        Ok(())
    }
}

/// A match that nothing speaks against.
struct Believed {
    settled: Settled,
    covariance: DMatrix<f64>,
    unstated: Vec<Nuisance>,
    chance: f64,
    cautions: Cautions,
}

/// Beads that are seen lie before the detector, whatever K is: their depths and the detector's are as the focal length together. Nothing is said of
/// a solved K, which has another distance.
fn behind_detector(request: &Registration, settled: &Settled) -> Option<String> {
    let detector_mm = settled.solution.intrinsics.fx * request.pitch_mm.filter(|_| settled.options.free == Free::Pose)?;
    let depth_mm = |lps_mm: DVec3| settled.solution.camera_from_lps.transform_point(lps_mm).z;
    let deepest = settled.matches.iter().max_by(|a, b| depth_mm(a.lps_mm).total_cmp(&depth_mm(b.lps_mm)))?;
    let (behind_mm, name) = (depth_mm(deepest.lps_mm) - detector_mm, &request.layout.beads[deepest.bead].name);
    // Along the beam a bead is known to some millimetres.
    (behind_mm > 0.002 * detector_mm).then(|| {
        format!(
            "{name} would lie {behind_mm:.0} mm behind the detector, which is {detector_mm:.0} mm from the source: check SID, pitch, and the layout's scale"
        )
    })
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec2};

    use super::super::solve::Match;
    use super::*;
    use crate::beads::{Bead, BeadLayout};
    use crate::geometry::{Intrinsics, Rigid};

    /// A pitch of the isocentre in a header put beads behind its own detector, without a word.
    #[test]
    fn beads_behind_the_detector_are_a_doubt() {
        let k = Intrinsics { fx: 4000.0, fy: 4000.0, skew: 0.0, cx: 511.5, cy: 511.5 };
        let camera_from_lps = Rigid::translation(DVec3::new(0.0, 0.0, 960.0));
        let places = [[40.0, 0.0, 30.0], [-40.0, 5.0, 0.0], [0.0, 40.0, -20.0], [10.0, -40.0, 10.0], [20.0, 20.0, -30.0]];
        let matches: Vec<Match> = (0..)
            .zip(places.map(DVec3::from_array))
            .map(|(bead, lps_mm)| Match {
                bead,
                detection: bead,
                lps_mm,
                image_px: k.project(camera_from_lps.transform_point(lps_mm)) + DVec2::ZERO,
                sigma_px: 0.05,
                noise_px2: [0.0025, 0.0, 0.0025],
                place_mm2: DMat3::from_diagonal(DVec3::splat(1e-4)),
            })
            .collect();
        let options = Options::least_squares(Free::Pose);
        let solution = solve(&matches, &camera_from_lps, &k, &options).expect("regular");
        let settled = Settled { solution, matches, left_out: Vec::new(), merged: Vec::new(), chi2_per_dof: 1.0, options };
        let beads = places.iter().enumerate().map(|(n, at)| Bead::new(format!("b{n}"), DVec3::from_array(*at))).collect();
        let layout = BeadLayout { beads, ..BeadLayout::none() };
        let said = |pitch_mm: Option<f64>| {
            behind_detector(&Registration { pitch_mm, intrinsics: Some(k), ..Registration::new([1024; 2], &layout) }, &settled)
        };
        let words = said(Some(0.24)).expect("a doubt");
        assert!(words.starts_with("b0 would lie 30 mm behind the detector, which is 960 mm"), "{words}");
        assert_eq!((said(Some(0.25)), said(None)), (None, None), "the controls");
    }
}

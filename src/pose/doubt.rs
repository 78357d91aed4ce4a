//! What speaks against a match that fits: beads that should be seen and are not, shadows that belong to none, another reading of the
//! remaining shadows, a mirror image.
//!
//! A wrong match of a layout that resembles itself fits as well as a right one does. What tells them apart is what the frame would have to
//! show besides.

use nalgebra::Matrix6;

use super::besides::Besides;
use super::case::{Case, GATE};
use super::cautions::Cautions;
use super::explained::{Reading, Rejected};
use super::prior::Prior;
use super::radii::{RadiusRatio, SizedShadow};
use super::refusal::{Refusal, Rival};
use super::search::Hypothesis;
use super::settle::Settled;
use super::solve::{Match, about, deviation};
use crate::beads::Probe;
use crate::geometry::Rigid;

/// So many beads may be missing, or migrated, from a sound layout.
pub(super) const ORDINARY: usize = 2;
/// Another reading of as many shadows counts where its squared standard deviations are less by so much, and where nothing else tells the two
/// apart, unless they are more by so much.
const FAR_BETTER: f64 = 15.0;
pub(super) const ALIKE: f64 = 12.0;
/// A second reading is nearer the prior from this difference of squared standard deviations on.
const NEARER: f64 = 12.0;
/// χ² per degree of freedom beyond which residuals are a reason for doubt, where one shadow lies beside its bead's place, and where more do.
const LOOSE_CHI2: f64 = 4.0;
const LOOSE_CHI2_OF_SEVERAL: f64 = 2.25;
/// From here on the mirror image, and other readings than the prior's, are looked at.
const UNEASY_CHI2: f64 = 1.5;
/// Squared standard deviations from the prior (six degrees of freedom) beyond which it is said, and for so few beads refused.
const FAR_FROM_PRIOR: f64 = 14.0;
const FEW: usize = 5;

/// Residuals below this are nobody's concern.
pub(super) const LEAST_RMS_PX: f64 = 0.15;

/// Fewer beads than this follow one that is not where it should be.
const FOLLOWING: usize = 10;
/// Residuals that are larger by accident once in two hundred times, in standard deviations; with many beads, once in two thousand.
const UNLIKELY: f64 = 2.6;
pub(super) const UNLIKELY_OF_MANY: f64 = 3.3;

/// How unlikely χ² per degree of freedom is, as standard deviations of a Gaussian (Wilson and Hilferty 1931).
pub(super) fn chi2_sigmas(per_dof: f64, dof: i64) -> f64 {
    let ninth = 2.0 / (9.0 * dof.max(1) as f64);
    (per_dof.max(0.0).cbrt() - (1.0 - ninth)) / ninth.sqrt()
}

impl Case<'_> {
    /// Refuses a match although it fits, or gives the cautions that a person should look at.
    pub fn doubt(&self, last: &Settled, hypothesis: &Hypothesis) -> Result<Cautions, Refusal> {
        let matched = last.matches.len();
        let besides = self.besides(last);
        let Besides { missing, displaced, unexplained } = &besides;
        let mut cautions = Cautions::default();
        let strays = match &self.probe {
            Some(_) => missing.len() + displaced.len() >= ORDINARY && unexplained.len() + displaced.len() >= ORDINARY,
            // Without the picture nobody knows whether a bead is hidden, nor whether a shadow is like a bead's.
            None => hypothesis.in_view >= matched + ORDINARY && self.detections.len() >= matched + ORDINARY,
        };
        let own = &last.solution.camera_from_lps;
        let uneasy = strays || last.chi2_per_dof > UNEASY_CHI2;
        let mirrored = if uneasy { self.mirrored(&last.solution.intrinsics, matched, Some(last.rms_px())) } else { None };
        if let Some(refusal) = mirrored {
            return Err(refusal);
        }
        let sought = |sought: bool| if sought { Rejected::NotFound } else { Rejected::NotSought };
        self.hear(Reading::MirrorImage, None, own, sought(uneasy));
        let guided = self.request.prior.is_some() && !self.without_prior && !self.request.ignore_prior;
        if guided {
            // Shadows that are left may be beads of the same layout under other names, whose own places the prior puts out of the frame.
            let left = uneasy || unexplained.len() >= ORDINARY;
            let better = if left { self.better_elsewhere(last, hypothesis, FAR_BETTER) } else { None };
            if let Some(refusal) = better {
                return Err(refusal);
            }
            self.hear(Reading::Elsewhere, None, own, sought(left));
        }
        self.check_moved_twin(last, guided, &mut cautions)?;
        let many_missing = missing.len() > ORDINARY && (missing.len() >= matched || unexplained.len() >= missing.len());
        if many_missing && !self.is_best_of_all(last, &besides) {
            let (missing, unexplained) = (missing.clone(), unexplained.len());
            return Err(Refusal::Missing { matched, missing, unexplained });
        }
        self.check_residual(last, displaced, &mut cautions)?;
        self.check_given_intrinsics(last, &mut cautions)?;
        self.check_lens(last, &mut cautions)?;
        self.check_radii(last, &mut cautions)?;
        self.check_correspondences(last, &mut cautions);
        self.check_second(last, hypothesis, unexplained, &mut cautions)?;
        self.check_prior(last, hypothesis, &mut cautions)?;
        self.doubt_put(last, &mut cautions);
        self.doubt_moved(last, &mut cautions);
        let rests_on = |m: &Match| last.matches.iter().any(|used| used.bead == m.bead);
        let merged: Vec<_> = last.merged.iter().filter(|(m, _)| rests_on(m)).collect();
        if !merged.is_empty() {
            let name = |bead: usize| self.request.layout.beads[bead].name.as_str();
            let pairs: Vec<String> = merged.iter().map(|(m, other)| format!("{} and {}", name(m.bead), name(*other))).collect();
            cautions.doubt(format!(
                "the shadows of {} run into one, and the pose rests on it for want of others: bring more beads into view, or turn the arm",
                pairs.join(", of ")
            ));
        }
        if !missing.is_empty() {
            cautions.missing = missing.len();
            cautions.say(format!("not seen although their places are clear: {}", missing.join(", ")));
        }
        Ok(cautions)
    }

    /// Where the layout fits the frame as well elsewhere, the prior alone, if the match is `guided` by one, tells which of the two it is.
    fn check_moved_twin(&self, last: &Settled, guided: bool, cautions: &mut Cautions) -> Result<(), Refusal> {
        let (own, matched) = (&last.solution.camera_from_lps, last.matches.len());
        let Some(twin) = self.moved_twin(last) else {
            self.hear(Reading::MovedLayout, None, own, Rejected::NotFound);
            return Ok(());
        };
        if !guided || twin.excess < -FAR_BETTER * last.chi2_per_dof.max(1.0) {
            let other = (&twin.camera_from_lps, matched, twin.rms_px);
            return Err(self.ambiguous(Rival::OtherNames, (own, matched, last.rms_px()), other));
        }
        self.hear(Reading::MovedLayout, Some((&twin.camera_from_lps, matched, twin.rms_px)), own, Rejected::Doubted);
        let (angle_deg, shift_mm) = self.distance(&twin.camera_from_lps, own);
        cautions.doubt(format!(
            "the beads fit the frame as well {angle_deg:.1}° and {shift_mm:.1} mm away, under other names: that they are not seen from there \
             rests on the prior alone"
        ));
        Ok(())
    }

    /// Shadows beside the places of their beads are outliers where the others fit as they should, and a wrong layout or K where not.
    fn check_residual(&self, last: &Settled, displaced: &[String], cautions: &mut Cautions) -> Result<(), Refusal> {
        let (chi2, matched) = (last.chi2_per_dof, last.matches.len());
        let limit = match displaced.len() {
            0 => f64::INFINITY,
            1 => LOOSE_CHI2,
            _ => LOOSE_CHI2_OF_SEVERAL,
        };
        if !(chi2 <= limit) {
            return Err(Refusal::Displaced { matched, rms_px: last.rms_px(), times: chi2.sqrt(), displaced: displaced.to_vec() });
        }
        let (dof, elsewhere) = (last.solution.degrees_of_freedom, self.elsewhere(last));
        if matched < FOLLOWING && chi2_sigmas(chi2, dof) > UNLIKELY {
            cautions.doubt(format!(
                "{matched} beads fit {:.1} times worse than noise and bead positions allow, and so few follow one that has moved or another's \
                 shadow: bring more into view, or state their sigma_mm",
                chi2.sqrt()
            ));
        } else if matched < FOLLOWING && 3 * elsewhere >= matched {
            cautions.doubt(format!(
                "{elsewhere} of {} beads whose shadows are found do not stand where the others have them: which of them moved one view hardly tells",
                matched + elsewhere
            ));
        } else if chi2_sigmas(chi2, dof) > UNLIKELY_OF_MANY {
            cautions.doubt(format!(
                "{matched} beads fit {:.1} times worse than noise and bead positions allow: did some of them move together, is K right, or is \
                 their sigma_mm larger?",
                chi2.sqrt()
            ));
        }
        Ok(())
    }

    /// Beads whose shadow is not where the others have it, or that have none but one that is nobody's close by.
    fn elsewhere(&self, last: &Settled) -> usize {
        let beads = &self.request.layout.beads;
        let merged = |bead: usize| last.merged.iter().any(|(m, other)| m.bead == bead || *other == bead);
        let unknown = (0..beads.len()).filter(|bead| !merged(*bead) && !last.known().any(|m| m.bead == *bead));
        let close_by = |bead: &usize| {
            let place =
                last.solution.place(beads[*bead].lps_mm).1.filter(|at| self.can_show(*at) && !self.request.is_outside(*at));
            place.is_some_and(|at| self.nearest_free(last, at).is_some())
        };
        last.left_out.len() + unknown.filter(close_by).count()
    }

    /// A bead that a person has named, and that does not stand where it is said to be by all others.
    fn check_correspondences(&self, last: &Settled, cautions: &mut Cautions) {
        let stands = |m: &Match, (bead, shadow): &(usize, usize)| m.bead == *bead && m.detection == *shadow;
        let kept = |pair: &(usize, usize)| {
            last.matches.iter().any(|m| stands(m, pair)) || last.merged.iter().any(|(m, _)| stands(m, pair))
        };
        let given = self.pinned.iter().take(self.request.correspondences.len()).zip(self.request.correspondences);
        let contradicted: Vec<&str> = given.filter(|(pair, _)| !kept(pair)).map(|(_, given)| given.bead.as_str()).collect();
        if !contradicted.is_empty() {
            cautions.doubt(format!(
                "{} named by correspondence: by all others it is not the shadow that was meant; check names and places in that file, or the bead has moved",
                contradicted.join(", ")
            ));
        }
    }

    /// The size of the shadows against depth and size of the beads. Only values that are proportional to quanta, or their logarithms, show
    /// the size of what is in the beam; of grey values of unknown scale it is only said: their curve changes what half the depth is.
    fn check_radii(&self, last: &Settled, cautions: &mut Cautions) -> Result<(), Refusal> {
        let quantitative = self.probe.as_ref().is_some_and(Probe::is_quantitative);
        let Some(radii) = self.radius_ratio(last) else { return Ok(()) };
        let ratio = radii.ratio;
        if quantitative && radii.is_contradicting() {
            return Err(Refusal::Radii { ratio });
        }
        if radii.is_doubtful() {
            cautions.doubt(format!(
                "the shadows are {:.0} % {} than the beads' radii give at their depth: check the layout's scale, the beads' radius, and SID and pitch",
                100.0 * (ratio - 1.0).abs(),
                if ratio < 1.0 { "smaller" } else { "larger" }
            ));
        }
        Ok(())
    }

    /// Of the matched beads.
    fn radius_ratio(&self, last: &Settled) -> Option<RadiusRatio> {
        let (pose, k) = (last.solution.camera_from_lps, last.solution.intrinsics);
        let sized = |m: &Match| {
            let radius_mm = self.request.layout.radius_mm(m.bead, self.request.bead_radius_mm)?;
            let expected_px = k.fx * radius_mm / pose.transform_point(m.lps_mm).z;
            Some(SizedShadow::new(self.detections.get(m.detection)?, expected_px))
        };
        RadiusRatio::of(last.matches.iter().filter_map(sized).collect())
    }

    /// A second reading of the shadows that are left.
    fn check_second(
        &self,
        last: &Settled,
        hypothesis: &Hypothesis,
        unexplained: &[usize],
        cautions: &mut Cautions,
    ) -> Result<(), Refusal> {
        let refusal = |second: &Hypothesis| {
            let own = (&hypothesis.camera_from_lps, last.matches.len(), hypothesis.rms_px);
            self.ambiguous(Rival::SecondSet, own, (&second.camera_from_lps, second.matches.len(), second.rms_px))
        };
        let (second, cut_short) = self.second_reading(last, unexplained);
        if let Some(second) = second {
            return Err(refusal(&second));
        }
        if cut_short {
            cautions.doubt(format!(
                "so many of the {} shadows belong to no bead that not all could be tried for a second reading: {}",
                self.detections.len(),
                self.request.fewer_shadows(true)
            ));
        }
        self.hear(Reading::SecondSet, None, &hypothesis.camera_from_lps, Rejected::NotFound);
        let Some(second) = self.second_near(last, unexplained) else { return Ok(()) };
        let explains = second.matches.len();
        let squares = |pose: &Rigid| self.off_prior(pose).map_or(0.0, |(squares, _)| squares);
        let nearer_the_prior = squares(&last.solution.camera_from_lps) - squares(&second.camera_from_lps) > NEARER;
        if nearer_the_prior || 3 * explains >= 2 * unexplained.len() {
            return Err(refusal(&second));
        }
        let found = (&second.camera_from_lps, explains, second.rms_px);
        self.hear(Reading::SecondSetClose, Some(found), &hypothesis.camera_from_lps, Rejected::Doubted);
        let (angle_deg, shift_mm) = self.distance(&second.camera_from_lps, &hypothesis.camera_from_lps);
        cautions.doubt(format!(
            "{explains} of {} clear shadows that belong to no bead fit the layout {angle_deg:.1}° and {shift_mm:.1} mm away",
            unexplained.len()
        ));
        Ok(())
    }

    /// A pose that few beads carry is not believed far from the prior; of others it is said.
    fn check_prior(&self, last: &Settled, hypothesis: &Hypothesis, cautions: &mut Cautions) -> Result<(), Refusal> {
        let pose = &last.solution.camera_from_lps;
        let Some((prior, (squares, _))) = self.request.prior.zip(self.off_prior(pose)) else { return Ok(()) };
        if squares <= FAR_FROM_PRIOR {
            if let Some(words) = self.off_depth(last, prior) {
                cautions.doubt(words);
            }
            return Ok(());
        }
        let (angle_deg, shift_mm) = self.distance(&prior.camera_from_lps, pose);
        let matched = last.matches.len();
        if (matched <= FEW || self.contradicts(last, prior)) && !self.request.ignore_prior {
            return Err(Refusal::PriorContradicted { matched, rms_px: last.rms_px(), angle_deg, shift_mm });
        }
        // So far from it the prior does not decide between two readings that fit alike.
        if let Some(refusal) = self.better_elsewhere(last, hypothesis, -ALIKE * last.chi2_per_dof.max(1.0)) {
            return Err(refusal);
        }
        cautions.is_far_from_prior = true;
        cautions.doubt(format!(
            "{angle_deg:.1}° and {shift_mm:.1} mm from the prior, {:.1} standard deviations: check K, SID, the layout's scale, and the prior",
            squares.sqrt()
        ));
        Ok(())
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
}

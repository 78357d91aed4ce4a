//! A registration with tags: they start the search for beads, are checked against its pose, and stand alone where beads are too few.

use super::case::Case;
use super::judge::MOST_SIGMA;
use super::prior::Prior;
use super::record::{BodyPose, Pose};
use super::refusal::Refusal;
use super::register::register_masked;
use super::request::Registration;
use super::residual::TagResidual;
use super::settle::Settled;
use super::solve::{Free, Options, Solution, about, deviation};
use super::tagged::{CORNER_SIGMA_PX, TOLD_APART, TagPose, View, corners, estimate, off_by, views};
use super::unstated::unstated;
use crate::acquire::Frame;
use crate::beads::tags::{SeenTag, TagLayout};
use crate::geometry::{Intrinsics, Rigid};
use crate::mask::Masks;

/// Squared distance of a tag's corner from where the beads put it, in standard deviations of corner, tag and beads, beyond which the two
/// contradict each other.
const CONTRADICTS: f64 = 30.0;
/// Tags that agree with each other and contradict the beads, from which on the beads are not believed either.
const WITNESSES: usize = 2;
/// χ² per degree of freedom of the corners up to which tags alone give a pose.
const MOST_CHI2_PER_DOF: f64 = 9.0;

/// [`register_masked`] with the tags that `seen` shows of those in `layout`. Without beads the pose is that of the tags. K is taken as it
/// is stated: of a tag's corners nobody knows how they share K's uncertainty with the beads.
#[must_use]
pub fn register_tagged(request: &Registration, frame: &Frame, masks: &Masks, layout: &TagLayout, seen: &[SeenTag]) -> Pose {
    let request = &Registration { intrinsics_prior: None, round_field: request.round_field_of(frame, masks), ..*request };

    let seen = &request.straight_tags(seen);

    let views = views(layout, seen);
    let tags = Tags { request, layout, seen, views: &views, pose: pose_of(request, layout, seen, &views) };
    let pose = if request.layout.beads.is_empty() {
        tags.alone(None)
    } else {
        let pose = tags.beads(frame, masks);
        if pose.is_accepted() { tags.confront(pose) } else { tags.instead_of(pose) }
    };
    tags.record(pose).on_panel(frame)
}

fn pose_of(request: &Registration, layout: &TagLayout, seen: &[SeenTag], views: &[View]) -> Result<TagPose, Refusal> {
    let k = request.intrinsics.ok_or(Refusal::TagsWithoutIntrinsics)?;
    if views.is_empty() {
        let mut others: Vec<u32> = seen.iter().map(|seen| seen.id).collect();
        others.dedup();
        return Err(Refusal::NoTags { listed: layout.tags.len(), others });
    }
    estimate(views, &k)
}

/// The tags of one frame.
struct Tags<'a> {
    request: &'a Registration<'a>,
    layout: &'a TagLayout,
    seen: &'a [SeenTag],
    views: &'a [View<'a>],
    pose: Result<TagPose, Refusal>,
}

impl Tags<'_> {
    fn ids(&self, which: impl Fn(usize) -> bool) -> Vec<u32> {
        self.views.iter().enumerate().filter(|(n, _)| which(*n)).map(|(_, view)| view.tag.id).collect()
    }

    fn case(&self) -> Case<'_> {
        Case {
            request: self.request,
            detections: &[],
            pinned: Vec::new(),
            barred: Vec::new(),
            probe: None,
            without_prior: false,
            everywhere: Default::default(),
            heard: Default::default(),
        }
    }

    /// Those that read only in the mirror image.
    fn mirrored(&self) -> Option<Refusal> {
        let tags = self.ids(|n| self.views[n].seen.mirrored);
        (!tags.is_empty()).then_some(Refusal::MirroredTags { tags })
    }

    /// The pose from beads, sought where the tags put it. A fused prior is a measurement: the search starts there.
    fn beads(&self, frame: &Frame, masks: &Masks) -> Pose {
        let plain = || register_masked(self.request, frame, masks);
        let Ok(found) = self.pose.as_ref().map_err(|_| ()) else { return plain() };
        if self.request.fuse || self.mirrored().is_some() {
            return plain();
        }
        let near = |start: Prior| {
            let request = Registration { prior: Some(&start), ignore_prior: false, ..*self.request };
            let mut pose = register_masked(&request, frame, masks);
            pose.prior_from("of the tags");
            pose
        };
        let mut accepted: Vec<Pose> = found.starts().into_iter().map(near).filter(Pose::is_accepted).collect();
        // Beads at both solutions of a plane tell nothing: they are looked at without the tags.
        match (accepted.pop(), accepted.pop()) {
            (Some(mut pose), None) => {
                let used = found.agrees.iter().filter(|agrees| **agrees).count();
                pose.notes.push(format!("the beads were sought where {used} tags put them"));
                self.against_prior(pose)
            }
            _ => plain(),
        }
    }

    /// The prior that was typed still counts, although the search did not start there.
    fn against_prior(&self, mut pose: Pose) -> Pose {
        let (Some(prior), Some(found)) = (self.request.prior, pose.camera_from_lps) else { return pose };
        let case = self.case();
        if !case.gate_excludes(&found) {
            return pose;
        }
        let (angle_deg, shift_mm) = case.distance(&prior.camera_from_lps, &found);
        if prior.covariance.is_some() && !self.request.ignore_prior {
            let (matched, rms_px) = (pose.beads.iter().filter(|bead| bead.used).count(), pose.rms_px.unwrap_or(f64::NAN));
            let refusal = Refusal::PriorContradicted { matched, rms_px, angle_deg, shift_mm };
            return Pose {
                notes: pose.notes,
                shadows: pose.shadows,
                detections: pose.detections,
                ..self.request.refuse(&refusal)
            };
        }
        pose.doubt(format!(
            "tags and beads agree on a pose {angle_deg:.1}° and {shift_mm:.1} mm away from the prior: check the prior"
        ));
        pose
    }

    /// Beads gave a pose: the tags' corners have to be where it puts them.
    fn confront(&self, mut pose: Pose) -> Pose {
        let Some((k, camera_from_lps)) = pose.camera() else { return pose };
        let Some(solution) = solution_of(&pose, &k, &camera_from_lps) else { return pose };
        let off: Vec<f64> = self.views.iter().map(|view| mean_off(view, &solution, &k)).collect();
        let wrong = |n: usize| !(off[n] <= CONTRADICTS);
        let contradicting = self.ids(wrong);
        if contradicting.is_empty() {
            return pose;
        }
        let off_px = self.views.iter().enumerate().filter(|(n, _)| wrong(*n)).map(|(_, view)| rms_px(view, &k, &camera_from_lps));
        let off_px = off_px.fold(0.0, f64::max);
        let together = self
            .pose
            .as_ref()
            .ok()
            .filter(|found| found.agrees.iter().enumerate().filter(|(n, agrees)| **agrees && wrong(*n)).count() >= WITNESSES);
        let Some(found) = together else {
            pose.doubt(format!(
                "the corners of tags {contradicting:?} are up to {off_px:.1} px from where the beads put them: the beads are believed; check lps_from_tag and size_mm, and whether a tag has moved"
            ));
            return pose;
        };
        let centre = pose.centroid_lps_mm.unwrap_or_default();
        let (angle, shift_mm) = super::search::apart(&found.solution.camera_from_lps, &camera_from_lps, centre);
        let beads = pose.beads.iter().filter(|bead| bead.used).count();
        let refusal = Refusal::TagsContradicted { tags: contradicting, off_px, beads, angle_deg: angle.to_degrees(), shift_mm };
        Pose {
            notes: pose.notes,
            cautions: pose.cautions,
            shadows: pose.shadows,
            detections: pose.detections,
            ..self.request.refuse(&refusal)
        }
    }

    /// Beads gave none. Where the tags' pose leaves too few of them in the frame, that is no wonder, and the tags may stand alone.
    fn instead_of(&self, refused: Pose) -> Pose {
        let Ok(found) = &self.pose else { return refused };
        let (Some(k), pose) = (self.request.intrinsics, found.solution.camera_from_lps) else { return refused };
        let [width, height] = self.request.size_px.map(f64::from);
        let in_frame = |bead: &&crate::beads::Bead| {
            let p = pose.transform_point(bead.lps_mm);
            let at = k.project(p);
            p.z > 1.0 && at.x >= 0.0 && at.y >= 0.0 && at.x <= width - 1.0 && at.y <= height - 1.0
        };
        let expected = self.request.layout.beads.iter().filter(in_frame).count();
        let unsound = self.request.layout.refused.is_some();
        if unsound || expected >= self.request.fewest() {
            return refused;
        }
        let alone = self.alone(Some(&refused));
        if alone.is_accepted() { alone } else { refused }
    }

    /// The pose of the tags, if it may be believed without beads.
    fn alone(&self, beads: Option<&Pose>) -> Pose {
        match self.believed() {
            Ok(found) => self.accept(found, beads),
            Err(refusal) => self.request.refuse(&refusal),
        }
    }

    fn believed(&self) -> Result<&TagPose, Refusal> {
        let found = self.pose.as_ref().map_err(Clone::clone)?;
        if let Some(mirrored) = self.mirrored() {
            return Err(mirrored);
        }
        let tags = self.ids(|n| found.agrees[n]);
        let agreeing = tags.len();
        // One that was put right, alone, may be any other; and of two that differ nobody knows which one is wrong.
        let outvoted = self.views.len() - agreeing;
        let corrected = self.views.iter().zip(&found.agrees).any(|(view, agrees)| *agrees && view.seen.hamming > 0);
        if agreeing <= outvoted || (agreeing == 1 && corrected) {
            return Err(Refusal::TagsDisagree { tags: self.ids(|_| true), agreeing });
        }
        if !(found.chi2_per_dof <= MOST_CHI2_PER_DOF) {
            let (times, limit) = (found.chi2_per_dof.sqrt(), MOST_CHI2_PER_DOF.sqrt());
            return Err(Refusal::TagCorners { tags, times, limit });
        }
        if let Some((twin, worse)) = found.twin.filter(|_| !found.is_told_apart()) {
            let centre = found.solution.camera_from_lps.inverse().transform_point(found.solution.centroid_mm);
            let (angle, shift_mm) = super::search::apart(&found.solution.camera_from_lps, &twin, centre);
            let limit = TOLD_APART * found.chi2_per_dof.max(1.0);
            return Err(Refusal::FlatTags { tags, angle_deg: angle.to_degrees(), shift_mm, worse, limit });
        }
        let covariance = found.covariance();
        let sigma = |n: usize| covariance[(n, n)].sqrt();
        let turn_deg = sigma(0).max(sigma(1)).max(sigma(2)).to_degrees();
        let (across_mm, along_mm) = (sigma(3).max(sigma(4)), sigma(5));
        let limits = MOST_SIGMA;
        if !(turn_deg <= limits[0] && across_mm <= limits[1] && along_mm <= limits[2]) {
            return Err(Refusal::Uncertain { turn_deg, across_mm, along_mm, limits });
        }
        if let Some(prior) = self.request.prior.filter(|_| !self.request.ignore_prior) {
            let apart = deviation(&found.solution.camera_from_lps, &prior.camera_from_lps);
            let centre = found.solution.camera_from_lps.inverse().transform_point(found.solution.centroid_mm);
            let case = self.case();
            let gate = case.gate(prior);
            // A prior without covariance is about a centre: that of the tags, where there are no beads.
            let information = match prior.covariance {
                Some(_) => gate.information,
                None => {
                    let (turn, shift) = super::PRIOR_SIGMA;
                    super::gate::information_about(prior.camera_from_lps.transform_point(centre), turn, shift)
                }
            };
            if !((apart.transpose() * information * apart)[(0, 0)] <= gate.limit) {
                let (angle, shift_mm) = super::search::apart(&found.solution.camera_from_lps, &prior.camera_from_lps, centre);
                return Err(Refusal::PriorAgainstTags { tags, angle_deg: angle.to_degrees(), shift_mm });
            }
        }
        Ok(found)
    }

    fn accept(&self, found: &TagPose, beads: Option<&Pose>) -> Pose {
        let settled = Settled {
            solution: found.solution.clone(),
            matches: found.matches.clone(),
            left_out: Vec::new(),
            merged: Vec::new(),
            chi2_per_dof: found.chi2_per_dof,
            options: Options::least_squares(Free::Pose),
        };
        let mut notes = self.request.layout.notes.clone();
        notes.push(format!(
            "the pose is that of tags alone; their corners are taken to be good to {CORNER_SIGMA_PX} px, which beads would check"
        ));
        let (unstated, said) = unstated(self.request, &settled);
        let mut pose = self.case().accept(&settled, &found.covariance(), &unstated, 0.0, notes);
        (pose.chance, pose.fused) = (None, false);
        said.into_iter().for_each(|word| word.tell(&mut pose));
        for view in self.views {
            if pose.bodies.iter().all(|body| body.name != view.tag.body) {
                let (name, lps_from_body) = (view.tag.body.clone(), Rigid::IDENTITY);
                pose.bodies.push(BodyPose { name, lps_from_body, beads: 0, used: 0, covariance_at_centroid: None });
            }
        }
        if let Some(refused) = beads {
            let why = refused.reason.as_deref().unwrap_or("no reason given");
            pose.cautions
                .push(format!("the beads gave no pose ({why}), and too few of them are in the frame; this one is of tags alone"));
            (pose.shadows, pose.detections) = (refused.shadows.clone(), refused.detections);
        }
        let disagreeing = self.ids(|n| !found.agrees[n]);
        if !disagreeing.is_empty() {
            pose.cautions.push(format!("tags {disagreeing:?} disagree with the others and are left out"));
        }
        pose
    }

    /// Every tag that was seen, and what it did for the pose.
    fn record(&self, mut pose: Pose) -> Pose {
        let (camera, covered) = (pose.camera(), solution_and_k(&pose));
        pose.tags = self
            .seen
            .iter()
            .map(|seen| {
                let own = self.views.iter().position(|view| std::ptr::eq(view.seen, seen));
                let residual_px = own.zip(camera.as_ref()).map(|(n, (k, at))| rms_px(&self.views[n], k, at));
                let agrees = own.is_some_and(|n| self.pose.as_ref().is_ok_and(|found| found.agrees[n]));
                let fits = own
                    .zip(covered.as_ref())
                    .is_none_or(|(n, (solution, k))| mean_off(&self.views[n], solution, k) <= CONTRADICTS);
                let reason = match own {
                    None if self.layout.tags.iter().any(|tag| tag.id == seen.id) => Some("seen more than once"),
                    None => Some("not in the list"),
                    Some(_) if self.request.intrinsics.is_none() => Some("tags need K"),
                    Some(_) if !agrees => Some("disagrees with the other tags"),
                    Some(_) if !fits => Some("contradicts the beads"),
                    Some(_) => None,
                };
                TagResidual {
                    id: seen.id,
                    family: seen.family,
                    corners_px: seen.corners_px.map(|corner| corner.to_array()),
                    margin: seen.margin,
                    inverted: seen.inverted,
                    mirrored: seen.mirrored,
                    residual_px,
                    used: reason.is_none() && pose.is_accepted(),
                    reason: reason.map(str::to_owned),
                }
            })
            .collect();
        if let Err(refusal) = &self.pose
            && !self.request.layout.beads.is_empty()
        {
            pose.notes.push(format!("tags did not help: {refusal}"));
        } else if let Some(mirrored) = self.mirrored().filter(|_| !self.request.layout.beads.is_empty()) {
            pose.notes.push(format!("tags did not start the search: {mirrored}"));
        }
        pose
    }
}

/// √mean(dx² + dy²) of a tag's corners.
fn rms_px(view: &View, k: &Intrinsics, pose: &Rigid) -> f64 {
    let squared = |corner: super::solve::Match| corner.image_px.distance_squared(k.project(pose.transform_point(corner.lps_mm)));
    (corners(view).map(squared).sum::<f64>() / 4.0).sqrt()
}

/// Mean over a tag's corners of their squared distance from where a pose puts them, in standard deviations.
fn mean_off(view: &View, solution: &Solution, k: &Intrinsics) -> f64 {
    corners(view).map(|corner| off_by(&corner, solution, &solution.covariance, k).unwrap_or(f64::INFINITY)).sum::<f64>() / 4.0
}

/// An accepted pose in the solver's words: covariance about the centroid.
fn solution_of(pose: &Pose, k: &Intrinsics, camera_from_lps: &Rigid) -> Option<Solution> {
    let rows = pose.covariance.as_ref()?;
    let centroid_mm = camera_from_lps.transform_point(pose.centroid_lps_mm?);
    let there = about(centroid_mm);
    let own = nalgebra::Matrix6::from_fn(|i, j| rows[i][j]);
    let moved = there * own * there.transpose();
    Some(Solution {
        camera_from_lps: *camera_from_lps,
        intrinsics: *k,
        residuals_px: Vec::new(),
        chi2: Vec::new(),
        prior_chi2: 0.0,
        degrees_of_freedom: 0,
        covariance: nalgebra::DMatrix::from_fn(6, 6, |i, j| moved[(i, j)]),
        centroid_mm,
    })
}

fn solution_and_k(pose: &Pose) -> Option<(Solution, Intrinsics)> {
    let (k, camera_from_lps) = pose.camera()?;
    Some((solution_of(pose, &k, &camera_from_lps)?, k))
}

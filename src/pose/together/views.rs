//! What the common solution says of each view, and of each bead.

use glam::{DVec2, DVec3};
use nalgebra::Matrix6;

use super::record::{BeadVerdict, SolvedBead};
use super::setup::{Blocks, Observation, Setup, place_covariance};
use super::strays::Sorted;
use crate::beads::Landmark;
use crate::estimate::{Covariance, Estimate, about};
use crate::geometry::{Intrinsics, Projection, Rigid};
use crate::mask::Disc;
use crate::pose::accept::{landmarks_of, rows_of};
use crate::pose::cautions::{is_of_header_k, is_of_looseness, is_of_residuals, is_of_round_field, larger_residuals};
use crate::pose::flat::{Loose, hold, is_off_plane, worst_landmark};
use crate::pose::nuisance::{Nuisance, Word};
use crate::pose::record::{BodyPose, Pose};
use crate::pose::request::Registration;
use crate::pose::residual::BeadResidual;
use crate::pose::settle::Settled;
use crate::pose::shadow::square;
use crate::pose::solve::{Free, Match, Options, Solution};
use crate::pose::unseen::Unseen;
use crate::pose::unstated::unstated;

/// The common solution.
pub struct Common<'s> {
    pub setup: &'s Setup<'s>,
    pub blocks: &'s Blocks,
    pub estimate: &'s Estimate<'s>,
    pub covariance: &'s Covariance,
    /// What covariances are scaled by.
    pub scale: f64,
    pub sorted: &'s Sorted,
    pub landmarks: &'s [Landmark],
    /// Of each view that an image intensifier may have taken.
    pub round_fields: &'s [Option<Disc>],
    /// Of each view whose K is its header's.
    pub are_k_of_header: &'s [bool],
}

impl Common<'_> {
    /// Standard deviations of (fx, fy, cx, cy).
    pub fn intrinsics_sigma_px(&self) -> Option<[f64; 4]> {
        let of = self.covariance.of(&[self.blocks.intrinsics[0].id()]);
        let sigma = |n: usize| (self.scale * of[(n, n)]).sqrt();
        (self.setup.free != Free::Pose).then(|| [sigma(0), sigma(0), sigma(1), sigma(2)])
    }

    /// The pose of a view, from what it was alone.
    pub fn pose(&self, view: usize, alone: &Pose) -> Pose {
        let (setup, blocks) = (self.setup, self.blocks);
        let (camera, k) = (setup.cameras[view], setup.intrinsics[view]);
        let motion = self.estimate.state().motion(blocks.cameras[view]);
        let covariance = self.covariance.of(&[blocks.cameras[view].id(), blocks.intrinsics_of(view).id()]) * self.scale;
        let at_centroid = Matrix6::from_fn(|i, j| covariance[(i, j)]);
        let back = about(-motion.centre_mm());
        let own = (0..setup.layout.beads.len()).map(|n| self.bead(view, n, alone));
        let checks = alone.beads.iter().filter(|bead| bead.check).map(|bead| Self::check(&camera, &k, bead));
        let beads: Vec<BeadResidual> = own.chain(checks).collect();
        let used: Vec<f64> =
            beads.iter().filter(|bead| bead.used).filter_map(|bead| bead.residual_px).map(|[u, v]| u * u + v * v).collect();
        let rms_px = (used.iter().sum::<f64>() / used.len().max(1) as f64).sqrt();
        let solution = Solution {
            camera_from_lps: camera,
            intrinsics: k,
            residuals_px: Vec::new(),
            chi2: Vec::new(),
            prior_chi2: 0.0,
            degrees_of_freedom: self.estimate.degrees_of_freedom(),
            covariance,
            centroid_mm: motion.centre_mm(),
        };
        let mut shadows = alone.shadows.clone();
        for shadow in &mut shadows {
            let rests = |name: &String| beads.iter().any(|bead| bead.used && bead.name == *name);
            shadow.bead = shadow.bead.take().filter(rests);
        }
        let bodies = BodyPose::of_beads(&beads, |n| self.lps_from_body(view, n));
        // What its own beads hold loosely all views together may hold: how loosely is told anew, at a landmark where one is asked for.
        let at_landmark = worst_landmark(&solution, self.landmarks, &solution.covariance);
        let is_asked = at_landmark.is_some();
        let is_round = self.round_fields[view].is_some();
        let is_told_anew =
            |words: &str| (is_asked && is_of_looseness(words)) || (is_round && is_of_round_field(words)) || is_of_header_k(words);
        let stands = |words: &str| !(is_off_plane(words) || is_of_residuals(words) || is_told_anew(words));
        let chi2_per_dof = self.estimate.chi2_sum() / self.estimate.degrees_of_freedom().max(1) as f64;
        let (unstated, said) = self.unstated(view, &solution, chi2_per_dof, alone.size_px);
        let holds = |n: &usize| beads[*n].used && self.lps_from_body(view, *n) == Rigid::IDENTITY;
        let places_mm: Vec<DVec3> = (0..setup.layout.beads.len()).filter(holds).map(|n| setup.layout.beads[n].lps_mm).collect();
        let loose = hold(&solution, &places_mm, at_landmark, &solution.covariance);
        let mm_per_px = alone.source_to_isocentre_mm.unwrap_or(motion.centre_mm().z) / k.fx;
        let mut pose = Pose {
            projection: Some(Projection::compose(&k, &camera)),
            intrinsics: Some(k),
            intrinsics_source: Some(setup.free.source().to_owned()),
            intrinsics_sigma_px: self.intrinsics_sigma_px(),
            camera_from_lps: Some(camera),
            bodies,
            rms_px: Some(rms_px),
            rms_mm: Some(rms_px * mm_per_px),
            unseen: Unseen::of(&beads, mm_per_px),
            chi2_per_dof: Some(chi2_per_dof),
            covariance: Some(rows_of(&(back * at_centroid * back.transpose()))),
            covariance_at_centroid: Some(rows_of(&at_centroid)),
            centroid_lps_mm: Some(motion.pivot_mm),
            landmarks: landmarks_of(self.landmarks, &solution, &solution.covariance, &unstated),
            beads,
            shadows,
            doubt: alone.doubt.clone().filter(|words| stands(words)),
            cautions: alone.cautions.iter().filter(|words| stands(words)).cloned().collect(),
            notes: alone.notes.iter().filter(|words| stands(words)).cloned().collect(),
            ..alone.clone()
        };
        match loose {
            Some(Loose::AtLandmark(words)) => pose.doubt(words),
            Some(Loose::OffPlane(words)) => pose.cautions.push(words),
            Some(Loose::NearlyFlat(words)) => pose.notes.push(words),
            None => {}
        }
        said.into_iter().for_each(|word| word.tell(&mut pose));
        pose.notes.extend(larger_residuals(chi2_per_dof));
        pose.on_panel_anew()
    }

    /// What nobody states of a view, as far as its own beads, in their places by the layout, leave that open: S of a lens turns with
    /// the arm, so that other views tell little of it, and places that were solved from all views have taken up part of a lens.
    fn unstated(
        &self,
        view: usize,
        solution: &Solution,
        chi2_per_dof: f64,
        size_px: Option<[u32; 2]>,
    ) -> (Vec<Nuisance>, Vec<Word>) {
        let setup = self.setup;
        let holds =
            |o: &Observation| o.view == view && !setup.freed[o.bead] && self.lps_from_body(view, o.bead) == Rigid::IDENTITY;
        let matched = |(n, o): (usize, &Observation)| {
            let Observation { bead, image_px, sigma_px, noise_px2, .. } = *o;
            let (lps_mm, place_mm2) = (setup.layout.beads[bead].lps_mm, setup.layout.beads[bead].place_mm2());
            Match { bead, detection: n, lps_mm, image_px, sigma_px, noise_px2, place_mm2 }
        };
        let settled = Settled {
            solution: solution.clone(),
            matches: setup.observations.iter().enumerate().filter(|(_, o)| holds(o)).map(matched).collect(),
            left_out: Vec::new(),
            merged: Vec::new(),
            chi2_per_dof,
            options: Options::least_squares(setup.free),
        };
        let (round_field, is_k_of_header, landmarks) = (self.round_fields[view], self.are_k_of_header[view], self.landmarks);
        let size_px = size_px.unwrap_or_default();
        unstated(&Registration { round_field, is_k_of_header, landmarks, ..Registration::new(size_px, setup.layout) }, &settled)
    }

    fn lps_from_body(&self, view: usize, bead: usize) -> Rigid {
        self.setup.segment_of(view, bead).map_or(Rigid::IDENTITY, |n| self.setup.segments[n].lps_from_body)
    }

    /// A bead of role `check` against the pose of all views.
    fn check(camera_from_lps: &Rigid, k: &Intrinsics, alone: &BeadResidual) -> BeadResidual {
        let p = camera_from_lps.transform_point(alone.lps_mm);
        let predicted = (p.z > 1.0).then(|| k.project(p));
        let off = |at: DVec2| Some((DVec2::from_array(alone.image_px?) - at).to_array());
        BeadResidual {
            predicted_px: predicted.map(|at| at.to_array()),
            residual_px: predicted.and_then(off),
            off_sigmas: None,
            ..alone.clone()
        }
    }

    fn bead(&self, view: usize, bead: usize, alone: &Pose) -> BeadResidual {
        let setup = self.setup;
        let own = &setup.layout.beads[bead];
        let p = (setup.cameras[view] * self.lps_from_body(view, bead)).transform_point(own.lps_mm);
        let predicted = (p.z > 1.0).then(|| setup.intrinsics[view].project(p));
        let seen = setup.observations.iter().position(|o| o.view == view && o.bead == bead);
        let row = alone.beads.iter().find(|row| row.name == own.name);
        let aside = self.sorted.aside.iter().find(|aside| aside.view == view && aside.bead == bead);
        let image = match seen {
            Some(n) => Some(setup.observations[n].image_px),
            None => row.and_then(|row| row.image_px).map(DVec2::from_array),
        };
        let left_out = seen.and_then(|n| self.estimate.left_out_linear(self.covariance, self.blocks.images[n]).ok());
        let verdict = self.sorted.verdicts[bead];
        let reason = match (seen, aside, verdict) {
            (Some(_), ..) if setup.freed[bead] => Some("it has migrated since the scan, as all views agree".to_owned()),
            (Some(_), ..) => None,
            (None, Some(_), Some(BeadVerdict::Unclear)) => {
                Some("it has moved, or one of its shadows is not its own; these views cannot tell which".to_owned())
            }
            (None, Some(_), Some(BeadVerdict::Inconsistent)) => Some("no one place explains its shadows in all views".to_owned()),
            (None, Some(_), _) if setup.seen_in(bead).next().is_none() => {
                Some("no view that is left has it elsewhere or in its place: where it is cannot be told".to_owned())
            }
            (None, Some(aside), _) => {
                Some(format!("its shadow here is {:.2} px from where the other views put it", aside.off_px))
            }
            (None, None, _) => row.and_then(|row| row.reason.clone()).or_else(|| Some("no shadow found".to_owned())),
        };
        BeadResidual {
            name: own.name.clone(),
            body: own.body.clone(),
            lps_mm: own.lps_mm,
            covariance_mm2: own.stated_mm2(),
            image_px: image.map(|at| at.to_array()),
            predicted_px: predicted.map(|at| at.to_array()),
            residual_px: image.zip(predicted).map(|(at, predicted)| (at - predicted).to_array()),
            sigma_px: seen.map(|n| setup.observations[n].sigma_px).or_else(|| row.and_then(|row| row.sigma_px)),
            covariance_px2: seen
                .map(|n| square(setup.observations[n].noise_px2))
                .or_else(|| row.and_then(|row| row.covariance_px2)),
            left_out_px: left_out.as_ref().map(|found| [found.offset[0], found.offset[1]]),
            beside_px: row.and_then(|row| row.beside_px).filter(|_| image.is_none()),
            off_sigmas: left_out.map(|found| found.chi2.sqrt()),
            used: seen.is_some() && !setup.freed[bead],
            reason,
            check: false,
        }
    }

    /// A bead's place.
    pub fn solved(&self, bead: usize) -> SolvedBead {
        let setup = self.setup;
        let own = &setup.layout.beads[bead];
        let views = setup.seen_in(bead).count();
        let verdict = match self.sorted.verdicts[bead] {
            Some(verdict) => verdict,
            None if views == 0 && self.sorted.aside.iter().any(|aside| aside.bead == bead) => BeadVerdict::Unclear,
            None if views == 0 => BeadVerdict::NotSeen,
            None if setup.freed[bead] => BeadVerdict::Migrated,
            None => BeadVerdict::InPlace,
        };
        let (place, covariance) = match self.blocks.beads[bead] {
            Some(block) => (setup.places_mm[bead], place_covariance(self.covariance, block) * self.scale),
            None => {
                let own_mm2 = own.place_mm2();
                (own.lps_mm, nalgebra::Matrix3::from_fn(|i, j| own_mm2.col(j)[i]))
            }
        };
        SolvedBead {
            name: own.name.clone(),
            body: own.body.clone(),
            lps_mm: place,
            sigma_mm: std::array::from_fn(|n| covariance[(n, n)].sqrt()),
            covariance_mm2: std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (covariance[(i, j)] + covariance[(j, i)]))),
            moved_mm: place.distance(own.lps_mm),
            migrated: verdict == BeadVerdict::Migrated,
            verdict,
            views,
        }
    }
}

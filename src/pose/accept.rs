//! The record of a pose that is believed.

use glam::DVec2;
use nalgebra::{DMatrix, Matrix6};

use super::case::Case;
use super::nuisance::Nuisance;
use super::record::{BodyPose, Covariance, LandmarkUncertainty, Pose, Status};
use super::residual::BeadResidual;
use super::settle::Settled;
use super::shadow::{Shadow, square};
use super::solve::{Free, Solution, about, left_out};
use super::unseen::Unseen;
use crate::beads::{Bead, Detection, Landmark};
use crate::estimate::LeftOut;
use crate::geometry::{Projection, Rigid};

impl Case<'_> {
    pub fn accept(
        &self,
        last: &Settled,
        covariance: &DMatrix<f64>,
        unstated: &[Nuisance],
        accident: f64,
        mut notes: Vec<String>,
    ) -> Pose {
        let rms_px = last.rms_px();
        let (pose, k) = (last.solution.camera_from_lps, last.solution.intrinsics);
        let layout = self.request.layout;
        let centroid = last.solution.centroid_mm;
        let at_centroid = Matrix6::from_fn(|i, j| covariance[(i, j)]);
        let back = about(-centroid);
        let about_origin = back * at_centroid * back.transpose();
        let projection = Projection::compose(&k, &pose);
        let unseen = self.left_out(last);
        let own = layout.beads.iter().enumerate().map(|(n, bead)| self.bead(last, covariance, &unseen, n, bead));
        let checks = layout.checks.iter().map(|bead| self.check(last, covariance, bead));
        let beads: Vec<BeadResidual> = own.chain(checks).collect();
        let source_to_isocentre_mm = self.request.isocentre_beside(centroid.z);
        let mm_per_px = source_to_isocentre_mm.unwrap_or(centroid.z) / k.fx;
        let bodies = BodyPose::of_beads(&beads, |_| Rigid::IDENTITY);
        if bodies.len() > 1 {
            notes.push("beads of several bodies agree as one rigid specimen".to_owned());
        }
        let free = self.request.free();
        let shadow = |(n, detection): (usize, &Detection)| {
            let bead = last.matches.iter().find(|m| m.detection == n).map(|m| layout.beads[m.bead].name.clone());
            Shadow::of(detection, bead)
        };
        let shadows = self.detections.iter().enumerate().map(shadow).collect();
        Pose {
            status: Status::Accepted,
            projection: Some(projection),
            intrinsics: Some(k),
            intrinsics_source: Some(free.source().to_owned()),
            intrinsics_sigma_px: (free != Free::Pose).then(|| {
                let sigma = |n: usize| covariance[(n, n)].sqrt();
                [sigma(6), sigma(6), sigma(7), sigma(8)]
            }),
            size_px: Some(self.request.size_px),
            pitch_mm: self.request.pitch_mm,
            camera_from_lps: Some(pose),
            bodies,
            rms_px: Some(rms_px),
            rms_mm: Some(rms_px * mm_per_px),
            source_to_isocentre_mm,
            unseen: Unseen::of(&beads, mm_per_px),
            chi2_per_dof: Some(last.chi2_per_dof),
            chance: Some(accident),
            covariance: Some(rows_of(&about_origin)),
            covariance_at_centroid: Some(rows_of(&at_centroid)),
            centroid_lps_mm: Some(pose.inverse().transform_point(centroid)),
            landmarks: landmarks_of(self.request.landmarks, &last.solution, covariance, unstated),
            beads,
            detections: self.detections.len(),
            shadows,
            fused: self.request.fuse,
            notes,
            version: Some(env!("CARGO_PKG_VERSION").to_owned()),
            ..Pose::default()
        }
    }

    fn bead(
        &self,
        last: &Settled,
        covariance: &DMatrix<f64>,
        unseen: &[Option<LeftOut>],
        index: usize,
        bead: &Bead,
    ) -> BeadResidual {
        let (at, predicted) = last.solution.place(bead.lps_mm);
        let used = last.matches.iter().position(|m| m.bead == index);
        let rejected = last.left_out.iter().find(|(m, _)| m.bead == index);
        let observed = used.map(|n| last.matches[n]).or_else(|| rejected.map(|(m, _)| *m));
        let left_out = used.and_then(|n| unseen[n].as_ref());
        let beside = match observed {
            None => predicted.filter(|at| !self.request.is_outside(*at)).and_then(|at| self.nearest_free(last, at)),
            Some(_) => None,
        };
        let beside = beside.map(|n| (self.detections[n].image_px - at, self.detections[n].noise_px2()));
        let reason = match (used, rejected) {
            (Some(_), _) => None,
            (None, Some((_, off))) => Some(format!("its shadow is {:.2} px from where the other beads put it", off.length())),
            (None, None) if predicted.is_none() => Some("behind the source".to_owned()),
            (None, None) if self.request.is_outside(at) => Some("outside the frame".to_owned()),
            (None, None) if last.merged.iter().any(|(m, other)| m.bead == index || *other == index) => {
                Some("its shadow and another bead's run into one".to_owned())
            }
            (None, None) if !self.can_show(at) => Some("behind the collimator, or where else the frame shows nothing".to_owned()),
            (None, None) => Some(match beside {
                Some((off, _)) => {
                    format!("no shadow where it should be; one that belongs to no bead is {:.1} px away", off.length())
                }
                None => "no shadow found where it should be".to_owned(),
            }),
        };
        let off = rejected.map(|(m, off)| (*off, m.noise_px2)).or(beside);
        BeadResidual {
            name: bead.name.clone(),
            body: bead.body.clone(),
            lps_mm: bead.lps_mm,
            covariance_mm2: bead.stated_mm2(),
            image_px: observed.map(|m| m.image_px.to_array()),
            predicted_px: predicted.map(|p| p.to_array()),
            residual_px: observed.zip(predicted).map(|(m, p)| (m.image_px - p).to_array()),
            sigma_px: observed.map(|m| m.sigma_px),
            covariance_px2: observed.map(|m| square(m.noise_px2)),
            left_out_px: left_out.map(|found| [found.offset[0], found.offset[1]]),
            beside_px: beside.map(|(off, _)| off.to_array()),
            off_sigmas: left_out.map(|found| found.chi2.sqrt()).or_else(|| {
                let (off, noise_px2) = off?;
                last.off_sigmas(covariance, (bead.lps_mm, bead.place_mm2()), noise_px2, off)
            }),
            used: used.is_some(),
            reason,
            check: false,
        }
    }

    /// A bead of role `check` against the free shadow next to its place.
    fn check(&self, last: &Settled, covariance: &DMatrix<f64>, bead: &Bead) -> BeadResidual {
        let (at, predicted) = last.solution.place(bead.lps_mm);
        let nearest = predicted.and_then(|at| self.nearest_free(last, at)).map(|n| &self.detections[n]);
        let off = nearest.zip(predicted).map(|(shadow, at)| shadow.image_px - at);
        BeadResidual {
            image_px: nearest.map(|shadow| shadow.image_px.to_array()),
            predicted_px: predicted.map(|at| at.to_array()),
            residual_px: off.map(|off| off.to_array()),
            sigma_px: nearest.map(|shadow| shadow.sigma_px),
            covariance_px2: nearest.map(|shadow| square(shadow.noise_px2())),
            off_sigmas: nearest
                .zip(off)
                .and_then(|(shadow, off)| last.off_sigmas(covariance, (bead.lps_mm, bead.place_mm2()), shadow.noise_px2(), off)),
            check: true,
            ..self.request.row(
                bead,
                match (nearest, predicted) {
                    (Some(_), _) => "a check bead: P is judged by it and does not rest on it",
                    (None, Some(_)) if self.request.is_outside(at) => "a check bead outside the frame",
                    (None, Some(_)) => "a check bead of which no shadow was found",
                    (None, None) => "a check bead behind the source",
                },
            )
        }
    }

    /// The shadow next to `at` that is no bead's.
    pub(super) fn nearest_free(&self, last: &Settled, at: DVec2) -> Option<usize> {
        let free = |n: &usize| !last.known().any(|m| m.detection == *n);
        let distance = |n: &usize| self.detections[*n].image_px.distance(at);
        let near = |n: &usize| distance(n) < 4.0 * self.detections[*n].radius_px;
        (0..self.detections.len()).filter(free).filter(near).min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }

    /// Residual of each used bead under the pose of all others, the prior among them where it is fused.
    pub(super) fn left_out(&self, last: &Settled) -> Vec<Option<LeftOut>> {
        // At least one other bead must be left to contradict it.
        if last.solution.degrees_of_freedom < 4 {
            return vec![None; last.matches.len()];
        }
        left_out(&last.matches, &last.solution, &last.options)
    }
}

/// Uncertainty where it was asked for; `covariance` is the solution's, scaled perhaps, and `unstated` what counts besides.
pub(super) fn landmarks_of(
    landmarks: &[Landmark],
    solution: &Solution,
    covariance: &DMatrix<f64>,
    unstated: &[Nuisance],
) -> Vec<LandmarkUncertainty> {
    let of = |landmark: &Landmark| {
        let p = solution.camera_from_lps.transform_point(landmark.lps_mm);
        let by_beads = solution.sharpness(landmark.lps_mm, covariance);
        let sharpness = unstated.iter().fold(by_beads, |known, open| open.with(&known, solution, landmark.lps_mm));
        LandmarkUncertainty {
            name: landmark.name.clone(),
            lps_mm: landmark.lps_mm,
            image_px: (p.z > 1.0).then(|| solution.intrinsics.project(p).to_array()),
            sigma_mm: std::array::from_fn(|n| sharpness.camera_mm2[(n, n)].sqrt()),
            sigma_px: sharpness.image_px2.map(|image| [image[(0, 0)].sqrt(), image[(1, 1)].sqrt()]),
            covariance_px2: sharpness.image_px2.map(|image| {
                let across = 0.5 * (image[(0, 1)] + image[(1, 0)]);
                [[image[(0, 0)], across], [across, image[(1, 1)]]]
            }),
        }
    };
    landmarks.iter().map(of).collect()
}

pub(super) fn rows_of(m: &Matrix6<f64>) -> Covariance {
    std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (m[(i, j)] + m[(j, i)])))
}

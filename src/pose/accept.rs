//! The record of a pose that is believed.

use glam::DVec2;
use nalgebra::{DMatrix, Matrix6};

use super::case::Case;
use super::record::{BeadResidual, BodyPose, Covariance, LandmarkUncertainty, Pose, Shadow, Status};
use super::settle::Settled;
use super::solve::{Free, Solution, about, left_out};
use crate::beads::{Bead, Detection, Landmark};
use crate::estimate::LeftOut;
use crate::geometry::{Projection, Rigid};

impl Case<'_> {
    pub fn accept(&self, last: &Settled, covariance: &DMatrix<f64>, accident: f64, mut notes: Vec<String>) -> Pose {
        let rms_px = last.rms_px();
        let (pose, k) = (last.solution.camera_from_lps, last.solution.intrinsics);
        let layout = self.request.layout;
        let centroid = last.solution.centroid_mm;
        let at_centroid = Matrix6::from_fn(|i, j| covariance[(i, j)]);
        let back = about(-centroid);
        let about_origin = back * at_centroid * back.transpose();
        let projection = Projection::compose(&k, &pose);
        let unseen = self.left_out(last);
        let beads: Vec<BeadResidual> =
            layout.beads.iter().enumerate().map(|(n, bead)| self.bead(last, &unseen, n, bead, &projection)).collect();
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
            rms_mm: Some(rms_px * centroid.z / k.fx),
            chi2_per_dof: Some(last.chi2_per_dof),
            chance: Some(accident),
            covariance: Some(rows_of(&about_origin)),
            covariance_at_centroid: Some(rows_of(&at_centroid)),
            centroid_lps_mm: Some(pose.inverse().transform_point(centroid)),
            landmarks: landmarks_of(self.request.landmarks, &last.solution, covariance),
            beads,
            detections: self.detections.len(),
            shadows,
            fused: self.request.fuse,
            notes,
            version: Some(env!("CARGO_PKG_VERSION").to_owned()),
            ..Pose::default()
        }
    }

    fn bead(&self, last: &Settled, unseen: &[Option<DVec2>], index: usize, bead: &Bead, projection: &Projection) -> BeadResidual {
        let (at, depth_mm) = projection.project(bead.lps_mm);
        let predicted = (depth_mm > 1.0).then_some(at);
        let used = last.matches.iter().position(|m| m.bead == index);
        let rejected = last.left_out.iter().find(|(m, _)| m.bead == index);
        let observed = used.map(|n| last.matches[n]).or_else(|| rejected.map(|(m, _)| *m));
        let [width, height] = self.request.size_px.map(f64::from);
        let outside = at.x < 0.0 || at.y < 0.0 || at.x > width - 1.0 || at.y > height - 1.0;
        let reason = match (used, rejected) {
            (Some(_), _) => None,
            (None, Some((_, off))) => Some(format!("its shadow is {:.2} px from where the other beads put it", off.length())),
            (None, None) if predicted.is_none() => Some("behind the source".to_owned()),
            (None, None) if outside => Some("outside the frame".to_owned()),
            (None, None) => Some(self.beside(last, at)),
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

    /// What there is instead of a bead's shadow.
    fn beside(&self, last: &Settled, at: DVec2) -> String {
        let free = |n: &usize| !last.known().any(|m| m.detection == *n);
        let distance = |n: &usize| self.detections[*n].image_px.distance(at);
        let near = |n: &usize| distance(n) < 4.0 * self.detections[*n].radius_px;
        let nearest = (0..self.detections.len()).filter(free).filter(near).min_by(|a, b| distance(a).total_cmp(&distance(b)));
        match nearest {
            Some(n) => format!("no shadow where it should be; one that belongs to no bead is {:.1} px away", distance(&n)),
            None => "no shadow found where it should be".to_owned(),
        }
    }

    /// Residual of each used bead under the pose of all others, the prior among them where it is fused.
    fn left_out(&self, last: &Settled) -> Vec<Option<DVec2>> {
        // At least one other bead must be left to contradict it.
        if last.solution.degrees_of_freedom < 4 {
            return vec![None; last.matches.len()];
        }
        let off = |found: LeftOut| DVec2::new(found.offset[0], found.offset[1]);
        left_out(&last.matches, &last.solution, &last.options).into_iter().map(|found| found.map(off)).collect()
    }
}

/// Uncertainty where it was asked for; `covariance` is the solution's, scaled perhaps.
pub(super) fn landmarks_of(landmarks: &[Landmark], solution: &Solution, covariance: &DMatrix<f64>) -> Vec<LandmarkUncertainty> {
    let of = |landmark: &Landmark| {
        let p = solution.camera_from_lps.transform_point(landmark.lps_mm);
        let sharpness = solution.sharpness(landmark.lps_mm, covariance);
        LandmarkUncertainty {
            name: landmark.name.clone(),
            lps_mm: landmark.lps_mm,
            image_px: (p.z > 1.0).then(|| solution.intrinsics.project(p).to_array()),
            sigma_mm: std::array::from_fn(|n| sharpness.camera_mm2[(n, n)].sqrt()),
            sigma_px: sharpness.image_px2.map(|image| [image[(0, 0)].sqrt(), image[(1, 1)].sqrt()]),
        }
    };
    landmarks.iter().map(of).collect()
}

pub(super) fn rows_of(m: &Matrix6<f64>) -> Covariance {
    std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (m[(i, j)] + m[(j, i)])))
}

//! The record of a pose that is believed.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, Matrix2x3, Matrix6};

use super::case::Case;
use super::record::{BeadResidual, BodyPose, Covariance, LandmarkUncertainty, Pose, Shadow, Status};
use super::settle::Settled;
use super::solve::{Options, about, image_by_point, point_by_pose, solve};
use crate::beads::{Bead, Detection};
use crate::geometry::{Intrinsics, Projection, Rigid};

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
        let beads: Vec<BeadResidual> =
            layout.beads.iter().enumerate().map(|(n, bead)| self.bead(last, n, bead, &projection)).collect();
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
        let solved = self.request.intrinsics.is_none();
        let shadow = |(n, detection): (usize, &Detection)| {
            let bead = last.matches.iter().find(|m| m.detection == n).map(|m| layout.beads[m.bead].name.clone());
            Shadow::of(detection, bead)
        };
        let shadows = self.detections.iter().enumerate().map(shadow).collect();
        let landmarks = self.request.landmarks.iter().map(|landmark| {
            let p = pose.transform_point(landmark.lps_mm);
            let j = point_by_pose(p, centroid);
            let place = j * at_centroid * j.transpose();
            let sigma_px = (p.z > 1.0).then(|| {
                let mut rows = DMatrix::zeros(2, covariance.ncols());
                rows.view_mut((0, 0), (2, 6)).copy_from(&(image_by_point(&k, p) * j));
                if solved {
                    rows.view_mut((0, 6), (2, 3)).copy_from(&Matrix2x3::new(p.x / p.z, 1.0, 0.0, p.y / p.z, 0.0, 1.0));
                }
                let image = &rows * covariance * rows.transpose();
                [image[(0, 0)].sqrt(), image[(1, 1)].sqrt()]
            });
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
            refusal: None,
            projection: Some(projection),
            intrinsics: Some(k),
            intrinsics_source: Some(if solved { "solved" } else { "given" }.to_owned()),
            intrinsics_sigma_px: solved.then(|| {
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
            landmarks: landmarks.collect(),
            beads,
            tags: Vec::new(),
            detections: self.detections.len(),
            shadows,
            fused: self.request.fuse,
            cautions: Vec::new(),
            notes,
            version: Some(env!("CARGO_PKG_VERSION").to_owned()),
        }
    }

    fn bead(&self, last: &Settled, index: usize, bead: &Bead, projection: &Projection) -> BeadResidual {
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
            left_out_px: used.and_then(|n| self.left_out(last, n)).map(|off| off.to_array()),
            used: used.is_some(),
            reason,
        }
    }

    /// Residual of a used bead under the pose of all others.
    fn left_out(&self, last: &Settled, n: usize) -> Option<DVec2> {
        let free = self.free();
        let mut others = last.matches.clone();
        let own = others.remove(n);
        if 2 * others.len() < 6 + free.count() + 2 {
            return None;
        }
        let s = &last.solution;
        let without = solve(&others, &s.camera_from_lps, &s.intrinsics, &Options::least_squares(free))?;
        Some(own.image_px - project(&without.intrinsics, &without.camera_from_lps, own.lps_mm))
    }
}

fn project(k: &Intrinsics, pose: &Rigid, p: DVec3) -> DVec2 {
    k.project(pose.transform_point(p))
}

fn rows_of(m: &Matrix6<f64>) -> Covariance {
    std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (m[(i, j)] + m[(j, i)])))
}

//! How well a layout will fix the pose of a planned view: the covariance of the estimate that beads in the frame give.

use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::DMatrix;
use serde::Serialize;

use crate::beads::{BeadLayout, Landmark};
use crate::estimate::{BeadImage, Freedom, Loss, Place, Problem, Settings, turned};
use crate::geometry::{Intrinsics, Rigid};

/// Views that are planned: the arm turned about the beads' centroid, which lies at the isocentre.
#[derive(Clone, Debug, PartialEq)]
pub struct Planned {
    /// K.
    pub intrinsics: Intrinsics,
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// From the source to the isocentre.
    pub source_to_isocentre_mm: f64,
    /// About the patient's long axis: 0 looks from in front to the back, 90 from the right to the left.
    pub orbital_deg: Vec<f64>,
    /// Towards the feet and the head.
    pub angulation_deg: Vec<f64>,
    /// Standard deviation of a shadow's centre per axis.
    pub sigma_px: f64,
    /// Where uncertainty is wanted besides.
    pub landmarks: Vec<Landmark>,
}

/// What is predicted.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PlannedView {
    /// As planned.
    pub orbital_deg: f64,
    /// As planned.
    pub angulation_deg: f64,
    /// Beads in the frame.
    pub in_view: usize,
    /// Standard deviations of the turn about the camera's axes; absent where the beads in the frame do not fix a pose.
    pub turn_deg: Option<[f64; 3]>,
    /// Of the beads' centroid: across, across, along the beam.
    pub centroid_mm: Option<[f64; 3]>,
    /// Of each landmark's projection: the larger of column and row, at its depth.
    pub landmarks_mm: Vec<(String, f64)>,
}

/// Fewest beads for which anything is predicted.
const FEWEST: usize = 4;

/// `camera_from_lps` of a planned view.
fn camera(planned: &Planned, centre_mm: DVec3, orbital_deg: f64, angulation_deg: f64) -> Rigid {
    // From in front: camera z is posterior (+y), rows go down the patient (−z), columns to the patient's left (+x).
    let front = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y).transpose());
    let orbit = DQuat::from_rotation_z(orbital_deg.to_radians());
    let tilt = DQuat::from_rotation_x(angulation_deg.to_radians());
    let rotation = (front * tilt * orbit).normalize();
    Rigid { rotation, translation_mm: DVec3::Z * planned.source_to_isocentre_mm - rotation * centre_mm }
}

/// One prediction for each orbital and angulation, K being known.
#[must_use]
pub fn predict(layout: &BeadLayout, planned: &Planned) -> Vec<PlannedView> {
    let grid = planned.angulation_deg.iter().flat_map(|a| planned.orbital_deg.iter().map(move |o| (*o, *a)));
    grid.map(|(orbital_deg, angulation_deg)| view(layout, planned, orbital_deg, angulation_deg)).collect()
}

fn view(layout: &BeadLayout, planned: &Planned, orbital_deg: f64, angulation_deg: f64) -> PlannedView {
    let k = planned.intrinsics;
    let camera_from_lps = camera(planned, layout.centroid_lps_mm(), orbital_deg, angulation_deg);
    let [width, height] = planned.size_px.map(f64::from);
    let mut problem = Problem::new();
    let camera = problem.pose("camera_from_lps", camera_from_lps, layout.centroid_lps_mm(), true);
    let intrinsics = problem.vector("intrinsics", &[k.fx, k.fy, k.skew, k.cx, k.cy], Freedom::Constant);
    let mut in_view = 0;
    for bead in &layout.beads {
        let p = camera_from_lps.transform_point(bead.lps_mm);
        let at: DVec2 = k.project(p);
        if !(p.z > 1.0 && at.x >= 0.0 && at.y >= 0.0 && at.x <= width - 1.0 && at.y <= height - 1.0) {
            continue;
        }
        let variance = planned.sigma_px.powi(2);
        let place = Place::Known { body_mm: bead.lps_mm, covariance_mm2: bead.place_mm2(), share: 1.0 };
        problem.add(BeadImage::new(camera, intrinsics, place, at, [variance, 0.0, variance]), Loss::None);
        in_view += 1;
    }
    let mut predicted =
        PlannedView { orbital_deg, angulation_deg, in_view, turn_deg: None, centroid_mm: None, landmarks_mm: Vec::new() };
    let Ok(estimate) = problem.solve(&Settings { iterations: 1, ..Settings::default() }) else { return predicted };
    let Some(covariance) = estimate.covariance().ok().filter(|_| in_view >= FEWEST) else { return predicted };
    let of = covariance.of(&[camera.id()]);
    let sigma = |n: usize| of[(n, n)].sqrt();
    predicted.turn_deg = Some([0, 1, 2].map(|n| sigma(n).to_degrees()));
    predicted.centroid_mm = Some([3, 4, 5].map(sigma));
    let centre = camera_from_lps.transform_point(layout.centroid_lps_mm());
    for landmark in &planned.landmarks {
        let p = camera_from_lps.transform_point(landmark.lps_mm);
        if !(p.z > 1.0) {
            continue;
        }
        // Across the ray, in mm at the landmark's depth.
        let rows = [DVec3::new(1.0, 0.0, -p.x / p.z), DVec3::new(0.0, 1.0, -p.y / p.z)].map(|row| turned(row, p - centre));
        let rows = DMatrix::from_fn(2, 6, |i, j| rows[i][j]);
        let across = covariance.propagate(&[(camera.id(), &rows)]);
        predicted.landmarks_mm.push((landmark.name.clone(), across[(0, 0)].max(across[(1, 1)]).sqrt()));
    }
    predicted
}

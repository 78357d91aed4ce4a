//! Where a prior lets a pose lie.

use glam::DVec3;
use nalgebra::Matrix6;

use super::solve::{about, deviation};
use crate::geometry::Rigid;

/// Where the pose must lie: squared deviation from `camera_from_lps` at most `limit` under `information` (ξ in `camera`).
#[derive(Clone, Copy, Debug)]
pub struct Gate {
    pub camera_from_lps: Rigid,
    pub information: Matrix6<f64>,
    pub limit: f64,
}

impl Gate {
    /// Squared deviation of a pose.
    pub fn squares(&self, pose: &Rigid) -> f64 {
        let r = deviation(pose, &self.camera_from_lps);
        (r.transpose() * self.information * r)[(0, 0)]
    }
}

/// Information about ξ in `camera` from standard deviations about `centre`.
pub fn information_about(centre: DVec3, rotation_rad: f64, shift_mm: f64) -> Matrix6<f64> {
    information_about_each(centre, rotation_rad, [shift_mm; 3])
}

/// [`information_about`] with shifts along x, y and z of their own.
pub fn information_about_each(centre: DVec3, rotation_rad: f64, shift_mm: [f64; 3]) -> Matrix6<f64> {
    let mut local = Matrix6::zeros();
    for n in 0..3 {
        local[(n, n)] = rotation_rad.powi(-2);
        local[(n + 3, n + 3)] = shift_mm[n].powi(-2);
    }
    let t = about(centre);
    t.transpose() * local * t
}

//! How badly a pose is known off the plane of (nearly) flat beads: their own residuals cannot show it.

use glam::{DVec2, DVec3};
use nalgebra::DMatrix;

use super::solve::{Match, Solution};
use super::verdict::spread;

/// The least certain place off the beads' plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OffPlane {
    /// Standard deviation of its projection along the worst direction.
    pub sigma_px: f64,
    pub lps_mm: DVec3,
}

impl OffPlane {
    /// Whether the pose is to be flagged.
    pub fn is_degenerate(&self) -> bool {
        // A σ that is not a number is a flag.
        !(self.sigma_px <= FLAGGED_PX)
    }
}

/// 2 px is too much; σ itself, taken at the estimated pose, is uncertain by a fifth or so.
const FLAGGED_PX: f64 = 1.5;

/// The worst of the places that lie one layout radius off the beads' plane, on either side, above the centroid and above every bead.
/// `covariance` is the solution's, scaled perhaps.
pub fn off_plane(solution: &Solution, matches: &[Match], covariance: &DMatrix<f64>) -> OffPlane {
    let points: Vec<DVec3> = matches.iter().map(|m| m.lps_mm).collect();
    let (_, normal) = spread(&points);
    let centroid = points.iter().copied().sum::<DVec3>() / points.len().max(1) as f64;
    let radius_mm = points.iter().map(|p| p.distance(centroid)).fold(0.0, f64::max);
    let mut worst = OffPlane { sigma_px: 0.0, lps_mm: centroid };
    for foot in points.iter().copied().chain([centroid]) {
        for side in [1.0, -1.0] {
            let lps_mm = foot + normal * (side * radius_mm);
            let Some(image) = solution.sharpness(lps_mm, covariance).image_px2 else { continue };
            // The larger eigenvalue of a 2×2.
            let (mean, half) =
                (0.5 * (image[(0, 0)] + image[(1, 1)]), DVec2::new(0.5 * (image[(0, 0)] - image[(1, 1)]), image[(0, 1)]));
            let sigma_px = (mean + half.length()).sqrt();
            if !(sigma_px <= worst.sigma_px) {
                worst = OffPlane { sigma_px, lps_mm };
            }
        }
    }
    worst
}

//! How badly a pose is known where no bead shows it: at landmarks, and off the plane of (nearly) flat beads. Residuals are small there too.

use glam::{DVec2, DVec3};
use nalgebra::DMatrix;

use super::cautions::LOOSELY;
use super::solve::{Match, Solution};
use super::verdict::spread;
use crate::beads::Landmark;

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

/// A landmark that is more uncertain is no measure of anything.
const LOOSE_PX: f64 = 2.0;

/// The landmark at which a pose is known worst, in words, behind the standard deviation of its projection along the worst direction, px.
/// `None` where none is in front of the source. `covariance` is the solution's, scaled perhaps.
pub(super) fn worst_landmark(solution: &Solution, landmarks: &[Landmark], covariance: &DMatrix<f64>) -> Option<(f64, String)> {
    // A landmark behind the source is in no picture; a σ that is not a number, of either sign, is the worst of all.
    let at = |landmark: &Landmark| {
        let sigma_px = worst_direction_px(solution, landmark.lps_mm, covariance)?;
        Some((if sigma_px.is_nan() { f64::INFINITY } else { sigma_px }, format!("at {}", landmark.name)))
    };
    landmarks.iter().filter_map(at).max_by(|a, b| a.0.total_cmp(&b.0))
}

/// Says that a pose is loose, although it fits, where it is as uncertain as that at a place.
pub(super) fn looseness((sigma_px, place): (f64, String)) -> Option<String> {
    (!(sigma_px <= LOOSE_PX)).then(|| {
        format!(
            "{LOOSELY}: {place} it is uncertain by {sigma_px:.1} px (1 σ); bring more beads into view, farther apart and off one plane"
        )
    })
}

/// Standard deviation of a place's projection along its worst direction; `None` behind the source.
fn worst_direction_px(solution: &Solution, lps_mm: DVec3, covariance: &DMatrix<f64>) -> Option<f64> {
    let image = solution.sharpness(lps_mm, covariance).image_px2?;
    // The larger eigenvalue of a 2×2.
    let (mean, half) = (0.5 * (image[(0, 0)] + image[(1, 1)]), DVec2::new(0.5 * (image[(0, 0)] - image[(1, 1)]), image[(0, 1)]));
    Some((mean + half.length()).sqrt())
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
            let Some(sigma_px) = worst_direction_px(solution, lps_mm, covariance) else { continue };
            if !(sigma_px <= worst.sigma_px) {
                worst = OffPlane { sigma_px, lps_mm };
            }
        }
    }
    worst
}

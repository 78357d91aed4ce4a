//! How badly a pose is known where no bead shows it: at landmarks, and off the plane of (nearly) flat beads. Residuals are small there too.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, Matrix2};

use super::cautions::LOOSELY;
use super::solve::Solution;
use super::verdict::spread;
use crate::beads::Landmark;

/// A landmark that is more uncertain is no measure of anything.
const LOOSE_PX: f64 = 2.0;

/// The landmark at which a pose is known worst, in words, behind the standard deviation of its projection along the worst direction, px.
/// `None` where none is in front of the source. `covariance` is the solution's, scaled perhaps.
pub(super) fn worst_landmark(solution: &Solution, landmarks: &[Landmark], covariance: &DMatrix<f64>) -> Option<(f64, String)> {
    // A landmark behind the source is in no picture.
    let at =
        |landmark: &Landmark| Some((worst_direction_px(solution, landmark.lps_mm, covariance)?, format!("at {}", landmark.name)));
    landmarks.iter().filter_map(at).max_by(|a, b| a.0.total_cmp(&b.0))
}

/// What is said of a pose that its beads hold loosely, although it fits.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Loose {
    /// At a landmark, where somebody wants something: a doubt.
    AtLandmark(String),
    /// Off the beads' plane, where nobody may want anything: a caution.
    OffPlane(String),
    /// The same, of less: a note.
    NearlyFlat(String),
}

/// Words of [`Loose::OffPlane`], and of [`Loose::NearlyFlat`].
const OFF_PLANE: &str = "off their plane";
const NEARLY_FLAT: &str = "the beads are nearly flat: off their plane";

/// Whether a caution or note is of a pose's σ off the plane of its beads: another solution has another.
pub(super) fn is_off_plane(words: &str) -> bool {
    words.contains(NEARLY_FLAT) || (words.contains(LOOSELY) && words.contains(OFF_PLANE))
}

/// How loosely beads at `places_mm` hold a pose: at the worst landmark, as [`worst_landmark`] gives it, or where there is none off their
/// plane. `covariance` is the solution's, scaled perhaps.
pub(super) fn hold(
    solution: &Solution,
    places_mm: &[DVec3],
    at_landmark: Option<(f64, String)>,
    covariance: &DMatrix<f64>,
) -> Option<Loose> {
    let off_plane_px = off_plane_px(solution, places_mm, covariance);
    let is_asked = at_landmark.is_some();
    match looseness(at_landmark.unwrap_or_else(|| (off_plane_px, OFF_PLANE.to_owned()))) {
        Some(words) if is_asked => Some(Loose::AtLandmark(words)),
        Some(words) => Some(Loose::OffPlane(words)),
        // A σ that is not a number is a flag.
        None if !(off_plane_px <= FLAGGED_PX) => Some(Loose::NearlyFlat(format!(
            "{NEARLY_FLAT} the pose is uncertain by {off_plane_px:.1} px, which their own residuals do not show"
        ))),
        None => None,
    }
}

/// Says that a pose is loose, although it fits, where it is as uncertain as that at a place.
fn looseness((sigma_px, place): (f64, String)) -> Option<String> {
    (!(sigma_px <= LOOSE_PX)).then(|| {
        format!(
            "{LOOSELY}: {place} it is uncertain by {sigma_px:.1} px (1 σ); bring more beads into view, farther apart and off one plane"
        )
    })
}

/// Standard deviation of a place's projection along its worst direction, infinite where it is no number; `None` behind the source.
fn worst_direction_px(solution: &Solution, lps_mm: DVec3, covariance: &DMatrix<f64>) -> Option<f64> {
    Some(along_worst_px(&solution.sharpness(lps_mm, covariance).image_px2?))
}

/// Standard deviation along the worst direction, infinite where it is no number.
pub(super) fn along_worst_px(image: &Matrix2<f64>) -> f64 {
    // The larger eigenvalue of a 2×2.
    let (mean, half) = (0.5 * (image[(0, 0)] + image[(1, 1)]), DVec2::new(0.5 * (image[(0, 0)] - image[(1, 1)]), image[(0, 1)]));
    let sigma_px = (mean + half.length()).sqrt();
    if sigma_px.is_nan() { f64::INFINITY } else { sigma_px }
}

/// 2 px is too much; σ itself, taken at the estimated pose, is uncertain by a fifth or so.
const FLAGGED_PX: f64 = 1.5;

/// Standard deviation, px, at the worst of the places that lie one layout radius off the beads' plane, on either side, above the centroid
/// and above every bead; 0 where there are no beads. `covariance` is the solution's, scaled perhaps.
fn off_plane_px(solution: &Solution, places_mm: &[DVec3], covariance: &DMatrix<f64>) -> f64 {
    if places_mm.is_empty() {
        return 0.0;
    }
    let (_, normal) = spread(places_mm);
    let centroid = places_mm.iter().copied().sum::<DVec3>() / places_mm.len() as f64;
    let radius_mm = places_mm.iter().map(|p| p.distance(centroid)).fold(0.0, f64::max);
    let feet = places_mm.iter().copied().chain([centroid]);
    let above = feet.flat_map(|foot| [1.0, -1.0].map(|side| foot + normal * (side * radius_mm)));
    above.filter_map(|lps_mm| worst_direction_px(solution, lps_mm, covariance)).fold(0.0, f64::max)
}

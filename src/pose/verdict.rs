//! What can go wrong with a match, in numbers: degenerate layouts, accidents, twins.

use glam::DVec3;
use nalgebra::Matrix3;

use super::refusal::{Points, Refusal};
use super::search::{Hypothesis, MISSED, apart, shared};
use super::solve::{Match, Options, solve};
use crate::geometry::{Intrinsics, Rigid};

/// Standard deviations of points along their principal axes (mm), largest first, and the axis of the smallest.
pub fn spread(points: &[DVec3]) -> ([f64; 3], DVec3) {
    let count = points.len().max(1) as f64;
    let mean = points.iter().copied().sum::<DVec3>() / count;
    let mut scatter = Matrix3::zeros();
    for p in points {
        let d = *p - mean;
        let d = nalgebra::Vector3::new(d.x, d.y, d.z);
        scatter += d * d.transpose() / count;
    }
    let eigen = scatter.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let axis = eigen.eigenvectors.column(order[2]);
    (order.map(|n| eigen.eigenvalues[n].max(0.0).sqrt()), DVec3::new(axis[0], axis[1], axis[2]))
}

/// Third extent over the first below which beads and their mirror image are seen alike.
const PLATE: f64 = 0.02;

/// Whether points of such extents (mm, largest first) and their mirror image are seen alike.
#[must_use]
pub fn is_plate([first_mm, _, third_mm]: [f64; 3]) -> bool {
    !(third_mm > PLATE * first_mm)
}

/// Standard deviations of points along their principal axes, largest first.
#[must_use]
pub fn extents_mm(points: &[DVec3]) -> [f64; 3] {
    spread(points).0
}

/// Points closer than this are one point.
const COINCIDENT_MM: f64 = 0.05;
/// A layout whose second (third) extent is below this share of its first is a line (a plane).
const FLAT: f64 = 0.02;

/// Checks places for a pose (`k_known`) or a pose and K.
pub fn check_geometry(points: &[DVec3], k_known: bool, of: Points) -> Result<(), Refusal> {
    let mut distinct: Vec<DVec3> = Vec::new();
    for p in points {
        if distinct.iter().all(|other| other.distance(*p) > COINCIDENT_MM) {
            distinct.push(*p);
        }
    }
    let required = if k_known { 4 } else { 6 };
    if distinct.len() < required {
        return Err(Refusal::TooFewBeads { points: of, found: distinct.len(), required, intrinsics_known: k_known });
    }
    let ([first_mm, second_mm, third_mm], _) = spread(&distinct);
    if !(second_mm > (FLAT * first_mm).max(1.0)) {
        return Err(Refusal::Collinear { points: of, first_mm, second_mm });
    }
    if !k_known && !(third_mm > (FLAT * first_mm).max(0.5)) {
        return Err(Refusal::Coplanar { points: of, first_mm, second_mm, third_mm });
    }
    Ok(())
}

/// Accidents expected, at most, behind an accepted match.
pub const MOST_CHANCE: f64 = 0.01;

/// Expected number of accidental poses, of `tried`, that agree with at least `matched` of `in_view` beads as closely as `rms_px`, when
/// `detections` shadows lie at random on `area_px2`.
///
/// k matches make what is solved, two `parameters` each (three a pose, five a pose and K), each other is an accident of probability
/// p = detections · π r² / area with r = 2.5 rms (at least 0.75 px); so the number is tried · P(Binomial(in_view − k, p) ≥ matched − k).
pub fn chance(
    tried: u64,
    matched: usize,
    in_view: usize,
    rms_px: f64,
    detections: usize,
    area_px2: f64,
    parameters: usize,
) -> f64 {
    let made_of = parameters.div_ceil(2);
    if matched <= made_of {
        return f64::INFINITY;
    }
    let degrees = (2 * matched) as f64;
    let radius = 2.5 * (rms_px * (degrees / (degrees - parameters as f64)).sqrt()).max(0.3);
    let others = detections.saturating_sub(made_of).max(1) as f64;
    let p = (others * std::f64::consts::PI * radius * radius / area_px2.max(1.0)).min(1.0);
    let n = in_view.max(matched) - made_of;
    let tail: f64 = (matched - made_of..=n).map(|k| choose(n, k) * p.powi(k as i32) * (1.0 - p).powi((n - k) as i32)).sum();
    tried.max(1) as f64 * tail
}

fn choose(n: usize, k: usize) -> f64 {
    (0..k).map(|i| (n - i) as f64 / (i + 1) as f64).product()
}

/// A different pose that explains the frame (nearly) as well as `best`, if one is among `others`. `scale` ≥ 1 is χ² per degree of
/// freedom of the best. One bead, which may have moved, does not decide between two readings of which nothing else is known (`anywhere`), nor
/// among few.
pub fn rival<'a>(best: &Hypothesis, others: &'a [Hypothesis], scale: f64, anywhere: bool) -> Option<&'a Hypothesis> {
    let centroid = best.matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / best.matches.len().max(1) as f64;
    let count = best.matches.len();
    others.iter().find(|other| {
        let (angle, shift) = apart(&best.camera_from_lps, &other.camera_from_lps, centroid);
        let shared = shared(best, other);
        if angle < 2f64.to_radians() && shift < 15.0 && 2 * shared > count.min(other.matches.len()) {
            return false;
        }
        let margin = 12.0 * scale;
        let same_count = other.matches.len() >= count && other.score < best.score + margin;
        // Another shadow near the place of the one that has moved makes up the number.
        let one_less = (count <= 6 && other.matches.len() + 1 == count || anywhere && other.matches.len() + 1 >= count)
            && shared + 2 < count
            && other.score < best.score + margin + MISSED;
        same_count || one_less
    })
}

/// The twin of a flat layout: the pose whose bead plane is mirrored about the line of sight, re-solved; `None` where it falls back
/// onto the pose itself. Returns it with its Σ χ².
pub fn mirrored(matches: &[Match], pose: &Rigid, intrinsics: &Intrinsics) -> Option<(Rigid, f64)> {
    let points: Vec<DVec3> = matches.iter().map(|m| m.lps_mm).collect();
    let (_, axis) = spread(&points);
    let mean = points.iter().copied().sum::<DVec3>() / points.len().max(1) as f64;
    let centre = pose.transform_point(mean);
    let sight = centre.normalize();
    let mut normal = pose.transform_vector(axis);
    if normal.dot(sight) > 0.0 {
        normal = -normal;
    }
    // Turning the normal onto its mirror image about the line of sight turns the plane through twice its tilt.
    let turn_axis = normal.cross(-sight);
    let tilt = turn_axis.length().atan2(normal.dot(-sight));
    if !(tilt > 0.01) {
        return None;
    }
    let turn = Rigid::exp(turn_axis.normalize() * (2.0 * tilt), DVec3::ZERO);
    let start = Rigid::translation(centre) * turn * Rigid::translation(-centre) * *pose;
    let twin = solve(matches, &start, intrinsics, &Options::least_squares(super::solve::Free::Pose))?;
    let (angle, shift) = apart(&twin.camera_from_lps, pose, mean);
    (angle > 1f64.to_radians() || shift > 15.0).then(|| (twin.camera_from_lps, twin.chi2.iter().sum()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn geometry_is_refused_for_its_reason() {
        let line: Vec<DVec3> = (0..8).map(|n| DVec3::new(10.0 * f64::from(n), 0.0, 0.0)).collect();
        assert!(matches!(check_geometry(&line, true, Points::Layout), Err(Refusal::Collinear { .. })));
        let plane: Vec<DVec3> = (0..9).map(|n| DVec3::new(f64::from(n % 3) * 30.0, f64::from(n / 3) * 30.0, 0.0)).collect();
        assert!(matches!(check_geometry(&plane, false, Points::Layout), Err(Refusal::Coplanar { .. })));
        assert!(check_geometry(&plane, true, Points::Layout).is_ok());
        assert!(matches!(check_geometry(&[DVec3::ONE; 9], true, Points::Layout), Err(Refusal::TooFewBeads { found: 1, .. })));
        assert!(check_geometry(&[DVec3::NAN; 9], true, Points::Layout).is_err());
    }

    #[test]
    fn accidents_get_rarer_with_every_bead() {
        let e = |n| chance(100_000, n, 8, 0.5, 20, 300_000.0, 6);
        assert!(e(5) > e(6) && e(6) > e(7) && e(8) < 1e-6 && e(4) > 1.0);
        // A free K makes up for two beads more.
        let free = |n| chance(100_000, n, 8, 0.5, 20, 300_000.0, 9);
        assert!(free(5).is_infinite() && free(6) > 10.0 * e(6) && free(8) > 10.0 * e(8));
    }
}

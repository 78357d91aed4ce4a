//! A layout that resembles its own mirror image: other names explain the picture's mirror image as well as the match explains the picture.

use glam::{DQuat, DVec2, DVec3};

use super::case::Case;
use super::doubt::ALIKE;
use super::settle::Settled;
use super::solve::{Free, Match, Options, solve};
use super::triangle::align;
use crate::geometry::{Intrinsics, Rigid};

/// Standard deviations of a bead's place, and mm at least, within which a bead may fall on another: along the beam the picture hardly tells.
const ON_ANOTHER: (f64, f64) = (10.0, 1.0);

impl Case<'_> {
    /// Whether the beads of the match, otherwise named, fit the picture's mirror image as well: then nobody can tell from the beads whether
    /// the picture, or the layout, is mirrored.
    pub fn has_mirror_twin(&self, last: &Settled) -> bool {
        let (matches, k) = (&last.matches, &last.solution.intrinsics);
        let places: Vec<DVec3> = self.request.layout.beads.iter().map(|bead| bead.lps_mm).collect();
        let Some(base) = widest(matches) else { return false };
        let depth_mm = last.solution.centroid_mm.z;
        let sigma_mm = |m: &Match| m.sigma_mm.hypot(m.sigma_px * depth_mm / k.fx);
        let scale = last.chi2_per_dof.max(1.0);
        let worst_mm = matches.iter().map(sigma_mm).fold(0.0, f64::max);
        let tolerance_mm = (ON_ANOTHER.0 * scale.sqrt() * worst_mm).max(ON_ANOTHER.1);
        let turned = |p: DVec3| DVec3::new(-p.x, p.y, p.z);
        let source = base.map(|n| turned(matches[n].lps_mm));
        let near = |a: f64, b: f64| (a - b).abs() <= 2.0 * tolerance_mm;
        let is_pair =
            |a: usize, b: usize, i: usize, j: usize| a != b && near(places[a].distance(places[b]), source[i].distance(source[j]));
        let n = places.len();
        let fit: f64 = last.solution.chi2.iter().sum();
        let pairs = (0..n).flat_map(|a| (0..n).map(move |b| (a, b))).filter(|(a, b)| is_pair(*a, *b, 0, 1));
        let triples = pairs.flat_map(|(a, b)| (0..n).map(move |c| [a, b, c]));
        triples.filter(|[a, b, c]| is_pair(*a, *c, 0, 2) && is_pair(*b, *c, 1, 2)).any(|triple| {
            let Some(motion) = align(&source, &triple.map(|bead| places[bead])) else { return false };
            let Some(names) = names(matches, &places, |p| motion.transform_point(turned(p)), tolerance_mm) else { return false };
            self.mirrored_fit(last, &names, &motion).is_some_and(|other| other - fit < ALIKE * scale)
        })
    }

    /// Σ χ² of the picture's mirror image, each shadow that of the bead in `names`; `motion` puts the layout, x negated, onto itself.
    fn mirrored_fit(&self, last: &Settled, names: &[usize], motion: &Rigid) -> Option<f64> {
        let k = &last.solution.intrinsics;
        let end_px = f64::from(self.request.size_px[0]) - 1.0;
        let mirrored = |(m, bead): (&Match, &usize)| Match {
            bead: *bead,
            lps_mm: self.request.layout.beads[*bead].lps_mm,
            image_px: DVec2::new(end_px - m.image_px.x, m.image_px.y),
            ..*m
        };
        let matches: Vec<Match> = last.matches.iter().zip(names).map(mirrored).collect();
        // Camera and layout both seen in a mirror of x.
        let camera = last.solution.camera_from_lps;
        let (q, t) = (camera.rotation, camera.translation_mm);
        let seen = Rigid { rotation: DQuat::from_xyzw(q.x, -q.y, -q.z, q.w), translation_mm: DVec3::new(-t.x, t.y, t.z) };
        let start = seen * motion.inverse();
        let solution = solve(&matches, &start, &mirrored_k(k, end_px), &Options::least_squares(Free::Pose))?;
        Some(solution.chi2.iter().sum())
    }
}

/// K of the mirror image of a picture whose last column is `end_px`.
pub(super) fn mirrored_k(k: &Intrinsics, end_px: f64) -> Intrinsics {
    Intrinsics { cx: end_px - k.cx, skew: -k.skew, ..*k }
}

/// The three matched beads that span the largest triangle.
fn widest(matches: &[Match]) -> Option<[usize; 3]> {
    let n = matches.len();
    let at = |n: usize| matches[n].lps_mm;
    let area = |&[i, j, k]: &[usize; 3]| (at(j) - at(i)).cross(at(k) - at(i)).length_squared();
    let triples = (0..n).flat_map(|i| (i + 1..n).flat_map(move |j| (j + 1..n).map(move |k| [i, j, k])));
    triples.max_by(|a, b| area(a).total_cmp(&area(b)))
}

/// The bead on which each matched bead falls, one to one; `None` where one falls on none.
fn names(matches: &[Match], places: &[DVec3], onto: impl Fn(DVec3) -> DVec3, tolerance_mm: f64) -> Option<Vec<usize>> {
    let mut names: Vec<usize> = Vec::with_capacity(matches.len());
    for m in matches {
        let at = onto(m.lps_mm);
        let free = (0..places.len()).filter(|bead| !names.contains(bead));
        let nearest = free.min_by(|a, b| places[*a].distance(at).total_cmp(&places[*b].distance(at)))?;
        if !(places[nearest].distance(at) <= tolerance_mm) {
            return None;
        }
        names.push(nearest);
    }
    Some(names)
}

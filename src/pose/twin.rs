//! A layout that resembles itself, moved or in a mirror: other names explain the picture, or its mirror image, as well as the match does.

use glam::{DQuat, DVec2, DVec3};

use super::case::Case;
use super::doubt::ALIKE;
use super::search::MISSED;
use super::settle::Settled;
use super::solve::{Free, Match, Options, Solution, solve};
use super::triangle::align;
use crate::geometry::{Intrinsics, Rigid};

/// Standard deviations of a bead's place, and mm at least, within which a bead may fall on another: along the beam the picture hardly tells.
const ON_ANOTHER: (f64, f64) = (10.0, 1.0);
/// Of so many matched beads one may have moved.
const FEWEST_TO_SPARE: usize = 6;

/// Other names of all beads of a match, and how well they fit.
pub(super) struct Twin {
    /// The camera under those names; where it is the mirror image that they fit, of that image.
    pub camera_from_lps: Rigid,
    /// How much more Σ χ² is than that of the match.
    pub excess: f64,
    pub rms_px: f64,
}

impl Case<'_> {
    /// Whether the beads of the match, otherwise named, fit the picture's mirror image as well: then nobody can tell from the beads whether
    /// the picture, or the layout, is mirrored.
    pub fn has_mirror_twin(&self, last: &Settled) -> bool {
        self.twins(last, true).next().is_some()
    }

    /// Whether they fit it from where the prior allows the camera of the mirror image, so that the prior cannot tell either.
    pub fn has_mirror_twin_near(&self, last: &Settled) -> bool {
        self.twins(last, true).any(|twin| !self.gate_excludes(&twin.camera_from_lps))
    }

    /// The best of those poses, apart from the match's, from which the beads, otherwise named, fit the picture as well: nothing but a prior
    /// tells them from it.
    pub fn moved_twin(&self, last: &Settled) -> Option<Twin> {
        let elsewhere = |twin: &Twin| self.is_elsewhere(&twin.camera_from_lps, last);
        self.twins(last, false).filter(elsewhere).min_by(|a, b| a.excess.total_cmp(&b.excess))
    }

    /// Motions of the layout, or of its mirror image, that put every bead of the match onto one, and under which the picture, or its mirror
    /// image, is explained as well.
    fn twins<'s>(&'s self, last: &'s Settled, mirrored: bool) -> impl Iterator<Item = Twin> + 's {
        let (matches, k) = (&last.matches, &last.solution.intrinsics);
        let places: Vec<DVec3> = self.request.layout.beads.iter().map(|bead| bead.lps_mm).collect();
        let depth_mm = last.solution.centroid_mm.z;
        let of_place_mm = |m: &Match| self.request.layout.beads[m.bead].most_sigma_mm();
        let sigma_mm = |m: &Match| of_place_mm(m).hypot(m.sigma_px * depth_mm / k.fx);
        let scale = last.chi2_per_dof.max(1.0);
        let worst_mm = matches.iter().map(sigma_mm).fold(0.0, f64::max);
        let tolerance_mm = (ON_ANOTHER.0 * scale.sqrt() * worst_mm).max(ON_ANOTHER.1);
        let turned = move |p: DVec3| if mirrored { DVec3::new(-p.x, p.y, p.z) } else { p };
        // Where the match does not explain every bead that it puts into the frame, its twin may leave one more out.
        let named: Vec<(Match, usize)> = matches.iter().map(|m| (*m, m.bead)).collect();
        // Where the prior is fused, the match's own squares are those of both.
        let squares = |solution: Solution| solution.chi2.iter().sum::<f64>();
        let own_fit = move |own: &[(Match, usize)]| self.fit_of(last, own, &Rigid::IDENTITY, false).map(squares);
        let fit_of_all = own_fit(&named);
        let spare = usize::from(matches.len() >= FEWEST_TO_SPARE && self.in_view_beside(&named, &last.solution) > 0);
        let all: Vec<usize> = (0..matches.len()).collect();
        let widest_of_all = widest(matches, &all);
        // The bead that may be left out may be a corner.
        let corners = widest_of_all.into_iter().flatten().filter(|_| spare > 0);
        let without =
            corners.filter_map(|corner| widest(matches, &all.iter().copied().filter(|n| *n != corner).collect::<Vec<_>>()));
        let sources = widest_of_all.into_iter().chain(without).map(|base| base.map(|n| turned(matches[n].lps_mm)));
        let onto = |source: [DVec3; 3]| {
            triples_like(&source, &places, 2.0 * tolerance_mm).into_iter().map(move |triple| (source, triple))
        };
        let onto: Vec<([DVec3; 3], [usize; 3])> = sources.flat_map(onto).collect();
        onto.into_iter().filter_map(move |(source, triple)| {
            let motion = align(&source, &triple.map(|bead| places[bead]))?;
            let names = names(matches, &places, |p| motion.transform_point(turned(p)), tolerance_mm, spare)?;
            // What a person has named has no other name.
            let renames = |(m, name): &(Match, usize)| self.pinned.iter().any(|(b, d)| (*b == *name) != (*d == m.detection));
            if !mirrored && names.iter().any(renames) {
                return None;
            }
            let own: Vec<(Match, usize)> = names.iter().map(|(m, _)| (*m, m.bead)).collect();
            let fit = if own.len() == named.len() { fit_of_all } else { own_fit(&own) }?;
            let solution = self.fit_of(last, &names, &motion, mirrored)?;
            let excess = solution.chi2.iter().sum::<f64>() - fit;
            // Beads that it would show, and the frame does not.
            let unseen = |names: &[(Match, usize)], pose: &Solution| self.in_view_beside(names, pose) as f64;
            let unseen = if mirrored { 0.0 } else { MISSED * (unseen(&names, &solution) - unseen(&own, &last.solution)) };
            let (camera_from_lps, rms_px) = (solution.camera_from_lps, solution.rms_px());
            (excess + unseen < ALIKE * scale).then_some(Twin { camera_from_lps, excess, rms_px })
        })
    }

    /// How many beads other than `names` a camera would show.
    fn in_view_beside(&self, names: &[(Match, usize)], camera: &Solution) -> usize {
        let is_named = |bead: usize| names.iter().any(|(_, name)| *name == bead);
        let beads = self.request.layout.beads.iter().enumerate().filter(|(bead, _)| !is_named(*bead));
        beads.filter_map(|(_, bead)| camera.place(bead.lps_mm).1).filter(|at| !self.request.is_outside(*at)).count()
    }

    /// The camera with each shadow that of the bead in `names`; `motion` puts the layout, x negated where the picture's mirror image
    /// is meant, onto itself.
    fn fit_of(&self, last: &Settled, names: &[(Match, usize)], motion: &Rigid, mirrored: bool) -> Option<Solution> {
        let end_px = f64::from(self.request.size_px[0]) - 1.0;
        let own = (last.solution.camera_from_lps, last.solution.intrinsics);
        let (seen, k) = if mirrored { (in_mirror(&own.0), mirrored_k(&own.1, end_px)) } else { own };
        let image_px = |at: DVec2| if mirrored { DVec2::new(end_px - at.x, at.y) } else { at };
        let renamed = |(m, bead): &(Match, usize)| {
            let own = &self.request.layout.beads[*bead];
            let [uu, uv, vv] = m.noise_px2;
            let noise_px2 = [uu, if mirrored { -uv } else { uv }, vv];
            let (lps_mm, place_mm2) = (own.lps_mm, own.place_mm2());
            Match { bead: *bead, lps_mm, place_mm2, image_px: image_px(m.image_px), noise_px2, ..*m }
        };
        let matches: Vec<Match> = names.iter().map(renamed).collect();
        solve(&matches, &(seen * motion.inverse()), &k, &Options::least_squares(Free::Pose))
    }
}

/// The pose of camera and layout both seen in a mirror of x.
fn in_mirror(camera_from_lps: &Rigid) -> Rigid {
    let (q, t) = (camera_from_lps.rotation, camera_from_lps.translation_mm);
    Rigid { rotation: DQuat::from_xyzw(q.x, -q.y, -q.z, q.w), translation_mm: DVec3::new(-t.x, t.y, t.z) }
}

/// Beads as far from each other as the three points, give or take `tolerance_mm`.
fn triples_like(points: &[DVec3; 3], places: &[DVec3], tolerance_mm: f64) -> Vec<[usize; 3]> {
    let n = places.len();
    let is_pair = |a: usize, b: usize, i: usize, j: usize| {
        a != b && (places[a].distance(places[b]) - points[i].distance(points[j])).abs() <= tolerance_mm
    };
    let pairs = (0..n).flat_map(|a| (0..n).map(move |b| (a, b))).filter(|(a, b)| is_pair(*a, *b, 0, 1));
    let triples = pairs.flat_map(|(a, b)| (0..n).map(move |c| [a, b, c]));
    triples.filter(|[a, b, c]| is_pair(*a, *c, 0, 2) && is_pair(*b, *c, 1, 2)).collect()
}

/// K of the mirror image of a picture whose last column is `end_px`.
pub(super) fn mirrored_k(k: &Intrinsics, end_px: f64) -> Intrinsics {
    Intrinsics { cx: end_px - k.cx, skew: -k.skew, ..*k }
}

/// The three beads among some of the matched that span the largest triangle.
fn widest(matches: &[Match], among: &[usize]) -> Option<[usize; 3]> {
    let n = among.len();
    let at = |n: usize| matches[among[n]].lps_mm;
    let area = |&[i, j, k]: &[usize; 3]| (at(j) - at(i)).cross(at(k) - at(i)).length_squared();
    let triples = (0..n).flat_map(|i| (i + 1..n).flat_map(move |j| (j + 1..n).map(move |k| [i, j, k])));
    triples.max_by(|a, b| area(a).total_cmp(&area(b))).map(|triple| triple.map(|n| among[n]))
}

/// The bead on which each matched bead falls, one to one; `None` where more than `spare` fall on none.
fn names(
    matches: &[Match],
    places: &[DVec3],
    onto: impl Fn(DVec3) -> DVec3,
    tolerance_mm: f64,
    spare: usize,
) -> Option<Vec<(Match, usize)>> {
    let mut names: Vec<(Match, usize)> = Vec::with_capacity(matches.len());
    for m in matches {
        let at = onto(m.lps_mm);
        let free = (0..places.len()).filter(|bead| names.iter().all(|(_, name)| name != bead));
        let nearest = free.min_by(|a, b| places[*a].distance(at).total_cmp(&places[*b].distance(at)))?;
        if places[nearest].distance(at) <= tolerance_mm {
            names.push((*m, nearest));
        }
    }
    (names.len() + spare >= matches.len()).then_some(names)
}

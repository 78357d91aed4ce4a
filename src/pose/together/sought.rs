//! Beads that hardly any view could name because they are not where they were: shadows that belong to no bead, put together over views.

use glam::{DVec2, DVec3};
use nalgebra::{Matrix2, Vector2};

use super::setup::{Observation, Setup};
use crate::estimate::median;
use crate::pose::record::Pose;
use crate::pose::residual::noise_px2;
use crate::pose::shadow::Shadow;

/// A bead is looked for this far from its place, mm.
const REACH_MM: f64 = 12.0;
/// Fitted radii of one bead's shadow and of the others differ by less than this factor (natural logarithm).
const ALIKE: f64 = 0.3;
/// A place explains a shadow to so many standard deviations of the shadow and of the cameras, which are good to so many px.
const SIGMAS: f64 = 4.0;
const CAMERA_PX: f64 = 0.5;

/// Views that must agree on the place of a bead that none has, and of one that some view has where it was.
const FEWEST: usize = 2;
const SURE: usize = 3;

/// A shadow that may be the bead's.
struct Candidate {
    view: usize,
    image_px: DVec2,
    sigma_px: f64,
    noise_px2: [f64; 3],
    from_mm: DVec3,
    along: DVec3,
}

/// A bead that was found, and its shadows.
pub struct Sought {
    pub bead: usize,
    pub place_mm: DVec3,
    pub observations: Vec<Observation>,
}

/// Those of `beads` that the shadows of two views or more agree on. `setup` is solved; `poses` are its views.
pub fn seek(setup: &Setup, poses: &[&Pose], beads: &[usize]) -> Vec<Sought> {
    let found = |bead: &usize| {
        let candidates: Vec<Candidate> =
            poses.iter().enumerate().flat_map(|(view, pose)| in_view(setup, *bead, view, pose)).collect();
        let (place_mm, members) = agreed(setup, *bead, &candidates)?;
        // Against a view that has it in its place two others prove nothing: their rays meet somewhere.
        let needed = if setup.seen_in(*bead).next().is_some() { SURE } else { FEWEST };
        if members.len() < needed {
            return None;
        }
        let observation = |n: usize| {
            let Candidate { view, image_px, sigma_px, noise_px2, .. } = candidates[n];
            Observation { view, bead: *bead, image_px, sigma_px, noise_px2 }
        };
        Some(Sought { bead: *bead, place_mm, observations: members.into_iter().map(observation).collect() })
    };
    beads.iter().filter_map(found).collect()
}

fn in_view(setup: &Setup, bead: usize, view: usize, pose: &Pose) -> Vec<Candidate> {
    let (camera, k) = (setup.cameras[view], setup.intrinsics[view]);
    let camera_from_body = setup.segment_of(view, bead).map_or(camera, |n| camera * setup.segments[n].lps_from_body);
    let p = camera_from_body.transform_point(setup.layout.beads[bead].lps_mm);
    if !(p.z > 1.0) {
        return Vec::new();
    }
    let matched = pose.shadows.iter().filter(|s| s.bead.is_some());
    let Some(usual_px) = median(matched.map(|s| s.radius_px)) else { return Vec::new() };
    let (at, reach_px) = (k.project(p), REACH_MM * k.fx / p.z);
    let body_from_camera = camera_from_body.inverse();
    let name = setup.layout.beads[bead].name.as_str();
    let others = || setup.observations.iter().filter(|o| o.view == view && o.bead != bead);
    let taken = |at: DVec2| others().any(|o| o.image_px.distance(at) < 0.5 * usual_px);
    let free = |s: &&Shadow| {
        let here = DVec2::from_array(s.image_px);
        s.bead.as_deref().is_none_or(|own| own == name)
            && here.distance(at) < reach_px
            && (s.radius_px / usual_px).ln().abs() < ALIKE
            && !taken(here)
    };
    let candidate = |s: &Shadow| {
        let (image_px, sigma_px) = (DVec2::from_array(s.image_px), s.sigma_px);
        Candidate {
            view,
            image_px,
            sigma_px,
            noise_px2: noise_px2(s.covariance_px2, sigma_px),
            from_mm: body_from_camera.translation_mm,
            along: body_from_camera.transform_vector(k.unproject(image_px)).normalize(),
        }
    };
    pose.shadows.iter().filter(free).map(candidate).collect()
}

/// The place on which most views agree, with the candidates that do; `None` where there is none or, of two views, more than one.
fn agreed(setup: &Setup, bead: usize, candidates: &[Candidate]) -> Option<(DVec3, Vec<usize>)> {
    let mut best: Vec<(DVec3, Vec<usize>)> = Vec::new();
    for (a, first) in candidates.iter().enumerate() {
        for second in candidates[a + 1..].iter().filter(|c| c.view != first.view) {
            let Some(place_mm) = between(first, second) else { continue };
            if !(place_mm.distance(setup.layout.beads[bead].lps_mm) < REACH_MM) {
                continue;
            }
            let mut members: Vec<usize> = Vec::new();
            for view in 0..setup.cameras.len() {
                let own = (0..candidates.len()).filter(|n| candidates[*n].view == view);
                let off = |n: usize| off(setup, bead, &candidates[n], place_mm);
                members.extend(own.min_by(|a, b| off(*a).total_cmp(&off(*b))).filter(|n| off(*n) <= 1.0));
            }
            if members.len() >= 2 && !best.iter().any(|(_, known)| *known == members) {
                best.push((place_mm, members));
            }
        }
    }
    best.sort_by_key(|(_, members)| std::cmp::Reverse(members.len()));
    let rival = best.get(1).is_some_and(|(_, members)| members.len() == best[0].1.len());
    (!rival).then(|| best.into_iter().next()).flatten()
}

/// The point half-way between two rays where they are closest.
fn between(a: &Candidate, b: &Candidate) -> Option<DVec3> {
    let (gap, cosine) = (b.from_mm - a.from_mm, a.along.dot(b.along));
    let sine2 = 1.0 - cosine * cosine;
    if !(sine2 > 1e-3) {
        return None;
    }
    let s = (gap.dot(a.along) - cosine * gap.dot(b.along)) / sine2;
    let t = (cosine * gap.dot(a.along) - gap.dot(b.along)) / sine2;
    Some(0.5 * (a.from_mm + a.along * s + b.from_mm + b.along * t))
}

/// How far a place is from explaining a shadow, as a share of what is allowed.
fn off(setup: &Setup, bead: usize, candidate: &Candidate, place_mm: DVec3) -> f64 {
    let (camera, k) = (setup.cameras[candidate.view], setup.intrinsics[candidate.view]);
    let camera_from_body = setup.segment_of(candidate.view, bead).map_or(camera, |n| camera * setup.segments[n].lps_from_body);
    let at = k.project(camera_from_body.transform_point(place_mm));
    let off = at - candidate.image_px;
    let ([uu, uv, vv], off) = (candidate.noise_px2, Vector2::new(off.x, off.y));
    let spread = Matrix2::new(uu, uv, uv, vv) + Matrix2::identity() * CAMERA_PX.powi(2);
    spread.try_inverse().map_or(f64::INFINITY, |information| off.dot(&(information * off)).sqrt() / SIGMAS)
}

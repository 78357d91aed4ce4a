//! What an image intensifier may have done to a picture of which nobody says what took it: its field is round.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};

use super::cautions::ROUND_FIELD;
use super::flat::along_worst_px;
use super::nuisance::{MOST_PX, Nuisance, Unmeasured, Word};
use super::request::Registration;
use super::settle::Settled;
use super::solve::Solution;

/// Standard deviations at the field's edge, shares of its radius: pincushion, of which a few per cent are published, and S.
const PINCUSHION: f64 = 0.03;
const S: f64 = 0.015;
/// Of the lens's centre from the field's, in its radii.
const OFF_CENTRE: f64 = 0.1;
/// A place farther out than this, in radii of the field, is not in the picture.
const REACH: f64 = 1.05;

/// What to do about it.
const MEASURE: &str = "measure it with `sidecarm calibrate intensifier` and give its file (--distortion FILE with one frame, \"intensifier\" in a \
     session), or \"none\" in its place where the detector is flat";

/// What may bend the picture of a match, and what is said of it, also that it cannot be told; nothing where the field is not round, or it is known what
/// took the picture.
pub(super) fn heard_of_lens(request: &Registration, settled: &Settled) -> (Option<Nuisance>, Option<Word>) {
    if request.round_field.is_none() {
        return (None, None);
    }
    let lens = lens_of(request, settled);
    let word = match &lens {
        Some(lens) => bends(lens, request, &settled.solution),
        None => Some(Word::Doubt(format!(
            "{ROUND_FIELD}, as that of an image intensifier, and how far one would bend this picture cannot be told: {MEASURE}"
        ))),
    };
    (lens, word)
}

/// `None` where it cannot be told.
fn lens_of(request: &Registration, settled: &Settled) -> Option<Nuisance> {
    let (field, k) = (request.round_field?, settled.solution.intrinsics);
    let radius = field.radius_px / k.fx;
    let off = (field.centre - DVec2::new(k.cx, k.cy)) / k.fx;
    let pincushion = PINCUSHION / radius.powi(2);
    let off_centre = |along: f64| pincushion * along.hypot(OFF_CENTRE * radius);
    let sigmas = [pincushion, off_centre(off.y), off_centre(off.x), S / radius.powi(2)];
    let is_told = sigmas.iter().all(|sigma| *sigma > 0.0 && sigma.is_finite());
    if is_told { Nuisance::of(settled, &Unmeasured::Lens(sigmas)) } else { None }
}

/// Where it may shift a place that is asked for by too much: a landmark, or where there is none a bead of the layout.
fn bends(lens: &Nuisance, request: &Registration, solution: &Solution) -> Option<Word> {
    let field = request.round_field?;
    let is_seen = |lps_mm: DVec3| {
        let at = solution.place(lps_mm).1;
        at.is_some_and(|at| at.distance(field.centre) <= REACH * field.radius_px)
    };
    let off_px = |lps_mm: DVec3| lens.image_px2(solution, lps_mm).map(|image| along_worst_px(&image));
    let layout = request.layout;
    let landmarks = request.landmarks.iter().map(|landmark| (landmark.name.clone(), landmark.lps_mm));
    let is_asked = !request.landmarks.is_empty();
    let beads = layout.beads.iter().chain(&layout.checks).filter(|_| !is_asked);
    let places = landmarks.chain(beads.map(|bead| (format!("bead {}", bead.name), bead.lps_mm)));
    let seen = places.filter(|(_, lps_mm)| is_seen(*lps_mm)).filter_map(|(name, lps_mm)| Some((off_px(lps_mm)?, name)));
    if let Some((worst_px, name)) = seen.max_by(|a, b| a.0.total_cmp(&b.0))
        && !(worst_px <= MOST_PX)
    {
        return Some(Word::Doubt(format!(
            "{ROUND_FIELD}, as that of an image intensifier, and no distortion is stated: if one took it, {name} may be off by \
             {worst_px:.1} px (1 σ), which beads elsewhere do not show; {MEASURE}"
        )));
    }
    if is_asked {
        return None;
    }
    let at_edge = |n: i32| {
        let at = field.centre + field.radius_px * DVec2::from_angle(TAU * f64::from(n) / 8.0);
        let in_camera = solution.intrinsics.unproject(at) * solution.centroid_mm.z;
        off_px(solution.camera_from_lps.inverse().transform_point(in_camera))
    };
    let edge_px = (0..8).filter_map(at_edge).fold(0.0, f64::max);
    (!(edge_px <= MOST_PX)).then(|| {
        Word::Note(format!(
            "{ROUND_FIELD}, and no distortion is stated: if an image intensifier took it, places at its edge may be off by \
             {edge_px:.1} px (1 σ)"
        ))
    })
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::super::solve::{Free, Match, Options, solve};
    use super::*;
    use crate::beads::{BeadLayout, Landmark};
    use crate::estimate::plane_by_lens;
    use crate::geometry::{Intrinsics, Rigid};
    use crate::mask::Disc;
    use crate::random::{Purpose, Stream};

    const K: Intrinsics = Intrinsics { fx: 3480.0, fy: 3480.0, skew: 0.0, cx: 511.5, cy: 511.5 };
    const FIELD: Disc = Disc { centre: DVec2::new(516.0, 505.0), radius_px: 480.0 };
    const AMONG: DVec3 = DVec3::new(4.0, -6.0, 5.0);
    const BEYOND: DVec3 = DVec3::new(85.0, 24.0, -12.0);

    /// Where a place is seen through a lens that shifts the field's edge by these shares of its radius.
    fn seen(pose: &Rigid, lps_mm: DVec3, [pincushion, s]: [f64; 2]) -> DVec2 {
        let p = pose.transform_point(lps_mm);
        let at = p.truncate() / p.z;
        let ([x, y], radius) = (plane_by_lens(at), FIELD.radius_px / K.fx);
        let by = |term: usize| DVec2::new(x[term], y[term]);
        let bent = at + (by(0) * pincushion + by(4) * s) / radius.powi(2);
        K.project(bent.extend(1.0))
    }

    /// Ten beads about the middle of the field, seen through such a lens and solved without one.
    fn settled(seed: u64, bent: [f64; 2]) -> (Settled, Rigid) {
        let mut random = Stream::new(seed, 0, 0, Purpose::Evaluation);
        let pose = Rigid::translation(DVec3::new(4.0, -6.0, 680.0)) * Rigid::exp(DVec3::new(0.4, -0.2, 0.9), DVec3::ZERO);
        let sigma_px = 0.15;
        let matches: Vec<Match> = (0..10)
            .map(|bead| {
                let mut side = |mm: f64| (random.uniform() - 0.5) * mm;
                let lps_mm = DVec3::new(side(70.0), side(70.0), side(50.0));
                let noise = DVec2::new(random.normal(), random.normal()) * sigma_px;
                let (noise_px2, place_mm2) =
                    ([sigma_px * sigma_px, 0.0, sigma_px * sigma_px], DMat3::from_diagonal(DVec3::splat(1e-4)));
                Match {
                    bead,
                    detection: bead,
                    lps_mm,
                    image_px: seen(&pose, lps_mm, bent) + noise,
                    sigma_px,
                    noise_px2,
                    place_mm2,
                }
            })
            .collect();
        let options = Options::least_squares(Free::Pose);
        let solution = solve(&matches, &pose, &K, &options).expect("regular");
        let chi2_per_dof = solution.chi2.iter().sum::<f64>() / 14.0;
        (Settled { solution, matches, left_out: Vec::new(), merged: Vec::new(), chi2_per_dof, options }, pose)
    }

    /// Squared standard deviations of a place's error: without the lens, and with it.
    fn squares(seed: u64, bent: [f64; 2], lps_mm: DVec3) -> [f64; 2] {
        let (settled, pose) = settled(seed, bent);
        let layout = BeadLayout::none();
        let request = Registration { round_field: Some(FIELD), ..Registration::new([1024; 2], &layout) };
        let lens = lens_of(&request, &settled).expect("regular");
        let solution = &settled.solution;
        let straight = solution.sharpness(lps_mm, &(&solution.covariance * settled.chi2_per_dof.max(1.0)));
        let off = seen(&pose, lps_mm, bent) - solution.place(lps_mm).0;
        let off = nalgebra::Vector2::new(off.x, off.y);
        [straight, lens.with(&straight, solution, lps_mm)].map(|sharpness| {
            let covariance = sharpness.image_px2.expect("in front");
            off.dot(&(covariance.try_inverse().expect("regular") * off))
        })
    }

    /// A pincushion of three per cent put places beyond the beads outside their 95 % regions in every second frame.
    #[test]
    fn regions_hold_places_beyond_the_beads_whatever_bends_the_picture() {
        let mut draw = Stream::new(7, 0, 0, Purpose::Evaluation);
        let count = 120;
        let (mut without, mut with) = (0, 0);
        for seed in 0..count {
            let bent = [PINCUSHION * draw.normal(), S * draw.normal()];
            let [straight, lens] = squares(seed, bent, BEYOND);
            without += usize::from(straight <= 5.99);
            with += usize::from(lens <= 5.99);
        }
        println!("{with} of {count} in their regions, {without} without the lens");
        assert!(with as f64 >= 0.92 * count as f64, "{with} of {count}");
        assert!((without as f64) < 0.75 * count as f64, "the control: {without} of {count}");
        for k in [0.0, 0.02, 0.05] {
            let held = (0..40).filter(|seed| squares(*seed, [k, 0.0], BEYOND)[1] <= 5.99).count();
            assert!(held >= 36, "{held} of 40 with a pincushion of {k}");
        }
    }

    /// What the lens adds to a place does not depend on the point that the pose is said about.
    #[test]
    fn what_a_lens_adds_is_the_same_about_any_centroid() {
        let (near, _) = settled(5, [0.02, 0.0]);
        let layout = BeadLayout::none();
        let request = Registration { round_field: Some(FIELD), ..Registration::new([1024; 2], &layout) };
        let added = |settled: &Settled| {
            let lens = lens_of(&request, settled).expect("regular");
            let image = lens.image_px2(&settled.solution, BEYOND).expect("in front");
            (along_worst_px(&image), lens.camera_mm2(&settled.solution, BEYOND).trace().sqrt())
        };
        let own = added(&near);
        let mut far = near;
        far.solution.centroid_mm += DVec3::new(30.0, -20.0, 15.0);
        let other = added(&far);
        assert!(own.0 > 1.0 && (other.0 / own.0 - 1.0).abs() < 1e-6 && (other.1 / own.1 - 1.0).abs() < 1e-6, "{own:?} {other:?}");
    }

    #[test]
    fn a_straight_picture_is_in_doubt_beyond_its_beads_and_not_among_them() {
        let (settled, _) = settled(3, [0.0; 2]);
        let layout = BeadLayout::none();
        let at = |lps_mm: DVec3, round_field: Option<Disc>| {
            let landmarks = [Landmark { name: "tip".to_owned(), lps_mm }];
            let request = Registration { round_field, landmarks: &landmarks, ..Registration::new([1024; 2], &layout) };
            bends(&lens_of(&request, &settled)?, &request, &settled.solution)
        };
        assert_eq!(at(AMONG, Some(FIELD)), None);
        let Some(Word::Doubt(words)) = at(BEYOND, Some(FIELD)) else { panic!("no doubt") };
        assert!(words.contains("field is round") && words.contains("tip may be off by"), "{words}");
        assert_eq!(at(BEYOND, None), None, "a field that is not round");
        assert_eq!(at(DVec3::new(170.0, 0.0, 0.0), Some(FIELD)), None, "not in the picture");
        let request = Registration { round_field: Some(FIELD), ..Registration::new([1024; 2], &layout) };
        let lens = lens_of(&request, &settled).expect("regular");
        assert!(matches!(bends(&lens, &request, &settled.solution), Some(Word::Note(_))), "nobody asks for a place");
    }
}

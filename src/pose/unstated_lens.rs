//! What an image intensifier may have done to a picture of which nobody says what took it: its field is round. Among the beads depth, turn and
//! K make up for most of a pincushion, residuals stay small, and beyond them places are off by pixels.
//!
//! Let p be what is solved (pose and K), l the lens, J and L the derivatives of the beads' images by both, and W their information. Without a
//! lens p comes out at p − B l, B = −(JᵀWJ)⁻¹JᵀW L, besides noise. A place whose image has the derivatives P and Q is then (Q + P B) l from
//! where the straight pose puts it. Of l the beads tell, under a prior, a mean μ and a covariance C; what the lens adds to the covariance of the
//! place's image is (Q + P B)(C + μμᵀ)(Q + P B)ᵀ. In a solution with both, cov(p, l) = B cov(l).

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix2, Matrix3};

use super::cautions::ROUND_FIELD;
use super::flat::along_worst_px;
use super::record::Pose;
use super::request::Registration;
use super::settle::Settled;
use super::solve::{Match, Sharpness, Solution, Stated, about, point_by_pose, problem};
use crate::estimate::{Loss, Reading, Settings, plane_by_lens};

/// k1, p1, p2 and s of the lens. About another centre than K's a pincushion has terms of p1 and p2.
const TERMS: [usize; 4] = [0, 2, 3, 4];
/// Standard deviations at the field's edge, shares of its radius: pincushion, of which a few per cent are published, and S.
const PINCUSHION: f64 = 0.03;
const S: f64 = 0.015;
/// Of the lens's centre from the field's, in its radii.
const OFF_CENTRE: f64 = 0.1;
/// Fewer degrees of freedom say nothing of how large the residuals' noise is …
const LEAST_DEGREES: f64 = 4.0;
/// … nor is it less than this share of the stated variance.
const SHARPEST: f64 = 0.02;
/// What the lens may add at a place without a word, px.
const MOST_PX: f64 = 1.0;
/// A place farther out than this, in radii of the field, is not in the picture.
const REACH: f64 = 1.05;

/// What to do about it.
const MEASURE: &str = "measure it with `sidecarm calibrate intensifier` and give its file (--distortion FILE with one frame, \"intensifier\" in a \
     session), or \"none\" in its place where the detector is flat";

/// What bends a picture that nobody has straightened, as far as the beads leave it open.
#[derive(Clone, Debug)]
pub(super) struct UnstatedLens {
    /// B: what is solved × terms, the pose about the centroid that the solution has.
    by_lens: DMatrix<f64>,
    /// C + μμᵀ.
    moment: DMatrix<f64>,
}

/// What is said of it.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Bends {
    /// At a place that somebody asks for, or at a bead of the layout: a doubt.
    AtPlace(String),
    /// Only at the field's edge, where nobody asks: a note.
    AtEdge(String),
}

impl Bends {
    /// Says so of an accepted pose.
    pub fn tell(self, pose: &mut Pose) {
        match self {
            Self::AtPlace(words) => pose.doubt(words),
            Self::AtEdge(words) => pose.notes.push(words),
        }
    }
}

impl UnstatedLens {
    /// Of a match, and what is said of it, also that it cannot be told; nothing where the field is not round, or it is known what took the picture.
    pub fn heard(request: &Registration, settled: &Settled) -> (Option<Self>, Option<Bends>) {
        if request.round_field.is_none() {
            return (None, None);
        }
        let lens = Self::of(request, settled);
        let bends = match &lens {
            Some(lens) => lens.bends(request, &settled.solution),
            None => Some(Bends::AtPlace(format!(
                "{ROUND_FIELD}, as that of an image intensifier, and how far one would bend this picture cannot be told: {MEASURE}"
            ))),
        };
        (lens, bends)
    }

    /// `None` where it cannot be told.
    fn of(request: &Registration, settled: &Settled) -> Option<Self> {
        let (field, k) = (request.round_field?, settled.solution.intrinsics);
        let radius = field.radius_px / k.fx;
        let off = (field.centre - DVec2::new(k.cx, k.cy)) / k.fx;
        let pincushion = PINCUSHION / radius.powi(2);
        let off_centre = |along: f64| pincushion * along.hypot(OFF_CENTRE * radius);
        let sigmas = [pincushion, off_centre(off.y), off_centre(off.x), S / radius.powi(2)];
        if !sigmas.iter().all(|sigma| *sigma > 0.0 && sigma.is_finite()) {
            return None;
        }
        // How large noise is the residuals themselves say: beads that stand better than stated tell more of a lens.
        let mut variance = 1.0;
        for _ in 0..2 {
            variance = Self::solved(settled, &sigmas, variance)?.1;
        }
        Some(Self::solved(settled, &sigmas, variance)?.0)
    }

    /// With beads of `variance` times the stated one, and what the residuals say of that.
    fn solved(settled: &Settled, sigmas: &[f64; 4], variance: f64) -> Option<(Self, f64)> {
        let weighed =
            |m: &Match| Match { noise_px2: m.noise_px2.map(|square| variance * square), place_mm2: m.place_mm2 * variance, ..*m };
        let matches: Vec<Match> = settled.matches.iter().map(weighed).collect();
        let Solution { camera_from_lps, intrinsics, .. } = &settled.solution;
        let Stated { mut problem, camera, intrinsics: k, lens } =
            problem(&matches, camera_from_lps, intrinsics, &settled.options, Some(&TERMS));
        let (lens, terms) = (lens?, TERMS.len());
        let information = DMatrix::from_fn(terms, terms, |i, j| if i == j { sigmas[i].powi(-2) } else { 0.0 });
        problem.add(Reading::of_some(lens, TERMS.to_vec(), &[0.0; 4], information), Loss::None);
        let estimate = problem.solve(&Settings::default()).ok()?;
        let covariance = estimate.covariance().ok()?.of(&[camera.into(), k.into(), lens.into()]);
        let solved = covariance.ncols() - terms;
        let own = covariance.view((solved, solved), (terms, terms)).into_owned();
        let mut by_lens = covariance.view((0, solved), (solved, terms)).into_owned() * own.clone().try_inverse()?;
        // A solution of several views is about the centroid of more beads than this one shows.
        let mean_lps = matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / matches.len() as f64;
        let centred = about(settled.solution.centroid_mm - camera_from_lps.transform_point(mean_lps));
        let of_pose = DMatrix::from_fn(6, 6, |i, j| centred[(i, j)]) * by_lens.rows(0, 6);
        by_lens.rows_mut(0, 6).copy_from(&of_pose);
        let numbers = estimate.state().vector(lens);
        let mean = DVector::from_fn(terms, |n, _| numbers[TERMS[n]]);
        let moment = own + &mean * mean.transpose();
        let finite = by_lens.iter().chain(moment.iter()).all(|x| x.is_finite());
        let degrees = estimate.degrees_of_freedom() as f64;
        let per_degree = estimate.chi2_sum() / degrees;
        let seen = variance * per_degree;
        let variance = if !(degrees >= LEAST_DEGREES) {
            1.0
        } else if seen >= 1.0 {
            seen
        } else {
            // Few residuals may be small by accident.
            (seen * (1.0 + 2.0 * (2.0 / degrees).sqrt())).clamp(SHARPEST, 1.0)
        };
        finite.then_some((Self { by_lens, moment }, variance))
    }

    /// How well a place is known where `straight` is how well it is without a lens.
    pub fn with(&self, straight: &Sharpness, solution: &Solution, lps_mm: DVec3) -> Sharpness {
        let added_px2 = self.image_px2(solution, lps_mm);
        Sharpness {
            image_px2: straight.image_px2.zip(added_px2).map(|(straight, added)| straight + added),
            camera_mm2: straight.camera_mm2 + self.camera_mm2(solution, lps_mm),
        }
    }

    /// What the lens adds to the covariance of a place's image; `None` behind the source.
    fn image_px2(&self, solution: &Solution, lps_mm: DVec3) -> Option<Matrix2<f64>> {
        let p = solution.camera_from_lps.transform_point(lps_mm);
        if !(p.z > 1.0) {
            return None;
        }
        let k = &solution.intrinsics;
        let [x, y] = plane_by_lens(p.truncate() / p.z);
        let direct = DMatrix::from_fn(2, TERMS.len(), |row, n| match (row, TERMS[n]) {
            (0, term) => k.fx * x[term] + k.skew * y[term],
            (_, term) => k.fy * y[term],
        });
        let rows = direct + solution.image_by_solved(p, self.by_lens.nrows()) * &self.by_lens;
        let image = &rows * &self.moment * rows.transpose();
        Some(Matrix2::from_fn(|i, j| image[(i, j)]))
    }

    /// What it adds to that of the place in `camera`, by the pose.
    fn camera_mm2(&self, solution: &Solution, lps_mm: DVec3) -> Matrix3<f64> {
        let p = solution.camera_from_lps.transform_point(lps_mm);
        let by_pose = point_by_pose(p, solution.centroid_mm);
        let rows = DMatrix::from_fn(3, 6, |i, j| by_pose[(i, j)]) * self.by_lens.rows(0, 6);
        let camera = &rows * &self.moment * rows.transpose();
        Matrix3::from_fn(|i, j| camera[(i, j)])
    }

    /// Where it may shift a place that is asked for by too much: a landmark, or where there is none a bead of the layout.
    fn bends(&self, request: &Registration, solution: &Solution) -> Option<Bends> {
        let field = request.round_field?;
        let is_seen = |lps_mm: DVec3| {
            let at = solution.place(lps_mm).1;
            at.is_some_and(|at| at.distance(field.centre) <= REACH * field.radius_px)
        };
        let off_px = |lps_mm: DVec3| self.image_px2(solution, lps_mm).map(|image| along_worst_px(&image));
        let layout = request.layout;
        let landmarks = request.landmarks.iter().map(|landmark| (landmark.name.clone(), landmark.lps_mm));
        let is_asked = !request.landmarks.is_empty();
        let beads = layout.beads.iter().chain(&layout.checks).filter(|_| !is_asked);
        let places = landmarks.chain(beads.map(|bead| (format!("bead {}", bead.name), bead.lps_mm)));
        let seen = places.filter(|(_, lps_mm)| is_seen(*lps_mm)).filter_map(|(name, lps_mm)| Some((off_px(lps_mm)?, name)));
        if let Some((worst_px, name)) = seen.max_by(|a, b| a.0.total_cmp(&b.0))
            && !(worst_px <= MOST_PX)
        {
            return Some(Bends::AtPlace(format!(
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
            Bends::AtEdge(format!(
                "{ROUND_FIELD}, and no distortion is stated: if an image intensifier took it, places at its edge may be off by \
                 {edge_px:.1} px (1 σ)"
            ))
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::super::solve::{Free, Options, solve};
    use super::*;
    use crate::beads::{BeadLayout, Landmark};
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
        let lens = UnstatedLens::of(&request, &settled).expect("regular");
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
            let lens = UnstatedLens::of(&request, settled).expect("regular");
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
            UnstatedLens::of(&request, &settled)?.bends(&request, &settled.solution)
        };
        assert_eq!(at(AMONG, Some(FIELD)), None);
        let Some(Bends::AtPlace(words)) = at(BEYOND, Some(FIELD)) else { panic!("no doubt") };
        assert!(words.contains("field is round") && words.contains("tip may be off by"), "{words}");
        assert_eq!(at(BEYOND, None), None, "a field that is not round");
        assert_eq!(at(DVec3::new(170.0, 0.0, 0.0), Some(FIELD)), None, "not in the picture");
        let request = Registration { round_field: Some(FIELD), ..Registration::new([1024; 2], &layout) };
        let lens = UnstatedLens::of(&request, &settled).expect("regular");
        assert!(matches!(lens.bends(&request, &settled.solution), Some(Bends::AtEdge(_))), "nobody asks for a place");
    }
}

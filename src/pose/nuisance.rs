//! Numbers that nobody has measured: taken for something, they count all the same in what is stated of places, as far as the beads leave them
//! open. Among the beads depth and turn make up for most of what they do, residuals stay small, and beyond them places are off by pixels.
//!
//! Let p be what is solved (pose, and K where it is), l these numbers less what they are taken for, J and L the derivatives of the beads' images by
//! both, and W their information. With l taken for 0 p comes out at p − B l, B = −(JᵀWJ)⁻¹JᵀW L, besides noise. A place whose image has the
//! derivatives P and Q is then (Q + P B) l from where that pose puts it. Of l the beads tell, under a prior, a mean μ and a covariance C; what l adds
//! to the covariance of the place's image is (Q + P B)(C + μμᵀ)(Q + P B)ᵀ. In a solution with both, cov(p, l) = B cov(l).

use glam::DVec3;
use nalgebra::{DMatrix, DVector, Matrix2, Matrix3};

use super::record::Pose;
use super::settle::Settled;
use super::solve::{Free, IntrinsicsPrior, Match, Options, Sharpness, Solution, Stated, about, point_by_pose, problem};
use crate::estimate::{Loss, Reading, Settings, plane_by_lens};

/// k1, p1, p2 and s of a lens. About another centre than K's a pincushion has terms of p1 and p2.
pub(super) const TERMS: [usize; 4] = [0, 2, 3, 4];
/// Fewer degrees of freedom say nothing of how large the residuals' noise is …
const LEAST_DEGREES: f64 = 4.0;
/// … nor is it less than this share of the stated variance.
const SHARPEST: f64 = 0.02;
/// What such numbers may add at a place without a doubt, px.
pub(super) const MOST_PX: f64 = 1.0;

/// What nobody has measured.
#[derive(Clone, Copy, Debug)]
pub(super) enum Unmeasured {
    /// A lens, which is taken to be none: standard deviations of its [`TERMS`].
    Lens([f64; 4]),
    /// K, and how well what it is taken for is known.
    K(IntrinsicsPrior),
}

/// Such numbers, as far as the beads leave them open.
#[derive(Clone, Debug)]
pub(super) struct Nuisance {
    unmeasured: Unmeasured,
    /// B: what is solved × these numbers, the pose about the centroid that the solution has.
    solved_by: DMatrix<f64>,
    /// C + μμᵀ.
    moment: DMatrix<f64>,
}

/// What is said of them.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Word {
    /// A place that somebody asks for may be off by too much.
    Doubt(String),
    /// None is, or nobody asks there.
    Note(String),
}

impl Word {
    /// Says so of an accepted pose.
    pub fn tell(self, pose: &mut Pose) {
        match self {
            Self::Doubt(words) => pose.doubt(words),
            Self::Note(words) => pose.notes.push(words),
        }
    }
}

impl Nuisance {
    /// Of a match; `None` where it cannot be told.
    pub fn of(settled: &Settled, unmeasured: &Unmeasured) -> Option<Self> {
        // How large noise is the residuals themselves say: beads that stand better than stated tell more of these numbers.
        let mut variance = 1.0;
        for _ in 0..2 {
            variance = Self::solved(settled, unmeasured, variance)?.1;
        }
        Some(Self::solved(settled, unmeasured, variance)?.0)
    }

    /// Mean square of the first of them: a lens's k1, or how far K's focal length is off, px.
    pub fn moment_of_first(&self) -> f64 {
        self.moment[(0, 0)]
    }

    /// With beads of `variance` times the stated one, and what the residuals say of that.
    fn solved(settled: &Settled, unmeasured: &Unmeasured, variance: f64) -> Option<(Self, f64)> {
        let weighed =
            |m: &Match| Match { noise_px2: m.noise_px2.map(|square| variance * square), place_mm2: m.place_mm2 * variance, ..*m };
        let matches: Vec<Match> = settled.matches.iter().map(weighed).collect();
        let Solution { camera_from_lps, intrinsics, .. } = &settled.solution;
        let (free, terms): (Free, Option<&[usize]>) = match unmeasured {
            Unmeasured::Lens(_) => (settled.options.free, Some(&TERMS)),
            Unmeasured::K(prior) => (Free::Known(*prior), None),
        };
        let options = Options { free, ..settled.options };
        let Stated { mut problem, camera, intrinsics: k, lens } = problem(&matches, camera_from_lps, intrinsics, &options, terms);
        let mut blocks = vec![camera.id(), k.id()];
        if let (Unmeasured::Lens(sigmas), Some(lens)) = (unmeasured, lens) {
            let count = TERMS.len();
            let information = DMatrix::from_fn(count, count, |i, j| if i == j { sigmas[i].powi(-2) } else { 0.0 });
            problem.add(Reading::of_some(lens, TERMS.to_vec(), &[0.0; 4], information), Loss::None);
            blocks.push(lens.id());
        }
        let estimate = problem.solve(&Settings::default()).ok()?;
        let state = estimate.state();
        let mean = match (unmeasured, lens) {
            (Unmeasured::Lens(_), lens) => {
                let numbers = state.vector(lens?);
                DVector::from_fn(TERMS.len(), |n, _| numbers[TERMS[n]])
            }
            (Unmeasured::K(IntrinsicsPrior { mean, .. }), _) => {
                let &[fx, _, _, cx, cy, ..] = state.vector(k) else { return None };
                DVector::from_vec(vec![fx - mean.fx, cx - mean.cx, cy - mean.cy])
            }
        };
        let covariance = estimate.covariance().ok()?.of(&blocks);
        let count = mean.len();
        let solved = covariance.ncols() - count;
        let own = covariance.view((solved, solved), (count, count)).into_owned();
        let mut solved_by = covariance.view((0, solved), (solved, count)).into_owned() * own.clone().try_inverse()?;
        // A solution of several views is about the centroid of more beads than this one shows.
        let mean_lps = matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / matches.len() as f64;
        let centred = about(settled.solution.centroid_mm - camera_from_lps.transform_point(mean_lps));
        let of_pose = DMatrix::from_fn(6, 6, |i, j| centred[(i, j)]) * solved_by.rows(0, 6);
        solved_by.rows_mut(0, 6).copy_from(&of_pose);
        let moment = own + &mean * mean.transpose();
        let finite = solved_by.iter().chain(moment.iter()).all(|x| x.is_finite());
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
        finite.then_some((Self { unmeasured: *unmeasured, solved_by, moment }, variance))
    }

    /// How well a place is known where `taken` is how well it is with what these numbers are taken for.
    pub fn with(&self, taken: &Sharpness, solution: &Solution, lps_mm: DVec3) -> Sharpness {
        let added_px2 = self.image_px2(solution, lps_mm);
        Sharpness {
            image_px2: taken.image_px2.zip(added_px2).map(|(taken, added)| taken + added),
            camera_mm2: taken.camera_mm2 + self.camera_mm2(solution, lps_mm),
        }
    }

    /// What they add to the covariance of a place's image; `None` behind the source.
    pub fn image_px2(&self, solution: &Solution, lps_mm: DVec3) -> Option<Matrix2<f64>> {
        let p = solution.camera_from_lps.transform_point(lps_mm);
        if !(p.z > 1.0) {
            return None;
        }
        let rows = self.image_by_own(solution, p) + solution.image_by_solved(p, self.solved_by.nrows()) * &self.solved_by;
        let image = &rows * &self.moment * rows.transpose();
        Some(Matrix2::from_fn(|i, j| image[(i, j)]))
    }

    /// What they add to that of the place in `camera`, by the pose.
    pub fn camera_mm2(&self, solution: &Solution, lps_mm: DVec3) -> Matrix3<f64> {
        let p = solution.camera_from_lps.transform_point(lps_mm);
        let by_pose = point_by_pose(p, solution.centroid_mm);
        let rows = DMatrix::from_fn(3, 6, |i, j| by_pose[(i, j)]) * self.solved_by.rows(0, 6);
        let camera = &rows * &self.moment * rows.transpose();
        Matrix3::from_fn(|i, j| camera[(i, j)])
    }

    /// Q for a point in `camera`.
    fn image_by_own(&self, solution: &Solution, p: DVec3) -> DMatrix<f64> {
        match self.unmeasured {
            Unmeasured::Lens(_) => {
                let k = &solution.intrinsics;
                let [x, y] = plane_by_lens(p.truncate() / p.z);
                DMatrix::from_fn(2, TERMS.len(), |row, n| match (row, TERMS[n]) {
                    (0, term) => k.fx * x[term] + k.skew * y[term],
                    (_, term) => k.fy * y[term],
                })
            }
            Unmeasured::K(_) => solution.image_by_solved(p, 9).columns(6, 3).into_owned(),
        }
    }
}

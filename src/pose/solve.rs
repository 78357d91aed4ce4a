//! Pose (and K) from matched beads, by the estimation core.
//!
//! A bead's measurement has the covariance S = Σ_px + A Σ_mm Aᵀ, A = ∂(u, v)/∂p at the pose: noise of the shadow's centre and of the
//! bead's place. All that judges a bead, or a match, does so by S.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, Matrix2, Matrix2x3, Matrix3, Matrix6, Vector2};

use super::refusal::IntrinsicsNumber;
use crate::beads::Detection;
use crate::estimate::{BeadImage, Freedom, LeftOut, Loss, Place, PoseBlock, PosePrior, Problem, Reading, Settings, VectorBlock};
use crate::geometry::{Intrinsics, PanelWindow, Rigid};

pub use crate::estimate::{about, deviation};

/// Ellipses are as good as round from this share of their circle's area on.
const ROUND: f64 = 0.9;

/// A bead and its shadow.
#[derive(Clone, Copy, Debug)]
pub struct Match {
    /// Index in the layout.
    pub bead: usize,
    /// Index among the detections.
    pub detection: usize,
    pub lps_mm: DVec3,
    pub image_px: DVec2,
    /// Standard deviation of `image_px` per axis, the mean of both.
    pub sigma_px: f64,
    /// Covariance of `image_px`: uu, uv, vv.
    pub noise_px2: [f64; 3],
    /// Covariance of `lps_mm`.
    pub place_mm2: DMat3,
}

impl Match {
    /// Bead `bead` at a place known to a covariance, and the shadow of number `detection`, whose centre stands for the bead's at `image_px`.
    pub fn new(bead: usize, (lps_mm, place_mm2): (DVec3, DMat3), detection: usize, shadow: &Detection, image_px: DVec2) -> Self {
        let noise_px2 = shadow.noise_px2();
        let sigma_px = (0.5 * (noise_px2[0] + noise_px2[2])).sqrt();
        Self { bead, detection, lps_mm, image_px, sigma_px, noise_px2, place_mm2 }
    }
}

/// S of a place known to `place_mm2` that a camera puts into the picture, beside a shadow whose centre is known to `noise_px2` (uu, uv, vv).
#[must_use]
pub fn image_spread(
    intrinsics: &Intrinsics,
    camera_from_lps: &Rigid,
    lps_mm: DVec3,
    place_mm2: &DMat3,
    noise_px2: [f64; 3],
) -> Matrix2<f64> {
    let by_place = image_by_point(intrinsics, camera_from_lps.transform_point(lps_mm));
    let turn = camera_from_lps.rotation_matrix();
    let in_camera = turn * *place_mm2 * turn.transpose();
    let in_camera = Matrix3::from_fn(|i, j| in_camera.col(j)[i]);
    let [uu, uv, vv] = noise_px2;
    Matrix2::new(uu, uv, uv, vv) + by_place * in_camera * by_place.transpose()
}

/// Length of an offset, px, as it were if the ellipse of its `spread` S were a circle of the same mean square: √(offᵀ S⁻¹ off · tr S / 2).
/// Where S is a circle that is the offset's own.
#[must_use]
pub fn rounded_px(off_px: DVec2, spread: &Matrix2<f64>) -> f64 {
    let off = Vector2::new(off_px.x, off_px.y);
    let sigmas2 = spread.try_inverse().map_or(f64::NAN, |information| off.dot(&(information * off)));
    (0.5 * sigmas2 * spread.trace()).sqrt()
}

/// K with independent Gaussian uncertainties: square pixels, one focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IntrinsicsPrior {
    pub mean: Intrinsics,
    pub focal_sigma_px: f64,
    /// Of the principal point's column and row.
    pub centre_sigma_px: [f64; 2],
}

impl IntrinsicsPrior {
    /// f = SID / pitch from both with their standard deviations, each as (value, σ) in mm.
    #[must_use]
    pub fn from_distance(mean: Intrinsics, distance_mm: (f64, f64), pitch_mm: (f64, f64), centre_sigma_px: f64) -> Self {
        let focal_px = distance_mm.0 / pitch_mm.0;
        let relative = (distance_mm.1 / distance_mm.0).hypot(pitch_mm.1 / pitch_mm.0);
        // Pixels that are not quite square keep their ratio.
        let ratio = mean.fy / mean.fx;
        let mean = Intrinsics { fx: focal_px, fy: focal_px * ratio, ..mean };
        Self { mean, focal_sigma_px: focal_px * relative, centre_sigma_px: [centre_sigma_px; 2] }
    }

    /// Standard deviation with which a focal length is stated; 0 where there is no prior: it is known.
    #[must_use]
    pub fn stated_focal_sigma_px(prior: Option<&Self>) -> f64 {
        prior.map_or(0.0, |prior| prior.focal_sigma_px)
    }

    /// K of the same detector with `factor` × `factor` pixels averaged into one.
    #[must_use]
    pub fn binned(&self, factor: f64) -> Self {
        Self {
            mean: self.mean.binned(factor),
            focal_sigma_px: self.focal_sigma_px / factor,
            centre_sigma_px: self.centre_sigma_px.map(|sigma| sigma / factor),
        }
    }

    /// K of a picture that a console made of the detector's.
    #[must_use]
    pub fn seen_through(&self, window: &PanelWindow) -> Self {
        Self {
            mean: window.intrinsics(&self.mean).0,
            focal_sigma_px: self.focal_sigma_px / window.step,
            centre_sigma_px: self.centre_sigma_px.map(|sigma| sigma / window.step),
        }
    }

    /// The prior as a residual of K's numbers (fx, fy, skew, cx, cy).
    pub(super) fn reading(&self, intrinsics: VectorBlock) -> Reading {
        let sigmas = [self.focal_sigma_px, self.centre_sigma_px[0], self.centre_sigma_px[1]];
        let information = DMatrix::from_fn(3, 3, |i, j| if i == j { sigmas[i].powi(-2) } else { 0.0 });
        Reading::of_some(intrinsics, vec![0, 3, 4], &[self.mean.fx, self.mean.cx, self.mean.cy], information)
    }

    /// What the prior says of `solved`'s numbers: name, solved minus stated, standard deviation, px.
    pub(super) fn deviations(&self, solved: &Intrinsics) -> [(IntrinsicsNumber, f64, f64); 3] {
        let [column, row] = self.centre_sigma_px;
        [
            (IntrinsicsNumber::FocalLength, solved.fx - self.mean.fx, self.focal_sigma_px),
            (IntrinsicsNumber::PrincipalColumn, solved.cx - self.mean.cx, column),
            (IntrinsicsNumber::PrincipalRow, solved.cy - self.mean.cy, row),
        ]
    }
}

/// Which of K's numbers are unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Free {
    /// None: K is known.
    Pose,
    /// One focal length and the principal point: square pixels.
    Square,
    /// The same, each with a prior.
    Known(IntrinsicsPrior),
}

impl Free {
    /// Where K comes from, as a pose's file says it.
    pub(super) fn source(self) -> &'static str {
        match self {
            Self::Pose => "given",
            Self::Square => "solved",
            Self::Known(_) => "solved with priors",
        }
    }
}

/// A measured pose: covariance of ξ in `camera`, exp(ξ̂)·pose being true.
#[derive(Clone, Copy, Debug)]
pub struct Measured {
    pub camera_from_lps: Rigid,
    pub information: Matrix6<f64>,
}

/// How to solve.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    pub free: Free,
    /// Cauchy loss at this many standard deviations; infinite: least squares.
    pub loss: f64,
    /// The weights take this share of the standard deviations of the beads' places; the covariance always takes all of them.
    pub sigma_mm_share: f64,
    pub measured: Option<Measured>,
    pub iterations: usize,
}

impl Options {
    pub fn least_squares(free: Free) -> Self {
        Self { free, loss: f64::INFINITY, sigma_mm_share: 1.0, measured: None, iterations: 30 }
    }
}

/// Where the solver ended.
#[derive(Clone, Debug)]
pub struct Solution {
    pub camera_from_lps: Rigid,
    pub intrinsics: Intrinsics,
    /// Observed minus projected, per match.
    pub residuals_px: Vec<DVec2>,
    /// Squared residual in standard deviations (two degrees of freedom), per match, by all of S.
    pub chi2: Vec<f64>,
    /// Squared deviation from the priors, of pose and K together.
    pub prior_chi2: f64,
    /// Of beads and priors together; negative where there are too few.
    pub degrees_of_freedom: i64,
    /// Covariance of (ω, v) about the centroid, then of K's free numbers (px).
    pub covariance: DMatrix<f64>,
    /// The beads' centroid in `camera`.
    pub centroid_mm: DVec3,
}

/// How well a place is known.
#[derive(Clone, Copy, Debug)]
pub struct Sharpness {
    /// Covariance of its projection, of pose and K together; `None` behind the source.
    pub image_px2: Option<Matrix2<f64>>,
    /// Covariance of its place in `camera`.
    pub camera_mm2: Matrix3<f64>,
}

impl Solution {
    /// √mean(dx² + dy²) of the residuals.
    #[must_use]
    pub fn rms_px(&self) -> f64 {
        let squares = self.residuals_px.iter().map(|r| r.length_squared()).sum::<f64>();
        (squares / self.residuals_px.len().max(1) as f64).sqrt()
    }

    /// S of a match.
    fn spread(&self, m: &Match) -> Matrix2<f64> {
        image_spread(&self.intrinsics, &self.camera_from_lps, m.lps_mm, &m.place_mm2, m.noise_px2)
    }

    /// Σ of the squared residuals of `matches`, px², each as [`rounded_px`] has it.
    #[must_use]
    pub fn rounded_px2(&self, matches: &[Match]) -> f64 {
        matches.iter().zip(&self.residuals_px).map(|(m, off)| rounded_px(*off, &self.spread(m)).powi(2)).sum()
    }

    /// Area of the ellipses in which shadows lie by S, over that of circles of the same mean square; 1 where they are as good as round.
    #[must_use]
    pub fn roundness(&self, matches: &[Match]) -> f64 {
        let (ellipses, circles) = matches.iter().map(|m| self.spread(m)).fold((0.0, 0.0), |(ellipses, circles), spread| {
            (ellipses + spread.determinant().max(0.0).sqrt(), circles + 0.5 * spread.trace())
        });
        let share = ellipses / circles;
        // Not a number is round.
        if share < ROUND { share } else { 1.0 }
    }

    /// Where P puts a place, and the same where it lies in front of the source.
    #[must_use]
    pub fn place(&self, lps_mm: DVec3) -> (DVec2, Option<DVec2>) {
        let p = self.camera_from_lps.transform_point(lps_mm);
        let at = self.intrinsics.project(p);
        (at, (p.z > 1.0).then_some(at))
    }

    /// Uncertainty of P at a place; `covariance` is this solution's, scaled perhaps.
    #[must_use]
    pub fn sharpness(&self, lps_mm: DVec3, covariance: &DMatrix<f64>) -> Sharpness {
        let p = self.camera_from_lps.transform_point(lps_mm);
        let by_pose = point_by_pose(p, self.centroid_mm);
        let camera_mm2 = by_pose * covariance.fixed_view::<6, 6>(0, 0) * by_pose.transpose();
        let image_px2 = (p.z > 1.0).then(|| {
            let rows = self.image_by_solved(p, covariance.ncols());
            let image = &rows * covariance * rows.transpose();
            Matrix2::from_fn(|i, j| image[(i, j)])
        });
        Sharpness { image_px2, camera_mm2 }
    }

    /// Rows of ∂(u, v)/∂ what is solved, 2 × `columns`, for a point in `camera`: six of the pose, and of K's free numbers what is left.
    pub(super) fn image_by_solved(&self, p: DVec3, columns: usize) -> DMatrix<f64> {
        let mut rows = DMatrix::zeros(2, columns);
        let by_pose = image_by_point(&self.intrinsics, p) * point_by_pose(p, self.centroid_mm);
        rows.view_mut((0, 0), (2, 6)).copy_from(&by_pose);
        if columns > 6 {
            let ratio = self.intrinsics.fy / self.intrinsics.fx;
            rows.view_mut((0, 6), (2, 3)).copy_from(&Matrix2x3::new(p.x / p.z, 1.0, 0.0, ratio * p.y / p.z, 0.0, 1.0));
        }
        rows
    }
}

/// Rows of ∂(u, v)/∂p for a point in `camera`.
pub fn image_by_point(intrinsics: &Intrinsics, p: DVec3) -> Matrix2x3<f64> {
    let (fx, fy, skew) = (intrinsics.fx, intrinsics.fy, intrinsics.skew);
    let z = p.z;
    Matrix2x3::new(fx / z, skew / z, -(fx * p.x + skew * p.y) / (z * z), 0.0, fy / z, -fy * p.y / (z * z))
}

/// ∂p/∂(ω, v) for rotation about `centre`, 3×6.
pub fn point_by_pose(p: DVec3, centre: DVec3) -> nalgebra::Matrix3x6<f64> {
    let mut rows = nalgebra::Matrix3x6::zeros();
    for (n, axis) in DVec3::AXES.into_iter().enumerate() {
        rows.set_row(n, &nalgebra::RowVector6::from_row_slice(&crate::estimate::turned(axis, p - centre)));
    }
    rows
}

/// K of square pixels, or of pixels of fixed shape: fy follows fx; columns f, cx, cy.
pub fn square_pixels(k: &Intrinsics) -> Freedom {
    let shares = [1.0, 0.0, 0.0, k.fy / k.fx, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    Freedom::Along(DMatrix::from_row_slice(5, 3, &shares))
}

/// A match as a residual; the weights take `share` of the place's standard deviations.
pub(super) fn image_of(m: &Match, camera: PoseBlock, intrinsics: VectorBlock, share: f64) -> BeadImage {
    let place = Place::Known { body_mm: m.lps_mm, covariance_mm2: m.place_mm2, share };
    BeadImage::new(camera, intrinsics, place, m.image_px, m.noise_px2)
}

/// A problem and what is solved in it.
pub(super) struct Stated<'a> {
    pub problem: Problem<'a>,
    pub camera: PoseBlock,
    pub intrinsics: VectorBlock,
    /// Where there is a lens.
    pub lens: Option<VectorBlock>,
}

/// The problem, with bead n as residual n and the priors behind them, seen through a lens of which the numbers `lens` are free.
pub(super) fn problem<'a>(
    matches: &[Match],
    start: &Rigid,
    k: &Intrinsics,
    options: &Options,
    lens: Option<&[usize]>,
) -> Stated<'a> {
    let mean_lps = matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / matches.len().max(1) as f64;
    let mut problem = Problem::new();
    let camera = problem.pose("camera_from_lps", *start, mean_lps, true);
    let freedom = match options.free {
        Free::Pose => Freedom::Constant,
        Free::Square | Free::Known(_) => square_pixels(k),
    };
    let intrinsics = problem.vector("intrinsics", &[k.fx, k.fy, k.skew, k.cx, k.cy], freedom);
    let loss = if options.loss.is_finite() { Loss::Cauchy(options.loss) } else { Loss::None };
    let lens = lens.map(|chosen| problem.vector("lens", &[0.0; 5], Freedom::Only(chosen.to_vec())));
    for m in matches {
        let image = image_of(m, camera, intrinsics, options.sigma_mm_share);
        let seen = match lens {
            Some(lens) => image.through(lens),
            None => image,
        };
        problem.add(seen, loss);
    }
    if let Some(measured) = &options.measured {
        problem.add(PosePrior::new(camera, measured.camera_from_lps, measured.information), Loss::None);
    }
    if let Free::Known(prior) = options.free {
        problem.add(prior.reading(intrinsics), Loss::None);
    }
    Stated { problem, camera, intrinsics, lens }
}

/// Solves from a start; `None` when the equations are singular or a number ceases to be finite.
pub fn solve(matches: &[Match], start: &Rigid, intrinsics: &Intrinsics, options: &Options) -> Option<Solution> {
    let Stated { problem, camera, intrinsics: k, .. } = problem(matches, start, intrinsics, options, None);
    let estimate = problem.solve(&Settings { iterations: options.iterations, ..Settings::default() }).ok()?;
    let covariance = estimate.covariance().ok()?.of(&[camera.into(), k.into()]);
    let state = estimate.state();
    let &[fx, fy, skew, cx, cy, ..] = state.vector(k) else { return None };
    let solved = Intrinsics { fx, fy, skew, cx, cy };
    let pose = *state.pose(camera);
    let off = |n: usize| DVec2::from_slice(estimate.offset(n));
    let chi2 = |n: usize| {
        if options.sigma_mm_share == 1.0 {
            return estimate.chi2(n);
        }
        let m = &matches[n];
        let spread = image_spread(&solved, &pose, m.lps_mm, &m.place_mm2, m.noise_px2);
        let off = Vector2::new(off(n).x, off(n).y);
        spread.try_inverse().map_or(f64::INFINITY, |inverse| off.dot(&(inverse * off)))
    };
    let finite = covariance.iter().all(|x| x.is_finite()) && pose.translation_mm.is_finite() && fx.is_finite();
    finite.then(|| Solution {
        camera_from_lps: pose,
        intrinsics: solved,
        residuals_px: (0..matches.len()).map(off).collect(),
        chi2: (0..matches.len()).map(chi2).collect(),
        prior_chi2: (matches.len()..problem.residual_count()).map(|n| estimate.chi2(n)).sum(),
        degrees_of_freedom: estimate.degrees_of_freedom(),
        covariance,
        centroid_mm: state.motion(camera).centre_mm(),
    })
}

/// What each match's residual (px) would be under the pose of all others, and how surprising that is; solved by `options`, whose priors
/// count. `None` for a match without which nothing is determined.
pub fn left_out(matches: &[Match], solution: &Solution, options: &Options) -> Vec<Option<LeftOut>> {
    let Stated { problem, .. } = problem(matches, &solution.camera_from_lps, &solution.intrinsics, options, None);
    let settings = Settings { iterations: options.iterations, ..Settings::default() };
    let Ok(estimate) = problem.solve(&settings) else { return vec![None; matches.len()] };
    (0..matches.len()).map(|n| estimate.left_out(n).ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    /// Eight beads over 160×160×120 mm, seen by a C-arm, with noise.
    fn frame(seed: u64) -> (Vec<Match>, Rigid, Intrinsics) {
        let mut random = Stream::new(seed, 0, 0, Purpose::Evaluation);
        let k = Intrinsics { fx: 5257.0, fy: 5257.0, skew: 0.0, cx: 511.5, cy: 511.5 };
        let pose = Rigid::translation(DVec3::new(4.0, -6.0, 600.0)) * Rigid::exp(DVec3::new(0.4, -0.2, 0.9), DVec3::ZERO);
        let matches = (0..8)
            .map(|n| {
                let side = |bit: usize| if n >> bit & 1 == 1 { 1.0 } else { -1.0 };
                let place = DVec3::new(80.0 * side(0), 80.0 * side(1), 60.0 * side(2)) * (0.6 + 0.4 * random.uniform());
                let noise = DVec2::new(random.normal(), random.normal()) * 0.05;
                let image_px = k.project(pose.transform_point(place)) + noise;
                let place_mm2 = DMat3::from_diagonal(DVec3::splat(0.05f64.powi(2)));
                let (sigma_px, noise_px2) = (0.05, [0.0025, 0.0, 0.0025]);
                Match { bead: n, detection: n, lps_mm: place, image_px, sigma_px, noise_px2, place_mm2 }
            })
            .collect();
        (matches, pose, k)
    }

    #[test]
    fn a_prior_of_intrinsics_lies_between_known_and_unknown() {
        let (matches, pose, k) = frame(1);
        let loose = IntrinsicsPrior::from_distance(k, (1020.0, 3.0), (0.194, 0.0002), 5.0);
        let tight = IntrinsicsPrior::from_distance(k, (1020.0, 1e-4), (0.194, 1e-9), 1e-4);
        let sigma = |free: Free| {
            let solution = solve(&matches, &pose, &k, &Options::least_squares(free)).expect("regular");
            // A prior is an observation for each number that it frees.
            let degrees = if free == Free::Square { 7 } else { 10 };
            assert_eq!(solution.degrees_of_freedom, degrees, "{free:?}");
            (solution.covariance[(0, 0)].sqrt(), solution.covariance[(5, 5)].sqrt())
        };
        let (known, tight, prior, free) =
            (sigma(Free::Pose), sigma(Free::Known(tight)), sigma(Free::Known(loose)), sigma(Free::Square));
        assert!(known.1 < prior.1 && prior.1 < free.1, "{known:?} {prior:?} {free:?}");
        assert!((tight.1 / known.1 - 1.0).abs() < 1e-3 && (tight.0 / known.0 - 1.0).abs() < 1e-3, "{tight:?} {known:?}");
    }

    #[test]
    fn a_moved_bead_is_the_most_surprising_one() {
        let (mut matches, pose, k) = frame(2);
        matches[3].image_px += DVec2::new(8.0, -3.0);
        let options = Options::least_squares(Free::Pose);
        let solution = solve(&matches, &pose, &k, &options).expect("regular");
        let left_out: Vec<f64> =
            left_out(&matches, &solution, &options).into_iter().map(|l| l.expect("seven are enough").chi2).collect();
        let worst = (0..8).max_by(|a, b| left_out[*a].total_cmp(&left_out[*b]));
        assert_eq!(worst, Some(3), "{left_out:?}");
    }
}

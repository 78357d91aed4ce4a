//! Pose (and K) from matched beads: Levenberg–Marquardt on SE(3).
//!
//! The pose moves by camera_from_lps ← T(c)·exp(ξ̂)·T(−c)·camera_from_lps with c the beads' centroid in `camera`: rotation about the
//! beads and translation of the beads, which are nearly uncorrelated, where rotation about the distant source and translation are not.
//! A bead's measurement has the covariance Σ = σ_px² 1 + σ_mm² A Aᵀ, A = ∂(u, v)/∂p: noise of the image and of the bead's place.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x3, Matrix6, Vector2, Vector6};

use crate::geometry::{Intrinsics, Rigid};

/// A bead and its shadow.
#[derive(Clone, Copy, Debug)]
pub struct Match {
    /// Index in the layout.
    pub bead: usize,
    /// Index among the detections.
    pub detection: usize,
    pub lps_mm: DVec3,
    pub image_px: DVec2,
    pub sigma_px: f64,
    pub sigma_mm: f64,
}

/// Which of K's numbers are unknown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Free {
    /// None: K is known.
    Pose,
    /// One focal length and the principal point: square pixels.
    Square,
}

impl Free {
    /// Unknowns besides the pose.
    pub fn count(self) -> usize {
        match self {
            Self::Pose => 0,
            Self::Square => 3,
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
    /// The weights take this share of σ_mm; the covariance always takes all of it.
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
    /// Squared residual in standard deviations (two degrees of freedom), per match, with all of σ_mm.
    pub chi2: Vec<f64>,
    /// Covariance of (ω, v) about the centroid, then of K's free numbers (px).
    pub covariance: DMatrix<f64>,
    /// The beads' centroid in `camera`.
    pub centroid_mm: DVec3,
}

/// Rows of ∂(u, v)/∂p for a point in `camera`.
pub fn image_by_point(intrinsics: &Intrinsics, p: DVec3) -> Matrix2x3<f64> {
    let (fx, fy, skew) = (intrinsics.fx, intrinsics.fy, intrinsics.skew);
    let z = p.z;
    Matrix2x3::new(fx / z, skew / z, -(fx * p.x + skew * p.y) / (z * z), 0.0, fy / z, -fy * p.y / (z * z))
}

/// −[r]× as it stands in δp = ω × r + v.
fn minus_cross(r: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, -r.z, r.y), DVec3::new(r.z, 0.0, -r.x), DVec3::new(-r.y, r.x, 0.0))
}

/// ∂p/∂(ω, v) for rotation about `centre`, 3×6.
pub fn point_by_pose(p: DVec3, centre: DVec3) -> nalgebra::Matrix3x6<f64> {
    let cross = minus_cross(p - centre);
    let mut j = nalgebra::Matrix3x6::zeros();
    for column in 0..3 {
        let c = cross.col(column);
        j[(0, column)] = c.x;
        j[(1, column)] = c.y;
        j[(2, column)] = c.z;
        j[(column, column + 3)] = 1.0;
    }
    j
}

/// ξ about `centre` from ξ about the camera's origin: (ω, v + ω × c).
pub fn about(centre: DVec3) -> Matrix6<f64> {
    let cross = minus_cross(centre);
    let mut t = Matrix6::identity();
    for column in 0..3 {
        let c = cross.col(column);
        t[(3, column)] = c.x;
        t[(4, column)] = c.y;
        t[(5, column)] = c.z;
    }
    t
}

struct Linear {
    jacobian: DMatrix<f64>,
    residual: DVector<f64>,
    /// Square residual under all of σ_mm, per match.
    chi2: Vec<f64>,
    residuals_px: Vec<DVec2>,
    /// Σ of the weights and Σ of the covariance, per match.
    covariances: Vec<(Matrix2<f64>, Matrix2<f64>)>,
    cost: f64,
}

fn linearise(matches: &[Match], pose: &Rigid, k: &Intrinsics, centre: DVec3, options: &Options) -> Linear {
    let columns = 6 + options.free.count();
    let mut jacobian = DMatrix::zeros(2 * matches.len(), columns);
    let mut residual = DVector::zeros(2 * matches.len());
    let (mut chi2, mut residuals_px, mut covariances) = (Vec::new(), Vec::new(), Vec::new());
    let mut cost = 0.0;
    for (n, m) in matches.iter().enumerate() {
        let p = pose.transform_point(m.lps_mm);
        let a = image_by_point(k, p);
        let off = m.image_px - k.project(p);
        let spread = a * a.transpose();
        let image = Matrix2::identity() * m.sigma_px.powi(2).max(1e-8);
        let full = image + spread * m.sigma_mm.powi(2);
        let used = image + spread * (m.sigma_mm * options.sigma_mm_share).powi(2);
        let off2 = Vector2::new(off.x, off.y);
        let square = |s: &Matrix2<f64>| s.try_inverse().map_or(f64::INFINITY, |i| (off2.transpose() * i * off2)[(0, 0)]);
        let own = if p.z > 1.0 { square(&used) } else { 1e12 };
        cost += if options.loss.is_finite() { options.loss.powi(2) * (1.0 + own / options.loss.powi(2)).ln() } else { own };
        chi2.push(square(&full));
        residuals_px.push(off);
        covariances.push((used, full));
        let rows = a * point_by_pose(p, centre);
        jacobian.view_mut((2 * n, 0), (2, 6)).copy_from(&rows);
        let (x, y) = (p.x / p.z, p.y / p.z);
        match options.free {
            Free::Pose => {}
            Free::Square => {
                jacobian[(2 * n, 6)] = x;
                jacobian[(2 * n + 1, 6)] = y;
                jacobian[(2 * n, 7)] = 1.0;
                jacobian[(2 * n + 1, 8)] = 1.0;
            }
        }
        residual[2 * n] = off.x;
        residual[2 * n + 1] = off.y;
    }
    if let Some(measured) = &options.measured {
        let r = deviation(pose, &measured.camera_from_lps);
        cost += (r.transpose() * measured.information * r)[(0, 0)];
    }
    Linear { jacobian, residual, chi2, residuals_px, covariances, cost }
}

/// ξ with exp(ξ̂)·from = to.
pub fn deviation(to: &Rigid, from: &Rigid) -> Vector6<f64> {
    let (omega, v) = (*to * from.inverse()).log();
    Vector6::new(omega.x, omega.y, omega.z, v.x, v.y, v.z)
}

/// JᵀWJ and JᵀWr with the loss's weights, the measured pose included.
fn normal_equations(linear: &Linear, pose: &Rigid, centre: DVec3, options: &Options) -> (DMatrix<f64>, DVector<f64>) {
    let columns = linear.jacobian.ncols();
    let (mut normal, mut right) = (DMatrix::zeros(columns, columns), DVector::zeros(columns));
    for (n, (used, _)) in linear.covariances.iter().enumerate() {
        let Some(inverse) = used.try_inverse() else { continue };
        let j = linear.jacobian.rows(2 * n, 2);
        let r = linear.residual.rows(2 * n, 2);
        let own = (r.transpose() * inverse * r)[(0, 0)];
        let weight = if options.loss.is_finite() { 1.0 / (1.0 + own / options.loss.powi(2)) } else { 1.0 };
        let jw = j.transpose() * inverse * weight;
        normal += &jw * j;
        right += jw * r;
    }
    if let Some(measured) = &options.measured {
        // ξ about the origin = T⁻¹ · ξ about the centroid.
        let t = about(-centre);
        let information = t.transpose() * measured.information * t;
        let pull = t.transpose() * measured.information * deviation(pose, &measured.camera_from_lps);
        for i in 0..6 {
            right[i] -= pull[i];
            for j in 0..6 {
                normal[(i, j)] += information[(i, j)];
            }
        }
    }
    (normal, right)
}

fn moved(pose: &Rigid, centre: DVec3, step: &DVector<f64>) -> Rigid {
    let local = Rigid::exp(DVec3::new(step[0], step[1], step[2]), DVec3::new(step[3], step[4], step[5]));
    Rigid::translation(centre) * local * Rigid::translation(-centre) * *pose
}

fn changed(k: &Intrinsics, free: Free, step: &DVector<f64>) -> Intrinsics {
    let mut next = *k;
    match free {
        Free::Pose => {}
        Free::Square => {
            next.fx += step[6];
            next.fy += step[6];
            next.cx += step[7];
            next.cy += step[8];
        }
    }
    next
}

/// Solves from a start; `None` when the equations are singular or a number ceases to be finite.
pub fn solve(matches: &[Match], start: &Rigid, intrinsics: &Intrinsics, options: &Options) -> Option<Solution> {
    let mean_lps = matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / matches.len().max(1) as f64;
    let (mut pose, mut k) = (*start, *intrinsics);
    let mut centre = pose.transform_point(mean_lps);
    let mut linear = linearise(matches, &pose, &k, centre, options);
    let mut damping = 1e-4;
    for _ in 0..options.iterations {
        let (normal, right) = normal_equations(&linear, &pose, centre, options);
        let mut gain = 0.0;
        let mut accepted = false;
        for _ in 0..8 {
            let mut damped = normal.clone();
            for n in 0..damped.nrows() {
                damped[(n, n)] *= 1.0 + damping;
            }
            let Some(step) = damped.cholesky().map(|c| c.solve(&right)) else {
                damping = (damping * 10.0).max(1e-8);
                continue;
            };
            let (next_pose, next_k) = (moved(&pose, centre, &step), changed(&k, options.free, &step));
            let next_centre = next_pose.transform_point(mean_lps);
            let sane = next_k.fx > 1.0 && next_k.fy > 1.0 && next_centre.z > 1.0;
            if sane {
                let next = linearise(matches, &next_pose, &next_k, next_centre, options);
                if next.cost <= linear.cost {
                    gain = linear.cost - next.cost;
                    (pose, k, centre, linear) = (next_pose, next_k, next_centre, next);
                    damping *= 0.1;
                    accepted = true;
                    break;
                }
            }
            damping = (damping * 10.0).max(1e-8);
        }
        if !accepted || gain <= 1e-12 * (1.0 + linear.cost) {
            break;
        }
    }
    let plain = Options { loss: f64::INFINITY, ..*options };
    let (normal, _) = normal_equations(&linear, &pose, centre, &plain);
    let inverse = normal.cholesky()?.inverse();
    // Sandwich H⁻¹ (Σ Jᵀ W Σ_full W J + prior) H⁻¹: equal to H⁻¹ when the weights take all of σ_mm.
    let mut middle: DMatrix<f64> = DMatrix::zeros(inverse.nrows(), inverse.nrows());
    for (n, (used, full)) in linear.covariances.iter().enumerate() {
        let jw = linear.jacobian.rows(2 * n, 2).transpose() * used.try_inverse()?;
        middle += &jw * full * jw.transpose();
    }
    if let Some(measured) = &options.measured {
        let t = about(-centre);
        let information = t.transpose() * measured.information * t;
        let mut block = middle.view_mut((0, 0), (6, 6));
        block += information;
    }
    let covariance = &inverse * middle * &inverse;
    let finite = covariance.iter().all(|x| x.is_finite()) && pose.translation_mm.is_finite() && k.fx.is_finite();
    finite.then_some(Solution {
        camera_from_lps: pose,
        intrinsics: k,
        residuals_px: linear.residuals_px,
        chi2: linear.chi2,
        covariance,
        centroid_mm: centre,
    })
}

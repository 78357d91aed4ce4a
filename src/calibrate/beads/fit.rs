//! The fit of one ball to the voxels around it.
//!
//! ```text
//! hu(voxel) = background + b₀ + g·(x − x₀) + other balls + A · mean share of the ball over the voxel + noise
//! ```
//! Clipped voxels are censored: all that is known is that the value is at least the clip, so they add −ln Φ((model − clip)/σ) to the
//! cost. Contrast A, radius and point spread hang together where the ball is clipped or small; what a CT of metal beads ordinarily has
//! enters as a wide prior of each, so that what the data do not say is stated as uncertainty instead of running away.

use glam::DVec3;
use nalgebra::{SMatrix, SVector};

use super::sphere::{VoxelPoints, error_function};
use crate::estimate::SmallSteps;

/// Unknowns: centre (3), ln mass, ln radius, ln blur, offset, gradient (3).
pub(super) const UNKNOWNS: usize = 10;
type Vector = SVector<f64, UNKNOWNS>;
type Matrix = SMatrix<f64, UNKNOWNS, UNKNOWNS>;

const MOST_STEPS: usize = 60;
/// Residuals beyond this many σ count as anatomy that the background does not have, and pull with constant force.
const HUBER_SIGMAS: f64 = 4.0;
/// Voxels that stand out by less than this share of the highest are halo, and tell little of a shape.
const STANDS_OUT: f64 = 0.2;

/// A number's logarithm: expected value, and σ.
#[derive(Clone, Copy, Debug)]
pub(super) struct Prior {
    /// Of the number.
    pub expected: f64,
    /// Of its logarithm.
    pub sigma_ln: f64,
}

/// What is known beforehand.
#[derive(Clone, Copy, Debug)]
pub(super) struct Priors {
    /// Contrast of the metal to tissue, HU.
    pub contrast_hu: Prior,
    /// The ball's radius, mm.
    pub radius_mm: Prior,
    /// σ of the point spread, mm.
    pub blur_mm: Prior,
    /// σ of the background's offset, HU.
    pub offset_hu: f64,
    /// σ of its gradient, HU/mm.
    pub gradient_hu_per_mm: f64,
}

/// A voxel of the fit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    /// Centre, lps mm.
    pub place_lps_mm: DVec3,
    /// As stored.
    pub hu: f64,
    /// What is there without this ball: surroundings and other balls.
    pub background_hu: f64,
}

/// A ball in a CT.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Ball {
    /// Centre.
    pub centre_lps_mm: DVec3,
    /// Contrast times volume, HU·mm³.
    pub mass_hu_mm3: f64,
    /// Radius.
    pub radius_mm: f64,
    /// σ of the point spread.
    pub blur_mm: f64,
}

impl Ball {
    /// HU above tissue inside.
    pub fn contrast_hu(&self) -> f64 {
        self.mass_hu_mm3 / (4.0 / 3.0 * std::f64::consts::PI * self.radius_mm.powi(3))
    }

    /// HU that it adds to the voxel at `place`.
    pub fn adds_hu(&self, place: DVec3, points: &VoxelPoints) -> f64 {
        self.contrast_hu() * points.mean_share(place - self.centre_lps_mm, self.radius_mm, self.blur_mm).0
    }
}

/// What is fitted, and to what.
#[derive(Clone, Debug)]
pub(super) struct Problem<'a> {
    /// Voxels.
    pub samples: &'a [Sample],
    /// How a voxel averages.
    pub points: &'a VoxelPoints,
    /// Values from here on are clipped; infinity where nothing is.
    pub clip_hu: f64,
    /// White noise of a voxel.
    pub noise_hu: f64,
    /// Misfit that neighbours share: anatomy, streaks, a point spread that is no Gaussian.
    pub misfit_hu: f64,
    /// Distance over which it is shared, mm.
    pub misfit_length_mm: f64,
    /// Known beforehand.
    pub priors: Priors,
}

/// A fitted ball.
#[derive(Clone, Debug)]
pub(super) struct Fitted {
    /// The ball.
    pub ball: Ball,
    /// Of the centre, mm².
    pub covariance_mm2: [[f64; 3]; 3],
    /// σ of ln radius and ln blur.
    pub radius_sigma_ln: f64,
    /// See `radius_sigma_ln`.
    pub blur_sigma_ln: f64,
    /// Root mean square of what the model misses, unclipped voxels, HU.
    pub rms_hu: f64,
    /// Root mean square of what the model misses where ball or data stand out, as a share of the ball there.
    pub missed_share: f64,
    /// Root mean square of what the model misses there, in σ of the white noise.
    pub missed_sigmas: f64,
    /// Clipped voxels.
    pub clipped: usize,
}

struct Row {
    /// Model less data; positive where the model is too high.
    residual: f64,
    by: Vector,
    clipped: bool,
}

impl Problem<'_> {
    /// Levenberg–Marquardt from `start`; `None` where it leaves what numbers can hold.
    pub fn solve(&self, start: Ball) -> Option<Fitted> {
        let origin = start.centre_lps_mm;
        let mut at = Vector::zeros();
        at[3] = start.mass_hu_mm3.ln();
        at[4] = start.radius_mm.ln();
        at[5] = start.blur_mm.ln();
        let (mut cost, mut gradient, mut curvature) = self.normal(&at, origin);
        let mut steps = SmallSteps { damping: 1e-2, lower: 0.2, raise: 5.0, most: 1e8, attempts: usize::MAX };
        // Half a millimetre, or a factor of 1.6, at a time: farther than that the linear model says little.
        let held = |step: &Vector| {
            let largest = step.rows(0, 6).amax();
            if largest > 0.5 { step * (0.5 / largest) } else { *step }
        };
        for _ in 0..MOST_STEPS {
            // What is tried is looked at once: of a step that is taken, what comes next is known already.
            let mut tried = (cost, gradient, curvature);
            let taken = steps.take(&curvature, &-gradient, |step| {
                tried = self.normal(&(at + held(step)), origin);
                tried.0 <= cost
            });
            let Some(step) = taken.map(|step| held(&step)) else { break };
            at += step;
            (cost, gradient, curvature) = tried;
            if step.rows(0, 3).amax() < 2e-5 && step.rows(3, 3).amax() < 1e-3 {
                break;
            }
        }
        self.describe(&at, origin).filter(|_| cost.is_finite())
    }

    fn ball(at: &Vector, origin: DVec3) -> Ball {
        Ball {
            centre_lps_mm: origin + DVec3::new(at[0], at[1], at[2]),
            mass_hu_mm3: at[3].exp(),
            radius_mm: at[4].exp(),
            blur_mm: at[5].exp(),
        }
    }

    fn rows<'a>(&'a self, at: &Vector, origin: DVec3) -> impl Iterator<Item = Row> + 'a {
        let ball = Self::ball(at, origin);
        let contrast = ball.contrast_hu();
        let (offset, slope) = (at[6], DVec3::new(at[7], at[8], at[9]));
        self.samples.iter().map(move |sample| {
            let (share, by_place, by_radius, by_blur) =
                self.points.mean_share(sample.place_lps_mm - ball.centre_lps_mm, ball.radius_mm, ball.blur_mm);
            let away = sample.place_lps_mm - origin;
            let model = sample.background_hu + offset + slope.dot(away) + contrast * share;
            let by_centre = -contrast * by_place;
            let by = Vector::from([
                by_centre.x,
                by_centre.y,
                by_centre.z,
                contrast * share,
                // The mass stays while the radius grows: the contrast falls by its third power.
                contrast * (ball.radius_mm * by_radius - 3.0 * share),
                contrast * ball.blur_mm * by_blur,
                1.0,
                away.x,
                away.y,
                away.z,
            ]);
            Row { residual: model - sample.hu.min(self.clip_hu), by, clipped: sample.hu >= self.clip_hu }
        })
    }

    fn sigma_hu(&self) -> f64 {
        self.noise_hu.hypot(self.misfit_hu)
    }

    /// Residuals of the priors over their σ, and their derivatives.
    fn prior_rows(&self, at: &Vector) -> [(f64, Vector); 7] {
        let Priors { contrast_hu, radius_mm, blur_mm, offset_hu, gradient_hu_per_mm } = self.priors;
        let unit = |n: usize, by: f64| {
            let mut row = Vector::zeros();
            row[n] = by;
            row
        };
        let ln_contrast = at[3] - 3.0 * at[4] - (4.0 / 3.0 * std::f64::consts::PI).ln();
        let contrast = (unit(3, 1.0) + unit(4, -3.0)) / contrast_hu.sigma_ln;
        let of = |n: usize, prior: Prior| ((at[n] - prior.expected.ln()) / prior.sigma_ln, unit(n, 1.0 / prior.sigma_ln));
        let plain = |n: usize, sigma: f64| (at[n] / sigma, unit(n, 1.0 / sigma));
        [
            ((ln_contrast - contrast_hu.expected.ln()) / contrast_hu.sigma_ln, contrast),
            of(4, radius_mm),
            of(5, blur_mm),
            plain(6, offset_hu),
            plain(7, gradient_hu_per_mm),
            plain(8, gradient_hu_per_mm),
            plain(9, gradient_hu_per_mm),
        ]
    }

    /// The cost, its gradient and its curvature.
    fn normal(&self, at: &Vector, origin: DVec3) -> (f64, Vector, Matrix) {
        let sigma = self.sigma_hu();
        let (mut cost, mut gradient, mut curvature) = (0.0, Vector::zeros(), Matrix::zeros());
        for row in self.rows(at, origin) {
            cost += row.cost(sigma);
            let (slope, bend) = row.weights(sigma);
            if slope != 0.0 || bend != 0.0 {
                gradient.axpy(slope, &row.by, 1.0);
                curvature.ger(bend, &row.by, &row.by, 1.0);
            }
        }
        let priors = self.prior_rows(at);
        cost += priors.iter().map(|(z, _)| 0.5 * z * z).sum::<f64>();
        for (z, by) in priors {
            gradient.axpy(z, &by, 1.0);
            curvature.ger(1.0, &by, &by, 1.0);
        }
        (cost, gradient, curvature)
    }

    fn describe(&self, at: &Vector, origin: DVec3) -> Option<Fitted> {
        let (_, _, curvature) = self.normal(at, origin);
        let inverse = curvature.cholesky()?.inverse();
        let rows: Vec<Row> = self.rows(at, origin).collect();
        let covariance = inverse + inverse * self.shared(&rows) * inverse;
        let background =
            |row: &Row, sample: &Sample| sample.background_hu + at[6] + at[7] * row.by[7] + at[8] * row.by[8] + at[9] * row.by[9];
        // Of each voxel: what the model misses (below the clip only, where it is clipped), the ball's own share of what can be seen, and
        // how far data or ball stand out.
        let seen: Vec<(f64, f64, f64)> = rows
            .iter()
            .zip(self.samples)
            .map(|(row, sample)| {
                let background = background(row, sample);
                let missed = if row.clipped { row.residual.min(0.0) } else { row.residual };
                let ball = row.by[3].min(self.clip_hu - background);
                (missed, ball, ball.max(sample.hu.min(self.clip_hu) - background))
            })
            .collect();
        let highest = seen.iter().map(|(.., stands_out)| *stands_out).fold(0.0, f64::max);
        let rms = |voxels: &mut dyn Iterator<Item = f64>| {
            let (sum, count) = voxels.fold((0.0, 0usize), |(sum, count), value| (sum + value * value, count + 1));
            (sum / count.max(1) as f64).sqrt()
        };
        let strong = || seen.iter().filter(|(.., stands_out)| *stands_out >= STANDS_OUT * highest);
        let missed_hu = rms(&mut strong().map(|(missed, ..)| *missed));
        let missed_share = missed_hu / rms(&mut strong().map(|(_, ball, _)| *ball));
        // A clipped voxel whose model is above the clip says nothing of a misfit.
        let rms_hu = rms(&mut seen
            .iter()
            .zip(&rows)
            .filter(|(_, row)| !row.clipped || row.residual < 0.0)
            .map(|((missed, ..), _)| *missed));
        let ball = Self::ball(at, origin);
        let covariance_mm2 = [0, 1, 2].map(|r| [0, 1, 2].map(|c| 0.5 * (covariance[(r, c)] + covariance[(c, r)])));
        let finite = covariance.iter().all(|value| value.is_finite()) && ball.centre_lps_mm.is_finite();
        finite.then_some(Fitted {
            ball,
            covariance_mm2,
            radius_sigma_ln: covariance[(4, 4)].max(0.0).sqrt(),
            blur_sigma_ln: covariance[(5, 5)].max(0.0).sqrt(),
            rms_hu,
            missed_share,
            missed_sigmas: missed_hu / self.noise_hu,
            clipped: rows.iter().filter(|row| row.clipped).count(),
        })
    }

    /// What shared misfit adds between the inverses of the curvature: Σ over pairs of voxels of their gradients' products, by how much
    /// of the misfit they share. Alone, each voxel has it in its σ already.
    fn shared(&self, rows: &[Row]) -> Matrix {
        let mut sum = Matrix::zeros();
        if !(self.misfit_hu > 0.0) {
            return sum;
        }
        let sigma = self.sigma_hu();
        let strong: Vec<(DVec3, Vector)> = rows
            .iter()
            .zip(self.samples)
            .map(|(row, sample)| (sample.place_lps_mm, row.by * row.weights(sigma).1))
            .filter(|(_, by)| by.amax() > 0.0)
            .collect();
        let reach = 3.0 * self.misfit_length_mm;
        let variance = self.misfit_hu * self.misfit_hu;
        for (at, (place, by)) in strong.iter().enumerate() {
            let mut others = Vector::zeros();
            for (other, (elsewhere, of_other)) in strong.iter().enumerate() {
                let squared = place.distance_squared(*elsewhere);
                if other != at && squared < reach * reach {
                    others.axpy((-0.5 * squared / (self.misfit_length_mm * self.misfit_length_mm)).exp(), of_other, 1.0);
                }
            }
            sum.ger(variance, by, &others, 1.0);
        }
        sum
    }
}

impl Row {
    fn cost(&self, sigma: f64) -> f64 {
        let z = self.residual / sigma;
        match self.clipped {
            true => censored(z).0,
            false if z.abs() > HUBER_SIGMAS => HUBER_SIGMAS * (z.abs() - 0.5 * HUBER_SIGMAS),
            false => 0.5 * z * z,
        }
    }

    /// First derivative of this row's cost by its residual, and the weight that stands for the second.
    fn weights(&self, sigma: f64) -> (f64, f64) {
        let z = self.residual / sigma;
        if self.clipped {
            let (_, slope, bend) = censored(z);
            return (slope / sigma, bend / (sigma * sigma));
        }
        let weight = if z.abs() > HUBER_SIGMAS { HUBER_SIGMAS / z.abs() } else { 1.0 };
        (weight * z / sigma, weight / (sigma * sigma))
    }
}

/// −ln Φ(z), its first derivative, and the weight that stands for its second. Beyond `HUBER_SIGMAS` below it goes on as a straight line.
fn censored(z: f64) -> (f64, f64, f64) {
    if z > 6.0 {
        return (0.0, 0.0, 0.0);
    }
    if !(z >= -HUBER_SIGMAS) {
        let (edge, slope, _) = censored(-HUBER_SIGMAS);
        return (edge + slope * (z + HUBER_SIGMAS), slope, -slope / z.abs());
    }
    let exp = (-0.5 * z * z).exp();
    let share = 0.5 * (1.0 + error_function(z, exp));
    let ratio = exp / std::f64::consts::TAU.sqrt() / share;
    (-share.ln(), -ratio, (ratio * (ratio + z)).max(0.0))
}

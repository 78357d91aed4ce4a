//! What a finished fit is worth: covariance of the centre, uncertainty of the radius, misfit, flags.
//!
//! Noise moves the centre by Σ aᵢ zᵢ, a being the influence of each pixel and z its residual over its noise, so that its covariance is
//! aᵀRa with the noise's correlation R. Structure under a shadow is in part followed by the background and in part left in the residual;
//! from either part something is known of its other part.

use super::flags::Flags;
use super::model::{Fit, Model};
use super::radius_sigma::radius_sigma_ln;
use super::shadow::{BLUR_PRIOR, COUNT, CUBIC, Equations, Evaluated, Matrix, SHAPE, Vector, Weighing};
use super::window::{Field, Window};

/// A fit that has arrived.
pub struct Finished<'a> {
    pub model: Model,
    pub theta: &'a Vector,
    pub window: &'a Window,
    pub at: &'a Evaluated,
    pub weighing: &'a Weighing,
    pub equations: &'a Equations,
    pub normal: &'a Matrix,
    pub field: &'a Field<'a>,
}

type Square = [[f64; 2]; 2];

/// Error of the centre over what clustered residuals do to it, where structure is strong: the fit has followed the larger part.
const CLUSTERED: f64 = 3.0;
/// Error of the centre over what the background's third degree does to it, where tissue is curved.
const FOLLOWED: f64 = 0.22;
/// Shift of the centre, in radii, of a shadow that is deeper on one side by its own depth per radius: (∫ρ³)/(∫ρ³/(1 − ρ²)), the lower
/// integral cut off by blur.
const LOPSIDED: f64 = 0.2;
/// Share of the radius by which structure may move the centre of a shadow that is not flagged.
const MOST_STRUCTURE: f64 = 0.0027;
/// Share of the core that is clipped, and of the shadow that is masked, from which it is flagged.
const CLIPPED_SHARE: f64 = 0.1;
const MASKED_SHARE: f64 = 0.02;

const RINGS: usize = 4;
const SECTORS: usize = 8;

/// Residuals by polar bins about the centre: what noise leaves averages out in them, what the model misses does not.
struct Residuals {
    /// Weighted sum of squares over noise.
    chi2: f64,
    /// Σ over bins of (Σ aᵢ zᵢ)(Σ aᵢ zᵢ)ᵀ: covariance of the centre if bins, not pixels, are independent.
    clustered: Square,
    /// Mean square of the bins' means beyond noise, as a share of the shadow's depth.
    unexplained: f64,
    /// Share of the core's pixels that are clipped.
    clipped: f64,
}

/// The fit with its uncertainty; `None` where the equations are singular, a number is not finite or a variance not positive.
pub fn judge(finished: &Finished) -> Option<Fit> {
    let Finished { model, theta, window, weighing, .. } = *finished;
    let inverse = finished.normal.cholesky()?.inverse();
    let (by_depth, depth_normal) = finished.equations.of_depth(model, finished.normal, finished.at, weighing);
    let held = held_inverse(&depth_normal)?;
    let correlation = finished.field.noise.correlation();
    let correlated = window.is_whole && !correlation.is_white();
    let count = window.len() as f64;
    // A smooth term of the model takes as much of the noise as there is at low frequency; the centre's terms take less.
    let taken = if correlated { (0.7 * correlation.sum()).max(1.0) } else { 1.0 };
    let dof = (count - COUNT as f64 * taken).max(0.3 * count);

    let influence = finished.equations.influence(None, &inverse, weighing, [0, 1]);
    let residuals = residuals(finished, &influence, correlated);
    let chi2_per_dof = residuals.chi2 / dof;
    let scale = chi2_per_dof.max(1.0);

    let mut covariance: Square = std::array::from_fn(|i| std::array::from_fn(|j| inverse[(i, j)]));
    let (mut depth_variance, mut radius_variance) = (held[(4, 4)], inverse[(2, 2)]);
    if correlated {
        let [u, v] = influence.each_ref().map(|influence| window.on_grid(influence));
        let form = |a: &[f64], b: &[f64]| correlation.form(a, b, window.side);
        let mixed = form(&u, &v);
        // A correlation that is measured need not be one that noise can have: then what white noise gives stays.
        let of_noise = [[form(&u, &u), mixed], [mixed, form(&v, &v)]];
        if is_positive(&of_noise) {
            covariance = of_noise;
        }
        let variance_of = |by_depth: Option<&[f64]>, inverse: &Matrix, parameter: usize| {
            let [by_parameter] = finished.equations.influence(by_depth, inverse, weighing, [parameter]);
            let grid = window.on_grid(&by_parameter);
            Some(form(&grid, &grid)).filter(|variance| *variance > 0.0)
        };
        depth_variance = variance_of(Some(&by_depth), &held, 4).unwrap_or(depth_variance);
        radius_variance =
            variance_of(None, &inverse, 2).map_or(radius_variance, |variance| variance + of_priors(model, &inverse));
    }
    let structure = structure(finished, &inverse, &residuals.clustered, scale)?;
    let structure_px = (0.5 * (structure[0][0] + structure[1][1])).sqrt();
    for (i, line) in covariance.iter_mut().enumerate() {
        for (j, value) in line.iter_mut().enumerate() {
            // Noise that is stronger here than elsewhere looks like structure: whichever says more.
            let local = (scale - 1.0) * *value;
            *value += if i == j { structure[i][j].max(local) } else { structure[i][j] };
        }
    }
    let (radius_px, blur_px) = (theta[2].exp(), theta[3].exp());
    let shadow_px = 1.3 * radius_px + 1.0;
    let masked = window.missing.iter().filter(|(dx, dy)| (dx - theta[0]).hypot(dy - theta[1]) < shadow_px).count() as f64;
    let fit = Fit {
        model,
        u_px: window.u_px + theta[0],
        v_px: window.v_px + theta[1],
        radius_px,
        radius_sigma_ln: radius_sigma_ln(model, (radius_variance * scale).sqrt(), radius_px, blur_px),
        blur_px,
        contrast: theta[4],
        depth: model.depth(theta[4], blur_px / radius_px),
        snr: theta[4].signum() / (depth_variance * scale).sqrt(),
        covariance_px2: covariance,
        chi2_per_dof,
        dof,
        misfit: residuals.unexplained.max(0.0).sqrt(),
        coverage: count / window.total.max(1.0),
        structure_px,
        flags: Flags {
            clipped: residuals.clipped > CLIPPED_SHARE,
            overlapping: false,
            at_mask: masked > MASKED_SHARE * std::f64::consts::PI * shadow_px * shadow_px,
            over_structure: !(structure_px <= MOST_STRUCTURE * radius_px),
        },
    };
    let [[uu, uv], [_, vv]] = fit.covariance_px2;
    let finite = [fit.u_px, fit.v_px, fit.radius_px, fit.contrast, fit.depth, fit.snr, uu, uv, vv, fit.misfit];
    (finite.iter().all(|x| x.is_finite()) && is_positive(&fit.covariance_px2)).then_some(fit)
}

/// Whether it can be a covariance.
fn is_positive([[uu, uv], [_, vv]]: &Square) -> bool {
    *uu > 0.0 && uu * vv - uv * uv > 0.0
}

fn residuals(finished: &Finished, influence: &[Vec<f64>; 2], correlated: bool) -> Residuals {
    let Finished { model, theta, window, at, weighing, .. } = *finished;
    let base = match model {
        Model::Transmission => theta[SHAPE].exp() * (1.0 - (-theta[4]).exp()),
        Model::Additive { .. } => theta[4],
    };
    let mut bins = [[0.0f64; 5]; RINGS * SECTORS];
    let mut bin_of = vec![0usize; window.len()];
    let (mut chi2, mut core, mut clipped) = (0.0, 0.0, 0.0);
    for n in 0..window.len() {
        let residual = window.value[n] - at.value[n];
        let z = residual / weighing.sigma[n];
        chi2 += weighing.trust[n] * z * z;
        let rho = at.rho[n];
        if rho < 0.8 {
            core += 1.0;
            clipped += if finished.field.is_clipped(window.value[n]) { 1.0 } else { 0.0 };
        }
        let ring = [0.6, 1.0, 1.4].iter().filter(|end| rho >= **end).count();
        let angle = (window.dy[n] - theta[1]).atan2(window.dx[n] - theta[0]) / std::f64::consts::TAU + 0.5;
        bin_of[n] = ring * SECTORS + ((angle * SECTORS as f64) as usize).min(SECTORS - 1);
        let share = residual / base;
        let terms = [1.0, share, share * share, influence[0][n] * z, influence[1][n] * z];
        bins[bin_of[n]].iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
    }
    // The noise of each bin's sum, per that of as many uncorrelated pixels.
    let mut excess = [1.0f64; RINGS * SECTORS];
    if correlated {
        finished.field.noise.correlation().excess_by_group(&window.place, &bin_of, window.side, &mut excess);
    }
    let (mut unexplained, mut counted, mut clustered) = (0.0, 0.0, [[0.0; 2]; 2]);
    for (n, [count, sum, squares, by_u, by_v]) in bins.iter().enumerate() {
        for (line, a) in clustered.iter_mut().zip([by_u, by_v]) {
            line.iter_mut().zip([by_u, by_v]).for_each(|(value, b)| *value += a * b);
        }
        if *count < 2.0 || n >= (RINGS - 1) * SECTORS {
            continue;
        }
        let mean = sum / count;
        let variance = ((squares - count * mean * mean) / (count - 1.0)).max(0.0);
        unexplained += count * (mean * mean - excess[n] * variance / count);
        counted += count;
    }
    Residuals { chi2, clustered, unexplained: unexplained / f64::max(counted, 1.0), clipped: clipped / f64::max(core, 1.0) }
}

/// Covariance of the centre from what is neither noise nor in the model.
fn structure(finished: &Finished, inverse: &Matrix, clustered: &Square, scale: f64) -> Option<Square> {
    let Finished { theta, window, .. } = *finished;
    // How far the centre would lie off if the background had no third degree, and the noise of that.
    let cubic = inverse.fixed_view::<CUBIC, CUBIC>(COUNT - CUBIC, COUNT - CUBIC).into_owned();
    let cross = inverse.fixed_view::<2, CUBIC>(0, COUNT - CUBIC).into_owned();
    let weights = cross * cubic.try_inverse()?;
    let bend = weights * theta.fixed_rows::<CUBIC>(COUNT - CUBIC);
    let bend_noise = weights * cross.transpose();
    // Behind an unknown display curve a shadow is deeper on the side where the curve is steeper.
    let radius = theta[2].exp();
    let lopsided = |n: usize| {
        let change_per_radius = theta[SHAPE + 1 + n] / window.half_width * radius / theta[4];
        (LOPSIDED * radius * finished.field.display_curve * change_per_radius).powi(2)
    };
    let left = CLUSTERED.powi(2) * (1.0 - 1.0 / scale).powi(2);
    Some(std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let followed = (bend[i] * bend[i] - bend_noise[(i, i)]).max(0.0);
            left * clustered[i][j] + if i == j { FOLLOWED.powi(2) * followed + lopsided(i) } else { 0.0 }
        })
    }))
}

/// Variance of ln r by what is known of radius, blur and contrast beforehand: of the whole by white noise, what is not the pixels'.
fn of_priors(model: Model, inverse: &Matrix) -> f64 {
    let weights = [(2, 1.0), (3, BLUR_PRIOR.1.powi(-2)), (4, model.contrast_weight())];
    weights.iter().map(|(n, weight)| inverse[(2, *n)].powi(2) * weight).sum()
}

/// Inverse with radius and blur taken as known: they trade off against contrast in small shadows, whose presence is sure.
fn held_inverse(normal: &Matrix) -> Option<Matrix> {
    let mut held = *normal;
    for fixed in [2, 3] {
        for n in 0..COUNT {
            held[(fixed, n)] = 0.0;
            held[(n, fixed)] = 0.0;
        }
        held[(fixed, fixed)] = 1.0;
    }
    Some(held.cholesky()?.inverse())
}

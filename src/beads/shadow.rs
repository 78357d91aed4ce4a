//! A sphere's shadow on its background, as numbers over a window: expected values, their derivatives, and the normal equations.
//!
//! Transmission: V = e^B(x, y) · (1 − (1 − e^(−c))·G_c(d/r; s/r)), so that noise keeps its own statistics and thick metal needs no logarithm
//! of few quanta. Blur acts on what arrives: the profile is that of the shadow's own contrast, c nepers. Other images: V = B(x, y) ± c·G_k.
//! B is a cubic.

use nalgebra::{SMatrix, SVector};

use super::model::{Model, Stopped};
use super::noise::Noise;
use super::products::{dot, dots};
use super::profile::Profile;
use super::window::{BACKGROUND, Window};
use crate::image::{exp, on_widest_vectors};

/// u, v, ln r, ln s, c.
pub const SHAPE: usize = 5;
/// Parameters of a fit.
pub const COUNT: usize = SHAPE + BACKGROUND;
/// θ = (u, v, ln r, ln s, c, background); positions relative to the window's centre.
pub type Vector = SVector<f64, COUNT>;
/// Of normal equations.
pub type Matrix = SMatrix<f64, COUNT, COUNT>;

/// Blur expected of detector and focal spot, px, and the standard deviation of its logarithm.
pub const BLUR_PRIOR: (f64, f64) = (0.8, 0.5);

/// Terms of the background of the third degree, the last ones.
pub const CUBIC: usize = 4;
/// First term of the background that is not a plane's.
const CURVED: usize = 3;

/// What is known before the pixels are looked at.
#[derive(Clone, Copy)]
pub struct Prior {
    pub ln_radius: f64,
    /// Weight against curvature of the background: a stiff one does not follow a wire, which then stands out and is left out.
    pub stiffness: f64,
    /// Weight against contrast.
    pub contrast: f64,
}

/// Expected values over a window, and what their derivatives are made of.
#[derive(Clone, Default)]
pub struct Evaluated {
    /// Expected value.
    pub value: Vec<f64>,
    /// ∂V/∂B.
    pub factor: Vec<f64>,
    /// What of the value is the shadow's.
    pub shadow: Vec<f64>,
    /// Derivatives by u, v, ln r, ln s and c.
    pub shape: [Vec<f64>; SHAPE],
    /// Distance from the centre in radii.
    pub rho: Vec<f64>,
}

impl Evaluated {
    /// Evaluates `model` with `theta` over `window`.
    pub fn fill(&mut self, model: Model, theta: &Vector, window: &Window) {
        let count = window.len();
        for column in self.shape.iter_mut().chain([&mut self.value, &mut self.factor, &mut self.shadow, &mut self.rho]) {
            column.resize(count, 0.0);
        }
        let radius = theta[2].exp();
        let made = if model == Model::Transmission { Profile::with_nepers } else { Profile::new };
        let profile = made(model.shape(theta[4]), theta[3].exp() / radius);
        let [by_u, by_v, by_ln_r, by_ln_s, by_c] = &mut self.shape;
        on_widest_vectors(Shapes {
            model,
            theta,
            window,
            profile: &profile,
            value: &mut self.value,
            factor: &mut self.factor,
            shadow: &mut self.shadow,
            rho: &mut self.rho,
            by_u,
            by_v,
            by_ln_r,
            by_ln_s,
            by_c,
        });
    }
}

/// Makes expected values and their derivatives of the background and of what the profile says.
struct Shapes<'a> {
    model: Model,
    theta: &'a Vector,
    window: &'a Window,
    profile: &'a Profile,
    value: &'a mut [f64],
    factor: &'a mut [f64],
    shadow: &'a mut [f64],
    rho: &'a mut [f64],
    by_u: &'a mut [f64],
    by_v: &'a mut [f64],
    by_ln_r: &'a mut [f64],
    by_ln_s: &'a mut [f64],
    by_c: &'a mut [f64],
}

impl pulp::NullaryFnOnce for Shapes<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { model, theta, window, profile, value, factor, shadow, rho, by_u, by_v, by_ln_r, by_ln_s, by_c } = self;
        let (contrast, radius) = (theta[4], theta[2].exp());
        let count = value.len();
        let (by_u, by_v, by_ln_r, by_ln_s, by_c) =
            (&mut by_u[..count], &mut by_v[..count], &mut by_ln_r[..count], &mut by_ln_s[..count], &mut by_c[..count]);
        let (factor, shadow, others) = (&mut factor[..count], &mut shadow[..count], &window.others[..count]);
        let (rho, dx, dy) = (&mut rho[..count], &window.dx[..count], &window.dy[..count]);
        // The background first, term by term, which the compiler turns into vector instructions.
        value.fill(0.0);
        for (term, coefficient) in window.basis.iter().zip(theta.as_slice()[SHAPE..].iter()) {
            for (value, term) in value.iter_mut().zip(term) {
                *value += coefficient * term;
            }
        }
        for n in 0..count {
            let (du, dv) = (dx[n] - theta[0], dy[n] - theta[1]);
            rho[n] = (du * du + dv * dv).sqrt() / radius;
        }
        // The profile's value waits in `by_c`, its derivatives in `by_ln_r`, `by_ln_s` and `by_u`, the last by nepers.
        for n in 0..count {
            let g = profile.at(rho[n]);
            (by_c[n], by_ln_r[n], by_ln_s[n], by_u[n]) = (g.value, g.by_rho, g.by_ln_beta, g.by_nepers);
        }
        // The value's derivative by the profile waits in `by_v`.
        match model {
            Model::Transmission => {
                let stopped = Stopped::of(contrast);
                for n in 0..count {
                    let light = exp(value[n].clamp(-60.0, 60.0)) * others[n];
                    let g = by_c[n];
                    value[n] = light * stopped.left(g);
                    factor[n] = value[n];
                    shadow[n] = value[n] - light;
                    by_v[n] = -light * stopped.share;
                    by_c[n] = -light * (stopped.passes * g + stopped.share * by_u[n]);
                }
            }
            Model::Additive { sign, .. } => {
                for n in 0..count {
                    shadow[n] = sign * contrast * by_c[n];
                    value[n] += shadow[n] + others[n];
                    factor[n] = 1.0;
                    by_v[n] = sign * contrast;
                    by_c[n] *= sign;
                }
            }
        }
        for n in 0..count {
            let (by_profile, by_rho) = (by_v[n], by_ln_r[n]);
            // ∂ρ/∂u = −du/(radius² ρ); the profile is flat in its middle.
            let slope = by_profile * by_rho / (radius * radius * rho[n].max(1e-9));
            by_u[n] = -slope * (dx[n] - theta[0]);
            by_v[n] = -slope * (dy[n] - theta[1]);
            by_ln_r[n] = by_profile * (-by_rho * rho[n] - by_ln_s[n]);
            by_ln_s[n] *= by_profile;
        }
    }
}

/// Noise and weight of each pixel.
#[derive(Clone, Default)]
pub struct Weighing {
    /// Standard deviation of the expected value's noise.
    pub sigma: Vec<f64>,
    /// In [0, 1]: how far the pixel is trusted.
    pub trust: Vec<f64>,
    scratch: Vec<u64>,
}

/// The median size of a normal number over its standard deviation.
const SIZE_PER_SIGMA: f64 = 0.6745;

/// |residual| in spreads to which a pixel counts fully, from which it counts no more than that, and from which not at all.
const TRUST: [f64; 3] = [2.5, 4.5, 9.0];

impl Weighing {
    /// Noise at the expected values; trust after Hampel (1974), against wires and edges in the window. Under the shadow itself trust does
    /// not fall to nothing: there a large residual means that the model is not yet right.
    pub fn update(&mut self, noise: &Noise, window: &Window, at: &Evaluated, redescending: bool) {
        let count = window.len();
        self.sigma.resize(count, 1.0);
        self.trust.resize(count, 1.0);
        noise.fill_sigmas(&at.value, &mut self.sigma);
        for ((trust, sigma), (value, expected)) in self.trust.iter_mut().zip(&self.sigma).zip(window.value.iter().zip(&at.value))
        {
            *trust = ((value - expected) / sigma).abs();
        }
        // Where more than half are no larger than noise, the median is not asked.
        let is_noise = 2 * self.trust.iter().filter(|size| **size <= SIZE_PER_SIGMA).count() > count;
        let spread = if is_noise { 1.0 } else { self.usual_size(count) / SIZE_PER_SIGMA }.max(1.0);
        let [full, level, none] = TRUST.map(|limit| limit * spread);
        for (trust, rho) in self.trust.iter_mut().zip(&at.rho) {
            let size = *trust;
            *trust = if size <= full {
                1.0
            } else if !redescending || size <= level || *rho < 1.2 {
                full / size
            } else {
                full / size * ((none - size) / (none - level)).max(0.0)
            };
        }
    }

    /// The median of what is in `trust`.
    fn usual_size(&mut self, count: usize) -> f64 {
        // Numbers without a sign are in the order of their bits, which are compared in fewer steps.
        self.scratch.clear();
        self.scratch.extend(self.trust[..count].iter().map(|size| size.to_bits()));
        if count == 0 { 0.0 } else { f64::from_bits(*self.scratch.select_nth_unstable(count / 2).1) }
    }

    /// Weighted square residual plus priors.
    pub fn cost(&self, window: &Window, at: &Evaluated, theta: &Vector, prior: &Prior) -> f64 {
        let mut data = 0.0;
        for n in 0..window.len() {
            data += self.trust[n] * ((window.value[n] - at.value[n]) / self.sigma[n]).powi(2);
        }
        let curved: f64 = theta.as_slice()[SHAPE + CURVED..].iter().map(|term| term * term).sum();
        data + ((theta[3] - BLUR_PRIOR.0.ln()) / BLUR_PRIOR.1).powi(2)
            + (theta[2] - prior.ln_radius).powi(2)
            + prior.contrast * theta[4].powi(2)
            + prior.stiffness * curved
    }
}

/// Scratch space of the normal equations: derivatives over noise, times the root of the trust; last the residual.
#[derive(Clone, Default)]
pub struct Equations {
    columns: Vec<Vec<f64>>,
}

impl Equations {
    /// JᵀWJ and JᵀWr, priors included.
    pub fn normal(
        &mut self,
        window: &Window,
        at: &Evaluated,
        weighing: &Weighing,
        theta: &Vector,
        prior: &Prior,
    ) -> (Matrix, Vector) {
        self.columns.resize(COUNT + 1, Vec::new());
        for column in &mut self.columns {
            column.resize(window.len(), 0.0);
        }
        let (mut normal, mut right) = pulp::Arch::new().dispatch(Products { columns: &mut self.columns, window, at, weighing });
        let blur_weight = BLUR_PRIOR.1.powi(-2);
        normal[(3, 3)] += blur_weight;
        right[3] += blur_weight * (BLUR_PRIOR.0.ln() - theta[3]);
        normal[(2, 2)] += 1.0;
        right[2] += prior.ln_radius - theta[2];
        normal[(4, 4)] += prior.contrast;
        right[4] -= prior.contrast * theta[4];
        for n in SHAPE + CURVED..COUNT {
            normal[(n, n)] += prior.stiffness;
            right[n] -= prior.stiffness * theta[n];
        }
        (normal, right)
    }

    /// The normal equations with the shadow's depth, as a share of itself, in place of its contrast, and the column by that: of metal that
    /// lets nothing pass the contrast is as good as any, and that it is there is sure. Of transmission the depth is in nepers, as what else
    /// lies there is.
    pub fn of_depth(&self, model: Model, normal: &Matrix, at: &Evaluated, weighing: &Weighing) -> (Vec<f64>, Matrix) {
        let by_depth = |n: usize| match model {
            Model::Transmission => at.value[n] * (at.value[n] / (at.value[n] - at.shadow[n])).ln(),
            Model::Additive { .. } => at.shadow[n],
        };
        let by_depth: Vec<f64> =
            (0..at.value.len()).map(|n| weighing.trust[n].sqrt() / weighing.sigma[n] * by_depth(n)).collect();
        let mut normal = *normal;
        for n in 0..COUNT {
            let sum = dot(pulp::Scalar, &by_depth, if n == 4 { &by_depth } else { &self.columns[n] });
            normal[(4, n)] = sum;
            normal[(n, 4)] = sum;
        }
        (by_depth, normal)
    }

    /// How much each pixel's normalised residual z = r/σ moves the parameters `of`: N⁻¹ Jᵀ W, column by column. `by_depth` stands in place
    /// of the contrast's, see [`Self::of_depth`].
    pub fn influence<const N: usize>(
        &self,
        by_depth: Option<&[f64]>,
        inverse: &Matrix,
        weighing: &Weighing,
        of: [usize; N],
    ) -> [Vec<f64>; N] {
        of.map(|parameter| {
            let mut influence = vec![0.0; weighing.trust.len()];
            for (n, own) in self.columns[..COUNT].iter().enumerate() {
                let column = by_depth.filter(|_| n == 4).unwrap_or(own);
                let share = inverse[(parameter, n)];
                for (sum, derivative) in influence.iter_mut().zip(column) {
                    *sum += share * derivative;
                }
            }
            for (sum, trust) in influence.iter_mut().zip(&weighing.trust) {
                *sum *= trust.sqrt();
            }
            influence
        })
    }
}

/// Fills the columns of [`Equations`] and multiplies them with one another.
struct Products<'a> {
    columns: &'a mut [Vec<f64>],
    window: &'a Window,
    at: &'a Evaluated,
    weighing: &'a Weighing,
}

impl pulp::WithSimd for Products<'_> {
    type Output = (Matrix, Vector);

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, simd: S) -> Self::Output {
        let Self { columns, window, at, weighing } = self;
        // The residual's column holds the scale until it is no longer needed.
        let (derivatives, last) = columns.split_at_mut(COUNT);
        let residual = &mut last[0];
        for ((scale, trust), sigma) in residual.iter_mut().zip(&weighing.trust).zip(&weighing.sigma) {
            *scale = trust.sqrt() / sigma;
        }
        let (shape, background) = derivatives.split_at_mut(SHAPE);
        for (column, derivative) in shape.iter_mut().zip(&at.shape) {
            let scaled = residual.iter().zip(derivative).map(|(scale, derivative)| scale * derivative);
            column.iter_mut().zip(scaled).for_each(|(column, value)| *column = value);
        }
        for (column, term) in background.iter_mut().zip(&window.basis) {
            let scaled = residual.iter().zip(&at.factor).zip(term).map(|((scale, factor), term)| scale * factor * term);
            column.iter_mut().zip(scaled).for_each(|(column, value)| *column = value);
        }
        for ((residual, value), expected) in residual.iter_mut().zip(&window.value).zip(&at.value) {
            *residual *= value - expected;
        }
        let (mut normal, mut right) = (Matrix::zeros(), Vector::zeros());
        let column = |n: usize| &columns[n][..window.len()];
        for first_row in (0..COUNT).step_by(ROWS_AT_ONCE) {
            let rows: [usize; ROWS_AT_ONCE] = std::array::from_fn(|n| (first_row + n).min(COUNT));
            for first in (first_row / COLUMNS_AT_ONCE * COLUMNS_AT_ONCE..=COUNT).step_by(COLUMNS_AT_ONCE) {
                let across: [usize; COLUMNS_AT_ONCE] = std::array::from_fn(|n| (first + n).min(COUNT));
                let sums = dots(simd, rows.map(column), across.map(column));
                for (i, sums) in rows.into_iter().zip(sums).filter(|(i, _)| *i < COUNT) {
                    for (j, sum) in across.into_iter().zip(sums) {
                        if j == COUNT {
                            right[i] = sum;
                        } else if j >= i {
                            normal[(i, j)] = sum;
                            normal[(j, i)] = sum;
                        }
                    }
                }
            }
        }
        (normal, right)
    }
}

/// Products that are summed side by side: each sum waits for itself, and what was loaded serves several.
const ROWS_AT_ONCE: usize = 2;
const COLUMNS_AT_ONCE: usize = 4;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::beads::noise::Noise;
    use crate::beads::window::Field;
    use crate::image::Image;

    #[test]
    fn derivatives_are_differences_of_the_expected_values() {
        let (pixels, usable) = (Image::filled(40, 40, 900.0f32), Image::filled(40, 40, true));
        let noise = Noise::measure(&pixels, &usable, true);
        let field = Field::new(&pixels, &usable, &noise, 0.0);
        let mut cases = 0;
        for (model, contrast, level) in [
            (Model::Transmission, 0.4, 900.0f64.ln()),
            (Model::Transmission, 5.1, 900.0f64.ln()),
            (Model::Additive { sign: -1.0, shape: 1 }, 300.0, 900.0),
            (Model::Additive { sign: 1.0, shape: 3 }, 300.0, 900.0),
        ] {
            let window = Window::new(&field, model, (19.6, 20.3), 8.0, &[], usize::MAX);
            let mut theta = Vector::zeros();
            (theta[0], theta[1], theta[2], theta[3], theta[4]) = (0.3, -0.2, 2.3f64.ln(), 0.9f64.ln(), contrast);
            (theta[SHAPE], theta[SHAPE + 1], theta[SHAPE + 4]) = (level, 0.1, -0.05);
            let filled = |theta: &Vector| {
                let mut at = Evaluated::default();
                at.fill(model, theta, &window);
                at
            };
            let at = filled(&theta);
            for parameter in 0..SHAPE {
                let h = 1e-5 * if parameter == 4 { contrast } else { 1.0 };
                let moved = |by: f64| {
                    let mut theta = theta;
                    theta[parameter] += by;
                    filled(&theta)
                };
                let (up, down) = (moved(h), moved(-h));
                let largest = at.shape[parameter].iter().fold(0.0f64, |largest, value| largest.max(value.abs()));
                for n in 0..window.len() {
                    let difference = (up.value[n] - down.value[n]) / (2.0 * h);
                    assert!((at.shape[parameter][n] - difference).abs() < 2e-3 * largest, "{model:?} {parameter} at {n}");
                }
                cases += 1;
            }
            // What the shadow has, taken off, leaves the background.
            let beside = filled(&Vector::from_fn(|n, _| if n == 4 { 0.0 } else { theta[n] }));
            assert!((0..window.len()).all(|n| (at.value[n] - at.shadow[n] - beside.value[n]).abs() < 1e-3));
        }
        assert_eq!(cases, 4 * SHAPE);
    }
}

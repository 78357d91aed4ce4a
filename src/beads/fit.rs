//! The least-squares fit of a sphere's shadow.
//!
//! Transmission: V = exp(B(x, y) − c·G(d/r; s/r)), so that noise keeps its own statistics and thick metal needs no logarithm of few
//! quanta. Other images: V = B(x, y) ± c·G_k. B is a quadratic. Its odd terms alone are correlated with the centre, so the even ones
//! cost the centre nothing.

use nalgebra::{SMatrix, SVector};

use super::noise::Noise;
use super::profile::{self, Profile};
use crate::image::Image;

/// How a pixel's value depends on the path through metal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Model {
    /// Proportional to detected quanta.
    Transmission,
    /// Value goes up (`sign` 1) or down (−1) under metal by a profile of index `shape`.
    Additive {
        /// 1 or −1.
        sign: f64,
        /// Index into [`profile::SHAPES`].
        shape: usize,
    },
}

/// What the fit works on.
pub struct Field<'a> {
    pub pixels: &'a Image<f32>,
    pub usable: &'a Image<bool>,
    pub noise: &'a Noise,
}

/// A fitted shadow.
#[derive(Clone, Copy, Debug)]
pub struct Fit {
    pub model: Model,
    pub u_px: f64,
    pub v_px: f64,
    pub radius_px: f64,
    pub blur_px: f64,
    /// c: nepers for transmission, else the image's unit.
    pub contrast: f64,
    /// c over its standard deviation, radius and blur taken as known.
    pub snr: f64,
    /// Covariance of (u, v), scaled up by the fit's misfit and the noise's correlation.
    pub covariance_px2: [[f64; 2]; 2],
    /// Weighted square residual per degree of freedom.
    pub chi2_per_dof: f64,
    /// Structure left in the residual, as a share of the shadow's depth.
    pub misfit: f64,
    /// Share of the window that could be used.
    pub coverage: f64,
}

const COUNT: usize = 11;
type Vector = SVector<f64, COUNT>;
type Matrix = SMatrix<f64, COUNT, COUNT>;

/// Blur expected of detector and focal spot, px, and the standard deviation of its logarithm.
const BLUR_PRIOR: (f64, f64) = (0.8, 0.5);

/// Pixels that are enough to tell a shadow from what is none.
const SCREENED: usize = 450;

struct Pixel {
    dx: f64,
    dy: f64,
    value: f64,
    /// What neighbouring beads contribute: a factor (transmission) or a term.
    others: f64,
    weight: f64,
    sigma: f64,
}

struct Evaluated {
    model: f64,
    gradient: Vector,
    rho: f64,
}

fn basis(x: f64, y: f64) -> [f64; 6] {
    [1.0, x, y, x * x, x * y, y * y]
}

/// θ = (u, v, ln r, ln s, c, six of the background); positions relative to the window's centre.
struct Shape<'a> {
    model: Model,
    theta: &'a Vector,
    radius: f64,
    profile: Profile,
    half_width: f64,
}

impl<'a> Shape<'a> {
    fn new(model: Model, theta: &'a Vector, half_width: f64) -> Self {
        let (radius, blur_px) = (theta[2].exp(), theta[3].exp());
        let shape = if let Model::Additive { shape, .. } = model { shape } else { 0 };
        Self { model, theta, radius, profile: Profile::new(shape, blur_px / radius), half_width }
    }

    fn parts(&self, pixel: &Pixel) -> (f64, profile::Value, f64, f64, f64) {
        let (du, dv) = (pixel.dx - self.theta[0], pixel.dy - self.theta[1]);
        let distance = (du * du + dv * dv).sqrt();
        let rho = distance / self.radius;
        let g = self.profile.at(rho);
        let terms = basis(pixel.dx / self.half_width, pixel.dy / self.half_width);
        let background: f64 = terms.iter().zip(self.theta.as_slice()[5..].iter()).map(|(term, b)| term * b).sum();
        let (sign, value, factor) = match self.model {
            Model::Transmission => {
                let value = (background - self.theta[4] * g.value).clamp(-60.0, 60.0).exp() * pixel.others;
                (-1.0, value, value)
            }
            Model::Additive { sign, .. } => (sign, background + sign * self.theta[4] * g.value + pixel.others, 1.0),
        };
        (rho, g, sign, value, factor)
    }

    fn value(&self, pixel: &Pixel) -> f64 {
        self.parts(pixel).3
    }
}

fn evaluate(shape: &Shape, pixel: &Pixel) -> Evaluated {
    let (rho, g, sign, value, factor) = shape.parts(pixel);
    let (theta, radius) = (shape.theta, shape.radius);
    let (du, dv) = (pixel.dx - theta[0], pixel.dy - theta[1]);
    let distance = rho * radius;
    let terms = basis(pixel.dx / shape.half_width, pixel.dy / shape.half_width);
    let mut gradient = Vector::zeros();
    if distance > 1e-9 {
        let slope = factor * sign * theta[4] * g.by_rho / (radius * distance);
        gradient[0] = -slope * du;
        gradient[1] = -slope * dv;
    }
    gradient[2] = factor * sign * theta[4] * (-g.by_rho * rho - g.by_ln_beta);
    gradient[3] = factor * sign * theta[4] * g.by_ln_beta;
    gradient[4] = factor * sign * g.value;
    for (n, term) in terms.iter().enumerate() {
        gradient[5 + n] = factor * term;
    }
    Evaluated { model: value, gradient, rho }
}

/// Fits `model` from a finished fit of another model.
pub fn refit(field: &Field, model: Model, from: &Fit, others: &[Fit]) -> Option<Fit> {
    fit_window(field, model, from.u_px, from.v_px, from.radius_px, Some(from), others, 8, usize::MAX)
}

/// Fits a shadow near (`u_px`, `v_px`) of about `radius_px`; `others` are shadows already fitted, taken into account where they reach.
/// `None` when there are too few usable pixels or the fit runs away.
pub fn fit(field: &Field, model: Model, u_px: f64, v_px: f64, radius_px: f64, others: &[Fit]) -> Option<Fit> {
    let first = fit_window(field, model, u_px, v_px, radius_px, None, others, 7, SCREENED)?;
    // What is no shadow by now will not become one.
    if !(first.contrast > 0.0 && first.snr > 2.5 && first.misfit < 2.0) {
        return None;
    }
    if first.misfit > 0.6 {
        return Some(first);
    }
    let again = fit_window(field, model, first.u_px, first.v_px, first.radius_px, Some(&first), others, 14, usize::MAX)?;
    let moved = (again.u_px - u_px).hypot(again.v_px - v_px);
    (moved <= 1.0 + 0.8 * radius_px.max(again.radius_px)).then_some(again)
}

#[expect(clippy::too_many_arguments, reason = "one private step of `fit`")]
fn fit_window(
    field: &Field,
    model: Model,
    u_px: f64,
    v_px: f64,
    radius_px: f64,
    start: Option<&Fit>,
    others: &[Fit],
    iterations: usize,
    most_pixels: usize,
) -> Option<Fit> {
    let blur_start = start.map_or(BLUR_PRIOR.0, |fit| fit.blur_px);
    let half_width = 1.9 * radius_px + 2.0 * blur_start + 2.0;
    let (mut pixels, total) = window(field, model, u_px, v_px, half_width, others, most_pixels);
    if pixels.len() < 3 * COUNT || !(pixels.len() as f64 > 0.6 * total) {
        return None;
    }
    let mut theta = initial(model, &pixels, radius_px, start, half_width);
    let prior_radius = radius_px.ln();
    let mut damping = 1e-3;
    reweigh(field, model, &theta, &mut pixels, half_width);
    let cost_of = |theta: &Vector, pixels: &[Pixel]| {
        let shape = Shape::new(model, theta, half_width);
        let data: f64 = pixels.iter().map(|p| p.weight * ((p.value - shape.value(p)) / p.sigma).powi(2)).sum();
        data + ((theta[3] - BLUR_PRIOR.0.ln()) / BLUR_PRIOR.1).powi(2) + (theta[2] - prior_radius).powi(2)
    };
    let mut cost = cost_of(&theta, &pixels);
    for iteration in 0..iterations {
        let (normal, right) = normal_equations(model, &theta, &pixels, half_width, prior_radius);
        let mut accepted = false;
        for _ in 0..6 {
            let mut damped = normal;
            for n in 0..COUNT {
                damped[(n, n)] += damping * normal[(n, n)].max(1e-12);
            }
            let Some(step) = damped.cholesky().map(|c| c.solve(&right)) else {
                damping *= 10.0;
                continue;
            };
            let mut next = theta + step;
            let limit = 0.5 * theta[2].exp() + 0.5;
            for n in 0..2 {
                next[n] = next[n].clamp(theta[n] - limit, theta[n] + limit);
            }
            next[2] = next[2].clamp(theta[2] - 0.5, theta[2] + 0.5).clamp(0.4f64.ln(), (40.0f64).ln());
            next[3] = next[3].clamp(0.3f64.ln(), (1.2 + 0.5 * next[2].exp()).ln());
            let next_cost = cost_of(&next, &pixels);
            if next_cost <= cost {
                let gain = cost - next_cost;
                theta = next;
                cost = next_cost;
                damping = (damping * 0.2).max(1e-9);
                accepted = gain > 1e-7 * cost;
                break;
            }
            damping *= 8.0;
        }
        if iteration < 6 {
            reweigh(field, model, &theta, &mut pixels, half_width);
            cost = cost_of(&theta, &pixels);
        } else if !accepted {
            break;
        }
    }
    judge(model, &theta, &pixels, u_px, v_px, half_width, prior_radius, total)
}

/// Pixels of the round window, thinned out to about `most_pixels`, and how many there would be if all were usable.
fn window(
    field: &Field,
    model: Model,
    u_px: f64,
    v_px: f64,
    half_width: f64,
    others: &[Fit],
    most_pixels: usize,
) -> (Vec<Pixel>, f64) {
    let every = (std::f64::consts::PI * half_width * half_width / most_pixels as f64).round().max(1.0) as i64;
    let (w, h) = (field.pixels.width as i64, field.pixels.height as i64);
    let reach = half_width.ceil() as i64;
    let (column0, row0) = (u_px.round() as i64, v_px.round() as i64);
    let profile_of = |other: &Fit| {
        let shape = if let Model::Additive { shape, .. } = other.model { shape } else { 0 };
        Profile::new(shape, other.blur_px / other.radius_px)
    };
    let near: Vec<(&Fit, Profile)> = others
        .iter()
        .filter(|other| (other.u_px - u_px).hypot(other.v_px - v_px) < half_width + 1.3 * other.radius_px + 3.0 * other.blur_px)
        .map(|other| (other, profile_of(other)))
        .collect();
    let (mut pixels, mut total) = (Vec::new(), 0.0);
    for row in row0 - reach..=row0 + reach {
        for column in column0 - reach..=column0 + reach {
            let (dx, dy) = (column as f64 - u_px, row as f64 - v_px);
            if dx * dx + dy * dy > half_width * half_width || (column + 3 * row).rem_euclid(every) != 0 {
                continue;
            }
            total += 1.0;
            if column < 0 || row < 0 || column >= w || row >= h {
                continue;
            }
            let index = (row * w + column) as usize;
            if !field.usable.pixels[index] {
                continue;
            }
            let shadow = |(other, profile): &(&Fit, Profile)| {
                let rho = (column as f64 - other.u_px).hypot(row as f64 - other.v_px) / other.radius_px;
                other.contrast * profile.at(rho).value
            };
            let sum: f64 = near.iter().map(shadow).sum();
            let others = match model {
                Model::Transmission => (-sum).exp(),
                Model::Additive { sign, .. } => sign * sum,
            };
            pixels.push(Pixel { dx, dy, value: f64::from(field.pixels.pixels[index]), others, weight: 1.0, sigma: 1.0 });
        }
    }
    (pixels, total)
}

fn initial(model: Model, pixels: &[Pixel], radius_px: f64, start: Option<&Fit>, half_width: f64) -> Vector {
    let mean = |near: bool| {
        let (mut sum, mut count) = (0.0, 0.0);
        for p in pixels {
            let distance = p.dx.hypot(p.dy);
            if (near && distance <= (0.4 * radius_px).max(0.8)) || (!near && distance >= 0.5 * (half_width + 1.2 * radius_px)) {
                let value = match model {
                    Model::Transmission => p.value / p.others.max(1e-6),
                    Model::Additive { .. } => p.value - p.others,
                };
                sum += value;
                count += 1.0;
            }
        }
        sum / f64::max(count, 1.0)
    };
    let (outside, centre) = (mean(false), mean(true));
    let mut theta = Vector::zeros();
    theta[2] = radius_px.ln();
    theta[3] = start.map_or(BLUR_PRIOR.0, |fit| fit.blur_px).ln();
    match model {
        Model::Transmission => {
            let least = 1e-3 * outside.abs().max(1e-9);
            theta[5] = outside.max(least).ln();
            theta[4] = theta[5] - centre.max(least).ln();
        }
        Model::Additive { sign, .. } => {
            theta[5] = outside;
            theta[4] = sign * (centre - outside);
        }
    }
    theta
}

/// Noise of the model's value, and Huber weights against wires and edges in the window.
fn reweigh(field: &Field, model: Model, theta: &Vector, pixels: &mut [Pixel], half_width: f64) {
    let shape = Shape::new(model, theta, half_width);
    for pixel in pixels.iter_mut() {
        let value = shape.value(pixel);
        pixel.sigma = field.noise.sigma(value);
        pixel.weight = ((pixel.value - value) / pixel.sigma).abs();
    }
    let mut sizes: Vec<f64> = pixels.iter().map(|p| p.weight).collect();
    let middle = sizes.len() / 2;
    let spread = (*sizes.select_nth_unstable_by(middle, f64::total_cmp).1 / 0.6745).max(1.0);
    for pixel in pixels.iter_mut() {
        pixel.weight = (2.5 * spread / pixel.weight.max(1e-12)).min(1.0);
    }
}

fn normal_equations(model: Model, theta: &Vector, pixels: &[Pixel], half_width: f64, prior_radius: f64) -> (Matrix, Vector) {
    let (mut normal, mut right) = (Matrix::zeros(), Vector::zeros());
    let shape = Shape::new(model, theta, half_width);
    for pixel in pixels {
        let at = evaluate(&shape, pixel);
        let weight = pixel.weight / (pixel.sigma * pixel.sigma);
        let residual = weight * (pixel.value - at.model);
        for i in 0..COUNT {
            let gi = weight * at.gradient[i];
            right[i] += at.gradient[i] * residual;
            for j in i..COUNT {
                normal[(i, j)] += gi * at.gradient[j];
            }
        }
    }
    for i in 0..COUNT {
        for j in 0..i {
            normal[(i, j)] = normal[(j, i)];
        }
    }
    let blur_weight = BLUR_PRIOR.1.powi(-2);
    normal[(3, 3)] += blur_weight;
    right[3] += blur_weight * (BLUR_PRIOR.0.ln() - theta[3]);
    normal[(2, 2)] += 1.0;
    right[2] += prior_radius - theta[2];
    (normal, right)
}

#[expect(clippy::too_many_arguments, reason = "one private step of `fit`")]
fn judge(
    model: Model,
    theta: &Vector,
    pixels: &[Pixel],
    u_px: f64,
    v_px: f64,
    half_width: f64,
    prior_radius: f64,
    total: f64,
) -> Option<Fit> {
    let (normal, _) = normal_equations(model, theta, pixels, half_width, prior_radius);
    let inverse = normal.cholesky()?.inverse();
    let dof = (pixels.len() - COUNT) as f64;
    // Polar bins: what noise leaves averages out in them, what the model misses does not.
    const RINGS: usize = 4;
    const SECTORS: usize = 8;
    let mut bins = [(0.0f64, 0.0f64, 0.0f64); RINGS * SECTORS];
    let mut chi2 = 0.0;
    let reach = half_width.ceil() as i64 + 1;
    let side = (2 * reach + 1) as usize;
    let mut grid = vec![f64::NAN; side * side];
    let base = match model {
        Model::Transmission => theta[5].exp() * (1.0 - (-theta[4]).exp()),
        Model::Additive { .. } => theta[4],
    };
    let shape = Shape::new(model, theta, half_width);
    for pixel in pixels {
        let at = evaluate(&shape, pixel);
        let z = (pixel.value - at.model) / pixel.sigma;
        chi2 += pixel.weight * z * z;
        let ring = match at.rho {
            rho if rho < 0.6 => 0,
            rho if rho < 1.0 => 1,
            rho if rho < 1.4 => 2,
            _ => 3,
        };
        let angle = (pixel.dy - theta[1]).atan2(pixel.dx - theta[0]) / std::f64::consts::TAU + 0.5;
        let sector = ((angle * SECTORS as f64) as usize).min(SECTORS - 1);
        let share = (pixel.value - at.model) / base;
        let bin = &mut bins[ring * SECTORS + sector];
        bin.0 += 1.0;
        bin.1 += share;
        bin.2 += share * share;
        let place = (pixel.dy.round() as i64 + reach) * side as i64 + pixel.dx.round() as i64 + reach;
        if let Some(cell) = grid.get_mut(place.max(0) as usize) {
            *cell = z * pixel.weight;
        }
    }
    let chi2_per_dof = chi2 / dof.max(1.0);
    let inflation = correlation_inflation(&grid, side);
    let (mut structure, mut counted) = (0.0, 0.0);
    for (n, (count, sum, squares)) in bins.iter().enumerate() {
        if *count < 2.0 || n >= 3 * SECTORS {
            continue;
        }
        let mean = sum / count;
        let variance = ((squares - count * mean * mean) / (count - 1.0)).max(0.0);
        structure += count * (mean * mean - (inflation * variance / count));
        counted += count;
    }
    let scale = chi2_per_dof.max(1.0) * inflation;
    let fit = Fit {
        model,
        u_px: u_px + theta[0],
        v_px: v_px + theta[1],
        radius_px: theta[2].exp(),
        blur_px: theta[3].exp(),
        contrast: theta[4],
        snr: 0.0,
        covariance_px2: std::array::from_fn(|i| std::array::from_fn(|j| inverse[(i, j)] * scale)),
        chi2_per_dof,
        misfit: (structure / f64::max(counted, 1.0)).max(0.0).sqrt(),
        coverage: pixels.len() as f64 / total.max(1.0),
    };
    let mut fit = fit;
    fit.snr = theta[4] / (conditional_variance(&normal)? * scale).sqrt();
    let finite = [fit.u_px, fit.v_px, fit.radius_px, fit.contrast, fit.snr, fit.covariance_px2[0][0], fit.misfit];
    finite.iter().all(|x| x.is_finite()).then_some(fit)
}

/// Variance of c with radius and blur taken as known: the three trade off against each other in small shadows, whose presence is sure.
fn conditional_variance(normal: &Matrix) -> Option<f64> {
    let mut held = *normal;
    for fixed in [2, 3] {
        for n in 0..COUNT {
            held[(fixed, n)] = 0.0;
            held[(n, fixed)] = 0.0;
        }
        held[(fixed, fixed)] = 1.0;
    }
    Some(held.cholesky()?.inverse()[(4, 4)])
}

/// Variance of a smooth estimate relative to white noise: (1 + 2ρ)² with the residual's correlation ρ between direct neighbours.
fn correlation_inflation(grid: &[f64], side: usize) -> f64 {
    let (mut across, mut down, mut own, mut pairs, mut count) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (n, value) in grid.iter().enumerate() {
        if value.is_nan() {
            continue;
        }
        own += value * value;
        count += 1.0;
        if let (Some(right), Some(below)) = (grid.get(n + 1), grid.get(n + side))
            && !right.is_nan()
            && !below.is_nan()
        {
            across += value * right;
            down += value * below;
            pairs += 1.0;
        }
    }
    if pairs < 20.0 || own <= 0.0 {
        return 1.0;
    }
    let mean_square = own / count;
    let factor = |sum: f64| 1.0 + 2.0 * (sum / (pairs * mean_square)).clamp(0.0, 0.9);
    factor(across) * factor(down)
}

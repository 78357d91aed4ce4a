//! The least-squares fit of a sphere's shadow: from a guess to a centre with its covariance.
//!
//! The model is in `shadow`, the pixels in `window`, the judgement of what was fitted in `fitted`.

use super::fitted;
use super::model::{Fit, Model};
use super::shadow::{BLUR_PRIOR, COUNT, Equations, Evaluated, Prior, SHAPE, Vector, Weighing};
use super::window::{Field, Window};
use crate::estimate::SmallSteps;

/// Pixels that are enough to tell a shadow from what is none.
const SCREENED: usize = 450;

/// How thoroughly a window is fitted.
#[derive(Clone, Copy)]
struct Effort {
    iterations: usize,
    /// Iterations in which the background is stiff.
    stiff: usize,
    most_pixels: usize,
    /// Gain in χ² below which the fit has arrived.
    arrived: f64,
}

/// Enough to tell a shadow from what is none.
const SCREENING: Effort = Effort { iterations: 8, stiff: 5, most_pixels: SCREENED, arrived: 0.05 };
/// A thousandth of χ² is a thirtieth of a standard deviation.
const FULL: Effort = Effort { iterations: 16, stiff: 4, most_pixels: usize::MAX, arrived: 1e-3 };

/// Where a fit begins.
#[derive(Clone, Copy)]
struct Start {
    u_px: f64,
    v_px: f64,
    radius_px: f64,
    blur_px: f64,
}

impl Start {
    fn of(fit: &Fit) -> Self {
        Self { u_px: fit.u_px, v_px: fit.v_px, radius_px: fit.radius_px, blur_px: fit.blur_px }
    }
}

/// Fits `model` from a finished fit of another model.
pub fn refit(field: &Field, model: Model, from: &Fit, others: &[Fit]) -> Option<Fit> {
    fit_window(field, model, Start::of(from), others, FULL)
}

/// Where a shadow may be, and about how large.
#[derive(Clone, Copy)]
pub struct Guess {
    pub u_px: f64,
    pub v_px: f64,
    pub radius_px: f64,
}

/// Fits a shadow near `guess`; `others` are shadows already fitted, taken into account where they reach. `None` when there are too few usable
/// pixels or the fit runs away.
pub fn fit(field: &Field, model: Model, guess: &Guess, others: &[Fit]) -> Option<Fit> {
    finish(field, &screen(field, model, guess, others)?, guess, others)
}

/// The first part of [`fit`], on few pixels: `None` for what is no shadow.
pub fn screen(field: &Field, model: Model, guess: &Guess, others: &[Fit]) -> Option<Fit> {
    let Guess { u_px, v_px, radius_px } = *guess;
    let first = fit_window(field, model, Start { u_px, v_px, radius_px, blur_px: BLUR_PRIOR.0 }, others, SCREENING)?;
    // What is no shadow by now will not become one.
    (first.contrast > 0.0 && first.snr > 2.5 && first.misfit < 2.0).then_some(first)
}

/// The second part of [`fit`], on all pixels.
pub fn finish(field: &Field, first: &Fit, guess: &Guess, others: &[Fit]) -> Option<Fit> {
    if first.misfit > 0.6 {
        return Some(*first);
    }
    let again = fit_window(field, first.model, Start::of(first), others, FULL)?;
    let moved = (again.u_px - guess.u_px).hypot(again.v_px - guess.v_px);
    (moved <= 1.0 + 0.8 * guess.radius_px.max(again.radius_px)).then_some(again)
}

/// Levenberg–Marquardt with weights that follow the residual.
fn fit_window(field: &Field, model: Model, start: Start, others: &[Fit], effort: Effort) -> Option<Fit> {
    let half_width = 1.9 * start.radius_px + 2.0 * start.blur_px + 2.0;
    let window = Window::new(field, model, (start.u_px, start.v_px), half_width, others, effort.most_pixels);
    if window.len() < 3 * COUNT || !(window.len() as f64 > 0.6 * window.total) {
        return None;
    }
    let mut theta = initial(model, &window, start);
    // Curvature of a tenth of the shadow's depth at the window's border costs as much as one pixel in a hundred off by its noise.
    let stiff = 0.01 * window.len() as f64 * (0.1 * theta[4]).powi(-2);
    let mut prior = Prior { ln_radius: start.radius_px.ln(), stiffness: 0.0, contrast: model.contrast_weight() };
    let (mut at, mut trial) = (Evaluated::default(), Evaluated::default());
    let (mut weighing, mut equations) = (Weighing::default(), Equations::default());
    let mut steps = SmallSteps { damping: 1e-3, lower: 0.1, raise: 8.0, most: f64::INFINITY, attempts: 6 };
    at.fill(model, &theta, &window);
    for iteration in 0..effort.iterations {
        let is_early = iteration < effort.stiff;
        prior.stiffness = if is_early && stiff.is_finite() { stiff } else { 0.0 };
        weighing.update(field.noise, &window, &at, iteration >= effort.stiff);
        let cost = weighing.cost(&window, &at, &theta, &prior);
        let (normal, right) = equations.normal(&window, &at, &weighing, &theta, &prior);
        let mut gain = 0.0;
        let taken = steps.take(&normal, &right, |step| {
            let next = limited(model, &theta, step);
            trial.fill(model, &next, &window);
            gain = cost - weighing.cost(&window, &trial, &next, &prior);
            gain >= 0.0
        });
        match taken {
            Some(step) => {
                theta = limited(model, &theta, &step);
                std::mem::swap(&mut at, &mut trial);
            }
            None => gain = 0.0,
        }
        if iteration > effort.stiff && gain < effort.arrived {
            break;
        }
    }
    weighing.update(field.noise, &window, &at, true);
    let (normal, _) = equations.normal(&window, &at, &weighing, &theta, &prior);
    fitted::judge(&fitted::Finished {
        model,
        theta: &theta,
        window: &window,
        at: &at,
        weighing: &weighing,
        equations: &equations,
        normal: &normal,
        field,
    })
}

/// `theta` after `step`, no farther than a fit may go at once.
fn limited(model: Model, theta: &Vector, step: &Vector) -> Vector {
    let mut next = theta + step;
    let limit = 0.5 * theta[2].exp() + 0.5;
    for n in 0..2 {
        next[n] = next[n].clamp(theta[n] - limit, theta[n] + limit);
    }
    next[2] = next[2].clamp(theta[2] - 0.5, theta[2] + 0.5).clamp(0.4f64.ln(), (40.0f64).ln());
    next[3] = next[3].clamp(0.3f64.ln(), (1.2 + 0.5 * next[2].exp()).ln());
    next[4] = model.bounded(next[4]);
    next
}

fn initial(model: Model, window: &Window, start: Start) -> Vector {
    let radius_px = start.radius_px;
    let (core_px, rim_px) = ((0.4 * radius_px).max(0.8), 0.5 * (window.half_width + 1.2 * radius_px));
    let ([mut outside, mut centre], [mut count_outside, mut count_centre]) = ([0.0; 2], [0.0; 2]);
    for n in 0..window.len() {
        let distance = window.dx[n].hypot(window.dy[n]);
        let value = match model {
            Model::Transmission => window.value[n] / window.others[n].max(1e-6),
            Model::Additive { .. } => window.value[n] - window.others[n],
        };
        if distance >= rim_px {
            outside += value;
            count_outside += 1.0;
        }
        if distance <= core_px {
            centre += value;
            count_centre += 1.0;
        }
    }
    outside /= f64::max(count_outside, 1.0);
    centre /= f64::max(count_centre, 1.0);
    let mut theta = Vector::zeros();
    theta[2] = radius_px.ln();
    theta[3] = start.blur_px.ln();
    match model {
        Model::Transmission => {
            let least = 1e-3 * outside.abs().max(1e-9);
            theta[SHAPE] = outside.max(least).ln();
            theta[4] = model.bounded(theta[SHAPE] - centre.max(least).ln());
        }
        Model::Additive { sign, .. } => {
            theta[SHAPE] = outside;
            theta[4] = sign * (centre - outside);
        }
    }
    theta
}

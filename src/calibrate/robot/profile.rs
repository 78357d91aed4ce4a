//! By how much a profile of the frame is shifted against the one that the model casts.
//!
//! y(x) = b₀ + b₁ x + b₂ x² + a T(x − δ): for each shift δ of a grid the other numbers follow linearly; the best δ is refined by
//! Gauss–Newton steps, with the weights of samples that fit badly (a bead, a wire, a bone's rim) taken back.

use nalgebra::{SMatrix, SVector};

use crate::estimate::median;

/// Step of the grid of shifts, px.
const STEP_PX: f64 = 0.5;
/// Gauss–Newton steps.
const STEPS: usize = 6;
/// Samples a fit needs beyond its unknowns.
const LEAST_SAMPLES: usize = 12;
/// Interpolation between pixels makes neighbouring samples alike: what their scatter says too little.
const ALIKE: f64 = 1.5;
/// Residuals from which on a sample loses weight, in robust standard deviations.
const DOUBTFUL: f64 = 3.0;

/// A curve sampled at equal steps.
pub(super) struct Sampled {
    pub first: f64,
    pub step: f64,
    pub values: Vec<f64>,
}

impl Sampled {
    fn at(&self, x: f64) -> f64 {
        let place = ((x - self.first) / self.step).clamp(0.0, (self.values.len() - 1) as f64);
        let index = (place as usize).min(self.values.len() - 2);
        let share = place - index as f64;
        self.values[index] * (1.0 - share) + self.values[index + 1] * share
    }
}

/// A fitted shift.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shift {
    pub px: f64,
    pub sigma_px: f64,
    /// Of the frame's profile in units of the template's, with its standard deviation.
    pub contrast: f64,
    pub contrast_sigma: f64,
    /// Share of the squares about a smooth background that the template explains.
    pub explained: f64,
}

/// Most unknowns: a background of degree 2, contrast and shift.
const MOST: usize = 5;

/// Fits `samples` (place, value) by a shift of `template` of at most `reach_px` on a background of `degree`; `None` where no shift inside
/// the reach is best, or nothing is left to fit.
pub(super) fn fit(samples: &[(f64, f64)], template: &Sampled, reach_px: f64, degree: usize) -> Option<Shift> {
    let unknowns = degree + 2;
    if samples.len() < unknowns + 1 + LEAST_SAMPLES || template.values.len() < 2 {
        return None;
    }
    let scale = samples.iter().fold(1.0f64, |most, (x, _)| most.max(x.abs()));
    let background = |x: f64| {
        let mut row = [0.0; MOST];
        (0..=degree).for_each(|power| row[power] = (x / scale).powi(power as i32));
        row
    };
    let shifted = |x: f64, shift: f64| {
        let mut row = background(x);
        row[degree + 1] = template.at(x - shift);
        row
    };
    let mut weights = vec![1.0; samples.len()];
    let steps = (reach_px / STEP_PX).floor() as i64;
    let shifts = (-steps..=steps).map(|n| n as f64 * STEP_PX);
    let tried = shifts.filter_map(|shift| Some((shift, solve(samples, &weights, unknowns, &|x| shifted(x, shift))?)));
    let best = tried.filter(|(_, found)| found.numbers[degree + 1] > 0.0).min_by(|a, b| a.1.cost.total_cmp(&b.1.cost))?;
    let mut shift = best.0;
    let mut last = None;
    for _ in 0..STEPS {
        let contrast = solve(samples, &weights, unknowns, &|x| shifted(x, shift))?.numbers[degree + 1];
        // With the shift free as well: its column is −a T′.
        let freed = |x: f64| {
            let mut row = shifted(x, shift);
            let slope = template.at(x - shift + 0.5 * STEP_PX) - template.at(x - shift - 0.5 * STEP_PX);
            row[unknowns] = -contrast * slope / STEP_PX;
            row
        };
        let free = solve(samples, &weights, unknowns + 1, &freed)?;
        shift += free.numbers[unknowns].clamp(-STEP_PX, STEP_PX);
        let spread = robust_spread(&free.residuals);
        for (weight, residual) in weights.iter_mut().zip(&free.residuals) {
            *weight = (1.0 + (residual / (DOUBTFUL * spread)).powi(2)).powi(-2);
        }
        last = Some(free);
    }
    let last = last?;
    if !(shift.abs() < reach_px - STEP_PX) {
        return None;
    }
    let smooth = solve(samples, &weights, degree + 1, &background)?;
    let effective = weights.iter().sum::<f64>() - (unknowns + 1) as f64;
    let variance = ALIKE * ALIKE * last.cost / effective.max(1.0);
    let sigma = |n: usize| (variance * last.inverse[(n, n)]).sqrt();
    let shift = Shift {
        px: shift,
        sigma_px: sigma(unknowns),
        contrast: last.numbers[degree + 1],
        contrast_sigma: sigma(degree + 1),
        explained: 1.0 - last.cost / smooth.cost,
    };
    (shift.sigma_px.is_finite() && shift.explained.is_finite()).then_some(shift)
}

struct Solved {
    numbers: [f64; MOST],
    residuals: Vec<f64>,
    /// Σ w r².
    cost: f64,
    inverse: SMatrix<f64, MOST, MOST>,
}

/// Weighted least squares in the first `unknowns` columns of the rows.
fn solve(samples: &[(f64, f64)], weights: &[f64], unknowns: usize, row: &dyn Fn(f64) -> [f64; MOST]) -> Option<Solved> {
    let mut normal = SMatrix::<f64, MOST, MOST>::zeros();
    let mut right = SVector::<f64, MOST>::zeros();
    (unknowns..MOST).for_each(|unused| normal[(unused, unused)] = 1.0);
    let rows: Vec<[f64; MOST]> = samples.iter().map(|(x, _)| row(*x)).collect();
    for ((row, (_, y)), weight) in rows.iter().zip(samples).zip(weights) {
        for (i, a) in row.iter().enumerate().take(unknowns) {
            right[i] += weight * a * y;
            for (j, b) in row.iter().enumerate().take(i + 1) {
                normal[(i, j)] += weight * a * b;
            }
        }
    }
    normal.fill_upper_triangle_with_lower_triangle();
    let factored = normal.cholesky()?;
    let numbers: [f64; MOST] = factored.solve(&right).into();
    let fitted = |row: &[f64; MOST]| (0..unknowns).map(|n| row[n] * numbers[n]).sum::<f64>();
    let residuals: Vec<f64> = rows.iter().zip(samples).map(|(row, (_, y))| y - fitted(row)).collect();
    let cost = residuals.iter().zip(weights).map(|(residual, weight)| weight * residual * residual).sum();
    Some(Solved { numbers, residuals, cost, inverse: factored.inverse() })
}

/// Median absolute residual as a standard deviation.
fn robust_spread(residuals: &[f64]) -> f64 {
    let middle = median(residuals.iter().map(|residual| residual.abs())).unwrap_or(0.0);
    (middle / 0.6745).max(1e-12)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn template() -> Sampled {
        let value = |n: usize| {
            let x: f64 = n as f64 * 0.25 - 40.0;
            (1.0 - (x / 6.0).powi(2)).max(0.0).sqrt()
        };
        Sampled { first: -40.0, step: 0.25, values: (0..321).map(value).collect() }
    }

    /// A shift of 2.3 px on a sloping background, with a bead beside the rod.
    fn samples(contrast: f64) -> Vec<(f64, f64)> {
        let value = |n: i32| {
            let x = f64::from(n);
            let bead = if (12..15).contains(&n) { 1.5 } else { 0.0 };
            let grain = 0.01 * f64::from((n * 7919).rem_euclid(13) - 6) / 6.0;
            (x, 3.0 + 0.02 * x + contrast * template().at(x - 2.3) + bead + grain)
        };
        (-24..=24).map(value).collect()
    }

    #[test]
    fn a_shift_is_found_beside_a_bead() {
        let found = fit(&samples(1.7), &template(), 6.0, 2).expect("there is a rod");
        assert!((found.px - 2.3).abs() < 0.03 && found.sigma_px < 0.05, "{found:?}");
        assert!((found.contrast - 1.7).abs() < 0.05 && found.explained > 0.9, "{found:?}");
        // The control: nothing there, or out of reach.
        let none = fit(&samples(0.0), &template(), 6.0, 2);
        assert!(none.is_none_or(|found| found.explained < 0.6 || found.contrast < 5.0 * found.contrast_sigma), "{none:?}");
        assert!(fit(&samples(1.7), &template(), 2.0, 2).is_none());
    }
}

//! Quantiles and small least squares.

use crate::estimate::median;

/// The value below which `share` of the values lie; reorders them.
pub(super) fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let index = ((values.len() - 1) as f64 * share).round() as usize;
    Some(*values.select_nth_unstable_by(index, f64::total_cmp).1)
}

/// Least squares with weights that fall with the residual, of `unknowns` numbers.
pub(super) fn robust_fit(points: &[([f64; 3], f64, f64)], unknowns: usize) -> Option<[f64; 3]> {
    if points.len() < unknowns + 1 {
        return None;
    }
    let mut fit = [median(points.iter().map(|point| point.1))?, 0.0, 0.0];
    for round in 0..8 {
        let width = if round < 3 { 4.0 } else { 1.5 };
        let mut normal = [[0.0; 4]; 3];
        for (basis, value, weight) in points {
            let residual = value - (0..3).map(|i| basis[i] * fit[i]).sum::<f64>();
            let weight = weight / (1.0 + (residual / width).powi(2));
            for i in 0..unknowns {
                for j in 0..unknowns {
                    normal[i][j] += weight * basis[i] * basis[j];
                }
                normal[i][3] += weight * basis[i] * value;
            }
        }
        fit = solved(normal, unknowns)?;
    }
    fit.iter().all(|x| x.is_finite()).then_some(fit)
}

/// Gauss–Jordan with pivots, of a system of `n` ≤ 3 rows with the right side in column 3.
pub(super) fn solved(mut rows: [[f64; 4]; 3], n: usize) -> Option<[f64; 3]> {
    for i in 0..n {
        let pivot = (i..n).max_by(|&a, &b| rows[a][i].abs().total_cmp(&rows[b][i].abs()))?;
        rows.swap(i, pivot);
        if !(rows[i][i].abs() > 1e-12 * rows[0][0].abs().max(1e-30)) {
            return None;
        }
        for other in 0..n {
            if other != i {
                let factor = rows[other][i] / rows[i][i];
                let row = rows[i];
                for (x, y) in rows[other].iter_mut().zip(row) {
                    *x -= factor * y;
                }
            }
        }
    }
    let mut fit = [0.0; 3];
    for i in 0..n {
        fit[i] = rows[i][3] / rows[i][i];
    }
    Some(fit)
}

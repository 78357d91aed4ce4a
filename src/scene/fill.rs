//! Voxels that are hidden are given what surrounds them: the smoothest values that agree with their neighbours.

use crate::geometry::VoxelGrid;

/// Relative change at which the fill is done, of the largest change that the first guess needed.
const SETTLED: f64 = 1e-4;
/// Conjugate gradients of n unknowns in a region some tens of voxels wide settle long before this.
const MOST_STEPS: usize = 400;

/// Values at `hidden` (ascending, no voxel twice) that are harmonic in mm: each is the mean of its neighbours across faces, weighted
/// by 1/spacing². Neighbours for which `usable` is false, and the grid's ends, let nothing through. `None` where no usable neighbour
/// touches the hidden voxels.
///
/// The result depends on the values alone, not on threads.
#[must_use]
pub fn fill_harmonic(grid: &VoxelGrid, values: &[f32], hidden: &[usize], usable: &dyn Fn(usize) -> bool) -> Option<Vec<f64>> {
    let weight = grid.spacing_mm().map(|mm| 1.0 / (mm * mm));
    // Row n: the unknowns that n touches, with weights; what the known neighbours add; the sum of all weights.
    let mut rows: Vec<Vec<(usize, f64)>> = Vec::with_capacity(hidden.len());
    let (mut known, mut total) = (vec![0.0; hidden.len()], vec![0.0; hidden.len()]);
    let (mut sum, mut count) = (0.0, 0usize);
    for (row, index) in hidden.iter().enumerate() {
        let mut touched = Vec::with_capacity(6);
        for side in 0..6 {
            let Some(next) = grid.neighbour(*index, side / 2, side % 2 == 1) else { continue };
            let weight = weight[side / 2];
            if let Ok(other) = hidden.binary_search(&next) {
                touched.push((other, weight));
            } else if usable(next) {
                let value = f64::from(values[next]);
                known[row] += weight * value;
                (sum, count) = (sum + value, count + 1);
            } else {
                continue;
            }
            total[row] += weight;
        }
        rows.push(touched);
    }
    if count == 0 {
        return None;
    }
    // A voxel that touches nothing at all keeps the mean.
    let mean = sum / count as f64;
    for row in (0..rows.len()).filter(|row| total[*row] == 0.0).collect::<Vec<_>>() {
        (known[row], total[row]) = (mean, 1.0);
    }
    Some(conjugate_gradients(&rows, &total, &known, mean))
}

/// Solves `total·x − Σ weight·x(neighbour) = known` from `x = start`, preconditioned by the diagonal.
fn conjugate_gradients(rows: &[Vec<(usize, f64)>], total: &[f64], known: &[f64], start: f64) -> Vec<f64> {
    let n = rows.len();
    let apply = |x: &[f64], row: usize| total[row] * x[row] - rows[row].iter().map(|(at, weight)| weight * x[*at]).sum::<f64>();
    let mut x = vec![start; n];
    let mut residual: Vec<f64> = (0..n).map(|row| known[row] - apply(&x, row)).collect();
    let mut direction: Vec<f64> = (0..n).map(|row| residual[row] / total[row]).collect();
    let mut energy: f64 = (0..n).map(|row| residual[row] * direction[row]).sum();
    let enough = energy * SETTLED * SETTLED * SETTLED;
    for _ in 0..MOST_STEPS {
        if !(energy > enough && energy > 0.0) {
            break;
        }
        let image: Vec<f64> = (0..n).map(|row| apply(&direction, row)).collect();
        let step = energy / (0..n).map(|row| direction[row] * image[row]).sum::<f64>();
        if !step.is_finite() {
            break;
        }
        for row in 0..n {
            x[row] += step * direction[row];
            residual[row] -= step * image[row];
        }
        let next: f64 = (0..n).map(|row| residual[row] * residual[row] / total[row]).sum();
        let keep = next / energy;
        energy = next;
        for row in 0..n {
            direction[row] = residual[row] / total[row] + keep * direction[row];
        }
    }
    x
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DVec3};

    use super::*;

    /// A field that is harmonic in mm on every grid of this spacing: differences of second order see a quadratic exactly.
    fn grid() -> VoxelGrid {
        VoxelGrid { size: [12, 11, 10], lps_from_voxel: DAffine3::from_scale(DVec3::new(0.5, 0.8, 2.0)) }
    }

    #[test]
    fn a_harmonic_field_comes_back() {
        let grid = grid();
        let field = |index: usize| {
            let p = grid.centre(index);
            (300.0 + 40.0 * p.x - 25.0 * p.y + 7.0 * p.z + 12.0 * (p.x * p.x - p.y * p.y) + 3.0 * p.y * p.z) as f32
        };
        let mut values: Vec<f32> = (0..grid.voxels()).map(field).collect();
        let hidden = grid.within(DVec3::new(2.6, 4.1, 9.0), 2.3);
        assert!(hidden.len() > 40);
        hidden.iter().for_each(|index| values[*index] = 3071.0);
        let filled = fill_harmonic(&grid, &values, &hidden, &|_| true).expect("surrounded");
        let worst = hidden.iter().zip(&filled).map(|(index, value)| (value - f64::from(field(*index))).abs()).fold(0.0, f64::max);
        assert!(worst < 0.2, "{worst} HU");
    }

    #[test]
    fn what_is_not_usable_lets_nothing_through() {
        let grid = grid();
        let mut values = vec![50.0f32; grid.voxels()];
        let hidden = grid.within(DVec3::new(2.6, 4.1, 9.0), 2.0);
        let metal: Vec<usize> = grid.neighbours(hidden[0]).filter(|next| !hidden.contains(next)).collect();
        assert!(!metal.is_empty());
        metal.iter().for_each(|index| values[*index] = 3071.0);
        let filled = fill_harmonic(&grid, &values, &hidden, &|index| !metal.contains(&index)).expect("surrounded");
        assert!(filled.iter().all(|value| (value - 50.0).abs() < 0.01));
        let all = fill_harmonic(&grid, &values, &hidden, &|_| true).expect("surrounded");
        assert!(all.iter().any(|value| *value > 60.0), "control: usable metal bleeds in");
        assert!(fill_harmonic(&grid, &values, &hidden, &|_| false).is_none());
    }
}

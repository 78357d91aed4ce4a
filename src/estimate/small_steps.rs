//! Levenberg–Marquardt steps of small problems in which every pixel or voxel is a residual.
//!
//! Apart from [`Problem`](super::Problem) for speed: N is known to the compiler and nothing is allocated, where a block and a residual of
//! [`Problem`](super::Problem) are as large as they happen to be; 160 shadows of a frame are fitted to hundreds of pixels each.

use nalgebra::{SMatrix, SVector};

/// How far steps are damped, from one to the next.
#[derive(Clone, Copy, Debug)]
pub struct SmallSteps {
    /// Share by which the diagonal of H is enlarged.
    pub damping: f64,
    /// Factor of it after a step that was taken.
    pub lower: f64,
    /// Factor of it after one that was not.
    pub raise: f64,
    /// Damping from which on no step is worth trying.
    pub most: f64,
    /// Steps that are tried at most before one is taken.
    pub attempts: usize,
}

/// Less damping than this is none.
const LEAST: f64 = 1e-9;
/// A number on which nothing depends stays where it is.
const LEAST_CURVATURE: f64 = 1e-12;

impl SmallSteps {
    /// The step δ of (H + damping · diag H) δ = g that `is_taken` takes, which is asked of one after the other, each shorter than the one
    /// before; `None` where it takes none. H is `normal`, g is `right`.
    pub fn take<const N: usize>(
        &mut self,
        normal: &SMatrix<f64, N, N>,
        right: &SVector<f64, N>,
        mut is_taken: impl FnMut(&SVector<f64, N>) -> bool,
    ) -> Option<SVector<f64, N>> {
        for _ in 0..self.attempts {
            let mut damped = *normal;
            for n in 0..N {
                damped[(n, n)] += self.damping * normal[(n, n)].max(LEAST_CURVATURE);
            }
            if let Some(step) = damped.cholesky().map(|factor| factor.solve(right))
                && is_taken(&step)
            {
                self.damping = (self.damping * self.lower).max(LEAST);
                return Some(step);
            }
            self.damping *= self.raise;
            if !(self.damping < self.most) {
                break;
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rosenbrock's valley, 10 (y − x²) and 1 − x, from where a full step leads far up its side.
    #[test]
    fn a_bent_valley_is_followed_to_its_end() {
        let residuals = |at: &SVector<f64, 2>| [10.0 * (at[1] - at[0] * at[0]), 1.0 - at[0]];
        let cost = |at: &SVector<f64, 2>| residuals(at).iter().map(|r| r * r).sum::<f64>();
        let mut at = SVector::<f64, 2>::new(-1.2, 1.0);
        let mut steps = SmallSteps { damping: 1e-3, lower: 0.1, raise: 8.0, most: f64::INFINITY, attempts: 6 };
        let mut refused = 0;
        for _ in 0..60 {
            let rows = [SVector::<f64, 2>::new(-20.0 * at[0], 10.0), SVector::<f64, 2>::new(-1.0, 0.0)];
            let normal = rows[0] * rows[0].transpose() + rows[1] * rows[1].transpose();
            let right = -(rows[0] * residuals(&at)[0] + rows[1] * residuals(&at)[1]);
            let taken = steps.take(&normal, &right, |step| {
                let is_lower = cost(&(at + step)) <= cost(&at);
                refused += i32::from(!is_lower);
                is_lower
            });
            at += taken.unwrap_or_default();
        }
        assert!((at - SVector::<f64, 2>::new(1.0, 1.0)).norm() < 1e-6, "{at}");
        assert!(refused > 0, "the control: not every step is downhill");
    }

    #[test]
    fn a_step_that_nobody_takes_ends() {
        let mut asked = Vec::new();
        let mut steps = SmallSteps { damping: 1.0, lower: 0.1, raise: 10.0, most: 1e3, attempts: 50 };
        let (normal, right) = (SMatrix::<f64, 1, 1>::new(2.0), SVector::<f64, 1>::new(8.0));
        let taken = steps.take(&normal, &right, |step| {
            asked.push(step[0]);
            false
        });
        assert!(taken.is_none() && asked.len() == 3, "{asked:?}");
        assert!((asked[0] - 2.0).abs() < 1e-12 && asked.is_sorted_by(|a, b| a > b), "each is shorter: {asked:?}");
    }
}

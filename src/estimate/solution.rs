//! What a solution says.

use super::block::State;
use super::covariance::Covariance;
use super::error::EstimateError;
use super::left_out::LeftOut;
use super::levenberg::{Settings, Solved, Stop};
use super::problem::Problem;

impl Problem<'_> {
    /// Minimises Σ ρ(rᵀWr).
    ///
    /// # Errors
    /// When a residual is not finite at the start, or the solution leaves one without a prediction.
    pub fn solve(&self, settings: &Settings) -> Result<Estimate<'_>, EstimateError> {
        Ok(Estimate { solved: self.minimise(self.start.clone(), None, settings)?, settings: *settings })
    }
}

/// Where the solver ended.
pub struct Estimate<'a> {
    solved: Solved<'a>,
    settings: Settings,
}

impl Estimate<'_> {
    /// All blocks.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.solved.state
    }

    /// Why the solver stopped.
    #[must_use]
    pub fn stop(&self) -> Stop {
        self.solved.stop
    }

    /// Steps taken.
    #[must_use]
    pub fn iterations(&self) -> usize {
        self.solved.iterations
    }

    /// Observed minus predicted of a residual, in its own units.
    #[must_use]
    pub fn offset(&self, residual: usize) -> &[f64] {
        self.solved.offset(residual)
    }

    /// rᵀWr of a residual.
    #[must_use]
    pub fn chi2(&self, residual: usize) -> f64 {
        self.solved.linear.chi2[residual]
    }

    /// The share with which its loss let a residual count, in (0, 1].
    #[must_use]
    pub fn weight(&self, residual: usize) -> f64 {
        self.solved.weight(residual)
    }

    /// Σ rᵀWr over residuals and priors alike.
    #[must_use]
    pub fn chi2_sum(&self) -> f64 {
        self.solved.counted().map(|i| self.solved.linear.chi2[i]).sum()
    }

    /// Observed numbers, priors among them, less unknowns; negative where there are too few.
    #[must_use]
    pub fn degrees_of_freedom(&self) -> i64 {
        let degrees: usize = self.solved.counted().map(|i| self.solved.problem.residuals[i].0.degrees()).sum();
        degrees as i64 - self.solved.plan.total as i64
    }

    /// Covariance of all free blocks; residuals count with their loss's weights.
    ///
    /// # Errors
    /// When some direction is not determined, or a number is not finite.
    pub fn covariance(&self) -> Result<Covariance, EstimateError> {
        Covariance::new(&self.solved)
    }

    /// What residual `residual` is when all others, priors among them, are solved without it.
    ///
    /// # Errors
    /// When the others leave a direction undetermined.
    pub fn left_out(&self, residual: usize) -> Result<LeftOut, EstimateError> {
        LeftOut::solved(&self.solved, residual, &self.settings)
    }

    /// The same to first order, by taking the residual's information out of `covariance` (one matrix of the residual's size to invert).
    ///
    /// # Errors
    /// When the others leave a direction undetermined.
    pub fn left_out_linear(&self, covariance: &Covariance, residual: usize) -> Result<LeftOut, EstimateError> {
        LeftOut::linear(&self.solved, covariance, residual)
    }
}

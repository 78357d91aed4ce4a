//! What a solution says.

use super::block::State;
use super::covariance::Covariance;
use super::equations::Equations;
use super::error::EstimateError;
use super::left_out::LeftOut;
use super::levenberg::{Settings, Stop};
use super::linearisation::{Linearisation, Plan, Weighing};
use super::problem::Problem;

/// Where the solver ended.
pub struct Estimate<'a> {
    pub(super) problem: &'a Problem<'a>,
    pub(super) plan: Plan,
    pub(super) state: State,
    pub(super) linear: Linearisation,
    pub(super) without: Option<usize>,
    pub(super) settings: Settings,
    pub(super) stop: Stop,
    pub(super) iterations: usize,
}

impl Estimate<'_> {
    /// All blocks.
    #[must_use]
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Why the solver stopped.
    #[must_use]
    pub fn stop(&self) -> Stop {
        self.stop
    }

    /// Steps taken.
    #[must_use]
    pub fn iterations(&self) -> usize {
        self.iterations
    }

    /// Observed minus predicted of a residual, in its own units.
    #[must_use]
    pub fn offset(&self, residual: usize) -> &[f64] {
        let slot = &self.plan.slots[residual];
        &self.linear.offset[slot.offset..slot.offset + slot.n]
    }

    /// rᵀWr of a residual.
    #[must_use]
    pub fn chi2(&self, residual: usize) -> f64 {
        self.linear.chi2[residual]
    }

    /// The share with which its loss let a residual count, in (0, 1].
    #[must_use]
    pub fn weight(&self, residual: usize) -> f64 {
        self.linear.weight(self.problem, residual)
    }

    /// Σ rᵀWr over residuals and priors alike.
    #[must_use]
    pub fn chi2_sum(&self) -> f64 {
        self.counted().map(|i| self.linear.chi2[i]).sum()
    }

    /// Observed numbers, priors among them, less unknowns; negative where there are too few.
    #[must_use]
    pub fn degrees_of_freedom(&self) -> i64 {
        let degrees: usize = self.counted().map(|i| self.problem.residuals[i].0.degrees()).sum();
        degrees as i64 - self.plan.total as i64
    }

    /// Covariance of all free blocks; residuals count with their loss's weights.
    ///
    /// # Errors
    /// When some direction is not determined, or a number is not finite.
    pub fn covariance(&self) -> Result<Covariance, EstimateError> {
        let mut equations = Equations::new(self.problem, &self.plan);
        equations.assemble(self.problem, &self.plan, &self.linear, self.without, Weighing::Curvature);
        Covariance::new(self, &equations)
    }

    /// What residual `residual` is when all others, priors among them, are solved without it.
    ///
    /// # Errors
    /// When the others leave a direction undetermined.
    pub fn left_out(&self, residual: usize) -> Result<LeftOut, EstimateError> {
        LeftOut::solved(self, residual, &self.settings)
    }

    /// The same to first order, by taking the residual's information out of `covariance` (one matrix of the residual's size to invert).
    ///
    /// # Errors
    /// When the others leave a direction undetermined.
    pub fn left_out_linear(&self, covariance: &Covariance, residual: usize) -> Result<LeftOut, EstimateError> {
        LeftOut::linear(self, covariance, residual)
    }

    pub(super) fn counted(&self) -> impl Iterator<Item = usize> {
        let without = self.without;
        (0..self.plan.slots.len()).filter(move |i| without != Some(*i))
    }
}

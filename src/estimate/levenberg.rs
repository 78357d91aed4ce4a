//! Levenberg–Marquardt.
//!
//! A residual's weight may depend on the state (a bead's own uncertainty, seen through the camera). A step is judged by the weights from
//! which it was computed, then weights are renewed: the end is where Σ w JᵀWr = 0 whatever the start. Judged by each state's own weights,
//! steps near the end are refused as soon as the change of the weights outweighs the gain, and the end depends on the way there.

use super::block::State;
use super::equations::Equations;
use super::error::EstimateError;
use super::linearisation::{Linearisation, Plan, Weighing};
use super::problem::Problem;

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// Steps, at most.
    pub iterations: usize,
    /// Enough is a step of less than this many standard deviations.
    pub step_sigmas: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { iterations: 50, step_sigmas: 1e-8 }
    }
}

/// Why it stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    /// The next step would be too small to matter.
    Converged,
    /// No step, however short, makes the cost smaller.
    Stalled,
    /// The number of steps is used up.
    Iterations,
}

/// Attempts at one step, each ten times shorter or so.
const ATTEMPTS: usize = 12;
/// A cost that falls by less than a tenth is near its end.
const NEAR: f64 = 0.9;
/// Rounding of a cost, absolute and relative: pixels of some hundred with σ of some hundredths carry 1e-12 σ each. Differences below it
/// mean nothing.
const ROUNDING: f64 = 1e-10;
/// Steps that rounding may cause, in standard deviations.
const ROUNDING_STEP: f64 = 1e-4;

/// Where it ended.
pub(super) struct Solved<'a> {
    pub problem: &'a Problem<'a>,
    pub plan: Plan,
    pub state: State,
    pub linear: Linearisation,
    /// The residual that was left out.
    pub without: Option<usize>,
    pub stop: Stop,
    pub iterations: usize,
}

impl Solved<'_> {
    /// Observed minus predicted of a residual.
    pub fn offset(&self, residual: usize) -> &[f64] {
        let slot = &self.plan.slots[residual];
        &self.linear.offset[slot.offset..slot.offset + slot.n]
    }

    /// The share with which a residual's loss let it count.
    pub fn weight(&self, residual: usize) -> f64 {
        self.linear.weight(self.problem, residual)
    }

    /// The residuals that were not left out.
    pub fn counted(&self) -> impl Iterator<Item = usize> {
        let without = self.without;
        (0..self.plan.slots.len()).filter(move |i| without != Some(*i))
    }
}

impl Problem<'_> {
    /// Minimises Σ ρ(rᵀWr) from `start` over all residuals but `without`.
    pub(super) fn minimise(
        &self,
        start: State,
        without: Option<usize>,
        settings: &Settings,
    ) -> Result<Solved<'_>, EstimateError> {
        let plan = Plan::new(self);
        let (mut state, mut linear, mut trial) = (start, Linearisation::new(&plan), Linearisation::new(&plan));
        linear.fill(self, &plan, &state);
        if let Some(residual) = linear.offset_not_finite(&plan) {
            return Err(EstimateError::NotFinite { residual });
        }
        let mut equations = Equations::new(self, &plan);
        let mut damping = 1e-4;
        let (mut stop, mut iterations) = (Stop::Iterations, 0);
        let (mut near, mut before) = (false, f64::INFINITY);
        'steps: while iterations < settings.iterations && plan.total > 0 {
            let weighing = if near { Weighing::Curvature } else { Weighing::Slope };
            equations.assemble(self, &plan, &linear, without, weighing);
            let cost = linear.cost(self, &plan, &linear, without);
            let mut gain = f64::INFINITY;
            for _ in 0..ATTEMPTS {
                if let Some(step) = equations.step(damping) {
                    let squared = equations.along(&step) * (1.0 + damping);
                    gain = gain.min(squared);
                    // Tiny steps that grow no smaller are the rounding of the Jacobians.
                    let floor = squared <= ROUNDING_STEP.powi(2) && squared >= before;
                    if squared <= settings.step_sigmas.powi(2) || floor {
                        stop = Stop::Converged;
                        break 'steps;
                    }
                    let next = self.moved(&state, &plan.columns, step.as_slice());
                    trial.fill(self, &plan, &next);
                    let next_cost = trial.cost(self, &plan, &linear, without);
                    if next_cost <= cost + ROUNDING * (1.0 + cost) {
                        near = next_cost > NEAR * cost;
                        before = squared;
                        state = next;
                        std::mem::swap(&mut linear, &mut trial);
                        damping = (damping * 0.1).max(1e-15);
                        iterations += 1;
                        continue 'steps;
                    }
                }
                damping = (damping * 10.0).max(1e-8);
            }
            stop = if gain <= ROUNDING * (1.0 + cost) { Stop::Converged } else { Stop::Stalled };
            break;
        }
        if plan.total == 0 {
            stop = Stop::Converged;
        }
        let missing = linear.chi2.iter().enumerate().position(|(i, chi2)| !chi2.is_finite() && without != Some(i));
        if let Some(residual) = missing {
            return Err(EstimateError::Infeasible { residual });
        }
        Ok(Solved { problem: self, plan, state, linear, without, stop, iterations })
    }
}

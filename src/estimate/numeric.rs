//! A residual from a function alone, its Jacobian by central differences: kinematic chains, and checks of other residuals.

use nalgebra::DMatrix;

use super::block::{Block, BlockId, Kind, State};
use super::problem::Problem;
use super::residual::{Evaluation, Residual};

/// Relative step: the cube root of the rounding of a double balances rounding and the third derivative.
const STEP: f64 = 6e-6;

/// `observed` and a function that predicts it.
pub struct Numeric<F> {
    ids: Vec<BlockId>,
    blocks: Vec<Block>,
    observed: Vec<f64>,
    information: DMatrix<f64>,
    predict: F,
}

impl<F: Fn(&State, &mut [f64]) -> bool> Numeric<F> {
    /// `predict` writes as many numbers as `observed` has, or says false where there is no prediction; it may read only `blocks`, which
    /// belong to `problem`.
    ///
    /// # Panics
    /// When `information` is not square in the number of observed values.
    #[must_use]
    pub fn new(problem: &Problem, blocks: &[BlockId], observed: &[f64], information: DMatrix<f64>, predict: F) -> Self {
        let n = observed.len();
        assert!(information.shape() == (n, n), "{n} numbers observed, information is {:?}", information.shape());
        let own = blocks.iter().map(|id| problem.blocks[id.0].clone()).collect();
        Self { ids: blocks.to_vec(), blocks: own, observed: observed.to_vec(), information, predict }
    }
}

impl<F: Fn(&State, &mut [f64]) -> bool> Residual for Numeric<F> {
    fn dimension(&self) -> usize {
        self.observed.len()
    }

    fn blocks(&self) -> &[BlockId] {
        &self.ids
    }

    fn evaluate(&self, state: &State, out: &mut Evaluation) -> bool {
        let n = self.observed.len();
        let (mut low, mut high) = (vec![0.0; n], vec![0.0; n]);
        if !(self.predict)(state, &mut high) {
            return false;
        }
        for (i, offset) in out.offset().iter_mut().enumerate() {
            *offset = self.observed[i] - high[i];
        }
        out.information().copy_from_slice(self.information.as_slice());
        let mut near = state.clone();
        for (place, block) in self.blocks.iter().enumerate() {
            let Some(jacobian) = out.jacobian(place) else { continue };
            for k in 0..block.raw_width {
                let (centre, size) = match block.kind {
                    Kind::Pose { index } => (None, if k < 3 { 1.0 } else { state.motions[index].centre_mm().length() }),
                    Kind::Vector { first, .. } => (Some(first + k), state.numbers[first + k].abs()),
                };
                let step = STEP * size.max(1.0);
                block.nudge(&mut near, k, step);
                let above = (self.predict)(&near, &mut high);
                restore(&mut near, state, block, centre);
                block.nudge(&mut near, k, -step);
                let below = (self.predict)(&near, &mut low);
                restore(&mut near, state, block, centre);
                if !(above && below) {
                    return false;
                }
                for i in 0..n {
                    jacobian[k * n + i] = (high[i] - low[i]) / (2.0 * step);
                }
            }
        }
        true
    }
}

fn restore(near: &mut State, state: &State, block: &Block, number: Option<usize>) {
    match (block.kind, number) {
        (Kind::Pose { index }, _) => near.motions[index] = state.motions[index],
        (Kind::Vector { .. }, Some(n)) => near.numbers[n] = state.numbers[n],
        (Kind::Vector { .. }, None) => {}
    }
}

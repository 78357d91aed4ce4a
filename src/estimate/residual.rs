//! What a residual must say of itself.

use super::block::{BlockId, State};

/// An observation and its prediction from blocks.
pub trait Residual {
    /// How many numbers are observed.
    fn dimension(&self) -> usize;

    /// What it adds to the degrees of freedom: fewer than its numbers where its information is singular.
    fn degrees(&self) -> usize {
        self.dimension()
    }

    /// The blocks its prediction depends on, none of them twice.
    fn blocks(&self) -> &[BlockId];

    /// Fills `out` at `state`. False where there is no prediction (a bead behind the focal spot): such a state is never preferred to one
    /// where there is.
    fn evaluate(&self, state: &State, out: &mut Evaluation) -> bool;
}

/// Where a residual writes. All matrices start as zeros and are column-major: a column's n numbers stand together, n being the residual's
/// dimension.
pub struct Evaluation<'a> {
    pub(super) offset: &'a mut [f64],
    pub(super) information: &'a mut [f64],
    pub(super) noise: &'a mut [f64],
    pub(super) own_noise: &'a mut bool,
    /// Start of each block's matrix in `jacobian`, `None` for a block that does not move.
    pub(super) starts: &'a [Option<usize>],
    pub(super) widths: &'a [usize],
    pub(super) jacobian: &'a mut [f64],
}

impl Evaluation<'_> {
    /// Observed minus predicted, n numbers in units of the observed.
    pub fn offset(&mut self) -> &mut [f64] {
        self.offset
    }

    /// The inverse of the covariance by which the residual is weighed, n×n, symmetric.
    pub fn information(&mut self) -> &mut [f64] {
        self.information
    }

    /// The covariance that the offset really has, n×n, where it is not the inverse of `information`; the covariance of the estimate then
    /// is H⁻¹ (Σ Jᵀ W C W J) H⁻¹.
    pub fn noise(&mut self) -> &mut [f64] {
        *self.own_noise = true;
        self.noise
    }

    /// ∂predicted/∂block for the block at `place` in [`Residual::blocks`], n × 6 for a pose (ω, v about its centre), n × its numbers for a
    /// vector; `None` where the block is constant and nobody asks.
    pub fn jacobian(&mut self, place: usize) -> Option<&mut [f64]> {
        let start = self.starts[place]?;
        let size = self.offset.len() * self.widths[place];
        Some(&mut self.jacobian[start..start + size])
    }
}

//! What is known of a block besides the beads: priors and joint readings.

use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, Matrix6};

use super::block::{BlockId, PoseBlock, State, VectorBlock};
use super::motion::{about, deviation, left_jacobian_inverse};
use super::residual::{Evaluation, Residual};
use crate::geometry::Rigid;

/// A measured pose: ξ in exp(ξ̂)·mean = pose has zero mean and this information.
#[derive(Clone, Debug)]
pub struct PosePrior {
    block: [BlockId; 1],
    pose: PoseBlock,
    mean: Rigid,
    information: Matrix6<f64>,
    rank: usize,
}

impl PosePrior {
    /// `information` of ξ = (ω, v) about the origin of the pose's target frame, in 1/rad² and 1/mm²; it may be singular.
    #[must_use]
    pub fn new(pose: PoseBlock, mean: Rigid, information: Matrix6<f64>) -> Self {
        let rank = rank(&DMatrix::from_fn(6, 6, |i, j| information[(i, j)]));
        Self { block: [pose.id], pose, mean, information, rank }
    }
}

impl Residual for PosePrior {
    fn dimension(&self) -> usize {
        6
    }

    fn degrees(&self) -> usize {
        self.rank
    }

    fn blocks(&self) -> &[BlockId] {
        &self.block
    }

    fn evaluate(&self, state: &State, out: &mut Evaluation) -> bool {
        let motion = state.motion(self.pose);
        let xi = deviation(&motion.pose, &self.mean);
        // Measured: no deviation. Predicted: ξ. The block moves about its centre, ξ is about the origin.
        for (offset, x) in out.offset().iter_mut().zip(xi.iter()) {
            *offset = -x;
        }
        out.information().copy_from_slice(self.information.as_slice());
        if let Some(jacobian) = out.jacobian(0) {
            jacobian.copy_from_slice((left_jacobian_inverse(&xi) * about(-motion.centre_mm())).as_slice());
        }
        true
    }
}

/// Measured numbers of a vector block: a prior on K, distortion, a bead's place, or the readings of encoders with an offset.
///
/// A reading is the joint's value less its offset, as `CarmCalibration` adds the offset to the reading.
#[derive(Clone, Debug)]
pub struct Reading {
    ids: Vec<BlockId>,
    joints: VectorBlock,
    offsets: Option<VectorBlock>,
    /// Which numbers of `joints` (and of `offsets`) are measured.
    chosen: Vec<usize>,
    values: Vec<f64>,
    information: DMatrix<f64>,
    rank: usize,
}

impl Reading {
    /// All numbers of `block`, with their information (numbers × numbers), which may be singular.
    #[must_use]
    pub fn of_all(block: VectorBlock, values: &[f64], information: DMatrix<f64>) -> Self {
        Self::of_some(block, (0..block.len).collect(), values, information)
    }

    /// A point with its covariance in mm², which is positive definite.
    #[must_use]
    pub fn of_place(block: VectorBlock, at_mm: DVec3, covariance_mm2: &DMat3) -> Self {
        let information = covariance_mm2.inverse();
        Self::of_all(block, &at_mm.to_array(), DMatrix::from_fn(3, 3, |i, j| information.col(j)[i]))
    }

    /// The numbers `chosen` of `block`, in that order.
    ///
    /// # Panics
    /// When the lengths differ or a number is not there.
    #[must_use]
    pub fn of_some(block: VectorBlock, chosen: Vec<usize>, values: &[f64], information: DMatrix<f64>) -> Self {
        let n = chosen.len();
        assert!(
            values.len() == n && information.shape() == (n, n),
            "{n} numbers, {} values, {:?}",
            values.len(),
            information.shape()
        );
        assert!(chosen.iter().all(|c| *c < block.len), "{chosen:?} of {} numbers", block.len);
        let rank = rank(&information);
        Self { ids: vec![block.id], joints: block, offsets: None, chosen, values: values.to_vec(), information, rank }
    }

    /// Independent numbers with standard deviations; those that are not finite (a joint without encoder is NaN) are left out.
    #[must_use]
    pub fn with_sigmas(block: VectorBlock, values: &[f64], sigmas: &[f64]) -> Self {
        let measured = |n: &usize| values[*n].is_finite() && sigmas[*n] > 0.0 && sigmas[*n].is_finite();
        let chosen: Vec<usize> = (0..block.len.min(values.len()).min(sigmas.len())).filter(measured).collect();
        let own: Vec<f64> = chosen.iter().map(|n| values[*n]).collect();
        let information = DMatrix::from_fn(own.len(), own.len(), |i, j| if i == j { sigmas[chosen[i]].powi(-2) } else { 0.0 });
        Self::of_some(block, chosen, &own, information)
    }

    /// The readings come short of the joints by `offsets`, number by number.
    ///
    /// # Panics
    /// When `offsets` has fewer numbers than the joints.
    #[must_use]
    pub fn behind(mut self, offsets: VectorBlock) -> Self {
        assert!(self.chosen.iter().all(|c| *c < offsets.len), "{:?} of {} offsets", self.chosen, offsets.len);
        self.ids.push(offsets.id);
        self.offsets = Some(offsets);
        self
    }
}

impl Residual for Reading {
    fn dimension(&self) -> usize {
        self.chosen.len()
    }

    fn degrees(&self) -> usize {
        self.rank
    }

    fn blocks(&self) -> &[BlockId] {
        &self.ids
    }

    fn evaluate(&self, state: &State, out: &mut Evaluation) -> bool {
        let joints = state.vector(self.joints);
        let offsets = self.offsets.map(|block| state.vector(block));
        for ((offset, value), c) in out.offset().iter_mut().zip(&self.values).zip(&self.chosen) {
            *offset = value - joints[*c] + offsets.map_or(0.0, |o| o[*c]);
        }
        let n = self.chosen.len();
        out.information().copy_from_slice(self.information.as_slice());
        for (place, slope) in [(0, 1.0), (1, -1.0)] {
            if place < self.ids.len()
                && let Some(jacobian) = out.jacobian(place)
            {
                for (row, c) in self.chosen.iter().enumerate() {
                    jacobian[c * n + row] = slope;
                }
            }
        }
        true
    }
}

/// Eigenvalues that are not zero beside the largest, in units of the diagonal.
fn rank(information: &DMatrix<f64>) -> usize {
    let n = information.nrows();
    if !information.iter().all(|x| x.is_finite()) {
        return n;
    }
    let scale: Vec<f64> =
        (0..n).map(|i| if information[(i, i)] > 0.0 { information[(i, i)].sqrt().recip() } else { 0.0 }).collect();
    let unit = DMatrix::from_fn(n, n, |i, j| information[(i, j)] * scale[i] * scale[j]);
    // A positive definite matrix is the ordinary case, and needs no eigenvalues.
    if unit.clone().cholesky().is_some_and(|c| (0..n).all(|i| c.l_dirty()[(i, i)] > 1e-4)) {
        return n;
    }
    unit.symmetric_eigen().eigenvalues.iter().filter(|x| **x > 1e-9).count()
}

//! What a residual is when the others, priors among them, predict it.

use nalgebra::{DMatrix, DVector};

use super::block::BlockId;
use super::covariance::Covariance;
use super::error::{Direction, EstimateError};
use super::levenberg::{Settings, Solved};

/// A residual that its own solution has not seen.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOut {
    /// Observed minus predicted, in the residual's units.
    pub offset: DVector<f64>,
    /// Covariance of the prediction alone: J C Jᵀ with the covariance C of the others' solution.
    pub of_prediction: DMatrix<f64>,
    /// Its square in standard deviations, of observation and prediction together; as many degrees of freedom as it has numbers.
    pub chi2: f64,
}

impl LeftOut {
    pub(super) fn solved(whole: &Solved, residual: usize, settings: &Settings) -> Result<Self, EstimateError> {
        let count = whole.plan.slots.len();
        if residual >= count {
            return Err(EstimateError::NoSuchResidual { residual, count });
        }
        let others = whole.problem.minimise(whole.state.clone(), Some(residual), settings)?;
        if !others.linear.chi2[residual].is_finite() {
            return Err(EstimateError::Infeasible { residual });
        }
        let covariance = Covariance::new(&others)?;
        let of_prediction = spread(&others, &covariance, residual);
        let information = information(&others, residual);
        let offset = DVector::from_column_slice(others.offset(residual));
        // rᵀ (W⁻¹ + S)⁻¹ r = rᵀ W (1 + S W)⁻¹ r, which a singular W does not disturb.
        let mixed = DMatrix::identity(offset.len(), offset.len()) + &of_prediction * &information;
        let chi2 = mixed.lu().solve(&offset).map_or(f64::INFINITY, |x| offset.dot(&(&information * x)));
        Ok(Self { offset, of_prediction, chi2 })
    }

    /// With S = J C Jᵀ of the whole, 1 − S W is what leaving out divides by: r → (1 − S W)⁻¹ r, S → (1 − S W)⁻¹ S, and
    /// χ² = rᵀ W (1 − S W)⁻¹ r (Cook & Weisberg 1982, §2.2).
    pub(super) fn linear(whole: &Solved, covariance: &Covariance, residual: usize) -> Result<Self, EstimateError> {
        let count = whole.plan.slots.len();
        if residual >= count {
            return Err(EstimateError::NoSuchResidual { residual, count });
        }
        let (own, information) = (spread(whole, covariance, residual), information(whole, residual));
        let offset = DVector::from_column_slice(whole.offset(residual));
        let n = offset.len();
        // The residual entered the sum with its loss's weight.
        let left = DMatrix::identity(n, n) - &own * &information * whole.weight(residual);
        let factor = left.full_piv_lu();
        if !(factor.determinant().abs() > 1e-9) {
            return Err(only_by(whole, residual));
        }
        let undetermined = || only_by(whole, residual);
        let outside = factor.solve(&offset).ok_or_else(undetermined)?;
        let of_prediction = factor.solve(&own).ok_or_else(undetermined)?;
        let mixed = DMatrix::identity(n, n) + &of_prediction * &information;
        let chi2 = mixed.lu().solve(&outside).map_or(f64::INFINITY, |x| outside.dot(&(&information * x)));
        Ok(Self { offset: outside, of_prediction, chi2 })
    }
}

fn information(estimate: &Solved, residual: usize) -> DMatrix<f64> {
    let slot = &estimate.plan.slots[residual];
    DMatrix::from_row_slice(slot.n, slot.n, &estimate.linear.information[slot.square..slot.square + slot.n * slot.n])
}

/// J C Jᵀ over the residual's blocks.
fn spread(estimate: &Solved, covariance: &Covariance, residual: usize) -> DMatrix<f64> {
    let (problem, plan) = (estimate.problem, &estimate.plan);
    let slot = &plan.slots[residual];
    let (mut blocks, mut by_free) = (Vec::new(), DMatrix::zeros(slot.n, 0));
    for part in slot.first..slot.first + slot.count {
        let (Some(start), block) = (plan.starts[part], plan.parts[part]) else { continue };
        let width = problem.blocks[block].width;
        let rows = DMatrix::from_column_slice(slot.n, width, &estimate.linear.jacobian[start..start + slot.n * width]);
        let before = by_free.ncols();
        by_free = by_free.resize_horizontally(before + width, 0.0);
        by_free.columns_mut(before, width).copy_from(&rows);
        blocks.push(BlockId(block));
    }
    &by_free * covariance.of(&blocks) * by_free.transpose()
}

/// Something of this residual's blocks rests on it alone.
fn only_by(estimate: &Solved, residual: usize) -> EstimateError {
    let columns = estimate.plan.total;
    let slot = &estimate.plan.slots[residual];
    let parts = slot.first..slot.first + slot.count;
    let components = parts
        .filter(|part| estimate.plan.starts[*part].is_some())
        .map(|part| (BlockId(estimate.plan.parts[part]), estimate.problem.blocks[estimate.plan.parts[part]].name, 0, 1.0))
        .collect();
    EstimateError::Undetermined { rank: columns - 1, columns, directions: vec![Direction { components }] }
}

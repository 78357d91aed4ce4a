//! Covariance of the cloud apart from where it lies, and apart from its size.
//!
//! The rough cameras place the cloud in the room worse than its beads are known to each other. What a user of the layout needs is the
//! covariance after the best rigid motion, with and without the best scale: C ← (1 − Q Qᵀ) C (1 − Q Qᵀ), Q spanning the motions.

use glam::DVec3;
use nalgebra::{DMatrix, DVector, Matrix3};

/// Standard deviations of a cloud.
#[derive(Clone, Debug)]
pub(super) struct Spread {
    /// Of each bead after the best rigid motion, the size's share included, mm².
    pub total: Vec<Matrix3<f64>>,
    /// Of each bead after the best motion and scale, mm².
    pub shape: Vec<Matrix3<f64>>,
    /// Of the size, as a share.
    pub scale_sigma: f64,
}

/// `covariance` of all beads, three numbers each, in their order.
pub(super) fn spread(points: &[DVec3], covariance: &DMatrix<f64>) -> Spread {
    let n = points.len();
    let centre = points.iter().sum::<DVec3>() / n.max(1) as f64;
    let arms: Vec<DVec3> = points.iter().map(|point| *point - centre).collect();
    let column = |of: &dyn Fn(DVec3) -> DVec3| {
        let moved: Vec<f64> = arms.iter().flat_map(|arm| of(*arm).to_array()).collect();
        DVector::from_vec(moved)
    };
    let mut columns: Vec<DVector<f64>> = DVec3::AXES.iter().map(|axis| column(&|_| *axis)).collect();
    columns.extend(DVec3::AXES.iter().map(|axis| column(&|arm| axis.cross(arm))));
    let size = column(&|arm| arm);
    let rigid = without(&columns, covariance);
    columns.push(size.clone());
    let shape = without(&columns, covariance);
    let of_bead = |of: &DMatrix<f64>, bead: usize| Matrix3::from_fn(|i, j| of[(3 * bead + i, 3 * bead + j)]);
    let unit = &size / size.norm_squared().max(f64::MIN_POSITIVE);
    Spread {
        total: (0..n).map(|bead| of_bead(&rigid, bead)).collect(),
        shape: (0..n).map(|bead| of_bead(&shape, bead)).collect(),
        scale_sigma: unit.dot(&(covariance * &unit)).max(0.0).sqrt(),
    }
}

/// The covariance without what lies along `columns`.
fn without(columns: &[DVector<f64>], covariance: &DMatrix<f64>) -> DMatrix<f64> {
    let q = DMatrix::from_columns(columns).qr().q();
    let left = DMatrix::identity(covariance.nrows(), covariance.ncols()) - &q * q.transpose();
    &left * covariance * &left
}

/// Root mean square over axes.
pub(super) fn sigma_mm(covariance: &Matrix3<f64>) -> f64 {
    (covariance.trace() / 3.0).max(0.0).sqrt()
}

/// Standard deviation along the worst axis.
pub(super) fn worst_mm(covariance: &Matrix3<f64>) -> f64 {
    covariance.symmetric_eigen().eigenvalues.max().max(0.0).sqrt()
}

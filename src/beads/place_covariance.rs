//! How well a bead's place is known along every direction.

use std::fmt;
use std::str::FromStr;

use glam::DMat3;
use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

/// Rounded digits leave entries that differ across the diagonal, and eigenvalues below zero, by this share of the largest variance.
const ROUNDING: f64 = 2e-3;
/// No place is known better along any direction, σ, mm; a covariance of less is taken as this.
pub(super) const LEAST_MM: f64 = 1e-4;
/// A place that is known no better along some direction, σ, mm, is not known: its numbers are of another unit.
const MOST_MM: f64 = 20.0;

/// A 3×3 covariance of a place in mm²: symmetric, positive definite. JSON has its rows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "[[f64; 3]; 3]", into = "[[f64; 3]; 3]")]
pub struct PlaceCovariance(DMat3);

/// Why something is no covariance of a place.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CovarianceFault {
    /// Other than six or nine numbers.
    #[error("is not six numbers xx:xy:xz:yy:yz:zz in mm² (or nine, row by row)")]
    Form,
    /// NaN or infinite.
    #[error("holds a number that is not finite")]
    NotFinite,
    /// Two entries that should be one.
    #[error("is not symmetric: two entries that should be alike differ by {gap_mm2:.3e} mm²")]
    Asymmetric {
        /// By how much.
        gap_mm2: f64,
    },
    /// A variance below zero along some direction.
    #[error("is not positive: along one direction the variance is {least_mm2:.3e} mm²")]
    Negative {
        /// The smallest.
        least_mm2: f64,
    },
    /// Nothing is known along some direction.
    #[error(
        "says that along one direction the place is known to {sigma_mm:.1} mm only (limit {limit_mm:.0} mm); are its numbers in mm²?"
    )]
    TooLarge {
        /// The largest standard deviation.
        sigma_mm: f64,
        /// What it may be.
        limit_mm: f64,
    },
}

impl PlaceCovariance {
    /// From its rows, mm², along the axes in which the place is given. Semidefinite ones are taken as known to 0.1 µm along the directions of no
    /// variance; rounded ones with a variance below zero to the root of its amount.
    ///
    /// # Errors
    /// When a number is not finite, or they are not symmetric, not positive, or beyond any place that is known.
    pub fn new(rows: [[f64; 3]; 3]) -> Result<Self, CovarianceFault> {
        if !rows.iter().flatten().all(|number| number.is_finite()) {
            return Err(CovarianceFault::NotFinite);
        }
        let symmetric = Matrix3::from_fn(|i, j| 0.5 * rows[i][j] + 0.5 * rows[j][i]);
        let eigen = symmetric.symmetric_eigen();
        let (least_mm2, most_mm2) = (eigen.eigenvalues.min(), eigen.eigenvalues.max());
        let gap_mm2 = [(0, 1), (0, 2), (1, 2)].map(|(i, j): (usize, usize)| (rows[i][j] - rows[j][i]).abs());
        let gap_mm2 = gap_mm2.into_iter().fold(0.0, f64::max);
        if !(gap_mm2 <= ROUNDING * most_mm2.abs()) {
            return Err(CovarianceFault::Asymmetric { gap_mm2 });
        }
        if !(least_mm2 >= -ROUNDING * most_mm2.abs()) {
            return Err(CovarianceFault::Negative { least_mm2 });
        }
        let sigma_mm = most_mm2.max(0.0).sqrt();
        if !(sigma_mm <= MOST_MM) {
            return Err(CovarianceFault::TooLarge { sigma_mm, limit_mm: MOST_MM });
        }
        // Digits that put a variance below zero are off by as much.
        let floor_mm2 = (LEAST_MM * LEAST_MM).max(-least_mm2);
        // What was written after it had been raised is not raised again: its digits come back as they are.
        if least_mm2 >= 0.5 * floor_mm2 {
            return Ok(Self::of(&symmetric));
        }
        let raised = Matrix3::from_diagonal(&eigen.eigenvalues.map(|variance| variance.max(floor_mm2)));
        Ok(Self::of(&(eigen.eigenvectors * raised * eigen.eigenvectors.transpose())))
    }

    fn of(m: &Matrix3<f64>) -> Self {
        let at = |i: usize, j: usize| 0.5 * (m[(i, j)] + m[(j, i)]);
        Self(DMat3::from_cols_array(&std::array::from_fn(|n| at(n / 3, n % 3))))
    }

    /// The matrix.
    #[must_use]
    pub fn mm2(&self) -> DMat3 {
        self.0
    }

    /// The same of a place whose axes are turned, or mirrored: Σ becomes T Σ Tᵀ.
    #[must_use]
    pub fn turned(&self, to_from: &DMat3) -> Self {
        Self(*to_from * self.0 * to_from.transpose())
    }

    /// Root mean square of the standard deviations along three axes.
    #[must_use]
    pub fn sigma_mm(&self) -> f64 {
        ((self.0.x_axis.x + self.0.y_axis.y + self.0.z_axis.z) / 3.0).sqrt()
    }

    /// Largest standard deviation along any direction.
    #[must_use]
    pub fn most_sigma_mm(&self) -> f64 {
        let m = self.0.to_cols_array_2d();
        Matrix3::from_fn(|i, j| m[j][i]).symmetric_eigenvalues().max().max(0.0).sqrt()
    }
}

impl TryFrom<[[f64; 3]; 3]> for PlaceCovariance {
    type Error = CovarianceFault;

    fn try_from(rows: [[f64; 3]; 3]) -> Result<Self, Self::Error> {
        Self::new(rows)
    }
}

impl From<PlaceCovariance> for [[f64; 3]; 3] {
    fn from(covariance: PlaceCovariance) -> Self {
        covariance.0.transpose().to_cols_array_2d()
    }
}

impl FromStr for PlaceCovariance {
    type Err = CovarianceFault;

    /// `xx:xy:xz:yy:yz:zz`, or nine numbers row by row.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let numbers = text.split(':').map(str::parse::<f64>).collect::<Result<Vec<_>, _>>().map_err(|_| CovarianceFault::Form)?;
        match numbers[..] {
            [xx, xy, xz, yy, yz, zz] => Self::new([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
            [xx, xy, xz, yx, yy, yz, zx, zy, zz] => Self::new([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]]),
            _ => Err(CovarianceFault::Form),
        }
    }
}

impl fmt::Display for PlaceCovariance {
    /// As a description says it, every digit.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, z] = [self.0.x_axis, self.0.y_axis, self.0.z_axis];
        write!(f, "{}:{}:{}:{}:{}:{}", x.x, x.y, x.z, y.y, y.z, z.z)
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    #[test]
    fn a_covariance_is_taken_as_it_is_written_and_comes_back_digit_for_digit() {
        let plain: PlaceCovariance = "0.36:0.01:-0.02:0.0025:0.001:0.04".parse().expect("a covariance");
        assert_eq!(plain.mm2().y_axis, DVec3::new(0.01, 0.0025, 0.001));
        assert!((plain.sigma_mm() - (0.4025f64 / 3.0).sqrt()).abs() < 1e-15 && plain.most_sigma_mm() > 0.6);
        // Certain along two axes: known to 0.1 µm.
        let flat: PlaceCovariance = "0.36:0:0:0:0:0".parse().expect("semidefinite");
        assert!((flat.mm2().y_axis.y - 1e-8).abs() < 1e-12 && flat.mm2().determinant() > 0.0);
        let turned = plain.turned(&DMat3::from_quat(DQuat::from_rotation_y(0.7)));
        assert!((turned.sigma_mm() - plain.sigma_mm()).abs() < 1e-12);
        assert!((turned.most_sigma_mm() - plain.most_sigma_mm()).abs() < 1e-12);
        assert!(turned.mm2().x_axis.x < 0.9 * plain.mm2().x_axis.x, "what was along x is not");
        // Along (1, −1, 0) −1e-5 mm²: its digits say no more of that direction.
        let rounded: PlaceCovariance = "0.01:0.01001:0:0.01:0:0.01".parse().expect("rounded");
        let least_mm2 = rounded.mm2().x_axis.x - rounded.mm2().x_axis.y;
        assert!((least_mm2 - 1e-5).abs() < 1e-9, "{least_mm2}");
        for own in [plain, flat, rounded] {
            assert_eq!(own.to_string().parse::<PlaceCovariance>(), Ok(own));
        }
    }

    #[test]
    fn what_is_no_covariance_is_told_why() {
        use CovarianceFault::{Asymmetric, Form, Negative, NotFinite, TooLarge};
        let fault = |text: &str| text.parse::<PlaceCovariance>().expect_err(text);
        assert_eq!(fault("0.01:0:0"), Form);
        assert_eq!(fault("0.01:0:0:a:0:0.01"), Form);
        assert_eq!(fault("0.01:0:0:nan:0:0.01"), NotFinite);
        assert_eq!(fault("0.01:0:0:inf:0:0.01"), NotFinite);
        assert!(matches!(fault("0.01:0.02:0:0:0.01:0:0:0:0.01"), Asymmetric { gap_mm2 } if (gap_mm2 - 0.02).abs() < 1e-12));
        assert!(matches!(fault("0.01:0.02:0:0.01:0:0.01"), Negative { least_mm2 } if (least_mm2 + 0.01).abs() < 1e-9));
        assert!(matches!(fault("-1:0:0:-1:0:-1"), Negative { .. }));
        assert!(matches!(fault("1.7e308:0:0:1:0:1"), TooLarge { .. }));
        assert!(matches!(fault("1e6:0:0:1:0:1"), TooLarge { sigma_mm, .. } if (sigma_mm - 1000.0).abs() < 1e-6));
        // Three rounded digits of a sound one whose smallest variance is a thousandth of the largest.
        assert!("3.602e-1:1.897e-2:0:9.990e-4:0:1.000e-3".parse::<PlaceCovariance>().is_ok());
    }
}

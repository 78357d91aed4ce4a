//! How a pose moves while it is estimated, and how far two poses are apart.
//!
//! The pose moves by a_from_b ← T(c)·exp(ξ̂)·T(−c)·a_from_b with ξ = (ω, v) and c the image in `a` of a pivot in `b`, the beads'
//! centroid as a rule: rotation about the beads and translation of the beads are nearly uncorrelated, where rotation about the distant
//! focal spot and translation are not.

use glam::DVec3;
use nalgebra::{Matrix6, Vector6};

use crate::geometry::Rigid;

/// A pose with the point it turns about.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// `a_from_b`.
    pub pose: Rigid,
    /// The pivot in `b`.
    pub pivot_mm: DVec3,
}

impl Motion {
    /// The pivot in `a`: the centre c of ξ.
    #[must_use]
    pub fn centre_mm(&self) -> DVec3 {
        self.pose.transform_point(self.pivot_mm)
    }

    /// Moved by ξ = (ω, v) about the centre; `xi` holds six numbers, rad and mm.
    #[must_use]
    pub fn moved(&self, xi: &[f64; 6]) -> Self {
        let local = Rigid::exp(DVec3::new(xi[0], xi[1], xi[2]), DVec3::new(xi[3], xi[4], xi[5]));
        let centre = self.centre_mm();
        let pose = Rigid::translation(centre) * local * Rigid::translation(-centre) * self.pose;
        Self { pose, pivot_mm: self.pivot_mm }
    }
}

/// A row a of ∂/∂p as a row of ∂/∂(ω, v): δp = ω × r + v, so a·δp = ω·(r × a) + v·a. `arm_mm` is r, from the centre to the point.
#[must_use]
pub fn turned(by_point: DVec3, arm_mm: DVec3) -> [f64; 6] {
    let turn = arm_mm.cross(by_point);
    [turn.x, turn.y, turn.z, by_point.x, by_point.y, by_point.z]
}

/// 6×6: ξ about `centre` from ξ about the origin, (ω, v + ω × c).
#[must_use]
pub fn about(centre: DVec3) -> Matrix6<f64> {
    let mut t = Matrix6::identity();
    // Columns of −[c]×.
    t[(4, 0)] = -centre.z;
    t[(5, 0)] = centre.y;
    t[(3, 1)] = centre.z;
    t[(5, 1)] = -centre.x;
    t[(3, 2)] = -centre.y;
    t[(4, 2)] = centre.x;
    t
}

/// ξ about the origin with exp(ξ̂)·from = to; rad and mm.
#[must_use]
pub fn deviation(to: &Rigid, from: &Rigid) -> Vector6<f64> {
    let (omega, v) = (*to * from.inverse()).log();
    Vector6::new(omega.x, omega.y, omega.z, v.x, v.y, v.z)
}

/// Even Bernoulli numbers over factorials, B₂ₖ/(2k)!, k = 1…12.
const BERNOULLI: [f64; 12] = [
    1.0 / 12.0,
    -1.0 / 720.0,
    1.0 / 30_240.0,
    -1.0 / 1_209_600.0,
    1.0 / 47_900_160.0,
    -691.0 / 1_307_674_368_000.0,
    1.0 / 74_724_249_600.0,
    -3617.0 / 10_670_622_842_880_000.0,
    43_867.0 / 5_109_094_217_170_944_000.0,
    -174_611.0 / 802_857_662_698_291_200_000.0,
    77_683.0 / 14_101_100_039_391_805_440_000.0,
    -236_364_091.0 / 1_693_824_136_731_743_669_452_800_000.0,
];

/// 6×6 J with log(exp(η̂)·exp(ξ̂)) = ξ + J η to first order: the inverse left Jacobian of SE(3), order (ω, v).
///
/// J = Σ Bₙ/n! ad(ξ)ⁿ = 1 − ½ ad + ad²/12 − ad⁴/720 … (Barfoot 2017, §7.1.5); the terms kept leave an error of 2(|ω|/2π)²⁶: 1e-20
/// at one radian, 3e-8 at half a turn, where the logarithm itself ends.
#[must_use]
pub fn left_jacobian_inverse(xi: &Vector6<f64>) -> Matrix6<f64> {
    let (omega, v) = (DVec3::new(xi[0], xi[1], xi[2]), DVec3::new(xi[3], xi[4], xi[5]));
    let mut ad = Matrix6::zeros();
    for column in 0..3 {
        let axis = DVec3::AXES[column];
        let (turn, shift) = (omega.cross(axis), v.cross(axis));
        for row in 0..3 {
            ad[(row, column)] = turn[row];
            ad[(row + 3, column + 3)] = turn[row];
            ad[(row + 3, column)] = shift[row];
        }
    }
    let square = ad * ad;
    let mut sum = Matrix6::identity() - ad * 0.5;
    let mut power = square;
    for coefficient in BERNOULLI {
        sum += power * coefficient;
        power *= square;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_turns_about_its_pivot() {
        let motion = Motion {
            pose: Rigid::exp(DVec3::new(0.3, -0.2, 0.9), DVec3::new(5.0, 7.0, 600.0)),
            pivot_mm: DVec3::new(9.0, 8.0, -7.0),
        };
        let turned = motion.moved(&[0.1, -0.2, 0.3, 0.0, 0.0, 0.0]);
        assert!(turned.centre_mm().distance(motion.centre_mm()) < 1e-9);
        assert!(turned.pose.angle_to_rad(&motion.pose) > 0.3);
        let shifted = motion.moved(&[0.0, 0.0, 0.0, 1.0, 2.0, 3.0]);
        assert!((shifted.centre_mm() - motion.centre_mm()).distance(DVec3::new(1.0, 2.0, 3.0)) < 1e-9);
    }

    #[test]
    fn the_left_jacobian_is_the_derivative_of_the_logarithm() {
        let mut cases = 0;
        for scale in [1e-6, 0.05, 1.0, 2.0] {
            let xi = Vector6::new(0.6 * scale, -0.5 * scale, 0.62 * scale, 30.0 * scale, -50.0, 80.0);
            let pose = Rigid::exp(DVec3::new(xi[0], xi[1], xi[2]), DVec3::new(xi[3], xi[4], xi[5]));
            let jacobian = left_jacobian_inverse(&xi);
            for column in 0..6 {
                let h = 1e-6;
                let at = |sign: f64| {
                    let mut eta = [0.0; 6];
                    eta[column] = sign * h;
                    let step = Rigid::exp(DVec3::new(eta[0], eta[1], eta[2]), DVec3::new(eta[3], eta[4], eta[5]));
                    deviation(&(step * pose), &Rigid::IDENTITY)
                };
                let slope = (at(1.0) - at(-1.0)) / (2.0 * h);
                let error = (slope - jacobian.column(column)).norm();
                assert!(error < 1e-5 * (1.0 + slope.norm()), "{scale} {column}: {error:.1e}");
                cases += 1;
            }
        }
        assert_eq!(cases, 24);
    }
}

//! How a C-arm bends under its own weight.
//!
//! An elastic C that keeps its shape under gravity deflects in proportion to the direction of gravity in its own axes. But the C slides
//! through its carriage: the lever arms on either side of the carriage, and so the stiffness, change with the orbital angle, which gives
//! products of gravity with sine and cosine of that angle.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Terms in which deflections are linear.
pub const SAG_TERMS: usize = 8;

/// Gravity's terms at two angles, all zero at zero. With "down" in the C's axes d = Ry(−o) Rx(−a) (0, 0, −1) less its value at zero,
/// a the angulation and o the orbital angle: d_x, d_y, d_z (first order: the C as it is); 1 − cos a (the carriage, which does not
/// slide); d_x sin o, d_x (cos o − 1), d_y sin o, d_y (cos o − 1) (second order: the lever arms change).
#[must_use]
pub fn sag_terms(angulation_rad: f64, orbital_rad: f64) -> [f64; SAG_TERMS] {
    let ((sin_a, cos_a), (sin_o, cos_o)) = (angulation_rad.sin_cos(), orbital_rad.sin_cos());
    let (x, y, z) = (cos_a * sin_o, -sin_a, 1.0 - cos_a * cos_o);
    [x, y, z, 1.0 - cos_a, x * sin_o, x * (cos_o - 1.0), y * sin_o, y * (cos_o - 1.0)]
}

/// Gravity's effect on focal spot and detector, in the axes of the C (those of the camera before the panel turns): rows x, y, z, each
/// with a coefficient per term of [`sag_terms`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GravitySag {
    /// The focal spot moves.
    pub source_mm: [[f64; SAG_TERMS]; 3],
    /// The detector turns about its middle; a rotation vector.
    pub rotation_deg: [[f64; SAG_TERMS]; 3],
    /// The detector's middle moves.
    pub detector_mm: [[f64; SAG_TERMS]; 3],
}

impl GravitySag {
    /// Of one of the three tables at given terms.
    #[must_use]
    pub fn at(rows: &[[f64; SAG_TERMS]; 3], terms: &[f64; SAG_TERMS]) -> DVec3 {
        DVec3::from_array(rows.map(|row| row.iter().zip(terms).map(|(coefficient, term)| coefficient * term).sum()))
    }
}

/// How the arm's axes and its detector stand to each other, where not as drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Misalignment {
    /// Turn of the angulation axis out of the horizontal, about y.
    pub angulation_axis_tilt_deg: f64,
    /// Turn of the orbital axis out of the perpendicular to the angulation axis, about z.
    pub orbital_axis_skew_deg: f64,
    /// The orbital axis passes the angulation axis at this distance, along z at zero.
    pub orbital_axis_offset_mm: f64,
    /// Turn of the detector about its middle, about the C's x and y.
    pub detector_tilt_deg: [f64; 2],
    /// Where the axis about which the panel turns passes the C's own axis, along its x and y.
    pub detector_offset_mm: [f64; 2],
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    #[test]
    fn the_first_terms_are_gravity_in_the_axes_of_the_c() {
        let mut cases = 0;
        for (a, o) in [(0.0f64, 0.0f64), (0.3, -1.2), (-0.7, 2.5)] {
            let c = DQuat::from_rotation_x(a) * DQuat::from_rotation_y(o);
            let down = c.inverse() * DVec3::NEG_Z - DVec3::NEG_Z;
            let terms = sag_terms(a, o);
            assert!(down.distance(DVec3::new(terms[0], terms[1], terms[2])) < 1e-12, "{a} {o}: {down} {terms:?}");
            cases += 1;
        }
        assert_eq!(cases, 3);
        assert_eq!(sag_terms(0.0, 0.0).map(f64::abs), [0.0; SAG_TERMS]);
    }
}

//! Angles and constants that need a name. Radians inside, degrees in files, on the wire and on screen.

use std::f64::consts::{PI, TAU};

/// Microseconds in a second.
pub const US_PER_S: i64 = 1_000_000;

/// The angle in (−π, π] that equals `angle_rad` up to whole turns; NaN stays NaN.
#[must_use]
pub fn wrap_rad(angle_rad: f64) -> f64 {
    let turned = (angle_rad + PI).rem_euclid(TAU) - PI;
    if turned <= -PI { turned + TAU } else { turned }
}

/// Interpolates from `a_rad` to `b_rad` the short way round; `fraction` 0 gives `a_rad`, 1 gives `b_rad` (up to whole turns).
#[must_use]
pub fn lerp_angle_rad(a_rad: f64, b_rad: f64, fraction: f64) -> f64 {
    a_rad + wrap_rad(b_rad - a_rad) * fraction
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrapping_keeps_the_half_open_interval() {
        assert!((wrap_rad(PI) - PI).abs() < 1e-15);
        assert!((wrap_rad(-PI) - PI).abs() < 1e-15);
        assert!((wrap_rad(3.5 * PI) + 0.5 * PI).abs() < 1e-12);
        assert!(wrap_rad(f64::NAN).is_nan());
    }

    #[test]
    fn angles_interpolate_across_the_seam() {
        let middle = lerp_angle_rad(170f64.to_radians(), -170f64.to_radians(), 0.5);
        assert!((wrap_rad(middle).to_degrees().abs() - 180.0).abs() < 1e-9);
    }
}

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

/// The value at `x` of a line through `values` at ascending `places`, as many and at least one; beyond them that of the nearer end.
#[must_use]
pub fn interpolated(places: &[f64], values: &[f64], x: f64) -> f64 {
    interpolated_below(places, values, x, places.partition_point(|place| *place < x))
}

/// [`interpolated`], where so many of the places lie below `x`.
#[inline]
#[must_use]
pub fn interpolated_below(places: &[f64], values: &[f64], x: f64, upper: usize) -> f64 {
    if upper == 0 || upper == places.len() {
        return values[upper.min(places.len() - 1)];
    }
    let (a, b) = (places[upper - 1], places[upper]);
    let fraction = if b > a { (x - a) / (b - a) } else { 0.0 };
    values[upper - 1] + fraction * (values[upper] - values[upper - 1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_straight_between_its_places_and_ends_flat() {
        let at = |x: f64| interpolated(&[1.0, 2.0, 2.0, 4.0], &[10.0, 20.0, 30.0, 50.0], x);
        for (x, value) in [(0.0, 10.0), (1.0, 10.0), (1.5, 15.0), (2.0, 20.0), (3.0, 40.0), (4.0, 50.0), (9.0, 50.0)] {
            assert_eq!(at(x), value, "{x}");
        }
    }

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

//! How far an image is from another of the same scene, in the measure in which plans state their error.

use serde::{Deserialize, Serialize};

/// |Δ line_integral| / max(1, line_integral) over the pixels of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Achieved {
    /// 99.9th percentile.
    pub error: f64,
    /// Worst pixel.
    pub worst: f64,
    /// Wall milliseconds, preparation and planning aside.
    pub ms: f64,
}

impl Achieved {
    /// Compares line integrals; NaN anywhere is an infinite error.
    #[must_use]
    pub fn of(line_integral: &[f32], expected: &[f32], ms: f64) -> Self {
        let error = |(found, expected): (&f32, &f32)| {
            let error = (f64::from(*found) - f64::from(*expected)).abs() / f64::from(*expected).max(1.0);
            if error.is_nan() { f64::INFINITY } else { error }
        };
        let mut errors: Vec<f64> = line_integral.iter().zip(expected).map(error).collect();
        if errors.is_empty() || line_integral.len() != expected.len() {
            return Self { error: f64::INFINITY, worst: f64::INFINITY, ms };
        }
        errors.sort_unstable_by(f64::total_cmp);
        let rank = (errors.len() * 999).div_ceil(1000).clamp(1, errors.len()) - 1;
        Self { error: errors[rank], worst: errors[errors.len() - 1], ms }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_pixel_in_a_thousand_is_left_to_the_worst() {
        let expected = vec![2.0f32; 2000];
        let mut found = expected.clone();
        found[7] = 3.0;
        let achieved = Achieved::of(&found, &expected, 1.0);
        assert_eq!((achieved.error, achieved.worst), (0.0, 0.5));
        found[8..10].fill(2.5);
        assert_eq!(Achieved::of(&found, &expected, 1.0).error, 0.25);
        found[9] = f32::NAN;
        assert_eq!(Achieved::of(&found, &expected, 1.0).worst, f64::INFINITY);
        assert_eq!(Achieved::of(&found[1..], &expected, 1.0).error, f64::INFINITY);
    }
}

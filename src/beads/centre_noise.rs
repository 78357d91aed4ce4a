//! How well a shadow's centre is known, along every direction.

use glam::DVec2;

use super::detect::Detection;

/// No centre is known better along any direction, σ, px.
const LEAST_SIGMA_PX: f64 = 0.003;
/// Rounded digits leave entries that differ across the diagonal by this share of the larger variance.
const ROUNDING: f64 = 2e-3;

/// A covariance uu, uv, vv in px² of a place that is known along no direction better than to `sigma_px`: raised by what the direction that
/// is known best lacks.
#[must_use]
pub fn known_at_best([uu, uv, vv]: [f64; 3], sigma_px: f64) -> [f64; 3] {
    let least = 0.5 * (uu + vv) - (0.5 * (uu - vv)).hypot(uv);
    let more = (sigma_px.powi(2) - least).max(0.0);
    [uu + more, uv, vv + more]
}

/// Whether rows in px² are a covariance: finite, symmetric but for rounding, positive definite.
#[must_use]
pub fn is_covariance_px2([[uu, uv], [vu, vv]]: &[[f64; 2]; 2]) -> bool {
    let cross = 0.5 * (uv + vu);
    let is_positive = *uu > 0.0 && *vv > 0.0 && uu * vv > cross * cross;
    is_positive && uu.max(*vv).is_finite() && (uv - vu).abs() <= ROUNDING * uu.max(*vv)
}

impl Detection {
    /// Whether a covariance is stated and is none. Of what [`super::detect()`] finds, and of files, none is.
    #[must_use]
    pub fn misstates_covariance(&self) -> bool {
        self.covariance_px2 != [[0.0; 2]; 2] && !is_covariance_px2(&self.covariance_px2)
    }

    /// Covariance of the centre, uu, uv, vv in px²: the stated one, or where there is none `sigma_px` along every direction; nowhere less
    /// than a centre can be known. Where a covariance is stated that is none ([`Detection::misstates_covariance`]), along every direction
    /// the largest of `sigma_px` and of the variances that it states. Not a number where `sigma_px` is none and counts.
    #[must_use]
    pub fn noise_px2(&self) -> [f64; 3] {
        let [[uu, uv], [vu, vv]] = self.covariance_px2;
        if is_covariance_px2(&self.covariance_px2) {
            return known_at_best([uu, 0.5 * (uv + vu), vv], LEAST_SIGMA_PX);
        }
        let own = self.sigma_px.powi(2);
        let stated = [uu, vv].into_iter().filter(|variance| variance.is_finite()).fold(LEAST_SIGMA_PX.powi(2), f64::max);
        let variance = if own < stated { stated } else { own };
        [variance, 0.0, variance]
    }

    /// Standard deviation of the centre along a direction of any length.
    #[must_use]
    pub fn sigma_along_px(&self, direction: DVec2) -> f64 {
        let ([uu, uv, vv], along) = (self.noise_px2(), direction.normalize_or_zero());
        (uu * along.x * along.x + 2.0 * uv * along.x * along.y + vv * along.y * along.y).max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shadow(sigma_px: f64, covariance_px2: [[f64; 2]; 2]) -> Detection {
        Detection { sigma_px, covariance_px2, ..Detection::default() }
    }

    #[test]
    fn a_covariance_that_is_stated_counts_and_without_one_sigma_does() {
        let stated = shadow(9.0, [[0.04, 0.01], [0.01, 0.09]]);
        assert_eq!((stated.noise_px2(), stated.misstates_covariance()), ([0.04, 0.01, 0.09], false));
        let plain = shadow(0.1, [[0.0; 2]; 2]);
        assert_eq!((plain.noise_px2(), plain.misstates_covariance()), ([0.1f64.powi(2), 0.0, 0.1f64.powi(2)], false));
    }

    /// Replaced by σ without a word: by a small σ where what was stated is large, and by 0.003 px where σ was no number.
    #[test]
    fn a_covariance_that_is_none_is_told_and_promises_nothing() {
        let none = [[[4.0, 3.0], [3.0, 1.0]], [[4.0, 0.0], [0.0, -1.0]], [[4.0, 0.5], [0.1, 1.0]], [[4.0, f64::NAN], [0.0, 1.0]]];
        for covariance_px2 in none {
            let shadow = shadow(0.1, covariance_px2);
            assert!(shadow.misstates_covariance(), "{covariance_px2:?}");
            assert_eq!(shadow.noise_px2(), [4.0, 0.0, 4.0], "{covariance_px2:?}");
        }
        assert!(shadow(0.1, [[f64::INFINITY, 0.0], [0.0, 1.0]]).misstates_covariance());
        assert!(shadow(f64::NAN, [[0.0; 2]; 2]).noise_px2()[0].is_nan(), "no number is no σ");
    }
}

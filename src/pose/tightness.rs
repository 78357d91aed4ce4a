//! How well beads keep their places, by what their shadows leave between them and the pose. A layout that states no deviation is taken to be
//! good to a tenth of a millimetre, and may be far better: then a body that has moved by less than that shows.

use super::record::Pose;
use crate::beads::{BeadLayout, DEFAULT_SIGMA_MM};

/// The variance that residuals have, over that which is taken for them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tightness {
    pub variance: f64,
    /// Degrees of freedom that it is estimated from, > 0.
    freedom: f64,
}

impl Tightness {
    /// Of the beads that each of `poses` rests on, of which `solved` parameters besides the six of each are free; `None` where the layout
    /// states how well a place is known, or too few beads are there to tell.
    pub fn of(layout: &BeadLayout, poses: [&Pose; 2], solved: usize) -> Option<Self> {
        if layout.beads.iter().any(|bead| bead.sigma_mm.is_some() || bead.covariance_mm2.is_some()) {
            return None;
        }
        let (mut sum, mut freedom) = (0.0, -(solved as f64));
        for pose in poses {
            let (intrinsics, camera_from_body) = pose.camera()?;
            freedom -= 6.0;
            for bead in pose.beads.iter().filter(|bead| bead.used) {
                let ([du, dv], sigma_px) = (bead.residual_px?, bead.sigma_px?);
                let place_px = DEFAULT_SIGMA_MM * intrinsics.fx / camera_from_body.transform_point(bead.lps_mm).z;
                sum += (du * du + dv * dv) / (sigma_px * sigma_px + place_px * place_px);
                freedom += 2.0;
            }
        }
        (freedom > 0.0 && sum.is_finite()).then(|| Self { variance: (sum / freedom).max(f64::MIN_POSITIVE), freedom })
    }

    /// Chance that bodies which have not moved lie apart by this χ² of six degrees of freedom, counted in the variance that residuals have:
    /// the distribution of a sixth of it is Fisher's F with 6 and `freedom` degrees.
    pub fn chance(&self, chi2: f64) -> f64 {
        let (half, x) = (0.5 * self.freedom, self.freedom / (self.freedom + chi2));
        // The incomplete beta function whose second parameter is three.
        x.powf(half) * (1.0 + half * (1.0 - x) * (1.0 + 0.5 * (half + 1.0) * (1.0 - x)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chances_are_those_of_tables() {
        let chance = |freedom: f64, f: f64| Tightness { variance: 1.0, freedom }.chance(6.0 * f);
        // Upper points of F with six and so many degrees of freedom.
        for (freedom, f, table) in [(2.0, 19.330, 0.05), (4.0, 15.207, 0.01), (12.0, 2.996, 0.05), (20.0, 3.871, 0.01)] {
            assert!((chance(freedom, f) / table - 1.0).abs() < 2e-3, "{freedom}: {}", chance(freedom, f));
        }
        // Of many, χ² itself: 22.458 is exceeded by one in a thousand.
        assert!((chance(1e6, 22.458 / 6.0) / 1e-3 - 1.0).abs() < 2e-3);
        assert_eq!(Tightness { variance: 0.01, freedom: 8.0 }.chance(0.0), 1.0);
    }
}

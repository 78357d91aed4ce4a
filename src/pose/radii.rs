//! The size of shadows against what the beads' radii make it at their depth: the same pose of a larger layout is farther away. One rule
//! for a match that the radii have led and for one that they were left out of.

use crate::beads::Detection;
use crate::estimate::median;

/// Relative differences of the radius from which on it is said, and refused, where nothing hides any.
const OTHER_RADIUS: (f64, f64) = (0.10, 0.15);
/// Radii of few pixels are measured worse: so much more by the square of the radius, px².
const SMALL_RADIUS_PX2: f64 = 0.3;
/// Standard deviation of a median over the median deviation from it and the root of the number, and how many of these radii may be off by.
const SIGMA_OF_MEDIAN: f64 = 1.86;
const RADIUS_SIGMAS: f64 = 2.0;
/// Radii whose logarithm may be off by more than this tell as good as nothing: a factor of 1.25.
const UNKNOWN: f64 = 0.223;
/// Fewer say nothing.
const FEWEST: usize = 4;

/// A shadow and its bead.
#[derive(Clone, Copy, Debug)]
pub(super) struct SizedShadow {
    /// Fitted over stated radius.
    ratio: f64,
    /// What the radius should be.
    expected_px: f64,
    /// By how much the logarithm of the fitted one may be off for what it states of itself.
    hidden: f64,
}

impl SizedShadow {
    pub fn new(shadow: &Detection, expected_px: f64) -> Self {
        Self { ratio: shadow.radius_px / expected_px, expected_px, hidden: shadow.radius_slack_ln(0.0) }
    }
}

/// How large the shadows of matched beads are.
#[derive(Clone, Copy, Debug)]
pub(super) struct RadiusRatio {
    /// Fitted over stated radius, the median.
    pub ratio: f64,
    /// Its standard deviation by the scatter of the beads.
    sigma: f64,
    /// By how much its logarithm may be off for what the radii state of themselves: blur hides the same of all of them.
    pub hidden: f64,
    /// What the radius of that bead should be.
    expected_px: f64,
}

impl RadiusRatio {
    /// `None` where fewer than four radii are known.
    pub fn of(mut shadows: Vec<SizedShadow>) -> Option<Self> {
        if shadows.len() < FEWEST {
            return None;
        }
        shadows.sort_by(|a, b| a.ratio.total_cmp(&b.ratio));
        let SizedShadow { ratio, expected_px, .. } = shadows[shadows.len() / 2];
        let off = median(shadows.iter().map(|other| (other.ratio - ratio).abs()))?;
        let sigma = SIGMA_OF_MEDIAN * off / (shadows.len() as f64).sqrt();
        Some(Self { ratio, sigma, hidden: median(shadows.iter().map(|shadow| shadow.hidden))?, expected_px })
    }

    /// Whether they are another size that a person should look at.
    pub fn is_doubtful(self) -> bool {
        !(self.ratio.ln().abs() <= self.gate(OTHER_RADIUS.0))
    }

    /// Whether they contradict the beads' radii. Radii that scatter are a doubt, and no contradiction.
    pub fn is_contradicting(self) -> bool {
        !(self.ratio.ln().abs() <= self.gate(OTHER_RADIUS.1) + RADIUS_SIGMAS * self.sigma / self.ratio)
    }

    /// Whether blur may be all that is wrong with them.
    pub fn is_hidden(self) -> bool {
        !self.is_contradicting() && self.hidden > UNKNOWN
    }

    /// By how much the logarithm may be off, of a size that is off by `share`.
    fn gate(self, share: f64) -> f64 {
        let share = share + SMALL_RADIUS_PX2 / self.expected_px.powi(2);
        // What blur hides is a factor: of shadows that are too small it is more than their share.
        let known = if self.ratio < 1.0 { -(1.0 - share).max(0.1).ln() } else { share.ln_1p() };
        known.hypot(self.hidden)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alike(ratio: f64, hidden: f64) -> RadiusRatio {
        RadiusRatio::of(vec![SizedShadow { ratio, expected_px: 6.0, hidden }; 5]).expect("enough")
    }

    /// Of a match that radii were left out of, shadows of six tenths counted as hidden by blur that a match led by them was refused under.
    #[test]
    fn blur_hides_no_more_of_radii_that_were_left_out() {
        let told = |ratio: f64, hidden: f64| {
            let radii = alike(ratio, hidden);
            [radii.is_doubtful(), radii.is_contradicting(), radii.is_hidden()]
        };
        assert_eq!(told(0.6, 0.4), [true, true, false]);
        assert_eq!(told(0.7, 0.4), [false, false, true]);
        assert_eq!(told(0.87, 0.04), [true, false, false], "clear shadows, of 13 % less");
        assert_eq!(told(0.8, 0.04), [true, true, false]);
        assert_eq!(told(1.0, 0.04), [false, false, false]);
        assert_eq!(told(f64::NAN, 0.4), [true, true, false]);
    }

    #[test]
    fn radii_that_scatter_contradict_nothing_and_few_say_nothing() {
        let of = |ratios: &[f64]| {
            RadiusRatio::of(ratios.iter().map(|ratio| SizedShadow { ratio: *ratio, expected_px: 6.0, hidden: 0.04 }).collect())
        };
        let scattered = of(&[0.5, 0.6, 0.75, 1.0, 1.2]).expect("enough");
        assert!(scattered.is_doubtful() && !scattered.is_contradicting(), "{scattered:?}");
        assert!(alike(scattered.ratio, 0.04).is_contradicting(), "the control");
        assert!(of(&[0.5, 0.5, 0.5]).is_none());
    }
}

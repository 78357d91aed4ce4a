//! The straight line through weighted points.

/// Of the spread of the places, the share that rounding leaves where they are all one.
const ROUNDING: f64 = 1e-24;

/// `value = intercept + slope · place`, by weighted least squares.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// The value at place 0.
    pub intercept: f64,
    /// By how much the value changes from a place to the next unit of it.
    pub slope: f64,
    /// Of intercept and slope, where the weights are inverse variances.
    pub covariance: [[f64; 2]; 2],
    /// Σ weight · residual².
    pub chi2: f64,
}

impl Line {
    /// Through points of a place, a value and a weight. `None` where they do not determine it: fewer than two places, no weight, or a number
    /// that is none.
    pub fn through(points: impl Iterator<Item = [f64; 3]> + Clone) -> Option<Self> {
        let mut sums = [0.0f64; 3];
        for [x, y, weight] in points.clone() {
            sums.iter_mut().zip([1.0, x, y]).for_each(|(sum, term)| *sum += weight * term);
        }
        // About the centre of gravity the normal equations part: slope and the value there are independent.
        let [weights, x, y] = sums;
        let (mean_x, mean_y) = (x / weights, y / weights);
        let (mut squares, mut along, mut spread) = (0.0, 0.0, 0.0);
        for [x, y, weight] in points.clone() {
            squares += weight * x * x;
            spread += weight * (x - mean_x).powi(2);
            along += weight * (x - mean_x) * (y - mean_y);
        }
        if !(weights > 0.0 && spread > ROUNDING * squares) {
            return None;
        }
        let slope = along / spread;
        let intercept = mean_y - slope * mean_x;
        let both = -mean_x / spread;
        let covariance = [[1.0 / weights + mean_x * mean_x / spread, both], [both, 1.0 / spread]];
        let chi2 = points.map(|[x, y, weight]| weight * (y - intercept - slope * x).powi(2)).sum::<f64>();
        let numbers = [intercept, slope, chi2, covariance[0][0], both, covariance[1][1]];
        numbers.iter().all(|number| number.is_finite()).then_some(Self { intercept, slope, covariance, chi2 })
    }

    /// Standard deviation of the intercept, where the weights are inverse variances.
    #[must_use]
    pub fn intercept_sigma(&self) -> f64 {
        self.covariance[0][0].sqrt()
    }

    /// Standard deviation of the slope, where the weights are inverse variances.
    #[must_use]
    pub fn slope_sigma(&self) -> f64 {
        self.covariance[1][1].sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Σw = 4, Σwx = 4, Σwxx = 6, Σwy = 6, Σwxy = 7, so that the determinant is 8, the slope 4 / 8 and the intercept 8 / 8.
    #[test]
    fn a_line_is_that_of_the_normal_equations() {
        let points = [[0.0, 1.0, 1.0], [1.0, 1.5, 2.0], [2.0, 2.0, 1.0]];
        let line = Line::through(points.into_iter()).expect("three places");
        assert_eq!((line.intercept, line.slope, line.chi2), (1.0, 0.5, 0.0));
        assert_eq!(line.covariance, [[0.75, -0.5], [-0.5, 0.5]]);
        assert_eq!((line.intercept_sigma(), line.slope_sigma()), (0.75f64.sqrt(), 0.5f64.sqrt()));
        // The middle point a unit higher draws the line half as far, and leaves 2 · ½² and twice ½².
        let raised = Line::through([[0.0, 1.0, 1.0], [1.0, 2.5, 2.0], [2.0, 2.0, 1.0]].into_iter()).expect("three places");
        assert_eq!((raised.intercept, raised.slope, raised.chi2), (1.5, 0.5, 1.0));
    }

    /// Far from 0 the sums of squares differ by less than their rounding.
    #[test]
    fn places_far_from_zero_determine_it_as_well() {
        let far = 1e9;
        let line = Line::through((0..5).map(|n| [far + f64::from(n), 3.0 + 2.0 * f64::from(n), 1.0])).expect("five places");
        assert!((line.slope - 2.0).abs() < 1e-9 && (line.slope_sigma() - 0.1f64.sqrt()).abs() < 1e-9, "{line:?}");
    }

    #[test]
    fn what_does_not_determine_it_gives_none() {
        let through = |points: &[[f64; 3]]| Line::through(points.iter().copied());
        let sound = [[1.0, 2.0, 1.0], [3.0, 4.0, 1.0], [5.0, 7.0, 1.0]];
        assert!(through(&sound).is_some(), "the control");
        assert_eq!(through(&[]), None);
        assert_eq!(through(&sound[..1]), None);
        assert_eq!(through(&[[0.1, 1.0, 0.3], [0.1, 2.0, 0.7], [0.1, 4.0, 0.9]]), None, "one place");
        assert_eq!(through(&[[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]]), None, "no weight");
        let mut cases = 0;
        for at in 0..3 {
            for wrong in [f64::NAN, f64::INFINITY] {
                let mut points = sound;
                points[1][at] = wrong;
                assert_eq!(through(&points), None, "{wrong} at {at}");
                cases += 1;
            }
        }
        assert_eq!(cases, 6);
    }
}

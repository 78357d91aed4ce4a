//! How far joints moved in a span, apart from what their encoders' noise makes of a joint that stands still.

use crate::units::wrap_rad;

/// What a joint measures.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Measure {
    Millimetres,
    Radians,
}
use Measure::{Millimetres, Radians};

/// Of the C-arm: see [`crate::geometry::CarmJoints::to_array`].
const ARM: [Measure; 7] = [Millimetres, Radians, Millimetres, Radians, Radians, Radians, Millimetres];
/// The range of ten to sixty readings of a joint that stands still is 3 to 4.7 of their standard deviations, now and then 6.
const RANGE_OF_NOISE: f64 = 6.0;
/// No encoder is so noisy, in mm and rad: what shakes more is shaken.
const MOST_NOISE: [f64; 2] = [0.5, 0.25 * std::f64::consts::PI / 180.0];
/// With fewer second differences than this the noise is not known, and counts as none.
const FEWEST_BENDS: u32 = 4;

/// One joint, from where it was at first.
#[derive(Clone, Copy, Debug, Default)]
struct Joint {
    low: f64,
    high: f64,
    /// The last two readings.
    last: [f64; 2],
    /// Sum of squares of the second differences, which steady motion leaves at zero.
    bends: f64,
}

/// All joints of a device.
#[derive(Clone, Debug)]
pub(super) struct Travel<const N: usize> {
    measures: [Measure; N],
    first: [f64; N],
    joints: [Joint; N],
    readings: u32,
}

impl Travel<7> {
    /// Of the C-arm's joints, from its first reading.
    pub(super) fn of_arm(first: [f64; 7]) -> Self {
        Self::new(ARM, first)
    }
}

impl<const N: usize> Travel<N> {
    /// Of joints that are angles, rad.
    pub(super) fn of_angles(first: [f64; N]) -> Self {
        Self::new([Radians; N], first)
    }

    fn new(measures: [Measure; N], first: [f64; N]) -> Self {
        Self { measures, first, joints: [Joint::default(); N], readings: 0 }
    }

    pub(super) fn push(&mut self, readings: [f64; N]) {
        self.readings = self.readings.saturating_add(1);
        for (n, (joint, reading)) in self.joints.iter_mut().zip(readings).enumerate() {
            let moved = reading - self.first[n];
            let moved = if self.measures[n] == Radians { wrap_rad(moved) } else { moved };
            // A reading that is missing leaves the range as it is.
            joint.low = joint.low.min(moved);
            joint.high = joint.high.max(moved);
            let [before, last] = joint.last;
            if self.readings >= 3 && moved.is_finite() {
                joint.bends += (moved - 2.0 * last + before).powi(2);
            }
            if moved.is_finite() {
                joint.last = [last, moved];
            }
        }
    }

    /// How far each joint moved, less what noise alone would make of it; NaN for joints without an encoder.
    pub(super) fn range(&self) -> [f64; N] {
        let bends = self.readings.saturating_sub(2);
        std::array::from_fn(|n| {
            let Joint { low, high, bends: sum, .. } = self.joints[n];
            // White noise of σ has second differences of 6 σ².
            let sigma = if bends >= FEWEST_BENDS { (sum / (6.0 * f64::from(bends))).sqrt() } else { 0.0 };
            let sigma = sigma.min(MOST_NOISE[usize::from(self.measures[n] == Radians)]);
            if self.first[n].is_nan() { f64::NAN } else { (high - low - RANGE_OF_NOISE * sigma).max(0.0) }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    /// The largest travel of `n` readings, noise of `sigma` on a joint that moves steadily by `moves` in all; 200 draws.
    fn largest(n: usize, sigma: f64, moves: f64) -> [f64; 2] {
        let mut random = Stream::new(11, 0, 0, Purpose::Evaluation);
        let draws = (0..200).map(|_| {
            let mut readings = (0..n).map(|k| moves * k as f64 / (n - 1) as f64 + sigma * random.normal());
            let first = readings.next().unwrap_or(0.0);
            let mut travel = Travel::of_arm([first; 7]);
            std::iter::once(first).chain(readings).for_each(|reading| travel.push([reading; 7]));
            travel.range()[0]
        });
        draws.fold([f64::INFINITY, 0.0], |[low, high], range| [low.min(range), high.max(range)])
    }

    #[test]
    fn noise_of_an_encoder_is_no_motion_and_motion_stays_one() {
        for n in [9, 16, 60] {
            let [_, still] = largest(n, 0.3, 0.0);
            assert!(still < 0.5, "{n} readings of a joint that stands still: {still}");
            let [moved, _] = largest(n, 0.1, 3.0);
            assert!(moved > 1.0, "{n} readings over 3 mm: {moved}");
        }
        assert!(largest(3, 0.0, 2.0)[0] > 1.99, "few readings count as they are");
    }

    #[test]
    fn what_shakes_more_than_any_encoder_is_motion() {
        let swing = |amplitude: f64| {
            let mut travel = Travel::of_arm([0.0; 7]);
            (0..10).for_each(|k| travel.push([amplitude * f64::from(1 - 2 * (k % 2)); 7]));
            travel.range()
        };
        assert!(swing(3.0_f64.to_radians())[4] > 4.0_f64.to_radians() && swing(5.0)[0] > 6.0, "{:?}", swing(5.0));
        assert!(swing(0.1_f64.to_radians())[4] == 0.0 && swing(0.3)[0] == 0.0);
    }

    #[test]
    fn a_joint_without_an_encoder_has_no_travel_and_a_missing_reading_no_effect() {
        let mut travel = Travel::of_arm([0.0, f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0]);
        for k in 0..10 {
            let reading = if k == 4 { f64::NAN } else { f64::from(k) };
            travel.push([reading, f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0]);
        }
        let range = travel.range();
        assert!(range[1].is_nan() && range[2] == 0.0 && range[0] > 5.0, "{range:?}");
    }
}

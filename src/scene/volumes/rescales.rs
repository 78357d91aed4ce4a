//! Whether the rescale of one slice of a series fits those of the others.

use std::collections::BTreeMap;

use super::head::Remark;

/// How one slice was rescaled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rescaled {
    pub slope: f64,
    pub intercept: f64,
    /// Mean of what is stored, without padding; NaN where all is padding.
    pub stored_mean: f64,
}

/// A slice and its neighbours differ by less in an ordinary CT, and nothing is said below.
const JUMP_HU: f64 = 100.0;

impl Rescaled {
    fn mean_hu(&self, by: &Self) -> f64 {
        self.stored_mean * by.slope + by.intercept
    }

    fn key(&self) -> (u64, u64) {
        (self.slope.to_bits(), self.intercept.to_bits())
    }
}

/// What to say where slices, in order, have another rescale than most, and would lie closer to their neighbours with that of most. A scanner
/// that stores one slice otherwise than another rescales it otherwise, too, and the values then go on; nothing is said where no rescale is
/// that of most.
pub(super) fn jumps(slices: &[Rescaled]) -> Option<Remark> {
    let mut counts: BTreeMap<(u64, u64), usize> = BTreeMap::new();
    slices.iter().for_each(|slice| *counts.entry(slice.key()).or_default() += 1);
    let (key, count) = counts.into_iter().max_by_key(|(_, count)| *count)?;
    if count * 2 <= slices.len() {
        return None;
    }
    let usual = slices.iter().find(|slice| slice.key() == key)?;
    let is_usual = |slice: &&Rescaled| slice.key() == key;
    let jumps = |at: usize| {
        let slice = &slices[at];
        let near: Vec<f64> = [slices[..at].iter().rev().find(is_usual), slices[at + 1..].iter().find(is_usual)]
            .into_iter()
            .flatten()
            .map(|slice| slice.mean_hu(slice))
            .collect();
        let expected = near.iter().sum::<f64>() / near.len() as f64;
        let (own, alike) = (slice.mean_hu(slice), slice.mean_hu(usual));
        (own - alike).abs() > JUMP_HU && (own - expected).abs() > (alike - expected).abs()
    };
    let odd: Vec<usize> = (0..slices.len()).filter(|at| slices[*at].key() != key).filter(|at| jumps(*at)).collect();
    let first = &slices[*odd.first()?];
    let words = format!(
        "{} of {} slices jump from their neighbours by their rescale, slice {} first (slope {} and intercept {}, {} and {} in most), and \
         fit with that of most: is it wrong? Export the series again",
        odd.len(),
        slices.len(),
        odd[0] + 1,
        first.slope,
        first.intercept,
        usual.slope,
        usual.intercept
    );
    Some((Some("rescale".to_owned()), words))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slice(slope: f64, intercept: f64, stored_mean: f64) -> Rescaled {
        Rescaled { slope, intercept, stored_mean }
    }

    #[test]
    fn a_rescale_that_makes_a_slice_jump_is_said_and_one_that_keeps_it_is_not() {
        let usual: Vec<Rescaled> = (0..9).map(|k| slice(1.0, -1024.0, 500.0 + 20.0 * f64::from(k))).collect();
        let said = |at: usize, other: Rescaled| {
            let mut slices = usual.clone();
            slices[at] = other;
            jumps(&slices).map(|(_, words)| words).unwrap_or_default()
        };
        assert_eq!(jumps(&usual), None, "the control");
        assert_eq!(jumps(&[]), None);
        assert_eq!(said(3, slice(0.5, -1024.0, 1120.0)), "", "twice the values at half the slope");
        assert_eq!(said(3, slice(1.0, 0.0, -464.0)), "", "stored with a sign");
        assert_eq!(said(3, slice(1.0, 0.0, f64::NAN)), "", "nothing but padding");
        // A slope for each slice, as positron emission has it.
        let own: Vec<Rescaled> = (0..9).map(|k| slice(1.0 + 0.1 * f64::from(k), 0.0, 500.0)).collect();
        assert_eq!(jumps(&own), None);
        for (at, other) in [(3, slice(1.0, 0.0, 560.0)), (0, slice(-1.0, -1024.0, 500.0)), (8, slice(2.0, -1024.0, 660.0))] {
            let words = said(at, other);
            assert!(words.contains("1 of 9 slices jump") && words.contains(&format!("slice {} first", at + 1)), "{words}");
        }
    }
}

//! How far a replayed DRR is from the one in the log.

use crate::image::Image;

/// A DRR that is not the one in the log.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct ImageDifference {
    /// Of the frame.
    pub number: u32,
    /// Largest difference in nepers; `None` (JSON null) where it is not finite: another size, NaN on one side, or not in the log.
    pub largest_nepers: Option<f64>,
    /// Bound that the plan states.
    pub bound: f64,
    /// What is wrong besides the difference.
    pub detail: Option<String>,
}

/// Largest difference between two images, and what else is wrong. Where only one is NaN, or the sizes differ, there is no largest.
pub(super) fn difference(then: &Image<f32>, now: Option<&Image<f32>>) -> (Option<f64>, Option<String>) {
    let Some(now) = now else { return (None, Some("the DRR of this replay cannot be read back".to_owned())) };
    if [then.width, then.height] != [now.width, now.height] {
        let detail = format!("{}x{} px in the log, {}x{} px now", then.width, then.height, now.width, now.height);
        return (None, Some(detail));
    }
    let apart = |a: f32, b: f32| if a == b || (a.is_nan() && b.is_nan()) { 0.0 } else { f64::from(a) - f64::from(b) };
    let pairs = then.pixels.iter().zip(&now.pixels).map(|(a, b)| apart(*a, *b).abs());
    let (mut largest, mut not_finite) = (0.0f64, 0usize);
    for difference in pairs {
        if difference.is_finite() {
            largest = largest.max(difference);
        } else {
            not_finite += 1;
        }
    }
    match not_finite {
        0 => (Some(largest), None),
        count => {
            (None, Some(format!("{count} pixels are not finite in one of them; the others differ by at most {largest:.3e}")))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(pixels: &[f32]) -> Image<f32> {
        Image { width: pixels.len(), height: 1, pixels: pixels.to_vec() }
    }

    /// A DRR with 195 703 NaN was "largest difference 0.000e0": `max` passes over NaN.
    #[test]
    fn nan_on_one_side_is_a_difference_and_on_both_none() {
        let then = image(&[1.0, f32::NAN, 2.0]);
        assert_eq!(difference(&then, Some(&then)), (Some(0.0), None));
        let (largest, detail) = difference(&then, Some(&image(&[1.0, 1.0, 2.0])));
        assert!(largest.is_none() && detail.is_some_and(|words| words.starts_with("1 pixels")));
        assert_eq!(difference(&then, Some(&image(&[1.0, f32::NAN, 2.5]))).0, Some(0.5));
        assert!(difference(&then, Some(&image(&[1.0]))).0.is_none());
        assert!(difference(&image(&[f32::INFINITY]), Some(&image(&[f32::INFINITY]))).0 == Some(0.0));
    }
}

//! What the collimator shuts off, as eyes see it. The logarithm of its noise would draw every look: it is calm, dim and tinted, and so little
//! that what a field taken for too small hides is still seen.

use std::borrow::Cow;

use super::canvas::Rgb;
use crate::image::{Image, block_means};

/// Added to what is left of the picture.
const TINT: Rgb = [26, 12, 36];
/// Share of the picture that is left.
const LEFT: f32 = 0.25;
/// Side of the blocks over which noise is averaged.
const BLOCK_PX: usize = 8;

/// `values` (larger is more attenuation) as they are shown between the ends of `window`: means of blocks where they are `shut_off`. What has no
/// value there is no light, and counts as the upper end.
#[must_use]
pub fn calm<'a>(values: &'a Image<f32>, shut_off: &Image<bool>, window: [f64; 2]) -> Cow<'a, Image<f32>> {
    if !(values.same_size(shut_off) && shut_off.pixels.contains(&true)) {
        return Cow::Borrowed(values);
    }
    let [low, high] = window.map(|end| end as f32);
    let within = values.map(|value| if value.is_finite() { value.max(low).min(high) } else { high });
    let (means, _) = block_means(&within, shut_off, BLOCK_PX);
    let mut shown = values.clone();
    for (at, pixel) in shown.pixels.iter_mut().enumerate().filter(|(at, _)| shut_off.pixels[*at]) {
        let (column, row) = (at % values.width / BLOCK_PX, at / values.width / BLOCK_PX);
        let mean = *means.at(column.min(means.width - 1), row.min(means.height - 1));
        // A block that lies mostly in the open field has none.
        *pixel = if mean.is_finite() { mean } else { within.pixels[at] };
    }
    Cow::Owned(shown)
}

/// A colour of the picture where `share`, 0 to 1, of it is shut off.
#[must_use]
pub fn dimmed(colour: Rgb, share: f32) -> Rgb {
    std::array::from_fn(|channel| {
        let shown = f32::from(colour[channel]);
        let shut = LEFT * shown + f32::from(TINT[channel]);
        (shown + share.clamp(0.0, 1.0) * (shut - shown)).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_that_is_shut_off_is_calm_and_the_open_field_stays() {
        // A ramp, and from column 35 on what noise about zero is in nepers: far too much, far too little, or nothing.
        let noise = [-5.0, 9.0, f32::NAN];
        let value = |at: usize| if at % 64 < 35 { 0.05 * (at % 64) as f32 } else { noise[at % 3] };
        let values = Image { width: 64, height: 33, pixels: (0..64 * 33).map(value).collect() };
        let shut_off = Image { width: 64, height: 33, pixels: (0..64 * 33).map(|at| at % 64 >= 35).collect() };
        let window = [0.0, 3.0];
        let seen = calm(&values, &shut_off, window);
        let spread = |image: &Image<f32>| {
            let shut = image.pixels.iter().zip(&shut_off.pixels).filter(|(value, shut)| **shut && value.is_finite());
            let (low, high) = shut.fold((f32::MAX, f32::MIN), |(low, high), (value, _)| (low.min(*value), high.max(*value)));
            high - low
        };
        assert!(spread(&values) > 10.0 && spread(&seen) < 0.3, "{} of {}", spread(&seen), spread(&values));
        assert!(seen.pixels.iter().all(|value| value.is_finite()));
        let mut open = (0..values.pixels.len()).filter(|at| !shut_off.pixels[*at]);
        assert!(open.all(|at| seen.pixels[at].to_bits() == values.pixels[at].to_bits()));
        // Where nothing is shut off nothing is changed.
        assert!(matches!(calm(&values, &shut_off.map(|_| false), window), Cow::Borrowed(_)));
    }

    #[test]
    fn what_is_shut_off_is_dim_and_tinted_and_still_seen() {
        let [black, white] = [[10; 3], [250; 3]].map(|gray: Rgb| dimmed(gray, 1.0));
        assert!(white[0] < 100 && white[2] > white[1] + 15, "{white:?}");
        assert!(white[0] > black[0] + 40, "{black:?} {white:?}");
        assert_eq!(dimmed([250, 3, 90], 0.0), [250, 3, 90]);
        let half = dimmed([250; 3], 0.5);
        assert!(white[0] + 60 < half[0] && half[0] < 200, "{half:?}");
    }
}

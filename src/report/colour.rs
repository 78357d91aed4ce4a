//! Colours of pictures: the theme, a perceptual diverging map, robust windows.

use std::sync::OnceLock;

use super::canvas::Rgb;
use crate::image::Image;

/// Page.
pub const BACKGROUND: Rgb = [0x0f, 0x12, 0x16];
/// Behind pictures, and where a picture has no value.
pub const WELL: Rgb = [0x17, 0x1b, 0x21];
/// Thin frames.
pub const LINE: Rgb = [0x2b, 0x32, 0x3b];
/// Words.
pub const TEXT: Rgb = [0xe7, 0xec, 0xf1];
/// Lesser words.
pub const DIM: Rgb = [0x97, 0xa3, 0xb0];
/// Accepted.
pub const GOOD: Rgb = [0x4c, 0xc3, 0x8a];
/// Refused.
pub const BAD: Rgb = [0xf0, 0x6a, 0x5f];
/// Falls back, or has no pose.
pub const CAUTION: Rgb = [0xf2, 0xb8, 0x4b];
/// Edges of the simulation.
pub const EDGE: Rgb = [0x3f, 0xe0, 0xd0];

/// Control points in OKLab (L, a, b) from −1 to 1: blue, dark neutral, orange. Lightness rises evenly to both sides, so that equal
/// steps look equal and the sign is told by hue alone.
const DIVERGING: [[f32; 3]; 5] =
    [[0.86, -0.065, -0.075], [0.58, -0.045, -0.125], [0.24, 0.0, -0.004], [0.62, 0.095, 0.105], [0.89, 0.012, 0.125]];

/// The diverging map at `value` in −1..=1; beyond is clipped, NaN is the well.
#[must_use]
pub fn diverging(value: f32) -> Rgb {
    if value.is_nan() {
        return WELL;
    }
    static STEPS: OnceLock<Vec<Rgb>> = OnceLock::new();
    let steps = STEPS.get_or_init(|| (0..=2 * STEPS_EACH_WAY).map(|step| between(step as f32 / STEPS_EACH_WAY as f32)).collect());
    steps[((value.clamp(-1.0, 1.0) + 1.0) * STEPS_EACH_WAY as f32).round() as usize]
}

/// Steps of the map to either side: from one to the next no channel changes by more than two levels.
const STEPS_EACH_WAY: usize = 1024;

/// The map at `value` in 0..=2, between its control points.
fn between(value: f32) -> Rgb {
    let at = 2.0 * value;
    let lower = (at as usize).min(3);
    let fraction = at - lower as f32;
    let lab: [f32; 3] = std::array::from_fn(|i| DIVERGING[lower][i] + (DIVERGING[lower + 1][i] - DIVERGING[lower][i]) * fraction);
    srgb_from_oklab(lab)
}

/// OKLab to 8-bit sRGB (B. Ottosson, 2020).
fn srgb_from_oklab([lightness, a, b]: [f32; 3]) -> Rgb {
    let l = (lightness + 0.396_337_78 * a + 0.215_803_76 * b).powi(3);
    let m = (lightness - 0.105_561_346 * a - 0.063_854_17 * b).powi(3);
    let s = (lightness - 0.089_484_18 * a - 1.291_485_5 * b).powi(3);
    let linear = [
        4.076_741_7 * l - 3.307_711_6 * m + 0.230_969_94 * s,
        -1.268_438 * l + 2.609_757_4 * m - 0.341_319_38 * s,
        -0.004_196_086_3 * l - 0.703_418_6 * m + 1.707_614_7 * s,
    ];
    linear.map(|c| {
        let c = c.clamp(0.0, 1.0);
        let encoded = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
        (255.0 * encoded).round() as u8
    })
}

/// Gray of `value` within `window` (low, high); NaN is the well.
#[must_use]
pub fn gray(value: f32, window: [f64; 2]) -> Rgb {
    if value.is_nan() {
        return WELL;
    }
    let share = ((f64::from(value) - window[0]) / (window[1] - window[0])).clamp(0.0, 1.0);
    let level = (10.0 + 240.0 * share).round() as u8;
    [level; 3]
}

/// The window from the 0.5th to the 99.5th percentile of the finite pixels of all `images` that `kept` keeps (of all where it keeps none), slightly
/// widened; a window of width 1 where there is no range.
#[must_use]
pub fn window(images: &[&Image<f32>], kept: Option<&Image<bool>>) -> [f64; 2] {
    let mut values: Vec<f32> = Vec::new();
    for image in images {
        let step = (image.pixels.len() / 200_000).max(1);
        let keeps = |at: usize| kept.is_none_or(|mask| mask.pixels.get(at).copied().unwrap_or(true));
        values.extend(
            (0..image.pixels.len()).step_by(step).filter(|&at| keeps(at)).map(|at| image.pixels[at]).filter(|v| v.is_finite()),
        );
    }
    if values.is_empty() && kept.is_some() {
        return window(images, None);
    }
    let last = (values.len().max(1) - 1) as f64;
    let mut at = |share: f64| ranked(&mut values, (last * share) as usize).unwrap_or(0.0);
    let (low, high) = (at(0.005), at(0.995));
    if high > low { [low - 0.02 * (high - low), high + 0.02 * (high - low)] } else { [low - 0.5, low + 0.5] }
}

/// The value that would stand at `place` if `values` were sorted; reorders them.
pub(super) fn ranked(values: &mut [f32], place: usize) -> Option<f64> {
    (place < values.len()).then(|| f64::from(*values.select_nth_unstable_by(place, f32::total_cmp).1))
}

/// The smallest of 1, 2, 5 × 10ⁿ that is at least `value`.
#[must_use]
pub fn round_up(value: f64) -> f64 {
    if !(value > 0.0 && value.is_finite()) {
        return 1.0;
    }
    let decade = 10f64.powf(value.log10().floor());
    [1.0, 2.0, 5.0, 10.0].map(|step| step * decade).into_iter().find(|step| *step >= value * 0.999_999).unwrap_or(10.0 * decade)
}

/// A number as short as its scale deserves, with a true minus sign.
#[must_use]
pub fn short(value: f64, scale: f64) -> String {
    let decimals = (2.0 - scale.abs().max(1e-12).log10().floor()).clamp(0.0, 6.0) as usize;
    let text = format!("{value:.decimals$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text };
    if text == "-0" { "0".into() } else { text.replace('-', "−") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_diverging_map_is_dark_in_the_middle_and_distinct_at_its_ends() {
        let light = |c: Rgb| c.iter().map(|x| u32::from(*x)).sum::<u32>();
        assert!(light(diverging(0.0)) < 150);
        assert!(light(diverging(-1.0)) > 350 && light(diverging(1.0)) > 350);
        assert!(diverging(-1.0)[2] > diverging(-1.0)[0] && diverging(1.0)[0] > diverging(1.0)[2]);
        let rising = (0..20).map(|i| light(diverging(i as f32 / 20.0))).collect::<Vec<_>>();
        assert!(rising.windows(2).all(|pair| pair[0] <= pair[1]));
        assert_eq!(diverging(f32::NAN), WELL);
        let at = |step: usize| diverging(step as f32 / STEPS_EACH_WAY as f32 - 1.0);
        let jumps = (0..2 * STEPS_EACH_WAY).flat_map(|step| (0..3).map(move |n| at(step)[n].abs_diff(at(step + 1)[n])));
        assert!(jumps.max() <= Some(2));
        assert_eq!([-1.5, -0.3, 0.0, 0.7, 2.0].map(diverging), [0.0, 0.7, 1.0, 1.7, 2.0].map(between));
    }

    #[test]
    fn numbers_are_short_and_steps_round() {
        assert_eq!(short(-0.126, 1.0), "−0.13");
        assert_eq!(short(250.0, 250.0), "250");
        assert_eq!((round_up(3.0), round_up(0.012), round_up(f64::NAN)), (5.0, 0.02, 1.0));
    }
}

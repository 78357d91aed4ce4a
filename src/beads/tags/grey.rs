//! Eight bits from pixels of any kind: what the tag decoder reads.

use crate::acquire::{Domain, Frame};
use crate::image::{Image, quantile};

/// Percentiles that become black and white.
const WINDOW: (f64, f64) = (0.002, 0.998);
/// Half the side of the square whose mean is taken off, as a share of the longer side of the frame.
const NEIGHBOURHOOD: f64 = 1.0 / 24.0;

/// The frame's values where attenuation adds up (logarithm of a linear signal), larger is more signal. NaN stays NaN.
pub fn values(frame: &Frame) -> Image<f32> {
    let Image { width, height, ref pixels } = frame.pixels;
    let pixels = match frame.domain {
        Domain::Linear => {
            // Behind the shutters an offset-corrected signal scatters about zero: what is below a thousandth of the median is black.
            let floor = quantile_of_finite(pixels, 0.5).map_or(1.0, |median| (1e-3 * median).max(f32::MIN_POSITIVE));
            pixels.iter().map(|value| if value.is_nan() { f32::NAN } else { value.max(floor).ln() }).collect()
        }
        Domain::Log => pixels.iter().map(|value| -value).collect(),
        Domain::Display | Domain::Unknown => pixels.clone(),
    };
    Image { width, height, pixels }
}

/// The window between two percentiles as 0 to 255; what is not finite is black.
pub fn windowed(values: &Image<f32>) -> Image<u8> {
    let ends = quantile_of_finite(&values.pixels, WINDOW.0).zip(quantile_of_finite(&values.pixels, WINDOW.1));
    let (low, high) = ends.filter(|(low, high)| low < high).unwrap_or((0.0, f32::INFINITY));
    // As exact integers where the values are bytes already.
    let scale = if high.is_finite() { 255.0 / (high - low) } else { 0.0 };
    let byte = |value: f32| ((value - low) * scale).clamp(0.0, 255.0).round() as u8;
    Image { width: values.width, height: values.height, pixels: values.pixels.iter().map(|value| byte(*value)).collect() }
}

/// `values` less their mean over a neighbourhood: a thin tag before a thick body uses all of the 256 steps.
pub fn flattened(values: &Image<f32>) -> Image<f32> {
    let Image { width, height, ref pixels } = *values;
    let half = ((width.max(height) as f64 * NEIGHBOURHOOD) as usize).max(12);
    // Sums over the rectangle above and left of a pixel, of values and of their count.
    let mut sums = vec![[0.0f64; 2]; (width + 1) * (height + 1)];
    for row in 0..height {
        let mut line = [0.0; 2];
        for column in 0..width {
            let value = f64::from(pixels[row * width + column]);
            if value.is_finite() {
                line[0] += value;
                line[1] += 1.0;
            }
            let above = sums[row * (width + 1) + column + 1];
            sums[(row + 1) * (width + 1) + column + 1] = [above[0] + line[0], above[1] + line[1]];
        }
    }
    let mut flat = Vec::with_capacity(pixels.len());
    for row in 0..height {
        let (top, bottom) = (row.saturating_sub(half), (row + half + 1).min(height));
        for column in 0..width {
            let (left, right) = (column.saturating_sub(half), (column + half + 1).min(width));
            let at = |row: usize, column: usize, n: usize| sums[row * (width + 1) + column][n];
            let over = |n: usize| at(bottom, right, n) - at(top, right, n) - at(bottom, left, n) + at(top, left, n);
            flat.push(pixels[row * width + column] - (over(0) / over(1).max(1.0)) as f32);
        }
    }
    Image { width, height, pixels: flat }
}

/// Black for white.
pub fn inverted(grey: &Image<u8>) -> Image<u8> {
    Image { width: grey.width, height: grey.height, pixels: grey.pixels.iter().map(|value| 255 - value).collect() }
}

/// Columns in reverse.
pub fn mirrored(grey: &Image<u8>) -> Image<u8> {
    let pixels = grey.pixels.chunks_exact(grey.width.max(1)).flat_map(|row| row.iter().rev().copied()).collect();
    Image { width: grey.width, height: grey.height, pixels }
}

/// The value below which a share of the finite ones lies; `None` when there is none.
fn quantile_of_finite(values: &[f32], share: f64) -> Option<f32> {
    let mut finite: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
    quantile(&mut finite, share).map(|value| value as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(pixels: Vec<f32>, domain: Domain) -> Frame {
        let image = Image::from_pixels(4, pixels.len() / 4, pixels).expect("four columns");
        Frame::from_pixels("made", image, domain).expect("a frame")
    }

    #[test]
    fn attenuation_is_dark_in_every_domain_and_nan_is_black() {
        let signal: Vec<f32> = (0..64).map(|n| if n % 2 == 0 { 1000.0 } else { 100.0 }).collect();
        let logs: Vec<f32> = signal.iter().map(|value| -(value / 1000.0).ln()).collect();
        let mut cases = 0;
        for (pixels, domain) in [(signal.clone(), Domain::Linear), (logs, Domain::Log), (signal, Domain::Display)] {
            let grey = windowed(&values(&frame(pixels, domain)));
            assert_eq!((grey.pixels[0], grey.pixels[1]), (255, 0), "{domain}");
            cases += 1;
        }
        assert_eq!(cases, 3);
        let mut holes = vec![5.0; 64];
        holes[0] = f32::NAN;
        holes[1] = 1.0;
        assert_eq!(windowed(&values(&frame(holes, Domain::Unknown))).pixels[0], 0);
    }

    #[test]
    fn a_ramp_is_flat_but_for_the_border() {
        let pixels: Vec<f32> = (0..100 * 100).map(|n| 3.0 * (n % 100) as f32).collect();
        let flat = flattened(&Image { width: 100, height: 100, pixels });
        assert!((20..80).all(|column| flat.pixels[50 * 100 + column].abs() < 1e-3));
        assert!(flat.pixels[50 * 100] < -10.0);
    }
}

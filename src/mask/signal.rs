//! The pixel values as a signal that grows with the X-rays that arrived, whatever the frame's domain.

use rayon::prelude::*;

use crate::image::Image;

/// Values looked at to choose the scale.
const SAMPLES: usize = 8192;
/// Pixels that a core takes at least.
const FEWEST_PX: usize = 1 << 14;
/// A frame whose attenuations span at most this much is taken to be in nepers.
const WIDEST_NEPERS: f64 = 20.0;

/// How values become signal; each is monotone, so that a shut area stays the darkest.
#[derive(Clone, Copy, Debug)]
enum Scale {
    Value,
    /// `top` − value, with `top` the largest value that the frame's words can hold, so that black is 0.
    Negated {
        top: f32,
    },
    /// exp(`least` − value): intensity, so that noise behind a blade is small again and edges are as steep as they were.
    Nepers {
        least: f32,
    },
    /// 0 where the value is the console's paint (by its bits, so that NaN can be one), 1 elsewhere.
    Unlike {
        paint: u32,
    },
}

impl Scale {
    /// The signal of a value; NaN stays NaN.
    fn signal(self, value: f32) -> f32 {
        match self {
            Scale::Value => value,
            Scale::Negated { top } => top - value,
            // A few pixels far above the open beam would otherwise outweigh all others; `clamp` keeps NaN, `min` would not.
            Scale::Nepers { least } => (least - value).exp().clamp(0.0, 2.0),
            Scale::Unlike { paint } => f32::from(u8::from(value.to_bits() != paint)),
        }
    }
}

/// A frame seen as signal.
pub(super) struct Signal<'a> {
    pub pixels: &'a Image<f32>,
    /// The finite signals of all pixels: each is looked at many times.
    values: Vec<f32>,
    scale: Scale,
    /// What is typical of the brightest and of the darkest pixels.
    pub brightest: f32,
    pub darkest: f32,
    /// Distance between neighbouring values: 1 where all are integers, else 0.
    pub resolution: f32,
}

impl<'a> Signal<'a> {
    /// `None` when too few values are finite, or all are alike.
    pub fn new(pixels: &'a Image<f32>, larger_is_more_attenuation: bool) -> Option<Self> {
        let stride = (pixels.pixels.len() / SAMPLES).max(1);
        // An even stride of an even width would look at few columns only.
        let stride = stride | 1;
        let mut seen: Vec<f32> = pixels.pixels.iter().step_by(stride).copied().filter(|value| value.is_finite()).collect();
        if seen.len() < 16 {
            return None;
        }
        seen.sort_unstable_by(f32::total_cmp);
        let quantile = |share: f64| seen[((seen.len() - 1) as f64 * share).round() as usize];
        let (least, most) = (quantile(0.005), quantile(0.995));
        let span = f64::from(most) - f64::from(least);
        if !(span > 0.0) {
            return None;
        }
        let (scale, darkest, brightest) = if !larger_is_more_attenuation {
            (Scale::Value, least, most)
        } else if span <= WIDEST_NEPERS {
            (Scale::Nepers { least }, (least - most).exp(), 1.0)
        } else {
            let top = (seen[seen.len() - 1].max(1.0).ceil() + 1.0).log2().ceil().exp2() - 1.0;
            (Scale::Negated { top }, top - most, top - least)
        };
        let of_nan = if matches!(scale, Scale::Nepers { .. }) { 0.0 } else { darkest };
        let resolution = f32::from(u8::from(seen.iter().all(|value| value.fract() == 0.0)));
        let values = values_of(pixels, |value| scale.signal(value), of_nan);
        Some(Self { pixels, values, scale, brightest, darkest, resolution })
    }

    /// The same frame as 0 where the value is `paint` and 1 elsewhere.
    pub fn unlike(&self, paint: f32) -> Self {
        let scale = Scale::Unlike { paint: paint.to_bits() };
        let values = values_of(self.pixels, |value| scale.signal(value), 1.0);
        Self { pixels: self.pixels, values, scale, brightest: 1.0, darkest: 0.0, resolution: 0.0 }
    }

    /// Whether the value is as bright as the open beam.
    pub fn is_bright(&self, value: f32) -> bool {
        self.scale.signal(value) >= self.brightest - 0.02 * (self.brightest - self.darkest)
    }

    pub fn is_paint(&self) -> bool {
        matches!(self.scale, Scale::Unlike { .. })
    }

    /// The finite signal at a pixel's index.
    pub fn at(&self, index: usize) -> f32 {
        self.values[index]
    }
}

/// Signals of all pixels, `of_nan` where there is none.
fn values_of(pixels: &Image<f32>, signal: impl Fn(f32) -> f32 + Sync, of_nan: f32) -> Vec<f32> {
    let finite = |value: &f32| Some(signal(*value)).filter(|signal| signal.is_finite()).unwrap_or(of_nan);
    pixels.pixels.par_iter().with_min_len(FEWEST_PX).map(finite).collect()
}

//! The declared tone between acquired and simulated: fitted on alternate tiles, scored on the others.

use crate::acquire::Domain;
use crate::estimate::Line;
use crate::image::{Image, quantile};

/// What may be fitted between the simulated and the acquired image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Tone {
    /// Nothing.
    #[default]
    None,
    /// One gain of the signal: an offset in nepers.
    Gain,
    /// An offset and a scale of the line integral.
    LogAffine,
    /// A monotone curve with at most five knots; display images only.
    Monotone,
}

impl Tone {
    /// The word used in files and on the command line.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Gain => "gain",
            Self::LogAffine => "log_affine",
            Self::Monotone => "monotone",
        }
    }

    /// Whether it may be fitted to frames of `domain`: gain and log-affine need values with a physical meaning, monotone forgoes them.
    #[must_use]
    pub fn is_permitted(self, domain: Domain) -> bool {
        match self {
            Self::None => true,
            Self::Gain | Self::LogAffine => !domain.is_gray(),
            Self::Monotone => domain.is_gray(),
        }
    }
}

impl std::str::FromStr for Tone {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        [Self::None, Self::Gain, Self::LogAffine, Self::Monotone]
            .into_iter()
            .find(|tone| tone.as_str() == word)
            .ok_or_else(|| format!("tone '{word}' is not one of none, gain, log_affine, monotone"))
    }
}

/// A fitted tone: maps the simulated line integral to what the acquired frame shows in the common domain.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ToneFit {
    /// What was declared.
    pub tone: Tone,
    /// Numbers that were fitted.
    pub degrees_of_freedom: usize,
    /// The curve as points (simulated nepers, common domain), straight between them and beyond the last two.
    pub curve: Vec<[f64; 2]>,
    /// Pixels that it was fitted on; 0 for `none`.
    pub fitted_pixels: usize,
    /// Other pixels, which the scores rest on.
    pub scored_pixels: usize,
    /// Side of the checkerboard's tiles in pixels.
    pub tile_px: usize,
    /// What the fit takes away from the comparison.
    pub note: Option<String>,
}

/// Most knots that a monotone tone may have.
const KNOTS: usize = 5;
/// Rounds of reweighting of the robust straight line.
const ROUNDS: usize = 8;
/// Least variance of the simulated line integrals that tells a slope, nepers².
const LEAST_SPREAD: f64 = 1e-9;

impl ToneFit {
    /// The identity.
    pub(super) fn none(scored_pixels: usize, tile_px: usize) -> Self {
        Self {
            tone: Tone::None,
            degrees_of_freedom: 0,
            curve: vec![[0.0, 0.0], [1.0, 1.0]],
            fitted_pixels: 0,
            scored_pixels,
            tile_px,
            note: None,
        }
    }

    /// The tone at a simulated line integral; NaN stays NaN.
    #[must_use]
    pub fn apply(&self, line_integral: f32) -> f32 {
        if self.tone == Tone::None {
            return line_integral;
        }
        let x = f64::from(line_integral);
        let upper = self.curve.iter().position(|knot| x < knot[0]).unwrap_or(self.curve.len()).clamp(1, self.curve.len() - 1);
        let ([x0, y0], [x1, y1]) = (self.curve[upper - 1], self.curve[upper]);
        (y0 + (x - x0) * (y1 - y0) / (x1 - x0)) as f32
    }

    /// The whole simulated image as the acquired one would show it.
    pub(super) fn apply_to(&self, simulated: &Image<f32>) -> Image<f32> {
        simulated.map(|&l| self.apply(l))
    }
}

/// Pixel (u, v) belongs to the tiles that are fitted (true) or scored (false).
pub(super) fn is_fit_tile(u: usize, v: usize, tile_px: usize) -> bool {
    (u / tile_px + v / tile_px).is_multiple_of(2)
}

/// Which of the usable pixels are scored: all without a tone, else those of the tiles it was not fitted on.
pub(super) fn scored_pixels(usable: &Image<bool>, tone: Tone, tile_px: usize) -> Image<bool> {
    let mut scored = usable.clone();
    if tone != Tone::None {
        for v in 0..usable.height {
            for u in 0..usable.width {
                *scored.at_mut(u, v) &= !is_fit_tile(u, v, tile_px);
            }
        }
    }
    scored
}

/// Fits `tone` on the usable pixels of alternate tiles. `None` when they do not determine it.
pub(super) fn fit(
    tone: Tone,
    acquired: &Image<f32>,
    simulated: &Image<f32>,
    usable: &Image<bool>,
    tile_px: usize,
) -> Option<ToneFit> {
    let total = usable.pixels.iter().filter(|u| **u).count();
    if tone == Tone::None {
        return Some(ToneFit::none(total, tile_px));
    }
    let mut pairs: Vec<[f32; 2]> = Vec::new();
    for v in 0..usable.height {
        for u in 0..usable.width {
            let at = v * usable.width + u;
            if usable.pixels[at] && is_fit_tile(u, v, tile_px) {
                pairs.push([simulated.pixels[at], acquired.pixels[at]]);
            }
        }
    }
    if pairs.len() < 50 {
        return None;
    }
    let fitted_pixels = pairs.len();
    let mut differences: Vec<f32> = pairs.iter().map(|[s, a]| a - s).collect();
    let (curve, degrees_of_freedom, note) = match tone {
        Tone::None => return None,
        Tone::Gain => {
            let offset = quantile(&mut differences, 0.5)?;
            (vec![[0.0, offset], [1.0, 1.0 + offset]], 1, None)
        }
        Tone::LogAffine => {
            let [offset, slope] = robust_line(&pairs)?;
            (
                vec![[0.0, offset], [1.0, offset + slope]],
                2,
                Some("a scale of the line integral absorbs errors of density, beam hardening and scatter"),
            )
        }
        Tone::Monotone => {
            let curve = isotonic_curve(&mut pairs)?;
            let count = curve.len();
            (curve, count, Some("a monotone curve absorbs errors of kVp, N0, beam hardening and density"))
        }
    };
    Some(ToneFit {
        tone,
        degrees_of_freedom,
        curve,
        fitted_pixels,
        scored_pixels: total - fitted_pixels,
        tile_px,
        note: note.map(str::to_owned),
    })
}

/// acquired ≈ offset + slope · simulated, iteratively reweighted with Huber's weights.
fn robust_line(pairs: &[[f32; 2]]) -> Option<[f64; 2]> {
    let mut weights = vec![1.0f64; pairs.len()];
    let mut line = [0.0, 1.0];
    for _ in 0..ROUNDS {
        let points = pairs.iter().zip(&weights).map(|([s, a], weight)| [f64::from(*s), f64::from(*a), *weight]);
        let found = Line::through(points)?;
        if !(found.covariance[1][1] * weights.iter().sum::<f64>() < 1.0 / LEAST_SPREAD) {
            return None;
        }
        line = [found.intercept, found.slope];
        let residual = |pair: &[f32; 2]| f64::from(pair[1]) - line[0] - line[1] * f64::from(pair[0]);
        let mut sizes: Vec<f32> = pairs.iter().map(|pair| residual(pair).abs() as f32).collect();
        let limit = (1.345 * 1.4826 * quantile(&mut sizes, 0.5)?).max(1e-6);
        weights.iter_mut().zip(pairs).for_each(|(weight, pair)| *weight = (limit / residual(pair).abs().max(1e-12)).min(1.0));
    }
    Some(line)
}

/// A monotone curve through knots at equal shares of the simulated values: medians of bins, made monotone by pooling adjacent
/// violators, then read at the knots. Its direction is the one that leaves the smaller residual.
fn isotonic_curve(pairs: &mut [[f32; 2]]) -> Option<Vec<[f64; 2]>> {
    const BINS: usize = 60;
    pairs.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]));
    let mut bins: Vec<[f64; 2]> = Vec::with_capacity(BINS);
    for chunk in pairs.chunks(pairs.len().div_ceil(BINS)) {
        let mut values: Vec<f32> = chunk.iter().map(|pair| pair[1]).collect();
        let x = chunk.iter().map(|pair| f64::from(pair[0])).sum::<f64>() / chunk.len() as f64;
        let y = quantile(&mut values, 0.5)?;
        match bins.last_mut() {
            // Equal simulated values (open air) make one bin.
            Some(last) if x - last[0] < 1e-6 => last[1] = 0.5 * (last[1] + y),
            _ => bins.push([x, y]),
        }
    }
    if bins.len() < 2 {
        return None;
    }
    let rising: Vec<f64> = pool(bins.iter().map(|bin| bin[1]).collect());
    let falling: Vec<f64> = pool(bins.iter().map(|bin| -bin[1]).collect()).iter().map(|y| -y).collect();
    let cost = |fitted: &[f64]| fitted.iter().zip(&bins).map(|(y, bin)| (y - bin[1]).powi(2)).sum::<f64>();
    let fitted = if cost(&rising) <= cost(&falling) { rising } else { falling };
    let knots = KNOTS.min(bins.len());
    Some(
        (0..knots)
            .map(|knot| {
                let at = knot * (bins.len() - 1) / (knots - 1);
                [bins[at][0], fitted[at]]
            })
            .collect(),
    )
}

/// The nearest rising sequence: pools adjacent violators.
fn pool(values: Vec<f64>) -> Vec<f64> {
    let mut blocks: Vec<(f64, usize)> = Vec::with_capacity(values.len());
    for value in values {
        blocks.push((value, 1));
        while let [.., (before, n_before), (last, n_last)] = blocks[..] {
            if before <= last {
                break;
            }
            let count = n_before + n_last;
            let mean = (before * n_before as f64 + last * n_last as f64) / count as f64;
            blocks.truncate(blocks.len() - 2);
            blocks.push((mean, count));
        }
    }
    blocks.into_iter().flat_map(|(value, count)| std::iter::repeat_n(value, count)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wedge() -> (Image<f32>, Image<bool>) {
        let pixels = (0..128 * 96).map(|at| (at % 128) as f32 * 0.03 + (at / 128) as f32 * 0.01).collect();
        (Image::from_pixels(128, 96, pixels).expect("size"), Image::filled(128, 96, true))
    }

    #[test]
    fn an_affine_tone_is_found_despite_a_tool() {
        let (simulated, usable) = wedge();
        let mut acquired = simulated.map(|l| 0.3 + 0.9 * l);
        for v in 40..50 {
            for u in 20..60 {
                *acquired.at_mut(u, v) += 3.0;
            }
        }
        let found = fit(Tone::LogAffine, &acquired, &simulated, &usable, 32).expect("determined");
        assert!((found.curve[0][1] - 0.3).abs() < 1e-2, "{:?}", found.curve);
        assert!((found.apply(2.0) - 2.1).abs() < 1e-2);
        assert!(found.scored_pixels + found.fitted_pixels == 128 * 96 && found.scored_pixels > 5000);
    }

    #[test]
    fn a_monotone_tone_follows_a_falling_curve_and_stays_monotone() {
        let (simulated, usable) = wedge();
        let acquired = simulated.map(|l| 200.0 * (-0.5 * l).exp());
        let found = fit(Tone::Monotone, &acquired, &simulated, &usable, 32).expect("determined");
        assert!(found.curve.len() <= 5 && found.curve.windows(2).all(|pair| pair[1][1] <= pair[0][1]));
        let worst = simulated.pixels.iter().zip(&acquired.pixels).map(|(l, a)| (found.apply(*l) - a).abs()).fold(0.0, f32::max);
        assert!(worst < 12.0, "worst {worst} of 200");
    }

    #[test]
    fn pooling_keeps_a_rising_sequence_and_repairs_others() {
        assert_eq!(pool(vec![1.0, 2.0, 3.0]), [1.0, 2.0, 3.0]);
        assert_eq!(pool(vec![1.0, 3.0, 2.0]), [1.0, 2.5, 2.5]);
    }
}

//! The offset without darks, sharper than medians give it: the means of frames that agree, over the pixels that are good in all of them.
//!
//! A median is safe from what stands in the beam, but it is no mean. Where a distribution of density f over the panel gets noise of variance
//! σ²(y), as many pixels come to lie below y as belong there and ½ (σ² f)′ more; with σ² = gain · y and an even f the median falls by half
//! a quantum, and by a sixth of one where the panel sees one signal throughout and the noise is skewed. The fall is the same at every
//! exposure, so that it is the intercept's. Means over one set of pixels lie on `offset + k · mAs`, whatever the noise.
//!
//! A mean over n pixels has the variance (gain · signal + σ²) / n of photon transfer, and (τ · signal)² more where the tube's output scatters
//! by the share τ: as large as the frames' distances from the line ask for.

use super::air::Consistent;
use super::error::DetectorError;
use super::offset::{Offset, has_levels, of_exposures};
use super::transfer::Transfer;
use crate::image::Image;

/// The weights follow the line.
const ROUNDS: usize = 4;
/// The output's scatter is found by halving; frames that scatter by more are left out before.
const MOST_SCATTER: f64 = 0.1;
const HALVINGS: usize = 40;

#[derive(Clone, Copy, Debug)]
struct Line {
    intercept: f64,
    sigma: f64,
    /// Per mAs.
    slope: f64,
    chi2: f64,
}

/// From the beam that gives it best; `first` is the offset with which the beams were judged.
pub(super) fn refined(
    first: &Offset,
    beams: &[(&Consistent, &Transfer)],
    bad: &Image<u8>,
    notes: &mut Vec<String>,
) -> Result<Offset, DetectorError> {
    let good: Vec<usize> = (0..bad.pixels.len()).filter(|&at| bad.pixels[at] == 0).collect();
    let mut best: Option<(f64, f64, f64)> = None;
    for (group, transfer) in beams {
        let frames = group.levels.iter().flat_map(|level| &level.frames);
        let points: Vec<[f64; 2]> = frames
            .filter_map(|frame| {
                let sum = good.iter().map(|&at| f64::from(frame.pixels.pixels[at])).sum::<f64>();
                Some([frame.exposure_mas?, sum / good.len() as f64])
            })
            .collect();
        if !has_levels(&points) {
            continue;
        }
        let largest = points.iter().map(|point| point[1]).fold(0.0, f64::max);
        if let Some(line) = line(&points, first.median, |signal| transfer.variance_of_mean(signal, good.len()))
            && best.is_none_or(|(_, sigma, _)| line.sigma < sigma)
        {
            best = Some((line.intercept, line.sigma, largest));
        }
    }
    let Some(best) = best else {
        notes.push(format!(
            "no dark frames: one offset of {:.2} ± {:.2} for all pixels, by the medians of the frames: without those that were left out no beam has \
             three different exposures (mAs), so it is less sure than that; take two dark frames",
            first.median, first.sigma
        ));
        return Ok(Offset { map: None, readout_sigma: None, temporal: None, saturated: first.saturated.clone(), ..*first });
    };
    let offset = of_exposures(Some(best))?;
    notes.push(format!(
        "no dark frames: one offset of {:.2} ± {:.2} for all pixels, from where the signal of the exposures vanishes if their mAs are true; \
         hot pixels are not found",
        offset.median, offset.sigma
    ));
    Ok(offset)
}

/// Through `points`, mAs and mean; `noise` is the variance of a mean by its signal.
fn line(points: &[[f64; 2]], intercept: f64, noise: impl Fn(f64) -> f64) -> Option<Line> {
    let freedom = points.len() as f64 - 2.0;
    let slopes = points.iter().map(|[mas, value]| (value - intercept) / mas);
    let mut slope = slopes.sum::<f64>() / points.len() as f64;
    let mut found = None;
    for _ in 0..ROUNDS {
        let with = |scatter: f64| {
            let variance = |mas: f64| noise(slope * mas) + (scatter * slope * mas).powi(2);
            weighted(points, variance)
        };
        let too_far = |scatter: f64| with(scatter).is_some_and(|line| line.chi2 > freedom);
        let mut scatter = 0.0;
        if too_far(0.0) {
            let mut above = MOST_SCATTER;
            for _ in 0..HALVINGS {
                let middle = 0.5 * (scatter + above);
                if too_far(middle) {
                    scatter = middle;
                } else {
                    above = middle;
                }
            }
        }
        let line = with(scatter)?;
        slope = line.slope;
        found = Some(line);
    }
    found.filter(|line| line.intercept.is_finite() && line.sigma.is_finite())
}

fn weighted(points: &[[f64; 2]], variance: impl Fn(f64) -> f64) -> Option<Line> {
    let mut sums = [0.0f64; 5];
    for [x, y] in points {
        let weight = 1.0 / variance(*x);
        for (sum, term) in sums.iter_mut().zip([1.0, *x, x * x, *y, x * y]) {
            *sum += weight * term;
        }
    }
    let [w, x, xx, y, xy] = sums;
    let determinant = w * xx - x * x;
    if !(determinant > 0.0) {
        return None;
    }
    let (intercept, slope) = ((xx * y - x * xy) / determinant, (w * xy - x * y) / determinant);
    let chi2 = points.iter().map(|[x, y]| (y - intercept - slope * x).powi(2) / variance(*x)).sum();
    Some(Line { intercept, sigma: (xx / determinant).sqrt(), slope, chi2 })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two frames of 1, 2, 4 and 8 mAs, 1000 per mAs, each off by its share of `output` and of the noise.
    fn frames(output: f64, noise: f64) -> Vec<[f64; 2]> {
        let sides = [1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0];
        let point = |(nth, side): (usize, f64)| {
            let mas = [1.0, 2.0, 4.0, 8.0][nth / 2];
            [mas, 200.0 + 1000.0 * mas * (1.0 + output * side) + noise * mas.sqrt() * side]
        };
        sides.into_iter().enumerate().map(point).collect()
    }

    #[test]
    fn the_frames_say_how_much_the_output_scatters_and_noise_alone_says_none() {
        let noise = |signal: f64| signal * 1e-4;
        let quiet = line(&frames(0.0, 0.1), 190.0, noise).expect("a line");
        assert!((quiet.intercept - 200.0).abs() < 2.0 * quiet.sigma, "{quiet:?}");
        // A variance of 0.1 x at x mAs: the inverse of the normal equations is 0.1 Σx / (Σ1/x Σx − (Σ1)²), of Σ1/x = 3.75, Σ1 = 8 and
        // Σx = 30.
        assert!((quiet.sigma - (0.1f64 * 30.0 / 48.5).sqrt()).abs() < 1e-3, "{quiet:?}");
        let scattering = line(&frames(0.01, 0.1), 190.0, noise).expect("a line");
        assert!(scattering.sigma > 10.0 * quiet.sigma, "{scattering:?}");
        assert!((scattering.chi2 / 6.0 - 1.0).abs() < 1e-3, "{scattering:?}");
        assert!((scattering.intercept - 200.0).abs() < 2.0 * scattering.sigma, "{scattering:?}");
    }
}

//! The stored value without X-rays: from darks, pixel by pixel, else from where the signal of several exposures would vanish, as well as
//! medians of the frames tell.

use super::error::DetectorError;
use super::groups::{Group, median, median_and_deviation};
use super::measurement::PanelFrame;
use crate::image::Image;

pub(super) struct Offset {
    /// Pixel by pixel, from darks.
    pub map: Option<Image<f32>>,
    /// Over the panel.
    pub median: f64,
    /// Of the median.
    pub sigma: f64,
    pub from: &'static str,
    /// Electronic noise of a pixel, from two darks or more.
    pub readout_sigma: Option<f64>,
    /// Variance of each pixel over the darks, when there are three or more, and how many there were.
    pub temporal: Option<(Image<f32>, usize)>,
    /// Dark frames at the end of the scale, by pixel.
    pub saturated: Vec<usize>,
}

impl Offset {
    /// Of the pixel with index `at`.
    pub(super) fn at(&self, at: usize) -> f64 {
        self.map.as_ref().map_or(self.median, |map| f64::from(map.pixels[at]))
    }
}

/// Darks whose medians differ by more than this many stored values, or this share of the pixels' noise, are not all dark.
const DARK_DRIFT: (f64, f64) = (3.0, 3.0);
/// Exposures this much apart are different levels.
const SAME_MAS: f64 = 0.02;
/// Levels that determine a line and show whether it is one.
const LEAST_LEVELS: usize = 3;
/// An offset that is less certain than this share of the largest signal is not used.
const MOST_UNCERTAIN: f64 = 5e-3;
/// Maps are kept in steps of this, so that they pack.
const STEP: f64 = 1.0 / 64.0;

pub(super) fn find(
    dark: &[PanelFrame],
    groups: &[Group],
    saturation: Option<f64>,
    notes: &mut Vec<String>,
) -> Result<Offset, DetectorError> {
    if dark.is_empty() { from_exposures(groups) } else { from_darks(dark, saturation, notes) }
}

fn from_darks(dark: &[PanelFrame], saturation: Option<f64>, notes: &mut Vec<String>) -> Result<Offset, DetectorError> {
    let medians: Vec<f64> = dark.iter().map(|frame| median(frame.pixels.pixels.clone())).collect();
    let (expected, _) = median_and_deviation(&medians);
    let readout_sigma = readout_sigma(dark);
    let limit = DARK_DRIFT.0.max(DARK_DRIFT.1 * readout_sigma.unwrap_or(0.0));
    if let Some((frame, found)) = dark.iter().zip(&medians).find(|(_, found)| !((*found - expected).abs() <= limit)) {
        return Err(DetectorError::DarkDiffers { label: frame.label.clone(), found: *found, expected });
    }
    if dark.len() == 1 {
        notes.push("one dark frame only: unstable dark pixels are not found".into());
    }
    let count = dark[0].pixels.pixels.len();
    let n = dark.len() as f64;
    let mut map = Image::filled(dark[0].pixels.width, dark[0].pixels.height, 0.0f32);
    let mut variance = map.clone();
    let mut saturated = Vec::new();
    for at in 0..count {
        let values = || dark.iter().map(|frame| f64::from(frame.pixels.pixels[at]));
        let mean = values().sum::<f64>() / n;
        map.pixels[at] = ((mean / STEP).round() * STEP) as f32;
        variance.pixels[at] = (values().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0)) as f32;
        if saturation.is_some_and(|end| values().any(|v| v >= end)) {
            saturated.push(at);
        }
    }
    let centre = median_of_map(&map);
    let sigma = readout_sigma.unwrap_or(1.0) / (n * count as f64).sqrt() + median_and_deviation(&medians).1 / n.sqrt();
    let temporal = (dark.len() >= 3).then_some((variance, dark.len()));
    Ok(Offset { map: Some(map), median: centre, sigma, from: "darks", readout_sigma, temporal, saturated })
}

/// The mean of the middle half: finer than the median of rounded values.
fn median_of_map(map: &Image<f32>) -> f64 {
    let mut values = map.pixels.clone();
    values.sort_by(f32::total_cmp);
    let middle = &values[values.len() / 4..(values.len() * 3).div_ceil(4)];
    middle.iter().map(|v| f64::from(*v)).sum::<f64>() / middle.len().max(1) as f64
}

/// From differences of successive darks, without the outermost of them.
fn readout_sigma(dark: &[PanelFrame]) -> Option<f64> {
    let variances: Vec<f64> = dark
        .windows(2)
        .map(|pair| {
            let differences = pair[0].pixels.pixels.iter().zip(&pair[1].pixels.pixels).map(|(a, b)| f64::from(a - b));
            let differences: Vec<f64> = differences.collect();
            clipped_variance(&differences) / 2.0
        })
        .collect();
    (!variances.is_empty()).then(|| (variances.iter().sum::<f64>() / variances.len() as f64).sqrt())
}

/// Variance without values beyond six deviations, which a normal distribution hardly has.
pub(super) fn clipped_variance(values: &[f64]) -> f64 {
    let moments = |limit: f64, centre: f64| {
        let kept = values.iter().filter(|v| (*v - centre).abs() <= limit);
        let (n, sum, squares) =
            kept.fold((0.0f64, 0.0, 0.0), |(n, sum, squares), v| (n + 1.0, sum + v, squares + (v - centre) * (v - centre)));
        let mean = sum / n.max(1.0);
        (mean, (squares / n.max(1.0) - (mean - centre).powi(2)).max(0.0))
    };
    let (centre, deviation) = median_and_deviation(values);
    let (mut centre, mut variance) = moments(6.0 * deviation.max(1.0), centre);
    for _ in 0..2 {
        (centre, variance) = moments(6.0 * variance.sqrt().max(0.5), centre);
    }
    variance
}

/// `signal = offset + k · mAs`, every frame with the same relative weight: tube output scatters by a share of itself.
fn from_exposures(groups: &[Group]) -> Result<Offset, DetectorError> {
    let mut best: Option<(f64, f64, f64)> = None;
    for group in groups {
        let points: Vec<[f64; 2]> =
            group.frames.iter().filter_map(|f| Some([f.exposure_mas?, median(f.pixels.pixels.clone())])).collect();
        if !has_levels(&points) {
            continue;
        }
        let fitted = weighted_line(&points);
        let largest = points.iter().map(|point| point[1]).fold(0.0, f64::max);
        if let Some((intercept, sigma)) = fitted
            && best.is_none_or(|(_, found, _)| sigma < found)
        {
            best = Some((intercept, sigma, largest));
        }
    }
    of_exposures(best)
}

/// Whether `points`, mAs and value, are of enough levels.
pub(super) fn has_levels(points: &[[f64; 2]]) -> bool {
    let mut levels: Vec<f64> = points.iter().map(|point| point[0]).collect();
    levels.sort_by(f64::total_cmp);
    levels.dedup_by(|a, b| (*a - *b).abs() <= SAME_MAS * *b);
    levels.len() >= LEAST_LEVELS
}

/// Of the intercept, its standard deviation and the largest value.
pub(super) fn of_exposures(best: Option<(f64, f64, f64)>) -> Result<Offset, DetectorError> {
    let refused = |detail: String| DetectorError::NoOffset { detail };
    let (intercept, sigma, largest) = best
        .ok_or_else(|| refused("the air frames do not state three different exposures (mAs) at one tube voltage".to_owned()))?;
    if !(sigma <= MOST_UNCERTAIN * largest) {
        return Err(refused(format!("the exposures give it as {intercept:.0} ± {sigma:.0} only")));
    }
    Ok(Offset {
        map: None,
        median: intercept,
        sigma,
        from: "exposures",
        readout_sigma: None,
        temporal: None,
        saturated: Vec::new(),
    })
}

/// Intercept and its standard deviation; weights follow the signal above the offset, so they are found in rounds.
fn weighted_line(points: &[[f64; 2]]) -> Option<(f64, f64)> {
    let mut intercept = 0.0;
    let mut sigma = f64::NAN;
    for _ in 0..6 {
        let mut sums = [0.0f64; 5];
        for [x, y] in points {
            let weight = 1.0 / (y - intercept).max(1.0).powi(2);
            for (sum, term) in sums.iter_mut().zip([1.0, *x, x * x, *y, x * y]) {
                *sum += weight * term;
            }
        }
        let [w, x, xx, y, xy] = sums;
        let determinant = w * xx - x * x;
        if !(determinant > 0.0) {
            return None;
        }
        intercept = (xx * y - x * xy) / determinant;
        let slope = (w * xy - x * y) / determinant;
        let chi: f64 = points.iter().map(|p| ((p[1] - intercept - slope * p[0]) / (p[1] - intercept).max(1.0)).powi(2)).sum();
        sigma = (chi / (points.len() as f64 - 2.0).max(1.0) * xx / determinant).sqrt();
    }
    (intercept.is_finite() && sigma.is_finite()).then_some((intercept, sigma))
}

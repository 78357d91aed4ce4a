//! The stored value without X-rays: from darks, pixel by pixel, else from where the signal of several exposures would vanish, as well as
//! medians of the frames tell.

use super::error::DetectorError;
use super::groups::{Group, median, median_and_deviation};
use super::measurement::PanelFrame;
use crate::estimate::Line;
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
/// Student's 95 % over the normal's, of so few degrees of freedom in all, from one on: they say little of how the output scatters.
const STUDENT: [f64; 5] = [6.48, 2.20, 1.62, 1.42, 1.31];
/// Weights follow the signal above the offset, so they are found in rounds.
const ROUNDS: usize = 6;
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

/// `signal = offset + k · mAs`, every frame with the same relative weight: tube output scatters by a share of itself, one tube's in all its
/// beams. By its own residuals alone a beam of few frames would often be the best by chance. Where the frames of one beam contradict each
/// other, the rest may tell without it, if they are enough to say how the output scatters.
fn from_exposures(groups: &[Group]) -> Result<Offset, DetectorError> {
    let mut beams: Vec<OfExposures> = groups.iter().filter_map(OfExposures::new).collect();
    beams.sort_by(|a, b| a.scatter().total_cmp(&b.scatter()));
    loop {
        let found = of_exposures(best_of(&beams));
        let Some((worst, others)) = beams.split_last().filter(|_| found.is_err()) else { return found };
        // Where all of them scatter, the worst is no exception.
        let (freedom, scatter) = pooled(others);
        if freedom <= STUDENT.len() || !(worst.scatter() > EXCEPTION * scatter) {
            return found;
        }
        beams.pop();
    }
}

/// A beam whose frames scatter by twice the share of the others', its square, is left out.
const EXCEPTION: f64 = 4.0;

/// The line of a beam's medians by their mAs.
struct OfExposures {
    /// Its weights are those of an output that scatters by all of itself.
    line: Line,
    freedom: usize,
    largest: f64,
}

impl OfExposures {
    fn new(group: &Group) -> Option<Self> {
        let frames = group.frames.iter();
        let points: Vec<[f64; 2]> =
            frames.filter_map(|frame| Some([frame.exposure_mas?, median(frame.pixels.pixels.clone())])).collect();
        if !has_levels(&points) {
            return None;
        }
        let mut found: Option<Line> = None;
        for _ in 0..ROUNDS {
            let offset = found.map_or(0.0, |line| line.intercept);
            let weighed = points.iter().map(|&[mas, value]| [mas, value, 1.0 / (value - offset).max(1.0).powi(2)]);
            found = Some(Line::through(weighed)?);
        }
        let largest = points.iter().map(|point| point[1]).fold(0.0, f64::max);
        Some(Self { line: found?, freedom: points.len() - 2, largest })
    }

    /// The square of the share by which the output scatters.
    fn scatter(&self) -> f64 {
        self.line.chi2 / self.freedom as f64
    }
}

/// Degrees of freedom of all beams, and the square of the share by which their output scatters.
fn pooled(beams: &[OfExposures]) -> (usize, f64) {
    let freedom = beams.iter().map(|beam| beam.freedom).sum::<usize>();
    (freedom, beams.iter().map(|beam| beam.line.chi2).sum::<f64>() / freedom as f64)
}

/// The intercept of the beam that gives it best, its standard deviation by the scatter of all of them, and the beam's largest value.
fn best_of(beams: &[OfExposures]) -> Option<(f64, f64, f64)> {
    let (freedom, scatter) = pooled(beams);
    let share = scatter.sqrt();
    let sigma = |beam: &OfExposures| student(freedom) * share * beam.line.intercept_sigma();
    let found = beams.iter().map(|beam| (beam.line.intercept, sigma(beam), beam.largest));
    found.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// How much wider a standard deviation is that rests on so few degrees of freedom.
pub(super) fn student(freedom: usize) -> f64 {
    freedom.checked_sub(1).and_then(|at| STUDENT.get(at)).copied().unwrap_or(1.0)
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

#[cfg(test)]
mod tests {
    use super::super::groups::Beam;
    use super::*;

    /// Of frames of one pixel each: mAs and value.
    fn found(beams: &[Vec<[f64; 2]>]) -> Result<Offset, DetectorError> {
        let frame = |[mas, value]: &[f64; 2]| PanelFrame {
            label: "air".to_owned(),
            pixels: Image::filled(1, 1, *value as f32),
            tube_kvp: Some(70.0),
            filter: None,
            exposure_mas: Some(*mas),
            source_to_detector_mm: None,
        };
        let frames: Vec<Vec<PanelFrame>> = beams.iter().map(|points| points.iter().map(frame).collect()).collect();
        let group =
            |frames| Group { beam: Beam { kvp: Some(70.0), filter: None }, frames, saturated: Vec::new(), left_out: Vec::new() };
        from_exposures(&frames.iter().map(|frames| group(frames.iter().collect())).collect::<Vec<_>>())
    }

    /// Two frames of 1, 2, 4 and 8 mAs above 200, each off by a share of its signal.
    fn many(per_mas: f64, share: f64) -> Vec<[f64; 2]> {
        let sides = [1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0];
        let point = |(nth, side): (usize, f64)| {
            let mas = [1.0, 2.0, 4.0, 8.0][nth / 2];
            [mas, 200.0 + per_mas * mas * (1.0 + share * side)]
        };
        sides.into_iter().enumerate().map(point).collect()
    }

    /// Three frames that lie on a line by chance were as sure as their residuals, and taken before eight that scatter.
    #[test]
    fn an_offset_is_as_sure_as_the_frames_of_all_beams() {
        let lucky = [1.0, 2.0, 4.0].map(|mas| [mas, 212.0 + 400.0 * mas]).to_vec();
        let offset = found(&[many(1000.0, 0.01), lucky]).expect("two beams");
        assert!(
            (offset.median - 200.0).abs() < 2.0 * offset.sigma && offset.sigma < 12.0,
            "{} ± {}",
            offset.median,
            offset.sigma
        );
        // Alone, of one degree of freedom, three frames that do scatter tell too little.
        let few = [[1.0, 1.01], [2.0, 0.99], [4.0, 1.01]].map(|[mas, share]| [mas, 200.0 + 1000.0 * mas * share]).to_vec();
        assert!(found(std::slice::from_ref(&few)).is_err());
        assert!(found(&[few, many(1000.0, 0.01)]).is_ok());
    }

    #[test]
    fn a_frame_with_another_ones_exposure_takes_no_offset_from_a_beam_of_enough_frames() {
        let mut wrong = many(1000.0, 0.001);
        wrong[3][0] = 4.0;
        let offset = found(&[wrong.clone(), many(1500.0, 0.001)]).expect("the second beam");
        assert!((offset.median - 200.0).abs() < 2.0 * offset.sigma && offset.sigma < 3.0, "{} ± {}", offset.median, offset.sigma);
        let few = [[1.0, 1.001], [2.0, 0.999], [4.0, 1.001]].map(|[mas, share]| [mas, 200.0 + 1500.0 * mas * share]).to_vec();
        assert!(found(&[wrong, few]).is_err(), "which of the two is wrong nobody knows");
    }

    /// Left out one after the other, the rest were sure by chance.
    #[test]
    fn where_all_beams_scatter_the_worst_is_no_exception() {
        let alike = [0.02, 0.04, 0.045, 0.05, 0.055].map(|share| many(1000.0, share));
        assert!(found(&alike).is_err());
        assert!(found(&alike[..2]).is_ok(), "the control");
    }

    #[test]
    fn exposures_that_do_not_determine_an_offset_give_none() {
        let same = vec![[2.0, 900.0], [2.0, 905.0], [2.01, 903.0], [2.0, 898.0]];
        assert!(found(&[same]).is_err() && found(&[Vec::new()]).is_err() && found(&[]).is_err());
    }
}

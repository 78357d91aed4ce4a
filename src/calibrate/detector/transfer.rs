//! Photon transfer: variance against mean, from differences of frames of the same exposure.
//!
//! For frames a and b with signals m_a and m_b = m_a / r, the difference d = a − r·b has no fixed pattern left, and
//! Var d = gain · (m_a + r² m_b) + (1 + r²) σ². Divided by (1 + r²) it lies on the line `σ² + gain · x`, x the weighted mean signal.
//! Light that spreads in the scintillator makes neighbours share quanta: a pixel's own variance is too small then, and the variance is
//! summed over the covariances with its neighbours instead, where these are seen at all.

use rayon::prelude::*;

use super::air::Consistent;
use super::error::DetectorError;
use super::measurement::PanelFrame;
use super::offset::Offset;
use crate::image::Image;

pub(super) struct Transfer {
    /// Stored value per quantum.
    pub gain: f64,
    pub relative_sigma: f64,
    /// Electronic noise as the line's end gives it, where darks do not.
    pub readout_sigma: Option<f64>,
    /// Slope and end of the line of single pixels' variance.
    pixel_line: [f64; 2],
    pub notes: Vec<String>,
}

impl Transfer {
    /// Variance of a pixel at a mean signal.
    pub(super) fn variance(&self, signal: f64) -> f64 {
        self.pixel_line[0] * signal.max(0.0) + self.pixel_line[1]
    }
}

/// Side of the blocks that become points of the line.
const BLOCK_PX: usize = 32;
/// Covariances are summed up to this far, each way.
const REACH_PX: usize = 3;
/// Pixels within this many deviations of the saturation are cut off by it.
const HEADROOM_SIGMAS: f64 = 6.0;
/// Differences beyond this many deviations are no noise.
const CLIP_SIGMAS: f64 = 7.0;
/// Two neighbours share quanta when their correlation is this many deviations from zero …
const SHARED_SIGMAS: f64 = 4.0;
/// … and at least this.
const SHARED_LEAST: f64 = 0.003;

/// One block of one pair of frames.
struct Point {
    signal: f64,
    variance: f64,
    /// With each neighbour of [`neighbours`].
    covariances: Vec<f64>,
    pixels: f64,
}

/// Columns and rows to the neighbours within reach, one of each opposite two.
fn neighbours() -> Vec<[isize; 2]> {
    let reach = REACH_PX as isize;
    let all = (0..=reach).flat_map(|dv| (-reach..=reach).map(move |du| [du, dv]));
    all.filter(|[du, dv]| *dv > 0 || *du > 0).collect()
}

pub(super) fn find(
    group: &Consistent,
    offset: &Offset,
    bad: &Image<u8>,
    saturation: Option<f64>,
) -> Result<Transfer, DetectorError> {
    let mut points = Vec::new();
    for level in &group.levels {
        for pair in level.frames.chunks(2).filter(|pair| pair.len() == 2) {
            points.extend(pair_points([pair[0], pair[1]], offset, bad, saturation));
        }
    }
    if points.is_empty() {
        return Err(DetectorError::NoPairs { beam: group.beam.words() });
    }
    let readout = offset.readout_sigma.map(|sigma| sigma * sigma);
    let single = line(&points, |point| point.variance, readout);
    if !(single.slope > 0.0 && single.slope.is_finite()) {
        return Err(DetectorError::NoTransfer { beam: group.beam.words(), slope: single.slope });
    }
    let mut notes = Vec::new();
    // Correlation of quantum noise with each neighbour; a covariance of n pixels scatters by variance / √n.
    let count = neighbours().len();
    let (mut shared, mut variance, mut scatter) = (vec![0.0; count], 0.0, 0.0);
    for point in &points {
        shared.iter_mut().zip(&point.covariances).for_each(|(sum, covariance)| *sum += point.pixels * covariance);
        variance += point.pixels * single.slope * point.signal;
        scatter += point.pixels * point.variance * point.variance;
    }
    let sigma = scatter.sqrt() / variance;
    let correlations: Vec<f64> = shared.iter().map(|sum| sum / variance).collect();
    let distance = |k: usize| neighbours()[k].iter().map(|d| (d * d) as f64).sum::<f64>().sqrt();
    let shares = |k: usize| correlations[k].abs() > SHARED_SIGMAS * sigma && correlations[k].abs() > SHARED_LEAST;
    // Light that reaches the next pixel correlates pixels twice as far apart, however weakly.
    let farthest = (0..count).filter(|k| shares(*k)).map(distance).fold(0.0, f64::max);
    let seen: Vec<usize> = (0..count).filter(|k| farthest > 0.0 && distance(*k) <= farthest.max(2.0)).collect();
    let chosen = if seen.is_empty() {
        single
    } else {
        let strongest = correlations.iter().copied().fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a });
        notes.push(format!(
            "{}: pixels share quanta with {} neighbours (correlation up to {strongest:.3}); the gain is from variances \
             summed over these, a single pixel's variance alone would give {:.4}",
            group.beam.words(),
            2 * seen.len(),
            single.slope
        ));
        let summed = |point: &Point| point.variance + 2.0 * seen.iter().map(|&k| point.covariances[k]).sum::<f64>();
        let line = line(&points, summed, readout);
        // Every covariance scatters as the variance does, by √2 less, and counts twice.
        Line { slope_sigma: line.slope_sigma * (1.0 + 2.0 * seen.len() as f64).sqrt(), ..line }
    };
    if !(chosen.slope > 0.0 && chosen.slope.is_finite()) {
        return Err(DetectorError::NoTransfer { beam: group.beam.words(), slope: chosen.slope });
    }
    Ok(Transfer {
        gain: chosen.slope,
        relative_sigma: chosen.slope_sigma / chosen.slope,
        readout_sigma: readout.is_none().then(|| single.end.max(0.0).sqrt()),
        pixel_line: [single.slope, single.end.max(0.0)],
        notes,
    })
}

#[derive(Clone, Copy)]
struct Line {
    slope: f64,
    slope_sigma: f64,
    end: f64,
}

/// Weighted least squares; the end of the line is `fixed` where darks give it. Weights follow the line itself, not the scattered points,
/// which would pull it down.
fn line(points: &[Point], value: impl Fn(&Point) -> f64, fixed: Option<f64>) -> Line {
    let mut found = Line { slope: 1.0, slope_sigma: f64::NAN, end: fixed.unwrap_or(0.0) };
    for round in 0..6 {
        let mut sums = [0.0f64; 5];
        for point in points {
            let expected = if round == 0 { point.variance } else { found.end + found.slope * point.signal };
            let weight = point.pixels / (2.0 * expected.max(1e-6).powi(2));
            let y = value(point) - fixed.unwrap_or(0.0);
            for (sum, term) in sums.iter_mut().zip([1.0, point.signal, point.signal * point.signal, y, point.signal * y]) {
                *sum += weight * term;
            }
        }
        let [w, x, xx, y, xy] = sums;
        found = match fixed {
            Some(end) => Line { slope: xy / xx, slope_sigma: 1.0 / xx.sqrt(), end },
            None => {
                let determinant = w * xx - x * x;
                Line {
                    slope: (w * xy - x * y) / determinant,
                    slope_sigma: (w / determinant).sqrt(),
                    end: (xx * y - x * xy) / determinant,
                }
            }
        };
    }
    found
}

/// The points of one pair.
fn pair_points([a, b]: [&PanelFrame; 2], offset: &Offset, bad: &Image<u8>, saturation: Option<f64>) -> Vec<Point> {
    let (width, height) = (bad.width, bad.height);
    let signal = |frame: &PanelFrame, at: usize| f64::from(frame.pixels.pixels[at]) - offset.at(at);
    let total =
        |frame: &PanelFrame| (0..bad.pixels.len()).filter(|&at| bad.pixels[at] == 0).map(|at| signal(frame, at)).sum::<f64>();
    let ratio = total(a) / total(b);
    let (across, down) = (width / BLOCK_PX, height / BLOCK_PX);
    (0..across * down)
        .into_par_iter()
        .filter_map(|block| {
            let (left, top) = (block % across * BLOCK_PX, block / across * BLOCK_PX);
            let places = (0..BLOCK_PX * BLOCK_PX).map(|n| (top + n / BLOCK_PX) * width + left + n % BLOCK_PX);
            let mut differences: Vec<Option<f64>> = Vec::with_capacity(BLOCK_PX * BLOCK_PX);
            let (mut n, mut sum, mut mean) = (0.0, 0.0, 0.0);
            let mut highest = f64::MIN;
            for at in places {
                if bad.pixels[at] != 0 {
                    differences.push(None);
                    continue;
                }
                let (of_a, of_b) = (signal(a, at), signal(b, at));
                n += 1.0;
                sum += (of_a + ratio * ratio * of_b) / (1.0 + ratio * ratio);
                mean += of_a - ratio * of_b;
                highest = highest.max(f64::from(a.pixels.pixels[at].max(b.pixels.pixels[at])));
                differences.push(Some(of_a - ratio * of_b));
            }
            if n < 0.75 * (BLOCK_PX * BLOCK_PX) as f64 {
                return None;
            }
            mean /= n;
            differences.iter_mut().flatten().for_each(|d| *d -= mean);
            clip(&mut differences);
            let point = statistics(&differences, sum / n, 1.0 + ratio * ratio)?;
            let headroom = HEADROOM_SIGMAS * point.variance.sqrt() * 0.5;
            saturation.is_none_or(|end| highest + headroom < end).then_some(point)
        })
        .collect()
}

/// Drops what is no noise: a pixel that flickers.
fn clip(differences: &mut [Option<f64>]) {
    let known: Vec<f64> = differences.iter().flatten().copied().collect();
    let (_, deviation) = super::groups::median_and_deviation(&known);
    let limit = CLIP_SIGMAS * deviation.max(0.5);
    differences.iter_mut().filter(|d| d.is_some_and(|d| !(d.abs() <= limit))).for_each(|d| *d = None);
}

fn statistics(differences: &[Option<f64>], signal: f64, divisor: f64) -> Option<Point> {
    let covariance = |du: isize, dv: isize| {
        let (mut n, mut sum) = (0.0, 0.0);
        for row in 0..BLOCK_PX as isize - dv {
            for column in (-du).max(0)..BLOCK_PX as isize - du.max(0) {
                let at = |u: isize, v: isize| differences[v as usize * BLOCK_PX + u as usize];
                if let (Some(x), Some(y)) = (at(column, row), at(column + du, row + dv)) {
                    n += 1.0;
                    sum += x * y;
                }
            }
        }
        if n > 0.0 { sum / n } else { 0.0 }
    };
    let count = differences.iter().flatten().count() as f64;
    if count < 8.0 {
        return None;
    }
    let own = covariance(0, 0);
    let covariances: Vec<f64> = neighbours().iter().map(|[du, dv]| covariance(*du, *dv)).collect();
    // The block's mean was subtracted, which takes S/n from every covariance, S being their sum over all neighbours, both ways.
    let lags = (1 + 2 * covariances.len()) as f64;
    let lost = (own + 2.0 * covariances.iter().sum::<f64>()) / (1.0 - lags / count) / count;
    Some(Point {
        signal,
        variance: (own + lost) / divisor,
        covariances: covariances.iter().map(|covariance| (covariance + lost) / divisor).collect(),
        pixels: count,
    })
}

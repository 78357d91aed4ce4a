//! Photon transfer: variance against mean, from differences of frames of the same exposure.
//!
//! For frames a and b with signals m_a and m_b = m_a / r, the difference d = a − r·b has no fixed pattern left, and
//! Var d = gain · (m_a + r² m_b) + (1 + r²) σ². Divided by (1 + r²) it lies on the line `σ² + gain · x`, x the weighted mean signal.
//! Light that spreads in the scintillator makes neighbours share quanta: a pixel's own variance is too small then, and the variance is
//! summed over the covariances with its neighbours instead, where these are seen at all. Light is spent after a few pixels; what whole
//! lines have in common is not, and the sum would take it for quanta.

use rayon::prelude::*;

use super::air::Consistent;
use super::error::DetectorError;
use super::measurement::PanelFrame;
use super::offset::Offset;
use crate::estimate::Line;
use crate::image::Image;

pub(super) struct Transfer {
    /// Stored value per quantum.
    pub gain: f64,
    pub relative_sigma: f64,
    /// Variance of a pixel without signal as the line's end gives it, and its standard deviation, where darks do not.
    pub end_variance: Option<[f64; 2]>,
    /// Slope and end of the line of single pixels' variance.
    pixel_line: [f64; 2],
    pub notes: Vec<String>,
}

impl Transfer {
    /// Variance of a pixel at a mean signal.
    pub(super) fn variance(&self, signal: f64) -> f64 {
        self.pixel_line[0] * signal.max(0.0) + self.pixel_line[1]
    }

    /// Variance of the mean of `count` pixels of a mean signal: what neighbours share counts, as in the gain.
    pub(super) fn variance_of_mean(&self, signal: f64, count: usize) -> f64 {
        (self.gain * signal.max(0.0) + self.pixel_line[1].max(1.0 / 12.0)) / count as f64
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
/// Light that spreads less than the reach leaves neighbours a smaller correlation than this …
const SPREAD_MOST: f64 = 0.9;
/// … and at the reach a smaller share of the next pixel's than this, else a whole line varies as one.
const SPREAD_SHARE: f64 = 0.5;
/// Lines may add this share to the gain, which is then so much less certain.
const LINES_MOST: f64 = 0.1;

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
    let beam = || group.beam.words();
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
    let mut common = None;
    let chosen = if seen.is_empty() {
        single
    } else {
        common = common_to_lines(&correlations, shares).map_err(|(apart_px, correlation)| DetectorError::CommonNoise {
            beam: beam(),
            columns: apart_px[0].unsigned_abs(),
            rows: apart_px[1].unsigned_abs(),
            correlation,
        })?;
        let strongest = correlations.iter().copied().fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a });
        notes.push(format!(
            "{}: pixels share quanta with {} neighbours (correlation up to {strongest:.3}); the gain is from variances \
             summed over these, a single pixel's variance alone would give {:.4}",
            beam(),
            2 * seen.len(),
            single.slope
        ));
        let summed = |point: &Point| point.variance + 2.0 * seen.iter().map(|&k| point.covariances[k]).sum::<f64>();
        let line = line(&points, summed, readout);
        // Every covariance scatters as the variance does, by √2 less, and counts twice.
        VarianceLine { slope_sigma: line.slope_sigma * (1.0 + 2.0 * seen.len() as f64).sqrt(), ..line }
    };
    if !(chosen.slope > 0.0 && chosen.slope.is_finite()) {
        return Err(DetectorError::NoTransfer { beam: group.beam.words(), slope: chosen.slope });
    }
    if let Some(share) = common {
        notes.push(format!(
            "{}: in doubt, noise is common to whole lines of pixels: the gain may be wrong by {:.1} %, which its sigma includes",
            beam(),
            100.0 * share
        ));
    }
    Ok(Transfer {
        gain: chosen.slope,
        relative_sigma: (chosen.slope_sigma / chosen.slope).hypot(common.unwrap_or(0.0)),
        // A wrong offset shifts every point along the line.
        end_variance: readout.is_none().then(|| [single.end, single.end_sigma.hypot(single.slope * offset.sigma)]),
        pixel_line: [single.slope, single.end.max(0.0)],
        notes,
    })
}

/// The share that noise common to whole lines adds to the gain, if any; where the correlations are none of light that spreads, the columns
/// and rows to the neighbour and its correlation.
fn common_to_lines(correlations: &[f64], shares: impl Fn(usize) -> bool) -> Result<Option<f64>, ([isize; 2], f64)> {
    let neighbours = neighbours();
    let strength = |k: &usize| correlations[*k].abs();
    let stronger = |a: &usize, b: &usize| strength(a).total_cmp(&strength(b));
    let strongest = (0..neighbours.len()).filter(|k| shares(*k)).max_by(stronger);
    if let Some(k) = strongest.filter(|k| !(strength(k) <= SPREAD_MOST)) {
        return Err((neighbours[k], correlations[k]));
    }
    let reach = REACH_PX as isize;
    let index = |apart_px: [isize; 2]| neighbours.iter().position(|neighbour| *neighbour == apart_px);
    let ends = [([1, 0], [reach, 0]), ([0, 1], [0, reach])].into_iter().filter_map(|(near, far)| index(near).zip(index(far)));
    let lines: Vec<usize> =
        ends.filter(|(near, far)| shares(*far) && strength(far) > SPREAD_SHARE * strength(near)).map(|(_, far)| far).collect();
    let share = |far: &usize| 2.0 * REACH_PX as f64 * strength(far);
    let all = lines.iter().map(share).sum::<f64>();
    match lines.iter().copied().max_by(stronger) {
        Some(far) if !(all <= LINES_MOST) => Err((neighbours[far], correlations[far])),
        worst => Ok(worst.map(|_| all)),
    }
}

/// The variance of a pixel by its signal.
#[derive(Clone, Copy)]
struct VarianceLine {
    slope: f64,
    slope_sigma: f64,
    end: f64,
    end_sigma: f64,
}

/// Weighted least squares; the end of the line is `fixed` where darks give it. Weights follow the line itself, not the scattered points,
/// which would pull it down. Its slope is NaN where the points do not determine it.
fn line(points: &[Point], value: impl Fn(&Point) -> f64, fixed: Option<f64>) -> VarianceLine {
    let mut found = VarianceLine { slope: 1.0, slope_sigma: f64::NAN, end: fixed.unwrap_or(0.0), end_sigma: 0.0 };
    for round in 0..6 {
        let before = found;
        let weighed = points.iter().map(|point| {
            let expected = if round == 0 { point.variance } else { before.end + before.slope * point.signal };
            [point.signal, value(point), point.pixels / (2.0 * expected.max(1e-6).powi(2))]
        });
        found = match fixed {
            Some(end) => {
                let (xx, xy) =
                    weighed.fold((0.0, 0.0), |(xx, xy), [x, y, weight]| (xx + weight * x * x, xy + weight * x * (y - end)));
                VarianceLine { slope: xy / xx, slope_sigma: 1.0 / xx.sqrt(), end, end_sigma: 0.0 }
            }
            None => match Line::through(weighed) {
                Some(line) => VarianceLine {
                    slope: line.slope,
                    slope_sigma: line.slope_sigma(),
                    end: line.intercept,
                    end_sigma: line.intercept_sigma(),
                },
                None => return VarianceLine { slope: f64::NAN, slope_sigma: f64::NAN, end: f64::NAN, end_sigma: f64::NAN },
            },
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_that_spreads_falls_off_and_a_line_that_varies_as_one_does_not() {
        // Of a Gaussian blur of `sigma_px`, and of lines along the rows of pixels.
        let blurred = |sigma_px: f64, line: f64| -> Vec<f64> {
            let at = |[du, dv]: [isize; 2]| {
                let squared = (du * du + dv * dv) as f64;
                (-squared / (4.0 * sigma_px * sigma_px)).exp() + if dv == 0 { line } else { 0.0 }
            };
            neighbours().into_iter().map(at).collect()
        };
        let judged = |correlations: &[f64]| common_to_lines(correlations, |k| correlations[k].abs() > SHARED_LEAST);
        for sigma_px in [0.2, 0.5, 1.0, 1.4] {
            assert_eq!(judged(&blurred(sigma_px, 0.0)), Ok(None), "{sigma_px}");
        }
        assert!(judged(&blurred(2.5, 0.0)).is_err(), "farther than the sum reaches");
        let weak = judged(&blurred(0.2, 0.01)).expect("little").expect("seen");
        assert!((weak - 0.06).abs() < 0.005, "{weak}");
        assert_eq!(judged(&blurred(0.2, 0.3)).map_err(|(apart_px, _)| apart_px), Err([3, 0]), "along the rows");
        assert!(judged(&blurred(0.2, 1.027)).is_err_and(|(_, correlation)| correlation > 1.0));
    }
}

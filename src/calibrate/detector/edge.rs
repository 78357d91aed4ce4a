//! Presampled MTF from a slanted edge (after IEC 62220-1): rows at an angle to the grid sample the edge finer than the pixels do.

use crate::acquire::EdgeMtf;
use crate::image::Image;
use crate::image::fourier::{Complex, transform};

/// Samples of the edge profile per pixel.
const OVERSAMPLING: f64 = 8.0;
/// The profile reaches this far to either side, pixels.
const REACH_PX: f64 = 32.0;
/// An edge less or more turned than this does not sample evenly.
const ANGLE_DEG: std::ops::RangeInclusive<f64> = 1.0..=20.0;
/// The dark side must be at least this much darker.
const LEAST_CONTRAST: f64 = 0.2;
/// Frequencies of the answer.
const FREQUENCIES: usize = 32;

/// `flat`: offset and air map taken out, NaN where a pixel is bad. Errors are sentences.
pub(super) fn mtf(flat: &Image<f32>, pitch_mm: f64) -> Result<EdgeMtf, String> {
    let columns = line_of_edge(flat);
    let turned = transposed(flat);
    let rows = line_of_edge(&turned);
    // The edge crosses that set of lines in which more of them see it.
    let (image, line, across) = match (columns, rows) {
        (Some(a), Some(b)) if a.lines >= b.lines => (flat, a, "columns"),
        (_, Some(b)) => (&turned, b, "rows"),
        (Some(a), None) => (flat, a, "columns"),
        (None, None) => return Err("no straight edge was found; put a sharp metal edge on the panel".into()),
    };
    let angle_deg = line.slope.atan().to_degrees();
    if !ANGLE_DEG.contains(&angle_deg.abs()) {
        return Err(format!("the edge is turned by {angle_deg:.1} degrees against the grid, expected 2 to 10"));
    }
    let spread = line_spread(image, &line)?;
    let n = spread.len();
    let mut values: Vec<Complex> = spread.iter().map(|v| [*v, 0.0]).collect();
    transform(&mut values);
    let magnitude = |k: usize| values[k][0].hypot(values[k][1]);
    let at = |per_px: f64| {
        let position = per_px / OVERSAMPLING * n as f64;
        let below = position.floor() as usize;
        let share = position - below as f64;
        let mut value = (1.0 - share) * magnitude(below) + share * magnitude(below + 1);
        value /= magnitude(0);
        // The profile was binned to 1/8 px and differentiated over two bins; both attenuate by a known factor.
        let bin = std::f64::consts::PI * per_px / OVERSAMPLING;
        if per_px > 0.0 { value / (bin.sin() / bin) / ((2.0 * bin).sin() / (2.0 * bin)) } else { value }
    };
    let frequency_per_px: Vec<f64> = (0..=FREQUENCIES).map(|k| 0.5 * k as f64 / FREQUENCIES as f64).collect();
    let mtf: Vec<f64> = frequency_per_px.iter().map(|f| at(*f)).collect();
    let half = mtf.windows(2).position(|pair| pair[0] >= 0.5 && pair[1] < 0.5).map(|k| {
        let share = (mtf[k] - 0.5) / (mtf[k] - mtf[k + 1]);
        (frequency_per_px[k] + share * (frequency_per_px[k + 1] - frequency_per_px[k])) / pitch_mm
    });
    Ok(EdgeMtf {
        edge_angle_deg: angle_deg,
        across: across.to_owned(),
        frequency_lp_per_mm: frequency_per_px.iter().map(|f| f / pitch_mm).collect(),
        mtf,
        half_lp_per_mm: half,
    })
}

fn transposed(image: &Image<f32>) -> Image<f32> {
    let at = |n: usize| image.pixels[(n % image.height) * image.width + n / image.height];
    Image { width: image.height, height: image.width, pixels: (0..image.pixels.len()).map(at).collect() }
}

/// column = offset + slope · row.
struct EdgeLine {
    offset: f64,
    slope: f64,
    /// Rows that see the edge.
    lines: usize,
}

/// Where each row crosses the middle between its two levels, and the straight line through these places.
fn line_of_edge(image: &Image<f32>) -> Option<EdgeLine> {
    let mut sorted: Vec<f32> = image.pixels.iter().copied().filter(|value| value.is_finite()).collect();
    if sorted.is_empty() {
        return None;
    }
    sorted.sort_unstable_by(f32::total_cmp);
    let level = |share: f64| f64::from(sorted[((sorted.len() - 1) as f64 * share) as usize]);
    let (low, high) = (level(0.02), level(0.98));
    if !(high - low >= LEAST_CONTRAST * high.abs()) {
        return None;
    }
    let half = 0.5 * (low + high);
    let mut places: Vec<[f64; 2]> = Vec::new();
    for row in 0..image.height {
        // Three columns smooth the noise enough to find the one crossing.
        let smooth = |u: usize| {
            let good = (u - 1..=u + 1).map(|c| f64::from(*image.at(c, row))).filter(|value| value.is_finite());
            let (sum, count) = good.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
            sum / count
        };
        let crossings: Vec<usize> =
            (1..image.width.saturating_sub(2)).filter(|&u| (smooth(u) < half) != (smooth(u + 1) < half)).collect();
        let (Some(&first), Some(&last)) = (crossings.first(), crossings.last()) else { continue };
        if last - first > 6 {
            continue;
        }
        let (a, b) = (smooth(first), smooth(first + 1));
        places.push([row as f64, first as f64 + (half - a) / (b - a)]);
    }
    if places.len() < 24 {
        return None;
    }
    let mut line = fit(&places)?;
    for _ in 0..3 {
        let deviations: Vec<f64> = places.iter().map(|[v, u]| u - line[0] - line[1] * v).collect();
        let (_, deviation) = super::groups::median_and_deviation(&deviations);
        let near = |place: &&[f64; 2]| (place[1] - line[0] - line[1] * place[0]).abs() <= (4.0 * deviation).max(0.5);
        let kept: Vec<[f64; 2]> = places.iter().filter(near).copied().collect();
        if kept.len() * 2 < places.len() {
            return None;
        }
        line = fit(&kept)?;
    }
    Some(EdgeLine { offset: line[0], slope: line[1], lines: places.len() })
}

fn fit(places: &[[f64; 2]]) -> Option<[f64; 2]> {
    let n = places.len() as f64;
    let (x, y) = places.iter().fold((0.0, 0.0), |(x, y), p| (x + p[0] / n, y + p[1] / n));
    let (xx, xy) = places.iter().fold((0.0, 0.0), |(xx, xy), p| (xx + (p[0] - x).powi(2), xy + (p[0] - x) * (p[1] - y)));
    (xx > 0.0).then(|| [y - xy / xx * x, xy / xx])
}

/// Derivative of the edge profile across the edge, in bins of 1/8 px; its length is a power of two.
fn line_spread(image: &Image<f32>, line: &EdgeLine) -> Result<Vec<f64>, String> {
    let bins = (2.0 * REACH_PX * OVERSAMPLING) as usize;
    let (mut sums, mut counts) = (vec![0.0f64; bins], vec![0.0f64; bins]);
    let across = 1.0 / (1.0 + line.slope * line.slope).sqrt();
    for row in 0..image.height {
        let edge = line.offset + line.slope * row as f64;
        let (from, to) =
            ((edge - 1.5 * REACH_PX).max(0.0) as usize, ((edge + 1.5 * REACH_PX).max(0.0) as usize).min(image.width));
        for column in from..to {
            let distance = (column as f64 - edge) * across;
            let bin = ((distance + REACH_PX) * OVERSAMPLING).floor();
            let value = f64::from(*image.at(column, row));
            if value.is_finite() && bin >= 0.0 && (bin as usize) < bins {
                sums[bin as usize] += value;
                counts[bin as usize] += 1.0;
            }
        }
    }
    let empty = counts.iter().filter(|n| **n < 1.0).count();
    if empty > 0 {
        return Err(format!(
            "the edge is sampled at {} of {bins} places within {REACH_PX} px; it must lie farther from the frame's border, or be turned \
             by 2 to 10 degrees",
            bins - empty
        ));
    }
    let profile: Vec<f64> = sums.iter().zip(&counts).map(|(sum, n)| sum / n).collect();
    let mut spread = vec![0.0; bins];
    for at in 1..bins - 1 {
        // A window that is 1 in the middle half keeps the far noise out.
        let place = (at as f64 + 0.5) / bins as f64 - 0.5;
        let window = if place.abs() <= 0.25 { 1.0 } else { (std::f64::consts::TAU * (place.abs() - 0.25)).cos().max(0.0) };
        spread[at] = 0.5 * (profile[at + 1] - profile[at - 1]) * window;
    }
    Ok(spread)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A blurred edge turned by four degrees; `spoil` is asked for each pixel's value.
    fn edge(spoil: impl Fn(usize, f32) -> f32) -> Image<f32> {
        let value = |at: usize| {
            let (u, v) = ((at % 160) as f64, (at / 160) as f64);
            let distance = (u - 75.3 - 0.07 * v) / 0.9;
            spoil(at, (500.0 + 4500.0 / (1.0 + (-distance).exp())) as f32)
        };
        Image { width: 160, height: 140, pixels: (0..160 * 140).map(value).collect() }
    }

    #[test]
    fn bad_pixels_near_the_edge_do_not_change_its_mtf() {
        let is_bad = |at: usize| at.is_multiple_of(97);
        let [clean, left_out, dead] = [
            edge(|_, value| value),
            edge(|at, value| if is_bad(at) { f32::NAN } else { value }),
            edge(|at, value| if is_bad(at) { 0.0 } else { value }),
        ]
        .map(|image| mtf(&image, 0.2).expect("an edge").mtf);
        let away = |found: &[f64]| clean.iter().zip(found).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(away(&left_out) < 0.01, "{}", away(&left_out));
        // The control: dead pixels that are not left out.
        assert!(away(&dead) > 0.05, "{}", away(&dead));
    }
}

//! Which air frames agree with each other, and the signal that they give per mAs, pixel by pixel.

use super::error::DetectorError;
use super::groups::{Beam, Group, median, median_and_deviation};
use super::measurement::PanelFrame;
use super::offset::Offset;
use super::surface::Surface;
use crate::acquire::ExposureLevel;
use crate::image::Image;

/// Frames of one exposure.
pub(super) struct Level<'a> {
    pub mas: Option<f64>,
    /// Over the panel and the frames, offset removed.
    pub median: f64,
    pub frames: Vec<&'a PanelFrame>,
}

/// Frames of one beam that agree.
pub(super) struct Consistent<'a> {
    pub beam: Beam,
    pub source_to_detector_mm: Option<f64>,
    /// Ascending.
    pub levels: Vec<Level<'a>>,
    pub saturated: Vec<ExposureLevel>,
    pub left_out: Vec<String>,
    /// Of the signal per mAs from frame to frame.
    pub output_scatter: f64,
}

/// The panel's signal with nothing in the beam.
pub(super) struct AirMap {
    /// Per mAs, median over the panel; `None` when the mAs are not stated.
    pub per_mas: Option<f64>,
    /// Median over the panel of the frames' mean.
    pub median: f64,
    /// Scatter of the tube's output from frame to frame.
    pub relative_sigma: f64,
    /// Relative to the median over the panel.
    pub share: Image<f32>,
    /// The smooth part of `share`.
    pub smooth: Image<f32>,
    /// 1 − smallest / largest of it.
    pub heel_share: f64,
}

/// Signal per mAs that is farther than this from the others' is left out or refused.
const PROPORTIONAL: f64 = 0.05;
/// Exposures that differ by less are one level.
const SAME_LEVEL: f64 = 0.03;
/// Least side of the blocks in which frames are compared with each other.
const BLOCK_PX: usize = 8;
/// A block differs when it is this many deviations off …
const OUTLIER_SIGMAS: f64 = 8.0;
/// … and by more than this share.
const OUTLIER_SHARE: f64 = 0.01;
/// At most this share of the frames may be left out.
const MOST_LEFT_OUT: f64 = 0.34;
/// A pixel this far from the smooth surface belongs to a thing in the beam, if it has enough neighbours like it.
const OBJECT_SHARE: f64 = 0.1;
/// Connected pixels that make a thing, at least this wide and high.
const OBJECT_PIXELS: usize = 12;
const OBJECT_SIDE_PX: usize = 3;
/// Below this share of its neighbours' signal a pixel is dead rather than in a shadow.
const SHADOW_LEAST: f64 = 0.03;
/// Maps are kept in steps of this, so that they pack.
const STEP: f64 = 1.0 / 16384.0;

/// Signal of a frame, offset removed, median over the panel.
fn signal_median(frame: &PanelFrame, offset: &Offset) -> f64 {
    let signal = frame.pixels.pixels.iter().enumerate().map(|(at, v)| (f64::from(*v) - offset.at(at)) as f32);
    // The mean of the middle half is finer than the median, and as safe from shadows.
    let mut values: Vec<f32> = signal.collect();
    values.sort_unstable_by(f32::total_cmp);
    let middle = &values[values.len() / 4..(values.len() * 3).div_ceil(4)];
    middle.iter().map(|v| f64::from(*v)).sum::<f64>() / middle.len().max(1) as f64
}

/// Leaves out frames that contradict the others.
pub(super) fn consistent<'a>(group: &Group<'a>, offset: &Offset) -> Result<Consistent<'a>, DetectorError> {
    let mut left_out = group.left_out.clone();
    let mut frames: Vec<(&PanelFrame, f64)> = group.frames.iter().map(|frame| (*frame, signal_median(frame, offset))).collect();
    let per_mas = |(frame, signal): &(&PanelFrame, f64)| frame.exposure_mas.map(|mas| signal / mas);
    let outputs: Vec<f64> = frames.iter().filter_map(per_mas).collect();
    let (centre, _) = median_and_deviation(&outputs);
    let far = |entry: &(&PanelFrame, f64)| per_mas(entry).is_some_and(|output| !((output / centre - 1.0).abs() <= PROPORTIONAL));
    let odd: Vec<(&PanelFrame, f64)> = frames.iter().filter(|entry| far(entry)).copied().collect();
    if odd.len() as f64 > MOST_LEFT_OUT * frames.len() as f64 || (odd.len() == 1 && frames.len() == 2) {
        let by_output =
            |a: &&(&PanelFrame, f64), b: &&(&PanelFrame, f64)| per_mas(a).unwrap_or(0.0).total_cmp(&per_mas(b).unwrap_or(0.0));
        let (most, least) = (frames.iter().max_by(by_output), frames.iter().min_by(by_output));
        let label = |entry: Option<&(&PanelFrame, f64)>| entry.map(|(frame, _)| frame.label.clone()).unwrap_or_default();
        let ends = [most, least].map(|entry| entry.and_then(per_mas).unwrap_or(f64::NAN));
        return Err(DetectorError::NotProportional {
            beam: group.beam.words(),
            scatter: 100.0 * (ends[0] / ends[1] - 1.0),
            most: label(most),
            least: label(least),
        });
    }
    for (frame, signal) in &odd {
        let ratio = signal / frame.exposure_mas.unwrap_or(1.0) / centre;
        left_out.push(format!("{}: its signal per mAs is {ratio:.3} of the others'", frame.label));
    }
    frames.retain(|entry| !far(entry));
    let outliers = outliers(&frames, offset);
    if outliers.len() as f64 > MOST_LEFT_OUT * frames.len() as f64 {
        return Err(DetectorError::TooManyOutliers {
            found: outliers.len(),
            of: frames.len(),
            beam: group.beam.words(),
            first: outliers[0].1.clone(),
        });
    }
    left_out.extend(outliers.iter().map(|(_, reason)| reason.clone()));
    let mut index = 0;
    frames.retain(|_| {
        index += 1;
        !outliers.iter().any(|(outlier, _)| *outlier == index - 1)
    });
    let outputs: Vec<f64> = frames.iter().filter_map(per_mas).collect();
    let mean = outputs.iter().sum::<f64>() / outputs.len().max(1) as f64;
    let scatter = outputs.iter().map(|output| (output / mean - 1.0).powi(2)).sum::<f64>() / (outputs.len() as f64 - 1.0).max(1.0);
    let distances: Vec<f64> = frames.iter().filter_map(|(frame, _)| frame.source_to_detector_mm).collect();
    let source_to_detector_mm = (!distances.is_empty()).then(|| median_and_deviation(&distances).0);
    Ok(Consistent {
        beam: group.beam.clone(),
        source_to_detector_mm,
        levels: levels(frames),
        saturated: group.saturated.clone(),
        left_out,
        output_scatter: scatter.sqrt(),
    })
}

fn levels(mut frames: Vec<(&PanelFrame, f64)>) -> Vec<Level<'_>> {
    let key = |(frame, signal): &(&PanelFrame, f64)| frame.exposure_mas.unwrap_or(*signal);
    // A stable sort: frames of a level stay in the order in which they were taken.
    frames.sort_by(
        |a, b| if (key(a) / key(b) - 1.0).abs() <= 1e-6 { std::cmp::Ordering::Equal } else { key(a).total_cmp(&key(b)) },
    );
    let mut levels: Vec<Level> = Vec::new();
    for (frame, signal) in frames {
        let first = levels.last().map(|level| level.mas.unwrap_or(level.median));
        match levels.last_mut() {
            Some(level) if first.is_some_and(|first| (key(&(frame, signal)) / first - 1.0).abs() <= SAME_LEVEL) => {
                level.frames.push(frame);
                let n = level.frames.len() as f64;
                level.median += (signal - level.median) / n;
            }
            _ => levels.push(Level { mas: frame.exposure_mas, median: signal, frames: vec![frame] }),
        }
    }
    levels
}

/// Frames whose shape differs from the others' somewhere, with the reason: something was in the beam, or the field was another.
fn outliers(frames: &[(&PanelFrame, f64)], offset: &Offset) -> Vec<(usize, String)> {
    if frames.len() < 2 {
        return Vec::new();
    }
    let (width, height) = (frames[0].0.pixels.width, frames[0].0.pixels.height);
    let blocks = blocks(width, height);
    let shapes: Vec<Vec<f64>> = frames.iter().map(|(frame, signal)| block_means(frame, *signal, offset, &blocks)).collect();
    let mut found = Vec::new();
    let typical: Vec<f64> =
        (0..blocks.len()).map(|block| median(shapes.iter().map(|shape| shape[block] as f32).collect())).collect();
    for (index, shape) in shapes.iter().enumerate() {
        let relative: Vec<f64> = shape.iter().zip(&typical).map(|(a, b)| if *b > 0.0 { a / b - 1.0 } else { 0.0 }).collect();
        let (centre, deviation) = median_and_deviation(&relative);
        let excess = |block: usize| (relative[block] - centre).abs() / (OUTLIER_SIGMAS * deviation).max(OUTLIER_SHARE);
        let worst = (0..blocks.len()).max_by(|a, b| excess(*a).total_cmp(&excess(*b)));
        let Some(block) = worst else { continue };
        if !(excess(block) <= 1.0) {
            let change = relative[block] - centre;
            let [left, top, right, bottom] = blocks[block];
            let (column, row) = ((left + right) / 2, (top + bottom) / 2);
            let label = &frames[index].0.label;
            found.push((
                index,
                format!(
                    "{label}: differs from the other frames by {:+.1} % near column {column}, row {row}: something was in the beam",
                    100.0 * change
                ),
            ));
        }
    }
    found
}

/// Left, top, right and bottom of blocks that share the panel evenly: in a narrow rest at its end the noise of few pixels, or one that is
/// dead, would look like a thing in the beam.
fn blocks(width: usize, height: usize) -> Vec<[usize; 4]> {
    let (across, down) = ((width / BLOCK_PX).max(1), (height / BLOCK_PX).max(1));
    let (column, row) = (|nth: usize| nth * width / across, |nth: usize| nth * height / down);
    let block = |nth: usize| {
        let (u, v) = (nth % across, nth / across);
        [column(u), row(v), column(u + 1), row(v + 1)]
    };
    (0..across * down).map(block).collect()
}

/// Signal of each block relative to the frame's, without the outermost eighths of its pixels: single bad pixels do not matter.
fn block_means(frame: &PanelFrame, signal: f64, offset: &Offset, blocks: &[[usize; 4]]) -> Vec<f64> {
    let pixels = &frame.pixels;
    let mean = |&[left, top, right, bottom]: &[usize; 4]| {
        let places = (top..bottom).flat_map(|row| (left..right).map(move |column| row * pixels.width + column));
        let mut values: Vec<f64> = places.map(|at| (f64::from(pixels.pixels[at]) - offset.at(at)) / signal).collect();
        values.sort_unstable_by(f64::total_cmp);
        let middle = &values[values.len() / 8..values.len() - values.len() / 8];
        middle.iter().sum::<f64>() / middle.len() as f64
    };
    blocks.iter().map(mean).collect()
}

/// The air signal of frames that agree; `bad` pixels known so far are left out of the surface.
pub(super) fn map(group: &Consistent, offset: &Offset, bad: &Image<u8>) -> Result<AirMap, DetectorError> {
    let all: Vec<&PanelFrame> = group.levels.iter().flat_map(|level| level.frames.iter().copied()).collect();
    let count = bad.pixels.len();
    let n = all.len() as f64;
    let total_mas: Option<f64> = all.iter().map(|frame| frame.exposure_mas).sum();
    let mean: Vec<f64> = (0..count)
        .map(|at| all.iter().map(|frame| f64::from(frame.pixels.pixels[at])).sum::<f64>() / n - offset.at(at))
        .collect();
    let good: Vec<f32> = mean.iter().zip(&bad.pixels).filter(|(_, bad)| **bad == 0).map(|(v, _)| *v as f32).collect();
    let middle = median(good);
    let rounded = |value: f64| ((value / middle / STEP).round() * STEP) as f32;
    let share = Image { width: bad.width, height: bad.height, pixels: mean.iter().map(|v| rounded(*v)).collect() };
    let surface = Surface::fit(&share, |at| bad.pixels[at] == 0);
    let smooth = match &surface {
        Some(surface) => {
            let at = |at: usize| surface.at(at % bad.width, at / bad.width) as f32;
            Image { width: bad.width, height: bad.height, pixels: (0..count).map(at).collect() }
        }
        // A panel of a few blocks has no shape to speak of.
        None => Image::filled(bad.width, bad.height, 1.0),
    };
    refuse_objects(group, &share, &smooth, bad)?;
    Ok(AirMap {
        per_mas: total_mas.filter(|mas| *mas > 0.0).map(|mas| middle * n / mas),
        median: middle,
        relative_sigma: group.output_scatter,
        heel_share: surface.as_ref().map_or(0.0, Surface::fall),
        share,
        smooth,
    })
}

/// A shadow of several pixels each way stands in all frames, where no panel has a defect like it.
fn refuse_objects(group: &Consistent, share: &Image<f32>, smooth: &Image<f32>, bad: &Image<u8>) -> Result<(), DetectorError> {
    let change = |at: usize| f64::from(share.pixels[at]) / f64::from(smooth.pixels[at]) - 1.0;
    let shadow = |at: usize| bad.pixels[at] == 0 && !(change(at).abs() <= OBJECT_SHARE) && change(at) > SHADOW_LEAST - 1.0;
    let (width, height) = (share.width, share.height);
    let mut seen = vec![false; share.pixels.len()];
    for start in 0..share.pixels.len() {
        if seen[start] || !shadow(start) {
            continue;
        }
        seen[start] = true;
        let mut found = vec![start];
        let mut next = 0;
        while let Some(&at) = found.get(next) {
            next += 1;
            let (u, v) = (at % width, at / width);
            for row in v.saturating_sub(1)..(v + 2).min(height) {
                for column in u.saturating_sub(1)..(u + 2).min(width) {
                    let beside = row * width + column;
                    if !seen[beside] && shadow(beside) {
                        seen[beside] = true;
                        found.push(beside);
                    }
                }
            }
        }
        let side = |coordinate: &dyn Fn(usize) -> usize| {
            let ends = found.iter().map(|&at| coordinate(at)).fold((usize::MAX, 0), |(l, h), c| (l.min(c), h.max(c)));
            ends.1 + 1 - ends.0
        };
        let (wide, high) = (side(&|at| at % width), side(&|at| at / width));
        if found.len() >= OBJECT_PIXELS && wide >= OBJECT_SIDE_PX && high >= OBJECT_SIDE_PX {
            let n = found.len();
            let sum = found.iter().fold((0, 0, 0.0), |(u, v, c), &at| (u + at % width, v + at / width, c + change(at)));
            return Err(DetectorError::Object {
                beam: group.beam.words(),
                column: sum.0 / n,
                row: sum.1 / n,
                change: 100.0 * sum.2 / n as f64,
                pixels: n,
            });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A last block of one column was judged as a full one, and named a place outside the panel.
    #[test]
    fn blocks_share_a_panel_of_any_size_and_none_is_narrow() {
        let mut cases = 0;
        for (width, height) in [(177, 217), (193, 248), (256, 192), (9, 15), (8, 8), (5, 1), (64, 3)] {
            let mut seen = vec![0; width * height];
            for [left, top, right, bottom] in blocks(width, height) {
                assert!(right - left >= BLOCK_PX.min(width) && bottom - top >= BLOCK_PX.min(height), "{width} x {height}");
                assert!((left + right) / 2 < width && (top + bottom) / 2 < height, "{width} x {height}");
                (top..bottom).for_each(|row| (left..right).for_each(|column| seen[row * width + column] += 1));
            }
            assert!(seen.iter().all(|times| *times == 1), "{width} x {height}");
            cases += 1;
        }
        assert_eq!(cases, 7);
    }
}

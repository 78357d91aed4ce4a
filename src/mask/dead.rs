//! Dead and hot pixels that a frame shows by itself: single ones, small clusters, lines.
//!
//! What stands before the panel is spread over several pixels by its point spread; a pixel that does not answer differs from all around it
//! alone. So a pixel counts that differs from its surroundings by more than noise ever does in a frame, in a cluster of no more than
//! three by three, beside which nothing is left of the difference. Edges, beads of a pixel's radius and more and wires of two pixels and more are
//! seen by their neighbours too; a line as thin that runs along a row from side to side may be taken for one of the panel's.

use rayon::prelude::*;

use super::dead_lines::dead_lines;
use super::local_noise::{LocalNoise, VarianceBound, around};
use super::text::{Component, components};
use crate::image::Image;

/// Smaller frames are not looked at.
const SMALLEST_PX: usize = 64;
/// Pixels that noise may take out of a frame, where that of one pixel says nothing of the next.
const FALSE_A_FRAME: f64 = 0.3;
/// Before a ring's median is taken a pixel must differ by so many σ from four of its pixels.
const WORTH_A_LOOK: f64 = 3.5;
/// Its square, less what single precision may be off; and so many pixels of a row are told at once that none of them does.
const LOOK_SQUARED: f32 = (0.999_9 * WORTH_A_LOOK * WORTH_A_LOOK) as f32;
const PIECE_PX: usize = 32;
/// Side of a cluster, at most.
const LARGEST_CLUSTER: usize = 3;
/// Smaller differences than this share of a larger one are its skirt, so many pixels about it.
const SKIRT: f32 = 0.3;
const SKIRT_PX: usize = 3;
/// Beside a cluster single pixels may differ by this share of it, or so many σ, and all of them together by this share.
const LEFT_BESIDE: f64 = 0.3;
const SIGMAS_BESIDE: f64 = 4.5;
const MEAN_BESIDE: f64 = 0.2;
/// Several that are too dark may be a bead's shadow: dead ones are as dark to this share, and beside them less is left.
const AS_DARK: f64 = 0.8;
const LEFT_BESIDE_DARK: f64 = 0.15;
const MEAN_BESIDE_DARK: f64 = 0.1;
/// Points and dots of letters lie this near to them.
const NEAR_WRITING_PX: usize = 8;
/// A frame of which more is dead is another kind of picture.
const MOST_DEAD: f64 = 0.01;

/// The dead pixels of `pixels`, proportional to quanta up to an offset, among those that are `usable` and not beside what is `written`; `None`
/// without any.
pub(super) fn dead_pixels(pixels: &Image<f32>, usable: &Image<bool>, written: Option<&Image<bool>>) -> Option<Image<bool>> {
    let (width, height) = (pixels.width, pixels.height);
    if width < SMALLEST_PX || height < SMALLEST_PX {
        return None;
    }
    let noise = LocalNoise::measure(pixels, usable)?;
    let is_most = |mask: &Image<bool>| {
        let count = mask.pixels.iter().filter(|dead| **dead).count();
        count as f64 > MOST_DEAD * mask.pixels.len() as f64
    };
    let mut dead = dead_lines(pixels, usable, noise.floor);
    // A grid's lines, or those of a readout.
    if is_most(&dead) {
        dead.pixels.fill(false);
    }
    let outliers = outliers(pixels, usable, &noise);
    for cluster in components(&outliers) {
        let is_beside_writing = written.is_some_and(|written| any_near(written, &cluster, NEAR_WRITING_PX));
        if !is_beside_writing && stands_alone(pixels, &outliers, &cluster, &noise) {
            cluster.indices.iter().for_each(|&at| dead.pixels[at] = true);
        }
    }
    (dead.pixels.contains(&true) && !is_most(&dead)).then_some(dead)
}

/// Pixels that differ from their surroundings by more than noise does.
fn outliers(pixels: &Image<f32>, usable: &Image<bool>, noise: &LocalNoise) -> Image<bool> {
    let (width, height) = (pixels.width, pixels.height);
    let rarity = (pixels.pixels.len() as f64 / FALSE_A_FRAME).ln();
    let bound = noise.variance_bound();
    // Columns and differences of those of a row.
    let departures: Vec<Vec<(usize, f32)>> = (0..height)
        .into_par_iter()
        .map(|row| {
            let mut found = Vec::new();
            for columns in worth_a_look(pixels, row, &bound) {
                found.extend(columns.filter_map(|column| {
                    let difference = departure(pixels, usable, noise, [column, row], rarity)?;
                    Some((column, difference))
                }));
            }
            found
        })
        .collect();
    let mut outliers = Image::filled(width, height, false);
    for (v, found) in departures.iter().enumerate() {
        for (u, own) in found {
            let near = &departures[v.saturating_sub(SKIRT_PX)..(v + SKIRT_PX + 1).min(height)];
            let largest = near.iter().fold(0.0f32, |largest, found| {
                let first = found.partition_point(|(column, _)| column + SKIRT_PX < *u);
                let beside = found[first..].iter().take_while(|(column, _)| *column <= u + SKIRT_PX);
                beside.fold(largest, |largest, (_, other)| largest.max(other.abs()))
            });
            outliers.pixels[v * width + u] = own.abs() >= SKIRT * largest;
        }
    }
    outliers
}

/// Columns of a row's pieces, in order, but for those in which each pixel is as near to the four that [`departure`] asks first as noise has it.
fn worth_a_look(pixels: &Image<f32>, row: usize, bound: &VarianceBound) -> impl Iterator<Item = std::ops::Range<usize>> {
    let (width, height) = (pixels.width, pixels.height);
    let [above, own, below] =
        [row.saturating_sub(2), row, (row + 2).min(height - 1)].map(|row| &pixels.pixels[row * width..][..width]);
    let inner = (2..width - 2).step_by(PIECE_PX).map(move |first| first..(first + PIECE_PX).min(width - 2));
    let is_worth = move |columns: &std::ops::Range<usize>| {
        let (start, end) = (columns.start, columns.end);
        let beside = own[start - 2..end - 2].iter().zip(&own[start + 2..end + 2]);
        let across = above[start..end].iter().zip(&below[start..end]);
        own[start..end].iter().zip(across.zip(beside)).fold(false, |is_worth, (own, ((above, below), (left, right)))| {
            let rough = 0.25 * (above + below + left + right);
            let difference = own - rough;
            is_worth | !(difference * difference <= LOOK_SQUARED * bound.at(rough))
        })
    };
    std::iter::once(0..2).chain(inner.filter(is_worth)).chain(std::iter::once(width - 2..width))
}

/// By how much a pixel differs from its surroundings, where that is more than noise does.
fn departure(
    pixels: &Image<f32>,
    usable: &Image<bool>,
    noise: &LocalNoise,
    [column, row]: [usize; 2],
    rarity: f64,
) -> Option<f32> {
    let (width, height) = (pixels.width, pixels.height);
    let line = |row: usize| &pixels.pixels[row * width..][..width];
    let (own, above, below) = (line(row), line(row.saturating_sub(2)), line((row + 2).min(height - 1)));
    let four = above[column] + below[column] + own[column.saturating_sub(2)] + own[(column + 2).min(width - 1)];
    let rough = f64::from(0.25 * four);
    // What is not finite beside it is looked at more closely.
    if !usable.pixels[row * width + column] || (f64::from(own[column]) - rough).abs() <= WORTH_A_LOOK * noise.sigma(rough) {
        return None;
    }
    let around = around(pixels, column, row)?;
    let difference = own[column] - around;
    let is_beyond = difference.is_finite() && noise.is_beyond(f64::from(difference), f64::from(around), rarity);
    // Those that are equal to it differ by nothing.
    (is_beyond && difference != 0.0).then_some(difference)
}

/// Columns and rows of a cluster's box, grown by `margin` as far as the frame reaches.
fn grown(cluster: &Component, margin: usize, width: usize, height: usize) -> [std::ops::Range<usize>; 2] {
    let [left, right, top, bottom] = cluster.bounds();
    [left.saturating_sub(margin)..(right + margin + 1).min(width), top.saturating_sub(margin)..(bottom + margin + 1).min(height)]
}

fn any_near(mask: &Image<bool>, cluster: &Component, margin: usize) -> bool {
    let [columns, mut rows] = grown(cluster, margin, mask.width, mask.height);
    rows.any(|row| mask.pixels[row * mask.width..][columns.clone()].contains(&true))
}

/// Whether `cluster`, one of `outliers`, is small, and its neighbours are as if it were not there.
fn stands_alone(pixels: &Image<f32>, outliers: &Image<bool>, cluster: &Component, noise: &LocalNoise) -> bool {
    let (width, height) = (pixels.width, pixels.height);
    let [left, right, top, bottom] = cluster.bounds();
    if right - left >= LARGEST_CLUSTER || bottom - top >= LARGEST_CLUSTER {
        return false;
    }
    let [beside_columns, beside_rows] = grown(cluster, 1, width, height);
    let [columns, rows] = grown(cluster, 2, width, height);
    let (mut beside, mut far) = (Vec::new(), Vec::new());
    for row in rows {
        for column in columns.clone() {
            let at = row * width + column;
            let value = f64::from(pixels.pixels[at]);
            if !value.is_finite() {
                continue;
            }
            if !(beside_columns.contains(&column) && beside_rows.contains(&row)) {
                far.push(value);
            } else if !outliers.pixels[at] {
                beside.push(value);
            }
        }
    }
    if far.len() < 8 || beside.len() < 3 {
        return false;
    }
    far.sort_unstable_by(f64::total_cmp);
    let level = 0.5 * (far[(far.len() - 1) / 2] + far[far.len() / 2]);
    let own = || cluster.indices.iter().map(move |&at| f64::from(pixels.pixels[at]) - level);
    let largest = own().fold(0.0f64, |largest, other| if other.abs() > largest.abs() { other } else { largest });
    let least = own().map(f64::abs).fold(f64::INFINITY, f64::min);
    let may_be_bead = largest < 0.0 && cluster.indices.len() > 1;
    if may_be_bead && !(least >= AS_DARK * largest.abs()) {
        return false;
    }
    let [left_beside, mean_beside] = if may_be_bead { [LEFT_BESIDE_DARK, MEAN_BESIDE_DARK] } else { [LEFT_BESIDE, MEAN_BESIDE] };
    let room = (left_beside * least).max(SIGMAS_BESIDE * noise.sigma(level));
    let mut off: Vec<f64> = far.iter().map(|value| (value - level).abs()).collect();
    off.sort_unstable_by(f64::total_cmp);
    let mean = beside.iter().map(|value| (value - level) * largest.signum()).sum::<f64>() / beside.len() as f64;
    off[3 * off.len() / 4] <= room && beside.iter().all(|value| (value - level).abs() <= room) && mean <= mean_beside * least
}

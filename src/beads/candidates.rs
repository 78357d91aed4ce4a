//! Blobs of any size: places where the smaller of the two principal curvatures is still large against its surroundings.
//!
//! An edge or a wire has one strong and one weak curvature; a sphere's shadow has two strong ones. The response at scale σ is
//! q = −σ² λ_max of the Hessian of the Gaussian-smoothed image (scale-normalised, Lindeberg 1998), on a pyramid with two scales an octave.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::image::{Image, quantile};

/// A blob that may be a bead.
#[derive(Clone, Copy, Debug)]
pub struct Candidate {
    /// Column.
    pub u_px: f64,
    /// Row.
    pub v_px: f64,
    /// Radius of the sphere whose shadow responds most at this scale.
    pub radius_px: f64,
    /// Response over the median response of the neighbourhood.
    pub strength: f64,
    /// Scale-normalised response in the image's unit.
    response: f64,
}

impl Candidate {
    /// Whether `other` is the same blob at another scale.
    fn is_place_of(&self, other: &Self) -> bool {
        let ratio = self.radius_px / other.radius_px;
        (0.4..2.5).contains(&ratio)
            && (self.u_px - other.u_px).hypot(self.v_px - other.v_px) < SAME_RADII * self.radius_px.max(other.radius_px)
    }
}

/// Blobs of alike scales that are nearer than so many radii are one.
const SAME_RADII: f64 = 0.5;

/// Which blobs lie near a place: a frame of few quanta has a hundred thousand peaks.
struct Places {
    /// Side of the cells.
    cell_px: f64,
    columns: usize,
    cells: Vec<Vec<usize>>,
}

impl Places {
    /// Of blobs in `image` that are one with none farther than `reach_px` away.
    fn new(image: &Image<f32>, reach_px: f64) -> Self {
        let cell_px = reach_px.max(4.0);
        let cells_along = |side: usize| (side as f64 / cell_px) as usize + 1;
        let (columns, rows) = (cells_along(image.width), cells_along(image.height));
        Self { cell_px, columns, cells: vec![Vec::new(); columns * rows] }
    }

    /// Column and row of the cell that holds a blob.
    fn cell(&self, candidate: &Candidate) -> (usize, usize) {
        ((candidate.u_px / self.cell_px) as usize, (candidate.v_px / self.cell_px) as usize)
    }

    fn add(&mut self, candidate: &Candidate, index: usize) {
        let (column, row) = self.cell(candidate);
        self.cells[row * self.columns + column].push(index);
    }

    /// Those in the cells about a blob.
    fn near(&self, candidate: &Candidate) -> impl Iterator<Item = usize> + '_ {
        let (column, row) = self.cell(candidate);
        let rows = self.cells.len() / self.columns;
        let across = column.saturating_sub(1)..(column + 2).min(self.columns);
        (row.saturating_sub(1)..(row + 2).min(rows))
            .flat_map(move |row| across.clone().map(move |column| row * self.columns + column))
            .flat_map(|cell| self.cells[cell].iter().copied())
    }
}

/// A chord profile of radius r responds most at σ ≈ 0.55 r.
const RADIUS_PER_SIGMA: f64 = 1.8;
/// Radius of the sphere whose shadow responds most at `sigma` on a level of every `step`-th pixel.
fn radius_px_of(sigma: f64, step: usize) -> f64 {
    sigma * step as f64 * RADIUS_PER_SIGMA
}

/// Scales that are looked at, in the smallest and the largest radius.
const SMALLEST: f64 = 0.55;
const LARGEST: f64 = 1.8;
/// Side of the tiles in which responses are compared, in pixels of the octave.
const TILE: usize = 32;

/// Blobs so strong are looked at beyond the number that is usual, up to so many more: writing and dead pixels are hundreds of them, and a bead
/// is no less clear for that.
const STRONG: f64 = 10.0;
const MOST_BESIDES: usize = 480;
/// Blobs of each scale that are looked at however strong others are.
const OF_EACH_SCALE: usize = 16;

/// Bright blobs of `image` whose radius may lie in `radius_px`, the `most` strongest, other strong ones and the strongest of each scale,
/// strongest first. Pixels that are not `usable` yield none.
pub fn find(image: &Image<f32>, usable: &Image<bool>, radius_px: (f64, f64), most: usize) -> Vec<Candidate> {
    let (mut found, mut radii) = (Vec::new(), Vec::new());
    let mut level = blur(image, (1.0f64 - 0.25).sqrt());
    let mut step = 1usize;
    while level.width >= 16 && level.height >= 16 {
        let wider = blur(&level, 1.0);
        for (smoothed, sigma) in [(&level, 1.0), (&wider, std::f64::consts::SQRT_2)] {
            let radius = radius_px_of(sigma, step);
            if radius >= SMALLEST * radius_px.0 && radius <= LARGEST * radius_px.1 {
                find_at_scale(smoothed, usable, sigma, step, &mut found);
                radii.push(radius);
            }
        }
        if step as f64 * RADIUS_PER_SIGMA > LARGEST * radius_px.1 {
            break;
        }
        level = halve(&blur(&wider, std::f64::consts::SQRT_2));
        step *= 2;
    }
    found.sort_by(|a, b| b.response.total_cmp(&a.response));
    let surroundings: Vec<Surroundings> = radii.into_iter().map(Surroundings::new).collect();
    let stands_out: Vec<bool> = found
        .par_iter()
        .map(|candidate| {
            let of_scale = surroundings.iter().find(|s| s.radius == candidate.radius_px.to_bits());
            of_scale.is_some_and(|surroundings| surroundings.are_darker(image, candidate))
        })
        .collect();
    let (mut kept, mut places) = (Vec::<Candidate>::new(), Places::new(image, SAME_RADII * LARGEST * radius_px.1));
    for (candidate, stands_out) in found.into_iter().zip(stands_out) {
        if !stands_out {
            continue;
        }
        if let Some(at) = places.near(&candidate).filter(|at| kept[*at].is_place_of(&candidate)).min() {
            // How clear a blob is does not depend on the scale at which it is largest: there it may lie among others as large.
            kept[at].strength = kept[at].strength.max(candidate.strength);
        } else {
            places.add(&candidate, kept.len());
            kept.push(candidate);
        }
    }
    kept.sort_by(|a, b| b.strength.total_cmp(&a.strength));
    let strong = kept.iter().take_while(|candidate| candidate.strength >= STRONG).count();
    let taken = strong.clamp(most, most + MOST_BESIDES);
    // Noise has by far the most peaks at the smallest scale: they must not crowd out the few of a larger one.
    let mut of_scale: BTreeMap<u64, usize> = BTreeMap::new();
    kept.into_iter()
        .enumerate()
        .filter(|(rank, candidate)| {
            let ahead = of_scale.entry(candidate.radius_px.to_bits()).or_default();
            *ahead += 1;
            *rank < taken || *ahead <= OF_EACH_SCALE
        })
        .map(|(_, candidate)| candidate)
        .collect()
}

/// The pixels about a blob that tell whether it stands out: its middle, and the ring outside by sectors.
struct Surroundings {
    /// Bits of the radius that they are of.
    radius: u64,
    reach: usize,
    /// Column, row and sector of each pixel, line by line; the middle is sector 8.
    pixels: Vec<(i32, i32, usize)>,
}

const MIDDLE: usize = 8;

impl Surroundings {
    fn new(radius_px: f64) -> Self {
        let radius = radius_px.max(1.5);
        let (outer, inner, core) = (1.9 * radius + 0.7, 1.15 * radius + 0.3, (0.5 * radius).max(0.8));
        let reach = outer.ceil() as i32;
        let mut pixels = Vec::new();
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let distance = f64::from(dx * dx + dy * dy).sqrt();
                if distance <= core {
                    pixels.push((dx, dy, MIDDLE));
                } else if distance >= inner && distance <= outer {
                    let angle = f64::from(dy).atan2(f64::from(dx)) / std::f64::consts::TAU + 0.5;
                    pixels.push((dx, dy, ((angle * 8.0) as usize).min(7)));
                }
            }
        }
        Self { radius: radius_px.to_bits(), reach: reach as usize, pixels }
    }

    /// Whether the middle is brighter than its surroundings all round: of eight sectors of the ring outside, six at least lie clearly
    /// below it. Cheap, and rids the fit of edges, wires and corners.
    fn are_darker(&self, image: &Image<f32>, candidate: &Candidate) -> bool {
        let (column, row) = (candidate.u_px as usize, candidate.v_px as usize);
        let inside = |at: usize, end: usize| at >= self.reach && at + self.reach < end;
        let is_inside = inside(column, image.width) && inside(row, image.height);
        let mut sums = [(0.0f64, 0.0f64); 9];
        for (dx, dy, sector) in &self.pixels {
            let (column, row) = (column as i64 + i64::from(*dx), row as i64 + i64::from(*dy));
            if !is_inside && (column < 0 || row < 0 || column >= image.width as i64 || row >= image.height as i64) {
                continue;
            }
            let sum = &mut sums[*sector];
            sum.0 += f64::from(image.pixels[row as usize * image.width + column as usize]);
            sum.1 += 1.0;
        }
        let middle = sums[MIDDLE].0 / sums[MIDDLE].1;
        let mut drops: Vec<f64> = sums[..MIDDLE].iter().filter(|s| s.1 > 0.0).map(|s| middle - s.0 / s.1).collect();
        if drops.len() < 6 {
            return false;
        }
        drops.sort_by(f64::total_cmp);
        let typical = drops[drops.len() / 2];
        typical > 0.0 && drops[drops.len() - 6] > 0.3 * typical && drops[0] > -typical
    }
}

fn find_at_scale(image: &Image<f32>, usable: &Image<bool>, sigma: f64, step: usize, found: &mut Vec<Candidate>) {
    let (w, h) = (image.width, image.height);
    let scale = (sigma * sigma) as f32;
    let mut response = Image::filled(w, h, 0.0f32);
    let mut trace = Image::filled(w, h, 0.0f32);
    let rows = response.pixels.par_chunks_mut(w).zip(trace.pixels.par_chunks_mut(w)).enumerate();
    rows.filter(|(row, _)| (1..h - 1).contains(row)).for_each(|(row, (response, trace))| {
        let [above, own, below] = [row - 1, row, row + 1].map(|row| &image.pixels[row * w..(row + 1) * w]);
        let (response, trace) = (&mut response[..w], &mut trace[..w]);
        for column in 1..w - 1 {
            let xx = own[column - 1] - 2.0 * own[column] + own[column + 1];
            let yy = above[column] - 2.0 * own[column] + below[column];
            let xy = 0.25 * (above[column - 1] + below[column + 1] - above[column + 1] - below[column - 1]);
            let half = 0.5 * (xx + yy);
            let largest = half + (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
            response[column] = -largest * scale;
            trace[column] = half.abs() * scale;
        }
    });
    let (tiles_across, tiles_down) = (w.div_ceil(TILE), h.div_ceil(TILE));
    let median_of = |tile: usize| {
        let (tile_row, tile_column) = (tile / tiles_across, tile % tiles_across);
        let mut inside: Vec<f32> = Vec::with_capacity(TILE * TILE);
        for row in tile_row * TILE..((tile_row + 1) * TILE).min(h) {
            for column in tile_column * TILE..((tile_column + 1) * TILE).min(w) {
                let at = (row * step).min(usable.height - 1) * usable.width + (column * step).min(usable.width - 1);
                if usable.pixels[at] {
                    inside.push(trace.pixels[row * w + column]);
                }
            }
        }
        quantile(&mut inside, 0.5).unwrap_or(0.0) as f32 / 0.6745
    };
    let medians: Vec<f32> = (0..tiles_across * tiles_down).into_par_iter().map(median_of).collect();
    let mut positive: Vec<f32> = medians.iter().copied().filter(|m| *m > 0.0).collect();
    let typical = quantile(&mut positive, 0.5).unwrap_or(0.0) as f32;
    let peaks = (1..h - 1).into_par_iter().flat_map_iter(|row| {
        let (response, line) = (&response, &response.pixels[row * w..(row + 1) * w]);
        let medians = &medians[row / TILE * tiles_across..][..tiles_across];
        (1..w - 1).filter_map(move |column| {
            let value = line[column];
            let noise = medians[column / TILE].max(0.3 * typical).max(f32::MIN_POSITIVE);
            if !(value > 2.5 * noise) {
                return None;
            }
            let is_peak = (0..9).filter(|n| *n != 4).all(|n| {
                let other = response.pixels[(row + n / 3 - 1) * w + column + n % 3 - 1];
                value > other || (value == other && n > 4)
            });
            let (full_column, full_row) = (column * step, row * step);
            let in_frame = full_column < usable.width && full_row < usable.height;
            (is_peak && in_frame && usable.pixels[full_row * usable.width + full_column]).then(|| Candidate {
                u_px: full_column as f64,
                v_px: full_row as f64,
                radius_px: radius_px_of(sigma, step),
                strength: f64::from(value / noise),
                response: f64::from(value),
            })
        })
    });
    found.par_extend(peaks);
}

/// Every second pixel of every second row; pixel (i, j) of the result lies at (2i, 2j).
fn halve(image: &Image<f32>) -> Image<f32> {
    let (width, height) = (image.width.div_ceil(2), image.height.div_ceil(2));
    let mut pixels = vec![0.0; width * height];
    let rows = pixels.par_chunks_mut(width.max(1)).zip(image.pixels.par_chunks(2 * image.width.max(1)));
    rows.for_each(|(out, rows)| out.iter_mut().zip(rows.iter().step_by(2)).for_each(|(out, value)| *out = *value));
    Image { width, height, pixels }
}

/// Gaussian of standard deviation `sigma_px`, the border repeated.
pub fn blur(image: &Image<f32>, sigma_px: f64) -> Image<f32> {
    let reach = (3.0 * sigma_px).ceil().max(1.0) as usize;
    let mut kernel: Vec<f32> = (0..=reach).map(|n| (-0.5 * (n as f64 / sigma_px).powi(2)).exp() as f32).collect();
    let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f32>();
    kernel.iter_mut().for_each(|weight| *weight /= sum);
    let (w, h) = (image.width, image.height);
    let mut across = vec![0.0f32; w * h];
    across.par_chunks_mut(w.max(1)).zip(image.pixels.par_chunks(w.max(1))).for_each(|(across, line)| {
        across.iter_mut().zip(line).for_each(|(out, value)| *out = kernel[0] * value);
        let inner = reach.min(w)..w.saturating_sub(reach).max(reach.min(w));
        for (n, weight) in kernel.iter().enumerate().skip(1) {
            if !inner.is_empty() {
                let (left, right) = (&line[inner.start - n..inner.end - n], &line[inner.start + n..inner.end + n]);
                add_weighted(&mut across[inner.clone()], *weight, left, right);
            }
            for column in (0..inner.start).chain(inner.end..w) {
                across[column] += weight * (line[column.saturating_sub(n)] + line[(column + n).min(w - 1)]);
            }
        }
    });
    let mut pixels = vec![0.0f32; w * h];
    pixels.par_chunks_mut(w.max(1)).enumerate().for_each(|(row, out)| {
        for (n, weight) in kernel.iter().enumerate() {
            let [above, below] = [row.saturating_sub(n), (row + n).min(h - 1)].map(|row| &across[row * w..(row + 1) * w]);
            add_weighted(out, if n == 0 { 0.5 } else { 1.0 } * weight, above, below);
        }
    });
    Image { width: w, height: h, pixels }
}

/// Adds `weight` times the sum of two lines.
fn add_weighted(out: &mut [f32], weight: f32, one: &[f32], other: &[f32]) {
    for ((out, one), other) in out.iter_mut().zip(one).zip(other) {
        *out += weight * (one + other);
    }
}

//! What skipping pixels would cost in a view: a coarse image of it, cast before planning, and where that image bends.

use super::RenderError;
use super::cpu::attenuate_spectrum::attenuate_spectrum;
use super::cpu::enlarge_density::enlarge_density;
use super::cpu::integrate_density::{Density, integrate_density};
use super::outline::outlined;
use super::plan::Sampling;
use super::prepared::Prepared;
use super::spectrum::Bins;
use super::tiles::{TILE_PX, Tiles};
use crate::geometry::View;
use crate::random::{Purpose, Stream};

/// Pixels between those that are cast, the largest step that a plan takes.
const STEP: u32 = 4;
/// Tiles in which a block of pixels is cast and compared with what interpolation makes of it.
const SAMPLES: usize = 100;
/// Pixels along either side of such a block.
const EDGE: u32 = 9;
/// The interpolation's error is taken to be at most this many times its largest error in the sampled blocks.
const SAFETY: f64 = 2.0;
/// Shares of the tiles without outlines that are cast in full because they bend most: the fewest leave out the worst that bone does.
const SHARES: [f64; 4] = [0.1, 0.3, 0.5, 0.7];

/// Steps between cast pixels that are compared.
pub const STEPS: [u32; 2] = [2, 4];

/// What the coarse image showed.
#[derive(Debug)]
pub struct Survey {
    outlined: Tiles,
    /// By tile: the largest second difference of the coarse image in it, in the measure of errors.
    bends: Vec<f64>,
    /// Tiles that were sampled, and the largest error of interpolation in each by step.
    sampled: Vec<(usize, [f64; 2])>,
}

/// A way to skip pixels.
#[derive(Clone, Debug)]
pub struct Skipping {
    /// Tiles that are cast in full.
    pub tiles: Tiles,
    /// Bounds of the interpolation's error in all others, by step.
    pub errors: [f64; 2],
}

/// Casts every fourth pixel of `view`, and all pixels of some blocks; `prepare` looks at the scene from a view. Without `bins` paths are
/// compared, g/cm² by material.
///
/// # Errors
/// As [`Prepared::new`].
pub fn survey<'a>(
    view: View,
    bins: Option<&Bins>,
    sampling: Sampling,
    mut prepare: impl FnMut(View) -> Result<Prepared<'a>, RenderError>,
) -> Result<Survey, RenderError> {
    let whole = prepare(view)?;
    let mut coarse = prepare(every(&view, STEP))?;
    // The detector stays where it is, however few of its pixels are cast.
    coarse.detector_mm = whole.detector_mm;
    let fields = fields(&integrate_density(&coarse, sampling), bins);
    let mut outlined = outlined(&whole);
    for tile in 0..outlined.count() {
        let bounds = outlined.bounds(tile);
        // Two coarse points do not show whether the image bends between them.
        if (0..2).any(|axis| bounds.to[axis] - bounds.from[axis] <= STEP) {
            outlined.fill(tile);
        }
    }
    let bends: Vec<f64> = (0..outlined.count()).map(|tile| bend(&fields, &outlined, tile, coarse.view.size_px)).collect();
    let quiet: Vec<usize> = (0..outlined.count()).filter(|tile| !outlined.is_full(*tile)).collect();
    let mut stream = Stream::new(0, 1, 0, Purpose::Evaluation);
    let mut sampled = Vec::new();
    for sample in 0..SAMPLES.min(quiet.len()) {
        // One tile of every stretch of them.
        let [first, end] = [sample, sample + 1].map(|n| n * quiet.len() / SAMPLES.min(quiet.len()));
        let tile = quiet[first + stream.next_u32() as usize % (end - first)];
        let bounds = outlined.bounds(tile);
        let from: [u32; 2] = std::array::from_fn(|axis| {
            let places = (bounds.to[axis] - bounds.from[axis]).saturating_sub(EDGE) / STEP + 1;
            bounds.from[axis] + stream.next_u32() % places * STEP
        });
        let size_px = [0, 1].map(|axis| EDGE.min(bounds.to[axis] - from[axis]));
        let block = prepare(part(view, from, size_px))?;
        let density = integrate_density(&block, sampling);
        sampled.push((tile, STEPS.map(|step| interpolation_error(&density, bins, size_px, step))));
    }
    Ok(Survey { outlined, bends, sampled })
}

impl Survey {
    /// Ways to skip pixels: with more and more of the tiles in full in which the image bends.
    #[must_use]
    pub fn ways(&self) -> Vec<Skipping> {
        let mut quiet: Vec<usize> = (0..self.bends.len()).filter(|tile| !self.outlined.is_full(*tile)).collect();
        quiet.sort_by(|a, b| self.bends[*b].total_cmp(&self.bends[*a]));
        let way = |share: f64| {
            let full = (share * quiet.len() as f64).ceil() as usize;
            let mut tiles = self.outlined.clone();
            quiet[..full].iter().for_each(|tile| tiles.fill(*tile));
            // A chord differs from a kink or a step by no more than the second differences around it.
            let bends = quiet.get(full).map_or(0.0, |tile| self.bends[*tile]);
            let errors = [0, 1].map(|step| {
                let sampled = self.sampled.iter().filter(|(tile, _)| !tiles.is_full(*tile)).map(|(_, errors)| errors[step]);
                larger(bends, SAFETY * sampled.fold(0.0, larger))
            });
            Skipping { tiles, errors }
        };
        // Where all tiles are full, no pixel is skipped.
        SHARES.into_iter().map(way).filter(|way| (0..way.tiles.count()).any(|tile| !way.tiles.is_full(tile))).collect()
    }
}

/// NaN stays.
fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || a > b { a } else { b }
}

/// What errors are measured in: the line integral, or g/cm² by material.
fn fields(density: &Density, bins: Option<&Bins>) -> Vec<Vec<f32>> {
    let materials = density.material_count;
    match bins {
        Some(bins) => vec![attenuate_spectrum(density, bins, false).line_integral],
        None => (0..materials).map(|m| density.g_per_cm2.iter().skip(m).step_by(materials).copied().collect()).collect(),
    }
}

/// The largest second difference, relative to values over 1, of the coarse points in a tile and on the next one's first row and column.
fn bend(fields: &[Vec<f32>], tiles: &Tiles, tile: usize, [columns, rows]: [u32; 2]) -> f64 {
    let from = tiles.bounds(tile).from.map(|n| (n / STEP) as i64);
    let reach = i64::from(TILE_PX / STEP);
    let mut worst = 0.0;
    for field in fields {
        let at = |u: i64, v: i64| {
            let inside = u >= from[0] && v >= from[1] && u <= from[0] + reach && v <= from[1] + reach;
            (inside && u < i64::from(columns) && v < i64::from(rows))
                .then(|| f64::from(field[v as usize * columns as usize + u as usize]))
        };
        for v in from[1]..from[1] + reach + 1 {
            for u in from[0]..from[0] + reach + 1 {
                for (du, dv) in [(1, 0), (0, 1), (1, 1), (1, -1)] {
                    let (Some(before), Some(here), Some(after)) = (at(u - du, v - dv), at(u, v), at(u + du, v + dv)) else {
                        continue;
                    };
                    let least = before.min(here).min(after).max(1.0);
                    worst = larger(worst, (here - 0.5 * (before + after)).abs() / least);
                }
            }
        }
    }
    worst
}

/// The largest error in a block when only every `step`-th of its pixels is kept.
fn interpolation_error(density: &Density, bins: Option<&Bins>, size_px: [u32; 2], step: u32) -> f64 {
    let (exact, thin) = (fields(density, bins), fields(&thinned(density, size_px, step as usize), bins));
    let [width, height] = size_px.map(|n| n as usize);
    // Beyond the last kept pixel the block knows nothing, the image does.
    let (last_u, last_v) = ((width - 1) / step as usize * step as usize, (height - 1) / step as usize * step as usize);
    let mut worst = 0.0;
    for (exact, thin) in exact.iter().zip(&thin) {
        for v in 0..last_v + 1 {
            for u in 0..last_u + 1 {
                let (this, other) = (f64::from(exact[v * width + u]), f64::from(thin[v * width + u]));
                worst = larger(worst, (other - this).abs() / this.max(1.0));
            }
        }
    }
    worst
}

/// What casting every `step`-th pixel and interpolating gives.
fn thinned(density: &Density, size_px: [u32; 2], step: usize) -> Density {
    let [width, height] = size_px.map(|n| n as usize);
    let coarse = [width.div_ceil(step), height.div_ceil(step)];
    let materials = density.material_count;
    let pick = |index: usize| {
        let (u, v) = (index % coarse[0] * step, index / coarse[0] * step);
        &density.g_per_cm2[(v * width + u) * materials..][..materials]
    };
    let g_per_cm2 = (0..coarse[0] * coarse[1]).flat_map(pick).copied().collect();
    let valid = vec![1; coarse[0] * coarse[1]];
    let thin = Density { material_count: materials, g_per_cm2, valid };
    enlarge_density(&thin, coarse, [width, height], step)
}

/// The part of an image from pixel `from` on.
#[must_use]
pub fn part(view: View, from: [u32; 2], size_px: [u32; 2]) -> View {
    let mut part = View { size_px, ..view };
    part.intrinsics.cx -= f64::from(from[0]);
    part.intrinsics.cy -= f64::from(from[1]);
    part
}

/// The view that casts every `step`-th pixel of `view`, far enough to interpolate the last ones.
#[must_use]
pub fn every(view: &View, step: u32) -> View {
    let mut coarse = *view;
    let scale = f64::from(step);
    let k = &mut coarse.intrinsics;
    (k.fx, k.fy, k.skew) = (k.fx / scale, k.fy / scale, k.skew / scale);
    (k.cx, k.cy) = (k.cx / scale, k.cy / scale);
    coarse.size_px = view.size_px.map(|n| n.div_ceil(step) + u32::from(n > 1));
    coarse
}

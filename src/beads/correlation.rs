//! How the noise of a frame hangs together from pixel to pixel: consoles smooth and sharpen, scintillators share light.

use rayon::prelude::*;

use crate::image::Image;

/// Largest lag, in pixels, along either axis.
pub const REACH: usize = 6;
/// Side of the tiles, and how far apart they start.
const TILE: usize = 32;
const STEP: usize = 12;
/// Tiles looked at, and how many of them are kept.
const MOST_TILES: usize = 400;
const KEPT_ONE_IN: usize = 4;
const MOST_KEPT: usize = 60;
/// Share of the variance that the correction for the trend may reach.
const MOST_TAKEN: f64 = 0.5;
/// Correlation below which a lag is taken for uncorrelated: that many tiles do not tell it from none.
const LEAST: f64 = 0.04;

/// Correlation of the noise of pixels a lag apart.
#[derive(Clone, Debug)]
pub struct Correlation {
    /// Lags (columns, rows) of one half plane that matter, and their correlation.
    lags: Vec<(i32, i32, f64)>,
    /// Variance over what second differences make of it when they take it for white.
    pub variance_ratio: f64,
}

impl Correlation {
    /// White noise.
    pub fn none() -> Self {
        Self { lags: Vec::new(), variance_ratio: 1.0 }
    }

    /// Measures tiles of `pixels` that are wholly `usable`; `sigma` is the standard deviation at a value as second differences give it.
    ///
    /// A tile's trend is taken out; the quietest tiles are kept, since what is in a tile besides noise only adds.
    pub fn measure(pixels: &Image<f32>, usable: &Image<bool>, sigma: impl Fn(f64) -> f64 + Sync) -> Self {
        let trend = Trend::new();
        let (w, h) = (pixels.width, pixels.height);
        if w < TILE || h < TILE {
            return Self::none();
        }
        let count = ((w - TILE) / STEP + 1) * ((h - TILE) / STEP + 1);
        let every = count.div_ceil(MOST_TILES);
        let places = (0..=h - TILE).step_by(STEP).flat_map(|row| (0..=w - TILE).step_by(STEP).map(move |column| (column, row)));
        let places: Vec<(usize, usize)> = places.step_by(every).collect();
        let tile_at = |(column, row): (usize, usize)| {
            let lines = || (row..row + TILE).map(|row| row * w + column..row * w + column + TILE);
            if !lines().all(|line| usable.pixels[line].iter().all(|usable| *usable)) {
                return None;
            }
            let mut tile: Vec<f64> = lines().flat_map(|line| pixels.pixels[line].iter().map(|value| f64::from(*value))).collect();
            let mean = tile.iter().sum::<f64>() / tile.len() as f64;
            let scale = 1.0 / sigma(mean);
            if !scale.is_finite() {
                return None;
            }
            tile.iter_mut().for_each(|value| *value = (*value - mean) * scale);
            trend.take_out(&mut tile);
            Some((covariance(&tile, 0, 0), tile))
        };
        let mut tiles: Vec<(f64, Vec<f64>)> = places.into_par_iter().filter_map(tile_at).collect();
        tiles.sort_by(|a, b| a.0.total_cmp(&b.0));
        let kept = (tiles.len() / KEPT_ONE_IN).clamp(12, MOST_KEPT).min(tiles.len());
        if kept < 6 {
            return Self::none();
        }
        tiles.truncate(kept);
        let at_lag = |columns, rows| middle_mean(tiles.iter().map(|(_, tile)| covariance(tile, columns, rows)).collect());
        let reach = REACH as i32;
        let half_plane = (0..=reach).flat_map(|rows| (-reach..=reach).map(move |columns| (columns, rows)));
        let half_plane: Vec<(i32, i32)> = half_plane.filter(|(columns, rows)| *rows > 0 || *columns > 0).collect();
        let lags = half_plane.into_par_iter().map(|(columns, rows)| (columns, rows, at_lag(columns, rows))).collect();
        Self::corrected(&trend, at_lag(0, 0), lags)
    }

    /// At the longest lags noise is taken to be uncorrelated. What is found there is, below zero, what the trend took of the noise, and
    /// above zero structure; towards shorter lags it grows as what the trend takes does.
    fn corrected(trend: &Trend, own: f64, mut lags: Vec<(i32, i32, f64)>) -> Self {
        let far = |lag: &&(i32, i32, f64)| lag.0.abs().max(lag.1) == REACH as i32;
        let (sum, taken) =
            lags.iter().filter(far).fold((0.0, 0.0), |(sum, taken), lag| (sum + lag.2, taken + trend.taken(lag.0, lag.1)));
        let whole = trend.taken(0, 0);
        let offset = (sum * whole / taken).clamp(-MOST_TAKEN * own, MOST_TAKEN * own) / whole;
        let variance = own - offset * whole;
        if !(variance > 0.0) {
            return Self::none();
        }
        for lag in &mut lags {
            lag.2 = (lag.2 - offset * trend.taken(lag.0, lag.1)) / variance;
        }
        lags.retain(|lag| lag.2.abs() > LEAST);
        // Second differences see a variance only through the lags they span; where nothing is correlated both measures agree.
        Self { variance_ratio: if lags.is_empty() { 1.0 } else { variance }, lags }
    }

    /// Sum of the correlation over all lags: the noise's power at low frequency over that of white noise of the same variance.
    pub fn sum(&self) -> f64 {
        1.0 + 2.0 * self.lags.iter().map(|lag| lag.2).sum::<f64>()
    }

    /// Whether no lag matters.
    pub fn is_white(&self) -> bool {
        self.lags.is_empty()
    }

    /// Σᵢⱼ aᵢ ρ(i − j) bⱼ of two grids of `side` columns, which are 0 where no pixel is.
    pub fn form(&self, a: &[f64], b: &[f64], side: usize) -> f64 {
        let mut sum: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
        for (columns, rows, correlation) in &self.lags {
            let shift = (*rows as isize * side as isize + *columns as isize).unsigned_abs().min(a.len());
            let forth: f64 = a.iter().zip(&b[shift..]).map(|(x, y)| x * y).sum();
            let back: f64 = b.iter().zip(&a[shift..]).map(|(x, y)| x * y).sum();
            sum += correlation * (forth + back);
        }
        sum
    }

    /// Σᵢⱼ ρ(i − j) over pairs of one group, over the group's pixels; `group` tells each of the `places` its group.
    pub fn excess_by_group(&self, places: &[(u16, u16)], group: &[usize], side: usize, excess: &mut [f64]) {
        let mut grid = vec![usize::MAX; side * side];
        let mut counts = vec![0.0f64; excess.len()];
        for ((column, row), group) in places.iter().zip(group) {
            grid[usize::from(*row) * side + usize::from(*column)] = *group;
            counts[*group] += 1.0;
        }
        excess.fill(0.0);
        for (columns, rows, correlation) in &self.lags {
            let shift = (*rows as isize * side as isize + *columns as isize).unsigned_abs().min(grid.len());
            for (a, b) in grid.iter().zip(&grid[shift..]) {
                if a == b && *a != usize::MAX {
                    excess[*a] += 2.0 * correlation;
                }
            }
        }
        for (excess, count) in excess.iter_mut().zip(&counts) {
            *excess = 1.0 + *excess / count.max(1.0);
        }
    }
}

/// Terms of a tile's trend: polynomials to the fourth degree.
const LINES: usize = 5;

/// Orthonormal polynomials over a tile, as products of orthonormal lines.
struct Trend {
    lines: [[f64; TILE]; LINES],
}

impl Trend {
    fn new() -> Self {
        let mut lines = [[0.0; TILE]; LINES];
        for degree in 0..LINES {
            let mut line: [f64; TILE] =
                std::array::from_fn(|n| ((n as f64 + 0.5) / (0.5 * TILE as f64) - 1.0).powi(degree as i32));
            // Gram and Schmidt, twice for the sake of rounding.
            for lower in lines[..degree].iter().chain(&lines[..degree]) {
                let share: f64 = line.iter().zip(lower).map(|(x, y)| x * y).sum();
                line.iter_mut().zip(lower).for_each(|(x, y)| *x -= share * y);
            }
            let norm = line.iter().map(|x| x * x).sum::<f64>().sqrt();
            lines[degree] = line.map(|x| x / norm);
        }
        Self { lines }
    }

    /// Takes the trend out of `tile`.
    fn take_out(&self, tile: &mut [f64]) {
        let along = |row: &[f64], line: &[f64; TILE]| row.iter().zip(line).map(|(value, x)| value * x).sum::<f64>();
        let rows: Vec<[f64; LINES]> =
            tile.chunks_exact(TILE).map(|row| std::array::from_fn(|degree| along(row, &self.lines[degree]))).collect();
        let mut shares = [[0.0; LINES]; LINES];
        for (down, shares) in shares.iter_mut().enumerate() {
            for (across, share) in shares.iter_mut().enumerate().take(LINES - down) {
                *share = rows.iter().zip(&self.lines[down]).map(|(row, y)| row[across] * y).sum();
            }
        }
        for (n, row) in tile.chunks_exact_mut(TILE).enumerate() {
            for (across, line) in self.lines.iter().enumerate() {
                let share: f64 = (0..LINES - across).map(|down| shares[down][across] * self.lines[down][n]).sum();
                row.iter_mut().zip(line).for_each(|(value, x)| *value -= share * x);
            }
        }
    }

    /// Share of the power at low frequency that the trend takes from the covariance at a lag.
    fn taken(&self, columns: i32, rows: i32) -> f64 {
        let along = |line: &[f64; TILE], lag: i32| {
            let lag = lag.unsigned_abs() as usize;
            line.iter().zip(&line[lag..]).map(|(x, y)| x * y).sum::<f64>() / (TILE - lag) as f64
        };
        let terms = (0..LINES).flat_map(|down| (0..LINES - down).map(move |across| (across, down)));
        terms.map(|(across, down)| along(&self.lines[across], columns) * along(&self.lines[down], rows)).sum()
    }
}

fn covariance(tile: &[f64], columns: i32, rows: i32) -> f64 {
    let (left, right) = ((-columns).max(0) as usize, columns.max(0) as usize);
    let width = TILE - columns.unsigned_abs() as usize;
    let height = TILE - rows.unsigned_abs() as usize;
    let mut sum = 0.0;
    for row in 0..height {
        let a = &tile[row * TILE + left..][..width];
        let b = &tile[(row + rows as usize) * TILE + right..][..width];
        sum += a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    }
    sum / (width * height) as f64
}

/// Mean of the middle half: tiles with something in them lie outside.
fn middle_mean(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let quarter = values.len() / 4;
    let middle = &values[quarter..values.len() - quarter];
    middle.iter().sum::<f64>() / middle.len() as f64
}

//! Scatter, followed elsewhere, added to what arrives.
//!
//! With S(u) the scattered signal in units of the unattenuated signal of the pixel: `intensity(u) = open(u) · Σ φ r b T / Σ φ r b + S(u)`.
//! It reaches the panel beside the collimated field as well. For noise its quanta count as ones of the beam's mean response.

use super::cpu::attenuate_spectrum::{Arriving, Signal};
use super::flood::Flood;
use super::spectrum::Bins;
use crate::image::Image;

/// Standard errors that the stated error counts: of a normal distribution 99.9 % lie within.
const SIGMAS: f64 = 3.3;

/// Scattered signal on a coarse raster that covers the image.
#[derive(Clone, Debug, PartialEq)]
pub struct Scatter {
    /// Mean over each cell, in units of the unattenuated signal there.
    pub signal: Image<f64>,
    /// Standard errors of `signal`.
    pub error: Image<f64>,
    /// Photons that were followed.
    pub histories: u64,
    /// Seed of their random numbers.
    pub seed: u64,
    /// Median over the cells of the relative standard error.
    pub relative_error: f64,
}

/// What adding it did.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Added {
    /// Photons that were followed.
    pub histories: u64,
    /// Their seed.
    pub seed: u64,
    /// Columns and rows of the raster.
    pub grid_px: [usize; 2],
    /// Median over its cells of the scatter's relative standard error.
    pub relative_error: f64,
    /// Mean of scatter over mean of primary.
    pub scatter_to_primary: f64,
    /// Bound of |Δ line_integral| / max(1, line_integral) that it adds to the stated error: of its noise, and of what the raster smooths.
    pub stated_error: f64,
}

impl Scatter {
    /// What a plan says of it.
    pub(super) fn words(&self) -> String {
        let Image { width, height, .. } = self.signal;
        format!(
            "by Monte Carlo: {:.1e} photons, {width} x {height} cells good to {:.1} % in the median, cubic between them; its quanta count as \
             ones of the beam's mean response",
            self.histories as f64,
            100.0 * self.relative_error
        )
    }

    /// Adds it to a signal of `size` = [columns, rows] pixels. The open shares of `flood` are in the signal afterwards and no longer in it.
    pub(super) fn add_to(&self, signal: &mut Signal, flood: &mut Flood, bins: &Bins, size: [usize; 2]) -> Added {
        let [width, height] = size;
        let smooth = Smooth::new(&self.signal, size);
        let (mut primary, mut scattered) = (0.0, 0.0);
        let mut row_of_scatter = vec![0.0; width];
        for row in 0..height {
            smooth.row(row, &mut row_of_scatter);
            for (column, seen) in row_of_scatter.iter().enumerate() {
                let pixel = row * width + column;
                let (open, seen) = (flood.open(pixel), seen.max(0.0));
                let line = f64::from(signal.line_integral[pixel]);
                let direct = open * (-line).exp();
                primary += direct;
                scattered += seen;
                // Without scatter the logarithm keeps what the exponential has lost.
                signal.line_integral[pixel] = if seen == 0.0 { line - open.ln() } else { -(direct + seen).ln() } as f32;
                if let Some(arriving) = signal.arriving.get_mut(pixel) {
                    *arriving = joined(arriving, open, seen, flood.response(pixel), bins);
                }
            }
        }
        flood.open = Vec::new();
        Added {
            histories: self.histories,
            seed: self.seed,
            grid_px: [self.signal.width, self.signal.height],
            relative_error: self.relative_error,
            scatter_to_primary: scattered / primary,
            stated_error: self.stated_error(signal, size),
        }
    }

    /// 99.9th percentile over the cells of what noise, and the curvature within a cell, may change.
    fn stated_error(&self, signal: &Signal, [width, height]: [usize; 2]) -> f64 {
        let Image { width: columns, height: rows, pixels } = &self.signal;
        let (columns, rows) = (*columns, *rows);
        let bent = |before: Option<f64>, here: f64, after: Option<f64>| match (before, after) {
            (Some(before), Some(after)) => (before - 2.0 * here + after).abs() / 8.0,
            _ => 0.0,
        };
        let at = |column: usize, row: usize| pixels[row * columns + column];
        let of_cell = |cell: usize| {
            let (column, row) = (cell % columns, cell / columns);
            let here = pixels[cell];
            let along =
                bent(column.checked_sub(1).map(|left| at(left, row)), here, (column + 1 < columns).then(|| at(column + 1, row)));
            let down =
                bent(row.checked_sub(1).map(|above| at(column, above)), here, (row + 1 < rows).then(|| at(column, row + 1)));
            let middle = |cell: usize, cells: usize, px: usize| ((2 * cell + 1) * px / (2 * cells)).min(px - 1);
            let pixel = middle(row, rows, height) * width + middle(column, columns, width);
            let line = f64::from(signal.line_integral[pixel]);
            match SIGMAS * self.error.pixels[cell] + along.max(down) {
                // Where nothing is added nothing is off, however thick the object.
                0.0 => 0.0,
                off => off * line.exp() / line.max(1.0),
            }
        };
        let mut errors: Vec<f64> = (0..pixels.len()).map(of_cell).collect();
        errors.sort_by(f64::total_cmp);
        errors[(0.999 * (errors.len() - 1) as f64).round() as usize]
    }
}

/// The photons of the primary, of which `open` pass the collimator, and `scattered` more.
fn joined(primary: &Arriving, open: f64, scattered: f64, response: f64, bins: &Bins) -> Arriving {
    let own = open * f64::from(primary.photon_fraction);
    let count = own + scattered;
    if !(count > 0.0) {
        return Arriving { photon_fraction: 0.0, ..*primary };
    }
    let mixed = |of_primary: f32, of_scatter: f64| ((own * f64::from(of_primary) + scattered * of_scatter) / count) as f32;
    // Heel and bow-tie move the mean; its square moves as much.
    let square = bins.mean_square_response * (response / bins.mean_response).powi(2);
    Arriving {
        photon_fraction: count as f32,
        mean_response: mixed(primary.mean_response, response),
        mean_square_response: mixed(primary.mean_square_response, square),
    }
}

/// A coarse raster between the middles of its cells: cubic (Catmull–Rom), and straight beyond the outermost.
struct Smooth {
    columns: usize,
    /// With two more cells on each side.
    padded: Vec<f64>,
    size: [usize; 2],
    rows: usize,
}

const PAD: usize = 2;

impl Smooth {
    fn new(coarse: &Image<f64>, size: [usize; 2]) -> Self {
        let (columns, rows) = (coarse.width + 2 * PAD, coarse.height + 2 * PAD);
        // Along one axis, at an index that may lie outside: straight on from the two outermost.
        let beyond = |n: usize, count: usize| -> [(usize, f64); 2] {
            let at = n as f64 - PAD as f64;
            let low = (at.max(0.0) as usize).min(count.saturating_sub(2));
            let share = at - low as f64;
            [(low, 1.0 - share), ((low + 1).min(count - 1), share)]
        };
        let mut padded = Vec::with_capacity(columns * rows);
        for row in 0..rows {
            for column in 0..columns {
                let mut value = 0.0;
                for (r, by_row) in beyond(row, coarse.height) {
                    for (c, by_column) in beyond(column, coarse.width) {
                        value += by_row * by_column * coarse.pixels[r * coarse.width + c];
                    }
                }
                padded.push(value);
            }
        }
        Self { columns, padded, size, rows }
    }

    /// The first of four cells about a pixel, and their weights.
    fn weights(pixel: usize, pixels: usize, cells: usize) -> (usize, [f64; 4]) {
        let at = (pixel as f64 + 0.5) / pixels as f64 * cells as f64 - 0.5;
        let base = at.floor();
        let f = at - base;
        let weights = [
            f * (-0.5 + f * (1.0 - 0.5 * f)),
            1.0 + f * f * (1.5 * f - 2.5),
            f * (0.5 + f * (2.0 - 1.5 * f)),
            f * f * (0.5 * f - 0.5),
        ];
        ((base as isize - 1 + PAD as isize) as usize, weights)
    }

    fn row(&self, row: usize, out: &mut [f64]) {
        let (top, down) = Self::weights(row, self.size[1], self.rows - 2 * PAD);
        let line: Vec<f64> = (0..self.columns)
            .map(|column| (0..4).map(|n| down[n] * self.padded[(top + n) * self.columns + column]).sum())
            .collect();
        for (column, out) in out.iter_mut().enumerate() {
            let (left, across) = Self::weights(column, self.size[0], self.columns - 2 * PAD);
            *out = (0..4).map(|n| across[n] * line[left + n]).sum();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn coarse(of: impl Fn(f64, f64) -> f64) -> Image<f64> {
        let pixels = (0..6 * 5).map(|n| of((n % 6) as f64 + 0.5, (n / 6) as f64 + 0.5)).collect();
        Image { width: 6, height: 5, pixels }
    }

    /// Planes are exact to the edge of the image, a parabola as well away from it.
    #[test]
    fn a_raster_between_its_cells_is_what_it_is_of() {
        let plane = |x: f64, y: f64| 3.0 + 0.2 * x - 0.1 * y;
        let bent = |x: f64, y: f64| (x - 2.0).powi(2) + 0.3 * x * y;
        for (of, inside_only) in [(&plane as &dyn Fn(f64, f64) -> f64, false), (&bent, true)] {
            let smooth = Smooth::new(&coarse(of), [60, 50]);
            let mut row = vec![0.0; 60];
            for y in 0..50 {
                smooth.row(y, &mut row);
                for (x, found) in row.iter().enumerate() {
                    let (at_x, at_y) = ((x as f64 + 0.5) / 10.0, (y as f64 + 0.5) / 10.0);
                    let is_inside = (1.5..4.5).contains(&at_x) && (1.5..3.5).contains(&at_y);
                    if is_inside || !inside_only {
                        assert!((found - of(at_x, at_y)).abs() < 1e-12, "{x} {y}: {found}");
                    }
                }
            }
        }
        // A single cell is the same everywhere.
        let smooth = Smooth::new(&Image { width: 1, height: 1, pixels: vec![0.7] }, [4, 3]);
        let mut row = vec![0.0; 4];
        smooth.row(2, &mut row);
        assert!(row.iter().all(|found| (found - 0.7).abs() < 1e-12), "{row:?}");
    }
}

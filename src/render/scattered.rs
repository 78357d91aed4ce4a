//! Scatter, followed elsewhere, added to what arrives.
//!
//! With S(u) the scattered signal in units of the unattenuated signal of the pixel: `intensity(u) = open(u) · Σ φ r b T / Σ φ r b + S(u)`.
//! What is smooth, and interpolated, is the scattered signal itself; the flood by which it is divided may end at the heel.
//! It reaches the panel beside the collimated field as well. For noise its quanta count as ones of the beam's mean response.

use super::cpu::attenuate_spectrum::{Arriving, Signal};
use super::flood::Flood;
use super::spectrum::Bins;
use crate::estimate::median;
use crate::image::Image;

/// Standard errors that the stated error counts: of a normal distribution 99.9 % lie within.
const SIGMAS: f64 = 3.3;
/// Share of a second difference between cells that the raster may be off: inside, and in the outermost cells, where it goes on straight.
const BENT: (f64, f64) = (1.0 / 8.0, 3.0 / 8.0);
/// Cells sorted by how bright they are: in the dark of the heel nothing tells the unit.
const LIT: f64 = 0.9;

/// Scattered signal on a coarse raster that covers the image.
#[derive(Clone, Debug, PartialEq)]
pub struct Scatter {
    /// Mean over each cell, keV or photons per history.
    pub signal: Image<f64>,
    /// Standard errors of `signal`; NaN where too little was seen to know it.
    pub error: Image<f64>,
    /// What a cell would detect with nothing in the beam and all of the panel open, in the unit of `signal`.
    pub unattenuated: Image<f64>,
    /// How it became known.
    pub from: Origin,
    /// Median over the cells of the relative standard error; infinite where most saw too little to tell.
    pub relative_error: f64,
}

/// How scatter became known.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Origin {
    /// Photons were followed.
    Photons {
        /// How many.
        histories: u64,
        /// Seed of their random numbers.
        seed: u64,
        /// `cpu`, or the GPU that followed them: each has random numbers of its own.
        device: String,
    },
    /// A network was asked.
    Network {
        /// SHA-256 of its weights.
        sha256: String,
        /// What of the scene lies outside what it was trained on: then its error is taken to be as large as the scatter.
        outside: Vec<String>,
    },
}

/// What adding it did.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Added {
    /// How it became known.
    pub from: Origin,
    /// Columns and rows of the raster.
    pub grid_px: [usize; 2],
    /// Median over its cells of the scatter's relative standard error; `None` where most saw too little to tell.
    pub relative_error: Option<f64>,
    /// Mean of scatter over mean of primary; `None` without primary.
    pub scatter_to_primary: Option<f64>,
    /// Bound of |Δ line_integral| / max(1, line_integral) that it adds to the stated error, the 99.9th percentile of valid pixels: of its
    /// noise, and of what the raster smooths.
    pub stated_error: f64,
}

impl Scatter {
    /// What a plan says of it.
    #[must_use]
    pub fn words(&self) -> String {
        let Image { width, height, .. } = self.signal;
        let by = match &self.from {
            Origin::Photons { histories, .. } => format!("by Monte Carlo: {:.1e} photons", *histories as f64),
            Origin::Network { sha256, outside } => {
                let though = if outside.is_empty() {
                    String::new()
                } else {
                    format!(", though not trained for this: {}", outside.join("; "))
                };
                format!("by the network (weights {}{though})", sha256.get(..12).unwrap_or(sha256))
            }
        };
        let good = if self.relative_error.is_finite() {
            let of = if matches!(self.from, Origin::Photons { .. }) { "in the median" } else { "of their root mean square" };
            format!("good to {:.1} % {of}", 100.0 * self.relative_error)
        } else {
            "most of which saw too little to tell how good they are".to_owned()
        };
        format!(
            "{by}, {width} x {height} cells {good}, cubic between them; what that leaves uncertain is added to the image's stated error; its \
             quanta count as ones of the beam's mean response"
        )
    }

    /// What to say where a network was not trained for the scene.
    #[must_use]
    pub fn unlike(&self) -> Option<String> {
        match &self.from {
            Origin::Network { outside, .. } if !outside.is_empty() => {
                Some(format!("the network was not trained for this scene, its scatter may be anything: {}", outside.join("; ")))
            }
            _ => None,
        }
    }

    /// Adds it to a signal of `size` = [columns, rows] pixels. The open shares of `flood`, which needs its photons, are in the signal
    /// afterwards, and no longer in `flood`, but for pixels that nothing reaches. `valid` says which pixels the statement is about.
    pub(super) fn add_to(&self, signal: &mut Signal, flood: &mut Flood, bins: &Bins, size: [usize; 2], valid: &[u8]) -> Added {
        let [width, height] = size;
        let [across, down] = [Axis::new(width, self.signal.width), Axis::new(height, self.signal.height)];
        let per_signal = self.principal(flood, size).recip();
        let variance = self.variances();
        let bends = self.bends();
        let (mut primary, mut scattered, mut is_dark) = (0.0, 0.0, false);
        let mut open_after = vec![1.0f32; width * height];
        let mut errors = Vec::new();
        for row in 0..height {
            let (by_row, outer_row) = (&down.weights[row], down.is_outer(row));
            let seen_along = mixed_rows(&self.signal.pixels, across.cells, by_row, false);
            let varied_along = mixed_rows(&variance, across.cells, by_row, true);
            for column in 0..width {
                let (pixel, by_column) = (row * width + column, &across.weights[column]);
                let unit = per_signal / flood.relative_signal(pixel);
                let found = unit * by_column.iter().map(|(cell, weight)| weight * seen_along[*cell]).sum::<f64>();
                // Not max, which would turn NaN into nothing.
                let seen = if found < 0.0 { 0.0 } else { found };
                let (open, line) = (flood.open(pixel), f64::from(signal.line_integral[pixel]));
                let direct = open * (-line).exp();
                primary += direct;
                scattered += seen;
                let both = direct + seen;
                // Without scatter the logarithm keeps what the exponential has lost.
                let joined_line = if seen == 0.0 { line - open.ln() } else { -both.ln() };
                signal.line_integral[pixel] = joined_line as f32;
                if open == 0.0 && seen == 0.0 {
                    (open_after[pixel], is_dark) = (0.0, true);
                }
                if let Some(arriving) = signal.arriving.get_mut(pixel) {
                    *arriving = joined(arriving, open, seen, flood.response(pixel), bins);
                }
                if valid[pixel] == 1 {
                    let cell = down.nearest(row) * across.cells + across.nearest(column);
                    // Photons err cell by cell, a network in all of them alike.
                    let sigma = unit
                        * match self.from {
                            Origin::Photons { .. } => {
                                by_column.iter().map(|(cell, weight)| weight * weight * varied_along[*cell]).sum::<f64>().sqrt()
                            }
                            Origin::Network { .. } => self.error.pixels[cell],
                        };
                    let share = if outer_row || across.is_outer(column) { BENT.1 } else { BENT.0 };
                    errors.push(match SIGMAS * sigma + share * unit * bends[cell] {
                        // Where nothing is added nothing is off, however thick the object.
                        0.0 => 0.0,
                        off => (off / both / joined_line.max(1.0)) as f32,
                    });
                }
            }
        }
        flood.open = if is_dark { open_after } else { Vec::new() };
        Added {
            from: self.from.clone(),
            grid_px: [across.cells, down.cells],
            relative_error: Some(self.relative_error).filter(|error| error.is_finite()),
            scatter_to_primary: Some(scattered / primary).filter(|ratio| ratio.is_finite()),
            stated_error: percentile(&mut errors),
        }
    }

    /// Signal of an open pixel on the principal ray, in the unit of `signal`: cells and pixels see the same flood.
    fn principal(&self, flood: &Flood, [width, height]: [usize; 2]) -> f64 {
        let Image { width: columns, height: rows, pixels } = &self.unattenuated;
        let (mut sums, mut counts) = (vec![0.0; pixels.len()], vec![0.0; pixels.len()]);
        for pixel in 0..width * height {
            let cell = (pixel / width * rows / height) * columns + pixel % width * columns / width;
            sums[cell] += flood.relative_signal(pixel);
            counts[cell] += 1.0;
        }
        let ratio = |cell: usize| (counts[cell] > 0.0).then(|| pixels[cell] * counts[cell] / sums[cell]);
        let mut ratios: Vec<f64> = (0..pixels.len()).filter_map(ratio).collect();
        ratios.sort_by(f64::total_cmp);
        ratios[(LIT * (ratios.len() - 1) as f64) as usize]
    }

    /// Variances of the cells; one that photons told too little about is as uncertain as the others, and as all that it has. Where all are such,
    /// what any has may be missing in each.
    fn variances(&self) -> Vec<f64> {
        let usual = median(self.error.pixels.iter().copied().filter(|error| *error > 0.0));
        let untold = || self.error.pixels.iter().zip(&self.signal.pixels).filter(|(error, _)| error.is_nan());
        let usual = usual.unwrap_or_else(|| untold().map(|(_, signal)| *signal).fold(0.0, f64::max));
        let variance = |(error, signal): (&f64, &f64)| match *error {
            known if known > 0.0 => known * known,
            unknown if unknown.is_nan() => signal.max(usual).powi(2),
            _ => usual * usual,
        };
        self.error.pixels.iter().zip(&self.signal.pixels).map(variance).collect()
    }

    /// Largest second difference along columns or rows, of an outermost cell that of its neighbour.
    fn bends(&self) -> Vec<f64> {
        let Image { width: columns, height: rows, pixels } = &self.signal;
        let inner = |n: usize, count: usize| (count >= 3).then(|| n.clamp(1, count - 2));
        let bend = |cell: usize| {
            let (column, row) = (cell % columns, cell / columns);
            let along = inner(column, *columns).map_or(0.0, |n| {
                let at = row * columns + n;
                (pixels[at - 1] - 2.0 * pixels[at] + pixels[at + 1]).abs()
            });
            let down = inner(row, *rows).map_or(0.0, |n| {
                let at = n * columns + column;
                (pixels[at - columns] - 2.0 * pixels[at] + pixels[at + columns]).abs()
            });
            along.max(down)
        };
        (0..pixels.len()).map(bend).collect()
    }
}

/// The 99.9th percentile; 0 of none.
fn percentile(errors: &mut [f32]) -> f64 {
    let Some(last) = errors.len().checked_sub(1) else { return 0.0 };
    let rank = (0.999 * last as f64).ceil() as usize;
    f64::from(*errors.select_nth_unstable_by(rank, f32::total_cmp).1)
}

/// The photons of the primary, of which `open` pass the collimator, and `scattered` more.
fn joined(primary: &Arriving, open: f64, scattered: f64, response: f64, bins: &Bins) -> Arriving {
    let own = open * f64::from(primary.photon_fraction);
    let count = own + scattered;
    if count == 0.0 {
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

/// Cells mixed down to one row, with weights or their squares.
fn mixed_rows(cells: &[f64], columns: usize, weights: &[(usize, f64)], squared: bool) -> Vec<f64> {
    let weight = |weight: f64| if squared { weight * weight } else { weight };
    (0..columns).map(|column| weights.iter().map(|(row, by)| weight(*by) * cells[row * columns + column]).sum()).collect()
}

/// Between the middles of cells along one axis: cubic (Catmull–Rom), and straight beyond the outermost.
struct Axis {
    cells: usize,
    /// By pixel: cells and their weights, each cell once.
    weights: Vec<Vec<(usize, f64)>>,
}

impl Axis {
    fn new(pixels: usize, cells: usize) -> Self {
        let of_pixel = |pixel: usize| {
            let at = (pixel as f64 + 0.5) / pixels as f64 * cells as f64 - 0.5;
            let base = at.floor();
            let f = at - base;
            let cubic = [
                f * (-0.5 + f * (1.0 - 0.5 * f)),
                1.0 + f * f * (1.5 * f - 2.5),
                f * (0.5 + f * (2.0 - 1.5 * f)),
                f * f * (0.5 * f - 0.5),
            ];
            let mut weights: Vec<(usize, f64)> = Vec::new();
            let mut add = |cell: usize, weight: f64| match weights.iter_mut().find(|(known, _)| *known == cell) {
                Some((_, sum)) => *sum += weight,
                None => weights.push((cell, weight)),
            };
            for (n, weight) in cubic.into_iter().enumerate() {
                let at = base as isize - 1 + n as isize;
                // A cell that is not there lies on the line through the two outermost.
                let last = cells as isize - 1;
                let low = at.clamp(0, (last - 1).max(0));
                let share = if last == 0 { 0.0 } else { (at - low) as f64 };
                add(low as usize, weight * (1.0 - share));
                if share != 0.0 {
                    add(low as usize + 1, weight * share);
                }
            }
            weights
        };
        Self { cells, weights: (0..pixels).map(of_pixel).collect() }
    }

    fn nearest(&self, pixel: usize) -> usize {
        pixel * self.cells / self.weights.len()
    }

    fn is_outer(&self, pixel: usize) -> bool {
        let cell = self.nearest(pixel);
        cell == 0 || cell + 1 == self.cells
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Planes are exact to the edge of the image, a parabola as well away from it.
    #[test]
    fn a_raster_between_its_cells_is_what_it_is_of() {
        let plane = |x: f64, y: f64| 3.0 + 0.2 * x - 0.1 * y;
        let bent = |x: f64, y: f64| (x - 2.0).powi(2) + 0.3 * x * y;
        let [across, down] = [Axis::new(60, 6), Axis::new(50, 5)];
        for (of, inside_only) in [(&plane as &dyn Fn(f64, f64) -> f64, false), (&bent, true)] {
            let cells: Vec<f64> = (0..6 * 5).map(|n| of((n % 6) as f64 + 0.5, (n / 6) as f64 + 0.5)).collect();
            for y in 0..50 {
                let along = mixed_rows(&cells, 6, &down.weights[y], false);
                for x in 0..60 {
                    let found: f64 = across.weights[x].iter().map(|(cell, weight)| weight * along[*cell]).sum();
                    let (at_x, at_y) = ((x as f64 + 0.5) / 10.0, (y as f64 + 0.5) / 10.0);
                    let is_inside = (1.5..4.5).contains(&at_x) && (1.5..3.5).contains(&at_y);
                    if is_inside || !inside_only {
                        assert!((found - of(at_x, at_y)).abs() < 1e-12, "{x} {y}: {found}");
                    }
                }
            }
        }
        // A single cell is the same everywhere.
        let one = Axis::new(4, 1);
        assert!(one.weights.iter().all(|weights| (weights.iter().map(|(_, weight)| weight).sum::<f64>() - 1.0).abs() < 1e-12));
    }

    /// A spike of which nobody knows the error is uncertain by all of itself, a cell that saw nothing as much as those that are known; without
    /// any of these as much as the largest spike.
    #[test]
    fn what_too_little_was_seen_of_is_uncertain_by_all_of_it() {
        let variances = |signal: [f64; 4], error: [f64; 4]| {
            let image = |pixels: [f64; 4]| Image { width: 4, height: 1, pixels: pixels.to_vec() };
            let from = Origin::Photons { histories: 1, seed: 1, device: "cpu".to_owned() };
            let unattenuated = image([1.0; 4]);
            Scatter { signal: image(signal), error: image(error), unattenuated, from, relative_error: 0.5 }.variances()
        };
        let unknown = f64::NAN;
        assert_eq!(variances([8.0, 6.0, 1e-30, 4.0], [1.0, 0.5, unknown, unknown]), [1.0, 0.25, 1.0, 16.0]);
        assert_eq!(variances([1e-30, 0.5, 0.0, 1e-9], [unknown; 4]), [0.25; 4]);
        assert_eq!(variances([0.0; 4], [unknown; 4]), [0.0; 4]);
        assert_eq!(variances([0.01; 4], [0.0; 4]), [0.0; 4]);
    }

    /// Exact moments: of quanta at 1 and 3, three at 1 from the primary behind half a collimator, two more with the beam's mean.
    #[test]
    fn quanta_are_joined_with_their_moments() {
        let primary = Arriving { photon_fraction: 0.6, mean_response: 1.0, mean_square_response: 1.0 };
        let bins = Bins { mean_response: 2.0, mean_square_response: 5.0, ..Bins::default() };
        let both = joined(&primary, 0.5, 0.2, 2.0, &bins);
        let close = |found: f32, expected: f64| (f64::from(found) - expected).abs() < 1e-6;
        assert!(close(both.photon_fraction, 0.5) && close(both.mean_response, 0.7 / 0.5), "{both:?}");
        assert!(close(both.mean_square_response, (0.3 + 0.2 * 5.0) / 0.5), "{both:?}");
        // Where heel or bow-tie have made the beam's mean 1.5 times as large.
        assert!(close(joined(&primary, 0.0, 0.2, 3.0, &bins).mean_square_response, 5.0 * 2.25));
        assert!(joined(&primary, 1.0, f64::NAN, 2.0, &bins).photon_fraction.is_nan());
    }
}

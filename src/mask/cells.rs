//! The frame in cells of a few pixels: the robust level and the noise of each.

use glam::DVec2;
use rayon::prelude::*;

use super::signal::Signal;
use crate::image::quantile;

/// Cells along the longer side of the frame, at most.
const MOST_CELLS: usize = 128;
/// Side of the smallest cell.
const SMALLEST_PX: usize = 4;
/// At most this many rows and columns of a cell are looked at.
const LOOKS: usize = 6;

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Cell {
    /// Mean of the middle half of the signals, so that letters and wires count little.
    pub level: f32,
    /// Standard deviation between neighbours in a row, from the median difference.
    pub noise: f32,
    /// The bits of the value that all pixels have.
    pub constant: Option<u32>,
}

pub(super) struct Cells {
    pub columns: usize,
    pub rows: usize,
    /// Pixels of a cell's side; the last ones may be larger by a part.
    pub size_px: DVec2,
    pub cells: Vec<Cell>,
}

impl Cells {
    pub fn new(signal: &Signal) -> Self {
        let (width, height) = (signal.pixels.width, signal.pixels.height);
        let side = width.max(height).div_ceil(MOST_CELLS).max(SMALLEST_PX);
        let (columns, rows) = ((width / side).max(1), (height / side).max(1));
        let cells = (0..rows * columns)
            .into_par_iter()
            .with_min_len(columns)
            .map(|index| {
                let (column, row) = (index % columns, index / columns);
                let (left, right) = (column * width / columns, (column + 1) * width / columns);
                let (top, bottom) = (row * height / rows, (row + 1) * height / rows);
                cell(signal, [left, right], [top, bottom])
            })
            .collect();
        let size_px = DVec2::new(width as f64 / columns as f64, height as f64 / rows as f64);
        Self { columns, rows, size_px, cells }
    }

    /// The centre in pixels.
    pub fn centre(&self, column: usize, row: usize) -> DVec2 {
        DVec2::new(column as f64 + 0.5, row as f64 + 0.5) * self.size_px - 0.5
    }

    /// Half of a cell's diagonal.
    pub fn reach_px(&self) -> f64 {
        self.size_px.length() / 2.0
    }

    /// Every cell with its centre.
    pub fn iter(&self) -> impl Iterator<Item = (DVec2, &Cell)> {
        self.cells.iter().enumerate().map(|(index, cell)| (self.centre(index % self.columns, index / self.columns), cell))
    }
}

fn cell(signal: &Signal, columns: [usize; 2], rows: [usize; 2]) -> Cell {
    let step_u = (columns[1] - columns[0]).div_ceil(LOOKS).max(1);
    let step_v = (rows[1] - rows[0]).div_ceil(LOOKS).max(1);
    let mut levels = [0.0_f32; LOOKS * LOOKS];
    let mut steps = [0.0_f32; LOOKS * LOOKS];
    let (mut count, mut pairs) = (0, 0);
    let first = signal.pixels.pixels[rows[0] * signal.pixels.width + columns[0]].to_bits();
    let mut constant = true;
    for row in (rows[0]..rows[1]).step_by(step_v) {
        let mut before = None;
        for column in (columns[0]..columns[1]).step_by(step_u) {
            let index = row * signal.pixels.width + column;
            constant &= signal.pixels.pixels[index].to_bits() == first;
            let level = signal.at(index);
            levels[count] = level;
            count += 1;
            if let Some(before) = before {
                steps[pairs] = f32::abs(level - before);
                pairs += 1;
            }
            before = Some(level);
        }
    }
    let levels = &mut levels[..count];
    levels.sort_unstable_by(f32::total_cmp);
    let middle = &levels[count / 4..count - count / 4];
    let level = middle.iter().sum::<f32>() / middle.len().max(1) as f32;
    let steps = &mut steps[..pairs];
    // The median of |a − b| of two normal numbers is 0.954 of one's standard deviation.
    let noise = quantile(steps, 0.5).map_or(0.0, |median| median as f32 / 0.954);
    Cell { level, noise, constant: constant.then_some(first) }
}

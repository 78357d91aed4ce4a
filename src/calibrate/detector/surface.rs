//! A smooth surface over the panel: a polynomial of two variables, fitted to the means of blocks, each as certain as it has pixels.

use nalgebra::{DMatrix, DVector};

use crate::image::Image;

/// Of fourth order in each direction together: heel, distance and obliquity need no more.
const ORDER: usize = 4;
/// Side of the blocks that are averaged.
const BLOCK_PX: usize = 16;

/// The mean of a block.
struct Block {
    place: [f64; 2],
    mean: f64,
    /// Root of the number of its pixels: the inverse of its standard deviation, but for a factor.
    weight: f64,
}

pub(super) struct Surface {
    coefficients: Vec<f64>,
    size_px: [usize; 2],
}

impl Surface {
    /// Least squares over blocks, three rounds, each without blocks that lie far off; `None` when too few blocks are left.
    pub(super) fn fit(map: &Image<f32>, good: impl Fn(usize) -> bool) -> Option<Self> {
        let size_px = [map.width, map.height];
        let mut blocks: Vec<Block> = Vec::new();
        for top in (0..map.height).step_by(BLOCK_PX) {
            for left in (0..map.width).step_by(BLOCK_PX) {
                let (mut n, mut sum) = (0.0f64, 0.0);
                let (bottom, right) = ((top + BLOCK_PX).min(map.height), (left + BLOCK_PX).min(map.width));
                for row in top..bottom {
                    for column in left..right {
                        let at = row * map.width + column;
                        if good(at) && map.pixels[at].is_finite() {
                            n += 1.0;
                            sum += f64::from(map.pixels[at]);
                        }
                    }
                }
                if n >= 0.5 * ((bottom - top) * (right - left)) as f64 {
                    let place = place(0.5 * (left + right - 1) as f64, 0.5 * (top + bottom - 1) as f64, size_px);
                    blocks.push(Block { place, mean: sum / n, weight: n.sqrt() });
                }
            }
        }
        let terms = powers([0.0, 0.0]).len();
        let mut coefficients = Vec::new();
        for _ in 0..3 {
            if blocks.len() < 2 * terms {
                return None;
            }
            let matrix =
                DMatrix::from_fn(blocks.len(), terms, |row, column| blocks[row].weight * powers(blocks[row].place)[column]);
            let values = DVector::from_iterator(blocks.len(), blocks.iter().map(|block| block.weight * block.mean));
            coefficients = matrix.svd(true, true).solve(&values, 1e-12).ok()?.iter().copied().collect();
            let at = |point: [f64; 2]| powers(point).iter().zip(&coefficients).map(|(p, c)| p * c).sum::<f64>();
            let residuals: Vec<f64> = blocks.iter().map(|block| block.weight * (block.mean - at(block.place))).collect();
            let (_, deviation) = super::groups::median_and_deviation(&residuals);
            let limit = 6.0 * deviation;
            let mut residual = residuals.into_iter();
            blocks.retain(|_| residual.next().is_some_and(|r| r.abs() <= limit || limit == 0.0));
        }
        Some(Self { coefficients, size_px })
    }

    /// At a pixel.
    pub(super) fn at(&self, column: usize, row: usize) -> f64 {
        powers(place(column as f64, row as f64, self.size_px)).iter().zip(&self.coefficients).map(|(p, c)| p * c).sum()
    }

    /// 1 − smallest / largest over the panel.
    pub(super) fn fall(&self) -> f64 {
        let [width, height] = self.size_px;
        let (mut low, mut high) = (f64::MAX, f64::MIN);
        for row in (0..height).step_by(4).chain([height - 1]) {
            for column in (0..width).step_by(4).chain([width - 1]) {
                let value = self.at(column, row);
                (low, high) = (low.min(value), high.max(value));
            }
        }
        1.0 - low / high
    }
}

/// −1 to 1 over the panel.
fn place(column: f64, row: f64, [width, height]: [usize; 2]) -> [f64; 2] {
    let scaled = |at: f64, side: usize| 2.0 * at / (side.max(2) - 1) as f64 - 1.0;
    [scaled(column, width), scaled(row, height)]
}

fn powers([x, y]: [f64; 2]) -> Vec<f64> {
    let mut terms = Vec::with_capacity((ORDER + 1) * (ORDER + 2) / 2);
    for total in 0..=ORDER {
        for of_y in 0..=total {
            terms.push(x.powi((total - of_y) as i32) * y.powi(of_y as i32));
        }
    }
    terms
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The last column of blocks, a pixel wide, drew the surface after its noise as if it were of sixteen.
    #[test]
    fn a_narrow_rest_of_the_panel_counts_for_as_much_as_it_has_pixels() {
        // Even means that alternate from block to block as noise of 0.002 would, and in the rest noise that is four times as large.
        let (width, height) = (129, 128);
        let value = |column: usize, row: usize| {
            let is_rest = column == width - 1;
            let side = if (column / BLOCK_PX + row / BLOCK_PX).is_multiple_of(2) { 1.0 } else { -1.0 };
            if is_rest { 1.008 } else { 1.0 + 0.002 * side }
        };
        let pixels = (0..width * height).map(|at| value(at % width, at / width)).collect();
        let surface = Surface::fit(&Image { width, height, pixels }, |_| true).expect("blocks enough");
        let off = surface.at(width - 1, height / 2) - 1.0;
        assert!(off.abs() < 0.004, "{off}");
    }
}

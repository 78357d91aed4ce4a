//! A batch on the device, and its loss.

use std::borrow::Borrow;

use burn::tensor::{Device, Tensor, TensorData};

use super::Sample;
use crate::infer::{CELL_COLUMNS, CELL_ROWS, CELLS, COLUMNS, Card, Network, PAGES, ROWS};

/// Share of the sum's square below which a page's own square does not count: a page that is almost empty is noise.
const LEAST_PAGE: f64 = 0.01;

/// Samples of one step.
pub(super) struct Batch {
    size: usize,
    channels: Tensor<4>,
    scalars: Tensor<2>,
    /// Truth over scale, [B, 2, 12, 16].
    target: Tensor<4>,
    /// Of the sum of pages and of each page, [B, 3, 1, 1].
    weights: Tensor<4>,
}

impl Batch {
    /// `samples`, normalised by `card`.
    pub(super) fn new(samples: &[impl Borrow<Sample>], card: &Card, page_weight: f64, device: &Device) -> Self {
        let size = samples.len();
        let (mut channels, mut scalars, mut target, mut weights) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for sample in samples.iter().map(Borrow::borrow) {
            let (of_channels, of_scalars) = card.normalised(&sample.input);
            channels.extend(of_channels);
            scalars.extend(of_scalars);
            target.extend(sample.truth.iter().map(|truth| truth / sample.input.scale));
            weights.extend(loss_weights(sample, page_weight).map(|weight| weight as f32));
        }
        Self {
            size,
            channels: Tensor::from_data(TensorData::new(channels, [size, card.channels.len(), ROWS, COLUMNS]), device),
            scalars: Tensor::from_data(TensorData::new(scalars, [size, card.scalars.len()]), device),
            target: Tensor::from_data(TensorData::new(target, [size, PAGES, CELL_ROWS, CELL_COLUMNS]), device),
            weights: Tensor::from_data(TensorData::new(weights, [size, PAGES + 1, 1, 1]), device),
        }
    }

    /// Predicted scatter over scale, [B, 2, 12, 16].
    pub(super) fn predicted(&self, network: &Network) -> Tensor<4> {
        network.forward(self.channels.clone(), self.scalars.clone()).exp()
    }

    /// Mean over the samples of w₀ Σ(Ŝ−S)²/ΣS̄² of the sum of pages + w₁ Σ(Ŝ₁−S₁)²/ΣS̄₁² + w₁ Σ(Ŝ₂−S₂)²/ΣS̄₂², w₀ + 2 w₁ = 1.
    ///
    /// Quadratic in the prediction, so that noise of the truth adds a constant and moves no minimum; S̄ is the truth smoothed, so that
    /// its noise hardly enters the weight.
    pub(super) fn loss(&self, network: &Network) -> Tensor<1> {
        let difference = self.predicted(network) - self.target.clone();
        let of_sum = difference.clone().sum_dim(1);
        let all = Tensor::cat(vec![of_sum, difference], 1);
        // Axis by axis: a GPU adds up a whole tensor in the order in which its groups are done.
        let squares: Tensor<4> = all.square() * self.weights.clone();
        squares.sum_dim(3).sum_dim(2).sum_dim(1).sum_dim(0).reshape([1]) / self.size as f64
    }
}

/// What the squared differences over scale are multiplied by: of the sum of pages, and of each page.
fn loss_weights(sample: &Sample, page_weight: f64) -> [f64; PAGES + 1] {
    let smooth: Vec<Vec<f64>> = sample.truth.chunks(CELLS).map(|page| smoothed(page, f64::from(sample.input.scale))).collect();
    let square = |page: &[f64]| page.iter().map(|value| value * value).sum::<f64>();
    let sum: Vec<f64> = smooth[0].iter().zip(&smooth[1]).map(|(single, multiple)| single + multiple).collect();
    let (of_sum, share) = (square(&sum), 1.0 / (1.0 + PAGES as f64 * page_weight));
    let of_page = |page: &[f64]| page_weight * share / square(page).max(LEAST_PAGE * of_sum);
    [share / of_sum, of_page(&smooth[0]), of_page(&smooth[1])]
}

/// Mean of the up to nine cells about each cell, over `scale`.
fn smoothed(page: &[f32], scale: f64) -> Vec<f64> {
    let about = |place: usize, count: usize| place.saturating_sub(1)..(place + 2).min(count);
    let cell = |index: usize| {
        let (rows, columns) = (about(index / CELL_COLUMNS, CELL_ROWS), about(index % CELL_COLUMNS, CELL_COLUMNS));
        let count = (rows.len() * columns.len()) as f64;
        let places = rows.flat_map(|row| columns.clone().map(move |column| row * CELL_COLUMNS + column));
        places.map(|place| f64::from(page[place])).sum::<f64>() / (count * scale)
    };
    (0..CELLS).map(cell).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::infer::Input;

    #[test]
    fn a_prediction_off_by_a_tenth_costs_a_hundredth_of_the_smooth_square() {
        let input = Input { inputs: vec![], scalars: vec![], scale: 0.5 };
        let truth: Vec<f32> = [vec![2.0; CELLS], vec![1.0; CELLS]].concat();
        let sample = Sample { input, truth_error: vec![0.0; 2 * CELLS], truth, specimen: String::new(), seed: 0 };
        for page_weight in [0.0, 0.25, 1.0] {
            let weights = loss_weights(&sample, page_weight);
            // Truth over scale is 4 and 2; a tenth of it 0.4 and 0.2, of the sum 0.6.
            let cost: f64 = weights.iter().zip([0.6_f64, 0.4, 0.2]).map(|(weight, off)| weight * off * off * CELLS as f64).sum();
            assert!((cost - 0.01).abs() < 1e-12, "{cost}");
        }
    }

    #[test]
    fn smoothing_keeps_a_constant_and_spreads_a_peak() {
        assert!(smoothed(&vec![3.0; CELLS], 1.5).iter().all(|value| (value - 2.0).abs() < 1e-12));
        let mut peak = vec![0.0; CELLS];
        peak[5 * CELL_COLUMNS + 7] = 9.0;
        let smooth = smoothed(&peak, 1.0);
        assert_eq!(smooth.iter().filter(|value| **value == 1.0).count(), 9);
        assert_eq!(smooth.iter().filter(|value| **value != 0.0).count(), 9);
    }
}

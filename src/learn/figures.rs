//! How good a network is on samples it was not trained on.

use std::collections::BTreeMap;

use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use super::Sample;
use super::loss::Batch;
use crate::infer::{CELL_COLUMNS, CELL_ROWS, CELLS, COLUMNS, Card, Input, Network, PAGES, PIXELS, ROWS};

/// Names of figures in a card.
pub(super) const SAMPLES: &str = "samples";
pub(super) const MEAN_RMS: &str = "mean_rms";
pub(super) const EDGE_BIAS: &str = "edge_bias";
pub(super) const EDGE_CELLS: &str = "edge_cells";

/// Place of the channel of absorbing thickness among [`crate::transport::CHANNELS`], and how much of it ends at an edge.
const ABSORBING: usize = 3;
const EDGE: f32 = 0.5;

/// Figures over samples; of each sample one figure, then their mean.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Figures {
    /// Samples.
    pub samples: usize,
    /// Σ(Ŝ−S)²/ΣS² over the cells of the sum of pages, S the noisy truth, its noise taken off the divisor.
    pub nmse_raw: f64,
    /// Share of it that is the truth's noise: Σσ²/ΣS², σ the standard error of the sum of pages.
    pub noise: f64,
    /// Mean of Ŝ's mean over S's mean, less 1.
    pub mean_bias: f64,
    /// Root of the mean square of the same.
    pub mean_rms: f64,
    /// Mean of (Ŝ−S) over mean of S where a tool, or dense bone, ends within a cell; S in units of its sample's mean. 0 where nothing ends.
    pub edge_bias: f64,
    /// Cells of which that is.
    pub edge_cells: usize,
}

impl Figures {
    /// The normalised mean squared error less the noise of the truth; below 0 only by chance.
    #[must_use]
    pub fn nmse(&self) -> f64 {
        self.nmse_raw - self.noise
    }

    fn new(of_samples: &[OfSample]) -> Self {
        let sum = |value: &dyn Fn(&OfSample) -> f64| of_samples.iter().map(value).sum::<f64>();
        let mean = |value: &dyn Fn(&OfSample) -> f64| sum(value) / of_samples.len() as f64;
        let edge_cells = of_samples.iter().map(|one| one.edge_cells).sum();
        Self {
            samples: of_samples.len(),
            nmse_raw: mean(&|one| one.nmse_raw),
            noise: mean(&|one| one.noise),
            mean_bias: mean(&|one| one.mean_error),
            mean_rms: mean(&|one| one.mean_error * one.mean_error).sqrt(),
            edge_bias: if edge_cells > 0 { sum(&|one| one.edge_difference) / sum(&|one| one.edge_truth) } else { 0.0 },
            edge_cells,
        }
    }

    /// By name, for a card.
    pub(super) fn named(&self, suffix: &str) -> [(String, f64); 8] {
        [
            (SAMPLES, self.samples as f64),
            ("nmse", self.nmse()),
            ("nmse_raw", self.nmse_raw),
            ("nmse_noise", self.noise),
            ("mean_bias", self.mean_bias),
            (MEAN_RMS, self.mean_rms),
            (EDGE_BIAS, self.edge_bias),
            (EDGE_CELLS, self.edge_cells as f64),
        ]
        .map(|(name, value)| (format!("{name}{suffix}"), value))
    }
}

/// Figures of one sample.
struct OfSample {
    nmse_raw: f64,
    noise: f64,
    mean_error: f64,
    /// Of the cells with an edge, in units of the mean truth: sum of differences, sum of the truth, and how many they are.
    edge_difference: f64,
    edge_truth: f64,
    edge_cells: usize,
}

/// Figures of `network` over all `samples`, and by specimen; `None` where there are none. Its inputs are normalised by `card`.
#[must_use]
pub fn figures_of(
    network: &Network,
    card: &Card,
    samples: &[&Sample],
    batch: usize,
    device: &Device,
) -> Option<(Figures, BTreeMap<String, Figures>)> {
    if samples.is_empty() {
        return None;
    }
    let (mut all, mut by_specimen) = (Vec::new(), BTreeMap::<String, Vec<usize>>::new());
    for chunk in samples.chunks(batch) {
        let predicted = Batch::new(chunk, card, 0.0, device).predicted(network).into_data();
        let values: Vec<f32> = predicted.iter::<f32>().collect();
        for (sample, ratio) in chunk.iter().zip(values.chunks(2 * CELLS)) {
            by_specimen.entry(sample.specimen.clone()).or_default().push(all.len());
            all.push(OfSample::new(sample, ratio));
        }
    }
    let parts = by_specimen.into_iter().map(|(name, places)| {
        let own: Vec<OfSample> = places.into_iter().map(|place| OfSample { ..all[place] }).collect();
        (name, Figures::new(&own))
    });
    let parts = parts.collect();
    Some((Figures::new(&all), parts))
}

impl OfSample {
    /// `ratio` is the predicted scatter over scale, [2, 12, 16].
    fn new(sample: &Sample, ratio: &[f32]) -> Self {
        let (mut difference, mut square, mut noise, mut predicted_sum, mut truth_sum) = (0.0, 0.0, 0.0, 0.0, 0.0);
        let (mut edge_difference, mut edge_truth, mut edge_cells) = (0.0, 0.0, 0);
        for cell in 0..CELLS {
            let sum = |values: &[f32]| f64::from(values[cell]) + f64::from(values[CELLS + cell]);
            let (predicted, truth) = (sum(ratio) * f64::from(sample.input.scale), sum(&sample.truth));
            difference += (predicted - truth).powi(2);
            square += truth * truth;
            noise += f64::from(sample.truth_error[PAGES * CELLS + cell]).powi(2);
            predicted_sum += predicted;
            truth_sum += truth;
            if has_edge(&sample.input, cell) {
                edge_difference += predicted - truth;
                edge_truth += truth;
                edge_cells += 1;
            }
        }
        let mean = truth_sum / CELLS as f64;
        // The noise of the truth is in its square as well.
        let square = (square - noise).max(0.1 * square);
        Self {
            nmse_raw: difference / square,
            noise: noise / square,
            mean_error: predicted_sum / truth_sum - 1.0,
            edge_difference: edge_difference / mean,
            edge_truth: edge_truth / mean,
            edge_cells,
        }
    }
}

/// Whether the absorbing thickness changes by more than [`EDGE`] from ray to ray within `cell`.
fn has_edge(input: &Input, cell: usize) -> bool {
    let Some(page) = input.inputs.get(ABSORBING * PIXELS..(ABSORBING + 1) * PIXELS) else { return false };
    let [across, down] = [COLUMNS / CELL_COLUMNS, ROWS / CELL_ROWS];
    let [column, row] = [cell % CELL_COLUMNS * across, cell / CELL_COLUMNS * down];
    let rays = (row..row + down).flat_map(|row| &page[row * COLUMNS + column..][..across]);
    let (least, most) =
        rays.fold((f32::INFINITY, f32::NEG_INFINITY), |(least, most), value| (least.min(*value), most.max(*value)));
    most - least > EDGE
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::infer::Input;

    #[test]
    fn figures_of_a_sample_follow_from_their_formulae() {
        // A tool ends in the first cell of the second row, where the truth is no other.
        let mut inputs = vec![0.0; 9 * PIXELS];
        inputs[ABSORBING * PIXELS + 5 * COLUMNS + 2] = 0.6;
        let input = Input { inputs, scalars: vec![], scale: 2.0 };
        let truth = [vec![3.0; CELLS], vec![1.0; CELLS]].concat();
        let sample = Sample { input, truth, truth_error: vec![0.2; 3 * CELLS], specimen: String::new(), seed: 0 };
        // Predicted 2 · (1.1 + 1.1) = 4.4, seen 4: off by 0.4; noise 0.04, of which 16 is as much more than the truth's square.
        let one = OfSample::new(&sample, &vec![1.1; 2 * CELLS]);
        assert!(
            (one.nmse_raw - 0.16 / 15.96).abs() < 1e-6
                && (one.noise - 0.04 / 15.96).abs() < 1e-6
                && (one.mean_error - 0.1).abs() < 1e-6
        );
        assert_eq!(crate::transport::CHANNELS[ABSORBING], "photo");
        assert!(one.edge_cells == 1 && (one.edge_difference - 0.1).abs() < 1e-6 && (one.edge_truth - 1.0).abs() < 1e-6);
        assert!(
            has_edge(&sample.input, CELL_COLUMNS) && !has_edge(&sample.input, 0) && !has_edge(&sample.input, CELL_COLUMNS + 1)
        );
        let low = OfSample { nmse_raw: 0.0, noise: 0.0, mean_error: -0.1, edge_difference: 0.5, edge_truth: 5.0, edge_cells: 3 };
        let both = Figures::new(&[one, low]);
        assert!(both.edge_cells == 4 && (both.edge_bias - 0.1).abs() < 1e-6);
        assert!(both.mean_bias.abs() < 1e-6 && (both.mean_rms - 0.1).abs() < 1e-6 && (both.nmse() - 0.06 / 15.96).abs() < 1e-6);
    }
}

//! A batch of patches on the device, and its loss.

use burn::tensor::{Device, Tensor, TensorData};

use super::patch::Patch;
use crate::infer::materials::{CLASSES, CubeNetwork, INPUTS, Pass};

/// Points that a class of its own size would have to be wrong by before an empty one counts.
const FEW: f32 = 50.0;

/// Patches of one step.
pub(super) struct Batch {
    windows: Tensor<5>,
    truth: Tensor<5>,
    weight: Tensor<5>,
}

impl Batch {
    pub(super) fn new(patches: &[Patch], pass: &Pass, device: &Device) -> Self {
        let side = pass.patch;
        let tensor = |channels: usize, values: &dyn Fn(&Patch) -> &[f32]| {
            let all: Vec<f32> = patches.iter().flat_map(|patch| values(patch).iter().copied()).collect();
            Tensor::from_data(TensorData::new(all, [patches.len(), channels, side, side, side]), device)
        };
        Self {
            windows: tensor(INPUTS, &|patch| &patch.windows),
            truth: tensor(CLASSES, &|patch| &patch.truth),
            weight: tensor(1, &|patch| &patch.weight),
        }
    }

    /// 1 − mean over the classes of (2 Σ w p t + ε) / (Σ w (p² + t²) + ε): 0 only where every probability is the share of its class
    /// (multi-class Dice with squares, Milletari, Navab & Ahmadi 2016).
    pub(super) fn loss(&self, network: &CubeNetwork) -> Tensor<1> {
        let said = network.probabilities(self.windows.clone());
        let of_class = |values: Tensor<5>| {
            let [batch, classes, depth, rows, columns] = values.dims();
            let flat: Tensor<3> = values.reshape([batch, classes, depth * rows * columns]);
            flat.sum_dim(2).sum_dim(0).reshape([CLASSES])
        };
        let weight = self.weight.clone();
        let both: Tensor<1> = of_class(said.clone() * self.truth.clone() * weight.clone()) * 2.0 + FEW;
        let each: Tensor<1> = of_class((said.square() + self.truth.clone().square()) * weight) + FEW;
        -(both / each).mean() + 1.0
    }
}

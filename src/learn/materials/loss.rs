//! A batch of patches on the device, and its loss.

use burn::tensor::activation::{log_softmax, softmax};
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
    /// Sum of the weights.
    whole: f32,
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
            whole: patches.iter().flat_map(|patch| &patch.weight).map(|weight| f64::from(*weight)).sum::<f64>() as f32,
        }
    }

    /// 1 − mean over the classes of (2 Σ w p t + ε) / (Σ w (p² + t²) + ε), which is 0 only where every probability is the share of its class
    /// (multi-class Dice with squares, Milletari, Navab & Ahmadi 2016), and the cross-entropy −Σ w t ln p / Σ w beside it (Isensee et al. 2021): it
    /// has a slope also where a patch holds hardly any of a class.
    pub(super) fn loss(&self, network: &CubeNetwork) -> Tensor<1> {
        let logits = network.forward(self.windows.clone());
        let said = softmax(logits.clone(), 1);
        let of_class = |values: Tensor<5>| {
            let [batch, classes, depth, rows, columns] = values.dims();
            let flat: Tensor<3> = values.reshape([batch, classes, depth * rows * columns]);
            flat.sum_dim(2).sum_dim(0).reshape([CLASSES])
        };
        let weight = self.weight.clone();
        // By class, then over them: a GPU adds up a whole tensor in the order in which its groups are done, and then no training is another one's bits.
        let entropy = -of_class(log_softmax(logits, 1) * self.truth.clone() * weight.clone()).sum_dim(0) / (self.whole + FEW);
        let both: Tensor<1> = of_class(said.clone() * self.truth.clone() * weight.clone()) * 2.0 + FEW;
        let each: Tensor<1> = of_class((said.square() + self.truth.clone().square()) * weight) + FEW;
        -(both / each).mean_dim(0) + 1.0 + entropy
    }
}

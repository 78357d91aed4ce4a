//! One pass as tensors on a device: Hounsfield numbers of patches in, logits of the classes out.

use burn::tensor::activation::{relu, softmax};
use burn::tensor::{Device, Tensor};

use super::layers::{CLASSES, Levels, Pass};
use crate::infer::{Convolution, Layer};

/// All layers of a pass.
#[derive(Clone, Debug)]
pub struct CubeNetwork {
    fold: usize,
    levels: Levels<Convolution<5>>,
    layers: Vec<Convolution<5>>,
}

/// `hu` of the points of patches in the two windows, [2, points]; below −1000 as −1000.
pub fn windows(hu: &[f32]) -> impl Iterator<Item = f32> + '_ {
    let wide = hu.iter().map(|hu| hu.clamp(-1000.0, 2000.0) / 1000.0);
    let narrow = hu.iter().map(|hu| (hu.clamp(-200.0, 600.0) - 200.0) / 200.0);
    wide.chain(narrow)
}

impl CubeNetwork {
    /// The network of `pass` with `parameters`: for each of its [`Layer`]s the weight, row-major, then the bias. `None` where there are more or
    /// fewer. On a device with autodiff the parameters ask for gradients.
    #[must_use]
    pub fn new(pass: &Pass, parameters: &[f32], device: &Device) -> Option<Self> {
        if parameters.len() != pass.parameter_count() {
            return None;
        }
        let (mut rest, mut layers) = (parameters, Vec::new());
        let levels = Levels::build(pass, |layer: Layer| {
            let convolution = Convolution::take(&layer, &mut rest, device);
            layers.push(convolution.clone());
            convolution
        });
        Some(Self { fold: pass.fold, levels, layers })
    }

    /// The layers in the order of the parameters.
    #[must_use]
    pub fn layers(&self) -> &[Convolution<5>] {
        &self.layers
    }

    /// Logits of the classes, [B, 3, n, n, n], from `windows` of n³ points each, [B, 2, n, n, n] (z, y, x).
    #[must_use]
    pub fn forward(&self, windows: Tensor<5>) -> Tensor<5> {
        let mut x = folded(windows, self.fold);
        let mut levels = Vec::new();
        for [first, second] in &self.levels.down {
            x = relu(second.forward(relu(first.forward(x))));
            levels.push(x.clone());
        }
        levels.pop();
        for join in &self.levels.up {
            let beside = levels.pop().expect("one level less than down");
            x = relu(join.forward(Tensor::cat(vec![beside, doubled(x)], 1)));
        }
        unfolded(self.levels.output.forward(x), self.fold)
    }

    /// Probabilities of the classes, [B, 3, n, n, n].
    #[must_use]
    pub fn probabilities(&self, windows: Tensor<5>) -> Tensor<5> {
        softmax(self.forward(windows), 1)
    }
}

/// Cells of `fold`³ points as channels: [B, C · fold³, n / fold, …].
fn folded(x: Tensor<5>, fold: usize) -> Tensor<5> {
    if fold == 1 {
        return x;
    }
    let [batch, channels, depth, rows, columns] = x.dims();
    let [depth, rows, columns] = [depth, rows, columns].map(|size| size / fold);
    let cells: Tensor<8> = x.reshape([batch, channels, depth, fold, rows, fold, columns, fold]);
    cells.permute([0, 1, 3, 5, 7, 2, 4, 6]).reshape([batch, channels * fold.pow(3), depth, rows, columns])
}

/// The inverse of [`folded`], of the classes.
fn unfolded(x: Tensor<5>, fold: usize) -> Tensor<5> {
    if fold == 1 {
        return x;
    }
    let [batch, _, depth, rows, columns] = x.dims();
    let cells: Tensor<8> = x.reshape([batch, CLASSES, fold, fold, fold, depth, rows, columns]);
    cells.permute([0, 1, 5, 2, 6, 3, 7, 4]).reshape([batch, CLASSES, depth * fold, rows * fold, columns * fold])
}

/// Every value twice along each axis.
fn doubled(x: Tensor<5>) -> Tensor<5> {
    let [batch, channels, depth, rows, columns] = x.dims();
    let x: Tensor<8> = x.reshape([batch, channels, depth, 1, rows, 1, columns, 1]);
    x.expand([batch, channels, depth, 2, rows, 2, columns, 2]).reshape([batch, channels, 2 * depth, 2 * rows, 2 * columns])
}

#[cfg(test)]
mod tests {
    use burn::tensor::TensorData;

    use super::*;

    fn counting(shape: [usize; 5]) -> Tensor<5> {
        let values: Vec<f32> = (0..shape.iter().product()).map(|n: usize| n as f32).collect();
        Tensor::from_data(TensorData::new(values, shape), &Device::flex())
    }

    fn values(x: Tensor<5>) -> Vec<f32> {
        x.into_data().iter::<f32>().collect()
    }

    #[test]
    fn cells_become_channels_and_come_back_in_place() {
        let points = counting([1, CLASSES, 4, 4, 4]);
        let cells = folded(points.clone(), 2);
        assert_eq!(cells.dims(), [1, CLASSES * 8, 2, 2, 2]);
        // The last point of the first cell of the first channel lies at (z, y, x) = (1, 1, 1).
        assert_eq!(values(cells.clone())[7 * 8], 21.0);
        assert!(values(unfolded(cells, 2)) == values(points));
    }

    #[test]
    fn doubling_repeats_every_value_along_every_axis() {
        let fine = values(doubled(counting([1, 1, 2, 2, 2])));
        for (at, value) in fine.iter().enumerate() {
            let [z, y, x] = [at / 16, at / 4 % 4, at % 4].map(|n| n / 2);
            assert_eq!(*value, (4 * z + 2 * y + x) as f32, "{at}");
        }
    }

    #[test]
    fn windows_are_bounded_whatever_a_ct_holds() {
        let seen: Vec<f32> = windows(&[-3024.0, 0.0, 100.0, 5000.0]).collect();
        assert_eq!(seen, [-1.0, 0.0, 0.1, 2.0, -2.0, -1.0, -0.5, 2.0]);
    }
}

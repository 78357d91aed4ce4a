//! A network as tensors on a device: parameters in, logarithms out.

use burn::tensor::activation::{leaky_relu, relu};
use burn::tensor::module::avg_pool2d;
use burn::tensor::ops::AvgPoolOptions;
use burn::tensor::{Device, Tensor, TensorData};

use super::convolution::Convolution;
use super::layers::Stages;
use super::{Architecture, CELL_COLUMNS, CELL_ROWS, COLUMNS, Layer, ROWS};

/// Predictions lie within e^±8 of `scale`: a network far from where it was trained stays finite.
pub const LOG_LIMIT: f64 = 8.0;
/// Slope below 0 of the paper's network: a layer of a single channel that is 0 everywhere would never learn again.
const LEAK: f64 = 0.1;

/// All layers of a network.
#[derive(Clone, Debug)]
pub struct Network {
    stages: Stages<Convolution<4>>,
    layers: Vec<Convolution<4>>,
    from_sixteenth: Tensor<2>,
    from_eighth: Tensor<2>,
}

impl Network {
    /// A network of `architecture` with `parameters`: for each of its [`Layer`]s the weight, row-major, then the bias. `None` where there
    /// are more or fewer. On a device with autodiff the parameters ask for gradients.
    #[must_use]
    pub fn new(architecture: Architecture, channels: usize, scalars: usize, parameters: &[f32], device: &Device) -> Option<Self> {
        if parameters.len() != architecture.layers(channels, scalars).iter().map(Layer::value_count).sum::<usize>() {
            return None;
        }
        let (mut rest, mut layers) = (parameters, Vec::new());
        let stages = Stages::build(architecture, channels + scalars, |layer| {
            let convolution = Convolution::take(&layer, &mut rest, device);
            layers.push(convolution.clone());
            convolution
        });
        let from_sixteenth = doubling(CELL_ROWS / 4, CELL_COLUMNS / 4, device);
        let from_eighth = doubling(CELL_ROWS / 2, CELL_COLUMNS / 2, device);
        Some(Self { stages, layers, from_sixteenth, from_eighth })
    }

    /// The layers in the order of the parameters.
    #[must_use]
    pub fn layers(&self) -> &[Convolution<4>] {
        &self.layers
    }

    /// ln(scatter / scale), [B, 2, 12, 16], from normalised channels [B, C, 48, 64] and scalars [B, K].
    #[must_use]
    pub fn forward(&self, channels: Tensor<4>, scalars: Tensor<2>) -> Tensor<4> {
        let [batch, count] = scalars.dims();
        let planes = scalars.reshape([batch, count, 1, 1]).expand([batch, count, ROWS, COLUMNS]);
        let x = Tensor::cat(vec![channels, planes], 1);
        let logarithm = match &self.stages {
            Stages::Default { down, before, eighth, sixteenth, after, output } => {
                let mut x = down.iter().fold(x, |x, layer| relu(layer.forward(x)));
                for block in before {
                    x = residual(block, x);
                }
                let near = relu(eighth.forward(pooled(x.clone(), 2)));
                let far = sixteenth.iter().fold(pooled(near.clone(), 2), |x, layer| relu(layer.forward(x)));
                let near = near + doubled(far, &self.from_sixteenth);
                x = residual(after, x + doubled(near, &self.from_eighth));
                output.forward(x)
            }
            Stages::Paper { features, smooth: [first, second, third, last] } => {
                let layers = features.iter().chain([first, second, third]);
                let x = layers.fold(x, |x, layer| leaky_relu(layer.forward(x), LEAK));
                pooled(last.forward(x), ROWS / CELL_ROWS)
            }
        };
        (logarithm / LOG_LIMIT).tanh() * LOG_LIMIT
    }
}

fn residual([first, second]: &[Convolution<4>; 2], x: Tensor<4>) -> Tensor<4> {
    relu(x.clone() + second.forward(relu(first.forward(x))))
}

fn pooled(x: Tensor<4>, factor: usize) -> Tensor<4> {
    avg_pool2d(x, AvgPoolOptions::new([factor; 2]).with_stride([factor; 2]))
}

/// `x` at twice its rows and columns, by the matrix of [`doubling`].
fn doubled(x: Tensor<4>, matrix: &Tensor<2>) -> Tensor<4> {
    let [batch, channels, rows, columns] = x.dims();
    x.reshape([batch * channels, rows * columns]).matmul(matrix.clone()).reshape([batch, channels, 2 * rows, 2 * columns])
}

/// Bilinear interpolation to twice the resolution about the same centre, [rows · columns, 4 · rows · columns]; constant beyond the
/// outermost centres.
fn doubling(rows: usize, columns: usize, device: &Device) -> Tensor<2> {
    let shares = |size: usize| -> Vec<f32> {
        let mut shares = vec![0.0; size * 2 * size];
        for fine in 0..2 * size {
            let place = ((fine as f32 + 0.5) / 2.0 - 0.5).clamp(0.0, (size - 1) as f32);
            let low = place as usize;
            shares[low * 2 * size + fine] += 1.0 - (place - low as f32);
            shares[(low + 1).min(size - 1) * 2 * size + fine] += place - low as f32;
        }
        shares
    };
    let (down, across) = (shares(rows), shares(columns));
    let (fine_rows, fine_columns) = (2 * rows, 2 * columns);
    let mut matrix = Vec::with_capacity(rows * columns * fine_rows * fine_columns);
    for row in 0..rows {
        for column in 0..columns {
            for fine_row in 0..fine_rows {
                let share = down[row * fine_rows + fine_row];
                matrix.extend((0..fine_columns).map(|fine_column| share * across[column * fine_columns + fine_column]));
            }
        }
    }
    Tensor::from_data(TensorData::new(matrix, [rows * columns, fine_rows * fine_columns]), device)
}

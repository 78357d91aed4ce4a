//! The parameters of one layer as tensors on a device.

use burn::tensor::module::{conv2d, conv3d};
use burn::tensor::ops::ConvOptions;
use burn::tensor::{Device, Tensor, TensorData};

use super::Layer;

/// A layer over squares (`D` = 4) or cubes (5).
#[derive(Clone, Debug)]
pub struct Convolution<const D: usize> {
    /// As [`Layer::weight_shape`].
    pub weight: Tensor<D>,
    /// [outputs].
    pub bias: Tensor<1>,
    stride: usize,
    padding: usize,
}

impl<const D: usize> Convolution<D> {
    /// The one of `layer` with the first of the parameters `rest`, which loses them. On a device with autodiff they ask for gradients.
    ///
    /// # Panics
    /// With fewer parameters than the layer has.
    pub(super) fn take(layer: &Layer, rest: &mut &[f32], device: &Device) -> Self {
        let (weight, behind) = rest.split_at(layer.weight_count());
        let (bias, behind) = behind.split_at(layer.outputs);
        *rest = behind;
        let mut weight = Tensor::from_data(TensorData::new(weight.to_vec(), layer.weight_shape()), device);
        let mut bias = Tensor::from_data(TensorData::new(bias.to_vec(), [layer.outputs]), device);
        if device.is_autodiff() {
            (weight, bias) = (weight.require_grad(), bias.require_grad());
        }
        Self { weight, bias, stride: layer.stride, padding: layer.padding() }
    }

    fn options<const N: usize>(&self) -> ConvOptions<N> {
        ConvOptions::new([self.stride; N], [self.padding; N], [1; N], 1)
    }
}

impl Convolution<4> {
    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        conv2d(x, self.weight.clone(), Some(self.bias.clone()), self.options::<2>())
    }
}

impl Convolution<5> {
    pub(super) fn forward(&self, x: Tensor<5>) -> Tensor<5> {
        conv3d(x, self.weight.clone(), Some(self.bias.clone()), self.options::<3>())
    }
}

//! The parameters of one layer as tensors on a device.

use burn::tensor::module::{conv2d, conv3d};
use burn::tensor::ops::ConvOptions;
use burn::tensor::{Device, Tensor, TensorData};

use super::Layer;
use super::device::is_processor;

/// What lies under the kernel at once, at most, unless a single row of the output takes more: no device refuses a buffer of 128 MiB.
const MOST_BYTES: usize = 120 << 20;

/// A layer over squares (`D` = 4) or cubes (5).
#[derive(Clone, Debug)]
pub struct Convolution<const D: usize> {
    /// As [`Layer::weight_shape`].
    pub weight: Tensor<D>,
    /// [outputs].
    pub bias: Tensor<1>,
    kernel: usize,
    stride: usize,
    padding: usize,
    by_product: bool,
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
        // A GPU's own gradient by the weight is one thread a value: a hundred times slower than a product of matrices. Without gradients its own
        // convolution takes half the time of one.
        let by_product = !is_processor(device) && device.is_autodiff();
        Self { weight, bias, kernel: layer.kernel, stride: layer.stride, padding: layer.padding(), by_product }
    }

    fn options<const N: usize>(&self) -> ConvOptions<N> {
        ConvOptions::new([self.stride; N], [self.padding; N], [1; N], 1)
    }

    /// The same as a product of matrices: the weights by what lies under each place of the kernel.
    fn product(&self, x: Tensor<D>) -> Tensor<D> {
        let dims = x.dims();
        let outputs: [usize; D] = std::array::from_fn(|axis| if axis < 2 { dims[axis] } else { self.outputs(dims[axis]) });
        let row_bytes = 4 * dims[0] * dims[1] * self.kernel.pow(D as u32 - 2) * outputs[3..].iter().product::<usize>();
        let rows = (MOST_BYTES / row_bytes).max(1);
        let padded = self.padded(x, 2);
        let of_rows = |first: usize| {
            let rows = rows.min(outputs[2] - first);
            self.product_of_padded(padded.clone().narrow(2, first * self.stride, self.inputs(rows)))
        };
        let mut parts: Vec<Tensor<D>> = (0..outputs[2]).step_by(rows).map(of_rows).collect();
        if parts.len() == 1 { parts.remove(0) } else { Tensor::cat(parts, 2) }
    }

    /// Of what is padded along axis 2 already.
    fn product_of_padded(&self, padded: Tensor<D>) -> Tensor<D> {
        let outputs = self.weight.dims()[0];
        let x = self.under_kernel(padded, 2);
        let seen = (3..D).fold(x, |x, axis| self.under_kernel(self.padded(x, axis), axis));
        let mut dims = seen.dims();
        let points: usize = dims[2..].iter().product();
        let columns: Tensor<3> = seen.reshape([dims[0], dims[1], points]);
        // [O, C, k₁ …] to [O, … k₁ · C], the order in which `under_kernel` puts places before channels.
        let last_first: [isize; D] = std::array::from_fn(|at| if at == 0 { 0 } else { (D - at) as isize });
        let weight: Tensor<3> = self.weight.clone().permute(last_first).reshape([1, outputs, dims[1]]);
        let product = weight.matmul(columns) + self.bias.clone().reshape([1, outputs, 1]);
        dims[1] = outputs;
        product.reshape(dims)
    }

    /// Values along an axis of `inputs`.
    fn outputs(&self, inputs: usize) -> usize {
        (inputs + 2 * self.padding - self.kernel) / self.stride + 1
    }

    /// What `outputs` values along an axis are made from: at every place of the kernel begins a stretch of so many strides.
    fn inputs(&self, outputs: usize) -> usize {
        self.kernel - 1 + outputs * self.stride
    }

    /// `x` with zeros on both sides along `axis`.
    fn padded(&self, x: Tensor<D>, axis: usize) -> Tensor<D> {
        let dims = x.dims();
        let behind = self.inputs(self.outputs(dims[axis])) - self.padding - dims[axis];
        let zeros = |length: usize| {
            let shape: [usize; D] = std::array::from_fn(|at| if at == axis { length } else { dims[at] });
            (length > 0).then(|| Tensor::zeros(shape, &x.device()))
        };
        let parts = [zeros(self.padding), Some(x.clone()), zeros(behind)].into_iter().flatten().collect();
        Tensor::cat(parts, axis)
    }

    /// For every place of the kernel along `axis` the channels of `padded` that lie under it, as so many times more channels.
    fn under_kernel(&self, padded: Tensor<D>, axis: usize) -> Tensor<D> {
        let mut dims = padded.dims();
        let (before, after): (usize, usize) = (dims[..axis].iter().product(), dims[axis + 1..].iter().product());
        let outputs = (dims[axis] + 1 - self.kernel) / self.stride;
        dims[axis] = outputs;
        let place = |place: usize| {
            let stretch = padded.clone().narrow(axis, place, outputs * self.stride);
            if self.stride == 1 {
                return stretch;
            }
            let strides: Tensor<4> = stretch.reshape([before, outputs, self.stride, after]);
            strides.narrow(2, 0, 1).reshape(dims)
        };
        Tensor::cat((0..self.kernel).map(place).collect(), 1)
    }
}

impl Convolution<4> {
    pub(super) fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        if self.by_product {
            return self.product(x);
        }
        conv2d(x, self.weight.clone(), Some(self.bias.clone()), self.options::<2>())
    }
}

impl Convolution<5> {
    pub(super) fn forward(&self, x: Tensor<5>) -> Tensor<5> {
        if self.by_product {
            return self.product(x);
        }
        conv3d(x, self.weight.clone(), Some(self.bias.clone()), self.options::<3>())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    fn drawn(count: usize, number: u32) -> Vec<f32> {
        let mut stream = Stream::new(9, 0, number, Purpose::FirstWeights);
        (0..count).map(|_| stream.normal() as f32).collect()
    }

    /// Values and slopes of both ways for a kernel of `kernel` at every `stride`.
    fn both<const D: usize>(
        (kernel, stride): (usize, usize),
        shape: [usize; D],
        forward: impl Fn(&Convolution<D>, Tensor<D>) -> Tensor<D>,
    ) -> [Vec<f32>; 2] {
        let device = Device::flex().autodiff();
        let layer = Layer { name: String::new(), inputs: shape[1], outputs: 3, dimensions: D - 2, kernel, stride, gain: 1.0 };
        let parameters = drawn(layer.value_count(), 0);
        [false, true].map(|by_product| {
            let layer = Convolution { by_product, ..Convolution::<D>::take(&layer, &mut parameters.as_slice(), &device) };
            let values = drawn(shape.iter().product(), 1);
            let x = Tensor::<D>::from_data(TensorData::new(values, shape), &device).require_grad();
            let found = forward(&layer, x.clone());
            let weights = Tensor::from_data(TensorData::new(drawn(found.dims().iter().product(), 2), found.dims()), &device);
            let mut slopes = (found.clone() * weights).sum().backward();
            let data = [
                found.into_data(),
                x.grad_remove(&mut slopes).expect("x is used").into_data(),
                layer.weight.grad_remove(&mut slopes).expect("the weight is used").into_data(),
                layer.bias.grad_remove(&mut slopes).expect("the bias is used").into_data(),
            ];
            data.iter().flat_map(|data| data.iter::<f32>().collect::<Vec<f32>>()).collect()
        })
    }

    fn agree([native, product]: &[Vec<f32>; 2], what: &str) {
        assert_eq!(native.len(), product.len(), "{what}");
        let largest = native.iter().map(|value| value.abs()).fold(0.0, f32::max);
        let near = native.iter().zip(product).filter(|(a, b)| (**a - **b).abs() < 1e-5 * largest).count();
        assert_eq!(near, native.len(), "{what}: of values up to {largest}");
    }

    #[test]
    fn a_product_of_matrices_is_the_convolution_and_has_its_slopes() {
        for (kernel, stride) in [(1, 1), (3, 1), (2, 2), (4, 2), (11, 1)] {
            let what = format!("{kernel} by {stride}");
            agree(&both((kernel, stride), [2, 4, 6, 8], Convolution::<4>::forward), &what);
            if kernel < 11 {
                agree(&both((kernel, stride), [2, 3, 4, 6, 2], Convolution::<5>::forward), &what);
            }
        }
        // In two parts, of rows of 35 MB.
        agree(&both((3, 1), [1, 8, 5, 200, 200], Convolution::<5>::forward), "in parts");
    }
}

//! The layers of each architecture, written once: as shapes, and as what is made of them.

use serde::{Deserialize, Serialize};

use super::PAGES;

/// Channels at 24 × 32.
const HALF: usize = 32;
/// Channels at 12 × 16 and below.
const WIDE: usize = 64;
/// Channels of the six first layers of the paper's network; the paper says "multiple".
const PAPER: usize = 8;

/// Which layers a network has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Architecture {
    /// Few wide layers at low resolution, with a branch that sees the whole image.
    Default,
    /// Ten layers at input resolution: six of 11×11 kernels in several channels, four of 31×31 in one (Unberath et al. 2018, DeepDRR).
    Paper,
}

/// A convolution with bias over a square or a cube, zero-padded so that its stride divides the size exactly.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// Name of its tensors in a file, before `.weight` and `.bias`.
    pub name: String,
    /// Channels in.
    pub inputs: usize,
    /// Channels out.
    pub outputs: usize,
    /// 2 or 3.
    pub dimensions: usize,
    /// Side of the kernel.
    pub kernel: usize,
    /// Step in every direction.
    pub stride: usize,
    /// First weights are normal with deviation `gain · √(2 / fan_in)`.
    pub gain: f32,
}

impl Layer {
    fn new(name: impl Into<String>, [inputs, outputs]: [usize; 2], kernel: usize, stride: usize, gain: f32) -> Self {
        Self { name: name.into(), inputs, outputs, dimensions: 2, kernel, stride, gain }
    }

    /// [outputs, inputs, kernel, kernel], of a cube once more kernel.
    #[must_use]
    pub fn weight_shape(&self) -> Vec<usize> {
        let sides = std::iter::repeat_n(self.kernel, self.dimensions);
        [self.outputs, self.inputs].into_iter().chain(sides).collect()
    }

    /// Values that one output is summed from.
    #[must_use]
    pub fn fan_in(&self) -> usize {
        self.inputs * self.kernel.pow(self.dimensions as u32)
    }

    /// Values of its weight and bias together.
    #[must_use]
    pub fn value_count(&self) -> usize {
        self.weight_count() + self.outputs
    }

    /// Values of its weight.
    #[must_use]
    pub fn weight_count(&self) -> usize {
        self.weight_shape().iter().product()
    }

    /// Zeros on each side.
    pub(super) fn padding(&self) -> usize {
        (self.kernel - self.stride) / 2
    }
}

/// What an architecture is made of, in the order of its parameters.
#[derive(Clone, Debug)]
pub(super) enum Stages<T> {
    /// [`Architecture::Default`].
    Default {
        /// To 24 × 32, then to 12 × 16. Kernels of even size keep a cell's centre where it is, and with it mirror symmetry.
        down: [T; 2],
        /// Residual blocks at 12 × 16.
        before: [[T; 2]; 2],
        /// At 6 × 8.
        eighth: T,
        /// At 3 × 4, where two kernels span the whole image.
        sixteenth: [T; 2],
        /// A residual block at 12 × 16 that knows the whole image.
        after: [T; 2],
        /// To the pages.
        output: T,
    },
    /// [`Architecture::Paper`].
    Paper {
        /// 11 × 11.
        features: [T; 6],
        /// 31 × 31.
        smooth: [T; 4],
    },
}

impl<T> Stages<T> {
    /// `make` is called with every layer, in the order of the parameters.
    pub(super) fn build(architecture: Architecture, input_channels: usize, mut make: impl FnMut(Layer) -> T) -> Self {
        match architecture {
            Architecture::Default => {
                let mut wide = |name: String, gain: f32| make(Layer::new(name, [WIDE, WIDE], 3, 1, gain));
                // Blocks begin near the identity, so that no normalisation layer is needed.
                let mut block = |name: &str| [wide(format!("{name}.0"), 1.0), wide(format!("{name}.1"), 0.2)];
                let before = [block("before.0"), block("before.1")];
                let after = block("after");
                let eighth = wide("eighth".to_owned(), 1.0);
                let sixteenth = [wide("sixteenth.0".to_owned(), 1.0), wide("sixteenth.1".to_owned(), 1.0)];
                let down = [
                    make(Layer::new("down.0", [input_channels, HALF], 4, 2, 1.0)),
                    make(Layer::new("down.1", [HALF, WIDE], 4, 2, 1.0)),
                ];
                let output = make(Layer::new("output", [WIDE, PAGES], 1, 1, 0.1));
                Self::Default { down, before, eighth, sixteenth, after, output }
            }
            Architecture::Paper => {
                let features = std::array::from_fn(|place| {
                    let inputs = if place == 0 { input_channels } else { PAPER };
                    make(Layer::new(format!("features.{place}"), [inputs, PAPER], 11, 1, 1.0))
                });
                let smooth = std::array::from_fn(|place| {
                    let channels = [if place == 0 { PAPER } else { 1 }, if place == 3 { PAGES } else { 1 }];
                    make(Layer::new(format!("smooth.{place}"), channels, 31, 1, if place == 3 { 0.1 } else { 1.0 }))
                });
                Self::Paper { features, smooth }
            }
        }
    }
}

impl Architecture {
    /// The layers of a network that takes `channels` channels and `scalars` scalars, in the order of its parameters.
    #[must_use]
    pub fn layers(self, channels: usize, scalars: usize) -> Vec<Layer> {
        let mut layers = Vec::new();
        Stages::build(self, channels + scalars, |layer| layers.push(layer));
        layers
    }
}

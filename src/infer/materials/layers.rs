//! The passes that a network makes over a CT, and their layers: written once, as shapes and as what is made of them.

use serde::{Deserialize, Serialize};

use crate::infer::Layer;

/// Windows of Hounsfield numbers that a pass sees: all of them, and those of tissue and thin bone.
pub const INPUTS: usize = 2;
/// Classes that a pass tells apart.
pub const CLASSES: usize = 3;
/// Class of what is thinner than tissue.
pub const AIR: usize = 0;
/// Class of all tissue but bone, contrast medium in it included.
pub const SOFT: usize = 1;
/// Class of bones, marrow included.
pub const BONE: usize = 2;

/// Which passes a network makes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaterialsArchitecture {
    /// Coarse over all that is dense, fine where that does not rule bone out.
    Default,
    /// One pass at 0.86 × 0.86 × 1.0 mm, patches of 128³ every 64 voxels whose central 64³ are kept (Unberath et al. 2018, DeepDRR).
    Paper,
    /// Two passes of few points, for tests of what any passes do.
    #[cfg(test)]
    Small,
}

/// One pass: an encoder and decoder with skip connections over patches of a grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pass {
    /// Begins the names of its tensors.
    pub name: &'static str,
    /// Distance of the grid's points along x, y, z of `lps`.
    pub spacing_mm: [f64; 3],
    /// Side of a patch, in points of the grid.
    pub patch: usize,
    /// Side of what is kept of it, at its centre.
    pub keep: usize,
    /// Side of the cells that the first layer sees as one: the network works at that much less resolution, and answers for every point.
    pub fold: usize,
    /// Channels of each level; every level has half the resolution of the one before.
    pub channels: &'static [usize],
}

const DEFAULT: [Pass; 2] = [
    Pass { name: "coarse", spacing_mm: [4.0; 3], patch: 48, keep: 32, fold: 2, channels: &[16, 32, 64] },
    Pass { name: "fine", spacing_mm: [1.5; 3], patch: 64, keep: 48, fold: 2, channels: &[16, 32, 64, 64] },
];
const PAPER: [Pass; 1] =
    [Pass { name: "paper", spacing_mm: [0.86, 0.86, 1.0], patch: 128, keep: 64, fold: 1, channels: &[8, 16, 32, 64] }];
#[cfg(test)]
const SMALL: [Pass; 2] = [
    Pass { name: "coarse", spacing_mm: [8.0; 3], patch: 16, keep: 8, fold: 2, channels: &[8, 16] },
    Pass { name: "fine", spacing_mm: [4.0; 3], patch: 16, keep: 12, fold: 2, channels: &[8, 16] },
];

impl MaterialsArchitecture {
    /// The passes, the coarsest first.
    #[must_use]
    pub fn passes(self) -> &'static [Pass] {
        match self {
            Self::Default => &DEFAULT,
            Self::Paper => &PAPER,
            #[cfg(test)]
            Self::Small => &SMALL,
        }
    }

    /// The layers of all passes, in the order of the parameters.
    #[must_use]
    pub fn layers(self) -> Vec<Layer> {
        self.passes().iter().flat_map(|pass| pass.layers()).collect()
    }
}

/// What a pass is made of, in the order of its parameters.
#[derive(Clone, Debug)]
pub(super) struct Levels<T> {
    /// Two of each level; from the second level on the first of them halves the resolution.
    pub down: Vec<[T; 2]>,
    /// From the last level but one up, of each what joins it with the level below.
    pub up: Vec<T>,
    /// To the classes of every point of a cell.
    pub output: T,
}

impl<T> Levels<T> {
    /// `make` is called with every layer, in the order of the parameters.
    pub(super) fn build(pass: &Pass, mut make: impl FnMut(Layer) -> T) -> Self {
        let Pass { name, fold, channels, .. } = pass;
        let layer = |part: String, inputs: usize, outputs: usize, kernel: usize, stride: usize, gain: f32| Layer {
            name: format!("{name}.{part}"),
            inputs,
            outputs,
            dimensions: 3,
            kernel,
            stride,
            gain,
        };
        let points = fold.pow(3);
        let mut down = Vec::new();
        for (level, width) in channels.iter().enumerate() {
            let first = match level.checked_sub(1) {
                None => layer(format!("down.{level}.0"), INPUTS * points, *width, 3, 1, 1.0),
                Some(above) => layer(format!("down.{level}.0"), channels[above], *width, 2, 2, 1.0),
            };
            down.push([make(first), make(layer(format!("down.{level}.1"), *width, *width, 3, 1, 1.0))]);
        }
        let levels = (0..channels.len() - 1).rev();
        let up = levels.map(|level| {
            let inputs = channels[level] + channels[level + 1];
            make(layer(format!("up.{level}"), inputs, channels[level], 3, 1, 1.0))
        });
        let up = up.collect();
        Self { down, up, output: make(layer("output".to_owned(), channels[0], CLASSES * points, 1, 1, 0.1)) }
    }
}

impl Pass {
    /// The layers, in the order of the parameters.
    #[must_use]
    pub fn layers(&self) -> Vec<Layer> {
        let mut layers = Vec::new();
        Levels::build(self, |layer| layers.push(layer));
        layers
    }

    /// Values of all its layers.
    #[must_use]
    pub fn parameter_count(&self) -> usize {
        self.layers().iter().map(Layer::value_count).sum()
    }

    /// Points of a patch.
    #[must_use]
    pub fn points(&self) -> usize {
        self.patch.pow(3)
    }
}

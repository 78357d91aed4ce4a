//! What a plan is put together from: executor, sampling, energies, and what is said of each ingredient.

use serde::{Deserialize, Serialize};

use crate::scene::model::{Response, Scene, Voxels};

/// Which of the two executors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Executor {
    /// The twins in native code, on all cores.
    Cpu,
    /// The shaders.
    Wgsl,
    /// The independent f64 yardstick.
    Reference,
}

impl Executor {
    /// Bound of |Δ line_integral| / max(1, line_integral), noise off.
    #[must_use]
    pub fn stated_error(self) -> f64 {
        match self {
            // f64 geometry; f32 interpolation weights, tables and exponentials: 3e-7 over random scenes, sums over bins 2e-6.
            Self::Cpu => 5e-6,
            // f32 throughout: positions to 2e-5 mm, summed over hundreds of cells and metal edges.
            Self::Wgsl => 5e-4,
            // 1e-9 in f64; pages are f32.
            Self::Reference => 1e-7,
        }
    }
}

/// How volumes are sampled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Sampling {
    /// Cell by cell, the trilinear field integrated exactly in each, in f64.
    ExactCells,
    /// Slab by slab, sixteen rays at a time, the trilinear field integrated exactly in each cell, in f32.
    ExactSlabs,
    /// Slab by slab, thirty-two rays at a time, the same integrals of densities rounded to 16 bits, in 16-bit fixed point.
    FixedSlabs,
    /// Voxel by voxel, constant inside each (Siddon): to compare with other tools.
    PiecewiseConstant,
    /// There is no volume.
    None,
}

impl Sampling {
    /// What `scene` asks for; `volumes` of its objects are volumes.
    pub(super) fn of(scene: &Scene, volumes: usize) -> Self {
        match scene.model.voxels {
            _ if volumes == 0 => Self::None,
            Voxels::Trilinear => Self::ExactCells,
            Voxels::PiecewiseConstant => Self::PiecewiseConstant,
        }
    }

    /// As `--explain` has it.
    pub(super) fn why(self) -> &'static str {
        match self {
            Self::ExactCells => "cell by cell, exact for the trilinear field; empty bricks of 8x8x8 cells are crossed at once",
            Self::ExactSlabs => {
                "slab by slab, sixteen rays at a time, exact for the trilinear field; bricks of 8x8x8 cells that are empty are left out, those of one density crossed at once"
            }
            Self::FixedSlabs => {
                "slab by slab, thirty-two rays at a time, in 16-bit fixed point: densities, positions and weights are rounded; bricks of 8x8x8 cells that are empty are left out, those of one density crossed at once"
            }
            Self::PiecewiseConstant => {
                "voxel by voxel, piecewise constant (Siddon) as the scene asks: not the field that DESIGN 5 defines, for comparison only"
            }
            Self::None => "there is none",
        }
    }
}

/// An energy with its share of the photons.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Node {
    /// Energy; of a fitted node, the energy that attenuates most like it.
    pub energy_kev: f64,
    /// Share φ; the shares add up to 1.
    pub fraction: f64,
    /// What replaces the tables where a few nodes were fitted to the whole spectrum.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fitted: Option<Fitted>,
}

/// A term of an exponential sum that stands for a whole spectrum.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fitted {
    /// Share of the signal in air; the shares add up to 1.
    pub signal_share: f64,
    /// Share of Σ φ r² in air; the shares add up to 1.
    pub square_share: f64,
    /// Mass attenuation of each material of the scene.
    pub cm2_per_g: Vec<f64>,
}

/// What is modelled or left out, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Choice {
    /// The ingredient.
    pub what: String,
    /// Whether it is modelled.
    pub modelled: bool,
    /// Why.
    pub why: String,
}

/// r_k of a node.
pub(super) fn response(scene: &Scene, node: &Node) -> f64 {
    match scene.detector.response {
        Response::Energy => node.energy_kev,
        Response::Counting => 1.0,
    }
}

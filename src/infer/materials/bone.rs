//! The bone of a CT, by a network from files.

use std::path::Path;

use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;

use super::card::MaterialsCard;
use super::grid::{HuVolume, PassGrid, Reduced};
use super::layers::{BONE, INPUTS, Pass};
use super::network::{CubeNetwork, windows};
use crate::infer::{InferError, NetworkDevice, NetworkFiles, fetched};

/// What is thinner is no bone, whatever surrounds it: marrow is soft tissue.
pub const DENSE_HU: f32 = 100.0;
/// A tile none of whose dense voxels has more probability of bone than this in the pass before is not looked at by a finer one. Where one has, the
/// finer pass decides of all of them: it carries over to other bodies better than the coarse one.
const HARDLY: f32 = 0.05;
/// What is denser is no tissue: metal attenuates like bone rather than like muscle.
pub const METAL_HU: f32 = 1700.0;
/// Beyond the scan there is air.
pub const BEYOND_HU: f32 = -1000.0;

/// The network that comes with the program: where its files are in the sources, and what they hold.
const SHIPPED: &str = "calibration/networks/materials";
const SHIPPED_WEIGHTS: &[u8] = include_bytes!("../../../calibration/networks/materials.safetensors");
const SHIPPED_CARD: &[u8] = include_bytes!("../../../calibration/networks/materials.json");

/// Patches that a GPU looks at together.
const PATCHES: usize = 16;

/// A materials network from files.
#[derive(Clone, Debug)]
pub struct LoadedMaterials {
    card: MaterialsCard,
    passes: Vec<(&'static Pass, CubeNetwork)>,
    device: NetworkDevice,
}

/// Probability of bone at the points of a pass; 0 where it did not look.
struct Found {
    grid: PassGrid,
    bone: Vec<f32>,
}

impl LoadedMaterials {
    /// The network `name`, a path with or without the ending of one of its files.
    ///
    /// # Errors
    /// When a file is missing, truncated or of another network.
    pub fn load(name: &Path) -> Result<Self, InferError> {
        let (card, parameters) = NetworkFiles::of(name).read::<MaterialsCard>()?;
        Ok(Self::new(card, &parameters, NetworkDevice::default()))
    }

    /// The network that comes with the program.
    ///
    /// # Errors
    /// When its files are damaged.
    pub fn shipped(device: NetworkDevice) -> Result<Self, InferError> {
        let (card, parameters) = NetworkFiles::of(Path::new(SHIPPED)).parse::<MaterialsCard>(SHIPPED_WEIGHTS, SHIPPED_CARD)?;
        Ok(Self::new(card, &parameters, device))
    }

    /// A network with `parameters`, as many as the layers of its card take.
    ///
    /// # Panics
    /// With more or fewer.
    #[must_use]
    pub fn new(card: MaterialsCard, parameters: &[f32], device: NetworkDevice) -> Self {
        let mut rest = parameters;
        let passes = card.materials.passes().iter().map(|pass| {
            let (own, behind) = rest.split_at(pass.parameter_count());
            rest = behind;
            (pass, CubeNetwork::new(pass, own, &device.device).expect("as many parameters as the layers have"))
        });
        Self { passes: passes.collect(), card, device }
    }

    /// What it is.
    #[must_use]
    pub fn card(&self) -> &MaterialsCard {
        &self.card
    }

    /// Bytes that [`Self::bone`] takes beside the volume, about.
    #[must_use]
    pub fn bytes(&self, volume: &HuVolume<'_>) -> u64 {
        let most = self.passes.iter().map(|(pass, _)| PassGrid::points_over(&volume.grid, pass.spacing_mm)).fold(0.0, f64::max);
        // A probability and a mark of each point, means of blocks and a mark of each voxel.
        (5.0 * most + 5.0 * volume.hu.len() as f64) as u64
    }

    /// Which voxels of `volume` are bone: those of at least [`DENSE_HU`] in a bone, and those
    /// above [`METAL_HU`] anywhere. `told` hears, of each pass, how many patches are done and how
    /// many there are.
    ///
    /// # Panics
    /// When a GPU is lost, or has no memory left.
    pub fn bone(&self, volume: &HuVolume<'_>, told: &mut dyn FnMut(&Pass, usize, usize)) -> Vec<bool> {
        let mut found: Option<Found> = None;
        for (pass, network) in &self.passes {
            let next = self.look(volume, (pass, network), found.as_ref(), told);
            found = Some(next);
        }
        let Some(found) = found else { return vec![false; volume.hu.len()] };
        let is_bone = |index: usize| {
            let hu = volume.hu[index];
            hu > METAL_HU || (hu >= DENSE_HU && found.at(volume, index) > 0.5)
        };
        (0..volume.hu.len()).into_par_iter().map(is_bone).collect()
    }

    fn look(
        &self,
        volume: &HuVolume<'_>,
        (pass, network): (&Pass, &CubeNetwork),
        before: Option<&Found>,
        told: &mut dyn FnMut(&Pass, usize, usize),
    ) -> Found {
        let reduced = Reduced::of(&volume.grid, pass.spacing_mm, |index| volume.hu[index].max(BEYOND_HU));
        let grid = PassGrid::covering(&volume.grid, pass.spacing_mm);
        let mut is_wanted = vec![false; grid.points()];
        for index in (0..volume.hu.len()).filter(|index| volume.hu[*index] >= DENSE_HU) {
            if before.is_none_or(|before| before.at(volume, index) > HARDLY) {
                grid.about(volume.grid.centre(index)).places().iter().for_each(|point| is_wanted[*point] = true);
            }
        }
        let mut bone = vec![0.0; grid.points()];
        let tiles = wanted_tiles(&grid, pass.keep, &is_wanted);
        let margin = (pass.patch - pass.keep) / 2;
        let seen_in = |tile: &[usize; 3]| {
            let from = tile.map(|at| (at * pass.keep) as i64 - margin as i64);
            let mut hu = Vec::with_capacity(pass.points());
            for_points(pass.patch, |step| {
                let point = grid.point(std::array::from_fn(|axis| from[axis] + step[axis] as i64));
                hu.push(reduced.interpolated(point, BEYOND_HU, |place| reduced.values[place]));
            });
            windows(&hu).collect::<Vec<f32>>()
        };
        let at_once = if self.device.is_processor() { rayon::current_num_threads() } else { PATCHES };
        for (done, some) in tiles.chunks(at_once).enumerate() {
            told(pass, done * at_once, tiles.len());
            let looked: Vec<Vec<f32>> = if self.device.is_processor() {
                some.par_iter().flat_map(|tile| self.probabilities(pass, network, &[seen_in(tile)])).collect()
            } else {
                self.probabilities(pass, network, &some.par_iter().map(seen_in).collect::<Vec<_>>())
            };
            for (tile, kept) in some.iter().zip(&looked) {
                for_points(pass.keep, |step| {
                    let at: [usize; 3] = std::array::from_fn(|axis| tile[axis] * pass.keep + step[axis]);
                    if (0..3).all(|axis| at[axis] < grid.size[axis]) {
                        let [x, y, z] = step.map(|n| n + margin);
                        bone[at[0] + grid.size[0] * (at[1] + grid.size[1] * at[2])] = kept[x + pass.patch * (y + pass.patch * z)];
                    }
                });
            }
        }
        told(pass, tiles.len(), tiles.len());
        Found { grid, bone }
    }

    /// Probability of bone at the points of patches, each as its two windows.
    fn probabilities(&self, pass: &Pass, network: &CubeNetwork, patches: &[Vec<f32>]) -> Vec<Vec<f32>> {
        let side = pass.patch;
        let seen = TensorData::new(patches.concat(), [patches.len(), INPUTS, side, side, side]);
        let all = network.probabilities(Tensor::from_data(seen, &self.device.device));
        let bone = fetched(all.narrow(1, BONE, 1)).unwrap_or_else(|detail| panic!("{}: {detail}", self.device.name));
        assert_eq!(self.device.fault(), None, "{}", self.device.name);
        bone.chunks_exact(pass.points()).map(<[f32]>::to_vec).collect()
    }
}

impl Found {
    fn at(&self, volume: &HuVolume<'_>, index: usize) -> f32 {
        self.grid.about(volume.grid.centre(index)).sum(0.0, |point| self.bone[point])
    }
}

/// `each` of the points (x, y, z) of a cube, x fastest.
fn for_points(side: usize, mut each: impl FnMut([usize; 3])) {
    for z in 0..side {
        for y in 0..side {
            (0..side).for_each(|x| each([x, y, z]));
        }
    }
}

/// Tiles of `keep`³ points with a wanted one among them.
fn wanted_tiles(grid: &PassGrid, keep: usize, is_wanted: &[bool]) -> Vec<[usize; 3]> {
    let count: [usize; 3] = grid.size.map(|size| size.div_ceil(keep));
    let mut seen = vec![false; count.iter().product()];
    for index in (0..is_wanted.len()).filter(|index| is_wanted[*index]) {
        let [x, y, z] = [index % grid.size[0], index / grid.size[0] % grid.size[1], index / (grid.size[0] * grid.size[1])];
        seen[x / keep + count[0] * (y / keep + count[1] * (z / keep))] = true;
    }
    let tile = |index: usize| [index % count[0], index / count[0] % count[1], index / (count[0] * count[1])];
    (0..seen.len()).filter(|index| seen[*index]).map(tile).collect()
}

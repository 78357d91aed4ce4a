//! Networks that tell bone from all that is as dense as bone in a CT: contrast medium, calcified vessels, noise.
//!
//! Data flows down this list: the passes and their layers, a pass as tensors, the card, the grids of the passes, the network that comes from files.

mod layers;
mod network;
mod card;
mod grid;
mod bone;

pub use bone::{BEYOND_HU, DENSE_HU, LoadedMaterials};
pub use card::MaterialsCard;
pub use grid::{HuVolume, PassGrid, Reduced};
pub use layers::{AIR, BONE, CLASSES, INPUTS, MaterialsArchitecture, Pass, SOFT};
pub use network::{CubeNetwork, windows};

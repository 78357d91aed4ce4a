//! The CPU executor: twins of the shaders, on all cores.

pub mod add_noise;
pub mod attenuate_spectrum;
pub mod bundles;
pub mod cells_of_slab;
pub mod claims;
pub mod cross_fixed;
pub mod cross_slabs;
pub mod crossing;
pub mod edges;
pub mod enlarge_density;
pub mod fixed_cells;
pub mod fixed_lanes;
pub mod fixed_windows;
pub mod integrate_block;
pub mod integrate_density;
pub mod intervals;
pub mod lanes;
#[cfg(target_arch = "x86_64")]
mod lanes_avx2;
pub mod resample_overlap;
pub mod shapes;
pub mod walk_cells;
pub mod window_places;
pub mod windows;

pub use super::mesh_tree as intersect_mesh;

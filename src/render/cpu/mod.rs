//! The CPU executor: twins of the shaders, on all cores.

pub mod add_noise;
pub mod attenuate_spectrum;
pub mod integrate_density;
pub mod intersect_mesh;
pub mod intervals;
pub mod resample_overlap;
pub mod shapes;
pub mod walk_cells;

//! Monte Carlo transport of photons: primary and scattered radiation on the detector, and the energy that stays in the scene.
//!
//! Data flows down this list: random numbers, tables of one material, what is where, beam and detector, one history, all of them.
//! Photoelectric absorption ends a photon where it happens; Compton scattering is Klein and Nishina's with the incoherent function of the
//! atoms, Rayleigh scattering Thomson's with their form factors. Left out: fluorescence, Doppler broadening, interference between atoms
//! (molecular form factors), and all matter behind the detector plane. The medium around the scene is vacuum.

mod stream;
mod alias;
mod attenuation;
mod compton;
mod rayleigh;
mod matter;
mod bounds;
mod contents;
mod planes;
mod cells;
mod flight;
mod error;
mod panel;
mod beam_shape;
mod source;
mod tally;
mod dose_grid;
mod history;
mod mass;
mod simulation;
mod columns;
mod image;
mod dose;
pub mod wgsl;
mod checkpoint;
mod scatter;
#[cfg(feature = "learn")]
mod predicted;
mod network;
#[cfg(test)]
mod fixture;
#[cfg(test)]
mod beside_metal;

pub use attenuation::{Attenuation, Shares};
pub use checkpoint::Checkpoint;
pub use columns::{CHANNELS, Columns, SCALARS};
pub use compton::{Compton, energy_ratio};
pub use dose::{DoseMap, dose_files};
pub use dose_grid::MOST_DOSE_VOXELS;
pub use error::TransportError;
pub use history::Estimator;
pub use image::{ScatterImage, written_with};
pub use network::{NetworkError, NetworkScatter};
#[cfg(feature = "learn")]
pub use predicted::{PredictError, predicted};
pub use rayleigh::Rayleigh;
pub use scatter::scatter;
pub use simulation::{BATCH, Histories, Simulation};
pub use stream::Stream;
pub use tally::{DETECTED, ESCAPED, Estimate, FATES, FEWEST, PAGE_NAMES, PAGES, Page, STARTED, Tally};
pub use wgsl::{GpuTransport, GpuTransportError};

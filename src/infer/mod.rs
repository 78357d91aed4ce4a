//! Networks that were trained elsewhere: loaded with their card, asked for the scattered radiation of one image, or for the bone of a CT.
//!
//! Nothing here trains. A network is two files, `NAME.safetensors` (weights) and `NAME.json` (the [`Card`]); the card says what the inputs
//! mean, how they are normalised and where they lay in training, and its checksum binds it to the weights.

mod card;
mod convolution;
mod device;
mod error;
mod files;
mod input;
mod layers;
pub mod materials;
mod network;
mod scatter;
mod tensors;

pub use card::{Card, JudgedBy, Quantity};
pub use convolution::Convolution;
pub use device::NetworkDevice;
pub(crate) use device::fetched;
pub use error::InferError;
pub use files::{NetworkCard, NetworkFiles, weights_file};
pub use input::{Input, Prediction};
pub use layers::{Architecture, Layer};
pub use network::{LOG_LIMIT, Network};
pub use scatter::{LoadedNetwork, ScatterNetwork};
pub use tensors::{TensorFault, bytes_from_tensors, floats_of, metadata_of, tensors_from_bytes};

/// Rows of an input channel.
pub const ROWS: usize = 48;
/// Columns of an input channel.
pub const COLUMNS: usize = 64;
/// Pixels of an input channel.
pub const PIXELS: usize = ROWS * COLUMNS;
/// Rows of the scatter that is predicted.
pub const CELL_ROWS: usize = 12;
/// Columns of the scatter that is predicted.
pub const CELL_COLUMNS: usize = 16;
/// Coarse cells of one page.
pub const CELLS: usize = CELL_ROWS * CELL_COLUMNS;
/// Pages: scattered once, scattered more than once.
pub const PAGES: usize = 2;

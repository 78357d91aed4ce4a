//! What networks are trained on, and how.
//!
//! Data flows down this list: a scene drawn around a specimen, a file of samples.

mod scatter_scene;
mod shard;

pub use scatter_scene::{Specimen, drawn};
pub use shard::{Shard, ShardError};

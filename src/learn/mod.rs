//! Scatter networks, trained on samples of the Monte Carlo.
//!
//! Data flows down this list: a scene drawn around a specimen, files of samples, a sample of a scene, the recipe, the set of samples, its mirror images and statistics, siblings,
//! the loss, the figures of what was held out, the step, the state between epochs, the training. `infer` runs what comes out and needs nothing of this.

mod scatter_scene;
mod shard;
mod scatter_sample;
mod error;
mod recipe;
mod dataset;
mod mirror;
mod statistics;
mod siblings;
mod loss;
mod figures;
mod adam;
mod options;
mod checkpoint;
mod train;

pub use checkpoint::recipe_of_checkpoint;
pub use dataset::{Dataset, Sample};
pub use error::LearnError;
pub use figures::{Figures, figures_of};
pub use mirror::Mirror;
pub use options::{EpochRecord, Progress, TrainFiles, TrainOptions, Trained, TrainingEnd};
pub use recipe::{HoldOut, Recipe};
pub use scatter_sample::{GRID_PX, LEAST_BATCHES, PHANTOM, SampleError, Sampled, Sampling, TRUTH_PX, sample};
pub use scatter_scene::{Specimen, drawn};
pub use shard::{Shard, ShardError};
pub use train::train;

//! Scatter networks, trained on samples of the Monte Carlo, and materials networks, trained on labelled CTs and phantoms.
//!
//! Data flows down this list: what is drawn with, a scene drawn around a specimen, files of samples, a sample of a scene, files of labelled specimens, the
//! recipe, the set of samples, its mirror images and statistics, siblings, the loss, the figures of what was held out, the step, the state
//! between epochs, the epochs, the training; `materials` has what is its own. `infer` runs what comes out and needs nothing of this.

mod draw;
mod scatter_scene;
mod shard;
mod scatter_sample;
mod specimen;
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
mod epochs;
mod train;
pub mod materials;

pub use checkpoint::{AnyRecipe, recipe_of_checkpoint};
pub use dataset::{Dataset, Sample};
pub use error::LearnError;
pub use figures::{Figures, figures_of};
pub use mirror::Mirror;
pub use options::{EpochRecord, Progress, TrainFiles, TrainOptions, Trained, TrainingEnd};
pub use recipe::{HoldOut, Recipe, StepRule};
pub use scatter_sample::{GRID_PX, LEAST_BATCHES, PHANTOM, SampleError, Sampled, Sampling, TRUTH_PX, sample};
pub use scatter_scene::{Specimen, drawn};
pub use shard::{Shard, ShardError};
pub use specimen::{LabelledSpecimen, METAL, SpecimenError};
pub use train::train;

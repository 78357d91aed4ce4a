//! Materials networks, trained on labelled CTs and on phantoms whose truth is exact.
//!
//! Data flows down this list: distances, solids as voxels, phantoms, patches, the recipe, the loss, figures, the training.

mod distance;
mod solid;
mod phantom;
mod patch;
mod recipe;
mod loss;
mod figures;
mod train;
#[cfg(test)]
mod tests;

pub use figures::MaterialsFigures;
pub use phantom::{PhantomMesh, phantom};
pub use recipe::MaterialsRecipe;
pub use train::{TrainedMaterials, train_materials};

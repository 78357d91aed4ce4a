//! What is in the beam: scene files, volumes, shapes, the robot, materials, the beam and the detector.

pub mod physics;

pub mod model;

mod error;
mod file;
mod load;
mod matter;
mod nifti;
mod objects;
mod robot;

pub use error::SceneError;
pub use file::SceneFile;
pub use load::{load, load_text};
pub use matter::DensityCurve;
pub use model::{InputFile, Scene};
pub use nifti::{Grid, read as read_nifti};
pub use objects::DEFAULT_BODY;

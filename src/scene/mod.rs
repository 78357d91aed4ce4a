//! What is in the beam: scene files, volumes, shapes, the robot, materials, the beam and the detector.

mod beam;
mod crossings;
mod density;
mod edit;
mod error;
pub mod file;
mod files;
mod foreign_files;
mod load;
mod matter;
mod mesh;
pub mod object_file;
mod objects;
mod optics_file;
mod view;
mod volume_file;

pub mod model;
pub mod optics;
pub mod physics;

pub use density::{DensityCurve, ThresholdClass};
pub use error::SceneError;
pub use foreign_files::{Triangle, VolumeFacts, VolumeFile, read_triangles, read_volume, read_volume_facts, serve};
pub use load::{input_files, load, load_text, load_text_with};
pub use model::{InputFile, Scene};
pub use volume_file::PlacedBy;

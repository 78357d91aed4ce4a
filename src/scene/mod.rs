//! What is in the beam: scene files, volumes, shapes, the robot, materials, the beam and the detector.

mod ambient;
mod beam;
mod bodies;
mod builder;
mod crossings;
mod ct;
mod density;
mod edit;
mod error;
pub mod file;
mod files;
mod fill;
mod foreign_files;
mod hounsfield;
mod inpaint;
mod label_names;
mod load;
mod matter;
mod mesh;
pub mod object_file;
#[cfg(feature = "learn")]
mod network_bone;
mod objects;
mod optics_file;
mod plain;
mod thin;
mod view;
mod volumes;

pub mod model;
pub mod optics;
pub mod physics;

pub use ct::LabelledCt;
pub use density::{DensityCurve, ThresholdClass};
pub use error::SceneError;
pub use files::{FILE_KEYS, built_in};
pub use fill::fill_harmonic;
pub use foreign_files::{Triangle, read_triangles, serve};
pub use inpaint::{Ball, Inpainted, inpaint_labels, inpaint_metal};
pub use label_names::{hidden_label, is_hidden_label};
pub use load::{input_files, load, load_labelled, load_text, load_text_with};
pub use mesh::{mesh_unit_doubt, read_closed_triangles};
pub use model::{InputFile, Robot, Scene};
pub use volumes::{
    PlacedBy, VolumeContent, VolumeFacts, VolumeFile, VolumeFormat, VolumeSource, is_ct_slice, is_volume, read_volume,
    read_volume_facts, write_nifti,
};

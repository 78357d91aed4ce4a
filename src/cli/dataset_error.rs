//! What can be wrong when samples are made.

use std::path::PathBuf;

use crate::image::ImageFileError;
use crate::learn::{SampleError, ShardError, SpecimenError};
use crate::scene::SceneError;

/// Why there are no samples.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A sample.
    #[error(transparent)]
    Sample(#[from] SampleError),
    /// A file of samples.
    #[error(transparent)]
    Shard(#[from] ShardError),
    /// A scene's file.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// A labelled specimen.
    #[error(transparent)]
    Specimen(#[from] SpecimenError),
    /// The folder.
    #[error("{}: {source}", path.display())]
    Io {
        /// It.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nothing to draw.
    #[error("{0}")]
    Arguments(String),
}

//! What can be wrong with a training.

use std::path::PathBuf;

use super::{ShardError, SpecimenError};
use crate::image::ImageFileError;
use crate::infer::{InferError, TensorFault};
use crate::scene::SceneError;

/// Why a training cannot begin, go on or be kept.
#[derive(Debug, thiserror::Error)]
pub enum LearnError {
    /// Reading or writing.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The device fails: it is lost, or has no memory left.
    #[error("{name}: {detail}; whole epochs are kept: --resume --device gpu goes on with them, --resume alone on the processor")]
    Device {
        /// Its name.
        name: String,
        /// What it said.
        detail: String,
    },
    /// A file of samples cannot be used.
    #[error(transparent)]
    Shard(#[from] ShardError),
    /// The folder has no files of samples.
    #[error("folder of samples {}: has no *.safetensors files with samples in them; make some with `sidecarm dataset scatter`", path.display())]
    NoSamples {
        /// The folder.
        path: PathBuf,
    },
    /// A specimen cannot be used.
    #[error(transparent)]
    Specimen(#[from] SpecimenError),
    /// The folder has no specimens.
    #[error("folder of specimens {}: has no materials-*.safetensors files; make some with `sidecarm dataset materials`", path.display())]
    NoSpecimens {
        /// The folder.
        path: PathBuf,
    },
    /// A surface of a bone.
    #[error(transparent)]
    Mesh(Box<SceneError>),
    /// Two specimens that are one, or are called so: one of them would be trained on where the other is held out.
    #[error("specimen {}: {name} has its name or its voxels; keep one of them in the folder", path.display())]
    SameSpecimen {
        /// The file.
        path: PathBuf,
        /// The other one.
        name: String,
    },
    /// Two files of one folder hold different things.
    #[error("file of samples {}: {what} are {found}, in the files before it {expected}; keep one kind of samples in a folder", path.display())]
    Mixed {
        /// The file.
        path: PathBuf,
        /// Which list or size.
        what: &'static str,
        /// Of the files before.
        expected: String,
        /// Of this file.
        found: String,
    },
    /// A sample that nothing can be learnt from.
    #[error("file of samples {}: sample {index} (seed {seed}): {what} is {found}, expected {expected}", path.display())]
    Sample {
        /// The file.
        path: PathBuf,
        /// Its place in the file.
        index: usize,
        /// Its seed.
        seed: u64,
        /// Which value.
        what: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: f64,
    },
    /// A network that says nothing about the one that is trained.
    #[error("sibling {}: {because}; a sibling is trained on the same samples, alike, with --hold-out of one specimen", path.display())]
    NoSibling {
        /// Its card.
        path: PathBuf,
        /// Why.
        because: &'static str,
    },
    /// A sibling cannot be read.
    #[error(transparent)]
    Sibling(#[from] InferError),
    /// A specimen to hold out that no sample shows.
    #[error("specimen `{name}` cannot be held out: the samples show [{}]", known.join(", "))]
    UnknownSpecimen {
        /// Its name.
        name: String,
        /// Those of the samples, sorted.
        known: Vec<String>,
    },
    /// The split leaves nothing to train on, or nothing to judge by.
    #[error("{train} samples to train on and {held_out} held out: both need at least one; make more samples or hold out others")]
    Split {
        /// Samples to train on.
        train: usize,
        /// Samples held out.
        held_out: usize,
    },
    /// A setting that makes no sense.
    #[error("{setting} is {found}, expected {expected}")]
    Setting {
        /// Which.
        setting: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// The network would lie among the samples, and be taken for one of their files.
    #[error("network {}: would lie in the folder of samples; name another folder", path.display())]
    AmongSamples {
        /// The weights file.
        path: PathBuf,
    },
    /// The loss or its gradient is no longer finite.
    #[error("training diverged in epoch {epoch}: the gradient's norm is {norm}; lower the learning rate (now {learning_rate})")]
    Diverged {
        /// Counted from 1.
        epoch: usize,
        /// Of all parameters together.
        norm: f64,
        /// Of that step.
        learning_rate: f64,
    },
    /// A checkpoint cannot be read.
    #[error("checkpoint {}: {fault}; delete it to train from the beginning", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        fault: TensorFault,
    },
    /// A checkpoint of another training.
    #[error("checkpoint {}: its {what} is {found}, this training's {expected}; resume with that, or delete it to begin anew", path.display())]
    OtherTraining {
        /// The file.
        path: PathBuf,
        /// What differs.
        what: String,
        /// Of this training.
        expected: String,
        /// Of the checkpoint.
        found: String,
    },
    /// The caller stopped the training before there was anything to keep.
    #[error("stopped before the first epoch was done: nothing is written")]
    StoppedTooSoon,
    /// The trained network cannot be encoded.
    #[error("trained network: {0}")]
    Encode(TensorFault),
    /// A file cannot be written.
    #[error(transparent)]
    File(#[from] ImageFileError),
}

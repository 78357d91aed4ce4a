//! What a training is told and what it tells.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Figures, Recipe};
use crate::infer::{Card, NetworkDevice, NetworkFiles};

/// A training.
#[derive(Clone, Debug)]
pub struct TrainOptions<R = Recipe> {
    /// Folder of `*.safetensors` files of samples.
    pub dataset: PathBuf,
    /// Name of the network, a path without ending: `.safetensors`, `.json`, `.csv` and `.checkpoint` are added.
    pub output: PathBuf,
    /// Go on from the checkpoint, where there is one.
    pub resume: bool,
    /// Cards of networks that were trained alike without one specimen each, whose figures this one shall have: names or paths, as in
    /// [`NetworkFiles::of`]. Then nothing is held out.
    pub siblings: Vec<PathBuf>,
    /// All that decides the result, together with the samples and, in the last bits, the device.
    pub recipe: R,
    /// Where it is computed.
    pub device: NetworkDevice,
}

impl<R> TrainOptions<R> {
    /// A training from its beginning, on the processor, without siblings.
    #[must_use]
    pub fn new(dataset: PathBuf, output: PathBuf, recipe: R) -> Self {
        Self { dataset, output, resume: false, siblings: Vec::new(), recipe, device: NetworkDevice::default() }
    }
}

/// The files of a training.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrainFiles {
    /// Weights and card.
    pub network: NetworkFiles,
    /// One row an epoch.
    pub history: PathBuf,
    /// The state after the last whole epoch.
    pub checkpoint: PathBuf,
}

impl TrainFiles {
    /// The files of the network `name`, as in [`NetworkFiles::of`].
    #[must_use]
    pub fn of(name: &Path) -> Self {
        let network = NetworkFiles::of(name);
        // The folder of samples may be the folder of the network: a checkpoint must not end as samples do.
        let (history, checkpoint) = (network.weights.with_extension("csv"), network.weights.with_extension("checkpoint"));
        Self { network, history, checkpoint }
    }
}

/// One row of the history.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpochRecord {
    /// Counted from 1.
    pub epoch: usize,
    /// Mean loss of the epoch's samples, each with the weights of its own step.
    pub train_loss: f64,
    /// How wrong it is on what was set aside to choose, else on what was held out, empty where nothing was: of scatter the normalised mean squared
    /// error less the noise of the truth, of materials the loss.
    pub held_out: Option<f64>,
    /// The same with the noise of the truth.
    pub held_out_raw: Option<f64>,
    /// Of the epoch's last step.
    pub learning_rate: f64,
}

/// Where a training stands, after every step.
#[derive(Clone, Debug)]
pub struct Progress<'a> {
    /// Counted from 1.
    pub epoch: usize,
    /// At most.
    pub epochs: usize,
    /// Steps done in this epoch.
    pub step: usize,
    /// Steps of an epoch.
    pub steps: usize,
    /// Mean loss of the epoch's samples so far.
    pub train_loss: f64,
    /// The whole epoch, once it is done, evaluated and kept.
    pub done: Option<&'a EpochRecord>,
    /// Whether that epoch is the best so far.
    pub best: bool,
}

/// Why a training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrainingEnd {
    /// All epochs are done.
    Complete,
    /// The figure that chooses no longer fell.
    NoBetter,
    /// The caller said so.
    ByCaller,
}

/// A trained network, as it was written.
#[derive(Clone, Debug)]
pub struct Trained<C = Card, F = Option<Figures>> {
    /// Its card.
    pub card: C,
    /// Its files.
    pub files: TrainFiles,
    /// The epoch whose weights these are, counted from 1.
    pub epoch: usize,
    /// Figures on what was held out; of scatter `None` where nothing was.
    pub held_out: F,
    /// One record an epoch.
    pub history: Vec<EpochRecord>,
    /// Why it ended.
    pub end: TrainingEnd,
}

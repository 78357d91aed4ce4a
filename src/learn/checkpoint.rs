//! The state of a training between two epochs, as one file.
//!
//! Random numbers have no state of their own: they are keyed by the seed and the epoch.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::adam::Adam;
use super::{EpochRecord, LearnError, TrainFiles, TrainOptions};
use crate::image::write_atomically;
use crate::infer::{TensorFault, bytes_from_tensors, floats_of, metadata_of, tensors_from_bytes};
use crate::regular;

/// The key of the metadata that holds [`Beside`].
const KEY: &str = "state";

/// All that decides what a training comes to, together with its samples.
pub trait AnyRecipe: Clone + std::fmt::Debug + PartialEq + Serialize + DeserializeOwned {}

impl<R: Clone + std::fmt::Debug + PartialEq + Serialize + DeserializeOwned> AnyRecipe for R {}

/// All that the next epoch needs.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct State {
    pub adam: Adam,
    pub history: Vec<EpochRecord>,
    /// The parameters to keep, and their epoch, counted from 1.
    pub best: Option<(usize, Vec<f32>)>,
    /// Names of the devices that it was trained on, in their order.
    pub devices: Vec<String>,
}

/// What of a checkpoint is no tensor.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Beside<R> {
    recipe: R,
    siblings: Vec<PathBuf>,
    samples_sha256: String,
    steps: u64,
    best_epoch: Option<usize>,
    history: Vec<EpochRecord>,
    #[serde(default)]
    devices: Vec<String>,
}

impl State {
    /// Before the first epoch.
    pub(super) fn new(adam: Adam) -> Self {
        Self { adam, history: Vec::new(), best: None, devices: Vec::new() }
    }

    /// Writes it, whole or not at all.
    pub(super) fn write<R: AnyRecipe>(
        &self,
        path: &Path,
        options: &TrainOptions<R>,
        samples_sha256: &str,
    ) -> Result<(), LearnError> {
        let beside = Beside {
            recipe: options.recipe.clone(),
            siblings: options.siblings.clone(),
            samples_sha256: samples_sha256.to_owned(),
            steps: self.adam.steps,
            best_epoch: self.best.as_ref().map(|(epoch, _)| *epoch),
            history: self.history.clone(),
            devices: self.devices.clone(),
        };
        let metadata = |error: serde_json::Error| TensorFault::MetadataForm { key: KEY.to_owned(), detail: error.to_string() };
        let text = serde_json::to_string(&beside).map_err(|error| LearnError::Encode(metadata(error)))?;
        let shape = vec![self.adam.parameters.len()];
        let mut list = vec![
            ("parameters", shape.clone(), self.adam.parameters.as_slice()),
            ("means", shape.clone(), &self.adam.means),
            ("squares", shape.clone(), &self.adam.squares),
        ];
        if let Some((_, parameters)) = &self.best {
            list.push(("best", shape, parameters));
        }
        let metadata = HashMap::from([(KEY.to_owned(), text)]);
        let bytes = bytes_from_tensors(&list, Some(metadata)).map_err(LearnError::Encode)?;
        Ok(write_atomically(path, |file| file.write_all(&bytes))?)
    }

    /// The state that this training left in `path`.
    pub(super) fn read<R: AnyRecipe>(
        path: &Path,
        recipe: &R,
        samples_sha256: &str,
        parameters: usize,
    ) -> Result<Self, LearnError> {
        let bytes = regular::read(path).map_err(|source| LearnError::Io { path: path.to_owned(), source })?;
        let fault = |fault| LearnError::Checkpoint { path: path.to_owned(), fault };
        let beside = beside_of::<R>(&bytes).map_err(fault)?;
        let sha = ("sha256 of the samples".to_owned(), samples_sha256.to_owned(), beside.samples_sha256.clone());
        let other_samples = (beside.samples_sha256 != samples_sha256).then_some(sha);
        if let Some((what, expected, found)) = difference(recipe, &beside.recipe).or(other_samples) {
            return Err(LearnError::OtherTraining { path: path.to_owned(), what, expected, found });
        }
        let tensors = tensors_from_bytes(&bytes).map_err(fault)?;
        let values = |name: &str| floats_of(&tensors, name, &[parameters]).map_err(fault);
        if let Some(epoch) = beside.best_epoch.filter(|epoch| !(1..=beside.history.len()).contains(epoch)) {
            let detail = format!("best epoch {epoch} of {}", beside.history.len());
            return Err(fault(TensorFault::MetadataForm { key: KEY.to_owned(), detail }));
        }
        let best = match beside.best_epoch {
            Some(epoch) => Some((epoch, values("best")?)),
            None => None,
        };
        let adam =
            Adam { parameters: values("parameters")?, means: values("means")?, squares: values("squares")?, steps: beside.steps };
        Ok(Self { adam, history: beside.history, best, devices: beside.devices })
    }
}

/// The first setting in which `found` differs from `expected`, and both values.
fn difference<R: AnyRecipe>(expected: &R, found: &R) -> Option<(String, String, String)> {
    if expected == found {
        return None;
    }
    let fields = |recipe: &R| match serde_json::to_value(recipe) {
        Ok(serde_json::Value::Object(fields)) => fields,
        _ => serde_json::Map::new(),
    };
    let (of_expected, of_found) = (fields(expected), fields(found));
    let differing = of_expected.iter().find(|(key, value)| of_found.get(*key) != Some(value));
    Some(match differing {
        Some((key, value)) => (key.clone(), value.to_string(), of_found.get(key).map_or(String::new(), ToString::to_string)),
        None => ("recipe".to_owned(), format!("{expected:?}"), format!("{found:?}")),
    })
}

fn beside_of<R: AnyRecipe>(bytes: &[u8]) -> Result<Beside<R>, TensorFault> {
    let lists = metadata_of(bytes)?;
    let text = lists.get(KEY).ok_or_else(|| TensorFault::MetadataMissing { key: KEY.to_owned() })?;
    serde_json::from_str(text).map_err(|error| TensorFault::MetadataForm { key: KEY.to_owned(), detail: error.to_string() })
}

/// The recipe and the siblings of the training that left a checkpoint beside the network `output`; `None` where there is no checkpoint.
///
/// # Errors
/// When the checkpoint is unreadable.
pub fn recipe_of_checkpoint<R: AnyRecipe>(output: &Path) -> Result<Option<(R, Vec<PathBuf>)>, LearnError> {
    let path = TrainFiles::of(output).checkpoint;
    match regular::read(&path) {
        Ok(bytes) => {
            let beside = beside_of(&bytes).map_err(|fault| LearnError::Checkpoint { path, fault })?;
            Ok(Some((beside.recipe, beside.siblings)))
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(LearnError::Io { path, source }),
    }
}

//! The card of a materials network: what it is, what it was trained on, how good it is on what it was not.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::layers::MaterialsArchitecture;
use crate::infer::{InferError, JudgedBy, Layer, NetworkCard};

/// What is known of a materials network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaterialsCard {
    /// Its passes.
    pub materials: MaterialsArchitecture,
    /// SHA-256 of the weights file, in hexadecimal.
    pub weights_sha256: String,
    /// Seed of the training.
    pub training_seed: u64,
    /// Epochs that the training was planned for: its learning rate ends there.
    pub training_epochs: usize,
    /// The epoch whose weights these are, counted from 1.
    pub kept_epoch: usize,
    /// Steps of an epoch.
    pub training_steps: usize,
    /// Patches of each pass in a step.
    pub training_batch: usize,
    /// The devices that it was trained on, in their order; none where nobody noted it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub training_devices: Vec<String>,
    /// Phantoms that chose the epoch, where what is held out does not.
    #[serde(default, skip_serializing_if = "crate::infer::card::is_zero")]
    pub set_aside: usize,
    /// Specimens trained on, sorted; of phantoms their number.
    pub specimens: Vec<String>,
    /// Who said what bone is in them.
    pub truth: String,
    /// SHA-256 of all specimens, held out or not, in hexadecimal.
    pub samples_sha256: String,
    /// Least and greatest distance of voxels in training, along any axis. Finer ones are averaged first.
    pub spacing_bounds_mm: [f64; 2],
    /// What the figures of `held_out` were found on.
    pub judged_by: JudgedBy,
    /// Figures on what was held out, by name.
    pub held_out: BTreeMap<String, f64>,
}

impl MaterialsCard {
    /// What to say of a CT whose voxels lie farther apart than any that it was trained on; `None` where they do not.
    #[must_use]
    pub fn outside(&self, spacing_mm: [f64; 3]) -> Option<String> {
        let [low, high] = self.spacing_bounds_mm;
        let inside = spacing_mm.iter().all(|mm| *mm > 0.0 && *mm <= high * 1.01);
        (!inside).then(|| format!("voxels of {spacing_mm:.2?} mm, in training {low:.2} to {high:.2} mm"))
    }
}

impl NetworkCard for MaterialsCard {
    fn weights_sha256(&self) -> &str {
        &self.weights_sha256
    }

    fn layers(&self) -> Vec<Layer> {
        self.materials.layers()
    }

    fn check(&self, path: &Path) -> Result<(), InferError> {
        let [low, high] = self.spacing_bounds_mm;
        if low > 0.0 && low <= high && high.is_finite() {
            return Ok(());
        }
        Err(InferError::CardValue {
            path: path.to_owned(),
            field: "spacing_bounds_mm".to_owned(),
            expected: "above 0, low, then high",
            found: format!("{:?}", self.spacing_bounds_mm),
        })
    }
}

//! All that decides what the training of a materials network comes to, together with its specimens.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::infer::materials::MaterialsArchitecture;
use crate::learn::recipe::{counted, of_choice, refuse_wrong};
use crate::learn::{HoldOut, LearnError, StepRule};

/// All that decides the result of a training, together with the specimens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaterialsRecipe {
    /// The passes.
    pub materials: MaterialsArchitecture,
    /// Of the first weights, the patches and the phantoms held out.
    pub seed: u64,
    /// Epochs; the learning rate has its end at the last.
    pub epochs: usize,
    /// Steps of an epoch.
    pub steps: usize,
    /// Patches of each pass in a step.
    pub batch: usize,
    /// How a step follows from its gradient.
    pub rule: StepRule,
    /// Share of the patches that are of phantoms, where there are CTs too.
    pub phantoms: f64,
    /// What is not trained on; a share of the seeds is one of the phantoms.
    pub hold_out: HoldOut,
    /// Share of the phantoms, rounded up, that is not trained on after all but chooses the epoch, in place of what is held out; 0 for none.
    #[serde(default)]
    pub set_aside: f64,
    /// Stop after so many epochs without a better loss, where one chooses.
    pub patience: Option<usize>,
    /// Phantoms, of simple shapes, that the network is judged by at the end; their seeds are far from those that anybody trains on.
    #[serde(default = "fresh_phantoms")]
    pub fresh_phantoms: u64,
    /// STL files of bones, mm: the network is judged by as many phantoms again, most of which have bones of these.
    #[serde(default)]
    pub meshes: Vec<PathBuf>,
    /// SHA-256 of these files, in their order: they are known by their content. A training fills it in.
    #[serde(default)]
    pub meshes_sha256: Vec<String>,
}

/// Enough for figures that hardly change with more.
fn fresh_phantoms() -> u64 {
    6
}

impl Default for MaterialsRecipe {
    fn default() -> Self {
        Self {
            materials: MaterialsArchitecture::Default,
            seed: 1,
            epochs: 30,
            steps: 40,
            batch: 2,
            rule: StepRule::default(),
            phantoms: 0.35,
            hold_out: HoldOut::Seeds { share: 0.1 },
            set_aside: 0.0,
            patience: Some(10),
            fresh_phantoms: fresh_phantoms(),
            meshes: Vec::new(),
            meshes_sha256: Vec::new(),
        }
    }
}

impl MaterialsRecipe {
    pub(super) fn check(&self) -> Result<(), LearnError> {
        refuse_wrong(&[
            counted("epochs", self.epochs),
            counted("steps", self.steps),
            counted("batch", self.batch),
            ("share of phantoms", "0 to 1", self.phantoms, self.phantoms >= 0.0 && self.phantoms <= 1.0),
        ])?;
        refuse_wrong(&of_choice(self.patience, self.set_aside))?;
        self.rule.check()?;
        self.hold_out.check()
    }
}

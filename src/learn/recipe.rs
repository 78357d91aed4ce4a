//! All that decides what a training comes to, together with its samples.

use serde::{Deserialize, Serialize};

use super::LearnError;
use crate::infer::Architecture;

/// All that decides the result of a training, together with the samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// The layers.
    pub architecture: Architecture,
    /// Of the first weights, the order, the mirroring and the seeds held out.
    pub seed: u64,
    /// Passes over the samples; the learning rate has its end at the last.
    pub epochs: usize,
    /// Samples of one step.
    pub batch: usize,
    /// How a step follows from its gradient.
    pub rule: StepRule,
    /// Weight of each page by itself in the loss, beside 1 for their sum.
    pub page_weight: f64,
    /// Mirror samples at random, in columns and in rows.
    pub mirror: bool,
    /// What is not trained on.
    pub hold_out: HoldOut,
    /// Share of the seeds of what is trained on that is not trained on after all but chooses the epoch, in place of what is held out; 0 for none.
    #[serde(default)]
    pub set_aside: f64,
    /// Stop after so many epochs without a better figure, where one chooses ([`Recipe::chooses`]).
    pub patience: Option<usize>,
}

/// How a step follows from its gradient.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StepRule {
    /// Highest learning rate, after warm-up.
    pub learning_rate: f64,
    /// Share of the steps in which the learning rate rises.
    pub warm_up: f64,
    /// Decay of the weights per step, as a share of the learning rate (Loshchilov & Hutter 2019).
    pub weight_decay: f64,
    /// Largest norm of a step's gradient over all parameters.
    pub largest_gradient: f64,
}

impl Default for StepRule {
    fn default() -> Self {
        Self { learning_rate: 2e-3, warm_up: 0.05, weight_decay: 1e-2, largest_gradient: 1.0 }
    }
}

/// What is not trained on but judged by, every epoch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum HoldOut {
    /// Every sample of these specimens.
    Specimens {
        /// Their names.
        names: Vec<String>,
    },
    /// A random share of the seeds.
    Seeds {
        /// Above 0, below 1.
        share: f64,
    },
    /// Nothing: the last epoch is kept.
    Nothing,
}

impl HoldOut {
    /// Whether what is held out chooses the epoch that is kept, and says when to stop. A specimen does not: it would no longer be one that
    /// the network knows nothing of. Unless something else is set aside to choose, the last epoch is kept.
    #[must_use]
    pub fn chooses(&self) -> bool {
        matches!(self, Self::Seeds { .. })
    }

    pub(super) fn check(&self) -> Result<(), LearnError> {
        match self {
            Self::Seeds { share } => {
                refuse_wrong(&[("share of seeds held out", "above 0, below 1", *share, *share > 0.0 && *share < 1.0)])
            }
            Self::Specimens { .. } | Self::Nothing => Ok(()),
        }
    }
}

impl Default for Recipe {
    fn default() -> Self {
        Self::of(Architecture::Default)
    }
}

impl Recipe {
    /// Settings with which `architecture` trains well.
    #[must_use]
    pub fn of(architecture: Architecture) -> Self {
        Self {
            architecture,
            seed: 1,
            epochs: 60,
            batch: 16,
            rule: match architecture {
                Architecture::Default => StepRule::default(),
                // The 961 weights of a kernel of 31×31 see much the same, and their steps add up.
                Architecture::Paper => StepRule { learning_rate: 2e-4, ..StepRule::default() },
            },
            page_weight: 0.25,
            mirror: true,
            hold_out: HoldOut::Seeds { share: 0.1 },
            set_aside: 0.0,
            patience: Some(20),
        }
    }

    /// Whether anything chooses the epoch that is kept, and says when to stop.
    #[must_use]
    pub fn chooses(&self) -> bool {
        self.hold_out.chooses() || self.set_aside > 0.0
    }

    pub(super) fn check(&self) -> Result<(), LearnError> {
        let of_weight = ("page weight", "0 or more", self.page_weight, self.page_weight >= 0.0 && self.page_weight.is_finite());
        refuse_wrong(&[counted("epochs", self.epochs), counted("batch", self.batch), of_weight])?;
        refuse_wrong(&of_choice(self.patience, self.set_aside))?;
        self.rule.check()?;
        self.hold_out.check()
    }
}

/// A setting: its name, what it must be, what it is, and whether that will do.
pub(super) type Setting = (&'static str, &'static str, f64, bool);

/// A setting that counts something.
pub(super) fn counted(name: &'static str, count: usize) -> Setting {
    (name, "at least 1", count as f64, count >= 1)
}

/// What says when to stop: `patience`, and the share that is set aside for it.
pub(super) fn of_choice(patience: Option<usize>, set_aside: f64) -> [Setting; 2] {
    [
        counted("patience", patience.unwrap_or(1)),
        ("share set aside", "0 or more, below 1", set_aside, (0.0..1.0).contains(&set_aside)),
    ]
}

/// The first setting that makes no sense, as an error.
pub(super) fn refuse_wrong(settings: &[Setting]) -> Result<(), LearnError> {
    match settings.iter().find(|(.., good)| !good) {
        Some((setting, expected, found, _)) => Err(LearnError::Setting { setting, expected, found: found.to_string() }),
        None => Ok(()),
    }
}

impl StepRule {
    pub(super) fn check(&self) -> Result<(), LearnError> {
        refuse_wrong(&[
            ("learning rate", "above 0, at most 1", self.learning_rate, self.learning_rate > 0.0 && self.learning_rate <= 1.0),
            ("warm-up", "0 to 1", self.warm_up, self.warm_up >= 0.0 && self.warm_up <= 1.0),
            ("weight decay", "0 to 1", self.weight_decay, self.weight_decay >= 0.0 && self.weight_decay <= 1.0),
            ("largest gradient", "above 0", self.largest_gradient, self.largest_gradient > 0.0),
        ])
    }
}

//! The card of a network: what it is, what its inputs mean, and where they lay when it was trained.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{Architecture, COLUMNS, InferError, Input, Layer, NetworkCard, PIXELS, ROWS};

/// One channel or scalar: its name, its normalisation, its range in training. All values in the unit that the name ends with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quantity {
    /// Name, with its unit.
    pub name: String,
    /// Mean over the pixels of all training samples.
    pub mean: f64,
    /// Standard deviation about it; 1 where the quantity never changed.
    pub deviation: f64,
    /// Lowest and highest mean of one sample.
    pub mean_bounds: [f64; 2],
    /// Lowest and highest maximum of one sample; of a scalar the same as `mean_bounds`.
    pub maximum_bounds: [f64; 2],
}

/// What is known of a network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Card {
    /// Its layers.
    pub architecture: Architecture,
    /// Its input channels, in order.
    pub channels: Vec<Quantity>,
    /// Its scalar inputs, in order.
    pub scalars: Vec<Quantity>,
    /// Lowest and highest rough guess of the mean scatter in training.
    pub scale_bounds: [f64; 2],
    /// SHA-256 of the weights file, in hexadecimal.
    pub weights_sha256: String,
    /// Seed of the training.
    pub training_seed: u64,
    /// Passes over the samples that it was trained for.
    pub training_epochs: usize,
    /// The epoch whose weights these are, counted from 1; none where nobody noted it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kept_epoch: Option<usize>,
    /// The devices that it was trained on, in their order; none where nobody noted it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub training_devices: Vec<String>,
    /// Samples trained on, without those held out or set aside.
    pub sample_count: usize,
    /// Samples of other views of the specimens trained on that chose the epoch, where what is held out does not.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub set_aside: usize,
    /// Photons that were followed for each sample; none where nobody noted it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub histories_per_sample: Option<u64>,
    /// Seeds that all samples were drawn with, as ranges: the first, and the one after the last; none where nobody noted them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sample_seeds: Vec<[u64; 2]>,
    /// Specimens trained on, sorted.
    pub specimens: Vec<String>,
    /// SHA-256 of all samples, held out or not, in hexadecimal.
    pub samples_sha256: String,
    /// What the figures of `held_out` were found on.
    pub judged_by: JudgedBy,
    /// Figures on what was held out, by name.
    pub held_out: BTreeMap<String, f64>,
}

/// What a card that counts none of something leaves out.
pub(super) fn is_zero(count: &usize) -> bool {
    *count == 0
}

/// What a network's figures were found on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", deny_unknown_fields)]
pub enum JudgedBy {
    /// There are none.
    Nothing,
    /// Other views of the specimens that it was trained on: of a specimen that is none of them they say less.
    Seeds,
    /// Specimens that it was not trained on.
    Specimens {
        /// Their names, sorted.
        names: Vec<String>,
    },
    /// It was trained on all samples. The figures are those of networks that were trained alike on the same samples but for one specimen,
    /// each on that specimen.
    Siblings {
        /// SHA-256 of a sibling's weights, by the specimen that it was not trained on.
        weights_sha256: BTreeMap<String, String>,
    },
}

impl Quantity {
    /// The normalised value of `value`.
    #[must_use]
    pub fn normalised(&self, value: f32) -> f32 {
        ((f64::from(value) - self.mean) / self.deviation) as f32
    }

    /// What to say of the `what` of a sample, such as its mean, where it lies outside `bounds`. NaN lies outside.
    fn outside(&self, what: &str, value: f64, [low, high]: [f64; 2]) -> Option<String> {
        // Room for the rounding of f32 inputs, which a quantity that never changed in training would not have otherwise.
        let room = 1e-6 * (self.deviation + low.abs().max(high.abs()));
        let inside = value >= low - room && value <= high + room;
        (!inside).then(|| format!("{what} is {value:.6}, in training {low:.6} to {high:.6}"))
    }
}

impl Card {
    /// Names of the channels, in order.
    #[must_use]
    pub fn channel_names(&self) -> Vec<String> {
        self.channels.iter().map(|quantity| quantity.name.clone()).collect()
    }

    /// Names of the scalars, in order.
    #[must_use]
    pub fn scalar_names(&self) -> Vec<String> {
        self.scalars.iter().map(|quantity| quantity.name.clone()).collect()
    }

    /// The normalised channels, [C, 48, 64] row-major, and scalars, [K].
    #[must_use]
    pub fn normalised(&self, input: &Input) -> (Vec<f32>, Vec<f32>) {
        let channels = self.channels.iter().zip(input.inputs.chunks(PIXELS));
        let pixels = channels.flat_map(|(quantity, page)| page.iter().map(|value| quantity.normalised(*value))).collect();
        let scalars = self.scalars.iter().zip(&input.scalars).map(|(quantity, value)| quantity.normalised(*value)).collect();
        (pixels, scalars)
    }

    /// Every input that lies outside what was seen in training, with its value and the bounds.
    #[must_use]
    pub fn outside(&self, input: &Input) -> Vec<String> {
        let mut sayings = Vec::new();
        for (quantity, page) in self.channels.iter().zip(input.inputs.chunks(PIXELS)) {
            let (mean, maximum) = mean_and_maximum(page);
            sayings.extend(quantity.outside(&format!("mean of channel {}", quantity.name), mean, quantity.mean_bounds));
            sayings.extend(quantity.outside(&format!("maximum of channel {}", quantity.name), maximum, quantity.maximum_bounds));
        }
        for (quantity, value) in self.scalars.iter().zip(&input.scalars) {
            sayings.extend(quantity.outside(&format!("scalar {}", quantity.name), f64::from(*value), quantity.mean_bounds));
        }
        let (scale, [low, high]) = (f64::from(input.scale), self.scale_bounds);
        if !(scale >= low * (1.0 - 1e-6) && scale <= high * (1.0 + 1e-6)) {
            sayings.push(format!("scale is {scale:.6e}, in training {low:.6e} to {high:.6e}"));
        }
        sayings
    }

    /// That `input` has as many values as this network takes, and a usable scale.
    ///
    /// # Errors
    /// Where it has not.
    pub fn check_input(&self, input: &Input) -> Result<(), InferError> {
        for (what, expected, found) in [
            ("channels", self.channels.len() * ROWS * COLUMNS, input.inputs.len()),
            ("scalars", self.scalars.len(), input.scalars.len()),
        ] {
            if expected != found {
                return Err(InferError::InputLength { what, expected, found });
            }
        }
        if !(input.scale > 0.0 && input.scale.is_finite()) {
            return Err(InferError::Scale { found: input.scale });
        }
        Ok(())
    }
}

impl NetworkCard for Card {
    fn weights_sha256(&self) -> &str {
        &self.weights_sha256
    }

    fn layers(&self) -> Vec<Layer> {
        self.architecture.layers(self.channels.len(), self.scalars.len())
    }

    fn check(&self, path: &Path) -> Result<(), InferError> {
        let refuse = |field: String, expected: &'static str, found: String| {
            Err(InferError::CardValue { path: path.to_owned(), field, expected, found })
        };
        if self.channels.is_empty() {
            return refuse("channels".to_owned(), "at least one", "empty".to_owned());
        }
        for quantity in self.channels.iter().chain(&self.scalars) {
            if !quantity.mean.is_finite() {
                return refuse(format!("mean of {}", quantity.name), "a finite number", quantity.mean.to_string());
            }
            if !(quantity.deviation > 0.0 && quantity.deviation.is_finite()) {
                return refuse(format!("deviation of {}", quantity.name), "a number above 0", quantity.deviation.to_string());
            }
            for bounds in [quantity.mean_bounds, quantity.maximum_bounds] {
                if !(bounds[0] <= bounds[1]) {
                    return refuse(format!("bounds of {}", quantity.name), "low, then high", format!("{bounds:?}"));
                }
            }
        }
        if !(self.scale_bounds[0] <= self.scale_bounds[1]) {
            return refuse("scale_bounds".to_owned(), "low, then high", format!("{:?}", self.scale_bounds));
        }
        Ok(())
    }
}

/// Mean and maximum of `page`; both NaN where a value is.
fn mean_and_maximum(page: &[f32]) -> (f64, f64) {
    let mean = page.iter().map(|value| f64::from(*value)).sum::<f64>() / page.len() as f64;
    let maximum = page.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    // `f32::max` passes over NaN; the mean does not.
    (mean, if mean.is_nan() { f64::NAN } else { f64::from(maximum) })
}

//! The card's figures of the inputs, from the samples that are trained on.

use super::{Dataset, HoldOut, Mirror, Recipe};
use crate::infer::{Card, JudgedBy, PIXELS, Quantity};

/// Sums over samples of one quantity.
struct Sums {
    count: f64,
    sum: f64,
    squares: f64,
    mean_bounds: [f64; 2],
    maximum_bounds: [f64; 2],
}

impl Sums {
    fn new() -> Self {
        let empty = [f64::INFINITY, f64::NEG_INFINITY];
        Self { count: 0.0, sum: 0.0, squares: 0.0, mean_bounds: empty, maximum_bounds: empty }
    }

    /// One sample's values, about `origin` so that their squares do not cancel; twice over where the mirror negates them.
    fn add(&mut self, values: &[f32], mirrored: bool, origin: f64) {
        let (mut least, mut most, mut sum) = (f64::INFINITY, f64::NEG_INFINITY, 0.0);
        for value in values.iter().map(|value| f64::from(*value)) {
            (least, most, sum) = (least.min(value), most.max(value), sum + value);
        }
        let images: &[(f64, f64)] = if mirrored { &[(1.0, most), (-1.0, -least)] } else { &[(1.0, most)] };
        for (sign, maximum) in images {
            let mean = sign * sum / values.len() as f64;
            for (bounds, value) in [(&mut self.mean_bounds, mean), (&mut self.maximum_bounds, *maximum)] {
                *bounds = [bounds[0].min(value), bounds[1].max(value)];
            }
            for value in values.iter().map(|value| sign * f64::from(*value) - origin) {
                (self.count, self.sum, self.squares) = (self.count + 1.0, self.sum + value, self.squares + value * value);
            }
        }
    }

    fn quantity(&self, name: &str, origin: f64) -> Quantity {
        let mean = self.sum / self.count;
        let deviation = (self.squares / self.count - mean * mean).max(0.0).sqrt();
        // A quantity that never changed says nothing; by 1, its rounding stays small.
        let varies = deviation > 1e-6 * (mean + origin).abs() && deviation > 0.0;
        Quantity {
            name: name.to_owned(),
            mean: mean + origin,
            deviation: if varies { deviation } else { 1.0 },
            mean_bounds: self.mean_bounds,
            maximum_bounds: self.maximum_bounds,
        }
    }
}

/// Photons of each sample, where what made the samples has noted them.
fn histories_of(origin: &str) -> Option<u64> {
    let made: serde_json::Value = serde_json::from_str(origin).ok()?;
    made.get("histories")?.as_u64()
}

/// A card without its checksum, its epoch and its held-out figures: what of it the samples `train` say.
pub(super) fn card_of(dataset: &Dataset, train: &[usize], recipe: &Recipe) -> Card {
    let both = Mirror { columns: recipe.mirror, rows: recipe.mirror };
    let samples = || train.iter().map(|index| &dataset.samples[*index]);
    let over = |name: &str, values: &dyn Fn(usize) -> Vec<f32>| {
        let mirrored = both.negates(name);
        let origin = if mirrored { 0.0 } else { f64::from(values(train[0])[0]) };
        let mut sums = Sums::new();
        train.iter().for_each(|index| sums.add(&values(*index), mirrored, origin));
        sums.quantity(name, origin)
    };
    let channels = dataset.channels.iter().enumerate().map(|(place, name)| {
        over(name, &|index| dataset.samples[index].input.inputs[place * PIXELS..(place + 1) * PIXELS].to_vec())
    });
    let scalars = dataset
        .scalar_names
        .iter()
        .enumerate()
        .map(|(place, name)| over(name, &|index| vec![dataset.samples[index].input.scalars[place]]));
    let scale_bounds = samples()
        .map(|sample| f64::from(sample.input.scale))
        .fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], scale| [low.min(scale), high.max(scale)]);
    Card {
        architecture: recipe.architecture,
        channels: channels.collect(),
        scalars: scalars.collect(),
        scale_bounds,
        weights_sha256: String::new(),
        training_seed: recipe.seed,
        training_epochs: recipe.epochs,
        kept_epoch: None,
        training_devices: Vec::new(),
        sample_count: train.len(),
        set_aside: 0,
        histories_per_sample: histories_of(&dataset.origin),
        sample_seeds: dataset.asked.clone(),
        specimens: dataset.specimens(train.iter().copied()),
        samples_sha256: dataset.fingerprint(),
        judged_by: match &recipe.hold_out {
            HoldOut::Nothing => JudgedBy::Nothing,
            HoldOut::Seeds { .. } => JudgedBy::Seeds,
            HoldOut::Specimens { names } => JudgedBy::Specimens { names: names.clone() },
        },
        held_out: std::collections::BTreeMap::new(),
    }
}

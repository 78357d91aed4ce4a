//! All samples of a folder, checked.

use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use super::shard::ERRORS;
use super::{HoldOut, LearnError, Shard};
use crate::image::hex;
use crate::infer::{CELL_COLUMNS, CELL_ROWS, CELLS, COLUMNS, Input, PAGES, PIXELS, ROWS};
use crate::random::{Purpose, Stream};

/// One image with its scatter.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// What the network is told.
    pub input: Input,
    /// Scatter, [2, 12, 16] row-major: once, more than once. Noisy means, 0 or more, in the unit of the scale.
    pub truth: Vec<f32>,
    /// Standard errors, [3, 12, 16]: of `truth`, and of the sum of its pages.
    pub truth_error: Vec<f32>,
    /// By it, samples are held out.
    pub specimen: String,
    /// Of the scene that was drawn.
    pub seed: u64,
}

/// Samples of one kind.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    /// Names of the channels, in order.
    pub channels: Vec<String>,
    /// Names of the scalars, in order.
    pub scalar_names: Vec<String>,
    /// What made them.
    pub origin: String,
    /// Seeds that samples were asked for with, ascending: the first of a range, and the one after its last.
    pub asked: Vec<[u64; 2]>,
    /// By name of their file, then by place in it.
    pub samples: Vec<Sample>,
}

impl Dataset {
    /// Every `*.safetensors` file of `folder`.
    ///
    /// # Errors
    /// When there is none, one is damaged or of another kind than those before, or a sample cannot be learnt from.
    pub fn read(folder: &Path) -> Result<Self, LearnError> {
        let io = |source| LearnError::Io { path: folder.to_owned(), source };
        let mut paths: Vec<PathBuf> = Vec::new();
        for entry in std::fs::read_dir(folder).map_err(io)? {
            paths.push(entry.map_err(io)?.path());
        }
        paths.retain(|path| path.extension().is_some_and(|ending| ending == "safetensors"));
        paths.sort();
        let mut dataset: Option<Self> = None;
        for path in &paths {
            let shard = Shard::read(path)?;
            let dataset = dataset.get_or_insert_with(|| Self {
                channels: shard.channels.clone(),
                scalar_names: shard.scalar_names.clone(),
                origin: shard.origin.clone(),
                asked: Vec::new(),
                samples: Vec::new(),
            });
            dataset.take(path, shard)?;
        }
        if let Some(dataset) = &mut dataset {
            dataset.asked = joined(std::mem::take(&mut dataset.asked));
        }
        let nothing = || LearnError::NoSamples { path: folder.to_owned() };
        dataset.filter(|dataset| !dataset.samples.is_empty()).ok_or_else(nothing)
    }

    /// The samples of `shard`, which came from `path`.
    fn take(&mut self, path: &Path, shard: Shard) -> Result<(), LearnError> {
        for (what, expected, found) in [
            ("what made the samples", self.origin.clone(), shard.origin.clone()),
            ("channels", format!("{:?}", self.channels), format!("{:?}", shard.channels)),
            ("scalars", format!("{:?}", self.scalar_names), format!("{:?}", shard.scalar_names)),
            ("columns and rows of the inputs", format!("{:?}", [COLUMNS, ROWS]), format!("{:?}", shard.grid_px)),
            ("columns and rows of the truth", format!("{:?}", [CELL_COLUMNS, CELL_ROWS]), format!("{:?}", shard.truth_px)),
        ] {
            if expected != found {
                return Err(LearnError::Mixed { path: path.to_owned(), what, expected, found });
            }
        }
        if let [first, end] = shard.asked[..] {
            self.asked.push([first, end]);
        }
        let (pixels, scalars, cells) = (self.channels.len() * PIXELS, self.scalar_names.len(), PAGES * CELLS);
        for (index, (seed, specimen)) in shard.seeds.iter().zip(shard.specimens).enumerate() {
            let of = |values: &[f32], length: usize| values[index * length..(index + 1) * length].to_vec();
            let input =
                Input { inputs: of(&shard.inputs, pixels), scalars: of(&shard.scalars, scalars), scale: shard.scale[index] };
            let (truth, truth_error) = (of(&shard.truth, cells), of(&shard.truth_error, ERRORS * CELLS));
            let sample = Sample { input, truth, truth_error, specimen, seed: *seed };
            sample.check().map_err(|(what, expected, found)| LearnError::Sample {
                path: path.to_owned(),
                index,
                seed: *seed,
                what,
                expected,
                found: f64::from(found),
            })?;
            self.samples.push(sample);
        }
        Ok(())
    }

    /// SHA-256 of everything that training sees, in hexadecimal.
    #[must_use]
    pub fn fingerprint(&self) -> String {
        let mut hash = Sha256::new();
        for name in self.channels.iter().chain(&self.scalar_names) {
            hash.update(name.as_bytes());
            hash.update([0]);
        }
        for sample in &self.samples {
            let scale = [sample.input.scale];
            for values in [&sample.input.inputs[..], &sample.input.scalars, &scale, &sample.truth, &sample.truth_error] {
                hash.update(bytemuck::cast_slice::<f32, u8>(values));
            }
            hash.update(sample.specimen.as_bytes());
            hash.update(sample.seed.to_le_bytes());
        }
        hex(&hash.finalize())
    }

    /// Indices of the samples to train on, and of those held out.
    ///
    /// # Errors
    /// When a specimen to hold out is unknown, or one of the two would be empty without being asked to.
    pub fn split(&self, hold_out: &HoldOut, seed: u64) -> Result<(Vec<usize>, Vec<usize>), LearnError> {
        let all = 0..self.samples.len();
        let (train, held_out): (Vec<usize>, Vec<usize>) = match hold_out {
            HoldOut::Nothing => (all.collect(), Vec::new()),
            HoldOut::Specimens { names } => {
                let known = self.specimens(all.clone());
                if let Some(name) = names.iter().find(|name| !known.contains(name)) {
                    return Err(LearnError::UnknownSpecimen { name: name.clone(), known });
                }
                all.partition(|index| !names.contains(&self.samples[*index].specimen))
            }
            HoldOut::Seeds { share } => self.without_share(all.collect(), *share, &mut Stream::new(seed, 0, 0, Purpose::HeldOut)),
        };
        if train.is_empty() || (held_out.is_empty() && *hold_out != HoldOut::Nothing) {
            return Err(LearnError::Split { train: train.len(), held_out: held_out.len() });
        }
        Ok((train, held_out))
    }

    /// Indices of `train` without those of a `share` of their seeds, and these: views of the specimens that are trained on, to choose by. Of a share
    /// of 0 there are none.
    ///
    /// # Errors
    /// When nothing is left to train on.
    pub fn set_aside(&self, train: Vec<usize>, share: f64, seed: u64) -> Result<(Vec<usize>, Vec<usize>), LearnError> {
        if !(share > 0.0) {
            return Ok((train, Vec::new()));
        }
        let (train, aside) = self.without_share(train, share, &mut Stream::new(seed, 1, 0, Purpose::HeldOut));
        if train.is_empty() {
            return Err(LearnError::Split { train: 0, held_out: aside.len() });
        }
        Ok((train, aside))
    }

    /// `indices` without those of a `share` of their seeds, rounded up, and these.
    fn without_share(&self, indices: Vec<usize>, share: f64, stream: &mut Stream) -> (Vec<usize>, Vec<usize>) {
        let mut seeds: Vec<u64> = indices.iter().map(|index| self.samples[*index].seed).collect();
        seeds.sort_unstable();
        seeds.dedup();
        shuffle(&mut seeds, stream);
        seeds.truncate((seeds.len() as f64 * share).ceil() as usize);
        seeds.sort_unstable();
        indices.into_iter().partition(|index| seeds.binary_search(&self.samples[*index].seed).is_err())
    }

    /// Names of the specimens of the samples `indices`, sorted.
    pub(super) fn specimens(&self, indices: impl IntoIterator<Item = usize>) -> Vec<String> {
        let mut names: Vec<String> = indices.into_iter().map(|index| self.samples[index].specimen.clone()).collect();
        names.sort();
        names.dedup();
        names
    }
}

impl Sample {
    /// What keeps it from being learnt from: the value, what it must be, and what it is.
    fn check(&self) -> Result<(), (&'static str, &'static str, f32)> {
        if !(self.input.scale > 0.0) {
            return Err(("scale", "above 0", self.input.scale));
        }
        for (what, values) in [("a cell of the truth", &self.truth), ("a standard error", &self.truth_error)] {
            if let Some(value) = values.iter().find(|value| !(**value >= 0.0)) {
                return Err((what, "0 or more", *value));
            }
        }
        let sum: f32 = self.truth.iter().sum();
        if !(sum > 0.0 && sum.is_finite()) {
            return Err(("the sum of the truth", "finite and above 0", sum));
        }
        Ok(())
    }
}

/// Ranges [first, end) in ascending order, those that touch as one.
fn joined(mut ranges: Vec<[u64; 2]>) -> Vec<[u64; 2]> {
    ranges.sort_unstable();
    ranges.dedup_by(|later, before| {
        let touches = later[0] <= before[1];
        if touches {
            before[1] = before[1].max(later[1]);
        }
        touches
    });
    ranges
}

/// Fisher–Yates.
pub(super) fn shuffle<T>(list: &mut [T], stream: &mut Stream) {
    for last in (1..list.len()).rev() {
        let chosen = (stream.uniform() * (last + 1) as f64) as usize;
        list.swap(last, chosen.min(last));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_that_touch_are_one() {
        assert_eq!(joined(vec![[100, 150], [0, 50], [50, 100], [1000, 1020], [20, 30]]), [[0, 150], [1000, 1020]]);
        assert_eq!(joined(vec![[0, 50], [51, 60]]), [[0, 50], [51, 60]], "the control: seed 50 is in neither");
    }
}

//! The training of a scatter network.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

use burn::tensor::Device;

use super::adam::Adam;
use super::checkpoint::State;
use super::dataset::shuffle;
use super::epochs::{self, Learner, Pace, slopes_of};
use super::figures_of;
use super::loss::Batch;
use super::siblings;
use super::statistics::card_of;
use super::{Dataset, Figures, LearnError, Mirror, Progress, Recipe, Sample, TrainFiles, TrainOptions, Trained, TrainingEnd};
use crate::image::{check_writable, sha256_bytes, write_atomically};
use crate::infer::{CELLS, Card, LOG_LIMIT, Layer, Network, NetworkCard, NetworkFiles, PAGES, weights_file};
use crate::random::{Purpose, Stream};

/// Trains a network, tells `told` after every step, and writes the best weights with their card, the history and a checkpoint after every
/// epoch. When `told` breaks, the unfinished epoch is dropped. The same options and samples give the same weights to the bit, on the same
/// kind of processor, also when the training was interrupted and resumed.
///
/// # Errors
/// When samples, options or a checkpoint cannot be used, a file cannot be written, the training diverges, or the device fails.
pub fn train(options: &TrainOptions, told: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>) -> Result<Trained, LearnError> {
    let recipe = &options.recipe;
    recipe.check()?;
    check_output(options)?;
    let dataset = Dataset::read(&options.dataset)?;
    let (train, held_out) = dataset.split(&recipe.hold_out, recipe.seed)?;
    let (train, set_aside) = dataset.set_aside(train, recipe.set_aside, recipe.seed)?;
    let card = Card { set_aside: set_aside.len(), ..card_of(&dataset, &train, recipe) };
    // What is no sibling is refused now; what they say is read when it is written, for they may be in training too.
    siblings::judge(&mut card.clone(), &options.siblings, false)?;
    let layers = recipe.architecture.layers(dataset.channels.len(), dataset.scalar_names.len());
    let samples = |indices: &[usize]| -> Vec<&Sample> { indices.iter().map(|index| &dataset.samples[*index]).collect() };
    let training = Training {
        options,
        recipe,
        held_out: samples(&held_out),
        set_aside: samples(&set_aside),
        files: TrainFiles::of(&options.output),
        dataset: &dataset,
        train,
        card,
    };
    let mut state = if options.resume && training.files.checkpoint.exists() {
        let count = layers.iter().map(Layer::value_count).sum();
        State::read(&training.files.checkpoint, recipe, &training.card.samples_sha256, count)?
    } else {
        let mut adam = Adam::drawn(&layers, recipe.seed);
        // The last layer's biases are the last parameters: the training begins at the usual scatter of each page.
        let first = adam.parameters.len() - PAGES;
        adam.parameters[first..].copy_from_slice(&training.usual_logarithms());
        State::new(adam)
    };
    let end = epochs::run(&training, &options.device, &mut state, told)?;
    training.trained(&state, end)
}

/// Refuses now what would be refused after the first epoch.
pub(super) fn check_output<R>(options: &TrainOptions<R>) -> Result<(), LearnError> {
    let weights = TrainFiles::of(&options.output).network.weights;
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| LearnError::Io { path, source }
    };
    check_writable(&weights)?;
    let folder = weights.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let samples = options.dataset.canonicalize().map_err(io(&options.dataset))?;
    if folder.canonicalize().map_err(io(folder))? == samples {
        return Err(LearnError::AmongSamples { path: weights });
    }
    Ok(())
}

/// Figures of all that was held out, and by specimen.
type Evaluation = Option<(Figures, BTreeMap<String, Figures>)>;

/// What does not change from epoch to epoch.
struct Training<'a> {
    options: &'a TrainOptions,
    recipe: &'a Recipe,
    dataset: &'a Dataset,
    train: Vec<usize>,
    held_out: Vec<&'a Sample>,
    /// What chooses the epoch in place of what is held out, if anything.
    set_aside: Vec<&'a Sample>,
    card: Card,
    files: TrainFiles,
}

impl Learner for Training<'_> {
    type Found = Evaluation;
    type Drawn = Vec<Sample>;

    fn pace(&self) -> Pace {
        let Recipe { epochs, batch, rule, patience, .. } = self.recipe;
        Pace { epochs: *epochs, batch: *batch, rule: rule.clone(), chooses: self.recipe.chooses(), patience: *patience }
    }

    fn order(&self, epoch: usize) -> Vec<usize> {
        let mut order = self.train.clone();
        shuffle(&mut order, &mut Stream::new(self.recipe.seed, epoch as u32, 0, Purpose::Epoch));
        order
    }

    fn draw(&self, epoch: usize, chosen: &[usize]) -> Vec<Sample> {
        chosen.iter().map(|index| self.augmented(*index, epoch)).collect()
    }

    fn slopes(&self, samples: Vec<Sample>, parameters: &[f32], device: &Device) -> Result<(f64, Vec<f32>), String> {
        let network = self.network(parameters, device);
        let loss = Batch::new(&samples, &self.card, self.recipe.page_weight, device).loss(&network);
        slopes_of(&loss, network.layers())
    }

    fn judge(&self, parameters: &[f32], _: &Device) -> Result<([Option<f64>; 2], Evaluation), String> {
        let evaluation = self.evaluate(parameters, &self.held_out);
        let aside = self.evaluate(parameters, &self.set_aside);
        let figures = aside.as_ref().or(evaluation.as_ref()).map(|(figures, _)| figures);
        Ok(([figures.map(Figures::nmse), figures.map(|figures| figures.nmse_raw)], evaluation))
    }

    fn write_network(&self, state: &State, found: &Evaluation) -> Result<(), LearnError> {
        self.written(state, found).map(drop)
    }

    fn files(&self) -> &TrainFiles {
        &self.files
    }

    fn keep(&self, state: &State) -> Result<(), LearnError> {
        state.write(&self.files.checkpoint, self.options, &self.card.samples_sha256)
    }
}

impl Training<'_> {
    /// Mean over the samples of ln(mean scatter / scale), by page; of a page without scatter as low as a prediction can be.
    fn usual_logarithms(&self) -> [f32; PAGES] {
        let logarithm = |sample: &Sample, page: usize| {
            let cells = &sample.truth[page * CELLS..(page + 1) * CELLS];
            let mean = cells.iter().map(|value| f64::from(*value)).sum::<f64>() / CELLS as f64;
            (mean / f64::from(sample.input.scale)).ln().clamp(-LOG_LIMIT, LOG_LIMIT)
        };
        let samples = || self.train.iter().map(|index| &self.dataset.samples[*index]);
        std::array::from_fn(|page| {
            (samples().map(|sample| logarithm(sample, page)).sum::<f64>() / self.train.len() as f64) as f32
        })
    }

    fn augmented(&self, index: usize, epoch: usize) -> Sample {
        let sample = &self.dataset.samples[index];
        if !self.recipe.mirror {
            return sample.clone();
        }
        // Stream 0 is the order's.
        let bits = Stream::new(self.recipe.seed, epoch as u32, index as u32 + 1, Purpose::Epoch).next_u32();
        self.dataset.mirrored(sample, Mirror { columns: bits & 1 != 0, rows: bits & 2 != 0 })
    }

    fn network(&self, parameters: &[f32], device: &Device) -> Network {
        let (channels, scalars) = (self.card.channels.len(), self.card.scalars.len());
        Network::new(self.recipe.architecture, channels, scalars, parameters, device)
            .expect("parameters were drawn or read for these layers")
    }

    /// On the processor, as users will ask it.
    fn evaluate(&self, parameters: &[f32], samples: &[&Sample]) -> Evaluation {
        let device = Device::flex();
        figures_of(&self.network(parameters, &device), &self.card, samples, self.recipe.batch, &device)
    }

    /// Writes the best parameters of `state`, then their card: until it is there too, a reader meets a checksum that disagrees.
    fn written(&self, state: &State, evaluation: &Evaluation) -> Result<Card, LearnError> {
        let Some((epoch, parameters)) = &state.best else { return Err(LearnError::StoppedTooSoon) };
        let mut card = Card { training_devices: state.devices.clone(), kept_epoch: Some(*epoch), ..self.card.clone() };
        let weights = weights_file(&card.layers(), parameters).map_err(LearnError::Encode)?;
        card.weights_sha256 = sha256_bytes(&weights);
        if let Some((all, by_specimen)) = evaluation {
            card.held_out.extend(all.named(""));
            if by_specimen.len() > 1 {
                by_specimen.iter().for_each(|(name, own)| card.held_out.extend(own.named(&format!(" of {name}"))));
            }
        }
        siblings::judge(&mut card, &self.options.siblings, true)?;
        let NetworkFiles { weights: weights_path, card: card_path } = &self.files.network;
        write_atomically(weights_path, |file| file.write_all(&weights))?;
        write_atomically(card_path, |file| Ok(serde_json::to_writer_pretty(file, &card)?))?;
        Ok(card)
    }

    fn trained(&self, state: &State, end: TrainingEnd) -> Result<Trained, LearnError> {
        let Some((epoch, parameters)) = &state.best else { return Err(LearnError::StoppedTooSoon) };
        let evaluation = self.evaluate(parameters, &self.held_out);
        let card = self.written(state, &evaluation)?;
        let held_out = evaluation.map(|(figures, _)| figures);
        Ok(Trained { card, files: self.files.clone(), epoch: *epoch, held_out, history: state.history.clone(), end })
    }
}

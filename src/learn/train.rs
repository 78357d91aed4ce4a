//! The training: epochs of steps, each epoch judged and kept.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

use burn::tensor::Device;

use super::adam::{Adam, learning_rate};
use super::checkpoint::State;
use super::dataset::shuffle;
use super::figures_of;
use super::loss::Batch;
use super::siblings;
use super::statistics::card_of;
use super::{
    Dataset, EpochRecord, Figures, LearnError, Mirror, Progress, Recipe, Sample, TrainFiles, TrainOptions, Trained, TrainingEnd,
};
use crate::image::{check_writable, write_atomically};
use crate::infer::{CELLS, Card, LOG_LIMIT, Layer, Network, NetworkFiles, PAGES, sha256};
use crate::random::{Purpose, Stream};

/// Trains a network, tells `told` after every step, and writes the best weights with their card, the history and a checkpoint after every
/// epoch. When `told` breaks, the unfinished epoch is dropped. The same options and samples give the same weights to the bit, on the same
/// kind of processor, also when the training was interrupted and resumed.
///
/// # Errors
/// When samples, options or a checkpoint cannot be used, a file cannot be written, or the training diverges.
pub fn train(options: &TrainOptions, told: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>) -> Result<Trained, LearnError> {
    let recipe = &options.recipe;
    recipe.check()?;
    check_output(options)?;
    let dataset = Dataset::read(&options.dataset)?;
    let (train, held_out) = dataset.split(&recipe.hold_out, recipe.seed)?;
    let card = card_of(&dataset, &train, recipe);
    // What is no sibling is refused now; what they say is read when it is written, for they may be in training too.
    siblings::judge(&mut card.clone(), &options.siblings)?;
    let layers = recipe.architecture.layers(dataset.channels.len(), dataset.scalar_names.len());
    let training = Training {
        options,
        recipe,
        held_out: held_out.iter().map(|index| &dataset.samples[*index]).collect(),
        files: TrainFiles::of(&options.output),
        steps: train.len().div_ceil(recipe.batch),
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
        State { adam, history: Vec::new(), best: None }
    };
    let end = training.run(&mut state, told)?;
    training.trained(&state, end)
}

/// Refuses now what would be refused after the first epoch.
fn check_output(options: &TrainOptions) -> Result<(), LearnError> {
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
    card: Card,
    files: TrainFiles,
    /// Of one epoch.
    steps: usize,
}

impl Training<'_> {
    fn run(&self, state: &mut State, told: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>) -> Result<TrainingEnd, LearnError> {
        while state.history.len() < self.recipe.epochs {
            if self.no_better(state) {
                return Ok(TrainingEnd::NoBetter);
            }
            let epoch = state.history.len() + 1;
            let mut next = state.adam.clone();
            let Some((train_loss, learning_rate)) = self.epoch(epoch, &mut next, told)? else {
                return Ok(TrainingEnd::ByCaller);
            };
            let evaluation = self.evaluate(&next.parameters);
            let figures = evaluation.as_ref().map(|(figures, _)| figures);
            let record = EpochRecord {
                epoch,
                train_loss,
                held_out_nmse: figures.map(Figures::nmse),
                held_out_nmse_raw: figures.map(|figures| figures.nmse_raw),
                learning_rate,
            };
            let known = state.best.as_ref().and_then(|(epoch, _)| state.history[epoch - 1].held_out_nmse);
            let best = match (record.held_out_nmse, known) {
                (Some(new), Some(known)) if self.recipe.hold_out.chooses() => new < known,
                _ => true,
            };
            state.adam = next;
            state.history.push(record);
            if best {
                state.best = Some((epoch, state.adam.parameters.clone()));
                self.write_network(&state.adam.parameters, &evaluation)?;
            }
            self.keep(state)?;
            let record = &state.history[epoch - 1];
            if told(&self.progress(epoch, self.steps, record.train_loss, Some(record), best)).is_break() {
                return Ok(TrainingEnd::ByCaller);
            }
        }
        Ok(TrainingEnd::Complete)
    }

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

    /// One pass over the samples: their mean loss and the last learning rate; `None` where the caller stopped it.
    fn epoch(
        &self,
        epoch: usize,
        adam: &mut Adam,
        told: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Option<(f64, f64)>, LearnError> {
        let device = Device::flex().autodiff();
        let mut order = self.train.clone();
        shuffle(&mut order, &mut Stream::new(self.recipe.seed, epoch as u32, 0, Purpose::Epoch));
        let all_steps = (self.steps * self.recipe.epochs) as u64;
        let (mut loss_sum, mut seen, mut rate) = (0.0, 0, 0.0);
        for (step, chosen) in order.chunks(self.recipe.batch).enumerate() {
            let samples: Vec<Sample> = chosen.iter().map(|index| self.augmented(*index, epoch)).collect();
            let network = self.network(&adam.parameters, &device);
            let loss = Batch::new(&samples, &self.card, self.recipe.page_weight, &device).loss(&network);
            let gradient = gradient_of(&loss, &network);
            rate = learning_rate(self.recipe, adam.steps, all_steps);
            let norm = adam.step(&gradient, rate, self.recipe);
            if !norm.is_finite() {
                return Err(LearnError::Diverged { epoch, norm, learning_rate: rate });
            }
            loss_sum += f64::from(loss.into_scalar::<f32>()) * samples.len() as f64;
            seen += samples.len();
            // The last step of an epoch is told with the epoch.
            if step + 1 < self.steps && told(&self.progress(epoch, step + 1, loss_sum / seen as f64, None, false)).is_break() {
                return Ok(None);
            }
        }
        Ok(Some((loss_sum / seen as f64, rate)))
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

    fn evaluate(&self, parameters: &[f32]) -> Evaluation {
        let device = Device::flex();
        figures_of(&self.network(parameters, &device), &self.card, &self.held_out, self.recipe.batch, &device)
    }

    fn no_better(&self, state: &State) -> bool {
        let best = state.best.as_ref().map_or(0, |(epoch, _)| *epoch);
        let chooses = self.recipe.hold_out.chooses();
        self.recipe.patience.is_some_and(|patience| chooses && state.history.len() >= best + patience)
    }

    fn progress<'a>(
        &self,
        epoch: usize,
        step: usize,
        train_loss: f64,
        done: Option<&'a EpochRecord>,
        best: bool,
    ) -> Progress<'a> {
        Progress { epoch, epochs: self.recipe.epochs, step, steps: self.steps, train_loss, done, best }
    }

    /// Writes the history, and last the checkpoint: what a checkpoint speaks of is there.
    fn keep(&self, state: &State) -> Result<(), LearnError> {
        let mut table = csv::Writer::from_writer(Vec::new());
        let path = &self.files.history;
        let io = |source| LearnError::Io { path: path.clone(), source };
        for record in &state.history {
            table.serialize(record).map_err(|error| io(error.into()))?;
        }
        let bytes = table.into_inner().map_err(|error| io(error.into_error()))?;
        write_atomically(path, |file| file.write_all(&bytes))?;
        state.write(&self.files.checkpoint, self.options, &self.card.samples_sha256)
    }

    /// Writes `parameters`, then their card: until it is there too, a reader meets a checksum that disagrees.
    fn write_network(&self, parameters: &[f32], evaluation: &Evaluation) -> Result<Card, LearnError> {
        let mut card = self.card.clone();
        let (channels, scalars) = (card.channels.len(), card.scalars.len());
        let weights = card.architecture.weights_file(channels, scalars, parameters).map_err(LearnError::Encode)?;
        card.weights_sha256 = sha256(&weights);
        if let Some((all, by_specimen)) = evaluation {
            card.held_out.extend(all.named(""));
            if by_specimen.len() > 1 {
                by_specimen.iter().for_each(|(name, own)| card.held_out.extend(own.named(&format!(" of {name}"))));
            }
        }
        siblings::judge(&mut card, &self.options.siblings)?;
        let NetworkFiles { weights: weights_path, card: card_path } = &self.files.network;
        write_atomically(weights_path, |file| file.write_all(&weights))?;
        write_atomically(card_path, |file| Ok(serde_json::to_writer_pretty(file, &card)?))?;
        Ok(card)
    }

    fn trained(&self, state: &State, end: TrainingEnd) -> Result<Trained, LearnError> {
        let Some((epoch, parameters)) = &state.best else { return Err(LearnError::StoppedTooSoon) };
        let evaluation = self.evaluate(parameters);
        let card = self.write_network(parameters, &evaluation)?;
        let held_out = evaluation.map(|(figures, _)| figures);
        Ok(Trained { card, files: self.files.clone(), epoch: *epoch, held_out, history: state.history.clone(), end })
    }
}

/// The slopes of `loss` by the parameters, in their order.
fn gradient_of(loss: &burn::tensor::Tensor<1>, network: &Network) -> Vec<f32> {
    let mut gradients = loss.backward();
    let mut all = Vec::new();
    for layer in network.layers() {
        let of_weight = layer.weight.grad_remove(&mut gradients).map(burn::tensor::Tensor::into_data);
        let of_bias = layer.bias.grad_remove(&mut gradients).map(burn::tensor::Tensor::into_data);
        for data in [of_weight, of_bias] {
            all.extend(data.expect("every parameter is used by the forward pass").iter::<f32>());
        }
    }
    all
}

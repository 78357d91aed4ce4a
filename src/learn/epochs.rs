//! Epochs of steps, each epoch judged and kept: the same for every kind of network.

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor};

use super::adam::learning_rate;
use super::checkpoint::State;
use super::{EpochRecord, LearnError, Progress, StepRule, TrainFiles, TrainingEnd};
use crate::image::write_atomically;
use crate::infer::{Convolution, NetworkDevice, fetched};

/// How long a training goes on.
#[derive(Clone, Debug)]
pub(super) struct Pace {
    /// At most.
    pub epochs: usize,
    /// Samples of a step.
    pub batch: usize,
    /// How a step follows from its gradient.
    pub rule: StepRule,
    /// Whether what is judged by chooses the epoch that is kept.
    pub chooses: bool,
    /// Stop after so many epochs without a better one, where that chooses.
    pub patience: Option<usize>,
}

/// What a kind of network adds to a training.
pub(super) trait Learner: Sync {
    /// What is found on that which was held out.
    type Found;
    /// Samples of a step, as they are drawn.
    type Drawn: Send;

    /// How long to go on.
    fn pace(&self) -> Pace;

    /// The samples of an epoch, in order.
    fn order(&self, epoch: usize) -> Vec<usize>;

    /// The samples `chosen`, as this epoch sees them.
    fn draw(&self, epoch: usize, chosen: &[usize]) -> Self::Drawn;

    /// Mean loss of the samples of a step, and its slopes by the parameters; what the device says where it fails.
    fn slopes(&self, drawn: Self::Drawn, parameters: &[f32], device: &Device) -> Result<(f64, Vec<f32>), String>;

    /// How wrong `parameters` are on what was set aside, else on what was held out, without and with the noise of the truth, and what to write of
    /// what was held out; what the device says where it fails.
    fn judge(&self, parameters: &[f32], device: &Device) -> Result<([Option<f64>; 2], Self::Found), String>;

    /// Writes the best network of `state`, with its card.
    fn write_network(&self, state: &State, found: &Self::Found) -> Result<(), LearnError>;

    /// Its files.
    fn files(&self) -> &TrainFiles;

    /// Writes the checkpoint.
    fn keep(&self, state: &State) -> Result<(), LearnError>;
}

/// Goes on from `state` to the end, writing the network and the history after every epoch.
pub(super) fn run<L: Learner>(
    learner: &L,
    device: &NetworkDevice,
    state: &mut State,
    told: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
) -> Result<TrainingEnd, LearnError> {
    let pace = learner.pace();
    while state.history.len() < pace.epochs {
        let best = state.best.as_ref().map_or(0, |(epoch, _)| *epoch);
        if pace.patience.is_some_and(|patience| pace.chooses && state.history.len() >= best + patience) {
            return Ok(TrainingEnd::NoBetter);
        }
        let epoch = state.history.len() + 1;
        let mut next = state.clone();
        let Some((train_loss, learning_rate, steps)) = run_epoch(learner, (&pace, device), epoch, &mut next, told)? else {
            return Ok(TrainingEnd::ByCaller);
        };
        let ([held_out, held_out_raw], found) = sound(device, learner.judge(&next.adam.parameters, &device.device))?;
        let known = state.best.as_ref().and_then(|(epoch, _)| state.history[epoch - 1].held_out);
        let is_best = match (held_out, known) {
            (Some(new), Some(known)) if pace.chooses => new < known,
            _ => true,
        };
        *state = next;
        if state.devices.last() != Some(&device.name) {
            state.devices.push(device.name.clone());
        }
        state.history.push(EpochRecord { epoch, train_loss, held_out, held_out_raw, learning_rate });
        if is_best {
            state.best = Some((epoch, state.adam.parameters.clone()));
            learner.write_network(state, &found)?;
        }
        write_history(learner.files(), &state.history)?;
        // Last: what a checkpoint speaks of is there.
        learner.keep(state)?;
        let done = Some(&state.history[epoch - 1]);
        let progress = Progress { epoch, epochs: pace.epochs, step: steps, steps, train_loss, done, best: is_best };
        // After the last one there is nothing left to stop.
        if told(&progress).is_break() && epoch < pace.epochs {
            return Ok(TrainingEnd::ByCaller);
        }
    }
    Ok(TrainingEnd::Complete)
}

/// One pass over the samples: their mean loss, the last learning rate and the number of steps; `None` where the caller stopped it.
fn run_epoch<L: Learner>(
    learner: &L,
    (pace, place): (&Pace, &NetworkDevice),
    epoch: usize,
    state: &mut State,
    told: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
) -> Result<Option<(f64, f64, usize)>, LearnError> {
    let device = place.device.clone().autodiff();
    let order = learner.order(epoch);
    let mut batches = order.chunks(pace.batch);
    let steps = batches.len();
    let all_steps = (steps * pace.epochs) as u64;
    let (mut loss_sum, mut seen, mut rate) = (0.0, 0, 0.0);
    let draw = |chosen: &[usize]| (chosen.len(), learner.draw(epoch, chosen));
    let mut next = batches.next().map(draw);
    let mut step = 0;
    while let Some((count, drawn)) = next.take() {
        let found = rayon::in_place_scope(|scope| {
            // While the device works, the processor draws what comes after.
            scope.spawn(|_| next = batches.next().map(draw));
            // On this thread always: each that asks a GPU for something has memory of its own there.
            learner.slopes(drawn, &state.adam.parameters, &device)
        });
        let (loss, slopes) = sound(place, found)?;
        step += 1;
        rate = learning_rate(&pace.rule, state.adam.steps, all_steps);
        let norm = state.adam.step(&slopes, rate, &pace.rule);
        if !norm.is_finite() {
            return Err(LearnError::Diverged { epoch, norm, learning_rate: rate });
        }
        loss_sum += loss * count as f64;
        seen += count;
        let train_loss = loss_sum / seen as f64;
        let progress = Progress { epoch, epochs: pace.epochs, step, steps, train_loss, done: None, best: false };
        // The last step of an epoch is told with the epoch.
        if step < steps && told(&progress).is_break() {
            return Ok(None);
        }
    }
    Ok(Some((loss_sum / seen as f64, rate, steps)))
}

fn write_history(files: &TrainFiles, history: &[EpochRecord]) -> Result<(), LearnError> {
    let mut table = csv::Writer::from_writer(Vec::new());
    let path = &files.history;
    let io = |source| LearnError::Io { path: path.clone(), source };
    for record in history {
        table.serialize(record).map_err(|error| io(error.into()))?;
    }
    let bytes = table.into_inner().map_err(|error| io(error.into_error()))?;
    Ok(write_atomically(path, |file| file.write_all(&bytes))?)
}

/// What was `found` on `device`, unless it failed meanwhile.
fn sound<T>(device: &NetworkDevice, found: Result<T, String>) -> Result<T, LearnError> {
    // What it met first says more than what became of it.
    let detail = match (device.fault(), found) {
        (None, Ok(found)) => return Ok(found),
        (Some(detail), _) => detail.to_owned(),
        (None, Err(detail)) => detail,
    };
    let detail = detail.lines().next().unwrap_or("it says nothing").to_owned();
    Err(LearnError::Device { name: device.name.clone(), detail })
}

/// `loss` and its slopes by the parameters of `layers`, in their order.
pub(super) fn slopes_of<const D: usize>(loss: &Tensor<1>, layers: &[Convolution<D>]) -> Result<(f64, Vec<f32>), String> {
    let mut gradients = loss.backward();
    let mut all: Vec<Tensor<1>> = vec![loss.clone().inner()];
    for Convolution { weight, bias, .. } in layers {
        let of_weight = weight.grad_remove(&mut gradients).map(|slopes| slopes.reshape([weight.shape().num_elements()]));
        let of_bias = bias.grad_remove(&mut gradients);
        all.extend([of_weight, of_bias].map(|slopes| slopes.expect("every parameter is used by the forward pass")));
    }
    // At once: every fetch waits for the device.
    let mut slopes = fetched(Tensor::cat(all, 0))?;
    Ok((f64::from(slopes.remove(0)), slopes))
}

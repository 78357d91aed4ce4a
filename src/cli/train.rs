//! `sidecarm train`: networks from their samples.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use super::render::DeviceArg;
use crate::gpu::{Device, GpuError};
use crate::image::plot::{Axis, Plot, PlotError, Scale, Series};
use crate::image::{ImageFileError, write_atomically};
use crate::infer::materials::{MaterialsArchitecture, MaterialsCard};
use crate::infer::{Architecture, Card, JudgedBy, NetworkDevice};
use crate::learn::materials::{MaterialsRecipe, train_materials};
use crate::learn::{
    AnyRecipe, EpochRecord, HoldOut, LearnError, Progress, Recipe, TrainFiles, TrainOptions, Trained, TrainingEnd,
    recipe_of_checkpoint, train,
};
use crate::reporter::Reporter;
use crate::time::Stopwatch;

/// Share of what is trained on that chooses the epoch where a specimen is held out.
const SET_ASIDE: f64 = 0.1;

/// Train a network on the samples of `sidecarm dataset`.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm train scatter set --out my-scatter")]
pub struct TrainArgs {
    #[command(subcommand)]
    of: TrainOf,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum TrainOf {
    Scatter(TrainScatterArgs),
    Materials(TrainMaterialsArgs),
}

/// A network that says what scatter reaches the detector.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm train scatter scatter-set --out my-scatter --hold-out chest --minutes 60
  sidecarm train scatter scatter-set --out my-scatter --hold-out chest --patience 10
  sidecarm train scatter scatter-set --out my-scatter --resume
  sidecarm train scatter scatter-set --out everything --sibling without-chest --sibling without-pelvis

Written after every epoch: NAME.safetensors (weights) and NAME.json (its card: what it takes, what it was trained on, how good it is on what
it was not), NAME.csv (losses), NAME.checkpoint (from where --resume goes on); at the end NAME.svg. Without --hold-out the epoch that is best
on the tenth is kept, so its figure there is a little too good; with it the last one is, and with --patience as well the one that is best on a tenth
of the other views. On one device a resumed training gives bit for bit what an uninterrupted one gives.")]
struct TrainScatterArgs {
    #[command(flatten)]
    common: CommonArgs,
    /// Passes over the samples
    #[arg(long, value_name = "N", default_value_t = 60, conflicts_with = "resume")]
    epochs: usize,
}

/// A network that says what of a CT is bone.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm train materials materials-set --out my-materials --hold-out chest --minutes 60
  sidecarm train materials materials-set --out my-materials --hold-out chest --patience 5
  sidecarm train materials materials-set --out my-materials --batch 8 --device gpu
  sidecarm train materials materials-set --out my-materials --resume
  sidecarm train materials materials-set --out everything --sibling without-chest --sibling without-pelvis

Written after every epoch: NAME.safetensors (weights) and NAME.json (its card), NAME.csv (losses), NAME.checkpoint (from where --resume goes on); at
the end NAME.svg, and in the card the errors on what was held out, beside those of thresholding. Without --hold-out a tenth of the phantoms is held
out and chooses the epoch that is kept; with it the last one is, and with --patience as well the one that is best on a tenth of the phantoms. On one
device a resumed training gives bit for bit what an uninterrupted one gives.")]
struct TrainMaterialsArgs {
    #[command(flatten)]
    common: CommonArgs,
    /// Epochs
    #[arg(long, value_name = "N", default_value_t = MaterialsRecipe::default().epochs, conflicts_with = "resume")]
    epochs: usize,
    /// Steps of an epoch
    #[arg(long, value_name = "N", default_value_t = MaterialsRecipe::default().steps, conflicts_with = "resume")]
    steps: usize,
    /// Patches of each pass in a step
    #[arg(long, value_name = "N", default_value_t = MaterialsRecipe::default().batch, conflicts_with = "resume")]
    batch: usize,
    /// Phantoms, drawn for it alone, on which the trained network is judged
    #[arg(long, value_name = "N", default_value_t = MaterialsRecipe::default().fresh_phantoms, conflicts_with = "resume")]
    fresh_phantoms: u64,
    /// A closed surface of a bone, in mm (repeatable): as many phantoms again, most of them with bones of these
    #[arg(long, value_name = "FILE.stl", conflicts_with = "resume")]
    mesh: Vec<PathBuf>,
}

/// What every training is told.
#[derive(Clone, Debug, clap::Args)]
struct CommonArgs {
    /// Folder of the samples, of `sidecarm dataset`
    dataset: PathBuf,
    /// The network, a path without ending
    #[arg(long, value_name = "NAME")]
    out: PathBuf,
    /// Stop at the end of the epoch in which so many minutes are over; --resume goes on
    #[arg(long, value_name = "MINUTES")]
    minutes: Option<f64>,
    /// Seed of all that is drawn: first weights, order, patches, mirroring
    #[arg(long, value_name = "SEED", default_value_t = 1, conflicts_with = "resume")]
    seed: u64,
    /// A specimen that the network is judged by and never trained on [default: a tenth of the samples (of materials: of the phantoms), of the same
    /// kind as the others: that says less of a specimen that is none of them]
    #[arg(long, value_name = "SPECIMEN", conflicts_with = "resume")]
    hold_out: Vec<String>,
    /// Stop once so many epochs have brought nothing better, and keep the best [default: 20, of materials 10; with --hold-out all epochs]. What is held
    /// out by --hold-out has no say in that: a tenth of the other views (of materials: of the phantoms) is kept out of the training as well, and chooses
    #[arg(long, value_name = "EPOCHS", conflicts_with_all = ["sibling", "resume"])]
    patience: Option<usize>,
    /// A network of the same samples and settings that was trained with --hold-out of one specimen (repeat it for each specimen): this one is
    /// trained on everything, and its card has their figures
    #[arg(long, value_name = "NAME", conflicts_with_all = ["hold_out", "resume"])]
    sibling: Vec<PathBuf>,
    /// Its layers, or passes: those chosen here, or those of the paper
    #[arg(long, value_enum, default_value = "default", conflicts_with = "resume")]
    architecture: ArchitectureArg,
    /// Go on from NAME.checkpoint, with the settings it was begun with
    #[arg(long)]
    resume: bool,
    /// Where to train
    #[arg(long, value_enum, default_value = "cpu")]
    device: DeviceArg,
    /// Print the card
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum ArchitectureArg {
    Default,
    Paper,
}

/// Why there is no network.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// Samples, settings or files.
    #[error(transparent)]
    Learn(#[from] LearnError),
    /// Nothing to go on from.
    #[error("{}: is not there, so there is nothing to go on from; leave out --resume", path.display())]
    Nothing {
        /// The checkpoint.
        path: PathBuf,
    },
    /// A network of that name.
    #[error("{}: is there already; --resume goes on with it, another --out begins anew", path.display())]
    Exists {
        /// Its weights, or its checkpoint.
        path: PathBuf,
    },
    /// The device.
    #[error(transparent)]
    Device(#[from] GpuError),
    /// The drawing of the losses.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// Its file.
    #[error(transparent)]
    File(#[from] ImageFileError),
}

/// Trains; 0 on success.
///
/// # Errors
/// When samples or settings cannot be used, a file cannot be written, or the training diverges.
pub fn run(args: &TrainArgs, reporter: &Reporter) -> Result<u8, TrainError> {
    match &args.of {
        TrainOf::Scatter(args) => scatter(args, reporter),
        TrainOf::Materials(args) => materials(args, reporter),
    }
}

fn scatter(args: &TrainScatterArgs, reporter: &Reporter) -> Result<u8, TrainError> {
    let TrainScatterArgs { common, epochs } = args;
    let options = common.options(reporter, |hold_out| {
        let standard = Recipe::of(match common.architecture {
            ArchitectureArg::Default => Architecture::Default,
            ArchitectureArg::Paper => Architecture::Paper,
        });
        let hold_out = hold_out.unwrap_or(standard.hold_out);
        let (patience, set_aside) = (common.patience.or(standard.patience), common.set_aside());
        Recipe { seed: common.seed, epochs: *epochs, hold_out, patience, set_aside, ..standard }
    })?;
    let judges = judges(options.recipe.set_aside);
    let trained = followed((common.minutes, judges), reporter, |told| train(&options, told))?;
    draw(&trained, "Scatter network: loss by epoch", "normalised squared error", &format!("{judges}, noise taken off"))?;
    let Card { judged_by, held_out, .. } = &trained.card;
    say(&trained, (options.recipe.epochs, common.json), (judged_by, held_out), reporter);
    Ok(0)
}

fn materials(args: &TrainMaterialsArgs, reporter: &Reporter) -> Result<u8, TrainError> {
    let &TrainMaterialsArgs { ref common, epochs, steps, batch, fresh_phantoms, ref mesh } = args;
    let options = common.options(reporter, |hold_out| {
        let materials = match common.architecture {
            ArchitectureArg::Default => MaterialsArchitecture::Default,
            ArchitectureArg::Paper => MaterialsArchitecture::Paper,
        };
        let standard = MaterialsRecipe::default();
        let hold_out = hold_out.unwrap_or(standard.hold_out);
        let (patience, set_aside) = (common.patience.or(standard.patience), common.set_aside());
        MaterialsRecipe {
            materials,
            seed: common.seed,
            epochs,
            steps,
            batch,
            hold_out,
            set_aside,
            patience,
            fresh_phantoms,
            meshes: mesh.iter().map(|path| absolute(path)).collect(),
            ..standard
        }
    })?;
    let judges = judges(options.recipe.set_aside);
    let trained = followed((common.minutes, judges), reporter, |told| train_materials(&options, told))?;
    draw(&trained, "Materials network: loss by epoch", "1 - Dice, cross-entropy", judges)?;
    let MaterialsCard { judged_by, held_out, .. } = &trained.card;
    say(&trained, (options.recipe.epochs, common.json), (judged_by, held_out), reporter);
    Ok(0)
}

/// A path as it is found from any folder: a training may go on from another one.
fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

/// What the epochs are judged by, in a word.
fn judges(set_aside: f64) -> &'static str {
    if set_aside > 0.0 { "set aside" } else { "held out" }
}

impl CommonArgs {
    /// The share that chooses the epoch where a specimen is held out, which must not.
    fn set_aside(&self) -> f64 {
        if self.patience.is_some() && !self.hold_out.is_empty() { SET_ASIDE } else { 0.0 }
    }

    /// The training that was interrupted, or a new one with the recipe `begun`, which is told what to hold out where anybody says it.
    fn options<R: AnyRecipe>(
        &self,
        reporter: &Reporter,
        begun: impl FnOnce(Option<HoldOut>) -> R,
    ) -> Result<TrainOptions<R>, TrainError> {
        let files = TrainFiles::of(&self.out);
        let (recipe, siblings) = if self.resume {
            recipe_of_checkpoint(&self.out)?.ok_or(TrainError::Nothing { path: files.checkpoint })?
        } else {
            if let Some(path) = [files.network.weights, files.checkpoint].into_iter().find(|path| path.exists()) {
                return Err(TrainError::Exists { path });
            }
            let hold_out = match self.hold_out.as_slice() {
                [] if !self.sibling.is_empty() => Some(HoldOut::Nothing),
                [] => None,
                names => Some(HoldOut::Specimens { names: names.to_vec() }),
            };
            (begun(hold_out), self.sibling.iter().map(|path| absolute(path)).collect())
        };
        let device = match (NetworkDevice::of(&Device::open(self.device.into(), reporter)?), self.device) {
            (Err(error), DeviceArg::Auto) => {
                reporter.note(format_args!("{error}"));
                NetworkDevice::default()
            }
            (opened, _) => opened?,
        };
        reporter.note(format_args!("training on {}", device.name));
        let options = TrainOptions::new(self.dataset.clone(), self.out.clone(), recipe);
        Ok(TrainOptions { resume: self.resume, siblings, device, ..options })
    }
}

/// Runs a training with a bar and a line for every epoch, which says what `judges` it, until it ends or `minutes` are over.
fn followed<T>(
    (minutes, judges): (Option<f64>, &str),
    reporter: &Reporter,
    train: impl FnOnce(&mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>) -> Result<T, LearnError>,
) -> Result<T, LearnError> {
    let watch = Stopwatch::start();
    let bar = reporter.progress("steps", 0);
    let mut first = true;
    train(&mut |progress: &Progress<'_>| {
        if first {
            bar.lengthen((progress.steps * progress.epochs) as u64);
            bar.advance((progress.steps * (progress.epoch - 1)) as u64);
            first = false;
        }
        bar.advance(1);
        if let Some(record) = progress.done {
            reporter.note(format_args!("{}", line(record, progress, judges)));
        }
        match minutes {
            Some(minutes) if progress.done.is_some() && !(watch.ms() < 60e3 * minutes) => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        }
    })
}

/// Says what came of a training of at most `epochs`, as its card with `--json`.
fn say<C: serde::Serialize, F>(
    trained: &Trained<C, F>,
    (epochs, json): (usize, bool),
    (judged_by, held_out): (&JudgedBy, &BTreeMap<String, f64>),
    reporter: &Reporter,
) {
    let done = trained.history.len();
    match trained.end {
        TrainingEnd::ByCaller => {
            reporter.note(format_args!("stopped by --minutes after {done} of {epochs} epochs: --resume goes on"));
        }
        TrainingEnd::NoBetter => {
            let best = trained.epoch;
            reporter
                .note(format_args!("stopped after {done} of {epochs} epochs: none was better than epoch {best} (--patience)"));
        }
        TrainingEnd::Complete => {}
    }
    if json {
        println!("{}", serde_json::to_string_pretty(&trained.card).expect("plain data"));
        return;
    }
    let figures: Vec<String> = held_out.iter().map(|(name, value)| format!("{name} {value:.4}")).collect();
    let judged = match judged_by {
        _ if !figures.is_empty() => figures.join(", "),
        JudgedBy::Nothing => "nothing was held out".to_owned(),
        _ => "its figures come at the end of the training".to_owned(),
    };
    println!("{}: epoch {} of {}; {judged}", trained.files.network.weights.display(), trained.epoch, trained.history.len());
}

fn line(record: &EpochRecord, progress: &Progress, judges: &str) -> String {
    let held_out = record.held_out.map_or(String::new(), |nmse| format!(", {judges} {nmse:.4}"));
    let best = if progress.best { " (the best so far)" } else { "" };
    format!("epoch {} of {}: loss {:.4}{held_out}{best}", record.epoch, progress.epochs, record.train_loss)
}

/// Losses by epoch, beside the table.
fn draw<C, F>(trained: &Trained<C, F>, title: &str, loss: &str, held_out: &str) -> Result<(), TrainError> {
    let curve = |label: &str, value: &dyn Fn(&EpochRecord) -> f64| Series {
        label: label.to_owned(),
        points: trained.history.iter().map(|record| [record.epoch as f64, value(record)]).collect(),
        ..Series::default()
    };
    let plot = Plot {
        title: title.to_owned(),
        x: Axis::new("epoch", Scale::Linear),
        y: Axis::new(loss, Scale::Log),
        series: vec![
            curve("trained on", &|record| record.train_loss),
            curve(held_out, &|record| record.held_out.unwrap_or(f64::NAN)),
        ],
        ..Plot::default()
    };
    let drawing = plot.svg()?;
    Ok(write_atomically(&trained.files.history.with_extension("svg"), |file| file.write_all(drawing.as_bytes()))?)
}

//! `sidecarm train`: networks from their samples.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::PathBuf;

use crate::image::plot::{Axis, Plot, PlotError, Scale, Series};
use crate::image::{ImageFileError, write_atomically};
use crate::infer::Architecture;
use crate::infer::materials::MaterialsArchitecture;
use crate::learn::materials::{MaterialsRecipe, train_materials};
use crate::learn::{
    EpochRecord, HoldOut, LearnError, Progress, Recipe, TrainFiles, TrainOptions, Trained, TrainingEnd, recipe_of_checkpoint,
    train,
};
use crate::reporter::Reporter;
use crate::time::Stopwatch;

/// Train a network on the samples of `sidecarm dataset`.
#[derive(Clone, Debug, clap::Args)]
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
  sidecarm train scatter scatter-set --out my-scatter --resume
  sidecarm train scatter scatter-set --out everything --sibling without-chest --sibling without-pelvis

Written after every epoch: NAME.safetensors (weights) and NAME.json (its card: what it takes, what it was trained on, how good it is on what
it was not), NAME.csv (losses), NAME.checkpoint (from where --resume goes on); at the end NAME.svg. Without --hold-out the epoch that is best
on the tenth is kept, so its figure there is a little too good; with it the last one is. A resumed training gives bit for bit what an uninterrupted one gives.")]
struct TrainScatterArgs {
    /// Folder of the samples
    dataset: PathBuf,
    /// The network, a path without ending
    #[arg(long, value_name = "NAME")]
    out: PathBuf,
    /// Passes over the samples
    #[arg(long, value_name = "N", default_value_t = 60, conflicts_with = "resume")]
    epochs: usize,
    /// Stop at the end of the epoch in which so many minutes are over; --resume goes on
    #[arg(long, value_name = "MINUTES")]
    minutes: Option<f64>,
    /// Seed of first weights, order and mirroring
    #[arg(long, value_name = "SEED", default_value_t = 1, conflicts_with = "resume")]
    seed: u64,
    /// A specimen that the network is judged by and never trained on [default: a tenth of the samples, of the same specimens as the others: that
    /// says less of a specimen that is none of them]
    #[arg(long, value_name = "SPECIMEN", conflicts_with = "resume")]
    hold_out: Vec<String>,
    /// A network of the same samples and layers that was trained with --hold-out of one specimen (repeat it for each specimen): this one is
    /// trained on everything, and its card has their figures
    #[arg(long, value_name = "NAME", conflicts_with_all = ["hold_out", "resume"])]
    sibling: Vec<PathBuf>,
    /// Its layers: few wide ones at low resolution, or those of the paper
    #[arg(long, value_enum, default_value = "default", conflicts_with = "resume")]
    architecture: ArchitectureArg,
    /// Go on from NAME.checkpoint, with the settings it was begun with
    #[arg(long)]
    resume: bool,
    /// Print the card
    #[arg(long)]
    json: bool,
}

/// A network that says what of a CT is bone.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm train materials materials-set --out my-materials --hold-out chest --minutes 60
  sidecarm train materials materials-set --out my-materials --resume
  sidecarm train materials materials-set --out everything --sibling without-chest --sibling without-pelvis

Written after every epoch: NAME.safetensors (weights) and NAME.json (its card), NAME.csv (losses), NAME.checkpoint (from where --resume goes on); at
the end NAME.svg, and in the card the errors on what was held out, beside those of thresholding. Without --hold-out a tenth of the phantoms is held
out and chooses the epoch that is kept; with it the last one is. A resumed training gives bit for bit what an uninterrupted one gives.")]
struct TrainMaterialsArgs {
    /// Folder of the specimens, of `sidecarm dataset materials`
    dataset: PathBuf,
    /// The network, a path without ending
    #[arg(long, value_name = "NAME")]
    out: PathBuf,
    /// Epochs
    #[arg(long, value_name = "N", default_value_t = MaterialsRecipe::default().epochs, conflicts_with = "resume")]
    epochs: usize,
    /// Steps of an epoch
    #[arg(long, value_name = "N", default_value_t = MaterialsRecipe::default().steps, conflicts_with = "resume")]
    steps: usize,
    /// Patches of each pass in a step
    #[arg(long, value_name = "N", default_value_t = MaterialsRecipe::default().batch, conflicts_with = "resume")]
    batch: usize,
    /// Stop at the end of the epoch in which so many minutes are over; --resume goes on
    #[arg(long, value_name = "MINUTES")]
    minutes: Option<f64>,
    /// Seed of first weights and patches
    #[arg(long, value_name = "SEED", default_value_t = 1, conflicts_with = "resume")]
    seed: u64,
    /// A specimen that the network is judged by and never trained on
    #[arg(long, value_name = "SPECIMEN", conflicts_with = "resume")]
    hold_out: Vec<String>,
    /// A network of the same specimens and settings that was trained with --hold-out of one of them (repeat it for each): this one is trained on
    /// everything, and its card has their figures
    #[arg(long, value_name = "NAME", conflicts_with_all = ["hold_out", "resume"])]
    sibling: Vec<PathBuf>,
    /// Its passes: coarse, then fine where bone is, or the one of the paper
    #[arg(long, value_enum, default_value = "default", conflicts_with = "resume")]
    architecture: ArchitectureArg,
    /// Go on from NAME.checkpoint, with the settings it was begun with
    #[arg(long)]
    resume: bool,
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
    let (recipe, siblings) = recipe(args)?;
    let epochs = recipe.epochs;
    let options = TrainOptions { dataset: args.dataset.clone(), output: args.out.clone(), resume: args.resume, siblings, recipe };
    let trained = followed(args.minutes, reporter, |told| train(&options, told))?;
    draw(&trained, "Scatter network: loss by epoch", "normalised squared error", "held out, noise taken off")?;
    let card = &trained.card;
    say(&trained, (epochs, args.json), &card.held_out, &serde_json::to_value(card).expect("plain data"), reporter);
    Ok(0)
}

fn materials(args: &TrainMaterialsArgs, reporter: &Reporter) -> Result<u8, TrainError> {
    let files = TrainFiles::of(&args.out);
    let (recipe, siblings) = if args.resume {
        recipe_of_checkpoint(&args.out)?.ok_or(TrainError::Nothing { path: files.checkpoint })?
    } else {
        refuse_present(&files)?;
        let hold_out = held_out(&args.hold_out, &args.sibling, MaterialsRecipe::default().hold_out);
        let materials = match args.architecture {
            ArchitectureArg::Default => MaterialsArchitecture::Default,
            ArchitectureArg::Paper => MaterialsArchitecture::Paper,
        };
        let &TrainMaterialsArgs { seed, epochs, steps, batch, .. } = args;
        let recipe = MaterialsRecipe { materials, seed, epochs, steps, batch, hold_out, ..MaterialsRecipe::default() };
        (recipe, absolute(&args.sibling))
    };
    let epochs = recipe.epochs;
    let options = TrainOptions { dataset: args.dataset.clone(), output: args.out.clone(), resume: args.resume, siblings, recipe };
    let trained = followed(args.minutes, reporter, |told| train_materials(&options, told))?;
    draw(&trained, "Materials network: loss by epoch", "1 - Dice", "held out")?;
    let card = &trained.card;
    say(&trained, (epochs, args.json), &card.held_out, &serde_json::to_value(card).expect("plain data"), reporter);
    Ok(0)
}

/// Runs a training with a bar and a line for every epoch, until it ends or `minutes` are over.
fn followed<T>(
    minutes: Option<f64>,
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
            reporter.note(format_args!("{}", line(record, progress)));
        }
        match minutes {
            Some(minutes) if progress.done.is_some() && !(watch.ms() < 60e3 * minutes) => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        }
    })
}

/// Says what came of a training of at most `epochs`, as its card with `--json`.
fn say<C, F>(
    trained: &Trained<C, F>,
    (epochs, json): (usize, bool),
    held_out: &BTreeMap<String, f64>,
    card: &serde_json::Value,
    reporter: &Reporter,
) {
    if trained.end == TrainingEnd::ByCaller {
        let done = trained.history.len();
        reporter.note(format_args!("stopped by --minutes after {done} of {epochs} epochs: --resume goes on"));
    }
    if json {
        println!("{}", serde_json::to_string_pretty(card).expect("plain data"));
        return;
    }
    let figures: Vec<String> = held_out.iter().map(|(name, value)| format!("{name} {value:.4}")).collect();
    let judged = if figures.is_empty() { "nothing was held out".to_owned() } else { figures.join(", ") };
    println!("{}: epoch {} of {}; {judged}", trained.files.network.weights.display(), trained.epoch, trained.history.len());
}

/// A training may go on from another folder.
fn absolute(paths: &[PathBuf]) -> Vec<PathBuf> {
    paths.iter().map(|path| std::path::absolute(path).unwrap_or_else(|_| path.clone())).collect()
}

fn refuse_present(files: &TrainFiles) -> Result<(), TrainError> {
    let there = [&files.network.weights, &files.checkpoint].into_iter().find(|path| path.exists());
    there.map_or(Ok(()), |path| Err(TrainError::Exists { path: path.clone() }))
}

fn held_out(names: &[String], siblings: &[PathBuf], standard: HoldOut) -> HoldOut {
    match names {
        [] if !siblings.is_empty() => HoldOut::Nothing,
        [] => standard,
        names => HoldOut::Specimens { names: names.to_vec() },
    }
}

fn recipe(args: &TrainScatterArgs) -> Result<(Recipe, Vec<PathBuf>), TrainError> {
    let files = TrainFiles::of(&args.out);
    if args.resume {
        let found = recipe_of_checkpoint(&args.out)?;
        return found.ok_or(TrainError::Nothing { path: files.checkpoint });
    }
    refuse_present(&files)?;
    let standard = Recipe::of(match args.architecture {
        ArchitectureArg::Default => Architecture::Default,
        ArchitectureArg::Paper => Architecture::Paper,
    });
    let hold_out = held_out(&args.hold_out, &args.sibling, standard.hold_out.clone());
    Ok((Recipe { seed: args.seed, epochs: args.epochs, hold_out, ..standard }, absolute(&args.sibling)))
}

fn line(record: &EpochRecord, progress: &Progress) -> String {
    let held_out = record.held_out.map_or(String::new(), |nmse| format!(", held out {nmse:.4}"));
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

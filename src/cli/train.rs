//! `sidecarm train`: networks from their samples.

use std::ops::ControlFlow;
use std::path::PathBuf;

use crate::image::plot::{Axis, Plot, PlotError, Scale, Series};
use crate::image::{ImageFileError, write_atomically};
use crate::infer::Architecture;
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
    let TrainOf::Scatter(args) = &args.of;
    let (recipe, siblings) = recipe(args)?;
    let options = TrainOptions { dataset: args.dataset.clone(), output: args.out.clone(), resume: args.resume, siblings, recipe };
    let watch = Stopwatch::start();
    let bar = reporter.progress("steps", 0);
    let mut first = true;
    let mut told = |progress: &Progress| {
        if first {
            bar.lengthen((progress.steps * progress.epochs) as u64);
            bar.advance((progress.steps * (progress.epoch - 1)) as u64);
            first = false;
        }
        bar.advance(1);
        if let Some(record) = progress.done {
            reporter.note(format_args!("{}", line(record, progress)));
        }
        match args.minutes {
            Some(minutes) if progress.done.is_some() && !(watch.ms() < 60e3 * minutes) => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        }
    };
    let trained = train(&options, &mut told)?;
    drop(bar);
    draw(&trained)?;
    if trained.end == TrainingEnd::ByCaller {
        let (done, all) = (trained.history.len(), options.recipe.epochs);
        reporter.note(format_args!("stopped by --minutes after {done} of {all} epochs: --resume goes on"));
    }
    let card = &trained.card;
    if args.json {
        println!("{}", serde_json::to_string_pretty(card).expect("plain data"));
    } else {
        let figures: Vec<String> = card.held_out.iter().map(|(name, value)| format!("{name} {value:.4}")).collect();
        let judged = if figures.is_empty() { "nothing was held out".to_owned() } else { figures.join(", ") };
        println!("{}: epoch {} of {}; {judged}", trained.files.network.weights.display(), trained.epoch, trained.history.len());
    }
    Ok(0)
}

fn recipe(args: &TrainScatterArgs) -> Result<(Recipe, Vec<PathBuf>), TrainError> {
    let files = TrainFiles::of(&args.out);
    if args.resume {
        let found = recipe_of_checkpoint(&args.out)?;
        return found.ok_or(TrainError::Nothing { path: files.checkpoint });
    }
    if let Some(path) = [files.network.weights, files.checkpoint].into_iter().find(|path| path.exists()) {
        return Err(TrainError::Exists { path });
    }
    // A training may go on from another folder.
    let siblings = args.sibling.iter().map(|path| std::path::absolute(path).unwrap_or_else(|_| path.clone())).collect();
    let standard = Recipe::of(match args.architecture {
        ArchitectureArg::Default => Architecture::Default,
        ArchitectureArg::Paper => Architecture::Paper,
    });
    let hold_out = match args.hold_out.as_slice() {
        [] if !args.sibling.is_empty() => HoldOut::Nothing,
        [] => standard.hold_out.clone(),
        names => HoldOut::Specimens { names: names.to_vec() },
    };
    Ok((Recipe { seed: args.seed, epochs: args.epochs, hold_out, ..standard }, siblings))
}

fn line(record: &EpochRecord, progress: &Progress) -> String {
    let held_out = record.held_out_nmse.map_or(String::new(), |nmse| format!(", held out {nmse:.4}"));
    let best = if progress.best { " (the best so far)" } else { "" };
    format!("epoch {} of {}: loss {:.4}{held_out}{best}", record.epoch, progress.epochs, record.train_loss)
}

/// Losses by epoch, beside the table.
fn draw(trained: &Trained) -> Result<(), TrainError> {
    let curve = |label: &str, value: &dyn Fn(&EpochRecord) -> f64| Series {
        label: label.to_owned(),
        points: trained.history.iter().map(|record| [record.epoch as f64, value(record)]).collect(),
        ..Series::default()
    };
    let plot = Plot {
        title: "Scatter network: loss by epoch".to_owned(),
        x: Axis::new("epoch", Scale::Linear),
        y: Axis::new("normalised squared error", Scale::Log),
        series: vec![
            curve("trained on, noise included", &|record| record.train_loss),
            curve("held out, noise taken off", &|record| record.held_out_nmse.unwrap_or(f64::NAN)),
        ],
        ..Plot::default()
    };
    let drawing = plot.svg()?;
    Ok(write_atomically(&trained.files.history.with_extension("svg"), |file| file.write_all(drawing.as_bytes()))?)
}

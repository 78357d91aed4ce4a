//! `sidecarm dataset`: what networks are trained on.

use std::path::PathBuf;

use crate::image::{ImageFileError, sha256_file};
use crate::infer::{CELL_COLUMNS, CELL_ROWS, COLUMNS, ROWS};
use crate::learn::{Shard, ShardError, Specimen, drawn};
use crate::reporter::Reporter;
use crate::scene::{self, SceneError};
use crate::transport::{BATCH, CHANNELS, Columns, Histories, Page, SCALARS, Simulation, TransportError};

/// Columns and rows of what a network is told, and of what it says.
const GRID_PX: [usize; 2] = [COLUMNS, ROWS];
const TRUTH_PX: [usize; 2] = [CELL_COLUMNS, CELL_ROWS];
/// Samples of one file.
const SAMPLES: u64 = 50;
/// What a sample without a specimen is called.
const PHANTOM: &str = "phantom";
/// Batches of photons from which a spread can be told.
const LEAST_BATCHES: u64 = 4;
/// Matter lower above the detector than this is through it.
const LOWEST_MM: f32 = 10.0;
/// Mean thickness of what scatters in the open field below which the specimen is not in view.
const IN_VIEW: f64 = 0.15;
/// Median relative standard error beyond which a sample says nothing.
const NOISIEST: f64 = 0.5;

/// Make the samples that a network is trained on.
#[derive(Clone, Debug, clap::Args)]
pub struct DatasetArgs {
    #[command(subcommand)]
    of: DatasetOf,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum DatasetOf {
    Scatter(ScatterSetArgs),
}

/// Drawn scenes around specimens and phantoms, each with what its rays meet and the scatter that a Monte Carlo finds.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm dataset scatter pelvis.json chest.json --count 3000 --out scatter-set
  sidecarm dataset scatter --phantoms 1 --count 1000 --first-seed 100000 --out scatter-set

Of each scene only the objects are taken; view, beam, field, grid, detector, tools and table are drawn. The files of 50 samples each,
scatter-SEED.safetensors, hold inputs [samples, 9, 48, 64], scalars, scale, truth [samples, 2, 12, 16] (scattered once, more often, in units
of the unattenuated signal without heel and bow-tie) and truth_error (of both, and of their sum); every sample is that of its seed. Files that
are there already are kept: the same command, with the same or a larger --count, goes on.")]
pub struct ScatterSetArgs {
    /// Scenes whose objects are the specimens, named by their files
    #[arg(value_name = "SCENE.json")]
    scenes: Vec<PathBuf>,
    /// Where the files go
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Samples
    #[arg(long, value_name = "N", default_value_t = 2000)]
    count: u64,
    /// Seed of the first; a multiple of 50
    #[arg(long, value_name = "SEED", default_value_t = 0)]
    first_seed: u64,
    /// Photons that are followed for each
    #[arg(long, value_name = "N", default_value_t = 200_000)]
    histories: u64,
    /// Share of phantoms among the samples
    #[arg(long, value_name = "SHARE", default_value_t = 0.4)]
    phantoms: f64,
}

/// Why there are no samples.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// A scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The transport.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A material.
    #[error(transparent)]
    Physics(#[from] crate::scene::physics::PhysicsError),
    /// A file of samples.
    #[error(transparent)]
    Shard(#[from] ShardError),
    /// A scene's file.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// The folder.
    #[error("{}: {source}", path.display())]
    Io {
        /// It.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nothing to draw.
    #[error("{0}")]
    Arguments(String),
}

/// Makes what is asked for; 0 on success.
///
/// # Errors
/// When a scene is wrong, or a file cannot be written.
pub fn run(args: &DatasetArgs, reporter: &Reporter) -> Result<u8, DatasetError> {
    let DatasetOf::Scatter(args) = &args.of;
    let wrong = |what: String| Err(DatasetError::Arguments(what));
    if !(0.0..=1.0).contains(&args.phantoms) {
        return wrong(format!("--phantoms {}: expected a share from 0 to 1", args.phantoms));
    }
    if args.scenes.is_empty() && args.phantoms < 1.0 {
        return wrong("no scene, so nothing but phantoms can be drawn: give SCENE.json, or --phantoms 1".to_owned());
    }
    if !args.first_seed.is_multiple_of(SAMPLES) {
        return wrong(format!("--first-seed {}: expected a multiple of {SAMPLES}", args.first_seed));
    }
    if args.histories < LEAST_BATCHES * BATCH {
        return wrong(format!("--histories {}: expected at least {}", args.histories, LEAST_BATCHES * BATCH));
    }
    let Some(end) = args.first_seed.checked_add(args.count) else {
        return wrong(format!("--first-seed {}: there are no {} seeds after it", args.first_seed, args.count));
    };
    let mut specimens: Vec<Specimen> = Vec::new();
    let mut hashes = Vec::new();
    for path in &args.scenes {
        let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        if name == PHANTOM || specimens.iter().any(|known| known.name == name) {
            return wrong(format!(
                "{}: another specimen is called {name}; specimens are told apart by their files' names",
                path.display()
            ));
        }
        let scene = scene::load(path, false, reporter)?;
        hashes.push(sha256_file(path)?);
        hashes.extend(scene.inputs.iter().map(|input| input.sha256.clone()));
        let Some(specimen) = Specimen::new(&name, &scene) else {
            return wrong(format!("{}: has no matter to scatter", path.display()));
        };
        specimens.push(specimen);
    }
    let version = env!("CARGO_PKG_VERSION");
    let made = serde_json::json!({"histories": args.histories, "phantoms": args.phantoms, "sha256": hashes, "version": version});
    std::fs::create_dir_all(&args.out).map_err(|source| DatasetError::Io { path: args.out.clone(), source })?;
    let progress = reporter.progress("samples", args.count);
    let mut counts = Counts::default();
    for first in (args.first_seed..end).step_by(SAMPLES as usize) {
        let path = args.out.join(format!("scatter-{first:09}.safetensors"));
        let last = (first + SAMPLES).min(end);
        let mut shard = Shard {
            channels: CHANNELS.map(str::to_owned).to_vec(),
            scalar_names: SCALARS.map(str::to_owned).to_vec(),
            grid_px: GRID_PX,
            truth_px: TRUTH_PX,
            asked: vec![first, last],
            origin: made.to_string(),
            ..Shard::default()
        };
        if path.is_file() {
            let there = Shard::read(&path)?;
            if there.origin != shard.origin {
                let (there, here) = (there.origin, shard.origin);
                return wrong(format!("{}: was made otherwise ({there}, now {here}); take another folder", path.display()));
            }
            // A file that was asked for fewer seeds is made again.
            if there.asked.last() >= Some(&last) {
                counts.kept += there.seeds.len();
                progress.advance(last - first);
                continue;
            }
        }
        for seed in first..last {
            sample(args, &specimens, seed, &mut shard, &mut counts)?;
            progress.advance(1);
        }
        shard.write(&path)?;
    }
    drop(progress);
    let Counts { kept, not_in_view, too_noisy } = counts;
    if kept == 0 {
        return wrong(format!(
            "of {} drawn scenes {not_in_view} had no specimen in view and {too_noisy} too few photons for a word about scatter: nothing is left; \
             more --histories, or another specimen",
            args.count
        ));
    }
    println!("{}: {kept} samples; {not_in_view} more had no specimen in view, {too_noisy} too few photons", args.out.display());
    Ok(0)
}

/// What became of the seeds.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    kept: usize,
    not_in_view: usize,
    too_noisy: usize,
}

/// Adds the sample of `seed`, unless there is nothing in view.
fn sample(
    args: &ScatterSetArgs,
    specimens: &[Specimen],
    seed: u64,
    shard: &mut Shard,
    counts: &mut Counts,
) -> Result<(), DatasetError> {
    let turn = |times: f64| (seed as f64 * times).fract();
    // Evenly over the seeds, whatever their number.
    let is_phantom = specimens.is_empty() || turn(0.618_033_988_749_895) < args.phantoms;
    let specimen = (!is_phantom).then(|| &specimens[(turn(0.754_877_666_246_693) * specimens.len() as f64) as usize]);
    let (scene, view) = drawn(specimen, seed)?;
    let asked = Histories { count: args.histories, seed, grid_px: TRUTH_PX, ..Histories::default() };
    let simulation = Simulation::new(&scene, &view, asked)?;
    let columns = simulation.columns(GRID_PX);
    if !(scattering(&columns) > IN_VIEW) || reaches_the_panel(&columns) {
        counts.not_in_view += 1;
        return Ok(());
    }
    let mut tally = simulation.tally();
    let run = simulation.run(&mut tally, |_| Ok::<(), std::convert::Infallible>(()));
    let Ok(()) = run;
    if !(simulation.relative_error(&tally) < NOISIEST) {
        counts.too_noisy += 1;
        return Ok(());
    }
    let cells = 0..TRUTH_PX[0] * TRUTH_PX[1];
    let unit = simulation.unshaped();
    let signal = |page: Page, cell: usize| tally.signal(page, cell, BATCH);
    for cell in cells.clone() {
        let once = signal(Page::Compton, cell).mean + signal(Page::Rayleigh, cell).mean;
        shard.truth.push((once / unit[cell]) as f32);
    }
    shard.truth.extend(cells.clone().map(|cell| (signal(Page::Multiple, cell).mean / unit[cell]) as f32));
    for cell in cells.clone() {
        let once = signal(Page::Compton, cell).standard_error.hypot(signal(Page::Rayleigh, cell).standard_error);
        shard.truth_error.push((once / unit[cell]) as f32);
    }
    shard.truth_error.extend(cells.clone().map(|cell| (signal(Page::Multiple, cell).standard_error / unit[cell]) as f32));
    shard.truth_error.extend(cells.map(|cell| (tally.scatter(cell, BATCH).standard_error / unit[cell]) as f32));
    columns.channels.iter().for_each(|channel| shard.inputs.extend(channel));
    shard.scalars.extend(columns.scalars);
    shard.scale.push(columns.scale);
    shard.specimens.push(specimen.map_or(PHANTOM, |specimen| &specimen.name).to_owned());
    shard.seeds.push(seed);
    counts.kept += 1;
    Ok(())
}

/// Mean over the open field of the thickness of what scatters.
fn scattering(columns: &Columns) -> f64 {
    let [_, compton, rayleigh, _, _, _, open, ..] = &columns.channels;
    let (mut sum, mut all) = (0.0, 0.0);
    for ((compton, rayleigh), open) in compton.iter().zip(rayleigh).zip(open) {
        sum += f64::from(open * (compton + rayleigh));
        all += f64::from(*open);
    }
    sum / all
}

/// Whether matter that scatters goes on to the detector plane: no C-arm can be so.
fn reaches_the_panel(columns: &Columns) -> bool {
    let [_, compton, _, _, height_mm, spread_mm, ..] = &columns.channels;
    // A slab's half thickness is √3 of its standard deviation.
    let lowest = height_mm.iter().zip(spread_mm).map(|(height_mm, spread_mm)| height_mm - 1.73 * spread_mm);
    lowest.zip(compton).any(|(lowest_mm, compton)| *compton > 0.05 && !(lowest_mm > LOWEST_MM))
}

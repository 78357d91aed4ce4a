//! `sidecarm dataset`: what networks are trained on.

use std::path::PathBuf;

pub use super::dataset_error::DatasetError;
use super::dataset_materials::{MaterialsSetArgs, materials_set};
use crate::image::sha256_file;
use crate::learn::{GRID_PX, LEAST_BATCHES, PHANTOM, Sampled, Sampling, Shard, Specimen, TRUTH_PX, sample};
use crate::reporter::Reporter;
use crate::scene;
use crate::transport::{BATCH, CHANNELS, SCALARS};

/// Samples of one file.
const SAMPLES: u64 = 50;

/// Make the samples that a network is trained on.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm dataset scatter pelvis.json --out set")]
pub struct DatasetArgs {
    #[command(subcommand)]
    of: DatasetOf,
}

#[derive(Clone, Debug, clap::Subcommand)]
enum DatasetOf {
    Scatter(ScatterSetArgs),
    Materials(MaterialsSetArgs),
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

/// Makes what is asked for; 0 on success.
///
/// # Errors
/// When a scene is wrong, or a file cannot be written.
pub fn run(args: &DatasetArgs, reporter: &Reporter) -> Result<u8, DatasetError> {
    match &args.of {
        DatasetOf::Scatter(args) => scatter_set(args, reporter),
        DatasetOf::Materials(args) => materials_set(args, reporter),
    }
}

fn scatter_set(args: &ScatterSetArgs, reporter: &Reporter) -> Result<u8, DatasetError> {
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
    let from = Sampling { specimens: &specimens, phantoms: args.phantoms, histories: args.histories };
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
            match sample(&from, seed, &mut shard)? {
                Sampled::Kept => counts.kept += 1,
                Sampled::NotInView => counts.not_in_view += 1,
                Sampled::TooNoisy => counts.too_noisy += 1,
            }
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

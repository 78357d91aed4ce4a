//! `sidecarm scatter`: primary and scattered radiation of a scene by Monte Carlo.

use std::path::{Path, PathBuf};

use super::render::DeviceArg;
use super::scattered::{LONG_MS, gpu_or_said, lasting, needed};
use crate::gpu::{Device, GpuError, cpu_name};
use crate::image::{ImageFileError, check_writable, refuse_overwrite, sha256_file};
use crate::reporter::Reporter;
use crate::scene::{self, SceneError};
use crate::time::{StageTimes, Stopwatch};
use crate::transport::{
    BATCH, Checkpoint, Estimator, GpuTransport, GpuTransportError, Histories, ScatterImage, Simulation, Tally, TransportError,
    written_with,
};

/// Follow photons through a scene: primary, Compton once, Rayleigh once and multiple scatter on a coarse detector.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm scatter scene.json --histories 1e8 --out scatter.tif
  sidecarm scatter scene.json --histories 1e10 --rel-error 0.01 --out scatter.tif --json

SCATTER.tif has eight pages: primary, compton_once, rayleigh_once, multiple, then their standard errors, in units of the unattenuated
signal. Beside it lies SCATTER.tif.json (energy absorbed, mass and mean dose by material, histories, seed, inputs). While it runs,
SCATTER.tif.checkpoint is kept up to date: the same command goes on from there. Without beam.field in the scene the field is the image.")]
pub struct ScatterArgs {
    /// The scene
    pub scene: PathBuf,
    /// The image, 32-bit float TIFF
    #[arg(long, value_name = "SCATTER.tif")]
    pub out: PathBuf,
    /// Photons to follow (1e8); rounded up to whole batches of 4096, on a GPU to some two or eight million
    #[arg(long, value_name = "N", value_parser = whole)]
    pub histories: u64,
    /// Stop earlier, once the median over the pixels of the scatter's relative standard error is no larger
    #[arg(long, value_name = "REL")]
    pub rel_error: Option<f64>,
    /// Columns and rows of the detector grid
    #[arg(long, value_name = "COLUMNSxROWS", default_value = "64x48", value_parser = grid)]
    pub grid_px: [usize; 2],
    /// Seed of the random numbers [default: the scene's]
    #[arg(long, value_name = "SEED")]
    pub seed: Option<u64>,
    /// Count photons where they arrive, instead of what each would send to the detector on average: slower to converge
    #[arg(long)]
    pub analogue: bool,
    /// What follows them; a GPU has random numbers of its own, so its image agrees with the CPU's within the standard errors
    #[arg(long, value_enum, default_value = "auto")]
    pub device: DeviceArg,
    /// Start anew where an interrupted run left a checkpoint
    #[arg(long)]
    pub fresh: bool,
    /// Keep a checkpoint every so many seconds: an interrupted run loses no more
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, value_parser = seconds)]
    pub checkpoint_s: f64,
    /// Print a summary as JSON
    #[arg(long)]
    pub json: bool,
}

/// A whole number that may be written as 1e8.
fn whole(text: &str) -> Result<u64, String> {
    let number: f64 = text.parse().map_err(|_| format!("'{text}' is no number"))?;
    let is_whole = (1.0..=1e15).contains(&number) && number.fract() == 0.0;
    if is_whole { Ok(number as u64) } else { Err(format!("{text}: expected a whole number from 1 to 1e15")) }
}

/// A time to wait.
fn seconds(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| format!("'{text}' is no number"))?;
    if number >= 0.0 && number.is_finite() { Ok(number) } else { Err(format!("{text}: expected seconds from 0 up")) }
}

/// `64x48`.
fn grid(text: &str) -> Result<[usize; 2], String> {
    let parsed = text.split_once('x').and_then(|(columns, rows)| Some([columns.parse().ok()?, rows.parse().ok()?]));
    parsed.ok_or_else(|| format!("'{text}': expected COLUMNSxROWS, as in 64x48"))
}

/// Why there is no scatter image.
#[derive(Debug, thiserror::Error)]
pub enum ScatterError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The transport.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The device.
    #[error(transparent)]
    Device(#[from] GpuError),
    /// The transport on it.
    #[error(transparent)]
    OnGpu(#[from] GpuTransportError),
    /// An output.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// The scene has no view.
    #[error("{}: has no view; scatter needs to know where the detector is", path.display())]
    NoView {
        /// The scene.
        path: PathBuf,
    },
}

/// Transports and writes; 0 on success.
///
/// # Errors
/// When the scene is wrong, the checkpoint is of another run, or a file cannot be written.
pub fn run(args: &ScatterArgs, reporter: &Reporter) -> Result<u8, ScatterError> {
    check_writable(&args.out)?;
    let scene = scene::load(&args.scene, true, reporter)?;
    let outputs = written_with(&args.out);
    let inputs = scene::input_files(&args.scene, &scene);
    refuse_overwrite(&outputs, &inputs)?;
    let view = scene.view.ok_or_else(|| ScatterError::NoView { path: args.scene.clone() })?;
    let estimator = if args.analogue { Estimator::Analogue } else { Estimator::Expected };
    let seed = args.seed.unwrap_or(scene.model.seed);
    let histories = Histories { count: args.histories, seed, grid_px: args.grid_px, estimator, rel_error: args.rel_error };
    let mut stages = StageTimes::default();
    let simulation = stages.measure("prepare", || Simulation::new(&scene, &view, histories))?;
    let device = Device::open(args.device.into(), reporter)?;
    let mut gpu = stages.measure("upload", || match &device {
        Device::Cpu => Ok(None),
        Device::Gpu(gpu) if args.device == DeviceArg::Auto => Ok(gpu_or_said(gpu, &simulation, reporter)),
        Device::Gpu(gpu) => GpuTransport::new(gpu, &simulation).map(Some),
    })?;
    let adapter = gpu.as_ref().map_or_else(cpu_name, |_| device.name());
    let empty = gpu.as_ref().map_or_else(|| simulation.tally(), GpuTransport::tally);
    let hashes = hashes(&args.scene, &scene)?;
    let [_, _, checkpoint] = &outputs;
    // Of processors any gives the same bits.
    let kept_of = if gpu.is_some() { adapter.as_str() } else { "cpu" };
    let mut tally = match if args.fresh { None } else { Checkpoint::read(checkpoint)? } {
        Some(saved) => {
            let tally = saved.tally_for(&simulation, (kept_of, &empty), &hashes)?;
            reporter.note(format_args!("going on after {} histories of {}", tally.histories(), checkpoint.display()));
            tally
        }
        None => empty,
    };
    let watch = Stopwatch::start();
    let before = tally.histories();
    let write = |tally: &Tally| Checkpoint::new(simulation.histories(), kept_of, &hashes, tally).write(checkpoint);
    let keep = Keep { every_ms: 1e3 * args.checkpoint_s, write: &write };
    transport(&simulation, gpu.as_mut(), &mut tally, &keep, reporter)?;
    stages.add("transport", watch.ms());
    let image = simulation.image(&tally);
    let mut json = simulation.describe(&image, &scene, &adapter);
    if let Some(map) = json.as_object_mut() {
        map.insert("stages_ms".to_owned(), serde_json::json!(stages));
    }
    image.write(&args.out, &json)?;
    if checkpoint.is_file() {
        std::fs::remove_file(checkpoint).map_err(|source| ImageFileError::Io { path: checkpoint.clone(), source })?;
    }
    let per_second = (tally.histories() - before) as f64 / (1e-3 * watch.ms());
    if args.json {
        println!("{}", serde_json::to_string_pretty(&json).expect("plain data"));
    } else {
        println!("{}", line(args, &image, per_second));
    }
    Ok(0)
}

/// How what is there so far is kept on disk.
struct Keep<'a> {
    every_ms: f64,
    write: &'a dyn Fn(&Tally) -> Result<(), TransportError>,
}

/// Runs to the end, keeping what is there so far on disk; what will take long is said after the first step.
fn transport(
    simulation: &Simulation,
    gpu: Option<&mut GpuTransport>,
    tally: &mut Tally,
    keep: &Keep<'_>,
    reporter: &Reporter,
) -> Result<(), ScatterError> {
    let all = gpu.as_ref().map_or(simulation.batches() * BATCH, |gpu| gpu.histories());
    let progress = reporter.progress("histories", all);
    progress.advance(tally.histories());
    let (before, watch, mut is_announced) = (tally.histories(), Stopwatch::start(), false);
    let (mut shown, mut saved) = (before, Stopwatch::start());
    let after = |tally: &Tally| {
        let histories = tally.histories();
        progress.advance(histories - shown);
        shown = histories;
        if !is_announced {
            is_announced = true;
            let precise = |wanted: f64| needed(histories, simulation.relative_error(tally), wanted);
            let end = simulation.histories().rel_error.map_or(f64::INFINITY, precise).min(all as f64);
            let left_ms = watch.ms() * (end - histories as f64) / (histories - before) as f64;
            if left_ms > LONG_MS {
                reporter.note(format_args!("{end:.1e} histories: about {} to go", lasting(left_ms)));
            }
        }
        if saved.ms() > keep.every_ms {
            (keep.write)(tally)?;
            saved = Stopwatch::start();
        }
        Ok::<(), ScatterError>(())
    };
    match gpu {
        Some(gpu) => gpu.run(simulation, tally, after),
        None => simulation.run(tally, after),
    }
}

/// SHA-256 of the scene file and of what it names.
fn hashes(path: &Path, scene: &crate::scene::Scene) -> Result<Vec<String>, ImageFileError> {
    let named = scene.inputs.iter().map(|input| Ok(input.sha256.clone()));
    std::iter::once(sha256_file(path)).chain(named).collect()
}

fn line(args: &ScatterArgs, image: &ScatterImage, per_second: f64) -> String {
    let [columns, rows] = args.grid_px;
    format!(
        "{}: {columns} x {rows} px, {:.3e} histories, scatter to primary {:.3}, median standard error of scatter {:.2} %\n{:.2e} \
         histories per second",
        args.out.display(),
        image.histories as f64,
        image.scatter_to_primary(),
        100.0 * image.relative_error,
        per_second
    )
}

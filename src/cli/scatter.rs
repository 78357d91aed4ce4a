//! `sidecarm scatter`: primary and scattered radiation of a scene by Monte Carlo.

use std::path::PathBuf;

use super::following::{Keep, KeepArgs, Pace, begin, follow, forget, gpu_or_said, hashes, lasting, needed};
use super::render::DeviceArg;
use crate::gpu::{Device, GpuError, cpu_name};
use crate::image::{ImageFileError, check_writable, refuse_overwrite, refuse_twice};
use crate::reporter::Reporter;
use crate::scene::{self, SceneError};
use crate::time::{StageTimes, Stopwatch};
use crate::transport::{
    BATCH, Estimator, GpuTransport, GpuTransportError, Histories, MOST_DOSE_VOXELS, ScatterImage, Simulation, Tally,
    TransportError, dose_files, written_with,
};

/// Follow photons through a scene: primary, Compton once, Rayleigh once and multiple scatter on a coarse detector.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm scatter scene.json --histories 1e8 --out scatter.tif
  sidecarm scatter scene.json --histories 1e10 --rel-error 0.01 --out scatter.tif --json
  sidecarm scatter scene.json --histories 1e8 --out scatter.tif --dose dose.nii.gz

SCATTER.tif has eight pages: primary, compton_once, rayleigh_once, multiple, then their standard errors, in units of the unattenuated
signal; an error is NaN where less came than ten contributions of one size, so that nobody knows it. Beside it lies SCATTER.tif.json
(energy absorbed, mass and mean dose by material, histories, seed, inputs). While it runs, SCATTER.tif.checkpoint is kept up to date: the
same command goes on from there. Without beam.field in the scene the field is the image.
DOSE.nii.gz is in Gy of the exposure that photons_per_pixel asks for, on the grid of the CT, coarser where that has more than half a million
voxels. Beside it lie its standard errors, DOSE.nii.gz.error.nii.gz, and DOSE.nii.gz.json (what a single photon leaves, and where the rest is).")]
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
    /// A map of the dose as well, a NIfTI volume; photons are then followed on the processor
    #[arg(long, value_name = "DOSE.nii.gz", value_parser = volume_name)]
    pub dose: Option<PathBuf>,
    #[command(flatten)]
    pub keep: KeepArgs,
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

/// A name for a NIfTI volume.
fn volume_name(text: &str) -> Result<PathBuf, String> {
    let is_volume = [".nii", ".nii.gz"].iter().any(|ending| text.to_lowercase().ends_with(ending));
    if is_volume { Ok(PathBuf::from(text)) } else { Err(format!("'{text}': expected a name that ends in .nii or .nii.gz")) }
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
    /// A dose of nothing.
    #[error("--dose: the scene holds no matter, so that there is no dose")]
    NoMatter,
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
    for output in std::iter::once(&args.out).chain(&args.dose) {
        check_writable(output)?;
    }
    let scene = scene::load(&args.scene, true, reporter)?;
    let [.., checkpoint] = written_with(&args.out);
    let outputs: Vec<PathBuf> =
        written_with(&args.out).into_iter().chain(args.dose.iter().flat_map(|path| dose_files(path))).collect();
    refuse_twice(&outputs)?;
    refuse_overwrite(&outputs, &scene::input_files(&args.scene, &scene))?;
    let view = scene.view.ok_or_else(|| ScatterError::NoView { path: args.scene.clone() })?;
    let estimator = if args.analogue { Estimator::Analogue } else { Estimator::Expected };
    let seed = args.seed.unwrap_or(scene.model.seed);
    let histories = Histories { count: args.histories, seed, grid_px: args.grid_px, estimator, rel_error: args.rel_error };
    let mut stages = StageTimes::default();
    let mut simulation = stages.measure("prepare", || Simulation::new(&scene, &view, histories))?;
    if args.dose.is_some() {
        simulation = simulation.with_dose(&scene, MOST_DOSE_VOXELS);
        // Hours later nobody wants to hear it.
        simulation.tally().dose_voxels().ok_or(ScatterError::NoMatter)?;
    }
    let device = Device::open(args.device.into(), reporter)?;
    let mut gpu = stages.measure("upload", || match &device {
        Device::Cpu => Ok(None),
        Device::Gpu(gpu) if args.device == DeviceArg::Auto => Ok(gpu_or_said(gpu, &simulation, reporter)),
        Device::Gpu(gpu) => GpuTransport::new(gpu, &simulation).map(Some),
    })?;
    let adapter = gpu.as_ref().map_or_else(cpu_name, |_| device.name());
    let hashes = hashes(&args.scene, &scene)?;
    let keep = Keep { path: &checkpoint, args: args.keep, inputs: &hashes };
    let mut tally = begin(&simulation, gpu.as_ref(), Some(&keep), reporter)?;
    let watch = Stopwatch::start();
    let before = tally.histories();
    transport(&simulation, gpu.as_mut(), &mut tally, &keep, reporter)?;
    stages.add("transport", watch.ms());
    let per_second = (tally.histories() - before) as f64 / (1e-3 * watch.ms());
    let dose = args.dose.as_ref().map(|path| {
        let map = stages.measure("dose", || simulation.dose_map(&tally)).ok_or(ScatterError::NoMatter)?;
        Ok::<_, ScatterError>((path, map.write(path, &scene, (&simulation, &tally, adapter.as_str()))?))
    });
    let dose = dose.transpose()?;
    let image = simulation.image(&tally);
    let mut json = simulation.describe(&image, &scene, &adapter);
    if let Some(map) = json.as_object_mut() {
        map.insert("stages_ms".to_owned(), serde_json::json!(stages));
    }
    image.write(&args.out, &json)?;
    forget(&checkpoint)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&json).expect("plain data"));
    } else {
        println!("{}", line(args, &image, per_second));
        if let Some((path, said)) = dose {
            let gy = |key: &str| said[key].as_f64().unwrap_or(f64::NAN);
            let words = |key: &str| {
                format!("{key} {:.3e} ± {:.1e} Gy", gy(&format!("{key}_gy")), gy(&format!("{key}_standard_error_gy")))
            };
            println!("{}: {}, {}", path.display(), words("mean"), words("largest"));
        }
    }
    Ok(0)
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
    let (mut pace, mut shown) = (Pace::new(tally), tally.histories());
    let after = |tally: &Tally| {
        let histories = tally.histories();
        progress.advance(histories - shown);
        shown = histories;
        let precise = |wanted: f64| needed(histories, simulation.relative_error(tally), wanted);
        let in_all = || simulation.histories().rel_error.map_or(f64::INFINITY, precise).min(all as f64);
        if let Some((in_all, left_ms)) = pace.long(histories, in_all) {
            reporter.note(format_args!("{in_all:.1e} histories: about {} to go", lasting(left_ms)));
        }
        true
    };
    follow(simulation, gpu, tally, Some(keep), after)
}

fn line(args: &ScatterArgs, image: &ScatterImage, per_second: f64) -> String {
    let [columns, rows] = args.grid_px;
    let error = if image.relative_error.is_finite() {
        format!("median standard error of scatter {:.2} %", 100.0 * image.relative_error)
    } else {
        "to most pixels came too little scatter to tell its standard error".to_owned()
    };
    format!(
        "{}: {columns} x {rows} px, {:.3e} histories, scatter to primary {:.3}, {error}\n{per_second:.2e} histories per second",
        args.out.display(),
        image.histories as f64,
        image.scatter_to_primary(),
    )
}

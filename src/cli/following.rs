//! Photons that are followed for long, for `scatter` and for an image: their sums are kept on disk, from where the same command goes on, and how
//! long they will take is said.

use std::path::Path;

use crate::gpu::{Gpu, cpu_name};
use crate::image::{ImageFileError, sha256_file};
use crate::reporter::Reporter;
use crate::scene::Scene;
use crate::time::Stopwatch;
use crate::transport::{Checkpoint, FEWEST, GpuTransport, GpuTransportError, Simulation, Tally, TransportError};

/// What takes longer than this is announced.
pub const LONG_MS: f64 = 10e3;

/// When sums are kept.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct KeepArgs {
    /// Start anew where an interrupted run left a checkpoint of its photons
    #[arg(long)]
    pub fresh: bool,
    /// Keep a checkpoint every so many seconds while photons are followed: an interrupted run loses no more
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, value_parser = seconds)]
    pub checkpoint_s: f64,
}

/// A time to wait.
fn seconds(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| format!("'{text}' is no number"))?;
    if number >= 0.0 && number.is_finite() { Ok(number) } else { Err(format!("{text}: expected seconds from 0 up")) }
}

/// Where the sums of one run are kept.
#[derive(Clone, Copy, Debug)]
pub struct Keep<'a> {
    /// The file.
    pub path: &'a Path,
    /// When, and whether what is there counts.
    pub args: KeepArgs,
    /// SHA-256 of the scene file and of what it names.
    pub inputs: &'a [String],
}

impl Keep<'_> {
    /// The same, where nothing counts that is there.
    #[must_use]
    pub fn anew(self) -> Self {
        Self { args: KeepArgs { fresh: true, ..self.args }, ..self }
    }

    fn is_due(&self, since: &Stopwatch) -> bool {
        since.ms() > 1e3 * self.args.checkpoint_s
    }

    fn write(&self, simulation: &Simulation, device: &str, tally: &Tally) -> Result<(), TransportError> {
        Checkpoint::new(simulation.histories(), device, self.inputs, tally).write(self.path)
    }
}

/// SHA-256 of a scene file and of what its scene names.
///
/// # Errors
/// When the file cannot be read.
pub fn hashes(path: &Path, scene: &Scene) -> Result<Vec<String>, ImageFileError> {
    let named = scene.inputs.iter().map(|input| Ok(input.sha256.clone()));
    std::iter::once(sha256_file(path)).chain(named).collect()
}

/// What follows photons, as a checkpoint names it: of processors any gives the same bits.
fn follower(gpu: Option<&GpuTransport>) -> String {
    gpu.map_or("cpu", |gpu| gpu.adapter()).to_owned()
}

/// The sums to go on with: those that an interrupted run left, else none.
///
/// # Errors
/// When they are of something else, or cannot be read.
pub fn begin(
    simulation: &Simulation,
    gpu: Option<&GpuTransport>,
    keep: Option<&Keep<'_>>,
    reporter: &Reporter,
) -> Result<Tally, TransportError> {
    let empty = gpu.map_or_else(|| simulation.tally(), GpuTransport::tally);
    let Some(keep) = keep.filter(|keep| !keep.args.fresh) else { return Ok(empty) };
    let Some(saved) = Checkpoint::read(keep.path)? else { return Ok(empty) };
    let tally = saved.tally_for(simulation, (&follower(gpu), &empty), keep.inputs)?;
    reporter.note(format_args!("going on after {} histories of {}", tally.histories(), keep.path.display()));
    Ok(tally)
}

/// Why no more photons are followed.
enum Stop<E> {
    Enough,
    Failed(E),
}

impl<E: From<GpuTransportError>> From<GpuTransportError> for Stop<E> {
    fn from(error: GpuTransportError) -> Self {
        Self::Failed(error.into())
    }
}

/// Follows photons until `simulation` has all that it asks for, or `goes_on`, which hears of the sums after every step, says no. They are kept
/// meanwhile, and in the end: what they are for may fail yet.
///
/// # Errors
/// When a GPU is lost, or the sums cannot be kept.
pub fn follow<E: From<TransportError> + From<GpuTransportError>>(
    simulation: &Simulation,
    gpu: Option<&mut GpuTransport>,
    tally: &mut Tally,
    keep: Option<&Keep<'_>>,
    mut goes_on: impl FnMut(&Tally) -> bool,
) -> Result<(), E> {
    let device = follower(gpu.as_deref());
    let (watch, mut saved) = (Stopwatch::start(), Stopwatch::start());
    let each = |tally: &Tally| -> Result<(), Stop<E>> {
        let goes_on = goes_on(tally);
        if let Some(keep) = keep.filter(|keep| keep.is_due(&saved)) {
            keep.write(simulation, &device, tally).map_err(|error| Stop::<E>::Failed(error.into()))?;
            saved = Stopwatch::start();
        }
        if goes_on { Ok(()) } else { Err(Stop::Enough) }
    };
    let run = match gpu {
        Some(gpu) => gpu.run(simulation, tally, each),
        None => simulation.run(tally, each),
    };
    if let Err(Stop::Failed(error)) = run {
        return Err(error);
    }
    if let Some(keep) = keep.filter(|keep| keep.is_due(&watch)) {
        keep.write(simulation, &device, tally)?;
    }
    Ok(())
}

/// Forgets the sums of `path`: what they were for is written.
///
/// # Errors
/// When the file is there and cannot be removed.
pub fn forget(path: &Path) -> Result<(), ImageFileError> {
    match std::fs::remove_file(path) {
        Err(source) if source.kind() != std::io::ErrorKind::NotFound => Err(ImageFileError::Io { path: path.to_owned(), source }),
        _ => Ok(()),
    }
}

/// Tells once how long photons will take.
pub struct Pace {
    before: u64,
    watch: Stopwatch,
    is_told: bool,
}

impl Pace {
    /// Of a run that begins with `tally`.
    #[must_use]
    pub fn new(tally: &Tally) -> Self {
        Self { before: tally.histories(), watch: Stopwatch::start(), is_told: false }
    }

    /// How many photons there will be in all, where `histories` are there, and milliseconds until then; the first time that it is asked, where
    /// these are many.
    pub fn long(&mut self, histories: u64, in_all: impl FnOnce() -> f64) -> Option<(f64, f64)> {
        if std::mem::replace(&mut self.is_told, true) {
            return None;
        }
        let in_all = in_all();
        let left_ms = self.watch.ms() * (in_all - histories as f64) / histories.saturating_sub(self.before) as f64;
        (left_ms > LONG_MS && left_ms.is_finite()).then_some((in_all, left_ms))
    }
}

/// `simulation` on `gpu`; where it cannot be, the processor follows the photons, which is said.
pub fn gpu_or_said<'a>(gpu: &'a Gpu, simulation: &Simulation, reporter: &Reporter) -> Option<GpuTransport<'a>> {
    let told = |error: GpuTransportError| {
        reporter.note(format_args!("photons are followed on {}: {error}", cpu_name()));
    };
    GpuTransport::new(gpu, simulation).map_err(told).ok()
}

/// Photons in all after which scatter is known to `wanted`, where the first `histories` know it to `relative_error`: errors fall with their
/// root, and are not told before [`FEWEST`] contributions. Infinite where most cells have seen none.
#[must_use]
pub fn needed(histories: u64, relative_error: f64, wanted: f64) -> f64 {
    histories as f64 * (relative_error / wanted.min(1.0 / FEWEST.sqrt())).powi(2)
}

/// A time for people.
#[must_use]
pub fn lasting(ms: f64) -> String {
    match ms / 1e3 {
        seconds if seconds < 10.0 => format!("{seconds:.1} s"),
        seconds if seconds < 120.0 => format!("{seconds:.0} s"),
        seconds if seconds < 7200.0 => format!("{:.0} min", seconds / 60.0),
        seconds => format!("{:.1} h", seconds / 3600.0),
    }
}

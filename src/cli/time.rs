//! `sidecarm time`: how long a scene takes from many views, the volumes staying prepared; `scripts/bench` is made of it.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use glam::DMat4;
use serde::{Deserialize, Serialize};

use crate::cli::render::{DeviceArg, QuantityArg};
use crate::cli::time_changes;
use crate::estimate::median;
use crate::foreign::read_small;
use crate::geometry::{self, Rigid};
use crate::render::plan::Executor;
use crate::render::{Goal, Options, RenderError, Renderer};
use crate::reporter::Reporter;
use crate::scene::{self, SceneError};
use crate::time::{StageTimes, Stopwatch};

/// Time a scene from its own view, or from many.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm time scene.json --views views.json --max-error 1e-3

VIEWS.json is a list of rows-of-rows 4x4 matrices camera_from_lps. Printed as JSON: milliseconds of the median and the fastest of
--repeat images per view, planning, preparation and (once a machine) calibration of costs apart, in plan_ms, prepare_ms, calibrate_ms; images_per_second of all views in one go, by the first view's plan
(a GPU is given eight at a time), with --replan one by one, each planned anew.")]
pub struct TimeArgs {
    /// The scene
    pub scene: PathBuf,
    /// Poses camera_from_lps, one image each
    #[arg(long, value_name = "VIEWS.json")]
    pub views: Option<PathBuf>,
    /// What the images hold
    #[arg(long, value_enum, default_value = "line_integral")]
    pub quantity: QuantityArg,
    /// The error that will do
    #[arg(long, value_name = "REL", default_value_t = 1e-3, allow_negative_numbers = true)]
    pub max_error: f64,
    /// Images per view
    #[arg(long, default_value = "5", allow_negative_numbers = true, value_parser = images)]
    pub repeat: NonZeroUsize,
    /// Plan every image anew, as a live session does, and count that
    #[arg(long)]
    pub replan: bool,
    /// Time the first image after a change of the robot, the C-arm, the spectrum, the CT as well
    #[arg(long)]
    pub changes: bool,
    /// What renders
    #[arg(long, value_enum, default_value = "cpu")]
    pub device: DeviceArg,
}

/// A number of images.
fn images(text: &str) -> Result<NonZeroUsize, String> {
    text.parse().map_err(|_| format!("'{text}' is no number of images, expected a whole number from 1"))
}

/// Why nothing was timed.
#[derive(Debug, thiserror::Error)]
pub enum TimeError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The renderer.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// An error that is no positive number.
    #[error("--max-error {value}: expected a positive number")]
    MaxError {
        /// As typed.
        value: f64,
    },
    /// What was asked for cannot be promised.
    #[error("--max-error {wanted:e}: the plan's bound is {stated:.1e} on {adapter}{advice}")]
    Bound {
        /// As typed.
        wanted: f64,
        /// What the plan states.
        stated: f64,
        /// Device.
        adapter: String,
        /// What comes closer.
        advice: &'static str,
    },
    /// The list of views.
    #[error("{}: {detail}; expected a list of 4x4 rigid matrices camera_from_lps", path.display())]
    Views {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
}

#[derive(Debug, Serialize, Deserialize)]
struct View {
    plan_ms: f64,
    calibrate_ms: f64,
    prepare_ms: f64,
    median_ms: f64,
    fastest_ms: f64,
    wall_ms: f64,
    stated_error: f64,
    energies: usize,
    predicted_ms: Option<f64>,
    stages_ms: StageTimes,
    gpu_ms: StageTimes,
    read_back_bytes: u64,
}

/// Times and prints; 0 on success.
///
/// # Errors
/// When the scene or a view is wrong, or the error cannot be promised.
pub fn run(args: &TimeArgs, reporter: &Reporter) -> Result<u8, TimeError> {
    if !(args.max_error > 0.0 && args.max_error.is_finite()) {
        return Err(TimeError::MaxError { value: args.max_error });
    }
    let watch = Stopwatch::start();
    let mut scene = scene::load(&args.scene, true, reporter)?;
    let load_ms = watch.ms();
    let mut renderer = Renderer::new(args.device.into(), reporter)?;
    let poses = match &args.views {
        Some(path) => poses(path)?.into_iter().map(Some).collect(),
        None => vec![None],
    };
    let progress = reporter.progress("timing views", poses.len() as u64);
    let (mut views, mut cameras) = (Vec::new(), Vec::new());
    let all = Stopwatch::start();
    for pose in poses {
        if let (Some(pose), Some(view)) = (pose, &mut scene.view) {
            view.camera_from_lps = pose;
        }
        cameras.extend(scene.view);
        views.push(time(&scene, &mut renderer, args)?);
        progress.advance(1);
    }
    let per_second = match args.replan {
        true => (views.len() * args.repeat.get()) as f64 / all.ms() * 1e3,
        false => together(&scene, &mut renderer, args, &cameras)?,
    };
    let changes = match args.changes {
        true => Some(time_changes::measure(&scene, &mut renderer, &options(args), args.repeat.get())?),
        false => None,
    };
    let report = serde_json::json!({
        "adapter": renderer.adapter_with_threads(),
        "load_ms": load_ms,
        "peak_memory_mib": peak_memory_mib(),
        "images_per_second": per_second,
        "views": views,
        "changes": changes,
    });
    println!("{}", serde_json::to_string_pretty(&report).expect("plain data"));
    Ok(0)
}

fn options(args: &TimeArgs) -> Options {
    Options { quantity: args.quantity.into(), goal: Some(Goal::MaxError(args.max_error)), ..Options::default() }
}

/// Images per second of all views in one go.
fn together(
    scene: &scene::Scene,
    renderer: &mut Renderer,
    args: &TimeArgs,
    cameras: &[geometry::View],
) -> Result<f64, RenderError> {
    let options = options(args);
    let watch = Stopwatch::start();
    let mut images = 0;
    renderer.render_views(scene, cameras, &options, &mut |_, _| images += 1)?;
    Ok(f64::from(images) / watch.ms() * 1e3)
}

fn time(scene: &scene::Scene, renderer: &mut Renderer, args: &TimeArgs) -> Result<View, TimeError> {
    let options = options(args);
    let mut planning = StageTimes::default();
    let plan = renderer.plan_timed(scene, &options, &mut planning)?;
    if !(args.max_error >= plan.stated_error) {
        let does = plan.executor == Executor::Wgsl && args.max_error >= Executor::Cpu.stated_error();
        let advice = if does { "; --device cpu reaches 5e-6" } else { "; only `sidecarm render --reference` is closer" };
        return Err(TimeError::Bound { wanted: args.max_error, stated: plan.stated_error, adapter: renderer.adapter(), advice });
    }
    let booked = |stage: &str| planning.get(stage).unwrap_or(0.0);
    let (plan_ms, calibrate_ms) = (booked("plan"), booked("calibrate"));
    let fixed = Options { plan: (!args.replan).then(|| plan.clone()), ..options };
    let mut times = Vec::new();
    let mut walls = Vec::new();
    let mut first_prepare_ms = booked("prepare");
    let (mut stages, mut gpu_ms, mut read_back_bytes) = (StageTimes::default(), StageTimes::default(), 0);
    for round in 0..args.repeat.get() {
        let watch = Stopwatch::start();
        let rendered = renderer.render(scene, &fixed)?;
        walls.push(watch.ms());
        if round == 0 {
            first_prepare_ms += rendered.stages.get("prepare").unwrap_or(0.0);
        }
        let all = || rendered.stages.iter().map(|(_, ms)| ms).sum::<f64>();
        times.push(if args.replan { all() } else { rendered.image_ms() });
        (stages, gpu_ms, read_back_bytes) = (rendered.stages, rendered.gpu_ms, rendered.read_back_bytes);
    }
    Ok(View {
        plan_ms,
        calibrate_ms,
        prepare_ms: first_prepare_ms,
        median_ms: median(times.iter().copied()).unwrap_or(f64::NAN),
        fastest_ms: times.iter().copied().fold(f64::INFINITY, f64::min),
        wall_ms: median(walls).unwrap_or(f64::NAN),
        stated_error: plan.stated_error,
        energies: plan.energy_nodes.len(),
        predicted_ms: plan.predicted_ms,
        stages_ms: stages,
        gpu_ms,
        read_back_bytes,
    })
}

fn poses(path: &Path) -> Result<Vec<Rigid>, TimeError> {
    let wrong = |detail: String| TimeError::Views { path: path.to_owned(), detail };
    let text = read_small(path).map_err(|error| wrong(error.to_string()))?;
    let rows: Vec<[[f64; 4]; 4]> = serde_json::from_slice(&text).map_err(|error| wrong(error.to_string()))?;
    if rows.is_empty() {
        return Err(wrong("it holds no matrix".to_owned()));
    }
    let pose = |(index, rows): (usize, &[[f64; 4]; 4])| {
        let matrix = DMat4::from_cols_array_2d(rows).transpose();
        let (scale, rotation, translation_mm) = matrix.to_scale_rotation_translation();
        if !((scale - 1.0).abs().max_element() < 1e-6) || !translation_mm.is_finite() {
            return Err(wrong(format!("matrix {index} is not rigid")));
        }
        Ok(Rigid { rotation, translation_mm })
    };
    rows.iter().enumerate().map(pose).collect()
}

/// The most memory that the process has held, where the system says.
fn peak_memory_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

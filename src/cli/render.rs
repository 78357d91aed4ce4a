//! `sidecarm render`: one scene, one radiograph.

use std::path::PathBuf;
use std::sync::Arc;

use clap::builder::{PathBufValueParser, TypedValueParser};

use crate::cli::following::{Keep, KeepArgs, forget, hashes};
use crate::cli::named;
pub use crate::cli::posed::PosedError;
use crate::cli::posed::posed;
use crate::cli::scattered::{Asked, SCATTER_ERROR, ScatteredError, scattered, ways};
use crate::gpu::DeviceChoice;
use crate::image::{ImageFileError, check_writable, refuse_overwrite, refuse_twice};
use crate::render::plan::Executor;
use crate::render::{
    Goal, Options, Origin, Quantity, RenderError, Rendered, Renderer, Scatter, explain_unseen, guessed_share, unsaid_skew,
    write_dicom, write_image, write_picture, written_with,
};
use crate::reporter::Reporter;
use crate::scene::model::ScatterModel;
use crate::scene::{self, SceneError};
use crate::time::StageTimes;

/// Render the radiograph that a scene should give: polychromatic, every material, later objects displacing earlier ones.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm render scene.json --out drr.tif
  sidecarm render scene.json --out paths.tif --quantity area_density
  sidecarm render scene.json --out drr.tif --max-error 1e-3 --explain
  sidecarm render scene.json --out drr.tif --budget-ms 20
  sidecarm render scene.json --out drr.tif --pose POSE.json --explain
  sidecarm render scene.json --out drr.tif --dicom drr.dcm

Where the scene's model.scatter is monte_carlo, photons are followed before the image is made: seconds to minutes, which no budget counts.
Meanwhile IMAGE.tif.checkpoint is kept up to date: the same command, or one with another --scatter-error, goes on from there.
Where it is network, one that `sidecarm train scatter` has made is asked: a fraction of a second, which --budget-ms counts.

Beside IMAGE.tif lies IMAGE.tif.json (plan, stated error, times, inputs), IMAGE.tif.valid.png when the CT is cut off for some
pixels (black there), and IMAGE.tif.guessed.png when a body has moved (white where the image shows what fills its old place).")]
pub struct RenderArgs {
    /// The scene
    pub scene: PathBuf,
    /// The image, 32-bit float TIFF
    #[arg(long, value_name = "IMAGE.tif", value_parser = PathBufValueParser::new().try_map(named::float_tiff))]
    pub out: PathBuf,
    /// What the image holds
    #[arg(long, value_enum, default_value = "intensity")]
    pub quantity: QuantityArg,
    /// Largest |error of the line integral| / max(1, line integral) that will do, noise aside [default: 1e-5]
    #[arg(long, value_name = "REL", allow_negative_numbers = true)]
    pub max_error: Option<f64>,
    /// Milliseconds that the image may take, planning and preparation of volumes aside: as accurate as fits
    #[arg(long, value_name = "T", conflicts_with = "max_error", allow_negative_numbers = true)]
    pub budget_ms: Option<f64>,
    /// What renders
    #[arg(long, value_enum, default_value = "auto")]
    pub device: DeviceArg,
    /// MiB of a GPU's memory that a CT may take: a larger one is crossed part by part [default: all there is]
    #[arg(long, value_name = "N")]
    pub gpu_memory_mib: Option<u64>,
    /// Where the scene has model.scatter "monte_carlo": follow photons until the median relative standard error of the scatter is no larger
    #[arg(long, value_name = "REL", default_value_t = SCATTER_ERROR, allow_negative_numbers = true)]
    pub scatter_error: f64,
    #[command(flatten)]
    pub keep: KeepArgs,
    /// Where the scene has model.scatter "network": the network that is asked, a path without ending, from
    /// `sidecarm train scatter` [default: the one that comes with the program]
    #[arg(long, value_name = "NAME")]
    pub scatter_network: Option<PathBuf>,
    /// Pose to render from, in place of the scene's view, from `register`; bodies that have moved since the scan move with it
    #[arg(long, value_name = "POSE.json")]
    pub pose: Option<PathBuf>,
    /// The slow f64 yardstick instead of the fast path; with --max-error or --budget-ms that plan is executed as well, and what it
    /// achieved stands in IMAGE.tif.json
    #[arg(long)]
    pub reference: bool,
    /// Print what is modelled, what is left out, and why
    #[arg(long)]
    pub explain: bool,
    /// An 8-bit picture for eyes as well
    #[arg(long, value_name = "FILE.png", value_parser = PathBufValueParser::new().try_map(named::png))]
    pub png: Option<PathBuf>,
    /// The same as a DICOM object (digital X-ray, 16 bits) with its geometry
    #[arg(long, value_name = "FILE.dcm", value_parser = PathBufValueParser::new().try_map(named::no_stream))]
    pub dicom: Option<PathBuf>,
    /// Print a summary as JSON
    #[arg(long)]
    pub json: bool,
    /// Count NaN and infinity after every pass, into IMAGE.tif.json
    #[arg(long, hide = true)]
    pub count_non_finite: bool,
}

/// `--quantity`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum QuantityArg {
    /// 1 in air
    Intensity,
    /// -ln intensity
    LineIntegral,
    /// gain times the detected signal, plus offset
    Counts,
    /// g/cm², one page per material, noise-free
    AreaDensity,
}

impl From<QuantityArg> for Quantity {
    fn from(quantity: QuantityArg) -> Self {
        match quantity {
            QuantityArg::Intensity => Self::Intensity,
            QuantityArg::LineIntegral => Self::LineIntegral,
            QuantityArg::Counts => Self::Counts,
            QuantityArg::AreaDensity => Self::AreaDensity,
        }
    }
}

/// `--device`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum DeviceArg {
    /// A hardware GPU if present, else the CPU
    Auto,
    /// A hardware GPU
    Gpu,
    /// Native code on all cores
    Cpu,
    /// The shaders on a CPU: slow, for tests
    SoftwareVulkan,
}

impl From<DeviceArg> for DeviceChoice {
    fn from(device: DeviceArg) -> Self {
        match device {
            DeviceArg::Auto => Self::Auto,
            DeviceArg::Gpu => Self::Gpu,
            DeviceArg::Cpu => Self::Cpu,
            DeviceArg::SoftwareVulkan => Self::SoftwareVulkan,
        }
    }
}

/// A kind of warning about the scene that bears on every pixel's meaning.
const OF_THE_SCENE: &str = "air displaces nothing";

/// Why nothing was rendered.
#[derive(Debug, thiserror::Error)]
pub enum RenderCommandError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The renderer.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The scatter.
    #[error(transparent)]
    Scatter(#[from] ScatteredError),
    /// The pose.
    #[error(transparent)]
    Posed(#[from] PosedError),
    /// The picture.
    #[error(transparent)]
    Picture(#[from] ImageFileError),
    /// Area densities of nothing.
    #[error("{path}: the scene has no material, so there is no area density to write; add an object, or ask for another --quantity", path = path.display())]
    NoMaterial {
        /// The scene.
        path: PathBuf,
    },
    /// A wish that is no positive number.
    #[error("{flag} {value}: expected a positive number")]
    Goal {
        /// The flag.
        flag: &'static str,
        /// As typed.
        value: f64,
    },
    /// What was asked for cannot be promised.
    #[error("--max-error {wanted:e}: the plan's bound is {stated:.1e} on {adapter}{advice}")]
    MaxError {
        /// As typed.
        wanted: f64,
        /// What the plan states.
        stated: f64,
        /// Device.
        adapter: String,
        /// What reaches it.
        advice: &'static str,
    },
}

/// Renders as asked; 0 on success.
///
/// # Errors
/// When the scene is wrong, the device is not there, the bound cannot be met, or a file cannot be written.
pub fn run(args: &RenderArgs, reporter: &Reporter) -> Result<u8, RenderCommandError> {
    // An image may take long: what cannot be written is refused before.
    for output in std::iter::once(&args.out).chain(&args.png).chain(&args.dicom) {
        check_writable(output)?;
    }
    let mut scene = scene::load(&args.scene, args.pose.is_none(), reporter)?;
    if let Some(path) = &args.pose {
        scene = posed(&scene, path, reporter)?;
    }
    if args.quantity == QuantityArg::AreaDensity && scene.materials.is_empty() {
        return Err(RenderCommandError::NoMaterial { path: args.scene.clone() });
    }
    let [.., checkpoint] = crate::transport::written_with(&args.out);
    let others = args.png.iter().chain(&args.dicom).chain([&checkpoint]).cloned();
    let outputs: Vec<PathBuf> = written_with(&args.out).into_iter().chain(others).collect();
    let inputs: Vec<PathBuf> = scene::input_files(&args.scene, &scene).into_iter().chain(args.pose.clone()).collect();
    refuse_twice(&outputs)?;
    refuse_overwrite(&outputs, &inputs)?;
    let unseen: Vec<String> = scene.view.iter().flat_map(|view| explain_unseen(&scene, view)).collect();
    unseen.iter().for_each(|words| reporter.warn("objects", words));
    // The yardstick runs on the CPU whatever else there is.
    let device = if args.reference { DeviceChoice::Cpu } else { args.device.into() };
    let mut renderer = Renderer::new(device, reporter)?;
    if let Some(mib) = args.gpu_memory_mib {
        renderer.limit_gpu_memory(mib.saturating_mul(1 << 20));
    }
    let hashes = hashes(&args.scene, &scene)?;
    let asked = Asked {
        rel_error: positive("--scatter-error", args.scatter_error)?,
        network: args.scatter_network.as_deref(),
        budget_ms: args.budget_ms,
        gpu: None,
        keep: Some(Keep { path: &checkpoint, args: args.keep, inputs: &hashes }),
    };
    let goal = goal(args)?;
    let mut options = Options {
        quantity: args.quantity.into(),
        reference: args.reference,
        count_non_finite: args.count_non_finite,
        guessed: true,
        goal,
        ..Options::default()
    };
    let mut stages = StageTimes::default();
    let scatter_of = |asked: &Asked<'_>, stages: &mut StageTimes| -> Result<Option<Arc<Scatter>>, RenderCommandError> {
        if args.quantity == QuantityArg::AreaDensity || scene.model.scatter == ScatterModel::Off {
            return Ok(None);
        }
        let view = scene.view.ok_or(RenderError::NoView)?;
        Ok(stages.measure("scatter", || scattered(&scene, &view, asked, reporter))?.map(Arc::new))
    };
    let mut network_ms = 0.0;
    if let (Some(Goal::BudgetMs(left_ms)), ScatterModel::Network) = (&mut options.goal, scene.model.scatter) {
        // Asked first, so that the image is planned into the time that the network leaves.
        options.scatter = scatter_of(&asked, &mut stages)?;
        network_ms = options.scatter.as_ref().and(stages.get("scatter")).unwrap_or(0.0);
        *left_ms = (*left_ms - network_ms).max(0.0);
    }
    let mut plan = renderer.plan_timed(&scene, &options, &mut stages)?;
    if let Some(wanted) = args.max_error
        && !(wanted >= plan.stated_error)
    {
        let (stated, adapter, advice) = (plan.stated_error, renderer.adapter(), what_reaches(wanted, plan.executor));
        return Err(RenderCommandError::MaxError { wanted, stated, adapter, advice });
    }
    plan.predicted_ms = plan.predicted_ms.map(|ms| ms + network_ms);
    // A GPU's part is not predicted; a network's is known.
    let predicted_ms = plan.predicted_ms.unwrap_or(network_ms);
    let with_network = args.budget_ms.filter(|budget_ms| network_ms > 0.0 && !args.reference && !(predicted_ms <= *budget_ms));
    if let Some(budget_ms) = with_network {
        // In place of what the planner says of the time that the network left.
        plan.say("budget", false, over_budget(budget_ms, predicted_ms, network_ms));
    }
    if let Some(said) = plan.choices.iter().find(|choice| choice.what == "budget") {
        let advice = match (with_network, plan.predicted_ms) {
            (Some(_), _) => "model.scatter \"off\" asks no network; fewer pixels, or a GPU, render faster",
            (None, Some(_)) => "fewer pixels, or a GPU, would be faster",
            (None, None) => "fewer pixels would be faster",
        };
        reporter.warn("budget", format_args!("--budget-ms {}; {advice}", said.why));
    }
    let asked = Asked { gpu: renderer.gpu(), ..asked };
    if options.scatter.is_none() {
        options.scatter = scatter_of(&asked, &mut stages)?;
    }
    if args.scatter_network.is_some() && scene.model.scatter != ScatterModel::Network {
        reporter.warn("scatter", format_args!("--scatter-network is not asked: the scene's model.scatter is not \"network\""));
    }
    if let Some(scatter) = &options.scatter {
        plan.say("scatter", true, scatter.words());
    }
    if args.explain {
        println!("{}", plan.explain().trim_end());
        if let Some(view) = scene.view.filter(|_| args.quantity != QuantityArg::AreaDensity) {
            println!("{}", ways(&scene, &view, &asked));
        }
    }
    options.plan = Some(plan);
    let mut rendered = renderer.render(&scene, &options)?;
    rendered.booked_before(&stages);
    if let (Some(wanted), Some(added)) = (args.max_error, &rendered.scatter)
        && !(wanted >= rendered.stated_error)
    {
        let (stated, adapter) = (rendered.stated_error, renderer.adapter());
        let advice = match &added.from {
            _ if !(added.stated_error > 0.5 * stated) => "",
            Origin::Photons { .. } => "; a smaller --scatter-error leaves less of the scatter uncertain",
            Origin::Network { .. } => "; the network knows its scatter no better: model.scatter \"monte_carlo\" does",
        };
        return Err(RenderCommandError::MaxError { wanted, stated, adapter, advice });
    }
    if let Some(goal) = goal.filter(|_| args.reference) {
        renderer.judge(&scene, goal, &mut rendered)?;
    }
    let warned = reporter.warnings();
    for note in rendered.notes.iter().filter(|note| !warned.values().any(|warning| warning.latest == **note)) {
        reporter.note(format_args!("note: {note}"));
    }
    // What was said before there was an image belongs to it as well.
    rendered.notes.extend(warned.get(OF_THE_SCENE).map(|warning| warning.latest.clone()));
    rendered.notes.extend(unseen);
    if let Some(counts) = rendered.non_finite.filter(|counts| counts.total() > 0) {
        reporter.warn("not finite", format_args!("{}: values that are not finite: {counts:?}", args.out.display()));
    }
    write_image(&args.out, &rendered, &scene)?;
    if let Some(path) = &args.png {
        write_picture(path, &rendered)?;
    }
    if let Some(path) = &args.dicom {
        write_dicom(path, &rendered, &scene)?;
        scene.view.and_then(|view| unsaid_skew(&view)).iter().for_each(|words| reporter.note(format_args!("note: {words}")));
    }
    if rendered.scatter.as_ref().is_some_and(|added| matches!(added.from, Origin::Photons { .. })) {
        forget(&checkpoint)?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&summary(args, &rendered)).expect("plain data"));
    } else {
        println!("{}", line(args, &rendered));
    }
    Ok(0)
}

/// A flag's value that must be positive.
fn positive(flag: &'static str, value: f64) -> Result<f64, RenderCommandError> {
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err(RenderCommandError::Goal { flag, value }) }
}

/// What keeps within `wanted`, where no plan of `executor` does.
fn what_reaches(wanted: f64, executor: Executor) -> &'static str {
    let does = |other: Executor| wanted >= other.stated_error();
    match executor {
        Executor::Wgsl if does(Executor::Cpu) => "; --device cpu reaches 5e-6, --reference 1e-7",
        Executor::Wgsl | Executor::Cpu if does(Executor::Reference) => "; --reference reaches 1e-7",
        _ => "; nothing reaches less than 1e-7, which --reference does",
    }
}

/// What `--max-error` or `--budget-ms` asks for.
fn goal(args: &RenderArgs) -> Result<Option<Goal>, RenderCommandError> {
    Ok(match (args.max_error, args.budget_ms) {
        (Some(error), _) => Some(Goal::MaxError(positive("--max-error", error)?)),
        (None, Some(ms)) => Some(Goal::BudgetMs(positive("--budget-ms", ms)?)),
        (None, None) => None,
    })
}

/// What to say of a time that the fastest plan does not keep, of which a network has taken `network_ms`.
fn over_budget(budget_ms: f64, predicted_ms: f64, network_ms: f64) -> String {
    format!(
        "{budget_ms} ms cannot be met: the fastest plan is predicted to take {predicted_ms:.2} ms, of which the scatter network takes \
         {network_ms:.2} ms"
    )
}

fn range(rendered: &Rendered) -> (f32, f32) {
    let values = rendered.pages.iter().flat_map(|page| &page.pixels);
    values.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), value| (low.min(*value), high.max(*value)))
}

fn line(args: &RenderArgs, rendered: &Rendered) -> String {
    let (low, high) = range(rendered);
    let judged = rendered.achieved.as_ref().map_or_else(String::new, |(plan, achieved)| {
        format!(
            "\nfast path: error {:.1e} (stated {:.1e}), worst pixel {:.1e}, {:.1} ms",
            achieved.error, plan.stated_error, achieved.worst, achieved.ms
        )
    });
    let times: Vec<String> = rendered.stages.iter().map(|(stage, ms)| format!("{stage} {ms:.1} ms")).collect();
    // No budget counts photons; what a network takes it does.
    let followed = rendered.scatter.as_ref().is_some_and(|added| matches!(added.from, Origin::Photons { .. }));
    let photons_ms = rendered.stages.get("scatter").filter(|_| followed).unwrap_or(0.0);
    let image_ms = rendered.image_ms() - photons_ms;
    let missed = args.budget_ms.filter(|budget| !(image_ms <= *budget));
    let missed =
        missed.map_or_else(String::new, |budget| format!("\n--budget-ms {budget}: not met, the image took {image_ms:.1} ms"));
    format!(
        "{}: {} x {} px, {} from {low:.4} to {high:.4}, stated error {:.1e}\n{}: {}{judged}{missed}",
        args.out.display(),
        rendered.valid.width,
        rendered.valid.height,
        rendered.quantity.name(),
        rendered.stated_error,
        rendered.adapter,
        times.join(", ")
    )
}

fn summary(args: &RenderArgs, rendered: &Rendered) -> serde_json::Value {
    let (low, high) = range(rendered);
    serde_json::json!({
        "out": args.out,
        "quantity": rendered.quantity,
        "size_px": [rendered.valid.width, rendered.valid.height],
        "pages": rendered.pages.len(),
        "min": low,
        "max": high,
        "stated_error": rendered.stated_error,
        "predicted_ms": rendered.plan["predicted_ms"],
        "achieved": rendered.achieved.as_ref().map(|(_, achieved)| achieved),
        "stages_ms": rendered.stages,
        "gpu_ms": rendered.gpu_ms,
        "read_back_bytes": rendered.read_back_bytes,
        "adapter": rendered.adapter,
        "scatter": rendered.scatter,
        "share_guessed": rendered.guessed.as_ref().map(guessed_share),
        "notes": rendered.notes,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The CPU offered `--device cpu` for what it had just refused.
    #[test]
    fn only_what_reaches_an_error_is_offered_for_it() {
        let [cpu, reference] = [Executor::Cpu, Executor::Reference].map(|executor| format!("{:e}", executor.stated_error()));
        let mut cases = 0;
        for (wanted, executor, offers) in [
            (1e-4, Executor::Wgsl, [true, true]),
            (4e-6, Executor::Wgsl, [false, true]),
            (4e-6, Executor::Cpu, [false, true]),
            (1e-9, Executor::Wgsl, [false, false]),
            (1e-9, Executor::Cpu, [false, false]),
            (1e-9, Executor::Reference, [false, false]),
        ] {
            let words = what_reaches(wanted, executor);
            let offered = [words.contains(&format!("--device cpu reaches {cpu}")), !words.contains("nothing")];
            assert_eq!(offered, offers, "{wanted:e} of {executor:?}: {words}");
            assert!(words.contains(&reference) && words.contains("--reference"), "{words}");
            cases += 1;
        }
        assert_eq!(cases, 6);
    }
}

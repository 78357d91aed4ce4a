//! `sidecarm compare`: one acquired frame, one simulated image, honest numbers.

use std::path::PathBuf;
use std::sync::Arc;

use glam::DVec3;

pub use super::compare_error::CompareCommandError;
use super::compare_origin::{Given, doubts, view_of};
use super::compare_pictures::{described, excludes_none, mask_as_compared, read_flags, read_mask, read_simulated};
use super::compare_table::table;
use super::read_aloud::frame_aloud;
use super::scattered::{Asked, SCATTER_ERROR, scattered};
use crate::acquire::{DetectorCalibration, Domain, Frame};
use crate::compare::{
    AirLevel, CompareInput, Compared, NullRenders, NullScatter, OffsetRule, Tone, bead_marks, compare, elsewhere, posed_scene,
    tool_mask,
};
use crate::geometry::{PanelWindow, View};
use crate::gpu::DeviceChoice;
use crate::image::{Image, beside, refuse_overwrite, sha256_file, write_atomically, write_png_rgb};
use crate::pose::Pose;
use crate::render::{Renderer, guessed};
use crate::report::{PairMarks, Standing, StripInput, score_words, strip};
use crate::reporter::Reporter;
use crate::scene::model::Scene;
use crate::scene::{input_files, load};
use crate::transport::NetworkScatter;

/// Compare an acquired radiograph with a simulated one: scores, masks, and every score against wrong poses.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm compare frame.dcm drr.tif --out compared
  sidecarm compare frame.dcm drr.tif --scene scene.json --pose POSE.json --tone gain --out compared

DIR/compare.json holds the numbers, DIR/strip.png acquired | matched DRR | signed difference | edges. With --scene and --pose each
score is put against its null: the same score at +-1, 3, 10 mm and +-1, 3 degrees, turned about, and mirrored. Exit code 1: refused (too
little left to score, or a pose that SIMULATED was not rendered from).")]
pub struct CompareArgs {
    /// The radiograph: DICOM, 16-bit PNG or TIFF, float TIFF
    pub acquired: PathBuf,
    /// The simulated image: a float TIFF from `render`, intensity or line_integral
    pub simulated: PathBuf,
    /// Scene that was rendered; with --pose it gives the null, and what a moved body left
    #[arg(long, value_name = "SCENE.json", requires = "pose")]
    pub scene: Option<PathBuf>,
    /// Pose that was rendered, from `register`; gives mm and the places of the beads
    #[arg(long, value_name = "POSE.json")]
    pub pose: Option<PathBuf>,
    /// What to leave out: an opaque image whose non-zero pixels are excluded, drawn over ACQUIRED as it is stored, or of SIMULATED's size
    #[arg(long, value_name = "M")]
    pub mask: Option<PathBuf>,
    /// What may be fitted between the two: none, gain, log_affine, monotone (display images only)
    #[arg(long, value_name = "TONE", default_value = "none")]
    pub tone: Tone,
    /// Air level: open (from pixels that the simulation predicts to be air), maximum (the paper's rule), unknown, or a number
    #[arg(long, value_name = "AIR", default_value = "open", allow_negative_numbers = true)]
    pub air: AirLevel,
    /// Stored value without X-rays: shutters (from the collimated area, for linear frames), none, or a number
    #[arg(long, value_name = "OFFSET", default_value = "shutters")]
    pub offset: OffsetRule,
    /// Calibration of the panel, from `calibrate detector`: takes out offset, gain and bad pixels, and gives the air level
    #[arg(long, value_name = "DETECTOR.json")]
    pub detector: Option<PathBuf>,
    /// What the acquired values are: linear, log, display or unknown
    #[arg(long, value_name = "DOMAIN")]
    pub domain: Option<Domain>,
    /// What the simulated values are, where no IMAGE.tif.json says so: intensity or line_integral
    #[arg(long, value_name = "QUANTITY")]
    pub quantity: Option<String>,
    /// Print the comparison as JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// Folder for compare.json and strip.png; made if it is not there
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Compares, writes the folder, prints a table. Returns the exit code 0.
///
/// # Errors
/// When an input cannot be read, the images cannot be compared, too little is left to score, or an output cannot be written.
pub fn run(args: &CompareArgs, reporter: &Reporter) -> Result<u8, CompareCommandError> {
    let (json_path, strip_path) = (args.out.join("compare.json"), args.out.join("strip.png"));
    let named = [
        Some(&args.acquired),
        Some(&args.simulated),
        args.scene.as_ref(),
        args.pose.as_ref(),
        args.mask.as_ref(),
        args.detector.as_ref(),
    ];
    let mut inputs: Vec<PathBuf> = named.into_iter().flatten().cloned().collect();
    inputs.extend(["json", "valid.png", "guessed.png"].map(|suffix| beside(&args.simulated, suffix)));
    refuse_overwrite(&[&json_path, &strip_path], &inputs)?;
    let pose = args.pose.as_deref().map(Pose::read).transpose()?;
    let mut frame = frame_aloud(&args.acquired, args.domain, reporter)?;
    let (stored_px, unmirrored) = (frame.size_px, frame.unmirrored);
    let mut window = PanelWindow::WHOLE;
    let console = pose.as_ref().and_then(|pose| pose.console.as_ref());
    // The pose is that of the picture with the console's doing undone.
    if let Some(console) = console {
        window = console.window(frame.size_px.map(|side| side as u32));
        frame = frame.oriented(console, pose.as_ref().and_then(|pose| pose.detector.as_ref()?.size_px));
    }
    if let Some(path) = &args.detector {
        frame = DetectorCalibration::apply_file(path, &frame, window)?;
    }
    let flood_doubt = frame.correction.as_ref().and_then(|correction| correction.flood_doubt.clone());
    flood_doubt.iter().for_each(|doubt| reporter.warn("flood of another filter", doubt));
    let simulated = read_simulated(&args.simulated, args.quantity.as_deref())?;
    let valid = read_flags(&beside(&args.simulated, "valid.png"))?;
    let described = described(&args.simulated);
    if let (None, Some(share)) = (&valid, described["share_invalid"].as_f64().filter(|share| *share > 0.0)) {
        return Err(CompareCommandError::NoValidity { path: beside(&args.simulated, "valid.png"), percent: 100.0 * share });
    }
    let extra = args.mask.as_deref().map(read_mask).transpose()?;
    let excludes_none = extra.as_ref().and_then(excludes_none);
    for (path, words) in args.mask.iter().zip(excludes_none) {
        reporter.warn("mask", format!("{}: {words}", path.display()));
    }
    let extra = extra.map(|mask| mask_as_compared(mask, stored_px, unmirrored, console));
    let (extra, mask_moved) = extra.map_or((None, None), |(mask, moved)| (Some(mask), moved));
    let scene = args.scene.as_deref().map(|path| load(path, false, reporter)).transpose()?;
    if let (Some(path), Some(scene)) = (&args.scene, &scene) {
        refuse_overwrite(&[&json_path, &strip_path], &input_files(path, scene))?;
    }
    let posed = args.pose.as_deref().zip(pose.as_ref());
    let view = posed.map(|posed| view_of(posed, &simulated, reporter)).transpose()?.flatten();
    let centre_lps_mm = pose.as_ref().and_then(|pose| centre(pose, scene.as_ref()));
    let given = Given {
        simulated: &args.simulated,
        described: &described,
        pose: args.pose.as_deref().map(|path| (path, view)),
        scene: scene.as_ref(),
        centre_lps_mm,
    };
    let doubts = doubts(&given)?;
    let posed = scene.as_ref().zip(pose.as_ref()).zip(view).map(|((scene, pose), view)| posed_scene(scene, pose, view));
    let posed_scene = posed.transpose()?;
    let beads = view.zip(pose.as_ref()).map(|(view, pose)| bead_marks(pose, &view, posed_scene.as_ref(), |_| None));
    let beads = beads.unwrap_or_default();
    let guessed = match &posed_scene {
        Some(scene) => guessed(scene)?,
        None => read_flags(&beside(&args.simulated, "guessed.png"))?,
    };
    let tool = posed_scene.as_ref().and_then(tool_mask);
    let input = CompareInput {
        valid: valid.as_ref(),
        guessed: guessed.as_ref(),
        extra_mask: extra.as_ref(),
        beads: &beads,
        tool: tool.as_ref(),
        tone: args.tone,
        air: args.air,
        offset: args.offset,
        view: view.as_ref(),
        centre_lps_mm,
        ..CompareInput::new(&frame, &simulated)
    };
    let mut compared = compare(&input)?;
    for disagreement in &compared.comparison.disagreements {
        reporter.warn("images disagree", format!("{}: {disagreement}", args.acquired.display()));
    }
    // What was warned of, which the table does not say again.
    let excludes_none = excludes_none.map(str::to_owned);
    let warned: Vec<String> = doubts.iter().chain(&flood_doubt).chain(&excludes_none).cloned().collect();
    for doubt in doubts {
        reporter.warn("not what was rendered", &doubt);
        compared.comparison.flags.push(doubt);
    }
    compared.comparison.flags.extend(frame.altered.iter().cloned().chain(flood_doubt).chain(mask_moved).chain(excludes_none));
    if frame.unmirrored {
        compared
            .comparison
            .flags
            .push("the file says that the console had mirrored the frame: un-mirrored before comparing".into());
    }
    if let Some(scene) = &posed_scene {
        add_null(&mut compared, scene, reporter)?;
    }
    let prefers = elsewhere(&compared.comparison.null);
    if let Some(found) = &prefers {
        reporter.warn("image disagrees", format!("{}: {found}", args.acquired.display()));
    }
    std::fs::create_dir_all(&args.out).map_err(|source| CompareCommandError::Io { path: args.out.clone(), source })?;
    let result = serde_json::json!({
        "version": env!("CARGO_PKG_VERSION"),
        "acquired": {
            "path": args.acquired.display().to_string(),
            "sha256": frame.sha256,
            "domain_evidence": frame.domain_evidence,
            "notes": frame.notes,
        },
        "simulated": { "path": args.simulated.display().to_string(), "sha256": sha256_file(&args.simulated)? },
        "comparison": compared.comparison,
        "image_prefers": prefers,
    });
    let text = format!("{result:#}\n");
    write_atomically(&json_path, |file| file.write_all(text.as_bytes()))?;
    write_png_rgb(&strip_path, &picture(&frame, &compared, pose.as_ref(), posed_scene.as_ref()))?;
    if args.json {
        print!("{text}");
    } else {
        let of_images = compared.comparison.disagreements.iter().map(ToString::to_string);
        let warned: Vec<String> = of_images.chain(warned).chain(prefers.iter().map(ToString::to_string)).collect();
        print!("{}", table(&compared.comparison, &warned));
    }
    reporter.wrote([&json_path, &strip_path]);
    Ok(0)
}

fn centre(pose: &Pose, scene: Option<&Scene>) -> Option<DVec3> {
    pose.centroid_lps_mm.or_else(|| scene?.bounds().map(|(centre, _)| centre))
}

fn add_null(compared: &mut Compared, scene: &Scene, reporter: &Reporter) -> Result<(), CompareCommandError> {
    // Of poses that are wrong on purpose nothing is to be said: some look past the specimen.
    let mut renderer = Renderer::new(DeviceChoice::Auto, &Reporter::silent())?;
    let asked = Asked { rel_error: SCATTER_ERROR, network: None, budget_ms: None, gpu: renderer.gpu(), keep: None };
    let found = scene.view.as_ref().map_or(Ok(None), |view| scattered(scene, view, &asked, reporter));
    let scatter = found.unwrap_or_else(|error| {
        let words = format!("no scatter in the null, whatever SIMULATED has: {error}");
        reporter.warn("scatter", &words);
        compared.comparison.flags.push(words);
        None
    });
    let network = scatter.as_ref().and_then(|_| NetworkScatter::open(None).ok());
    let far = |scene: &Scene, view: &View| network.as_ref()?.say(scene, view, &Reporter::silent()).ok();
    let scatter = NullScatter { near: scatter.map(Arc::new), far: Some(&far) };
    let bar = reporter.progress("null", crate::compare::NULL_RENDERS as u64);
    let mut renders = NullRenders::new(&mut renderer, scene, None, scatter);
    let mut rerender = |view: &View| {
        bar.advance(1);
        renders.render(view)
    };
    if let Err(error) = compared.add_null(&mut rerender, &|| false) {
        reporter.warn("null", &error);
        compared.comparison.flags.push(error.to_string());
    }
    Ok(())
}

/// What the strip marks in the frame.
fn marked(pose: &Pose, scene: Option<&Scene>) -> PairMarks {
    let view = pose.camera().zip(pose.size_px);
    let view = view.map(|((intrinsics, camera_from_lps), size_px)| View { size_px, intrinsics, camera_from_lps });
    let through = scene.and_then(|scene| scene.detector.panel.intensifier.as_ref()?.for_size(pose.size_px?).ok());
    PairMarks::of(pose, through.as_ref().map(|through| &through.distortion), view.as_ref(), scene)
}

fn picture(frame: &Frame, compared: &Compared, pose: Option<&Pose>, scene: Option<&Scene>) -> Image<[u8; 3]> {
    let (standing, status) = match pose {
        Some(pose) if pose.camera().is_some() => {
            let rms = pose.rms_px.map(|px| format!("rms {px:.3} px")).unwrap_or_default();
            let rms = pose.rms_mm.map_or(rms.clone(), |mm| format!("{rms} ({mm:.3} mm)"));
            match (elsewhere(&compared.comparison.null), &pose.doubt) {
                (Some(found), _) => (Standing::ImageDisagrees, format!("{rms} · {found}")),
                (None, Some(doubt)) => (Standing::InDoubt, format!("{rms} · {doubt}")),
                (None, None) if pose.cautions.is_empty() => (Standing::Accepted, rms),
                (None, None) => (Standing::Accepted, format!("{rms} · with caution: {}", pose.cautions.join("; "))),
            }
        }
        Some(pose) => (Standing::Refused, pose.reason.clone().unwrap_or_default()),
        None => (Standing::NoPose, "pose not given".into()),
    };
    strip(&StripInput {
        acquired: frame,
        pictures: Some(&*compared.pictures),
        masks: None,
        without: None,
        marks: pose.map(|pose| marked(pose, scene)).as_ref(),
        standing,
        status: &status,
        scores: &score_words(&compared.comparison.scores, &compared.comparison.null),
        mm_per_px: compared.comparison.mm_per_px,
    })
}

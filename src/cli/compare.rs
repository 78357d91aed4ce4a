//! `sidecarm compare`: one acquired frame, one simulated image, honest numbers.

use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};

use super::read_aloud::frame_aloud;
use crate::acquire::{AcquireError, DetectorCalibration, DetectorCalibrationError, Domain, Frame};
use crate::compare::{
    AirLevel, CompareError, CompareInput, Compared, NULL_SCORES, NullRenders, OffsetRule, Tone, bead_marks, compare, elsewhere,
    posed_scene, tool_mask,
};
use crate::geometry::{PanelWindow, View};
use crate::gpu::DeviceChoice;
use crate::image::{Image, ImageFileError, read_tiff_f32, refuse_overwrite, sha256_file, write_atomically, write_png_rgb};
use crate::pose::{BeadResidual, Pose, PoseFileError};
use crate::render::{RenderError, Renderer, guessed};
use crate::report::{Standing, StripInput, score_words, strip};
use crate::reporter::Reporter;
use crate::scene::model::Scene;
use crate::scene::{SceneError, input_files, load};

/// Compare an acquired radiograph with a simulated one: scores, masks, and every score against wrong poses.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm compare frame.dcm drr.tif --out compared
  sidecarm compare frame.dcm drr.tif --scene scene.json --pose POSE.json --tone gain --out compared

DIR/compare.json holds the numbers, DIR/strip.png acquired | matched DRR | signed difference | edges. With --scene and --pose each
score is put against its null: the same score at +-1, 3, 10 mm and +-1, 3 degrees. Exit code 1: refused (too little left to score).")]
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
    /// What to leave out: an image whose non-zero pixels are excluded, of either image's size
    #[arg(long, value_name = "M")]
    pub mask: Option<PathBuf>,
    /// What may be fitted between the two: none, gain, log_affine, monotone (display images only)
    #[arg(long, value_name = "TONE", default_value = "none")]
    pub tone: Tone,
    /// Air level: open (from pixels that the simulation predicts to be air), maximum (the paper's rule), unknown, or a number
    #[arg(long, value_name = "AIR", default_value = "open")]
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

/// Why nothing was compared.
#[derive(Debug, thiserror::Error)]
pub enum CompareCommandError {
    /// The acquired frame.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// The detector calibration cannot be read, or does not apply to the frame.
    #[error(transparent)]
    Detector(#[from] DetectorCalibrationError),
    /// The simulated image, or an output.
    #[error(transparent)]
    Image(#[from] ImageFileError),
    /// The pose.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The renderer of the null.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// Refused.
    #[error(transparent)]
    Compare(#[from] CompareError),
    /// A render that says of itself that pixels are invalid, without the mask that says which.
    #[error("{path}: is not there, but {percent:.1} % of the simulated image are invalid; copy it along, or render again", path = path.display())]
    NoValidity {
        /// The mask.
        path: PathBuf,
        /// Share of invalid pixels.
        percent: f64,
    },
    /// A file that cannot be read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nothing says what the simulated image holds.
    #[error("{path}: quantity is {found}, a comparison needs intensity or line_integral (--quantity, or IMAGE.tif.json beside it)", path = path.display())]
    Quantity {
        /// The simulated image.
        path: PathBuf,
        /// What was found.
        found: String,
    },
    /// Several pages.
    #[error("{path}: holds {found} pages, a comparison needs one", path = path.display())]
    Pages {
        /// The simulated image.
        path: PathBuf,
        /// How many.
        found: usize,
    },
    /// A mask that is no picture.
    #[error("{path}: not a readable mask ({detail})", path = path.display())]
    Mask {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        detail: String,
    },
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
    let mut window = PanelWindow::WHOLE;
    // The pose is that of the picture with the console's doing undone.
    if let Some(console) = pose.as_ref().and_then(|pose| pose.console.as_ref()) {
        window = console.window(frame.size_px.map(|side| side as u32));
        frame = frame.oriented(console, pose.as_ref().and_then(|pose| pose.detector.as_ref()?.size_px));
    }
    if let Some(path) = &args.detector {
        frame = DetectorCalibration::apply_file(path, &frame, window)?;
    }
    let simulated = read_simulated(&args.simulated, args.quantity.as_deref())?;
    let valid = read_flags(&beside(&args.simulated, "valid.png"))?;
    let described = described(&args.simulated);
    if let (None, Some(share)) = (&valid, described["share_invalid"].as_f64().filter(|share| *share > 0.0)) {
        return Err(CompareCommandError::NoValidity { path: beside(&args.simulated, "valid.png"), percent: 100.0 * share });
    }
    let extra = args.mask.as_deref().map(read_mask).transpose()?;
    let scene = args.scene.as_deref().map(|path| load(path, false, reporter)).transpose()?;
    if let (Some(path), Some(scene)) = (&args.scene, &scene) {
        refuse_overwrite(&[&json_path, &strip_path], &input_files(path, scene))?;
    }
    let view = pose.as_ref().and_then(|pose| view_of(pose, &simulated, reporter));
    let beads = view.zip(pose.as_ref()).map(|(view, pose)| marks(pose, &view, scene.as_ref())).unwrap_or_default();
    let posed = scene.as_ref().zip(pose.as_ref()).zip(view).map(|((scene, pose), view)| posed_scene(scene, pose, view));
    let posed_scene = posed.transpose()?;
    let guessed = match &posed_scene {
        Some(scene) => guessed(scene)?,
        None => read_flags(&beside(&args.simulated, "guessed.png"))?,
    };
    let tool = posed_scene.as_ref().zip(view.as_ref()).and_then(|(scene, view)| tool_mask(scene, view));
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
        centre_lps_mm: pose.as_ref().and_then(|pose| centre(pose, scene.as_ref())),
        ..CompareInput::new(&frame, &simulated)
    };
    let mut compared = compare(&input)?;
    if frame.unmirrored {
        compared
            .comparison
            .flags
            .push("the file says that the console had mirrored the frame: un-mirrored before comparing".into());
    }
    if let Some(scene) = &posed_scene {
        add_null(&mut compared, scene, reporter)?;
    }
    std::fs::create_dir_all(&args.out).map_err(|source| CompareCommandError::Io { path: args.out.clone(), source })?;
    let result = serde_json::json!({
        "version": env!("CARGO_PKG_VERSION"),
        "acquired": { "path": args.acquired.display().to_string(), "sha256": frame.sha256, "domain_evidence": frame.domain_evidence },
        "simulated": { "path": args.simulated.display().to_string(), "sha256": sha256_file(&args.simulated)? },
        "comparison": compared.comparison,
    });
    let text = format!("{result:#}\n");
    write_atomically(&json_path, |file| file.write_all(text.as_bytes()))?;
    write_png_rgb(&strip_path, &picture(&frame, &compared, pose.as_ref()))?;
    if args.json {
        print!("{text}");
    } else {
        print!("{}", table(&compared));
    }
    Ok(0)
}

/// `IMAGE.tif` → `IMAGE.tif.suffix`.
fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(suffix);
    PathBuf::from(name)
}

/// What `render` wrote about an image; null where there is nothing.
fn described(path: &Path) -> serde_json::Value {
    let bytes = std::fs::read(beside(path, "json")).ok();
    bytes.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default()
}

/// The simulated line integral; what has no logarithm is NaN.
fn read_simulated(path: &Path, quantity: Option<&str>) -> Result<Image<f32>, CompareCommandError> {
    let described = described(path)["quantity"].as_str().map(str::to_owned);
    let found = quantity.map(str::to_owned).or(described).unwrap_or_else(|| "not known".into());
    let mut pages = read_tiff_f32(path)?;
    let image = match (pages.len(), pages.pop()) {
        (1, Some(image)) => image,
        (found, _) => return Err(CompareCommandError::Pages { path: path.to_owned(), found }),
    };
    match found.as_str() {
        "line_integral" => Ok(image),
        "intensity" => Ok(image.map(|&i| if i > 0.0 { -i.ln() } else { f32::NAN })),
        _ => Err(CompareCommandError::Quantity { path: path.to_owned(), found }),
    }
}

/// What `render` writes beside an image where some pixels are invalid, or show a guess: 1 where the picture is white.
fn read_flags(path: &Path) -> Result<Option<Image<u8>>, CompareCommandError> {
    if !path.exists() {
        return Ok(None);
    }
    Ok(Some(read_mask(path)?.map(|valid| u8::from(*valid))))
}

/// True where a pixel is not zero.
fn read_mask(path: &Path) -> Result<Image<bool>, CompareCommandError> {
    let unreadable = |detail: String| CompareCommandError::Mask { path: path.to_owned(), detail };
    let bytes = std::fs::read(path).map_err(|source| CompareCommandError::Io { path: path.to_owned(), source })?;
    let decoded = image::load_from_memory(&bytes).map_err(|error| unreadable(error.to_string()))?.to_luma16();
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let pixels = decoded.into_raw().into_iter().map(|value| value != 0).collect();
    Image::from_pixels(width, height, pixels).ok_or_else(|| unreadable("pixels are missing".into()))
}

/// The view of the simulated image: that of the pose, binned where the image is a whole fraction of it.
fn view_of(pose: &Pose, simulated: &Image<f32>, reporter: &Reporter) -> Option<View> {
    let Some((intrinsics, camera_from_lps)) = pose.camera() else {
        let reason = pose.reason.as_deref().unwrap_or("no reason given");
        reporter.warn("pose", format!("the pose is refused ({reason}): no distances in mm, no null"));
        return None;
    };
    let size_px = [simulated.width as u32, simulated.height as u32];
    let full = pose.size_px.unwrap_or(size_px);
    let factor = full[0].checked_div(size_px[0]).unwrap_or(0);
    if factor == 0 || full[0] / factor != size_px[0] || full[1] / factor != size_px[1] {
        reporter.warn(
            "pose",
            format!("the pose is for images of {full:?} px, the simulated one has {size_px:?}: no distances in mm, no null"),
        );
        return None;
    }
    Some(View { size_px, intrinsics: intrinsics.binned(f64::from(factor)), camera_from_lps })
}

/// Beads by the pose's file; a matched shadow tells the size.
fn marks(pose: &Pose, view: &View, scene: Option<&Scene>) -> Vec<(DVec2, f64)> {
    let camera_from_lps = view.camera_from_lps;
    let full_fx = pose.intrinsics.map_or(view.intrinsics.fx, |k| k.fx);
    let radius_mm = |bead: &BeadResidual| {
        let shadow = pose.shadows.iter().find(|shadow| shadow.bead.as_ref() == Some(&bead.name))?;
        Some(shadow.radius_px * camera_from_lps.transform_point(bead.lps_mm).z / full_fx)
    };
    bead_marks(pose.beads.iter().map(|bead| (pose.place_of(&bead.body, bead.lps_mm), radius_mm(bead))), view, scene)
}

fn centre(pose: &Pose, scene: Option<&Scene>) -> Option<DVec3> {
    pose.centroid_lps_mm.or_else(|| scene?.bounds().map(|(centre, _)| centre))
}

fn add_null(compared: &mut Compared, scene: &Scene, reporter: &Reporter) -> Result<(), CompareCommandError> {
    let mut renderer = Renderer::new(DeviceChoice::Auto, reporter)?;
    let bar = reporter.progress("null", crate::compare::NULL_RENDERS as u64);
    let mut renders = NullRenders::new(&mut renderer, scene, None);
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

fn picture(frame: &Frame, compared: &Compared, pose: Option<&Pose>) -> Image<[u8; 3]> {
    let (standing, status) = match pose {
        Some(pose) if pose.camera().is_some() => {
            let rms = pose.rms_px.map(|px| format!("rms {px:.3} px")).unwrap_or_default();
            let rms = pose.rms_mm.map_or(rms.clone(), |mm| format!("{rms} ({mm:.3} mm)"));
            match elsewhere(&compared.comparison.null) {
                Some(found) => (Standing::ImageDisagrees, format!("{rms} · {found}")),
                None => (Standing::Accepted, rms),
            }
        }
        Some(pose) => (Standing::Refused, pose.reason.clone().unwrap_or_default()),
        None => (Standing::NoPose, "pose not given".into()),
    };
    strip(&StripInput {
        acquired: frame,
        pictures: Some(&compared.pictures),
        without: None,
        standing,
        status: &status,
        scores: &score_words(&compared.comparison.scores, &compared.comparison.null),
        mm_per_px: compared.comparison.mm_per_px,
    })
}

/// Scores, each with its null; then masks, tone, air level and flags.
fn table(compared: &Compared) -> String {
    let found = &compared.comparison;
    let number = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.4}"));
    let mut text = format!("{:<18}{:>10}  {:>10}  {:>10}  {}\n", "score", "here", "null size", "best null", "rank");
    for (name, _) in NULL_SCORES {
        let (small, best, rank) = match found.null.get(name) {
            Some(null) => {
                let doubt = if null.discriminating { "" } else { ", not discriminating" };
                let at = null.best_shift.as_deref().unwrap_or("nowhere");
                (
                    number(null.at_pose),
                    number(null.best_shifted),
                    format!("{} of {} (best wrong: {at}{doubt})", null.rank, null.of),
                )
            }
            None => ("-".into(), "-".into(), found.scores.reasons.get(name).cloned().unwrap_or_default()),
        };
        text += format!("{name:<18}{:>10}  {small:>10}  {best:>10}  {rank}", number(found.scores.get(name))).trim_end();
        text.push('\n');
    }
    for name in ["edge_distance_mm", "bias_nepers", "noise_nepers"] {
        let reason = found.scores.reasons.get(name).map(String::as_str).unwrap_or_default();
        text += format!("{name:<18}{:>10}  {reason}", number(found.scores.get(name))).trim_end();
        text.push('\n');
    }
    let causes: Vec<String> =
        found.masks.causes.iter().map(|(cause, share)| format!("{} {:.1} %", cause.words(), 100.0 * share)).collect();
    text += &format!(
        "masked {:.1} % ({})\n",
        100.0 * found.masks.masked,
        if causes.is_empty() { "nothing".into() } else { causes.join(", ") }
    );
    text += &format!(
        "domain {}, tone {} with {} fitted numbers, ",
        found.domain,
        found.tone.tone.as_str(),
        found.tone.degrees_of_freedom
    );
    text += &match found.air.level {
        Some(level) => format!("air level {level:.6} ({})", found.air.rule),
        None => "air level unknown".to_owned(),
    };
    if let Some(offset) = &found.air.offset {
        text += &match offset.sigma {
            Some(sigma) => format!(", offset {:.2} ± {sigma:.2} ({})", offset.value, offset.rule),
            None => format!(", offset {:.2} ({})", offset.value, offset.rule),
        };
        text += &offset.reason.as_ref().map(|reason| format!(": {reason}")).unwrap_or_default();
    }
    text.push('\n');
    if let (Some(seen), Some(expected)) = (found.scores.noise_nepers, found.noise_expected_nepers) {
        text += &format!("noise {seen:.4} nepers, the detector calibration expects {expected:.4}\n");
    }
    if let Some(prefers) = elsewhere(&found.null) {
        text += &format!("{prefers}\n");
    }
    found.flags.iter().for_each(|flag| text += &format!("note: {flag}\n"));
    text
}

//! `sidecarm pose convert`: a pose in the words of other tools, and back.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use serde_json::{Map, Value, json};

use super::pose_losses::{PitchContradiction, beyond_panel, implausible, settle_pitch, unkept, unused};
use crate::foreign::read_small;
use crate::geometry::formats::{ExchangedCamera, Format, FormatError, Known, PatientAxes, read, recognise, write};
use crate::geometry::{AngleConvention, CameraError, PatientPosition, View};
use crate::image::{ImageFileError, refuse_overwrite, write_atomically};
use crate::pose::{IntrinsicsFile, Pose, PoseFileError, Status, is_pitch};
use crate::reporter::Reporter;
use crate::table::unmarked;

/// Poses as other tools write and read them.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm pose convert POSE.json --to opencv --out camera.yml")]
pub struct PoseArgs {
    /// What to do
    #[command(subcommand)]
    pub action: PoseAction,
}

/// What can be done with a pose.
#[derive(Clone, Debug, Subcommand)]
pub enum PoseAction {
    /// Convert a pose to or from the format of another tool
    Convert(ConvertArgs),
}

/// Convert a pose to or from the format of another tool.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm pose convert POSE.json --to opencv --out camera.yml
  sidecarm pose convert geometry.xml --to pose --intrinsics K.json --out POSE.json

Formats:
  pose      our pose file
  matrix    P as 3 rows of 4 numbers; read: any positive scale
  kr        K as 3 rows of 3 numbers, then [R|t] as 3 rows of 4; kr-json: the same as JSON
  opencv    FileStorage YAML: camera_matrix, rvec, tvec, image_width, image_height
  rtk       ThreeDCircularProjectionGeometry XML; needs size and pitch, writing and reading
  deepdrr   CameraProjection's configuration as JSON (CameraProjection.from_config)
  xreg      the cam-model datasets as JSON; xreg-neg-z, xreg-on-detector: its other camera frames (mirrored)
  slicer    ITK transform in text (.tfm), for 3D Slicer: pose only

Coordinates: patient mm in LPS (deepdrr: RAS, see --axes). The centre of the first pixel is (0, 0) everywhere but in DeepDRR, where
it is (0.5, 0.5), and in RTK, whose detector is in mm with its origin in the middle and v upwards. What each format says of frames and
what it does not keep is told on standard error, and in the answer of --json.

Exit code 0: converted; 1: refused, or not convertible (said why).")]
pub struct ConvertArgs {
    /// The pose: our pose file, or a file of another tool
    pub pose: PathBuf,
    /// Format to write
    #[arg(long, value_name = "FORMAT")]
    pub to: Target,
    /// Format of POSE; recognised by content and ending where not given
    #[arg(long, value_name = "FORMAT")]
    pub from: Option<Target>,
    /// K, size and pitch where POSE has none: {"intrinsics": 3x3, "size_px": [columns, rows], "pitch_mm": p}
    #[arg(long, value_name = "K.json")]
    pub intrinsics: Option<PathBuf>,
    /// Image size in pixels, where POSE and --intrinsics have none
    #[arg(long, value_name = "COLUMNS,ROWS", value_delimiter = ',', num_args = 1)]
    pub size: Vec<u32>,
    /// Pixel pitch at the detector, where POSE and --intrinsics have none; two numbers for pixels that are not square
    #[arg(long, value_name = "MM", value_delimiter = ',', num_args = 1, allow_negative_numbers = true)]
    pub pitch: Vec<f64>,
    /// Patient axes of the other tool's file: lps or ras; by default those the tool uses (deepdrr: ras, others: lps)
    #[arg(long, value_name = "AXES")]
    pub axes: Option<PatientAxes>,
    /// How the patient lies, for the C-arm angles in the answer of --json: HFS, HFP, FFS or FFP
    #[arg(long, value_name = "POSITION", default_value = "HFS")]
    pub position: PatientPosition,
    /// Where the result is written; standard output if absent
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Print one JSON object: camera, C-arm angles, conventions, losses, and the result itself unless --out is given
    #[arg(long)]
    pub json: bool,
}

/// One end of a conversion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// Our pose file.
    Pose,
    /// A foreign format.
    Foreign(Format),
}

impl std::str::FromStr for Target {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        if word == "pose" {
            return Ok(Self::Pose);
        }
        word.parse().map(Self::Foreign).map_err(|error: String| error.replace("one of", "one of pose,"))
    }
}

impl Target {
    fn name(self) -> &'static str {
        match self {
            Self::Pose => "pose",
            Self::Foreign(format) => format.name(),
        }
    }
}

/// Why nothing was converted.
#[derive(Debug, thiserror::Error)]
pub enum ConvertError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nothing is known of this kind of file.
    #[error("{path}: no pose in a format that is known here; name it with --from", path = path.display())]
    Unrecognised {
        /// The file.
        path: PathBuf,
    },
    /// Both ends are our own.
    #[error("{path}: is a pose file already; name another format with --to", path = path.display())]
    Already {
        /// The file.
        path: PathBuf,
    },
    /// A refused pose.
    #[error("{path}: the pose was refused, so there is no projection to convert: {reason}", path = path.display())]
    Refused {
        /// The file.
        path: PathBuf,
        /// As in the file.
        reason: String,
    },
    /// A pose file without a pose.
    #[error("{path}: has neither projection nor camera_from_lps, so there is nothing to convert", path = path.display())]
    NoPose {
        /// The file.
        path: PathBuf,
    },
    /// P is not K \[R|t\].
    #[error("{path}: projection and intrinsics with camera_from_lps differ by {difference:.1e} of its largest entry", path = path.display())]
    Contradiction {
        /// The file.
        path: PathBuf,
        /// Relative to the largest entry.
        difference: f64,
    },
    /// Two pitches that K contradicts.
    #[error("{path}: {source}", path = path.display())]
    Pitch {
        /// The file.
        path: PathBuf,
        /// Found and expected.
        source: PitchContradiction,
    },
    /// The text is not of its format, or holds no camera.
    #[error("{path}: {format}: {source}", path = path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// The format.
        format: &'static str,
        /// What is wrong.
        source: FormatError,
    },
    /// No X-ray camera.
    #[error("{path}: {source}", path = path.display())]
    Camera {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: CameraError,
    },
    /// The pose or K file.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// The result.
    #[error(transparent)]
    Output(#[from] ImageFileError),
    /// An option that cannot be.
    #[error("--{option} is {found}, expected {expected}")]
    Option {
        /// Which.
        option: &'static str,
        /// What was typed.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// The answer cannot be turned into JSON.
    #[error("answer as JSON: {0}")]
    Json(#[from] serde_json::Error),
}

/// Converts, writes or prints. Returns the exit code.
///
/// # Errors
/// When an input cannot be read, holds no pose, or cannot be said in the other format.
pub fn run(args: &PoseArgs, reporter: &Reporter) -> Result<u8, ConvertError> {
    let PoseAction::Convert(args) = &args.action;
    let inputs: Vec<&PathBuf> = std::iter::once(&args.pose).chain(&args.intrinsics).collect();
    refuse_overwrite(&args.out.iter().collect::<Vec<_>>(), &inputs)?;
    let known = known(args)?;
    let (from, mut camera, mut warnings) = load(args, &known)?;
    if from == Target::Pose && args.to == Target::Pose {
        return Err(ConvertError::Already { path: args.pose.clone() });
    }
    let typed_mm = known.pitch_mm.filter(|_| !args.pitch.is_empty());
    let settled = settle_pitch(&mut camera, typed_mm, args.to == Target::Pose);
    warnings.extend(settled.map_err(|source| ConvertError::Pitch { path: args.pose.clone(), source })?);
    let typed_size_px = known.size_px.filter(|_| !args.size.is_empty());
    warnings.extend(unused(&camera, typed_size_px, known.intrinsics));
    warnings.extend(implausible(&camera.camera_from_lps).or_else(|| beyond_panel(&camera)));
    let text = match args.to {
        Target::Pose => serde_json::to_string_pretty(&pose_of(&camera, from))? + "\n",
        Target::Foreign(format) => {
            let axes = args.axes.unwrap_or(format.usual_axes());
            write(format, &camera, axes).map_err(|source| ConvertError::Format {
                path: args.pose.clone(),
                format: format.name(),
                source,
            })?
        }
    };
    if let Some(out) = &args.out {
        write_atomically(out, |file| file.write_all(text.as_bytes()))?;
    }
    let foreign = |target| if let Target::Foreign(format) = target { Some(format) } else { None };
    let convention = foreign(args.to).or(foreign(from)).map(Format::convention);
    let loses = foreign(args.to).and_then(Format::loses);
    if args.json {
        println!("{:#}", answer(args, from, &camera, convention, loses, &warnings, &text));
    } else if args.out.is_none() {
        print!("{text}");
    }
    warnings.iter().for_each(|words| reporter.warn("conversion", words));
    let notes = camera.notes.iter().map(String::as_str).chain(convention).chain(loses);
    notes.for_each(|sentence| reporter.note(format!("note: {sentence}")));
    reporter.wrote(&args.out);
    Ok(0)
}

/// What the options say of the panel.
fn known(args: &ConvertArgs) -> Result<Known, ConvertError> {
    let file = args.intrinsics.as_deref().map(IntrinsicsFile::read).transpose()?;
    let size_px = match args.size[..] {
        [] => file.and_then(|file| file.size_px),
        [columns, rows] if columns > 0 && rows > 0 => Some([columns, rows]),
        _ => {
            let found = format!("{:?}", args.size);
            return Err(ConvertError::Option { option: "size", found, expected: "columns and rows, both at least 1" });
        }
    };
    let pitch_mm = match args.pitch[..] {
        [] => file.and_then(|file| file.pitch_mm).map(|pitch| [pitch, pitch]),
        [pitch] if is_pitch(pitch) => Some([pitch, pitch]),
        [x, y] if is_pitch(x) && is_pitch(y) => Some([x, y]),
        _ => {
            let found = format!("{:?}", args.pitch);
            return Err(ConvertError::Option { option: "pitch", found, expected: "one or two positive numbers, at most 100 mm" });
        }
    };
    Ok(Known { intrinsics: file.map(|file| file.intrinsics), size_px, pitch_mm })
}

/// The camera of `args.pose`, the format it was in, and what of it is lost on the way.
fn load(args: &ConvertArgs, known: &Known) -> Result<(Target, ExchangedCamera, Vec<String>), ConvertError> {
    let path = &args.pose;
    let bytes = read_small(path).map_err(|source| ConvertError::Read { path: path.clone(), source })?;
    let text = String::from_utf8_lossy(&bytes);
    let text = unmarked(&text);
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let found = match args.from {
        Some(target) => target,
        None => match recognise(text, &name) {
            Some(format) => Target::Foreign(format),
            None if text.trim_start().starts_with('{') => Target::Pose,
            None => return Err(ConvertError::Unrecognised { path: path.clone() }),
        },
    };
    let mut losses = Vec::new();
    let camera = match found {
        Target::Pose => {
            let pose = Pose::read(path)?;
            losses = unkept(&pose, args.to.name());
            camera_of(&pose, path, known)?
        }
        Target::Foreign(format) => {
            let axes = args.axes.unwrap_or(format.usual_axes());
            read(format, text, axes, known).map_err(|source| ConvertError::Format {
                path: path.clone(),
                format: format.name(),
                source,
            })?
        }
    };
    if let (Some(intrinsics), Some(size_px)) = (camera.intrinsics, camera.size_px) {
        let view = View { size_px, intrinsics, camera_from_lps: camera.camera_from_lps };
        view.check().map_err(|source| ConvertError::Camera { path: path.clone(), source })?;
    }
    Ok((found, camera, losses))
}

/// The camera of a pose file.
fn camera_of(pose: &Pose, path: &Path, known: &Known) -> Result<ExchangedCamera, ConvertError> {
    if pose.status == Status::Refused {
        let reason = pose.reason.clone().unwrap_or_else(|| "no reason given".to_owned());
        return Err(ConvertError::Refused { path: path.to_owned(), reason });
    }
    let camera_error = |source| ConvertError::Camera { path: path.to_owned(), source };
    let decomposed = pose.projection.map(|projection| projection.decompose().map_err(camera_error)).transpose()?;
    let camera_from_lps = pose
        .camera_from_lps
        .or(decomposed.map(|(_, camera_from_lps)| camera_from_lps))
        .ok_or_else(|| ConvertError::NoPose { path: path.to_owned() })?;
    let intrinsics = pose.intrinsics.or(decomposed.map(|(intrinsics, _)| intrinsics)).or(known.intrinsics);
    let camera = ExchangedCamera {
        intrinsics,
        size_px: pose.size_px.or(known.size_px),
        pitch_mm: pose.pitch_mm.map(|pitch| [pitch, pitch]).or(known.pitch_mm),
        ..ExchangedCamera::placed(camera_from_lps)
    };
    if let (Some(stated), Some(composed)) = (pose.projection, camera.projection()) {
        // Which of the two is meant cannot be known; files written by this program agree to rounding.
        const LIMIT: f64 = 1e-6;
        let largest = composed.0.iter().flatten().fold(0.0f64, |largest, x| largest.max(x.abs()));
        let pairs = stated.0.iter().flatten().zip(composed.0.iter().flatten());
        let difference = pairs.map(|(a, b)| (a - b).abs() / largest).fold(0.0f64, f64::max);
        if !(difference <= LIMIT) {
            return Err(ConvertError::Contradiction { path: path.to_owned(), difference });
        }
    }
    Ok(camera)
}

/// A pose file of a camera that another tool states.
fn pose_of(camera: &ExchangedCamera, from: Target) -> Pose {
    let mut notes = vec![format!("converted from {}; no beads were judged here", from.name())];
    notes.extend(camera.notes.iter().cloned());
    let square = |[x, y]: [f64; 2]| (x - y).abs() <= 1e-9 * x;
    if let Some([x, y]) = camera.pitch_mm.filter(|pitch| !square(*pitch)) {
        notes.push(format!("pixels are not square: {x} mm between columns, {y} mm between rows; pitch_mm is the first"));
    }
    Pose {
        projection: camera.projection(),
        intrinsics: camera.intrinsics,
        intrinsics_source: camera.intrinsics.map(|_| "given".to_owned()),
        size_px: camera.size_px,
        pitch_mm: camera.pitch_mm.map(|pitch| pitch[0]),
        camera_from_lps: Some(camera.camera_from_lps),
        notes,
        version: Some(env!("CARGO_PKG_VERSION").to_owned()),
        ..Pose::default()
    }
}

/// The answer of `--json`.
fn answer(
    args: &ConvertArgs,
    from: Target,
    camera: &ExchangedCamera,
    convention: Option<&str>,
    loses: Option<&str>,
    warnings: &[String],
    text: &str,
) -> Value {
    let lps_from_camera = camera.camera_from_lps.rotation.conjugate();
    let angles = AngleConvention::ALL.map(|convention| {
        let degrees = convention.angles(lps_from_camera, args.position).to_degrees();
        let named = convention.angle_names().into_iter().zip(degrees).map(|(name, value)| (name.to_owned(), json!(value)));
        (convention.name().to_owned(), Value::Object(named.collect()))
    });
    let mut map = Map::new();
    map.insert("from".to_owned(), json!(from.name()));
    map.insert("to".to_owned(), json!(args.to.name()));
    map.insert("projection".to_owned(), json!(camera.projection()));
    map.insert("intrinsics".to_owned(), json!(camera.intrinsics));
    map.insert("size_px".to_owned(), json!(camera.size_px));
    map.insert("pitch_mm".to_owned(), json!(camera.pitch_mm));
    map.insert("camera_from_lps".to_owned(), json!(camera.camera_from_lps));
    map.insert("patient_position".to_owned(), json!(args.position.name()));
    map.insert("angles_deg".to_owned(), Value::Object(Map::from_iter(angles)));
    map.insert("convention".to_owned(), json!(convention));
    map.insert("loses".to_owned(), json!(loses));
    map.insert("warnings".to_owned(), json!(warnings));
    map.insert("notes".to_owned(), json!(camera.notes));
    match &args.out {
        Some(out) => map.insert("out".to_owned(), json!(out.display().to_string())),
        None => map.insert("text".to_owned(), json!(text)),
    };
    Value::Object(map)
}

//! `sidecarm calibrate layout SHOTS…`: the beads of a phantom that nobody has measured.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;

use super::calibrate_carm::read_joints;
use super::calibrate_layout_error::CalibrateShotsError;
use super::read_aloud::frame_aloud;
use super::shot_files::{doubted, pretty, read_json, read_priors, shot_name};
use crate::acquire::{Domain, Frame};
use crate::beads::{Detection, Expectation, detect};
use crate::calibrate::carm::Sensors;
use crate::calibrate::phantom::{
    ArmSigma, Asked, CameraErrors, Cameras, Distance, Phantom, PhantomShot, ShotShadow, markups, measure,
};
use crate::geometry::{CarmCalibration, CarmJoints, Intrinsics};
use crate::image::{check_writable, refuse_overwrite, refuse_same_content, write_atomically};
use crate::mask::{self, Cause};
use crate::pose::{Covariance, IntrinsicsFile, Prior, intrinsics_of};
use crate::reporter::Reporter;

/// Shadows of a shot: the best.
const MOST_SHADOWS: usize = 40;
/// Standard deviation of a radius' logarithm up to which it tells the scale.
const MOST_RADIUS_SIGMA: f64 = 0.1;

/// How shots are measured.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Shots of a phantom")]
pub struct ShotsArgs {
    /// Joints at the exposures, CSV or JSON, as for `calibrate carm`
    #[arg(long, value_name = "TABLE", requires_all = ["calibration", "shots"], conflicts_with = "prior")]
    pub joints: Option<PathBuf>,
    /// The arm, for frames of the shots' size
    #[arg(long, value_name = "ARM.json", requires = "joints")]
    pub calibration: Option<PathBuf>,
    /// Where the camera was, roughly: a pose file per shot, in their order; without covariance to 5 degrees and 15 mm
    #[arg(long, value_name = "POSE.json", requires = "shots")]
    pub prior: Vec<PathBuf>,
    /// Standard deviation of the encoders of angles, degrees; of an arm that states how well it is calibrated, in it
    #[arg(long, value_name = "DEG", requires = "joints")]
    pub encoder_sigma_deg: Option<f64>,
    /// Standard deviation of the encoders of lengths, mm; likewise
    #[arg(long, value_name = "MM", requires = "joints")]
    pub encoder_sigma_mm: Option<f64>,
    /// How far each camera is off by itself, degrees; as the arm's calibration states, else 1
    #[arg(long, value_name = "DEG", requires = "joints")]
    pub arm_sigma_deg: Option<f64>,
    /// How far the isocentre is off in each camera by itself, mm; as the arm's calibration states, else 6
    #[arg(long, value_name = "MM", requires = "joints")]
    pub arm_sigma_mm: Option<f64>,
    /// Radius of the beads: written to the layout, and in linear and neper frames their shadows' radii tell the scale
    #[arg(long, value_name = "MM", requires = "shots")]
    pub bead_radius: Option<f64>,
    /// Distance between the centres of two beads, measured otherwise; may be given several times
    #[arg(long, num_args = 3, value_names = ["A", "B", "MM"], requires = "shots")]
    pub distance: Vec<String>,
    /// Standard deviation of the distances, mm
    #[arg(long, value_name = "MM", default_value_t = 0.1)]
    pub distance_sigma: f64,
    /// What the pixel values are: linear, log, display or unknown
    #[arg(long, value_name = "DOMAIN")]
    pub domain: Option<Domain>,
}

/// Measures, writes, prints; exit code 0, or 3 when shots were left out.
///
/// # Errors
/// When a file cannot be read or written, an option makes no sense, or the shots do not tell the layout.
pub fn run(
    shots: &[PathBuf],
    args: &ShotsArgs,
    intrinsics: Option<&Path>,
    out: &Path,
    json: bool,
    reporter: &Reporter,
) -> Result<u8, CalibrateShotsError> {
    check(args)?;
    let name = out.to_string_lossy().into_owned();
    let stem = name.strip_suffix(".mrk.json").ok_or_else(|| CalibrateShotsError::Extension { path: out.to_owned() })?;
    let outputs = [out.to_owned(), PathBuf::from(format!("{stem}.report.json"))];
    let named = args.joints.iter().chain(&args.calibration).map(PathBuf::as_path).chain(intrinsics);
    let inputs: Vec<&Path> = shots.iter().chain(&args.prior).map(PathBuf::as_path).chain(named).collect();
    refuse_overwrite(&outputs.each_ref().map(PathBuf::as_path), &inputs)?;
    refuse_same_content(shots)?;
    check_writable(out)?;
    let distances = distances(args)?;
    let rough = RoughCameras::read(shots, args)?;
    let doubts = rough.doubts(shots, reporter);
    let file = intrinsics.map(IntrinsicsFile::read).transpose()?;
    let mut seen = Vec::new();
    let progress = reporter.progress("finding beads", shots.len() as u64);
    for (number, path) in shots.iter().enumerate() {
        seen.push(rough.shot(number, path, args, file.as_ref(), reporter)?);
        progress.advance(1);
    }
    let errors = rough.errors(args, file.as_ref(), seen.first());
    let asked = Asked {
        shots: &seen,
        errors,
        cameras_from: rough.words().0,
        axes: rough.words().1,
        bead_radius_mm: args.bead_radius,
        distances: &distances,
    };
    let mut phantom = measure(&asked)?;
    phantom.warnings.iter().for_each(|warning| reporter.note(format_args!("warning: {warning}")));
    phantom.warnings.extend(doubts);
    let report = pretty(&phantom);
    for (path, text) in outputs.iter().zip([&pretty(&markups(&phantom, args.bead_radius)), &report]) {
        write_atomically(path, |file| file.write_all(text.as_bytes()))?;
    }
    if json {
        print!("{report}");
    } else {
        print!("{}", table(&phantom));
    }
    reporter.wrote(&outputs);
    for left in &phantom.left_out_shots {
        reporter.warn("shot left out", format_args!("{}: {}", left.shot, left.reason));
    }
    Ok(if phantom.left_out_shots.is_empty() { 0 } else { 3 })
}

fn check(args: &ShotsArgs) -> Result<(), CalibrateShotsError> {
    let limits = [
        ("--encoder-sigma-deg", args.encoder_sigma_deg, 10.0, "0 to 10 degrees"),
        ("--encoder-sigma-mm", args.encoder_sigma_mm, 100.0, "0 to 100 mm"),
        ("--arm-sigma-deg", args.arm_sigma_deg, 10.0, "0 to 10 degrees"),
        ("--arm-sigma-mm", args.arm_sigma_mm, 100.0, "0 to 100 mm"),
        ("--bead-radius", args.bead_radius.map(|mm| mm - 0.1), 9.9, "0.1 to 10 mm"),
        ("--distance-sigma", Some(args.distance_sigma - 1e-6), 100.0, "above 0, at most 100 mm"),
    ];
    for (option, value, most, expected) in limits {
        if let Some(found) = value.filter(|value| !(*value >= 0.0 && *value <= most)) {
            return Err(CalibrateShotsError::Option { option, found: found.to_string(), expected });
        }
    }
    Ok(())
}

fn distances(args: &ShotsArgs) -> Result<Vec<Distance>, CalibrateShotsError> {
    let one = |words: &[String]| {
        let mm = words[2].parse::<f64>().ok().filter(|mm| *mm > 0.0 && mm.is_finite() && words[0] != words[1]);
        let expected = "two beads and the distance of their centres, as bead-01 bead-09 120.4";
        let wrong = || CalibrateShotsError::Option { option: "--distance", found: words.join(" "), expected };
        let mm = mm.ok_or_else(wrong)?;
        Ok(Distance { beads: [words[0].clone(), words[1].clone()], mm, sigma_mm: args.distance_sigma })
    };
    args.distance.chunks_exact(3).map(one).collect()
}

/// Where the cameras were, as far as stated.
enum RoughCameras {
    Joints { carm: Box<CarmCalibration>, sigma: ArmSigma, joints: BTreeMap<String, CarmJoints> },
    Priors { priors: Vec<Prior>, covariances: Vec<Covariance>, doubts: Vec<Option<String>> },
}

impl RoughCameras {
    fn read(shots: &[PathBuf], args: &ShotsArgs) -> Result<Self, CalibrateShotsError> {
        if let Some((joints, path)) = args.joints.as_ref().zip(args.calibration.as_ref()) {
            let wrong = |detail: String| CalibrateShotsError::Arm { path: path.clone(), detail };
            let carm: CarmCalibration = read_json(path).map_err(wrong)?;
            let stated = ArmSigma::of(&carm);
            let sigma = ArmSigma {
                encoders: Sensors {
                    sigma_deg: args.encoder_sigma_deg.unwrap_or(stated.encoders.sigma_deg),
                    sigma_mm: args.encoder_sigma_mm.unwrap_or(stated.encoders.sigma_mm),
                },
                each_deg: args.arm_sigma_deg.unwrap_or(stated.each_deg),
                each_mm: args.arm_sigma_mm.unwrap_or(stated.each_mm),
                ..stated
            };
            return Ok(Self::Joints { carm: Box::new(carm), sigma, joints: read_joints(joints)? });
        }
        if args.prior.is_empty() {
            return Err(CalibrateShotsError::NoCameras);
        }
        if args.prior.len() != shots.len() {
            return Err(CalibrateShotsError::Priors { priors: args.prior.len(), shots: shots.len() });
        }
        let (priors, doubts) = read_priors(&args.prior)?;
        let covariances = Cameras::by_priors(&priors);
        Ok(Self::Priors { priors, covariances, doubts })
    }

    /// Which shots' priors are in doubt, and why; it is warned of as well.
    fn doubts(&self, shots: &[PathBuf], reporter: &Reporter) -> Vec<String> {
        match self {
            Self::Joints { .. } => Vec::new(),
            Self::Priors { doubts, .. } => doubted(shots, doubts, reporter),
        }
    }

    /// Where they come from, and whose axes the layout has.
    fn words(&self) -> (&'static str, &'static str) {
        match self {
            Self::Joints { .. } => ("joints of the C-arm", "the room (the C-arm's base at zero, z up)"),
            Self::Priors { .. } => ("prior poses", "the priors' lps"),
        }
    }

    fn errors(&self, args: &ShotsArgs, file: Option<&IntrinsicsFile>, first: Option<&PhantomShot>) -> CameraErrors {
        let of_file = file.and_then(|file| {
            let (sigma, pitch_mm) = (file.sigma?, file.pitch_mm?);
            let distance = sigma.source_to_detector_mm / file.intrinsics.source_to_detector_mm(pitch_mm);
            let focal = distance.hypot(sigma.pitch_mm / pitch_mm);
            Some(CameraErrors { focal, principal_point_px: sigma.principal_point_px, ..CameraErrors::default() })
        });
        match (self, first) {
            (Self::Joints { carm, sigma, .. }, Some(first)) => {
                let own = sigma.errors(carm, &first.intrinsics);
                // K of a file is that of its file; how far the arm's cameras stand stays the arm's.
                if file.is_some() { CameraErrors { depth_mm: own.depth_mm, ..of_file.unwrap_or_default() } } else { own }
            }
            _ if args.prior.is_empty() => CameraErrors::default(),
            _ => of_file.unwrap_or_default(),
        }
    }

    fn shot(
        &self,
        number: usize,
        path: &Path,
        args: &ShotsArgs,
        file: Option<&IntrinsicsFile>,
        reporter: &Reporter,
    ) -> Result<PhantomShot, CalibrateShotsError> {
        let frame = frame_aloud(path, args.domain, reporter)?;
        let name = shot_name(path);
        let size_px = frame.size_px.map(|n| n as u32);
        let fits = |of, expected: [u32; 2]| {
            let wrong = || CalibrateShotsError::Size { shot: name.clone(), of, found: size_px, expected };
            if expected == size_px { Ok(()) } else { Err(wrong()) }
        };
        if let Some(expected) = file.and_then(|file| file.size_px) {
            fits("K of --intrinsics", expected)?;
        }
        let of_file = file.map(|file| file.intrinsics);
        let (camera_from_world, intrinsics, covariance) = match self {
            Self::Joints { carm, sigma, joints } => {
                if of_file.is_none() {
                    fits("--calibration", [carm.columns_px, carm.rows_px])?;
                }
                let mut joints = *joints.get(&name).ok_or_else(|| CalibrateShotsError::NoJoints { shot: name.clone() })?;
                if let Some(sid_mm) = frame.tags.sid_mm.filter(|_| !joints.source_to_detector_mm.is_finite()) {
                    joints.source_to_detector_mm = sid_mm;
                }
                let camera = Cameras::by_joints(carm, &joints, sigma);
                let (camera, k, covariance) =
                    camera.map_err(|error| CalibrateShotsError::Camera { shot: name.clone(), detail: error.to_string() })?;
                (camera, of_file.unwrap_or(k), covariance)
            }
            Self::Priors { priors, covariances, .. } => {
                let k: Option<Intrinsics> = of_file.or_else(|| intrinsics_of(&frame).map(|(k, ..)| k));
                let k = k.ok_or_else(|| CalibrateShotsError::NoIntrinsics { shot: name.clone() })?;
                (priors[number].camera_from_lps, k, covariances[number])
            }
        };
        let shadows = shadows(&frame);
        Ok(PhantomShot { name, size_px, intrinsics, camera_from_world, covariance, shadows })
    }
}

/// What may be beads, the best first.
fn shadows(frame: &Frame) -> Vec<ShotShadow> {
    let [width, height] = frame.size_px;
    let usable = mask::of_frame(frame).usable(width, height, &[Cause::Saturation, Cause::NoSignal, Cause::BurnedIn]);
    let found = detect(frame, Some(&usable), &Expectation::default()).found;
    // A shadow's size means something where its values do, and where blur does not hide it.
    let in_nepers = frame.domain == Domain::Log && frame.unit.as_deref() == Some("neper");
    let sized = frame.domain == Domain::Linear || in_nepers;
    let shadow = |own: &Detection| ShotShadow {
        image_px: own.image_px,
        noise_px2: own.noise_px2(),
        radius_px: (sized && own.radius_sigma_ln <= MOST_RADIUS_SIGMA).then_some(own.radius_px),
    };
    let finite = |own: &&Detection| own.image_px.is_finite() && own.sigma_px.is_finite();
    found.iter().filter(finite).take(MOST_SHADOWS).map(shadow).collect()
}

fn table(phantom: &Phantom) -> String {
    let mut text = format!(
        "{} beads from {} shots, to {:.3} mm apart from the scale; shadows to {:.3} px, to {:.3} px where the others predict them\nscale ± {:.2} %: {}\n{}\n",
        phantom.beads.len(),
        phantom.shots.len(),
        phantom.shape_sigma_mm,
        phantom.rms_px,
        phantom.left_out_px,
        100.0 * phantom.scale.sigma,
        phantom
            .scale
            .sources
            .iter()
            .map(|own| format!("{} ({:.2} %)", own.source, 100.0 * own.sigma))
            .collect::<Vec<_>>()
            .join(", "),
        phantom.frame
    );
    text += "bead                    x         y         z, mm     sigma   without scale   shots   rms px   by others px\n";
    for bead in &phantom.beads {
        let [x, y, z] = bead.mm;
        text += &format!(
            "{:<16} {x:>9.3} {y:>9.3} {z:>9.3} {:>13.3} {:>15.3} {:>7} {:>8.3} {:>14.3}\n",
            bead.name, bead.sigma_mm, bead.shape_sigma_mm, bead.shots, bead.rms_px, bead.left_out_px
        );
    }
    for shot in &phantom.shots {
        text += &format!(
            "shot {}: {} beads, {} shadows of none, rms {:.3} px, camera {:.1} standard deviations off\n",
            shot.shot, shot.beads, shot.strays, shot.rms_px, shot.camera_off_sigma
        );
    }
    for left in &phantom.left_out_beads {
        let [x, y, z] = left.mm;
        text += &format!("left out: a bead near {x:.1} {y:.1} {z:.1} mm in {} shots: {}\n", left.shots, left.reason);
    }
    text
}

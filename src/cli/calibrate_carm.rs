//! `sidecarm calibrate carm`: a C-arm from a few bead shots.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::Args;

use super::shot_files::{OutOfRange, check_range, csv_table, is_json, is_log, number, pretty, read_json, shot_name};
use crate::calibrate::carm::{CarmFitError, CarmReport, Sensors, Shot, calibrate, plot, shots_of_log};
use crate::foreign::read_small_text;
use crate::geometry::{CarmCalibration, CarmJoints, JOINT_KEYS};
use crate::image::plot::PlotError;
use crate::image::{ImageFileError, check_writable, refuse_overwrite, refuse_same_content, refuse_twice, write_atomically};
use crate::pose::{Pose, PoseFileError};
use crate::record::RecordError;
use crate::reporter::Reporter;

/// Squares in standard deviations over degrees of freedom above this are no luck.
const POOR_FIT: f64 = 4.0;

/// A C-arm from a few bead shots: offsets, source to isocentre, detector, axes and gravity sag.
#[derive(Clone, Debug, Args)]
#[command(after_help = "Examples:
  sidecarm calibrate carm session.mcap --calibration calibration/carm/live-620x480.json --out calibration/carm/lab-3.json
  sidecarm calibrate carm pose-*.json --joints joints.csv --calibration live-620x480.json --encoder-sigma-deg 0.02 --out lab-3.json

A shot is a frame of one specimen that does not move, with an accepted pose and the joints at its exposure: a log of `live` has both, for
POSE.json files of `register` the joints come as a table, one line a shot: frame,lift_mm,wig_wag_deg,longitudinal_mm,angulation_deg,
orbital_deg,detector_rotation_deg,source_to_detector_mm (frame: the POSE file's name without its ending), or as JSON {\"frame\": {joints}}.
What is no shot is said: a refused pose, an exposure during which the arm moved. Ten shots over the whole orbit, at three or more
angulations, make a good calibration. Beside NAME.json stand NAME.report.json (residuals, standard deviation of each parameter) and
NAME.svg (each shot predicted by the others). Exit code 1: the shots do not tell the arm (said why); 3: some shots did not belong to the
others and were left out (said which).")]
pub struct CarmArgs {
    /// POSE.json files of `register`, or logs of sessions
    #[arg(required = true, value_name = "SHOTS")]
    pub shots: Vec<PathBuf>,
    /// Joints at the exposures of POSE.json files, CSV or JSON
    #[arg(long, value_name = "TABLE")]
    pub joints: Option<PathBuf>,
    /// The nominal arm, for frames of the shots' size, or of the panel where the console's doing is declared
    #[arg(long, value_name = "NOMINAL.json")]
    pub calibration: PathBuf,
    /// Standard deviation of the encoders of angles, degrees
    #[arg(long, value_name = "DEG", default_value_t = Sensors::default().sigma_deg)]
    pub encoder_sigma_deg: f64,
    /// Standard deviation of the encoders of lengths, mm
    #[arg(long, value_name = "MM", default_value_t = Sensors::default().sigma_mm)]
    pub encoder_sigma_mm: f64,
    /// Who measured, when, with which instrument; goes into the file
    #[arg(long, value_name = "TEXT")]
    pub origin: Option<String>,
    /// Print the report as JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// The calibration
    #[arg(long, value_name = "NAME.json")]
    pub out: PathBuf,
}

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateCarmError {
    /// A pose file.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// A log.
    #[error(transparent)]
    Log(#[from] RecordError),
    /// The nominal calibration or the table of joints.
    #[error("{path}: {detail}", path = path.display())]
    Input {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// A pose without joints.
    #[error("{shot}: there are no joints of it; add a line `{shot},…` to the table of --joints")]
    NoJoints {
        /// Name of the pose file, without its ending.
        shot: String,
    },
    /// A number that was typed.
    #[error(transparent)]
    Option(#[from] OutOfRange),
    /// The shots.
    #[error(transparent)]
    Fit(#[from] CarmFitError),
    /// The plot.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// An output.
    #[error(transparent)]
    Output(#[from] ImageFileError),
}

/// Calibrates; exit code 0, or 3 when shots were left out.
///
/// # Errors
/// When a file cannot be read or written, an option makes no sense, or the shots do not determine the arm.
pub fn run(args: &CarmArgs, reporter: &Reporter) -> Result<u8, CalibrateCarmError> {
    let sensors = Sensors { sigma_deg: args.encoder_sigma_deg, sigma_mm: args.encoder_sigma_mm };
    check_range([("--encoder-sigma-deg", sensors.sigma_deg, 5.0), ("--encoder-sigma-mm", sensors.sigma_mm, 50.0)])?;
    let outputs = [args.out.clone(), args.out.with_extension("report.json"), args.out.with_extension("svg")];
    let inputs: Vec<&Path> = args.shots.iter().chain(&args.joints).chain([&args.calibration]).map(PathBuf::as_path).collect();
    refuse_twice(&outputs)?;
    refuse_overwrite(&outputs.each_ref().map(PathBuf::as_path), &inputs)?;
    refuse_same_content(&args.shots)?;
    check_writable(&args.out)?;
    let wrong = |detail: String| CalibrateCarmError::Input { path: args.calibration.clone(), detail };
    let nominal: CarmCalibration = read_json(&args.calibration).map_err(wrong)?;
    let shots = read_shots(args, reporter)?;
    let mut fit = calibrate(&shots, &nominal, &sensors)?;
    let said = args.origin.as_deref().unwrap_or("who, when and with what not stated (--origin)");
    fit.calibration.origin = format!(
        "{said}; {} bead shots, encoders {} degrees and {} mm; calibrate carm of sidecarm {}",
        fit.shots.len(),
        sensors.sigma_deg,
        sensors.sigma_mm,
        env!("CARGO_PKG_VERSION")
    );
    let report = CarmReport::new(&fit, &nominal, &sensors);
    let texts = [pretty(&fit.calibration), pretty(&report), plot(&report)?];
    for (path, text) in outputs.iter().zip(&texts) {
        write_atomically(path, |file| file.write_all(text.as_bytes()))?;
    }
    if args.json {
        print!("{}", texts[1]);
    } else {
        print!("{}", table(&report));
    }
    reporter.wrote(&outputs);
    if !(fit.chi2_per_dof <= POOR_FIT) {
        let words = format!(
            "the shots disagree with their joints {:.1} times as much as encoders and beads allow: are pitch, source-to-detector distance and \
             the table of joints those of these shots?",
            fit.chi2_per_dof.sqrt()
        );
        reporter.warn("poor fit", words);
    }
    for parameter in report.parameters.iter().filter(|parameter| parameter.is_far()) {
        let words = format!(
            "{} came out as {:.2}, and {:.2} ± {:.2} is what arms have: an encoder's scale, the layout's or another arm's joints would do that",
            parameter.key, parameter.value, parameter.nominal, parameter.prior_sigma
        );
        reporter.warn("unlike an arm", words);
    }
    for shot in &report.left_out {
        reporter.warn(
            "shot left out",
            format_args!(
                "{}: its beads are {:.1} mm and {:.1} degrees from where its joints and the other shots put them: were its joints read at \
                 another moment, or was the specimen moved?",
                shot.shot, shot.off.piercing_mm, shot.off.attitude_deg
            ),
        );
    }
    Ok(if report.left_out.is_empty() { 0 } else { 3 })
}

fn read_shots(args: &CarmArgs, reporter: &Reporter) -> Result<Vec<Shot>, CalibrateCarmError> {
    let joints = args.joints.as_deref().map(read_joints).transpose()?.unwrap_or_default();
    let mut shots = Vec::new();
    let progress = reporter.progress("reading shots", args.shots.len() as u64);
    for path in &args.shots {
        if is_log(path) {
            let (found, notes) = shots_of_log(path)?;
            notes.iter().for_each(|note| reporter.note(format_args!("note: {note}")));
            shots.extend(found);
            progress.advance(1);
            continue;
        }
        let pose = Pose::read(path)?;
        let name = shot_name(path);
        let of_shot = joints.get(&name).ok_or_else(|| CalibrateCarmError::NoJoints { shot: name.clone() })?;
        if let Some(words) = pose.doubt.as_ref().filter(|_| pose.is_accepted()) {
            reporter.note(format_args!("note: {name} is a shot, but its pose is in doubt: {words}"));
        }
        match Shot::of(&name, &pose, *of_shot) {
            Ok(shot) => shots.push(shot),
            Err(why) => reporter.note(format_args!("note: {name} is no shot: {why}")),
        }
        progress.advance(1);
    }
    Ok(shots)
}

/// Joints by shot: JSON by its ending, else CSV.
pub(super) fn read_joints(path: &Path) -> Result<BTreeMap<String, CarmJoints>, CalibrateCarmError> {
    let wrong = |detail: String| CalibrateCarmError::Input { path: path.to_owned(), detail };
    if is_json(path) {
        return read_json(path).map_err(wrong);
    }
    let text = read_small_text(path).map_err(|error| wrong(error.to_string()))?;
    let known = |key: &str| key == "frame" || JOINT_KEYS.iter().any(|(joint, _)| *joint == key);
    let check = |header: &[&str]| {
        let is_right = header.first() == Some(&"frame") && header.iter().all(|key| known(key));
        if is_right { Ok(()) } else { Err(format!("frame,{} or some of them", JOINT_KEYS.map(|(key, _)| key).join(","))) }
    };
    let row = |header: &[&str], cells: &[&str]| {
        let mut values = serde_json::Map::new();
        for (key, cell) in header.iter().zip(cells).skip(1).filter(|(_, cell)| !cell.is_empty()) {
            values.insert((*key).to_owned(), number(key, cell)?.into());
        }
        serde_json::from_value(values.into()).map_err(|error| error.to_string())
    };
    csv_table(&text, check, row).map_err(wrong)
}

fn table(report: &CarmReport) -> String {
    let mut text = format!(
        "{} shots; each predicted from its joints by the others: piercing point {:.2} mm on the detector, ray {:.3} degrees (rms); chi2 per degree \
         of freedom {:.2}\n",
        report.shots.len(),
        report.held_out_piercing_mm,
        report.held_out_ray_deg,
        report.chi2_per_dof
    );
    text += "shot                         beads px  readings sigma   piercing mm    ray deg  attitude deg\n";
    for shot in &report.shots {
        let off = &shot.held_out;
        text += &format!(
            "{:<28} {:>8.3} {:>15.2} {:>13.2} {:>10.3} {:>13.3}\n",
            shot.shot, shot.rms_px, shot.readings_off_sigma, off.piercing_mm, off.ray_deg, off.attitude_deg
        );
    }
    for parameter in report.parameters.iter().filter(|parameter| !parameter.key.starts_with("gravity_sag")) {
        let undetermined = if parameter.determined { "" } else { "  not determined by these shots" };
        text += &format!("{:<42} {:>10.3} ± {:<8.3}{undetermined}\n", parameter.key, parameter.value, parameter.sigma);
    }
    let largest = |table: &str| {
        let of_table = report.parameters.iter().filter(|parameter| parameter.key.starts_with(&format!("gravity_sag.{table}")));
        of_table.map(|parameter| parameter.value.abs()).fold(0.0, f64::max)
    };
    let [source_mm, rotation_deg, detector_mm] = ["source_mm", "rotation_deg", "detector_mm"].map(largest);
    text += &format!(
        "gravity sag, largest coefficients: {source_mm:.2} mm at the source, {rotation_deg:.2} degrees, {detector_mm:.2} mm at the detector\n"
    );
    text
}

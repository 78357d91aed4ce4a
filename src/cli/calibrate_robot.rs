//! `sidecarm calibrate robot`: the robot's base and control-angle offsets from frames in which it is seen.

use std::path::{Path, PathBuf};

use clap::Args;

use super::calibrate_robot_error::CalibrateRobotError;
use super::calibrate_robot_shots::{ShotFiles, read_shots};
use super::shot_files::{check_range, pretty};
use crate::acquire::Domain;
use crate::calibrate::robot::{Assumed, RobotReport, calibrate, plot};
use crate::image::{check_writable, refuse_overwrite, refuse_same_content, refuse_twice, write_atomically};
use crate::reporter::Reporter;
use crate::scene::{input_files, load};

/// Load and friction bend the tip of this robot, 39 mm long, by a few millimetres.
const MOST_LOAD_MM: f64 = 5.0;

/// The snake robot's base and control-angle offsets from frames in which it is seen; load bend as the tip's discrepancy in mm.
#[derive(Clone, Debug, Args)]
#[command(after_help = "Examples:
  sidecarm calibrate robot pose-*.json --angles angles.csv --scene scene.json --out robot-lab.json
  sidecarm calibrate robot session.mcap --scene scene.json --guess-sigma-mm 15 --out robot-lab.json

A shot is a frame with the robot in view, its accepted pose and the control angles at its exposure. A log of `live` has all three; for
POSE.json files of `register` the rest comes as a table, one line a shot: frame,image,angle_1_deg,angle_2_deg,angle_3_deg,angle_4_deg,
angle_5_deg (frame: the POSE file's name without its ending; image: the acquired frame, from the table's folder), or as JSON
{\"frame\": {\"image\": FILE, \"control_angles_deg\": [5 numbers], \"tracker_from_base\": 4x4 if tracked}}. The scene has the robot, with
lps_from_base roughly where it is. Take six shots or so, from two sides or more, with the robot bent in some. With --tracker, a file
{\"world_from_lps\": 4x4, \"world_from_tracker\": 4x4}, the base is sought in the frame that the tracker reports as the base
(marker_from_base) and may move from shot to shot.

A scene takes the result as \"calibration\": \"robot-lab.json\" in its robot object, in place of lps_from_base; sessions with that scene do
too. Beside NAME.json stand NAME.report.json (residuals, and for each shot how far the drill's tip is from where readings and offsets put
it) and NAME.svg. Exit code 1: the shots do not tell the robot (said why); 3: some shots were left out (said which).")]
pub struct RobotArgs {
    /// POSE.json files of `register`, or logs of sessions
    #[arg(required = true, value_name = "SHOTS")]
    pub shots: Vec<PathBuf>,
    /// Frames and control angles of POSE.json files, CSV or JSON
    #[arg(long, value_name = "TABLE")]
    pub angles: Option<PathBuf>,
    /// The scene: model, rough place of the base, beam
    #[arg(long, value_name = "SCENE.json")]
    pub scene: PathBuf,
    /// Where specimen and tracker are in the room: the base is carried by a tracked marker
    #[arg(long, value_name = "TIE.json")]
    pub tracker: Option<PathBuf>,
    /// Standard deviation of the scene's place of the base, each axis, mm
    #[arg(long, value_name = "MM", default_value_t = Assumed::default().guess_sigma_mm)]
    pub guess_sigma_mm: f64,
    /// Standard deviation of its turn, each axis, degrees
    #[arg(long, value_name = "DEG", default_value_t = Assumed::default().guess_sigma_deg)]
    pub guess_sigma_deg: f64,
    /// Standard deviation of control-angle offsets, degrees
    #[arg(long, value_name = "DEG", default_value_t = Assumed::default().offset_sigma_deg)]
    pub offset_sigma_deg: f64,
    /// Standard deviation of a control angle's reading from shot to shot, degrees
    #[arg(long, value_name = "DEG", default_value_t = Assumed::default().reading_sigma_deg)]
    pub reading_sigma_deg: f64,
    /// What the pixels of frames are, where their files do not say it
    #[arg(long, value_name = "DOMAIN")]
    pub domain: Option<Domain>,
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

/// Calibrates; exit code 0, or 3 when shots were left out.
///
/// # Errors
/// When a file cannot be read or written, an option makes no sense, or the shots do not determine the robot.
pub fn run(args: &RobotArgs, reporter: &Reporter) -> Result<u8, CalibrateRobotError> {
    check_range([
        ("--guess-sigma-mm", args.guess_sigma_mm, 50.0),
        ("--guess-sigma-deg", args.guess_sigma_deg, 30.0),
        ("--offset-sigma-deg", args.offset_sigma_deg, 10.0),
        ("--reading-sigma-deg", args.reading_sigma_deg, 5.0),
    ])?;
    let assumed = Assumed {
        guess_sigma_mm: args.guess_sigma_mm,
        guess_sigma_deg: args.guess_sigma_deg,
        offset_sigma_deg: args.offset_sigma_deg,
        reading_sigma_deg: args.reading_sigma_deg,
        tracked: args.tracker.is_some(),
    };
    let outputs = [args.out.clone(), args.out.with_extension("report.json"), args.out.with_extension("svg")];
    let outputs = outputs.each_ref().map(PathBuf::as_path);
    let inputs: Vec<&Path> = args.shots.iter().chain(&args.angles).chain(&args.tracker).map(PathBuf::as_path).collect();
    refuse_twice(&outputs)?;
    refuse_overwrite(&outputs, &inputs)?;
    refuse_same_content(&args.shots)?;
    check_writable(&args.out)?;
    let scene = load(&args.scene, false, reporter)?;
    refuse_overwrite(&outputs, &input_files(&args.scene, &scene))?;
    let files =
        ShotFiles { shots: &args.shots, angles: args.angles.as_deref(), tracker: args.tracker.as_deref(), domain: args.domain };
    let (shots, frames) = read_shots(&files, &scene, reporter)?;
    refuse_overwrite(&outputs, &frames)?;
    refuse_same_content(&frames)?;
    let mut fit = calibrate(&shots, &scene, &assumed)?;
    let said = args.origin.as_deref().unwrap_or("who, when and with what not stated (--origin)");
    fit.calibration.origin = format!(
        "{said}; the robot's shadow in {} frames from directions up to {:.0} degrees apart; calibrate robot of sidecarm {}",
        fit.shots.len(),
        fit.spread_deg,
        env!("CARGO_PKG_VERSION")
    );
    let report = RobotReport::new(&fit, &assumed);
    let texts = [pretty(&fit.calibration), pretty(&report), plot(&report)?];
    for (path, text) in outputs.iter().zip(&texts) {
        write_atomically(path, |file| file.write_all(text.as_bytes()))?;
    }
    if args.json {
        print!("{}", texts[1]);
    } else {
        print!("{}", table(&report));
    }
    reporter.wrote(outputs);
    for shot in &report.left_out {
        reporter.warn("shot left out", format_args!("{}: {}", shot.shot, shot.why));
    }
    let bent = report
        .shots
        .iter()
        .filter_map(|shot| Some((shot, shot.tip.as_ref()?)))
        .max_by(|a, b| a.1.length_mm.total_cmp(&b.1.length_mm));
    if let Some((shot, tip)) = bent.filter(|(_, tip)| !(tip.length_mm <= MOST_LOAD_MM)) {
        let words = format!(
            "the tip of {} is {:.1} mm from where its readings put it, a load bends by up to {MOST_LOAD_MM} mm: are the angles of another sign, \
             unit or shot?",
            shot.shot, tip.length_mm
        );
        reporter.warn("tip far off", words);
    }
    if !report.undetermined_offsets.is_empty() {
        let angles = report.undetermined_offsets.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        reporter.warn("offset not told", format_args!("control angles {angles}: the shots do not tell their offsets"));
    }
    Ok(if report.left_out.is_empty() { 0 } else { 3 })
}

fn table(report: &RobotReport) -> String {
    let calibration = &report.calibration;
    let [x, y, z] = calibration.base_sigma_mm;
    let [turn_x, turn_y, turn_z] = calibration.base_sigma_deg;
    let mut text = format!(
        "{} shots from directions up to {:.0} degrees apart; chi2 per degree of freedom {:.2}\n\
         base, along its own x, y, z: ± {x:.3}, {y:.3}, {z:.3} mm; about them ± {turn_x:.3}, {turn_y:.3}, {turn_z:.3} degrees; {:.1} mm and {:.1} \
         degrees from the guess\n",
        report.shots.len(),
        report.directions_deg,
        report.chi2_per_dof,
        report.from_guess_mm,
        report.from_guess_deg
    );
    let offsets = calibration.control_angle_offsets_deg.iter().zip(&calibration.control_angle_offsets_sigma_deg);
    for (n, (offset, sigma)) in (1..).zip(offsets) {
        let open = if report.undetermined_offsets.contains(&n) { "  not determined by these shots" } else { "" };
        text += &format!("offset of control angle {n}: {offset:+.3} ± {sigma:.3} degrees{open}\n");
    }
    text += "shot                         profiles  residual px  in sigma   tip off mm (columns, rows)   length mm\n";
    for shot in &report.shots {
        let tip = shot.tip.as_ref().map_or_else(
            || "not in front of the source".to_owned(),
            |tip| {
                format!("{:>+12.2} {:>+12.2}   {:>8.2} ± {:.2}", tip.off_mm[0], tip.off_mm[1], tip.length_mm, tip.length_sigma_mm)
            },
        );
        text += &format!("{:<28} {:>8} {:>12.3} {:>9.2}   {tip}\n", shot.shot, shot.profiles, shot.rms_px, shot.rms_sigma);
    }
    for tip in &report.shared_tips {
        let [x, y, z] = tip.off_in_base_mm;
        text += &format!("in space, from {}: {x:+.2}, {y:+.2}, {z:+.2} mm along the base's x, y, z\n", tip.shots.join(", "));
    }
    text
}

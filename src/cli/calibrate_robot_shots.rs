//! The shots of `calibrate robot`: pose files with a table of frames and control angles, or logs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;

use super::calibrate_robot_error::CalibrateRobotError;
use super::read_aloud::frame_aloud;
use super::shot_files::{csv_table, is_json, is_log, number, read_json, shot_name};
use crate::acquire::{Domain, Frame};
use crate::calibrate::robot::{LoggedShot, NoShot, Shot, shots_of_log};
use crate::foreign::read_small_text;
use crate::geometry::Rigid;
use crate::pose::Pose;
use crate::reporter::Reporter;
use crate::scene::Scene;
use crate::session::logged_frames;

/// What the table says of a pose file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    image: PathBuf,
    control_angles_deg: [f64; 5],
    #[serde(default)]
    tracker_from_base: Option<Rigid>,
}

/// Where specimen and tracker are in the room.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Tie {
    world_from_lps: Rigid,
    world_from_tracker: Rigid,
}

const COLUMNS: [&str; 7] = ["frame", "image", "angle_1_deg", "angle_2_deg", "angle_3_deg", "angle_4_deg", "angle_5_deg"];

/// What was named.
pub(super) struct ShotFiles<'a> {
    pub shots: &'a [PathBuf],
    pub angles: Option<&'a Path>,
    pub tracker: Option<&'a Path>,
    pub domain: Option<Domain>,
}

/// All shots, and the files of their frames.
pub(super) fn read_shots(
    args: &ShotFiles,
    scene: &Scene,
    reporter: &Reporter,
) -> Result<(Vec<Shot>, Vec<PathBuf>), CalibrateRobotError> {
    let rows = args.angles.map(read_rows).transpose()?.unwrap_or_default();
    let tie = args.tracker.map(read_tie).transpose()?;
    let body = scene.robot.as_ref().map_or("", |robot| scene.objects[robot.object].body.as_str());
    let carrier = |pose: &Pose, tracked: Option<Rigid>| match (&tie, tracked) {
        (None, _) => {
            let places = pose.places();
            Some(places.iter().find(|(name, _)| *name == body).map_or(Rigid::IDENTITY, |(_, place)| *place))
        }
        (Some(tie), tracked) => Some(tie.world_from_lps.inverse() * tie.world_from_tracker * tracked?),
    };
    let (mut shots, mut frames) = (Vec::new(), Vec::new());
    let progress = reporter.progress("finding the robot", args.shots.len() as u64);
    for path in args.shots {
        if is_log(path) {
            let (found, notes) = shots_of_log(path)?;
            notes.iter().for_each(|note| reporter.note(format_args!("note: {note}")));
            let found: BTreeMap<u32, LoggedShot> = found.into_iter().map(|shot| (shot.number, shot)).collect();
            // By number: frames come in the order in which they were registered.
            let mut taken: BTreeMap<u32, Option<Shot>> = BTreeMap::new();
            let mut of_frame = |number: u32, frame: Arc<Frame>, said: &[String]| {
                let Some(shot) = found.get(&number) else { return };
                said.iter().for_each(|words| reporter.warn("frame of a log", words));
                let carrier = carrier(&shot.pose, shot.tracker_from_base);
                taken.insert(number, shot_of((&shot.name, &shot.pose, shot.readings_deg, carrier), &frame, reporter));
            };
            let losses = logged_frames(path, &|number| found.contains_key(&number), &mut of_frame)?;
            losses.iter().for_each(|loss| reporter.note(format_args!("note: {loss}")));
            for (_, shot) in found.iter().filter(|(number, _)| !taken.contains_key(*number)) {
                reporter.note(format_args!("note: {} is no shot: its picture is not in the log", shot.name));
            }
            shots.extend(taken.into_values().flatten());
            progress.advance(1);
            continue;
        }
        let pose = Pose::read(path)?;
        let name = shot_name(path);
        let row = rows.get(&name).ok_or_else(|| CalibrateRobotError::NoAngles { shot: name.clone() })?;
        let mut frame = frame_aloud(&row.image, args.domain, reporter)?;
        // The pose is that of the picture with the console's doing undone.
        if let Some(console) = &pose.console {
            frame = frame.oriented(console, pose.detector.as_ref().and_then(|detector| detector.size_px));
        }
        frames.push(row.image.clone());
        let carrier = carrier(&pose, row.tracker_from_base);
        shots.extend(shot_of((&name, &pose, row.control_angles_deg, carrier), &frame, reporter));
        progress.advance(1);
    }
    Ok((shots, frames))
}

/// What a shot is made of, but for the frame: its name, pose, readings in degrees, and `lps_from_carrier`, where that is known.
type Told<'a> = (&'a str, &'a Pose, [f64; 5], Option<Rigid>);

/// A shot, or nothing but a word of why it is none.
fn shot_of((name, pose, readings_deg, carrier): Told, frame: &Frame, reporter: &Reporter) -> Option<Shot> {
    match carrier.ok_or(NoShot::NotTracked).and_then(|carrier| Shot::of(name, frame, pose, readings_deg, carrier)) {
        Ok(shot) => {
            if let Some(words) = &shot.doubt {
                reporter.warn("pose in doubt", format_args!("{name} is a shot, but its pose is in doubt: {words}"));
            }
            Some(shot)
        }
        Err(why) => {
            reporter.note(format_args!("note: {name} is no shot: {why}"));
            None
        }
    }
}

fn read_tie(path: &Path) -> Result<Tie, CalibrateRobotError> {
    let wrong = |detail: String| CalibrateRobotError::Input { path: path.to_owned(), detail };
    read_json(path).map_err(wrong)
}

/// Rows by shot, their images from the table's folder: JSON by its ending, else CSV.
fn read_rows(path: &Path) -> Result<BTreeMap<String, Row>, CalibrateRobotError> {
    let wrong = |detail: String| CalibrateRobotError::Input { path: path.to_owned(), detail };
    let mut rows: BTreeMap<String, Row> = if is_json(path) {
        read_json(path).map_err(wrong)?
    } else {
        let text = read_small_text(path).map_err(|error| wrong(error.to_string()))?;
        parse_csv(&text).map_err(wrong)?
    };
    let folder = path.parent().unwrap_or(Path::new(""));
    rows.values_mut().for_each(|row| row.image = folder.join(&row.image));
    Ok(rows)
}

fn parse_csv(text: &str) -> Result<BTreeMap<String, Row>, String> {
    let check = |header: &[&str]| if header == COLUMNS { Ok(()) } else { Err(COLUMNS.join(",")) };
    let row = |header: &[&str], cells: &[&str]| {
        let mut control_angles_deg = [0.0; 5];
        for ((angle, cell), key) in control_angles_deg.iter_mut().zip(&cells[2..]).zip(&header[2..]) {
            *angle = number(key, cell)?;
        }
        Ok(Row { image: PathBuf::from(cells[1]), control_angles_deg, tracker_from_base: None })
    };
    csv_table(text, check, row)
}

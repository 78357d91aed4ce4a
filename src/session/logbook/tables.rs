//! A log as tables: exposures, both devices, beads and scores, each a CSV file with units in its headers. What was not measured is empty.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::super::edit::{NOTE_TOPIC, NoteRecord, take_note};
use super::super::log::PoseRecord;
use super::super::records::RESTART_TOPIC;
use super::LogbookError;
use super::frames::Frames;
use super::inventory::Reading;
use super::lines::{Heard, Lines};
use crate::compare::{NULL_SCORES, Scores};
use crate::image::NewFile;
use crate::pose::Pose;
use crate::record::{LogReader, Tolerance, topic};
use crate::report::Pair;
use crate::reporter::Reporter;
use crate::telemetry::{CarmSample, DeviceKind, Event, RobotSample, Sample, Sequenced};
use crate::time::rfc3339_from_us;
use crate::timeline::{ExposureInterval, Stamps};

/// The files, in the order in which they are told.
const FILES: [&str; 5] = ["exposures.csv", "carm.csv", "robot.csv", "beads.csv", "scores.csv"];

const JOINTS: [&str; 7] = [
    "lift_mm",
    "wig_wag_deg",
    "longitudinal_mm",
    "angulation_deg",
    "orbital_deg",
    "detector_rotation_deg",
    "source_to_detector_mm",
];

/// What was written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TablesReport {
    /// Files and their rows.
    pub rows: Vec<(PathBuf, u64)>,
    /// What of the log could not be read.
    pub losses: Vec<String>,
}

/// A file that appears under its name when it is whole.
struct Table {
    new: NewFile,
    writer: csv::Writer<BufWriter<File>>,
    rows: u64,
}

impl Table {
    fn create(path: &Path) -> Result<Self, LogbookError> {
        let (new, file) = NewFile::create(path).map_err(|source| failed(path, source))?;
        Ok(Self { new, writer: csv::Writer::from_writer(BufWriter::new(file)), rows: 0 })
    }

    fn head(&mut self, columns: impl IntoIterator<Item = String>) -> Result<(), LogbookError> {
        let outcome = self.writer.write_record(columns.into_iter().collect::<Vec<_>>());
        outcome.map_err(|error| self.failed(error.into()))
    }

    fn row(&mut self, cells: Vec<String>) -> Result<(), LogbookError> {
        self.rows += 1;
        self.writer.write_record(cells).map_err(|error| self.failed(error.into()))
    }

    fn failed(&self, source: std::io::Error) -> LogbookError {
        failed(self.new.path(), source)
    }

    fn finish(mut self) -> Result<(PathBuf, u64), LogbookError> {
        self.writer.flush().map_err(|source| self.failed(source))?;
        let Self { new, writer, rows } = self;
        drop(writer);
        let path = new.path().to_owned();
        new.appear().map_err(|source| failed(&path, source))?;
        Ok((path, rows))
    }
}

/// Rows of a device, which wait until the times of their samples are known.
struct Samples {
    device: DeviceKind,
    table: Table,
    waiting: VecDeque<(Vec<String>, Option<Stamps>)>,
}

impl Samples {
    fn new(device: DeviceKind, table: Table) -> Self {
        Self { device, table, waiting: VecDeque::new() }
    }

    /// Writes what is known by now.
    fn write(&mut self, lines: &Lines) -> Result<(), LogbookError> {
        while let Some((row, stamps)) = self.waiting.front_mut() {
            if let Some(stamps) = stamps {
                let Some(now) = lines.stamps_now(self.device, stamps) else { break };
                row[HOST_US] = now.mapped_us.to_string();
            }
            self.table.row(std::mem::take(row))?;
            self.waiting.pop_front();
        }
        Ok(())
    }
}

fn failed(path: &Path, source: std::io::Error) -> LogbookError {
    let path = path.to_owned();
    match source.kind() {
        std::io::ErrorKind::AlreadyExists => LogbookError::TableExists { path },
        _ => LogbookError::Out { path, source },
    }
}

fn number(value: f64) -> String {
    if value.is_finite() { value.to_string() } else { String::new() }
}

fn or_empty<T: ToString>(value: Option<T>) -> String {
    value.map(|value| value.to_string()).unwrap_or_default()
}

/// Writes the tables into `folder`, which is made where it is missing.
///
/// # Errors
/// When the log cannot be read, one of the files exists, or the folder is not writable.
pub fn write_tables(log: &Path, folder: &Path, reporter: &Reporter) -> Result<TablesReport, LogbookError> {
    let mut reader = LogReader::open(log)?;
    std::fs::create_dir_all(folder).map_err(|source| LogbookError::Out { path: folder.to_owned(), source })?;
    let [exposures, carm, robot, beads, scores] = FILES.map(|name| Table::create(&folder.join(name)));
    let (mut exposures, mut carm, mut robot, mut beads, mut scores) = (exposures?, carm?, robot?, beads?, scores?);
    carm.head(carm_columns())?;
    robot.head(robot_columns())?;
    let (mut carm, mut robot) = (Samples::new(DeviceKind::Carm, carm), Samples::new(DeviceKind::Robot, robot));
    let mut reading = Reading::new("reading", &reader, reporter);
    let (mut frames, mut lines, mut tolerance) = (Frames::default(), Lines::new(), Tolerance::default());
    let (mut poses, mut pairs): (BTreeMap<u32, PoseRecord>, BTreeMap<u32, Pair>) = Default::default();
    let mut notes: BTreeMap<u32, String> = BTreeMap::new();
    while let Some(entry) = reader.next() {
        reading.at(&reader);
        tolerance.take(frames.take(&entry));
        if &*entry.topic == RESTART_TOPIC {
            lines.finish();
            carm.write(&lines)?;
            robot.write(&lines)?;
        }
        let piece = lines.piece();
        tolerance.take(lines.take(&entry, &mut |heard| match heard.event {
            Event::Sample(Sample::Carm(sample), sequenced) => {
                carm.waiting.push_back((carm_row(piece, entry.host_us, &heard, *sequenced, sample), heard.stamps));
            }
            Event::Sample(Sample::Robot(sample), sequenced) => {
                robot.waiting.push_back((robot_row(piece, entry.host_us, &heard, *sequenced, sample), heard.stamps));
            }
            Event::Sample(Sample::Metadata(_), _) | Event::Fault(_) => {}
        }));
        carm.write(&lines)?;
        robot.write(&lines)?;
        frames.piece = lines.piece();
        match &*entry.topic {
            topic::POSE => {
                // A frame that was posed again counts by its last pose.
                let record = tolerance.take(entry.json::<PoseRecord>());
                poses.extend(record.map(|record| (record.number, record)));
            }
            topic::SCORES => {
                let pair = tolerance.take(entry.json::<Pair>());
                pairs.extend(pair.map(|pair| (pair.number, pair)));
            }
            NOTE_TOPIC => {
                if let Some(note) = tolerance.take(entry.json::<NoteRecord>()) {
                    take_note(&mut notes, note.number, &note.words);
                }
            }
            _ => {}
        }
    }
    lines.finish();
    carm.write(&lines)?;
    robot.write(&lines)?;
    write_exposures(&mut exposures, &lines, &frames, &notes)?;
    write_beads(&mut beads, &poses)?;
    write_scores(&mut scores, &pairs)?;
    let rows =
        [exposures, carm.table, robot.table, beads, scores].map(Table::finish).into_iter().collect::<Result<Vec<_>, _>>()?;
    let damage = reader.losses().iter().map(ToString::to_string);
    Ok(TablesReport { rows, losses: damage.chain(tolerance.losses()).collect() })
}

/// The column of the time at which a sample was measured.
const HOST_US: usize = 2;

fn of_sample() -> impl Iterator<Item = String> {
    ["log", "arrival_us", "host_us", "device_us", "segment", "sequence", "epoch", "follows"].map(str::to_owned).into_iter()
}

fn carm_columns() -> Vec<String> {
    let beam = ["tube_kvp", "tube_ma", "pulse_width_ms", "filter_mm_al", "filter_mm_cu"];
    let field = ["field_left_mm", "field_top_mm", "field_right_mm", "field_bottom_mm"];
    let state = ["xray_on", "exposure_counter", "status"];
    let own = JOINTS.iter().chain(&beam).chain(&field).chain(&state).map(|name| (*name).to_owned());
    of_sample().chain(own).collect()
}

fn robot_columns() -> Vec<String> {
    let angles = ["commanded", "sensed"].map(|what| (1..=5).map(move |point| format!("{what}_{point}_deg")));
    let tendon = |n: u32| ["position_mm", "velocity_mm_per_s", "tension_n", "current_a"].map(|what| format!("tendon_{n}_{what}"));
    let base = ["base_x_mm", "base_y_mm", "base_z_mm", "base_qx", "base_qy", "base_qz", "base_qw"].map(str::to_owned);
    let state = ["drill_rpm", "status"].map(str::to_owned);
    of_sample().chain(angles.into_iter().flatten()).chain(tendon(1)).chain(tendon(2)).chain(base).chain(state).collect()
}

fn sample_cells(
    piece: u32,
    arrival_us: i64,
    heard: &Heard<'_>,
    sequenced: Sequenced,
    number: u32,
    device_us: u64,
) -> Vec<String> {
    let follows = match sequenced {
        Sequenced::Next => "next".to_owned(),
        Sequenced::Gap(lost) => format!("after a gap of {lost}"),
        Sequenced::GapWhileClosed(lost) => format!("after a gap of {lost} while closed"),
        Sequenced::Duplicate => "twice".to_owned(),
        Sequenced::Reordered => "late".to_owned(),
        Sequenced::Early(lost) => format!("late, before all others, with {lost} between"),
        Sequenced::Reset => "restart".to_owned(),
    };
    vec![
        (piece + 1).to_string(),
        arrival_us.to_string(),
        // When its times are known.
        String::new(),
        device_us.to_string(),
        or_empty(heard.stamps.map(|stamps| stamps.segment)),
        number.to_string(),
        heard.epoch.to_string(),
        follows,
    ]
}

fn joint_cells(joints: [f64; 7]) -> impl Iterator<Item = String> {
    // Angles are radians inside, degrees in files.
    (0..7).map(move |at| number(if matches!(at, 1 | 3 | 4 | 5) { joints[at].to_degrees() } else { joints[at] }))
}

fn carm_row(piece: u32, arrival_us: i64, heard: &Heard<'_>, sequenced: Sequenced, sample: &CarmSample) -> Vec<String> {
    let mut row = sample_cells(piece, arrival_us, heard, sequenced, sample.sequence, sample.device_us);
    row.extend(joint_cells(sample.joints.to_array()));
    let beam = [sample.tube_kvp, sample.tube_ma, sample.pulse_width_ms, sample.filter_mm_al, sample.filter_mm_cu];
    row.extend(beam.into_iter().chain(sample.field_mm).map(number));
    row.extend([u8::from(sample.xray_on).to_string(), or_empty(sample.exposure_counter), sample.status.to_string()]);
    row
}

fn robot_row(piece: u32, arrival_us: i64, heard: &Heard<'_>, sequenced: Sequenced, sample: &RobotSample) -> Vec<String> {
    let mut row = sample_cells(piece, arrival_us, heard, sequenced, sample.sequence, sample.device_us);
    row.extend(sample.commanded_deg.map(number));
    row.extend(sample.sensed_deg.unwrap_or([f64::NAN; 5]).map(number));
    for tendon in &sample.tendons {
        row.extend([tendon.position_mm, tendon.velocity_mm_per_s, tendon.tension_n, tendon.current_a].map(number));
    }
    let base = sample.tracker_from_base.map_or([f64::NAN; 7], |base| {
        let ([x, y, z], turn) = (base.translation_mm.to_array(), base.rotation);
        [x, y, z, turn.x, turn.y, turn.z, turn.w]
    });
    row.extend(base.map(number));
    row.extend([number(sample.drill_rpm), sample.status.to_string()]);
    row
}

fn write_exposures(table: &mut Table, lines: &Lines, frames: &Frames, notes: &BTreeMap<u32, String>) -> Result<(), LogbookError> {
    let head = [
        "log",
        "number",
        "counter",
        "start_us",
        "end_us",
        "start_utc",
        "start_uncertainty_us",
        "device_start_us",
        "device_end_us",
        "segment",
        "epoch",
        "samples",
    ];
    let beam = ["tube_kvp", "tube_ma"];
    let joints = JOINTS.iter().chain(&["joints_gap_us"]);
    let robot = (1..=5).map(|point| format!("robot_{point}_deg"));
    let tail = ["frames", "binding", "notes"].map(str::to_owned);
    table.head(head.iter().chain(&beam).chain(joints).map(|name| (*name).to_owned()).chain(robot).chain(tail))?;
    let mut bound: BTreeMap<(u32, u64), (Vec<u32>, BTreeSet<String>)> = BTreeMap::new();
    for (number, frame) in &frames.by_number {
        let Some(pose) = &frame.pose else { continue };
        let Some(exposure) = pose.exposure else { continue };
        let (numbers, how) = bound.entry((pose.piece, exposure)).or_default();
        numbers.push(*number);
        how.insert(pose.binding.clone());
    }
    for (piece, exposures) in (0u32..).zip(lines.exposures()) {
        for exposure in exposures {
            let (numbers, how) = bound.remove(&(piece, exposure.index)).unwrap_or_default();
            let mut row = exposure_cells(piece, &exposure);
            let noted: Vec<&str> = numbers.iter().filter_map(|number| Some(notes.get(number)?.as_str())).collect();
            let numbers: Vec<String> = numbers.iter().map(u32::to_string).collect();
            row.extend([numbers.join(" "), how.into_iter().collect::<Vec<_>>().join(" "), noted.join("; ")]);
            table.row(row)?;
        }
    }
    Ok(())
}

fn exposure_cells(piece: u32, exposure: &ExposureInterval) -> Vec<String> {
    let [device_start_us, device_end_us] = exposure.device_us;
    let mut row = vec![
        (piece + 1).to_string(),
        (exposure.index + 1).to_string(),
        or_empty(exposure.counter),
        exposure.start_us.to_string(),
        exposure.end_us.to_string(),
        rfc3339_from_us(exposure.start_us),
        number(exposure.start_uncertainty_us),
        device_start_us.to_string(),
        device_end_us.to_string(),
        exposure.segment.to_string(),
        exposure.epoch.to_string(),
        exposure.samples.to_string(),
        number(exposure.tube_kvp),
        number(exposure.tube_ma),
    ];
    row.extend(joint_cells(exposure.joints.as_ref().map_or([f64::NAN; 7], |joints| joints.value.to_array())));
    row.push(or_empty(exposure.joints.as_ref().map(|joints| joints.gap_us)));
    row.extend(exposure.control_angles_deg.as_ref().map_or([f64::NAN; 5], |angles| angles.value).map(number));
    row
}

fn write_beads(table: &mut Table, poses: &BTreeMap<u32, PoseRecord>) -> Result<(), LogbookError> {
    let head = [
        "frame",
        "status",
        "bead",
        "body",
        "x_lps_mm",
        "y_lps_mm",
        "z_lps_mm",
        "image_u_px",
        "image_v_px",
        "predicted_u_px",
        "predicted_v_px",
        "residual_u_px",
        "residual_v_px",
        "sigma_px",
        "used",
        "check",
        "reason",
    ];
    table.head(head.map(str::to_owned))?;
    for (frame, record) in poses {
        let Ok(pose) = Pose::deserialize(&record.pose) else { continue };
        let status = if pose.is_accepted() { "accepted" } else { "refused" };
        for bead in &pose.beads {
            let pixels = |at: Option<[f64; 2]>| at.unwrap_or([f64::NAN; 2]).map(number);
            let mut row = vec![frame.to_string(), status.to_owned(), bead.name.clone(), bead.body.clone()];
            row.extend(bead.lps_mm.to_array().map(number));
            row.extend([bead.image_px, bead.predicted_px, bead.residual_px].map(pixels).into_iter().flatten());
            row.extend([
                or_empty(bead.sigma_px),
                u8::from(bead.used).to_string(),
                u8::from(bead.check).to_string(),
                bead.reason.clone().unwrap_or_default(),
            ]);
            table.row(row)?;
        }
    }
    Ok(())
}

/// Scores without a null, in the order of their file.
const OTHER_SCORES: [&str; 3] = ["edge_distance_mm", "bias_nepers", "noise_nepers"];

fn write_scores(table: &mut Table, pairs: &BTreeMap<u32, Pair>) -> Result<(), LogbookError> {
    let head = ["frame", "time_us", "status", "pose_source", "binding", "rms_px", "rms_mm", "render_error"];
    let with_null = NULL_SCORES.iter().flat_map(|(name, _)| [(*name).to_owned(), format!("{name}_null_margin")]);
    let others = OTHER_SCORES.iter().map(|name| (*name).to_owned());
    table.head(head.map(str::to_owned).into_iter().chain(with_null).chain(others))?;
    for (frame, pair) in pairs {
        let mut row = vec![
            frame.to_string(),
            or_empty(pair.time_us),
            word(&pair.status),
            word(&pair.pose_source),
            pair.binding.clone(),
            or_empty(pair.rms_px),
            or_empty(pair.rms_mm),
            or_empty(pair.render_error),
        ];
        for (name, larger_is_better) in NULL_SCORES {
            let margin = pair.null.get(name).and_then(|null| {
                let ahead = null.at_pose? - null.best_shifted?;
                Some(if larger_is_better { ahead } else { -ahead })
            });
            row.extend([of(&pair.scores, name), or_empty(margin)]);
        }
        row.extend(OTHER_SCORES.map(|name| of(&pair.scores, name)));
        table.row(row)?;
    }
    Ok(())
}

fn of(scores: &Scores, name: &str) -> String {
    scores.get(name).map(number).unwrap_or_default()
}

/// A variant's name in files.
fn word(value: &impl serde::Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|value| value.as_str().map(str::to_owned)).unwrap_or_default()
}

//! A log as tables: exposures, both devices, poses, beads and scores, each a CSV file with units in its headers. What was not measured is empty.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

use super::super::edit::{NOTE_TOPIC, NoteRecord, take_note};
use super::super::log::PoseRecord;
use super::super::records::RESTART_TOPIC;
use super::LogbookError;
use super::frame_tables::{write_beads, write_poses, write_scores};
use super::frames::Frames;
use super::inventory::Reading;
use super::lines::{Heard, Lines};
use super::sheet::{Table, number, or_empty};
use crate::geometry::JOINT_KEYS;
use crate::record::{LogReader, Tolerance, topic};
use crate::report::Pair;
use crate::reporter::Reporter;
use crate::telemetry::{CarmSample, DeviceKind, Event, RobotSample, Sample, Sequenced};
use crate::time::rfc3339_from_us;
use crate::timeline::{ExposureInterval, Stamps};

/// The files, in the order in which they are told.
const FILES: [&str; 6] = ["exposures.csv", "carm.csv", "robot.csv", "poses.csv", "beads.csv", "scores.csv"];

/// What was written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TablesReport {
    /// Files and their rows.
    pub rows: Vec<(PathBuf, u64)>,
    /// What of the log could not be read.
    pub losses: Vec<String>,
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

/// Writes the tables into `folder`, which is made where it is missing.
///
/// # Errors
/// When the log cannot be read, one of the files exists, or the folder is not writable.
pub fn write_tables(log: &Path, folder: &Path, reporter: &Reporter) -> Result<TablesReport, LogbookError> {
    let mut reader = LogReader::open(log)?;
    std::fs::create_dir_all(folder).map_err(|source| LogbookError::Out { path: folder.to_owned(), source })?;
    let [exposures, carm, robot, of_poses, beads, scores] = FILES.map(|name| Table::create(&folder.join(name)));
    let (mut exposures, mut carm, mut robot) = (exposures?, carm?, robot?);
    let (mut of_poses, mut beads, mut scores) = (of_poses?, beads?, scores?);
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
    write_poses(&mut of_poses, &frames, &poses, &pairs)?;
    write_beads(&mut beads, &frames, &poses)?;
    write_scores(&mut scores, &frames, &pairs)?;
    let tables = [exposures, carm.table, robot.table, of_poses, beads, scores];
    let rows = tables.map(Table::finish).into_iter().collect::<Result<Vec<_>, _>>()?;
    let damage = reader.losses().iter().map(ToString::to_string);
    Ok(TablesReport { rows, losses: damage.chain(tolerance.losses()).collect() })
}

/// The column of the time at which a sample was measured.
const HOST_US: usize = 2;

fn of_sample() -> impl Iterator<Item = String> {
    ["log", "arrival_us", "host_us", "device_us", "segment", "sequence", "epoch", "follows"].map(str::to_owned).into_iter()
}

fn joint_columns() -> [&'static str; 7] {
    JOINT_KEYS.map(|(name, _)| name)
}

fn carm_columns() -> Vec<String> {
    let beam = ["tube_kvp", "tube_ma", "pulse_width_ms", "filter_mm_al", "filter_mm_cu"];
    let field = ["field_left_mm", "field_top_mm", "field_right_mm", "field_bottom_mm"];
    let state = ["xray_on", "exposure_counter", "status"];
    let joints = joint_columns();
    let own = joints.iter().chain(&beam).chain(&field).chain(&state).map(|name| (*name).to_owned());
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
    let joints = joint_columns();
    let joints = joints.iter().chain(&["joints_gap_us"]);
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

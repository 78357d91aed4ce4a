//! A log through the same engine: poses byte for byte, images by their hash.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use super::SessionError;
use super::board::Board;
use super::develop::{Developed, Workshop};
use super::engine::{Engine, Input, Output};
use super::file::Setup;
use super::folder::{Collector, Folder};
use super::journal::{CLOCK_TOPIC, DRR_HASH_TOPIC, END_TOPIC, PoseRecord, SETUP_TOPIC};
use crate::gpu::DeviceChoice;
use crate::record::{FrameAssembler, LogEntry, read_log, topic};
use crate::render::Plan;
use crate::reporter::Reporter;
use crate::telemetry::DeviceKind;
use crate::time::Stopwatch;

/// How a log is replayed.
#[derive(Clone, Debug)]
pub struct ReplayOptions {
    /// The replayed session's folder.
    pub out: PathBuf,
    /// Where the scene's volumes are, if not where the session had them.
    pub data: Option<PathBuf>,
    /// Speed against the recorded clock; `None` is as fast as possible.
    pub rate: Option<f64>,
}

/// What a replay found against the log.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
pub struct ReplayReport {
    /// Frames replayed.
    pub frames: usize,
    /// Poses that are the same, byte for byte.
    pub poses_identical: usize,
    /// Frames whose pose differs from the log.
    pub poses_different: Vec<String>,
    /// DRRs with the same hash.
    pub images_identical: usize,
    /// Frames whose DRR differs: name, largest difference in nepers, and the bound of the plan.
    pub images_different: Vec<(String, f64, f64)>,
    /// Poses and DRRs that the log does not hold.
    pub not_in_log: Vec<String>,
    /// What the log had lost.
    pub losses: Vec<String>,
}

impl ReplayReport {
    /// Whether everything that the log holds came out the same (images within their plan's bound).
    #[must_use]
    pub fn is_faithful(&self) -> bool {
        self.poses_different.is_empty() && self.images_different.iter().all(|(_, largest, bound)| largest <= bound)
    }
}

/// Results that the log holds, by frame.
#[derive(Default)]
struct Recorded {
    poses: BTreeMap<String, Vec<u8>>,
    hashes: BTreeMap<String, String>,
    drrs: BTreeMap<String, crate::image::Image<f32>>,
    plans: BTreeMap<String, Plan>,
}

/// Replays `log`.
///
/// # Errors
/// When the log is none, holds no session, or the scene's files are not found.
pub fn run(
    log: &Path,
    options: &ReplayOptions,
    board: &Board,
    reporter: &Reporter,
) -> Result<(Folder, ReplayReport), SessionError> {
    let contents = read_log(log)?;
    let no_session = |detail: &str| SessionError::NoSession { path: log.display().to_string(), detail: detail.to_owned() };
    let entry =
        contents.entries.iter().find(|entry| &*entry.topic == SETUP_TOPIC).ok_or_else(|| no_session("no session setup"))?;
    let mut setup: Setup = entry.json()?;
    if let Some(data) = &options.data {
        setup.scene_path = data.join(setup.scene_path.file_name().unwrap_or_default());
    }
    let mut report = ReplayReport::default();
    report.losses.extend(contents.losses.iter().map(|loss| format!("at byte {}: {}", loss.at_byte, loss.reason)));
    for loss in &report.losses {
        reporter.warn("log damaged", format!("{}: {loss}", log.display()));
    }
    let recorded = recorded(&contents.entries)?;
    let mut workshop = Workshop::open(&setup, DeviceChoice::Auto, reporter)?;
    let mut collector = Collector::create(&options.out)?;
    let started_us = contents.entries.first().map_or(0, |entry| entry.host_us);
    collector.start(started_us, &setup, &workshop);
    report.losses.iter().for_each(|loss| collector.loss(loss.clone()));
    let mut engine = Engine::new(setup, workshop.layout().cloned(), reporter.clone());
    let progress = reporter.progress("replaying", contents.entries.len() as u64);
    let mut assembler = FrameAssembler::default();
    let mut outputs = Vec::new();
    let mut ended = false;
    let mut last_us = started_us;
    let mut pace = Pace { rate: options.rate, first_us: None, watch: Stopwatch::start() };
    for entry in &contents.entries {
        progress.advance(1);
        let Some(input) = input(entry, &mut assembler, &mut ended)? else {
            if ended {
                break;
            }
            continue;
        };
        pace.wait_for(entry.host_us);
        last_us = last_us.max(entry.host_us);
        engine.push(input, &mut |output| outputs.push(output));
        for output in outputs.drain(..) {
            take(output, &mut collector, &mut workshop, &recorded, &mut report);
        }
        while let Some(developed) = workshop.try_take() {
            finish_pair(developed, &recorded, &mut collector, &mut report, board)?;
        }
    }
    if !ended {
        report.losses.push("the log has no end: the session was cut short".to_owned());
    }
    engine.finish(last_us, &mut |output| outputs.push(output));
    for output in outputs.drain(..) {
        take(output, &mut collector, &mut workshop, &recorded, &mut report);
    }
    for developed in workshop.finish()? {
        finish_pair(developed, &recorded, &mut collector, &mut report, board)?;
    }
    board.update(|state| state.finished = true);
    let folder = collector.finish(&engine, reporter, None)?;
    Ok((folder, report))
}

/// Waits so that inputs come at the recorded pace.
struct Pace {
    rate: Option<f64>,
    first_us: Option<i64>,
    watch: Stopwatch,
}

impl Pace {
    fn wait_for(&mut self, host_us: i64) {
        let Some(rate) = self.rate else { return };
        let first_us = *self.first_us.get_or_insert(host_us);
        let due_ms = (host_us - first_us) as f64 * 1e-3 / rate;
        let early_ms = due_ms - self.watch.ms();
        if early_ms > 1.0 {
            std::thread::sleep(Duration::from_secs_f64(early_ms.min(60_000.0) * 1e-3));
        }
    }
}

/// What `/plan` holds.
#[derive(serde::Deserialize)]
struct PlanRecord {
    frame: String,
    plan: Plan,
}

fn recorded(entries: &[LogEntry]) -> Result<Recorded, SessionError> {
    let mut found = Recorded::default();
    let mut last_drr = None;
    for entry in entries {
        match &*entry.topic {
            topic::POSE => {
                let pose: PoseRecord = entry.json()?;
                found.poses.insert(pose.frame, entry.data.clone());
            }
            topic::DRR => last_drr = entry.image()?,
            topic::PLAN => {
                let PlanRecord { frame, plan } = entry.json()?;
                found.plans.insert(frame, plan);
            }
            DRR_HASH_TOPIC => {
                let value: serde_json::Value = entry.json()?;
                let (Some(frame), Some(sha256)) = (value["frame"].as_str(), value["sha256"].as_str()) else { continue };
                found.hashes.insert(frame.to_owned(), sha256.to_owned());
                if let Some(drr) = last_drr.take() {
                    found.drrs.insert(frame.to_owned(), drr);
                }
            }
            _ => {}
        }
    }
    Ok(found)
}

fn input(entry: &LogEntry, assembler: &mut FrameAssembler, ended: &mut bool) -> Result<Option<Input>, SessionError> {
    let device = match &*entry.topic {
        topic::CARM_RAW => DeviceKind::Carm,
        topic::ROBOT_RAW => DeviceKind::Robot,
        topic::FRAME_TAGS | topic::FRAME_PIXELS => {
            let frame = assembler.push(entry)?;
            return Ok(frame.map(|frame| Input::Frame { frame: Arc::new(frame), host_us: entry.host_us }));
        }
        CLOCK_TOPIC => return Ok(Some(Input::Tick { host_us: entry.host_us })),
        END_TOPIC => {
            *ended = true;
            return Ok(None);
        }
        _ => return Ok(None),
    };
    let raw = entry.raw_bytes()?;
    Ok(raw.map(|raw| Input::Bytes { device, epoch: raw.epoch, host_us: entry.host_us, bytes: raw.bytes.to_vec() }))
}

fn take(output: Output, collector: &mut Collector, workshop: &mut Workshop, recorded: &Recorded, report: &mut ReplayReport) {
    match output {
        Output::Sample { host_us, sample, .. } => collector.sample(host_us, &sample),
        Output::Fault { .. } => {}
        Output::Posed(posed) => {
            report.frames += 1;
            let name = posed.frame.name.clone();
            let now = serde_json::to_vec(&PoseRecord::of(&posed)).unwrap_or_default();
            match recorded.poses.get(&name) {
                Some(then) if *then == now => report.poses_identical += 1,
                Some(_) => report.poses_different.push(name),
                None => report.not_in_log.push(format!("pose of {name}")),
            }
            let plan = recorded.plans.get(&posed.frame.name).cloned();
            workshop.submit(*posed, plan);
        }
    }
}

fn finish_pair(
    developed: Developed,
    recorded: &Recorded,
    collector: &mut Collector,
    report: &mut ReplayReport,
    board: &Board,
) -> Result<(), SessionError> {
    let name = &developed.posed.frame.name;
    if let (Some(sha256), Some((drr, _)), false) = (&developed.drr_sha256, &developed.drr, collector.knows(&developed)) {
        match (recorded.hashes.get(name), recorded.drrs.get(name)) {
            (Some(then), _) if then == sha256 => report.images_identical += 1,
            (Some(_), Some(then)) => {
                let pairs = then.pixels.iter().zip(&drr.pages[0].pixels);
                let largest = pairs.map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max);
                report.images_different.push((name.clone(), largest, drr.stated_error));
            }
            (Some(_), None) => report.images_different.push((name.clone(), f64::INFINITY, drr.stated_error)),
            (None, _) => report.not_in_log.push(format!("DRR of {name}")),
        }
    }
    let picture = Arc::new(developed.picture());
    board.update(|state| match state.pairs.iter_mut().find(|pair| pair.name == picture.name) {
        Some(slot) => *slot = picture,
        None => state.pairs.push(picture),
    });
    collector.take(developed)
}

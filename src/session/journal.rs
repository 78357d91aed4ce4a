//! What a running session writes: the log first, then strips, DRRs and `pairs.json`, and at the end the report.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::SessionError;
use super::develop::{Developed, Workshop};
use super::engine::{Engine, Posed};
use super::file::Setup;
use super::folder::{Collector, Folder};
use crate::acquire::Frame;
use crate::record::{BeadMark, Level, Provenance, Recorder, topic};
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, Sample};
use crate::time::host_now_us;

/// The session's inputs, embedded in the log.
pub(super) const SETUP_TOPIC: &str = "/session/setup";
/// Ticks of the host clock: replay passes them to the engine as the session did.
pub(super) const CLOCK_TOPIC: &str = "/session/clock";
/// The end of the session.
pub(super) const END_TOPIC: &str = "/session/end";
/// Name and SHA-256 of each DRR's pixels.
pub(super) const DRR_HASH_TOPIC: &str = "/frames/drr_sha256";

/// Log and folder of a running session.
pub(super) struct Journal {
    recorder: Recorder,
    reporter: Reporter,
    collector: Collector,
    log: PathBuf,
    failed: bool,
}

impl Journal {
    /// Creates the folder and the log.
    pub(super) fn create(out: &Path, setup: &Setup, workshop: &Workshop, reporter: &Reporter) -> Result<Self, SessionError> {
        let log = out.join("session.mcap");
        if log.exists() {
            return Err(SessionError::Occupied { path: log.display().to_string() });
        }
        let mut collector = Collector::create(out)?;
        let started_us = host_now_us();
        collector.start(started_us, setup, workshop);
        let details = json!({"adapter": workshop.adapter(), "inputs": workshop.inputs()});
        let recorder = Recorder::create(&log, &Provenance::of_this_program(started_us, details))?;
        recorder.json(SETUP_TOPIC, started_us, setup)?;
        recorder.attach("scene.json", "application/json", started_us, setup.scene_json.as_bytes())?;
        if let Some((path, text)) = &setup.beads {
            let name = path.file_name().map_or_else(|| "beads.mrk.json".to_owned(), |name| name.to_string_lossy().into_owned());
            recorder.attach(&name, "application/json", started_us, text.as_bytes())?;
        }
        Ok(Self { recorder, reporter: reporter.clone(), collector, log, failed: false })
    }

    /// A failed recorder is said once, loudly; the session goes on without it, because the frames still need their pairs.
    fn check(&mut self, outcome: Result<(), crate::record::RecordError>) {
        if let Err(error) = outcome
            && !self.failed
        {
            self.failed = true;
            self.collector.loss(error.to_string());
            self.reporter.warn("recording stopped", error);
        }
    }

    pub(super) fn bytes(&mut self, device: DeviceKind, epoch: u32, host_us: i64, bytes: &[u8]) {
        let outcome = self.recorder.raw_bytes(device.key(), epoch, host_us, bytes);
        self.check(outcome);
    }

    pub(super) fn tick(&mut self, host_us: i64) {
        let outcome = self.recorder.json(CLOCK_TOPIC, host_us, &json!({ "host_us": host_us }));
        self.check(outcome);
    }

    pub(super) fn frame(&mut self, frame: &Frame, host_us: i64) {
        let outcome = self.recorder.frame(frame, host_us);
        self.check(outcome);
    }

    pub(super) fn event(&mut self, host_us: i64, text: &str) {
        let outcome = self.recorder.event(Level::Info, text, host_us);
        self.check(outcome);
    }

    pub(super) fn line_lost(&mut self, device: DeviceKind, host_us: i64, reason: &str) {
        self.collector.line_lost(device, host_us, reason);
        let outcome = self.recorder.event(Level::Warning, &format!("{} line lost: {reason}", device.key()), host_us);
        self.check(outcome);
    }

    pub(super) fn line_opened(&mut self, device: DeviceKind, host_us: i64, epoch: u32, path: &Path) {
        self.collector.line_opened(device, host_us);
        self.event(host_us, &format!("{} line opened at {}, epoch {epoch}", device.key(), path.display()));
    }

    pub(super) fn sample(&mut self, device: DeviceKind, host_us: i64, sample: &Sample) {
        let topic = match (device, sample) {
            (_, Sample::Metadata(_)) => "/devices/metadata",
            (DeviceKind::Carm, _) => topic::CARM_JOINTS,
            (DeviceKind::Robot, _) => topic::ROBOT_JOINTS,
        };
        let outcome = self.recorder.json(topic, host_us, sample);
        self.check(outcome);
        self.collector.sample(host_us, sample);
    }

    pub(super) fn pose(&mut self, posed: &Posed) {
        let record = PoseRecord::of(posed);
        let outcome = self.recorder.json(topic::POSE, posed.time_us, &record);
        self.check(outcome);
        if let Some(view) = &posed.view {
            let projection = view.projection();
            let mark = |bead: &crate::pose::BeadResidual| {
                let (projected_px, depth_mm) = projection.project(bead.lps_mm);
                let detected_px = bead.image_px.map(glam::DVec2::from_array);
                (depth_mm > 0.0).then(|| BeadMark { name: bead.name.clone(), detected_px, projected_px, radius_px: 4.0 })
            };
            let marks: Vec<BeadMark> = posed.pose.beads.iter().filter_map(mark).collect();
            let outcome = self.recorder.pose_geometry(view, &marks, posed.time_us);
            self.check(outcome);
        }
    }

    /// Records a pair and writes its files.
    pub(super) fn pair(&mut self, developed: Developed) -> Result<(), SessionError> {
        let time_us = developed.posed.time_us;
        if let (Some((drr, _)), Some(sha256), false) = (&developed.drr, &developed.drr_sha256, self.collector.knows(&developed)) {
            let name = &developed.posed.frame.name;
            let outcome = self
                .recorder
                .drr(name, &drr.pages[0], time_us)
                .and_then(|()| self.recorder.json(topic::PLAN, time_us, &json!({"frame": name, "plan": drr.plan})))
                .and_then(|()| self.recorder.json(DRR_HASH_TOPIC, time_us, &json!({"frame": name, "sha256": sha256})));
            self.check(outcome);
        }
        if developed.complete {
            let outcome = self.recorder.json(topic::SCORES, time_us, &developed.pair);
            self.check(outcome);
        }
        self.collector.take(developed)
    }

    pub(super) fn end(&mut self, host_us: i64) {
        let outcome = self.recorder.json(END_TOPIC, host_us, &json!({ "host_us": host_us }));
        self.check(outcome);
    }

    /// Finishes the log and writes the report.
    pub(super) fn close(mut self, engine: &Engine, reporter: &Reporter) -> Result<Folder, SessionError> {
        let finished = self.recorder.finish();
        if let (Err(error), false) = (&finished, self.failed) {
            self.collector.loss(error.to_string());
            reporter.warn("recording stopped", error);
        }
        self.collector.finish(engine, reporter, Some(self.log))
    }
}

/// What `/pose` holds.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub(super) struct PoseRecord {
    pub(super) frame: String,
    pub(super) index: u32,
    pub(super) pose_source: super::engine::PoseSource,
    pub(super) camera_from_lps: Option<crate::geometry::Rigid>,
    pub(super) projection: Option<crate::geometry::Projection>,
    pub(super) binding: serde_json::Value,
    pub(super) control_angles_deg: Option<[f64; 5]>,
    pub(super) pose: serde_json::Value,
}

impl PoseRecord {
    pub(super) fn of(posed: &Posed) -> Self {
        Self {
            frame: posed.frame.name.clone(),
            index: posed.index,
            pose_source: posed.pose_source,
            camera_from_lps: posed.view.map(|view| view.camera_from_lps),
            projection: posed.view.map(|view| view.projection()),
            binding: serde_json::to_value(&posed.binding).unwrap_or_default(),
            control_angles_deg: posed.robot.as_ref().map(|robot| robot.control_angles_deg),
            pose: serde_json::to_value(&posed.pose).unwrap_or_default(),
        }
    }
}

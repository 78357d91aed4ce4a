//! The session's log, shared by all threads: what comes in is recorded in the order in which the engine is given it, before anything is
//! made of it, and a log that fails is said once and stops nothing.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use serde_json::json;

use super::SessionError;
use super::against_log::topic_of;
use super::edit::{EDIT_TOPIC, EditRecord, NOTE_TOPIC, NoteRecord};
use super::event::Event;
use super::file::Setup;
use super::input::Input;
use super::inputs::InputNames;
use super::losses::{Losses, came, lost};
use super::posed::Posed;
use super::workshop::Workshop;
use crate::geometry::Distortion;
use crate::record::{BeadMark, Level, Placed, Provenance, RecordError, Recorder, RecorderHealth, topic};
use crate::render::Rendered;
use crate::report::{self, PoseSource};
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, Sample};
use crate::time::host_now_us;

/// The session's inputs, embedded in the log.
pub(super) const SETUP_TOPIC: &str = "/session/setup";
/// Ticks of the host clock: replay passes them to the engine as the session did.
pub(super) const CLOCK_TOPIC: &str = "/session/clock";
/// The order in which frames were registered, by number.
pub(super) const ORDER_TOPIC: &str = "/session/order";
/// Frames whose image prefers another pose, by number, when the engine was told.
pub(super) const DISAGREES_TOPIC: &str = "/session/image_disagrees";
/// Key of the provenance: SHA-256 of the weights of the network that says the scatter, where one is asked.
pub(super) const SCATTER_NETWORK: &str = "scatter_network_sha256";
/// The end of the session's inputs.
pub(super) const END_TOPIC: &str = "/session/end";
/// Number and SHA-256 of each DRR's pixels.
pub(super) const DRR_HASH_TOPIC: &str = "/frames/drr_sha256";

/// See the module.
pub(super) struct SessionLog {
    recorder: Recorder,
    reporter: Reporter,
    path: PathBuf,
    names: InputNames,
    /// Held while an input is recorded and handed to the engine.
    engine: Mutex<Option<Sender<Event>>>,
    failed: AtomicBool,
    /// The log has its end.
    finished: AtomicBool,
    losses: Mutex<Losses>,
}

impl SessionLog {
    /// Refuses a folder that holds a session.
    pub(super) fn refuse_occupied(out: &Path) -> Result<(), SessionError> {
        let path = out.join("session.mcap");
        if path.exists() { Err(SessionError::Occupied { path: path.display().to_string() }) } else { Ok(()) }
    }

    /// Creates the log of a session that hears since `started_us`; inputs go to `engine`.
    pub(super) fn create(
        (out, started_us): (&Path, i64),
        setup: &Setup,
        workshop: &Workshop,
        engine: Sender<Event>,
        reporter: &Reporter,
    ) -> Result<Self, SessionError> {
        let path = out.join("session.mcap");
        let names = workshop.names().clone();
        let mut details = json!({"adapter": workshop.adapter(), "inputs": names.shown()});
        if let Some(sha256) = workshop.network_sha256() {
            details[SCATTER_NETWORK] = json!(sha256);
        }
        let setup = names.setup(setup);
        let provenance = Provenance::of_this_program(started_us, details);
        let (recorder, unkept) = match crate::foreign::installed().program() {
            Some(program) => Recorder::create_kept(&path, program, &provenance)?,
            None => (Recorder::create(&path, &provenance)?, None),
        };
        if let Some(error) = unkept {
            let what = format!(
                "the process that writes the log cannot be started ({error}); it is written by this one, and a kill -9 loses"
            );
            reporter.warn("no log keeper", format!("{what} what comes while the disk stands still"));
        }
        recorder.json(SETUP_TOPIC, started_us, &setup)?;
        recorder.attach("scene.json", "application/json", started_us, setup.scene_json.as_bytes())?;
        if let Some((path, text)) = &setup.beads {
            let name = path.file_name().map_or_else(|| "beads.mrk.json".to_owned(), |name| name.to_string_lossy().into_owned());
            recorder.attach(&name, "application/json", started_us, text.as_bytes())?;
        }
        Ok(Self {
            recorder,
            reporter: reporter.clone(),
            path,
            names,
            engine: Mutex::new(Some(engine)),
            failed: AtomicBool::new(false),
            finished: AtomicBool::new(false),
            losses: Mutex::default(),
        })
    }

    /// Where the log is.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn health(&self) -> RecorderHealth {
        self.recorder.health()
    }

    /// A failed log is said once, loudly; the session goes on without it, because the frames still need their pairs.
    fn check(&self, outcome: Result<(), RecordError>) {
        match outcome {
            // Whoever leaves at once does not wait for what still comes in.
            Err(RecordError::Finished { .. }) if self.finished.load(Ordering::Relaxed) => {}
            Err(error) => self.fail(&error.to_string()),
            Ok(()) => {}
        }
    }

    /// Said once.
    pub(super) fn fail(&self, reason: &str) {
        if !self.failed.swap(true, Ordering::Relaxed) {
            self.lose(format!("recording stopped: {reason}"));
            self.reporter.warn("recording stopped", format!("{reason}; telemetry and frames go on without a log"));
        }
    }

    /// Whether recording has stopped.
    pub(super) fn has_failed(&self) -> bool {
        self.failed.load(Ordering::Relaxed)
    }

    /// How what was derived and is gone is had again.
    pub(super) fn again(&self) -> &'static str {
        match self.has_failed() {
            false => "a replay of the log makes what is missing",
            true => "the log has stopped as well: what is missing cannot be made again",
        }
    }

    /// Something is lost: it stands in the report, and the exit code is 3.
    pub(super) fn lose(&self, what: String) {
        self.losses.lock().unwrap_or_else(PoisonError::into_inner).add(what);
    }

    /// Something is lost that no replay brings back or misses: the log tells of it.
    pub(super) fn lose_for_good(&self, what: String) {
        self.event(Level::Error, host_now_us(), &lost(&what));
        self.lose(what);
    }

    /// It is not lost after all, and the log tells of that; false where nobody said that it was.
    pub(super) fn take_back(&self, what: &str) -> bool {
        let is_back = self.losses.lock().unwrap_or_else(PoisonError::into_inner).take_back(what);
        if is_back {
            self.event(Level::Info, host_now_us(), &came(what));
        }
        is_back
    }

    pub(super) fn losses(&self) -> Vec<String> {
        self.losses.lock().unwrap_or_else(PoisonError::into_inner).sentences()
    }

    /// Records an input and hands it to the engine; both in one order, whatever thread calls.
    pub(super) fn input(&self, input: Input) {
        // What takes long is done before the lock is taken: other lines must not wait for the pixels of a frame.
        let prepared = match &input {
            Input::Frame { frame, host_us } => self.recorder.prepare_frame(frame, *host_us).and_then(|frame| {
                self.recorder.wait_for_room(frame.bytes())?;
                Ok(Some(frame))
            }),
            _ => Ok(None),
        };
        let engine = self.engine.lock().unwrap_or_else(PoisonError::into_inner);
        let outcome = match (&input, prepared) {
            (_, Err(error)) => Err(error),
            (_, Ok(Some(prepared))) => self.recorder.record(prepared),
            (Input::Bytes { device, epoch, host_us, bytes }, _) => self.recorder.raw_bytes(device.key(), *epoch, *host_us, bytes),
            (Input::Tick { host_us }, _) => self.recorder.json(CLOCK_TOPIC, *host_us, &json!({ "host_us": host_us })),
            (Input::Develop { number }, _) => self.recorder.json(ORDER_TOPIC, host_now_us(), &json!({ "number": number })),
            (Input::ImageDisagrees { number }, _) => {
                self.recorder.json(DISAGREES_TOPIC, host_now_us(), &json!({ "number": number }))
            }
            (Input::Edit { number, edit, host_us }, _) => {
                let record = EditRecord { number: *number, host_us: *host_us, edit: edit.clone() };
                self.recorder.json(EDIT_TOPIC, *host_us, &record)
            }
            (Input::Note { number, words, host_us }, _) => {
                let record = NoteRecord { number: *number, host_us: *host_us, words: words.clone() };
                self.recorder.json(NOTE_TOPIC, *host_us, &record)
            }
            // Of a log, never of a session.
            (Input::Frame { .. } | Input::Seen { .. }, _) => Ok(()),
        };
        if let Some(sender) = &*engine {
            // The engine listens until the session is over.
            let _ = sender.send(Event::Input(input));
        }
        drop(engine);
        self.check(outcome);
    }

    /// Something for the engine's thread that is no input.
    pub(super) fn tell(&self, event: Event) {
        if let Some(sender) = &*self.engine.lock().unwrap_or_else(PoisonError::into_inner) {
            let _ = sender.send(event);
        }
    }

    pub(super) fn event(&self, level: Level, host_us: i64, text: &str) {
        self.check(self.recorder.event(level, &self.names.hide(text), host_us));
    }

    pub(super) fn sample(&self, device: DeviceKind, host_us: i64, sample: &Sample) {
        self.check(self.recorder.json(topic_of(device, sample), host_us, sample));
    }

    /// What onlookers want of a device at once: joints by name (rad, m), frames of the tree.
    pub(super) fn onlooker(&self, device: &str, host_us: i64, joints: &[(&str, f64)], placed: &[Placed]) {
        self.check(self.recorder.joint_states(&format!("/{device}/joint_states"), host_us, joints));
        if !placed.is_empty() {
            self.check(self.recorder.transforms(&format!("/{device}/tf"), placed, host_us));
        }
    }

    /// The acquired frame for the eye, at the time of its exposure.
    pub(super) fn shown(&self, posed: &Posed) {
        let pixels = &posed.frame.pixels;
        let window = report::window(&[pixels], Some(&posed.masks.usable(pixels.width, pixels.height, &[])));
        self.check(self.recorder.shown(&pixels.map(|value| report::gray(*value, window)[0]), posed.time_us));
    }

    /// A pose, and where its frame stands in the tree.
    pub(super) fn pose(&self, posed: &Posed, placed: &[Placed]) {
        self.check(self.recorder.json(topic::POSE, posed.time_us, &PoseRecord::of(posed)));
        if let Some(view) = &posed.view {
            let projection = view.projection();
            let seen: Vec<f64> =
                posed.pose.shadows.iter().filter(|shadow| shadow.bead.is_some()).map(|shadow| shadow.radius_px).collect();
            let usual_px = if seen.is_empty() { 4.0 } else { seen.iter().sum::<f64>() / seen.len() as f64 };
            let distortion = posed.intensifier.as_deref().map(|intensifier| &intensifier.distortion);
            let mark = |bead: &crate::pose::BeadResidual| {
                let (projected_px, depth_mm) = projection.project(posed.pose.place_of(&bead.body, bead.lps_mm));
                let detected_px = bead.image_px.map(glam::DVec2::from_array);
                // On the picture as it was acquired.
                let shown = |p| Distortion::shown(distortion, p);
                let (projected_px, detected_px) = (shown(projected_px)?, detected_px.and_then(shown));
                let own = |shadow: &&crate::pose::Shadow| shadow.bead.as_deref() == Some(bead.name.as_str());
                let radius_px = posed.pose.shadows.iter().find(own).map_or(usual_px, |shadow| shadow.radius_px);
                (depth_mm > 0.0).then(|| BeadMark { name: bead.name.clone(), detected_px, projected_px, radius_px })
            };
            let marks: Vec<BeadMark> = posed.pose.beads.iter().filter_map(mark).collect();
            self.check(self.recorder.pose_geometry(view, placed, &marks, posed.time_us));
        }
    }

    /// The DRR of a frame, its plan and its hash.
    pub(super) fn drr(&self, posed: &Posed, drr: &Rendered, sha256: &str) {
        let Posed { number, development, time_us, .. } = *posed;
        let record = || {
            let prepared = self.recorder.prepare_drr(&format!("frame {number}"), &drr.pages[0], time_us);
            self.recorder.wait_for_room(prepared.bytes())?;
            self.recorder.record(prepared)?;
            self.recorder.json(topic::PLAN, time_us, &json!({"number": number, "development": development, "plan": drr.plan}))?;
            let hash = json!({"number": number, "development": development, "sha256": sha256});
            self.recorder.json(DRR_HASH_TOPIC, time_us, &hash)
        };
        self.check(record());
    }

    pub(super) fn scores(&self, pair: &crate::report::Pair, time_us: i64) {
        self.check(self.recorder.json(topic::SCORES, time_us, pair));
    }

    /// No more inputs come.
    pub(super) fn end(&self, host_us: i64) {
        self.check(self.recorder.json(END_TOPIC, host_us, &json!({ "host_us": host_us })));
    }

    /// Finishes the log; within a `limit` where somebody leaves at once.
    pub(super) fn finish(&self, limit: Option<Duration>) {
        self.engine.lock().unwrap_or_else(PoisonError::into_inner).take();
        self.finished.store(true, Ordering::Relaxed);
        let Some(limit) = limit else { return self.check(self.recorder.finish().map(|_| ())) };
        match self.recorder.finish_within(limit) {
            Ok(Some(_)) => {}
            Ok(None) => self.reporter.warn(
                "disk stands still",
                "the log's disk stands still: the process that writes the log has all of it, and goes on until it is written",
            ),
            Err(error) => self.check(Err(error)),
        }
    }
}

/// What `/pose` holds.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub(super) struct PoseRecord {
    pub(super) number: u32,
    #[serde(default, skip_serializing_if = "is_zero")]
    pub(super) development: u32,
    pub(super) frame: String,
    pub(super) pose_source: PoseSource,
    pub(super) camera_from_lps: Option<crate::geometry::Rigid>,
    pub(super) projection: Option<crate::geometry::Projection>,
    pub(super) binding: serde_json::Value,
    pub(super) control_angles_deg: Option<[f64; 5]>,
    pub(super) pose: serde_json::Value,
}

impl PoseRecord {
    pub(super) fn of(posed: &Posed) -> Self {
        Self {
            number: posed.number,
            development: posed.development,
            frame: posed.frame.name.clone(),
            pose_source: posed.pose_source,
            camera_from_lps: posed.view.map(|view| view.camera_from_lps),
            projection: posed.view.map(|view| view.projection()),
            binding: serde_json::to_value(&posed.binding).unwrap_or_default(),
            control_angles_deg: posed.robot.as_ref().map(|robot| robot.control_angles_deg),
            pose: serde_json::to_value(&posed.pose).unwrap_or_default(),
        }
    }
}

fn is_zero(n: &u32) -> bool {
    *n == 0
}

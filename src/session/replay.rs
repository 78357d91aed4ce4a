//! A log through the same engine: poses byte for byte, images by their hash. The log is streamed; memory does not grow with it.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

use super::SessionError;
use super::against_log::Samples;
use super::board::Board;
use super::broadcast::Broadcast;
use super::developed::Developed;
use super::edit::take_note;
use super::engine::Engine;
use super::file::Setup;
use super::folder::{Collector, Folder, Times};
use super::image_difference::{ImageDifference, difference};
use super::input::{Input, Output};
use super::jobs::Order;
use super::log::{CLOCK_TOPIC, END_TOPIC, PoseRecord};
use super::log_inputs::LogInputs;
use super::losses::{Losses, none_accepted};
use super::pace::Pace;
use super::places;
use super::posed::Posed;
use super::posing::Registered;
use super::recorded::{Development, Recorded, drrs_of};
use super::records::{CUT_TOPIC, CutRecord, RESTART_TOPIC};
use super::replay_board::ReplayBoard;
pub use super::replay_report::ReplayReport;
use super::replay_report::{another_network, planned_error};
use super::servers::IgtlServer;
use super::tracks::Tracks;
use super::whereabouts::Whereabouts;
use super::workshop::Workshop;
use crate::gpu::DeviceChoice;
use crate::image::read_tiff_f32;
use crate::record::{LogEntry, LogReader, topic};
use crate::reporter::Reporter;

/// How a log is replayed.
#[derive(Clone, Debug)]
pub struct ReplayOptions {
    /// The replayed session's folder.
    pub out: PathBuf,
    /// Where the scene's volumes are, if not where the session had them.
    pub data: Option<PathBuf>,
    /// Speed against the recorded clock; `None` is as fast as possible.
    pub rate: Option<f64>,
    /// Who else is to hear it.
    pub igtl: Option<IgtlServer>,
}

/// Frames that wait for the workshop hold their pixels: more make the replay wait.
const MOST_OPEN: usize = 6;

/// Replays `log`.
///
/// # Errors
/// When the log is none, holds no session, the scene's files are not found, or `out` is the session's own folder.
pub fn run(
    log: &Path,
    options: &ReplayOptions,
    board: &Board,
    reporter: &Reporter,
) -> Result<(Folder, ReplayReport), SessionError> {
    refuse_own_folder(log, &options.out)?;
    let mut recorded = Recorded::read(log)?;
    let no_session = || SessionError::NoSession { path: log.display().to_string(), detail: "no session setup".to_owned() };
    let mut setup = recorded.setup.take().ok_or_else(no_session)?;
    match &options.data {
        // A log of a version that kept the paths.
        Some(data) if setup.inputs.is_empty() => {
            setup.scene_path = data.join(setup.scene_path.file_name().unwrap_or_default());
        }
        data => places::find(&mut setup, log, data.as_deref())?,
    }
    let setup = Arc::new(setup);
    for loss in &recorded.losses {
        reporter.warn("log damaged", format!("{}: {loss}", log.display()));
    }
    let mut workshop = Workshop::open(&setup, DeviceChoice::Auto, reporter)?;
    let mut losses = recorded.losses.clone();
    if let Some(words) = another_network(recorded.network_sha256.as_deref(), workshop.network_sha256()) {
        reporter.warn("scatter network", format!("{}: {words}", log.display()));
        losses.push(words);
    }
    for words in workshop.names().other_versions() {
        reporter.warn("files of the program", format!("{}: {words}", log.display()));
        losses.push(words);
    }
    for (what, words) in setup.adapters.unknowns() {
        reporter.warn(what, words);
    }
    let collector = Collector::create(&options.out, recorded.started_us, Times::Apart, &workshop)?;
    board.keep_pictures_in(&options.out, reporter);
    let broadcast = Broadcast::open(options.igtl.as_ref(), Whereabouts::new(&setup, workshop.robot()), reporter)?;
    let (pairs, developed) = sync_channel(MOST_OPEN);
    workshop.start(Order::AsHandedIn, move |pair| pairs.send(pair).is_ok())?;
    let replay = Replay {
        engine: engine(&setup, &workshop, &recorded, &options.out, reporter),
        board: ReplayBoard::open(board, &setup),
        setup,
        workshop,
        broadcast,
        collector,
        developed,
        tracks: Tracks::new(),
        last_us: 0,
        report: ReplayReport { losses, ..ReplayReport::default() },
        seen: BTreeSet::new(),
        without_pixels: BTreeSet::new(),
        has_end: false,
        rendered: BTreeMap::new(),
        scored: BTreeMap::new(),
        samples: Samples::default(),
        inputs: LogInputs::default(),
        told: Losses::default(),
        is_cut: false,
        recorded,
    };
    replay.run(log, options, reporter)
}

/// A replay never replaces what the session wrote.
fn refuse_own_folder(log: &Path, out: &Path) -> Result<(), SessionError> {
    let real = |path: &Path| std::fs::canonicalize(path).ok();
    let own = log.parent().map(|folder| if folder.as_os_str().is_empty() { Path::new(".") } else { folder });
    let is_own = own.and_then(real).is_some_and(|own| real(out) == Some(own));
    if is_own || out.join("session.mcap").exists() {
        return Err(SessionError::OwnFolder { path: out.display().to_string() });
    }
    Ok(())
}

/// One that knows nothing yet.
fn engine(setup: &Arc<Setup>, workshop: &Workshop, recorded: &Recorded, out: &Path, reporter: &Reporter) -> Engine {
    let mut engine = Engine::new(Arc::clone(setup), workshop.layout().cloned(), reporter.clone());
    engine.park_in(out);
    if recorded.has_edits {
        engine.keep_for_edits();
    }
    engine
}

struct Replay<'a> {
    setup: Arc<Setup>,
    engine: Engine,
    workshop: Workshop,
    broadcast: Broadcast,
    collector: Collector,
    developed: Receiver<Developed>,
    tracks: Tracks,
    board: ReplayBoard<'a>,
    /// Host time of the latest input.
    last_us: i64,
    recorded: Recorded,
    report: ReplayReport,
    /// What was posed by now.
    seen: BTreeSet<Development>,
    /// Frames whose pixels were left out of the log.
    without_pixels: BTreeSet<u32>,
    /// The inputs of the session, or of this part of it, came to their end.
    has_end: bool,
    /// The last DRR of each frame against the log's.
    rendered: BTreeMap<u32, AgainstLog>,
    /// Whether the last scores of each frame are the log's.
    scored: BTreeMap<u32, bool>,
    samples: Samples,
    inputs: LogInputs,
    /// What the log's events tell of losses that nothing else in it shows: files of which no frame came.
    told: Losses,
    /// Frames were cut away, and exposures were not.
    is_cut: bool,
}

/// How a DRR stands to the log's.
enum AgainstLog {
    Same,
    /// Another hash; the bound of its plan.
    Different {
        bound: f64,
    },
    NotInLog,
}

impl Replay<'_> {
    fn run(mut self, log: &Path, options: &ReplayOptions, reporter: &Reporter) -> Result<(Folder, ReplayReport), SessionError> {
        let progress = reporter.progress("replaying", self.recorded.messages);
        let mut pace = Pace::new(options.rate);
        self.last_us = self.recorded.started_us;
        for entry in LogReader::open(log)? {
            progress.advance(1);
            if self.samples.says(&entry) {
                continue;
            }
            let is_input = matches!(&*entry.topic, topic::CARM_RAW | topic::ROBOT_RAW | topic::FRAME_PIXELS | CLOCK_TOPIC);
            if is_input {
                pace.wait_for(entry.host_us);
                self.last_us = self.last_us.max(entry.host_us);
            }
            if &*entry.topic == END_TOPIC {
                self.has_end = true;
                self.with_engine(|engine, sink| engine.finish(entry.host_us, sink));
            } else if &*entry.topic == RESTART_TOPIC {
                // As the session had, the engine learns clocks, counters and the specimen's place anew.
                self.end_engine(reporter);
                self.engine = engine(&self.setup, &self.workshop, &self.recorded, &options.out, reporter);
                self.samples.begin_anew();
                self.broadcast.begin_anew();
            } else if let Some(cut) = self.cut(&entry) {
                self.samples.cut(cut.from_us, cut.to_us);
                self.is_cut = true;
            } else if &*entry.topic == topic::EVENTS {
                // No result rests on one that is damaged.
                entry.event().ok().flatten().iter().for_each(|event| self.told.hear(event));
            } else if let Some(input) = self.inputs.of(&entry) {
                if let Input::Seen { frame, .. } = &input {
                    self.without_pixels.insert(frame.number);
                }
                self.with_engine(|engine, sink| engine.push(input, sink));
            }
            if is_input {
                self.broadcast.look(&self.engine, self.last_us);
            }
            self.board.tick(&self.engine, self.last_us, self.report.frames, self.workshop.open_jobs());
            self.take_pairs(reporter);
        }
        self.end_engine(reporter);
        self.workshop.close();
        while let Ok(developed) = self.developed.recv() {
            self.take_pair(developed, reporter);
        }
        self.workshop.join()?;
        self.finish(log, options, reporter)
    }

    /// The inputs of a session, or of one of the logs that were joined, are over.
    fn end_engine(&mut self, reporter: &Reporter) {
        let last_us = self.last_us;
        if !std::mem::take(&mut self.has_end) {
            self.report.losses.push("the log has no end: the session was cut short".to_owned());
            self.with_engine(|engine, sink| engine.finish(last_us, sink));
        }
        // What the session did not come to, in the order of arrival.
        let left: Vec<u32> = self.engine.bound().collect();
        for number in left {
            self.with_engine(|engine, sink| engine.push(Input::Develop { number }, sink));
            self.take_pairs(reporter);
        }
        self.report.session_losses.extend(self.engine.line_losses());
        self.report.session_losses.extend(self.engine.hardly_bound());
        if !self.is_cut {
            self.engine.unmatched().for_each(|(kind, words)| reporter.warn(kind, words));
        }
    }

    fn cut(&mut self, entry: &LogEntry) -> Option<CutRecord> {
        (&*entry.topic == CUT_TOPIC).then(|| self.inputs.tolerance.take(entry.json()))?
    }

    fn with_engine(&mut self, drive: impl FnOnce(&mut Engine, &mut dyn FnMut(Output))) {
        let mut outputs = VecDeque::new();
        drive(&mut self.engine, &mut |output| outputs.push_back(output));
        while let Some(output) = outputs.pop_front() {
            let engine = &mut self.engine;
            let mut sink = |output| outputs.push_back(output);
            match output {
                // What a device says of itself was said when it was recorded.
                Output::Sample { device, host_us, sample } => {
                    self.samples.decoded(device, host_us, &sample);
                    self.broadcast.sample(host_us, &sample, engine.world_from_lps());
                    drop(self.tracks.sample(host_us, &sample));
                }
                // A log that keeps no order registered each frame when it was bound.
                Output::Bound { number } if !self.recorded.has_order => engine.push(Input::Develop { number }, &mut sink),
                Output::Fault { .. } | Output::Bound { .. } | Output::BoundLate { .. } | Output::NotEdited { .. } => {}
                Output::Job(job) => engine.registered(job.run(), &mut sink),
                Output::PictureLost { job, words } => {
                    self.report.losses.push(format!("frame {}: {words}", job.number()));
                    engine.registered(Registered::failed(*job, &words), &mut sink);
                }
                Output::Noted { number, words } => {
                    self.tracks.noted(number, &words);
                    self.board.board().update(|state| take_note(&mut state.notes, number, &words));
                }
                Output::Edit(job) => self.take_posed(job.run()),
                Output::Posed(posed) => self.take_posed(*posed),
            }
        }
    }

    fn take_posed(&mut self, posed: Posed) {
        let number = posed.number;
        let development = (number, posed.development);
        self.report.frames += usize::from(posed.development == 0);
        self.seen.insert(development);
        let now = serde_json::to_vec(&PoseRecord::of(&posed)).unwrap_or_default();
        match self.recorded.poses.get(&development) {
            Some(then) if *then == now => self.report.poses_identical += 1,
            Some(_) => self.report.poses_different.push(number),
            None if self.recorded.plans.contains_key(&development) => {
                self.report
                    .losses
                    .push(format!("the pose of frame {number} is gone from the log; what was made with it is there"));
            }
            None => self.report.not_in_log.push(format!("pose of frame {number}")),
        }
        self.broadcast.posed(&posed, &posed.announcement());
        if posed.view.is_some() && self.recorded.is_passed_over(development) {
            return;
        }
        let plan = self.recorded.plans.get(&development).cloned();
        self.workshop.submit(posed, plan);
    }

    /// Takes what is ready; waits where too many frames are open.
    fn take_pairs(&mut self, reporter: &Reporter) {
        loop {
            if let Ok(developed) = self.developed.try_recv() {
                self.take_pair(developed, reporter);
            } else if self.workshop.open_jobs() > MOST_OPEN && !self.workshop.has_ended() {
                if let Ok(developed) = self.developed.recv_timeout(Duration::from_millis(20)) {
                    self.take_pair(developed, reporter);
                }
            } else {
                return;
            }
        }
    }

    fn take_pair(&mut self, developed: Developed, reporter: &Reporter) {
        let number = developed.posed.number;
        if let (Some(sha256), Some((drr, _)), false) = (&developed.drr_sha256, &developed.drr, self.collector.knows(&developed)) {
            let against_log = match self.recorded.hashes.get(&number) {
                Some(then) if then == sha256 => AgainstLog::Same,
                // What a network or photons leave uncertain of scatter is the same in both.
                Some(_) => AgainstLog::Different { bound: planned_error(&drr.plan) },
                None => AgainstLog::NotInLog,
            };
            self.rendered.insert(number, against_log);
        }
        self.compare_scores(&developed);
        self.broadcast.developed(&developed, !self.collector.knows(&developed));
        self.board.board().show(|| developed.picture());
        for failure in self.collector.take(developed) {
            reporter.warn("file not written", &failure);
            if self.report.losses.len() < 20 {
                self.report.losses.push(failure);
            }
        }
    }

    /// Scores of a pair whose pose and DRR are the log's: they follow from these.
    fn compare_scores(&mut self, developed: &Developed) {
        let number = developed.posed.number;
        let is_same =
            matches!(self.rendered.get(&number), Some(AgainstLog::Same)) && !self.report.poses_different.contains(&number);
        let Some(then) = self.recorded.scores.get(&number).filter(|_| developed.complete && is_same) else { return };
        let again = (number, 1);
        let once = !self.recorded.poses.contains_key(&again) && !self.seen.contains(&again);
        self.scored.insert(number, then.agrees(&developed.pair, once));
    }

    fn finish(
        mut self,
        log: &Path,
        options: &ReplayOptions,
        reporter: &Reporter,
    ) -> Result<(Folder, ReplayReport), SessionError> {
        let mut differences: BTreeMap<u32, ImageDifference> = BTreeMap::new();
        let mut to_compare: BTreeMap<u32, f64> = BTreeMap::new();
        for (number, against_log) in &self.rendered {
            match against_log {
                AgainstLog::Same => self.report.images_identical += 1,
                AgainstLog::Different { bound } => _ = to_compare.insert(*number, *bound),
                // A plan is written behind its DRR and before the DRR's hash.
                AgainstLog::NotInLog if self.recorded.plans.keys().any(|(of, _)| of == number) => {
                    self.report.losses.push(format!("the hash of frame {number}'s DRR is gone from the log; its plan is there"));
                }
                AgainstLog::NotInLog => self.report.not_in_log.push(format!("DRR of frame {number}")),
            }
        }
        if !to_compare.is_empty() {
            drrs_of(log, &|number| to_compare.contains_key(&number), &mut |number, then| {
                let now = read_tiff_f32(&options.out.join(format!("drr/{number:03}.tif"))).ok();
                let now = now.and_then(|pages| pages.into_iter().next());
                let (largest_nepers, detail) = difference(&then, now.as_ref());
                let bound = to_compare.get(&number).copied().unwrap_or(0.0);
                differences.insert(number, ImageDifference { number, largest_nepers, bound, detail });
            })?;
        }
        for (number, bound) in to_compare {
            let detail = Some("the log has its hash, but not its pixels".to_owned());
            let unknown = ImageDifference { number, largest_nepers: None, bound, detail };
            self.report.images_different.push(differences.remove(&number).unwrap_or(unknown));
        }
        for (number, is_same) in &self.scored {
            match is_same {
                true => self.report.scores_identical += 1,
                false => self.report.scores_different.push(*number),
            }
        }
        let has_pixels = |number: &u32| !self.without_pixels.contains(number);
        let not_rendered = self.recorded.hashes.keys().filter(|number| !self.rendered.contains_key(number));
        self.report.images_missing = not_rendered.copied().filter(has_pixels).collect();
        self.report.samples_different = self.samples.different();
        let missing = self.recorded.poses.keys().filter(|development| !self.seen.contains(development));
        self.report.poses_missing = missing.map(|(number, _)| *number).filter(has_pixels).collect();
        let posed = self.without_pixels.iter().filter(|number| self.recorded.poses.contains_key(&(**number, 0))).count();
        if posed > 0 {
            let words =
                "were left out of this log on purpose (log redact --no-pixels): their poses and images cannot be made again";
            self.report.losses.push(format!("the pixels of {posed} frames {words}"));
        }
        self.report.losses.extend(self.inputs.tolerance.losses().into_iter().filter(|loss| !self.recorded.losses.contains(loss)));
        self.report.session_losses.splice(0..0, self.told.sentences());
        self.board.finish(&self.engine, self.last_us, self.report.frames);
        let losses = self.report.losses.iter().chain(&self.report.session_losses).cloned().collect();
        let folder =
            self.collector.finish(&self.engine, self.tracks, (losses, "another replay makes what is missing"), reporter, None);
        // What is known only now: that no frame gave a pose, and what could not be written.
        let report = &mut self.report;
        report.session_losses.extend(none_accepted(&folder.pairs).filter(|_| self.engine.seeks_beads()));
        let is_told = |loss: &&String| report.session_losses.contains(loss) || report.losses.contains(loss);
        let untold: Vec<String> = folder.losses.iter().filter(|loss| !is_told(loss)).cloned().collect();
        report.losses.extend(untold);
        Ok((folder, self.report))
    }
}

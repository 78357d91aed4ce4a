//! The session's folder: `strips/NNN.png drr/NNN.tif pairs.json timings.json report.html` (DESIGN §7).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::SessionError;
use super::developed::Developed;
use super::engine::Engine;
use super::inputs::InputNames;
use super::left_out::LeftOut;
use super::losses::none_accepted;
use super::tracks::Tracks;
use super::workshop::Workshop;
use crate::image::{read_png_rgb, write_atomically, write_png_rgb};
use crate::render::write_image_without_times;
use crate::report::{Pair, Provenance, SessionReport, restated, write_pairs, write_session};
use crate::reporter::Reporter;
use crate::time::{StageTimes, Stopwatch};

/// A finished session.
#[derive(Debug)]
pub struct Folder {
    /// The folder.
    pub path: PathBuf,
    /// The log; absent for a replay.
    pub log: Option<PathBuf>,
    /// One row per exposure, in order.
    pub pairs: Vec<Pair>,
    /// Pose of each rendered frame, by number.
    pub views: BTreeMap<u32, crate::geometry::View>,
    /// What was lost.
    pub losses: Vec<String>,
    /// What the report says besides the pairs; `None` where none was written.
    pub report: Option<Box<SessionReport>>,
}

impl Folder {
    /// Writes `pairs.json` and `report.html` again, with what has been added to the pairs since.
    ///
    /// # Errors
    /// When the folder is not writable.
    pub fn write_again(&self) -> Result<(), SessionError> {
        let Some(report) = &self.report else { return Ok(write_pairs(&self.path.join("pairs.json"), &self.pairs)?) };
        let report = SessionReport { pairs: self.pairs.clone(), ..SessionReport::clone(report) };
        let mut errors = write_session(&self.path, &report);
        match errors.len() {
            0 => Ok(()),
            1 => Err(errors.remove(0).into()),
            _ => Err(SessionError::Unwritten(errors.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))),
        }
    }
}

/// Whether derived files say how long things took.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Times {
    /// In `pairs.json` and the report.
    Told,
    /// Only in `timings.json`: two replays are byte-identical.
    Apart,
}

/// Writes the files of pairs as they come in, and the report at the end.
pub(super) struct Collector {
    path: PathBuf,
    names: InputNames,
    times: Times,
    rows: BTreeMap<u32, Pair>,
    /// Of each row, how often its frame was posed before.
    developments: BTreeMap<u32, u32>,
    views: BTreeMap<u32, crate::geometry::View>,
    /// Frames of unfinished files, and those that are the whole pictures.
    replaced: BTreeMap<u32, u32>,
    report: SessionReport,
    left_out: LeftOut,
    timings: BTreeMap<u32, StageTimes>,
    /// Files that could not be written, and why the latest could not.
    unwritten: BTreeMap<String, String>,
    /// `pairs.json` lags behind.
    pairs_are_old: bool,
    since_pairs: Stopwatch,
}

/// `pairs.json` holds all pairs; it is written at most this often.
const PAIRS_MS: f64 = 500.0;

impl Collector {
    /// Creates the folder and those inside it.
    pub(super) fn create(path: &Path, started_us: i64, times: Times, workshop: &Workshop) -> Result<Self, SessionError> {
        for part in ["strips", "drr"] {
            let folder = path.join(part);
            std::fs::create_dir_all(&folder)
                .map_err(|source| SessionError::Folder { path: folder.display().to_string(), source })?;
        }
        let network = workshop.network_sha256();
        let names = workshop.names().clone();
        let inputs: Vec<_> = names.shown().into_iter().map(|input| (input.path, input.sha256)).collect();
        let scene = inputs.first().map(|(label, _)| ("scene".to_owned(), label.clone()));
        let provenance = Provenance {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            adapter: Some(workshop.adapter().to_owned()),
            command: None,
            inputs,
            details: scene
                .into_iter()
                .chain(network.map(|sha256| ("scatter network".to_owned(), format!("sha256 {sha256}"))))
                .collect(),
        };
        let report = SessionReport {
            title: "Sidecarm session".to_owned(),
            started_us: Some(started_us),
            provenance,
            ..SessionReport::default()
        };
        Ok(Self {
            path: path.to_owned(),
            names,
            times,
            rows: BTreeMap::new(),
            developments: BTreeMap::new(),
            views: BTreeMap::new(),
            replaced: BTreeMap::new(),
            report,
            left_out: LeftOut::default(),
            timings: BTreeMap::new(),
            unwritten: BTreeMap::new(),
            pairs_are_old: false,
            since_pairs: Stopwatch::start(),
        })
    }

    /// Whether this pair came before, so that only its null is new.
    pub(super) fn knows(&self, developed: &Developed) -> bool {
        self.developments.get(&developed.posed.number) >= Some(&developed.posed.development)
    }

    /// Writes strip, DRR and `pairs.json`; gives a sentence for each file that could not be written.
    pub(super) fn take(&mut self, developed: Developed) -> Vec<String> {
        let number = developed.posed.number;
        let known = self.knows(&developed);
        let mut pair = developed.pair;
        let strip = format!("strips/{number:03}.png");
        let written = write_png_rgb(&self.path.join(&strip), &developed.strip);
        let mut failures: Vec<String> = self.note(&strip, written).into_iter().collect();
        pair.strip = Some(strip);
        if let Some((drr, scene)) = &developed.drr {
            let name = format!("drr/{number:03}.tif");
            if !known {
                self.left_out.take(number, &drr.plan);
                let written = write_image_without_times(&self.path.join(&name), drr, scene);
                failures.extend(self.note(&name, written));
            }
            pair.drr = Some(name);
        }
        if let Some(view) = developed.posed.view {
            self.views.insert(number, view);
        }
        self.developments.insert(number, developed.posed.development);
        self.timings.insert(number, pair.stages_ms.clone());
        if self.times == Times::Apart {
            pair.stages_ms = StageTimes::default();
        }
        self.rows.insert(number, pair);
        let before = developed.posed.frame.completes;
        self.replaced.extend(before.map(|before| (before, number)));
        for unfinished in [Some(number), before].into_iter().flatten() {
            failures.extend(self.take_back(unfinished));
        }
        self.pairs_are_old = true;
        failures.extend(self.write_pairs_if_due());
        failures
    }

    /// What was said of a picture that was not finished is taken back, in its row and its strip.
    fn take_back(&mut self, number: u32) -> Option<String> {
        let by = *self.replaced.get(&number)?;
        let pair = self.rows.get_mut(&number)?;
        pair.replace_by(by);
        let name = pair.strip.clone()?;
        let (frame, standing, status) = (pair.frame.clone(), pair.standing(), pair.status_line());
        let path = self.path.join(&name);
        let written = read_png_rgb(&path).and_then(|strip| write_png_rgb(&path, &restated(strip, &frame, standing, &status)));
        self.note(&name, written)
    }

    /// Writes `pairs.json` unless it was written just now.
    pub(super) fn write_pairs_if_due(&mut self) -> Option<String> {
        if !self.pairs_are_old || self.since_pairs.ms() < PAIRS_MS {
            return None;
        }
        self.since_pairs = Stopwatch::start();
        self.pairs_are_old = false;
        let pairs: Vec<Pair> = self.rows.values().cloned().collect();
        let written = write_pairs(&self.path.join("pairs.json"), &pairs);
        self.note("pairs.json", written)
    }

    fn note<E: std::fmt::Display>(&mut self, file: &str, written: Result<(), E>) -> Option<String> {
        match written {
            Ok(()) => {
                self.unwritten.remove(file);
                None
            }
            Err(error) => {
                let sentence = format!("{file} is not written: {error}");
                self.unwritten.insert(file.to_owned(), error.to_string());
                Some(sentence)
            }
        }
    }

    /// The names of this machine's files and folders do not reach the report.
    fn hide_names(&mut self) {
        let own = format!("{}/", self.path.display());
        let hide = |text: &str| self.names.hide(&text.replace(&own, ""));
        self.report.losses.iter_mut().for_each(|loss| *loss = hide(loss));
        self.report.warnings.iter_mut().for_each(|(_, counted)| counted.latest = hide(&counted.latest));
    }

    /// How long each stage of each frame took.
    fn write_timings(&self) -> Result<(), crate::image::ImageFileError> {
        let frames: Vec<_> =
            self.timings.iter().map(|(number, stages)| serde_json::json!({"number": number, "stages_ms": stages})).collect();
        let text = serde_json::json!({ "frames": frames }).to_string();
        write_atomically(&self.path.join("timings.json"), |file| file.write_all(text.as_bytes()))
    }

    /// Writes the report; what could not be written at all is a loss. `again`: how it is had all the same.
    pub(super) fn finish(
        mut self,
        engine: &Engine,
        tracks: Tracks,
        (losses, again): (Vec<String>, &str),
        reporter: &Reporter,
        log: Option<PathBuf>,
    ) -> Folder {
        let written = self.write_timings();
        self.note("timings.json", written);
        self.report.ended_us = tracks.last_us().or(self.report.started_us);
        (self.report.links, self.report.tracks) = tracks.links(engine);
        for (number, pair) in
            self.rows.iter_mut().filter(|(number, pair)| pair.binding == "none" && !self.replaced.contains_key(number))
        {
            // More was known at the end than when it was developed.
            if let Some(binding) = engine.why_unbound(*number) {
                pair.binding_evidence.clone_from(&binding.evidence);
                let flags = binding.flags.iter().map(ToString::to_string);
                let new: Vec<String> = flags.filter(|flag| !pair.flags.contains(flag)).collect();
                pair.flags.extend(new);
            }
        }
        self.report.pairs = std::mem::take(&mut self.rows).into_values().collect();
        self.report.losses = losses;
        self.report.losses.extend(none_accepted(&self.report.pairs).filter(|_| engine.seeks_beads()));
        self.report.warnings = reporter.warnings();
        self.report.not_modelled = self.left_out.sentences();
        self.unwritten.remove("pairs.json");
        if let Some((file, reason)) = self.unwritten.iter().next_back() {
            let others = match self.unwritten.len() {
                1 => String::new(),
                count => format!(" and {} other files", count - 1),
            };
            let sentence = format!("{file}{others} could not be written ({reason}); {again}");
            self.report.losses.push(sentence);
        }
        self.hide_names();
        for error in write_session(&self.path, &self.report) {
            reporter.warn("report not written", &error);
            self.report.losses.push(format!("{error}; {again}"));
        }
        // What is said of them now holds a path again.
        self.hide_names();
        let (pairs, losses) = (std::mem::take(&mut self.report.pairs), self.report.losses.clone());
        Folder { path: self.path, log, pairs, views: self.views, losses, report: Some(Box::new(self.report)) }
    }
}

//! The session's folder: `strips/NNN.png drr/NNN.tif pairs.json timings.json report.html` (DESIGN §7).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::SessionError;
use super::bound::copy_of;
use super::developed::Developed;
use super::engine::Engine;
use super::fault;
use super::inputs::InputNames;
use super::left_out::LeftOut;
use super::losses::none_accepted;
use super::tracks::Tracks;
use super::unwritten::Unwritten;
use super::workshop::Workshop;
use crate::image::{Image, Lasting, check_writable, read_png_rgb, write_lasting, write_png_rgb};
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
    /// How many frames were recorded.
    pub frames: usize,
    /// How many of them have no pair, or one that is not complete.
    pub unfinished: usize,
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

/// How long the stages of a frame took, and how long this machine was expected to take for the DRR.
struct Timing {
    stages: StageTimes,
    predicted_ms: Option<f64>,
}

/// The strip of a pair whose null is to come: what it says may change, and each strip is written once.
struct WaitingStrip {
    strip: Arc<Image<[u8; 3]>>,
    since: Stopwatch,
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
    timings: BTreeMap<u32, Timing>,
    /// Strips that are not written yet.
    waiting: BTreeMap<u32, WaitingStrip>,
    /// Files that could not be written.
    unwritten: Unwritten,
    /// `pairs.json` lags behind.
    pairs_are_old: bool,
    since_pairs: Stopwatch,
    /// Of `pairs.json` as it was written last.
    pairs_bytes: u64,
}

/// `pairs.json` holds all pairs and is written whole, at most this often.
const PAIRS_MS: f64 = 500.0;
/// And no more of it than 2 MB a second: in a session of thousands of frames it lags behind by minutes, which a replay makes good.
const PAIRS_BYTES_PER_MS: f64 = 2000.0;

/// Time from one writing of `pairs.json` to the next, by the size of that.
fn between_pairs_ms(bytes: u64) -> f64 {
    PAIRS_MS.max(bytes as f64 / PAIRS_BYTES_PER_MS)
}

/// A frame's strip, relative to the session's folder.
fn strip_name(number: u32) -> String {
    format!("strips/{number:03}.png")
}

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
        Ok(Self::empty(path, names, times, report))
    }

    /// With no pair yet.
    fn empty(path: &Path, names: InputNames, times: Times, report: SessionReport) -> Self {
        Self {
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
            waiting: BTreeMap::new(),
            unwritten: Unwritten::default(),
            pairs_are_old: false,
            since_pairs: Stopwatch::start(),
            pairs_bytes: 0,
        }
    }

    /// Whether this pair came before, so that only its null is new.
    pub(super) fn knows(&self, developed: &Developed) -> bool {
        self.developments.get(&developed.posed.number) >= Some(&developed.posed.development)
    }

    /// Writes DRR and `pairs.json`, and the strip once the pair is complete; gives a sentence for each file that could not be written.
    pub(super) fn take(&mut self, developed: Developed) -> Vec<String> {
        let number = developed.posed.number;
        let known = self.knows(&developed);
        let mut failures = Vec::new();
        let mut pair = developed.pair;
        let before = developed.posed.frame.completes;
        self.replaced.extend(before.map(|before| (before, number)));
        if let Some(by) = self.replaced.get(&number) {
            pair.replace_by(*by);
        }
        let strip = strip_name(number);
        let is_same = self.developments.get(&number) == Some(&developed.posed.development);
        let is_written = is_same && !self.waiting.contains_key(&number) && !self.unwritten.holds(&strip);
        // The null has changed nothing of what the strip says.
        let stands = is_written && self.rows.get(&number).is_some_and(|row| row.heading() == pair.heading());
        pair.strip = Some(strip);
        if let Some((drr, scene)) = &developed.drr {
            let name = format!("drr/{number:03}.tif");
            if !known {
                self.left_out.take(number, &drr.plan);
                let written = write_image_without_times(&self.path.join(&name), drr, scene);
                failures.extend(self.unwritten.note(&name, written));
            }
            pair.drr = Some(name);
        }
        if let Some(view) = developed.posed.view {
            self.views.insert(number, view);
        }
        self.developments.insert(number, developed.posed.development);
        let predicted_ms = developed.drr.as_ref().and_then(|(drr, _)| drr.plan["predicted_ms"].as_f64());
        self.timings.insert(number, Timing { stages: pair.stages_ms.clone(), predicted_ms });
        if self.times == Times::Apart {
            pair.stages_ms = StageTimes::default();
        }
        self.rows.insert(number, pair);
        if !stands {
            failures.extend(self.take_strip(number, developed.strip, developed.complete));
        }
        failures.extend(before.and_then(|before| self.take_back(before)));
        self.pairs_are_old = true;
        failures.extend(self.write_pairs_if_due());
        failures
    }

    /// Writes the strip of a pair that is complete; that of another waits for its null.
    fn take_strip(&mut self, number: u32, strip: Arc<Image<[u8; 3]>>, complete: bool) -> Option<String> {
        let before = self.waiting.remove(&number);
        if complete {
            return self.write_strip(number, &strip);
        }
        let since = before.map_or_else(Stopwatch::start, |before| before.since);
        self.waiting.insert(number, WaitingStrip { strip, since });
        // That it will not be written is said while something can be done about it.
        let name = strip_name(number);
        let writable = check_writable(&self.path.join(&name));
        self.unwritten.note(&name, writable)
    }

    /// Strips that are not written yet, by frame, and for how many milliseconds they have waited.
    pub(super) fn waiting(&self) -> impl Iterator<Item = (u32, f64)> + '_ {
        self.waiting.iter().map(|(number, waiting)| (*number, waiting.since.ms()))
    }

    /// Writes a strip that waits as it is; gives a sentence when it could not be written.
    pub(super) fn write_waiting(&mut self, number: u32) -> Option<String> {
        let waiting = self.waiting.remove(&number)?;
        self.write_strip(number, &waiting.strip)
    }

    /// Writes a strip; that of a picture whose file was written on or anew says so.
    fn write_strip(&mut self, number: u32, strip: &Image<[u8; 3]>) -> Option<String> {
        fault::hangs("strip");
        let name = strip_name(number);
        let path = self.path.join(&name);
        let taken_back = self.rows.get(&number).filter(|_| self.replaced.contains_key(&number));
        let written = match taken_back {
            Some(pair) => write_png_rgb(&path, &restated(strip.clone(), &pair.frame, pair.standing(), &pair.status_line())),
            None => write_png_rgb(&path, strip),
        };
        self.unwritten.note(&name, written)
    }

    /// What was said of a picture whose file was written on or anew is taken back, in its row and its strip.
    fn take_back(&mut self, number: u32) -> Option<String> {
        let by = *self.replaced.get(&number)?;
        self.rows.get_mut(&number)?.replace_by(by);
        // A strip that is still to be written will say so.
        if self.waiting.contains_key(&number) {
            return None;
        }
        let name = strip_name(number);
        match read_png_rgb(&self.path.join(&name)) {
            Ok(strip) => self.write_strip(number, &strip),
            Err(error) => self.unwritten.note(&name, Err(error)),
        }
    }

    /// Writes `pairs.json` unless it was written just now.
    pub(super) fn write_pairs_if_due(&mut self) -> Option<String> {
        if !self.pairs_are_old || self.since_pairs.ms() < between_pairs_ms(self.pairs_bytes) {
            return None;
        }
        self.since_pairs = Stopwatch::start();
        self.pairs_are_old = false;
        let path = self.path.join("pairs.json");
        let written = write_pairs(&path, self.rows.values());
        self.pairs_bytes = std::fs::metadata(&path).map_or(0, |file| file.len());
        self.unwritten.note("pairs.json", written)
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
        let row = |(number, timing): (&u32, &Timing)| {
            let Timing { stages, predicted_ms } = timing;
            serde_json::json!({"number": number, "stages_ms": stages, "predicted_ms": predicted_ms})
        };
        let frames: Vec<_> = self.timings.iter().map(row).collect();
        let text = serde_json::json!({ "frames": frames }).to_string();
        write_lasting(&self.path.join("timings.json"), Lasting::Later, |file| file.write_all(text.as_bytes()))
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
        // A session that is left at once, or whose other threads died, makes no null any more.
        let waiting: Vec<u32> = self.waiting.keys().copied().collect();
        for failure in waiting.into_iter().filter_map(|number| self.write_waiting(number)) {
            reporter.warn("file not written", format!("{failure}; {again}"));
        }
        let written = self.write_timings();
        self.unwritten.note("timings.json", written);
        self.report.ended_us = tracks.last_us().or(self.report.started_us);
        for (number, pair) in &mut self.rows {
            pair.note = tracks.note(*number).map(str::to_owned);
        }
        (self.report.links, self.report.tracks) = tracks.links(engine);
        for (number, pair) in
            self.rows.iter_mut().filter(|(number, pair)| pair.binding == "none" && !self.replaced.contains_key(number))
        {
            // More was known at the end than when it was developed.
            if let Some(binding) = engine.why_unbound(*number) {
                pair.binding_evidence.clone_from(&binding.evidence);
                pair.copy_of = copy_of(binding);
                let flags = binding.flags.iter().map(ToString::to_string);
                let new: Vec<String> = flags.filter(|flag| !pair.flags.contains(flag)).collect();
                pair.flags.extend(new);
            }
        }
        for (number, words) in engine.words_of_those_that_count_on() {
            if let Some(pair) = self.rows.get_mut(&number) {
                pair.flags.push(words);
            }
        }
        self.report.pairs = std::mem::take(&mut self.rows).into_values().collect();
        self.report.losses = losses;
        self.report.losses.extend(none_accepted(&self.report.pairs).filter(|_| engine.seeks_beads()));
        self.report.warnings = reporter.warnings();
        self.report.not_modelled = self.left_out.sentences();
        self.unwritten.forget("pairs.json");
        self.report.losses.extend(self.unwritten.sentence(again));
        self.hide_names();
        for error in write_session(&self.path, &self.report) {
            reporter.warn("report not written", &error);
            self.report.losses.push(format!("{error}; {again}"));
        }
        // What is said of them now holds a path again.
        self.hide_names();
        let (pairs, losses) = (std::mem::take(&mut self.report.pairs), self.report.losses.clone());
        let (frames, unfinished) = (pairs.len(), 0);
        let report = Some(Box::new(self.report));
        Folder { path: self.path, log, pairs, views: self.views, losses, frames, unfinished, report }
    }
}

#[cfg(test)]
mod tests {
    use super::super::posed::Posed;
    use super::*;
    use crate::report::{PairStatus, PoseSource};

    const STRIP_PX: [usize; 2] = [1200, 80];

    /// A session's folder without a pair, and what writes into it.
    fn begun() -> (tempfile::TempDir, Collector) {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::create_dir(folder.path().join("strips")).expect("a folder");
        let collector = Collector::empty(folder.path(), InputNames::default(), Times::Told, SessionReport::default());
        (folder, collector)
    }

    fn gray_strip(gray: u8) -> Image<[u8; 3]> {
        Image::filled(STRIP_PX[0], STRIP_PX[1], [gray; 3])
    }

    /// An accepted pair of a frame; its strip is of one gray.
    fn pair_of(number: u32, gray: u8, complete: bool) -> Developed {
        let mut pair = Pair { number, ..Pair::unmatched("a", "") };
        (pair.status, pair.reason, pair.pose_source) = (PairStatus::Accepted, None, PoseSource::Beads);
        let (posed, strip) = (Arc::new(Posed::bare(number)), Arc::new(gray_strip(gray)));
        let (drr, scatter, compared, seen_robot, drr_sha256) = (None, None, None, None, None);
        Developed { posed, pair, drr, scatter, compared, seen_robot, strip, drr_sha256, complete }
    }

    /// With its null, which leaves a doubt.
    fn doubted(number: u32, gray: u8) -> Developed {
        let mut developed = pair_of(number, gray, true);
        developed.pair.doubt("the image prefers another pose");
        developed
    }

    /// A pair is shown before its null is there; its strip is not written for that.
    #[test]
    fn a_strip_is_written_once_with_its_null_or_before_where_that_is_late() {
        let (folder, mut collector) = begun();
        let path = |number: u32| folder.path().join(strip_name(number));
        let gray = |number: u32| read_png_rgb(&path(number)).ok().map(|strip| strip.pixels[0][0]);
        let mut take = |developed: Developed, late: bool| {
            let number = developed.posed.number;
            let mut failures = collector.take(developed);
            failures.extend(late.then(|| collector.write_waiting(number)).flatten());
            let waiting = collector.waiting().any(|(waiting, _)| waiting == number);
            (failures.len(), waiting)
        };
        // The null is there soon.
        assert_eq!((take(pair_of(1, 10, false), false), gray(1)), ((0, true), None));
        assert_eq!((take(doubted(1, 11), false), gray(1)), ((0, false), Some(11)));

        // It is late and changes nothing that the strip says: what stands in place of the strip stays.
        assert_eq!((take(pair_of(2, 20, false), true), gray(2)), ((0, false), Some(20)));
        std::fs::write(path(2), "not written again").expect("written");
        assert_eq!(take(pair_of(2, 20, true), false), (0, false));
        assert_eq!(std::fs::read(path(2)).expect("there"), b"not written again");
        // It is late, and the strip says another thing: the control.
        assert_eq!((take(pair_of(3, 30, false), true), gray(3)), ((0, false), Some(30)));
        assert_eq!((take(doubted(3, 31), false), gray(3)), ((0, false), Some(31)));
        // Another pose is another picture, whatever it says.
        let mut edited = pair_of(2, 22, true);
        Arc::make_mut(&mut edited.posed).development = 1;
        assert_eq!((take(edited, false), gray(2)), ((0, false), Some(22)));

        // That there is no folder is said before the null is there; a strip that could not be written is tried again with it.
        std::fs::remove_dir_all(folder.path().join("strips")).expect("removed");
        assert_eq!(take(pair_of(4, 40, false), true), (2, false));
        std::fs::create_dir(folder.path().join("strips")).expect("a folder");
        assert_eq!((take(pair_of(4, 40, true), false), gray(4)), ((0, false), Some(40)));
    }

    #[test]
    fn the_strip_of_a_picture_that_was_not_finished_says_so_whichever_comes_first() {
        for (order, complete) in [([1, 2], false), ([2, 1], false), ([1, 2], true), ([2, 1], true)] {
            let (folder, mut collector) = begun();
            for number in order {
                let mut pair = pair_of(number, 10 * number as u8, complete);
                if number == 2 {
                    Arc::make_mut(&mut Arc::make_mut(&mut pair.posed).frame).completes = Some(1);
                }
                assert_eq!(collector.take(pair), Vec::<String>::new());
            }
            assert_eq!(order.map(|number| collector.write_waiting(number)), [None, None]);
            let torn = &collector.rows[&1];
            assert_eq!(torn.status, PairStatus::Refused);
            assert!(torn.status_line().contains("frame 2 is the whole picture"), "{torn:?}");
            let expected = [restated(gray_strip(10), "a", torn.standing(), &torn.status_line()), gray_strip(20)];
            let found = [1, 2].map(|number| read_png_rgb(&folder.path().join(strip_name(number))).expect("a strip"));
            assert!(found == expected && expected[0] != gray_strip(10), "{order:?}, complete: {complete}");
        }
    }

    /// All pairs written whole for each that comes are bytes by the square of their number.
    #[test]
    fn what_is_written_of_all_pairs_is_bounded_in_time() {
        const PAIR_BYTES: u64 = 45_000;
        assert_eq!(between_pairs_ms(10 * PAIR_BYTES), PAIRS_MS, "a short session's pairs are there at once");
        // Ten hours with a frame every five seconds, each written twice.
        let (frames, hours_ms) = (7200, 36e6);
        let written = |between_ms: &dyn Fn(u64) -> f64| {
            let (mut bytes, mut at_ms) = (0u64, 0.0);
            while at_ms < hours_ms {
                let all = PAIR_BYTES * (f64::from(frames) * at_ms / hours_ms) as u64;
                bytes += all;
                at_ms += between_ms(all).max(2500.0);
            }
            bytes
        };
        assert!(written(&between_pairs_ms) as f64 <= 1.05 * PAIRS_BYTES_PER_MS * hours_ms);
        assert!(written(&|_| PAIRS_MS) as f64 > 10.0 * PAIRS_BYTES_PER_MS * hours_ms, "the control");
    }
}

//! Frames exported after a session, tied to the exposures that its log recorded. The log is read, never written.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::file::Setup;
use super::log::SETUP_TOPIC;
use super::pictures::{PictureDigest, Pictures};
use super::records::{RESTART_TOPIC, SEEN_TOPIC, SeenRecord};
use super::studies::Studies;
use crate::acquire::{Fault, Frame, files_below, read_frames};
use crate::record::{FrameAssembler, LogReader, RecordError, topic};
use crate::reporter::Reporter;
use crate::telemetry::{DeviceKind, Event, Link};
use crate::timeline::{Binder, Binding, BindingFlag, ConsoleClock, ConsoleZone, ExposureInterval, FrameEvidence, Timeline};

/// Why nothing could be attached.
#[derive(Debug, thiserror::Error)]
pub enum AttachError {
    /// The log.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A frame's folder cannot be listed.
    #[error("{path}: {source}", path = path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The log has no telemetry of the C-arm.
    #[error("{path}: the log holds no bytes of the C-arm, so there is no exposure to tie a frame to", path = path.display())]
    NoTelemetry {
        /// The log.
        path: PathBuf,
    },
    /// The log is one of several sessions.
    #[error(
        "{path}: was joined of several logs (`sidecarm log merge`), and exposures of two of them may have the same number: attach the frames \
         to each of those logs by itself",
        path = path.display()
    )]
    Joined {
        /// The log.
        path: PathBuf,
    },
    /// Nothing to attach.
    #[error("no frames were found in what was named: name image files or a folder that holds some")]
    NoFrames,
}

/// An attached frame.
#[derive(Clone, Debug, Serialize)]
pub struct Attached {
    /// Its label.
    pub label: String,
    /// SHA-256 of its file.
    pub sha256: String,
    /// Index and count of the image within its file.
    pub image_of_file: [u32; 2],
    /// Which exposure, with times, joints and evidence.
    pub binding: Binding,
}

/// What came of it.
#[derive(Clone, Debug, Serialize)]
pub struct AttachReport {
    /// Exposures in the log.
    pub exposures: usize,
    /// Frames that the log itself holds.
    pub frames_in_log: usize,
    /// The console's clock as all frames together show it.
    pub console: Option<ConsoleClock>,
    /// The time zone that the frames state, minutes east of UTC; it is in `console` as well.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub console_zone_min: Option<i32>,
    /// The named frames, in the order in which they were named (folders by path, with those below them).
    pub frames: Vec<Attached>,
    /// Frames without an exposure that are certainly of another study than the session's: none of that study has one, each exposure has its frame,
    /// and the C-arm was heard from the first to the last.
    pub of_another_study: usize,
    /// Exposures of which neither the log nor what was named has a frame.
    pub exposures_without_frame: Vec<String>,
    /// Files that could not be read, and what the log had lost.
    pub losses: Vec<String>,
}

impl AttachReport {
    /// Frames with an exposure.
    #[must_use]
    pub fn bound(&self) -> usize {
        self.frames.iter().filter(|frame| frame.binding.exposure.is_some()).count()
    }
}

/// Reads the log through decoder and timeline, the frames through `acquire`, and ties the whole batch at once.
///
/// # Errors
/// When the log is none or holds no C-arm, or no frame is found. A single unreadable file is a loss in the report.
pub fn attach(log: &Path, named: &[PathBuf], reporter: &Reporter) -> Result<AttachReport, AttachError> {
    let mut session = Recorded::default();
    session.read(log)?;
    if session.carm_bytes == 0 {
        return Err(AttachError::NoTelemetry { path: log.to_owned() });
    }
    let (files, unlisted) = files(named)?;
    session.losses.extend(unlisted);
    let progress = reporter.progress("reading frames", files.len() as u64);
    let mut read: Vec<(u32, Frame, [u32; 2], String)> = Vec::new();
    for (place, file) in files.iter().enumerate() {
        match read_frames(file, None) {
            Ok(frames) => {
                for frame in frames {
                    let image_of_file = image_of(&frame);
                    // A picture that the log holds may come again in another file, and in other grey values; what it says of its
                    // exposure counts first.
                    let content = match frame.tags.names_exposure() {
                        true => frame.sha256.clone(),
                        false => session.pictures.first_of(&frame, PictureDigest::of(&frame)),
                    };
                    read.push((session.next_frame(), without_pixels(frame), image_of_file, content));
                }
            }
            // A folder holds other things beside frames; what looks like one and is damaged is said, without its name.
            Err(error) => match error.fault() {
                Some(Fault::NotAnImage { .. }) => {}
                Some(fault) => session.losses.push(format!("file {} of {}: {fault}", place + 1, files.len())),
                None => session.losses.push(format!("file {} of {} could not be opened", place + 1, files.len())),
            },
        }
        progress.advance(1);
    }
    if read.is_empty() && session.losses.is_empty() {
        return Err(AttachError::NoFrames);
    }
    let mut studies = Studies::default();
    for (place, (number, frame, image_of_file, content)) in read.iter().enumerate() {
        if let Some(words) = studies.meet(place as u32 + 1, frame.tags.study.as_deref()) {
            reporter.warn("another study", words);
        }
        let said = FrameEvidence::of(*number, &frame.tags, content, *image_of_file, None);
        session.studies.meet(*number, frame.tags.study.as_deref());
        let said = session.zone.steady(&frame.tags, said);
        session.binder.note_zone(session.zone.minutes());
        session.binder.push_of(frame.tags.study.as_deref(), said);
    }
    session.timeline.finish();
    session.binder.finish(&session.timeline);
    let attached = |(number, frame, image_of_file, _): &(u32, Frame, [u32; 2], String)| Attached {
        label: frame.name.clone(),
        sha256: frame.sha256.clone(),
        image_of_file: *image_of_file,
        // When it came says nothing of a frame that was exported afterwards.
        binding: session.binding(*number).with_beam_length(&session.timeline, frame.tags.exposure_ms, i64::MAX),
    };
    let exposures = session.timeline.exposures();
    let shown: BTreeSet<u64> = (1..=session.taken).filter_map(|number| Some(session.binding(number).exposure?.index)).collect();
    let without: Vec<String> =
        exposures.iter().filter(|exposure| !shown.contains(&exposure.index)).map(ExposureInterval::label).collect();
    let of_another_study = if without.is_empty() { session.strangers(&exposures).len() } else { 0 };
    Ok(AttachReport {
        exposures: exposures.len(),
        frames_in_log: session.frames_in_log as usize,
        console: session.binder.clock(),
        console_zone_min: session.zone.minutes(),
        frames: read.iter().map(attached).collect(),
        of_another_study,
        exposures_without_frame: without,
        losses: session.losses,
    })
}

fn image_of(frame: &Frame) -> [u32; 2] {
    frame.image_of_file.map(|number| u32::try_from(number).unwrap_or(u32::MAX))
}

/// A batch may hold thousands of frames; only their headers matter here.
fn without_pixels(mut frame: Frame) -> Frame {
    frame.pixels.pixels = Vec::new();
    frame
}

/// Files as named, and those in named folders and below them, by path; and what of these could not be listed, without its name.
fn files(named: &[PathBuf]) -> Result<(Vec<PathBuf>, Vec<String>), AttachError> {
    let (mut found, mut unlisted) = (Vec::new(), Vec::new());
    for path in named {
        if !path.is_dir() {
            found.push(path.clone());
            continue;
        }
        let (inside, errors) = files_below(path).map_err(|source| AttachError::Folder { path: path.clone(), source })?;
        found.extend(inside);
        unlisted.extend(errors.into_iter().map(|error| format!("a folder below what was named cannot be listed: {error}")));
    }
    Ok((found, unlisted))
}

/// A session's timeline and frames, as its log has them.
#[derive(Default)]
struct Recorded {
    timeline: Timeline,
    binder: Binder,
    frames_in_log: u32,
    taken: u32,
    carm_bytes: u64,
    /// What the log calls its frames.
    numbers: BTreeMap<u32, u32>,
    pictures: Pictures,
    zone: ConsoleZone,
    studies: Studies,
    losses: Vec<String>,
}

impl Recorded {
    fn read(&mut self, log: &Path) -> Result<(), AttachError> {
        let mut links = DeviceKind::ALL.map(Link::new);
        let mut has_setup = false;
        let mut assembler = FrameAssembler::default();
        // A frame whose pixels have not come yet, and when it arrived.
        let mut tagged: Option<(Frame, i64)> = None;
        let mut reader = LogReader::open(log)?;
        for entry in reader.by_ref() {
            let device = match &*entry.topic {
                topic::CARM_RAW => DeviceKind::Carm,
                topic::ROBOT_RAW => DeviceKind::Robot,
                topic::FRAME_TAGS => {
                    self.take_frame(tagged.take(), None);
                    // Tags that are damaged fail here.
                    let _ = assembler.push(&entry);
                    match entry.json::<Frame>() {
                        Ok(frame) => tagged = Some((frame, entry.host_us)),
                        Err(error) => self.losses.push(error.to_string()),
                    }
                    continue;
                }
                topic::FRAME_PIXELS => {
                    // Damaged pixels do not matter to what the frame says of its exposure.
                    let content = assembler.push(&entry).ok().flatten();
                    let content = content.map(|frame| self.pictures.first_of(&frame, PictureDigest::of(&frame)));
                    self.take_frame(tagged.take(), content);
                    continue;
                }
                SEEN_TOPIC => {
                    self.take_frame(tagged.take(), None);
                    match entry.json::<SeenRecord>() {
                        Ok(SeenRecord { frame, picture }) => {
                            let content = self.pictures.first_of(&frame, picture);
                            self.take_frame(Some((frame, entry.host_us)), Some(content));
                        }
                        Err(error) => self.losses.push(error.to_string()),
                    }
                    continue;
                }
                SETUP_TOPIC if !has_setup => {
                    // What is no setup says nothing of how bytes are read: they are packets.
                    if let Ok(setup) = entry.json::<Setup>() {
                        links = DeviceKind::ALL.map(|device| setup.link(device));
                        self.timeline = setup.adapters.timeline();
                        has_setup = true;
                    }
                    continue;
                }
                RESTART_TOPIC => return Err(AttachError::Joined { path: log.to_owned() }),
                _ => continue,
            };
            let raw = match entry.raw_bytes() {
                Ok(Some(raw)) => raw,
                Ok(None) => continue,
                Err(error) => {
                    self.losses.push(error.to_string());
                    continue;
                }
            };
            if device == DeviceKind::Carm {
                self.carm_bytes += raw.bytes.len() as u64;
            }
            let timeline = &mut self.timeline;
            links[device as usize].feed(entry.host_us, raw.epoch, raw.bytes, &mut |received| {
                if let Event::Sample(sample, sequenced) = received.event {
                    timeline.push_sample(device, entry.host_us, raw.epoch, sequenced, sample);
                }
            });
            self.binder.update(&self.timeline, entry.host_us);
        }
        self.take_frame(tagged, None);
        self.losses.extend(reader.losses().iter().map(|loss| format!("at byte {} of the log: {}", loss.at_byte, loss.reason)));
        Ok(())
    }

    /// Takes a frame of the log; `content` is that of the first frame that showed the same picture, where its pixels are there.
    fn take_frame(&mut self, tagged: Option<(Frame, i64)>, content: Option<String>) {
        let Some((frame, host_us)) = tagged else { return };
        let number = self.next_frame();
        self.frames_in_log += 1;
        let content = content.unwrap_or_else(|| frame.sha256.clone());
        let evidence = FrameEvidence::of(number, &frame.tags, &content, image_of(&frame), Some(host_us));
        self.numbers.insert(frame.number, number);
        self.studies.meet(number, frame.tags.study.as_deref());
        let completes = frame.completes.and_then(|before| self.numbers.get(&before).copied());
        let evidence = FrameEvidence { completes, ..self.zone.steady(&frame.tags, evidence) };
        self.binder.note_zone(self.zone.minutes());
        self.binder.push_of(frame.tags.study.as_deref(), evidence);
        if let Some(before) = self.pictures.take_copied_before(&content) {
            self.binder.was_copied_by(&before, number);
        }
        self.binder.update(&self.timeline, host_us);
    }

    /// Frames named beside the log's that are of a study of which none has one of the `exposures`; none where the C-arm may have missed some.
    fn strangers(&self, exposures: &[ExposureInterval]) -> BTreeSet<u32> {
        let (Some(first), Some(last)) = (exposures.first(), exposures.last()) else { return BTreeSet::new() };
        if self.timeline.exposure_tracker().blind_spot(first.start_us, last.end_us).is_some() {
            return BTreeSet::new();
        }
        let is_copy = |binding: &Binding| {
            let is_of_another =
                |flag: &BindingFlag| matches!(flag, BindingFlag::Duplicate { .. } | BindingFlag::Unfinished { .. });
            binding.flags.iter().any(is_of_another)
        };
        let bindings: Vec<(u32, Binding)> = (1..=self.taken).map(|number| (number, self.binding(number))).collect();
        let tied = bindings.iter().filter(|(_, binding)| binding.exposure.is_some()).map(|(number, _)| *number);
        let named = bindings.iter().filter(|(number, _)| *number > self.frames_in_log);
        let untied = named.filter(|(_, binding)| binding.exposure.is_none() && !is_copy(binding)).map(|(number, _)| *number);
        self.studies.strangers(tied, untied)
    }

    fn next_frame(&mut self) -> u32 {
        self.taken += 1;
        self.taken
    }

    /// A frame's binding; a frame that the log holds already has the binding that it has there.
    fn binding(&self, frame: u32) -> Binding {
        let own = self.binder.binding(frame).cloned().unwrap_or_default();
        let original = own.flags.iter().find_map(|flag| match flag {
            BindingFlag::Duplicate { of } if *of <= self.frames_in_log => Some(*of),
            _ => None,
        });
        match original.and_then(|of| self.binder.binding(of)) {
            Some(there) => {
                let mut binding = there.clone();
                binding.evidence.insert(0, "the log holds this very frame".to_owned());
                binding.flags.extend(own.flags);
                binding
            }
            None => own,
        }
    }
}

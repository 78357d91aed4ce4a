//! A part of a log that replays as the whole does.
//!
//! What lies within is kept as it is. Of before, all is kept that the session had learnt from: its setup and files, the bytes of the devices and
//! the ticks of the clock (their clocks, counters and exposures), the frames on which the tie of the specimen to the room rests, and of every
//! other frame what it says of its exposure and what tells copies of its picture (bindings may refer to it), without its pixels. A frame is within when it came or was taken within, and then all that was made
//! of it is kept, whenever that was; where it came late, devices and ticks are kept until it was developed.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::super::edit::{EDIT_TOPIC, NOTE_TOPIC};
use super::super::log::{CLOCK_TOPIC, DISAGREES_TOPIC, DRR_HASH_TOPIC, END_TOPIC, ORDER_TOPIC, SETUP_TOPIC};
use super::super::pictures::PictureDigest;
use super::super::records::{CUT_TOPIC, CutRecord, REDACTED_TOPIC, RESTART_TOPIC, SEEN_TOPIC, SeenRecord};
use super::LogbookError;
use super::frames::{Frames, Pixels};
use super::inventory::Reading;
use super::moment::Moment;
use super::retrace::{TieAt, retrace};
use crate::acquire::Frame;
use crate::image::refuse_overwrite;
use crate::record::{FrameAssembler, LogCopy, LogEntry, LogReader, RecordError, Tolerance, topic};
use crate::reporter::Reporter;

/// What was kept.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CutReport {
    /// The new log.
    pub path: PathBuf,
    /// Messages in it.
    pub messages: u64,
    /// Host time.
    pub from_us: i64,
    /// Host time.
    pub to_us: i64,
    /// Frames that came or were taken within.
    pub frames: Vec<u32>,
    /// Of these, the ones that came before or after.
    pub frames_from_outside: Vec<u32>,
    /// Frames kept because the tie of the specimen to the room rests on them.
    pub frames_of_the_tie: Vec<u32>,
    /// Frames of which what they say of their exposures is kept, so that others are bound as they were, and what tells copies of them.
    pub frames_without_pixels: usize,
    /// Of the devices, from before: all since the start of the log, because a replay learns their clocks, counters and exposures from them.
    pub serial_bytes_before: u64,
    /// What of the whole log could not be read.
    pub losses: Vec<String>,
}

#[derive(Deserialize)]
struct OfFrame {
    number: u32,
}

/// The whole log at a glance.
#[derive(Default)]
struct Glance {
    frames: Frames,
    start_us: i64,
    end_us: i64,
    /// Place of the last message that each frame needs to be developed: its pixels, or the order to register it.
    needed: BTreeMap<u32, u64>,
    earlier: Vec<Span>,
}

/// To what each of the logs that were joined was cut before, host time: from and to.
type Span = [i64; 2];
const UNCUT: Span = [i64::MIN, i64::MAX];

impl Glance {
    fn read(reader: &mut LogReader, tolerance: &mut Tolerance, reporter: &Reporter) -> Self {
        let mut found = Self { start_us: i64::MAX, end_us: i64::MIN, earlier: vec![UNCUT], ..Self::default() };
        let (mut reading, mut place) = (Reading::new("reading", reader, reporter), 0);
        while let Some(entry) = reader.next() {
            reading.at(reader);
            found.start_us = found.start_us.min(entry.host_us);
            found.end_us = found.end_us.max(entry.host_us);
            match &*entry.topic {
                ORDER_TOPIC => {
                    let of: Option<OfFrame> = tolerance.take(entry.json());
                    found.needed.extend(of.map(|of| (of.number, place)));
                }
                RESTART_TOPIC => found.earlier.push(UNCUT),
                CUT_TOPIC => {
                    let cut: Option<CutRecord> = tolerance.take(entry.json());
                    if let Some((cut, span)) = cut.zip(found.earlier.last_mut()) {
                        *span = [cut.from_us, cut.to_us];
                    }
                }
                _ => {
                    let number = tolerance.take(found.frames.take(&entry)).flatten();
                    if matches!(&*entry.topic, topic::FRAME_TAGS | topic::FRAME_PIXELS) {
                        found.needed.extend(number.map(|number| (number, place)));
                    }
                }
            }
            place += 1;
        }
        found
    }
}

/// Writes what lies between `from` and `to` of `log`, and what its replay needs, to `out`.
///
/// # Errors
/// When the log cannot be read, nothing lies between the two, or `out` exists or cannot be written.
pub fn cut(log: &Path, from: Moment, to: Moment, out: &Path, reporter: &Reporter) -> Result<CutReport, LogbookError> {
    refuse_overwrite(&[out], &[log])?;
    LogCopy::refuse_existing(out)?;
    let (mut reader, mut tolerance) = (LogReader::open(log)?, Tolerance::default());
    let glance = Glance::read(&mut reader, &mut tolerance, reporter);
    if glance.frames.without_numbers {
        return Err(LogbookError::WithoutNumbers { path: log.to_owned(), todo: "cut" });
    }
    let start_us = glance.start_us;
    let [from_us, to_us] = [from, to].map(|moment| moment.host_us(start_us));
    let from_us = glance.earlier.iter().map(|[from_us, _]| *from_us).min().unwrap_or(from_us).max(from_us);
    let to_us = glance.earlier.iter().map(|[_, to_us]| *to_us).max().unwrap_or(to_us).min(to_us);
    if !(from_us < to_us && from_us <= glance.end_us && to_us >= start_us) {
        let s = |us: i64| us.saturating_sub(start_us.min(glance.end_us)) as f64 * 1e-6;
        let (from_s, to_s, length_s) = (s(from_us), s(to_us), s(glance.end_us).max(0.0));
        return Err(LogbookError::NothingWithin { path: log.to_owned(), from_s, to_s, length_s });
    }
    let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let tie_at = retrace(log, folder, reporter)?.unwrap_or_default();
    let plan = CutPlan::new(&glance, [from_us, to_us], &tie_at);
    let kept = Kept { earlier: glance.earlier.into(), ..Kept::default() };
    let mut writing = Writing { plan, kept, copy: LogCopy::create(out)?, tolerance };
    for attachment in reader.attachments() {
        writing.copy.attach(attachment, start_us)?;
    }
    let mut losses: Vec<String> = reader.losses().iter().map(ToString::to_string).collect();
    let mut reader = LogReader::open(log)?;
    let mut reading = Reading::new("writing", &reader, reporter);
    let mut place = 0;
    while let Some(entry) = reader.next() {
        reading.at(&reader);
        writing.take(&reader, &entry, place)?;
        place += 1;
    }
    let Writing { plan, kept, mut copy, tolerance, .. } = writing;
    if !kept.ended && kept.has_session {
        copy.json(END_TOPIC, to_us.max(kept.last_input_us), &json!({"host_us": to_us.max(kept.last_input_us)}))?;
    }
    losses.extend(tolerance.losses());
    let summary = copy.finish()?;
    let frames_from_outside = plan.within.iter().copied().filter(|number| {
        let arrival_us = glance.frames.by_number.get(number).map(|frame| frame.arrival_us);
        arrival_us.is_some_and(|arrival_us| !(from_us..=to_us).contains(&arrival_us))
    });
    Ok(CutReport {
        path: summary.path,
        messages: summary.messages,
        from_us,
        to_us,
        frames_from_outside: frames_from_outside.collect(),
        frames: plan.within.into_iter().collect(),
        frames_of_the_tie: plan.of_the_tie.into_iter().collect(),
        frames_without_pixels: kept.without_pixels,
        serial_bytes_before: kept.serial_bytes_before,
        losses,
    })
}

/// What is kept.
struct CutPlan {
    from_us: i64,
    to_us: i64,
    within: BTreeSet<u32>,
    of_the_tie: BTreeSet<u32>,
    /// Times of the poses of both, which their pictures for the eye have.
    shown_us: BTreeSet<i64>,
    /// Place of the last message that a kept frame needs.
    last_place: Option<u64>,
}

impl CutPlan {
    fn new(glance: &Glance, [from_us, to_us]: [i64; 2], tie_at: &TieAt) -> Self {
        let is_within = |us: &i64| (from_us..=to_us).contains(us);
        let there = glance.frames.by_number.values().filter(|frame| frame.pixels == Pixels::There);
        let within = there.filter(|frame| is_within(&frame.arrival_us) || frame.times_us.iter().any(is_within));
        let within: BTreeSet<u32> = within.map(|frame| frame.number).collect();
        let of_the_tie = rested_on(&within, tie_at);
        let last_place = within.iter().filter_map(|number| glance.needed.get(number)).copied().max();
        let kept = within.iter().chain(&of_the_tie).filter_map(|number| glance.frames.by_number.get(number));
        let shown_us = kept.flat_map(|frame| frame.times_us.iter().copied()).collect();
        Self { from_us, to_us, within, of_the_tie, shown_us, last_place }
    }

    fn keeps(&self, number: u32) -> bool {
        self.within.contains(&number) || self.of_the_tie.contains(&number)
    }

    /// Whether the session needed what stood here to develop the frames that are kept.
    fn is_needed(&self, place: u64) -> bool {
        self.last_place.is_some_and(|last_place| place <= last_place)
    }
}

/// Frames besides `within` on which their tie rests, and those on which that of these rests in turn: they are posed again as well.
fn rested_on(within: &BTreeSet<u32>, tie_at: &TieAt) -> BTreeSet<u32> {
    let mut found = BTreeSet::new();
    let mut waiting: Vec<u32> = within.iter().copied().collect();
    while let Some(number) = waiting.pop() {
        let before = tie_at.get(&number).into_iter().flatten().copied();
        waiting.extend(before.filter(|number| !within.contains(number) && found.insert(*number)));
    }
    found
}

/// What has been written.
#[derive(Default)]
struct Kept {
    has_session: bool,
    ended: bool,
    /// Of the logs to come.
    earlier: VecDeque<Span>,
    last_input_us: i64,
    without_pixels: usize,
    serial_bytes_before: u64,
    assembler: FrameAssembler,
    /// Tags whose pixels come next.
    tags: Option<LogEntry>,
    /// Frame of the latest pose and of the latest DRR, whose further messages do not name it.
    posed: Option<u32>,
    rendered: Option<u32>,
}

struct Writing {
    plan: CutPlan,
    kept: Kept,
    copy: LogCopy,
    tolerance: Tolerance,
}

impl Writing {
    fn take(&mut self, reader: &LogReader, entry: &LogEntry, place: u64) -> Result<(), RecordError> {
        let is_within = (self.plan.from_us..=self.plan.to_us).contains(&entry.host_us);
        let keeps = match &*entry.topic {
            topic::PROVENANCE | REDACTED_TOPIC => true,
            SETUP_TOPIC => {
                self.kept.has_session = true;
                true
            }
            CUT_TOPIC => false,
            RESTART_TOPIC => {
                let keeps = self.is_input(entry, place);
                self.kept.ended &= !keeps;
                keeps
            }
            END_TOPIC => {
                let keeps = self.is_input(entry, place);
                self.kept.ended |= keeps;
                keeps
            }
            topic::CARM_RAW | topic::ROBOT_RAW | CLOCK_TOPIC => {
                let keeps = self.is_input(entry, place);
                if keeps {
                    self.kept.last_input_us = self.kept.last_input_us.max(entry.host_us);
                }
                if keeps && entry.host_us < self.plan.from_us {
                    let raw = self.tolerance.take(entry.raw_bytes()).flatten();
                    self.kept.serial_bytes_before += raw.map_or(0, |raw| raw.bytes.len() as u64);
                }
                keeps
            }
            topic::FRAME_TAGS | topic::FRAME_PIXELS => return self.frame(reader, entry, place),
            SEEN_TOPIC => {
                let keeps = self.plan.is_needed(place) || is_within;
                self.kept.without_pixels += usize::from(keeps);
                keeps
            }
            ORDER_TOPIC | EDIT_TOPIC | NOTE_TOPIC | DISAGREES_TOPIC | topic::PLAN | DRR_HASH_TOPIC | topic::SCORES => {
                self.names_kept(entry).is_some()
            }
            topic::POSE => {
                self.kept.posed = self.names_kept(entry);
                self.kept.posed.is_some()
            }
            topic::CALIBRATION | topic::TRANSFORMS | topic::ANNOTATIONS => self.kept.posed.is_some(),
            // Made beside the poses, and known by the time of its frame alone.
            topic::SHOWN => self.plan.shown_us.contains(&entry.host_us),
            topic::EVENTS => self.event(entry, is_within),
            topic::DRR => self.kept.rendered.take().is_some_and(|number| self.plan.keeps(number)),
            _ => is_within,
        };
        if keeps {
            self.copy.message(reader, entry)?;
        }
        // At the start, and where another log was joined on.
        let begins = place == 0 || keeps && &*entry.topic == RESTART_TOPIC;
        match begins.then(|| self.kept.earlier.pop_front()).flatten() {
            Some(earlier) => self.say_cut(entry.host_us, earlier),
            None => Ok(()),
        }
    }

    /// Says to what the log that begins is cut.
    fn say_cut(&mut self, host_us: i64, [from_us, to_us]: Span) -> Result<(), RecordError> {
        let CutPlan { within, of_the_tie, .. } = &self.plan;
        let record = CutRecord {
            from_us: self.plan.from_us.max(from_us),
            to_us: self.plan.to_us.min(to_us),
            frames: within.iter().copied().collect(),
            frames_of_the_tie: of_the_tie.iter().copied().collect(),
        };
        self.copy.json(CUT_TOPIC, host_us, &record)
    }

    fn is_input(&self, entry: &LogEntry, place: u64) -> bool {
        entry.host_us <= self.plan.to_us || self.plan.is_needed(place)
    }

    /// The frame that a message names, if it is kept.
    fn names_kept(&mut self, entry: &LogEntry) -> Option<u32> {
        let of: OfFrame = self.tolerance.take(entry.json())?;
        Some(of.number).filter(|number| self.plan.keeps(*number))
    }

    /// What was told, and the word that announces the DRR of a frame.
    fn event(&mut self, entry: &LogEntry, is_within: bool) -> bool {
        let text = self.tolerance.take(entry.event()).flatten().unwrap_or_default();
        match drr_of(&text) {
            Some(number) => {
                self.kept.rendered = Some(number);
                self.plan.keeps(number)
            }
            None => is_within,
        }
    }

    /// Tags and pixels of a frame that is kept; of another one that the session had met before, that it came.
    fn frame(&mut self, reader: &LogReader, entry: &LogEntry, place: u64) -> Result<(), RecordError> {
        let is_tags = &*entry.topic == topic::FRAME_TAGS;
        if is_tags {
            self.kept.tags = Some(entry.clone());
        }
        let Some(tags) = self.kept.tags.take_if(|_| !is_tags) else {
            // Damaged tags are said where their pixels are.
            self.tolerance.take(self.kept.assembler.push(entry));
            return Ok(());
        };
        let Some(frame) = self.tolerance.take(self.kept.assembler.push(entry)).flatten() else { return Ok(()) };
        if self.plan.keeps(frame.number) {
            self.copy.message(reader, &tags)?;
            return self.copy.message(reader, entry);
        }
        if self.plan.is_needed(place) {
            self.kept.without_pixels += 1;
            self.copy.json(SEEN_TOPIC, entry.host_us, &seen(frame))?;
        }
        Ok(())
    }
}

/// The frame without its pixels.
fn seen(frame: Frame) -> SeenRecord {
    let picture = PictureDigest::of(&frame);
    SeenRecord { frame, picture }
}

/// Of which frame an event announces the DRR, which comes next.
pub(super) fn drr_of(event: &str) -> Option<u32> {
    event.strip_prefix("DRR of frame ")?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_the_tie_bring_those_that_they_rest_on_themselves() {
        let tie_at = TieAt::from([(9, vec![6, 7]), (7, vec![6, 2]), (6, vec![1, 2]), (2, vec![1]), (5, vec![4]), (10, vec![9])]);
        let rested = |within: &[u32]| rested_on(&within.iter().copied().collect(), &tie_at).into_iter().collect::<Vec<_>>();
        assert_eq!(rested(&[9]), [1, 2, 6, 7]);
        assert_eq!(rested(&[9, 10]), [1, 2, 6, 7], "what is within is no frame besides");
        assert_eq!(rested(&[5]), [4]);
        assert!(rested(&[1, 3]).is_empty());
    }
}

//! A part of a log that replays as the whole does.
//!
//! What lies within is kept as it is. Of before, all is kept that the session had learnt from: its setup and files, the bytes of the devices and
//! the ticks of the clock (their clocks, counters and exposures), the frames on which the tie of the specimen to the room rests, and of every
//! other frame what it says of its exposure, without its pixels. A frame is within when it came or was taken within, and then all that was made
//! of it is kept, whenever that was; where it came late, devices and ticks are kept until it was developed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::super::log::{CLOCK_TOPIC, DISAGREES_TOPIC, DRR_HASH_TOPIC, END_TOPIC, ORDER_TOPIC, SETUP_TOPIC};
use super::super::pictures::PictureDigest;
use super::super::records::{CUT_TOPIC, CutRecord, REDACTED_TOPIC, RESTART_TOPIC, SEEN_TOPIC, SeenRecord};
use super::LogbookError;
use super::frames::{Frames, Pixels};
use super::inventory::Reading;
use super::retrace::{TieAt, retrace};
use crate::acquire::Frame;
use crate::image::refuse_overwrite;
use crate::record::{FrameAssembler, LogCopy, LogEntry, LogReader, RecordError, Tolerance, topic};
use crate::reporter::Reporter;
use crate::time::us_from_rfc3339;

/// When, as it is typed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Moment {
    /// Seconds from the start of the log.
    SinceStart {
        /// So many.
        s: f64,
    },
    /// Host time.
    At {
        /// Microseconds since the Unix epoch.
        host_us: i64,
    },
}

impl std::str::FromStr for Moment {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let seconds = text.parse::<f64>().ok().filter(|s| s.is_finite() && *s >= 0.0).map(|s| Self::SinceStart { s });
        seconds.or_else(|| us_from_rfc3339(text).map(|host_us| Self::At { host_us })).ok_or_else(|| {
            "expected seconds from the start of the log (12.5), or a time as 2026-11-21T10:00:00Z (RFC 3339, with its zone)"
                .to_owned()
        })
    }
}

impl Moment {
    fn host_us(self, start_us: i64) -> i64 {
        match self {
            // Saturates far outside any log.
            Self::SinceStart { s } => start_us.saturating_add((s * 1e6).round() as i64),
            Self::At { host_us } => host_us,
        }
    }
}

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
    /// Frames of which only that they came is kept.
    pub frames_without_pixels: usize,
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
    earlier_cut: Option<CutRecord>,
}

impl Glance {
    fn read(reader: &mut LogReader, tolerance: &mut Tolerance, reporter: &Reporter) -> Self {
        let mut found = Self { start_us: i64::MAX, end_us: i64::MIN, ..Self::default() };
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
                CUT_TOPIC => found.earlier_cut = tolerance.take(entry.json()),
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
    if out.symlink_metadata().is_ok() {
        return Err(RecordError::Exists { path: out.to_owned() }.into());
    }
    let (mut reader, mut tolerance) = (LogReader::open(log)?, Tolerance::default());
    let glance = Glance::read(&mut reader, &mut tolerance, reporter);
    if glance.frames.without_numbers {
        return Err(LogbookError::WithoutNumbers { path: log.to_owned(), todo: "cut" });
    }
    let start_us = glance.start_us;
    let [mut from_us, mut to_us] = [from, to].map(|moment| moment.host_us(start_us));
    if let Some(earlier) = &glance.earlier_cut {
        (from_us, to_us) = (from_us.max(earlier.from_us), to_us.min(earlier.to_us));
    }
    if !(from_us < to_us && from_us <= glance.end_us && to_us >= start_us) {
        let s = |us: i64| us.saturating_sub(start_us.min(glance.end_us)) as f64 * 1e-6;
        let (from_s, to_s, length_s) = (s(from_us), s(to_us), s(glance.end_us).max(0.0));
        return Err(LogbookError::NothingWithin { path: log.to_owned(), from_s, to_s, length_s });
    }
    let tie_at = retrace(log, reporter)?.unwrap_or_default();
    let plan = CutPlan::new(&glance, [from_us, to_us], &tie_at);
    let mut writing = Writing { plan, kept: Kept::default(), copy: LogCopy::create(out)?, tolerance, start_us };
    for attachment in reader.attachments() {
        writing.copy.attach(attachment, start_us)?;
    }
    let mut losses: Vec<String> =
        reader.losses().iter().map(|loss| format!("at byte {}: {}", loss.at_byte, loss.reason)).collect();
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
        losses,
    })
}

/// What is kept.
struct CutPlan {
    from_us: i64,
    to_us: i64,
    within: BTreeSet<u32>,
    of_the_tie: BTreeSet<u32>,
    /// Place of the last message that a kept frame needs.
    last_place: Option<u64>,
}

impl CutPlan {
    fn new(glance: &Glance, [from_us, to_us]: [i64; 2], tie_at: &TieAt) -> Self {
        let is_within = |us: &i64| (from_us..=to_us).contains(us);
        let there = glance.frames.by_number.values().filter(|frame| frame.pixels == Pixels::There);
        let within = there.filter(|frame| is_within(&frame.arrival_us) || frame.times_us.iter().any(is_within));
        let within: BTreeSet<u32> = within.map(|frame| frame.number).collect();
        let of_the_tie = within.iter().filter_map(|number| tie_at.get(number)).flatten().copied();
        let of_the_tie: BTreeSet<u32> = of_the_tie.filter(|number| !within.contains(number)).collect();
        let last_place = within.iter().filter_map(|number| glance.needed.get(number)).copied().max();
        Self { from_us, to_us, within, of_the_tie, last_place }
    }

    fn keeps(&self, number: u32) -> bool {
        self.within.contains(&number) || self.of_the_tie.contains(&number)
    }

    /// Whether the session needed what stood here to develop the frames that are kept.
    fn is_needed(&self, place: u64) -> bool {
        self.last_place.is_some_and(|last_place| place <= last_place)
    }
}

/// What has been written.
#[derive(Default)]
struct Kept {
    has_session: bool,
    ended: bool,
    cut_said: bool,
    last_input_us: i64,
    without_pixels: usize,
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
    start_us: i64,
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
                keeps
            }
            topic::FRAME_TAGS | topic::FRAME_PIXELS => return self.frame(reader, entry, place),
            SEEN_TOPIC => {
                let keeps = self.plan.is_needed(place) || is_within;
                self.kept.without_pixels += usize::from(keeps);
                keeps
            }
            ORDER_TOPIC | DISAGREES_TOPIC | topic::PLAN | DRR_HASH_TOPIC | topic::SCORES => self.names_kept(entry).is_some(),
            topic::POSE => {
                self.kept.posed = self.names_kept(entry);
                self.kept.posed.is_some()
            }
            topic::CALIBRATION | topic::TRANSFORMS | topic::ANNOTATIONS => self.kept.posed.is_some(),
            topic::EVENTS => self.event(entry, is_within),
            topic::DRR => self.kept.rendered.take().is_some_and(|number| self.plan.keeps(number)),
            _ => is_within,
        };
        if keeps {
            self.copy.message(reader, entry)?;
        }
        if !std::mem::replace(&mut self.kept.cut_said, true) {
            let (from_us, to_us) = (self.plan.from_us, self.plan.to_us);
            let (frames, frames_of_the_tie) =
                (self.plan.within.iter().copied().collect(), self.plan.of_the_tie.iter().copied().collect());
            self.copy.json(CUT_TOPIC, self.start_us, &CutRecord { from_us, to_us, frames, frames_of_the_tie })?;
        }
        Ok(())
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
pub(super) fn seen(frame: Frame) -> SeenRecord {
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
    fn a_moment_is_seconds_or_a_time_with_its_zone() {
        assert_eq!("12.5".parse(), Ok(Moment::SinceStart { s: 12.5 }));
        assert_eq!("2024-02-29T12:00:00Z".parse(), Ok(Moment::At { host_us: 1_709_208_000_000_000 }));
        for text in ["-1", "NaN", "inf", "noon", "2024-02-29T12:00:00", ""] {
            assert!(text.parse::<Moment>().is_err(), "{text}");
        }
    }
}

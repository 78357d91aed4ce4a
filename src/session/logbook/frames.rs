//! What a log says of each frame: when it came, what it is called, whether its pixels are there, and its last pose.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::super::records::{SEEN_TOPIC, SeenRecord};
use crate::acquire::Frame;
use crate::record::{LogEntry, RecordError, topic};
use crate::report::PoseSource;

/// Whether the pixels of a frame are in the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Pixels {
    /// They are.
    There,
    /// They are not, and the log says that this is on purpose.
    LeftOut,
    /// Its tags are there alone.
    Missing,
}

/// The last pose of a frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PoseTold {
    /// How often the frame was posed before.
    pub development: u32,
    /// Middle of the exposure, or arrival; host time.
    pub time_us: i64,
    /// Which pose was used.
    pub source: PoseSource,
    /// Whether the beads gave one.
    pub accepted: bool,
    /// Why not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Whether there were beads to look for.
    #[serde(skip)]
    pub tried: bool,
    /// √mean(dx² + dy²) over used beads.
    pub rms_px: Option<f64>,
    /// Place of its exposure in the session, from 0; `None` for a frame that is bound to none.
    pub exposure: Option<u64>,
    /// The C-arm's own number of it.
    pub exposure_counter: Option<u32>,
    /// What tied the two: `counter`, `time` or `none`.
    pub binding: String,
    /// Which of the logs that were joined, from 0.
    #[serde(skip)]
    pub piece: u32,
}

/// A frame of a log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameTold {
    /// Of arrival.
    pub number: u32,
    /// What people call it.
    pub label: String,
    /// Of its file.
    pub sha256: String,
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Host time.
    pub arrival_us: i64,
    /// Whether they are there.
    pub pixels: Pixels,
    /// The frame that was this image before its file was written on or anew.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub completes: Option<u32>,
    /// Its last pose; `None` where the session did not come to it.
    pub pose: Option<PoseTold>,
    /// Of each of its poses, host time.
    #[serde(skip)]
    pub times_us: Vec<i64>,
}

/// What `/pose` says, as far as it matters here.
#[derive(Deserialize)]
struct PoseLine {
    #[serde(default)]
    number: u32,
    #[serde(default)]
    development: u32,
    pose_source: PoseSource,
    #[serde(default)]
    binding: Value,
    pose: Value,
}

/// Frames by their number; takes the messages of a log in order.
#[derive(Debug, Default)]
pub(super) struct Frames {
    pub(super) by_number: BTreeMap<u32, FrameTold>,
    /// Tags whose pixels come next.
    waiting: Option<u32>,
    /// The log is of a version that gave no numbers.
    pub(super) without_numbers: bool,
    /// Logs joined on before.
    pub(super) piece: u32,
}

impl Frames {
    /// The number of the frame that a message speaks of, where it speaks of one.
    ///
    /// # Errors
    /// When the message is not what its topic promises.
    pub(super) fn take(&mut self, entry: &LogEntry) -> Result<Option<u32>, RecordError> {
        match &*entry.topic {
            topic::FRAME_TAGS => Ok(Some(self.tags(entry.json()?, entry.host_us, Pixels::Missing))),
            SEEN_TOPIC => Ok(Some(self.tags(entry.json::<SeenRecord>()?.frame, entry.host_us, Pixels::LeftOut))),
            topic::FRAME_PIXELS => {
                let number = self.waiting.take();
                if let Some(frame) = number.and_then(|number| self.by_number.get_mut(&number)) {
                    frame.pixels = Pixels::There;
                }
                Ok(number)
            }
            topic::POSE => {
                let line: PoseLine = entry.json()?;
                let number = line.number;
                self.pose(entry.host_us, line);
                Ok(Some(number))
            }
            _ => Ok(None),
        }
    }

    fn tags(&mut self, frame: Frame, arrival_us: i64, pixels: Pixels) -> u32 {
        // Logs without numbers count by order.
        let number = if frame.number > 0 { frame.number } else { self.by_number.len() as u32 + 1 };
        self.without_numbers |= frame.number == 0;
        let Frame { name: label, sha256, size_px, completes, .. } = frame;
        let told = FrameTold { number, label, sha256, size_px, arrival_us, pixels, completes, pose: None, times_us: Vec::new() };
        self.by_number.insert(number, told);
        self.waiting = (pixels == Pixels::Missing).then_some(number);
        number
    }

    fn pose(&mut self, time_us: i64, line: PoseLine) {
        let PoseLine { number, development, pose_source: source, binding, pose } = line;
        let piece = self.piece;
        let Some(frame) = self.by_number.get_mut(&number) else { return };
        frame.times_us.push(time_us);
        if frame.pose.as_ref().is_some_and(|known| known.development > development) {
            return;
        }
        let exposure = &binding["exposure"];
        frame.pose = Some(PoseTold {
            development,
            time_us,
            source,
            accepted: pose["status"] == "accepted",
            reason: pose["reason"].as_str().map(str::to_owned),
            tried: pose["refusal"]["code"] != "layout",
            rms_px: pose["rms_px"].as_f64(),
            exposure: exposure["index"].as_u64(),
            exposure_counter: exposure["counter"].as_u64().and_then(|counter| u32::try_from(counter).ok()),
            binding: binding["how"].as_str().unwrap_or("none").to_owned(),
            piece,
        });
    }
}

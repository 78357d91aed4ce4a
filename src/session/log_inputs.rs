//! From the messages of a log to the inputs of its session.
//!
//! A replay meets a session here, at the engine, and not at its sources of bytes and frames: when a port was opened, how bytes were cut, which of two
//! lines came first and when a frame was seen is what sources decide, and what the log keeps. Sources that played it would decide it anew.

use std::sync::Arc;

use super::edit::{EDIT_TOPIC, EditRecord, NOTE_TOPIC, NoteRecord};
use super::input::Input;
use super::log::{CLOCK_TOPIC, DISAGREES_TOPIC, ORDER_TOPIC};
use super::records::{SEEN_TOPIC, SeenRecord};
use crate::acquire::Frame;
use crate::record::{FrameAssembler, LogEntry, Tolerance, topic};
use crate::telemetry::DeviceKind;

/// Takes messages in order.
#[derive(Default)]
pub(super) struct LogInputs {
    assembler: FrameAssembler,
    numbered: u32,
    pub(super) tolerance: Tolerance,
}

impl LogInputs {
    /// What the session took in with this message, if it did.
    pub(super) fn of(&mut self, entry: &LogEntry) -> Option<Input> {
        #[derive(serde::Deserialize)]
        struct Numbered {
            number: u32,
        }
        let device = match &*entry.topic {
            topic::CARM_RAW => DeviceKind::Carm,
            topic::ROBOT_RAW => DeviceKind::Robot,
            topic::FRAME_TAGS | topic::FRAME_PIXELS => {
                return self.frame(entry).map(|frame| Input::Frame { frame, host_us: entry.host_us });
            }
            SEEN_TOPIC => {
                let SeenRecord { frame, picture } = self.tolerance.take(entry.json())?;
                self.numbered = frame.number.max(self.numbered);
                return Some(Input::Seen { frame: Box::new(frame), picture, host_us: entry.host_us });
            }
            CLOCK_TOPIC => return Some(Input::Tick { host_us: entry.host_us }),
            ORDER_TOPIC => {
                let Numbered { number } = self.tolerance.take(entry.json())?;
                return Some(Input::Develop { number });
            }
            EDIT_TOPIC => {
                let EditRecord { number, host_us, edit } = self.tolerance.take(entry.json())?;
                return Some(Input::Edit { number, edit, host_us });
            }
            NOTE_TOPIC => {
                let NoteRecord { number, host_us, words } = self.tolerance.take(entry.json())?;
                return Some(Input::Note { number, words, host_us });
            }
            DISAGREES_TOPIC => {
                let Numbered { number } = self.tolerance.take(entry.json())?;
                return Some(Input::ImageDisagrees { number });
            }
            _ => return None,
        };
        let raw = self.tolerance.take(entry.raw_bytes())??;
        Some(Input::Bytes { device, epoch: raw.epoch, host_us: entry.host_us, bytes: raw.bytes.to_vec() })
    }

    /// The frame that is whole with this message, if one is, with its number.
    pub(super) fn frame(&mut self, entry: &LogEntry) -> Option<Arc<Frame>> {
        let frame = self.tolerance.take(self.assembler.push(entry))??;
        // Logs without numbers count by order.
        self.numbered = if frame.number > 0 { frame.number } else { self.numbered + 1 };
        Some(Arc::new(Frame { number: self.numbered, ..frame }))
    }
}

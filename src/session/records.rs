//! What stands in a log that was made of another one: cut, joined, or redacted. A replay goes by it.

use serde::{Deserialize, Serialize};

use super::pictures::PictureDigest;
use crate::acquire::Frame;

/// Frames whose pixels were left out of the log: [`SeenRecord`].
pub(super) const SEEN_TOPIC: &str = "/frames/seen";
/// The log was cut: [`CutRecord`].
pub(super) const CUT_TOPIC: &str = "/session/cut";
/// Here another log of the same session was joined on: [`RestartRecord`].
pub(super) const RESTART_TOPIC: &str = "/session/restart";
/// The log was redacted: [`RedactedRecord`].
pub(super) const REDACTED_TOPIC: &str = "/session/redacted";

/// A frame without its pixels: it counts where frames are tied to exposures, and nowhere else.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct SeenRecord {
    pub(super) frame: Frame,
    pub(super) picture: Option<PictureDigest>,
}

/// What was cut out of which log, host time. Devices and clock ticks of before, and frames on which later ones rest, are there as well.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct CutRecord {
    pub(super) from_us: i64,
    pub(super) to_us: i64,
    /// Frames that came or were taken in between.
    pub(super) frames: Vec<u32>,
    /// Frames of before or after that are kept because the tie of the specimen to the room rests on them.
    pub(super) frames_of_the_tie: Vec<u32>,
}

/// Where the next log of a session begins: all that the session had learnt it had to learn again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct RestartRecord {
    /// What was added to the numbers of its frames.
    pub(super) numbers_from: u32,
}

/// What was taken out of a log before it was given away.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct RedactedRecord {
    pub(super) names: usize,
    pub(super) events: usize,
    pub(super) serial_numbers: usize,
    pub(super) pixels: usize,
}

//! Counters of a device's link.

use serde::{Deserialize, Serialize};

/// What became of the bytes of one device, since the program started. Every frame that did not become a sample is in one of these.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Health {
    /// Bytes taken.
    pub bytes: u64,
    /// Frames, or lines of text, decoded into samples.
    pub frames: u64,
    /// Frames whose checksum or stuffing was wrong; lines that are not as declared.
    pub corrupt: u64,
    /// Sequence numbers that never came while the port was open.
    pub lost: u64,
    /// Sequence numbers that passed while the port was closed (unplugged).
    pub missed_unplugged: u64,
    /// Frames that came twice; the second is dropped.
    pub duplicate: u64,
    /// Frames that came after later ones; they are used.
    pub reordered: u64,
    /// Intact frames of the other device: the ports are swapped.
    pub wrong_device: u64,
    /// Intact frames with a message id that is not known.
    pub unknown_message: u64,
    /// Intact frames of another protocol version.
    pub version_mismatch: u64,
    /// Frames whose checksum is right for another schema: other firmware.
    pub schema_mismatch: u64,
    /// Intact frames whose content is impossible (length, enumeration).
    pub malformed: u64,
    /// Runs of bytes without a delimiter longer than any frame or line.
    pub overlong: u64,
    /// Frames or lines cut by opening the port in the middle of them; no fault of the line.
    pub partial_at_open: u64,
    /// Restarts of the device: its sequence began anew.
    pub resets: u64,
    /// Silences longer than the limit for stale data.
    pub stale: u64,
    /// Openings of the port.
    pub epochs: u64,
}

impl Health {
    /// Frames and stretches of bytes that were lost, for whatever reason.
    #[must_use]
    pub fn lost_in_all(&self) -> u64 {
        let lost = [
            self.lost,
            self.missed_unplugged,
            self.corrupt,
            self.wrong_device,
            self.unknown_message,
            self.version_mismatch,
            self.schema_mismatch,
            self.malformed,
            self.overlong,
        ];
        lost.iter().sum()
    }

    /// What went wrong, and how often: every counter of that kind that is not zero.
    pub fn faults(&self) -> impl Iterator<Item = (u64, &'static str)> + use<> {
        let faults = [
            (self.corrupt, "corrupt"),
            (self.lost, "lost"),
            (self.missed_unplugged, "missed while unplugged"),
            (self.duplicate, "duplicate"),
            (self.reordered, "reordered"),
            (self.wrong_device, "of the other device"),
            (self.unknown_message, "of unknown kind"),
            (self.version_mismatch, "of another protocol version"),
            (self.schema_mismatch, "of another schema"),
            (self.malformed, "malformed"),
            (self.overlong, "overlong"),
            (self.resets, "device resets"),
            (self.stale, "stale silences"),
        ];
        faults.into_iter().filter(|(count, _)| *count > 0)
    }
}

impl std::fmt::Display for Health {
    /// The frames, then every fault.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} frames", self.frames)?;
        self.faults().try_for_each(|(count, words)| write!(f, ", {count} {words}"))
    }
}

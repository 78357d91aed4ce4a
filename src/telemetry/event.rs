//! What a decoder finds in the bytes of a device, whatever they are.

use serde::Serialize;

use super::device::DeviceKind;
use super::line_fault::LineFault;
use super::sample::Sample;
use super::sequence::Sequenced;
use super::wire::FrameFault;

/// What the decoder found.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// An intact frame or line, and how its sequence number follows. This is the only verdict on sequence and restart: whoever keeps samples
    /// goes by it. Never [`Sequenced::Duplicate`], whose samples are not delivered.
    Sample(Sample, Sequenced),
    /// Something else; decoding goes on after the next delimiter.
    Fault(DecodeFault),
}

/// What was wrong; counted in [`super::Health`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, thiserror::Error)]
#[serde(rename_all = "snake_case", tag = "fault")]
pub enum DecodeFault {
    /// The frame is damaged or of no known form.
    #[error(transparent)]
    Frame(FrameFault),
    /// The line is damaged, or not as it was declared.
    #[error(transparent)]
    Line(LineFault),
    /// More bytes without a delimiter than any frame or line has.
    #[error("no delimiter in {limit} bytes: the line carries something else, or at another speed")]
    Overlong {
        /// Longest frame or line.
        limit: usize,
    },
    /// Sequence numbers are missing before the sample that follows: lost, unless a [`DecodeFault::Reordered`] tells of them.
    #[error("packets missing: {count}, lost unless they come late")]
    Lost {
        /// How many.
        count: u32,
        /// Whether the port was closed meanwhile.
        while_closed: bool,
    },
    /// The packet was here before; its sample is not delivered again.
    #[error("packet {sequence} came twice")]
    Duplicate {
        /// Its number.
        sequence: u32,
    },
    /// The packet comes after later ones and is not lost; its sample follows.
    #[error("packet {sequence} came late")]
    Reordered {
        /// Its number.
        sequence: u32,
    },
    /// The device's count began anew; the first sample of it follows.
    #[error("the device restarted: its sequence is at {sequence}")]
    Reset {
        /// The new number.
        sequence: u32,
    },
    /// The frame is of the other device: the ports are swapped.
    #[error("a message of the {found} on the port of the {expected}")]
    WrongDevice {
        /// Whose port this is.
        expected: DeviceKind,
        /// Whose message it is.
        found: DeviceKind,
    },
}

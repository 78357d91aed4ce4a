//! Bytes from the devices to samples.
//!
//! [`spawn_port`] reads a serial port and reports bytes with their arrival; a [`Link`] decodes them, whether they come from a port, a
//! log or a script. The wire is specified in `mocks/PROTOCOL.md`. Nothing here can write to a device.

mod decoder;
mod device;
mod health;
mod link;
mod port;
mod sample;
mod sequence;
mod status;
mod wire;

pub use decoder::{DecodeFault, Decoder, Event};
pub use device::{DEFAULT_BAUD, DeviceKind, PortConfig};
pub use health::Health;
pub use link::{ByteSource, Link, Received, STALE_SILENCE_US};
pub use port::{FIRST_BACKOFF, LONGEST_BACKOFF, PortError, PortEvent, PortTask, hint, spawn_port};
pub use sample::{AngleSource, CarmSample, Limit, Metadata, RobotSample, Sample, Tendon};
pub use sequence::{SequenceTracker, Sequenced};
pub use status::status_words;
pub use wire::{FrameFault, MAX_ENCODED_BYTES, SCHEMA_HASH, Telling, VERSION, blanked};

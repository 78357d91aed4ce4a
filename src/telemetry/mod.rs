//! Bytes from the devices to samples.
//!
//! [`spawn_port`] reads a serial port, datagrams or a growing file and reports bytes with their arrival, [`spawn_source`] any other
//! [`ByteSource`]; a [`Link`] decodes them, whether they come from a port, a log or a script. What they are is specified in
//! `mocks/PROTOCOL.md` (packets), or declared for a device that sends lines of text ([`LineAdapter`]). Nothing here can write to a device.

mod address;
mod blank_packet;
mod byte_source;
mod counting;
mod decoder;
mod device;
mod event;
mod health;
mod line_fault;
pub mod lines;
mod link;
mod outlet;
mod packet;
mod port;
mod port_error;
mod sample;
mod script;
mod sequence;
mod serial;
mod status;
mod tail;
mod udp;
mod wire;

pub use address::{AddressError, PortAddress, PortConfig};
pub use blank_packet::{Telling, blanked};
pub use byte_source::{ByteSource, Closing, Heard};
pub use decoder::Decoder;
pub use device::{DEFAULT_BAUD, DeviceKind};
pub use event::{DecodeFault, Event};
pub use health::Health;
pub use line_fault::LineFault;
pub use lines::{LineAdapter, NO_EXPOSURES};
pub use link::{Link, Received, STALE_SILENCE_US};
pub use outlet::PortEvent;
pub use packet::{carm_packet, robot_packet};
pub use port::{FIRST_BACKOFF, LONGEST_BACKOFF, PortTask, spawn_port, spawn_source};
pub use port_error::{PortError, hint};
pub use sample::{AngleSource, CarmSample, Limit, Metadata, RobotSample, Sample, Tendon};
pub use script::Script;
pub use sequence::{SequenceTracker, Sequenced};
pub use status::status_words;
pub use wire::{FrameFault, MAX_ENCODED_BYTES, SCHEMA_HASH, VERSION};

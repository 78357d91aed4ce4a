//! What is done with a log after its session: told, checked, cut, joined, put into tables, redacted. Logs are read, never written over.
//!
//! A log that is made of another keeps its messages as they are, byte for byte, unless its purpose is to change them, and says in a message of
//! its own what was done to it ([`super::replay`] goes by that).

mod cut;
mod error;
mod frame_tables;
mod frames;
mod inventory;
mod lines;
mod merge;
mod moment;
mod names;
mod redact;
mod renumber;
mod retrace;
mod serial_numbers;
mod sheet;
mod tables;
mod verify;
mod video;

pub use cut::{CutReport, cut};
pub use error::LogbookError;
pub use frames::{FrameTold, Pixels, PoseTold};
pub use inventory::{DeviceTold, Inventory, TopicTold, take_inventory};
pub use merge::{MergeReport, merge};
pub use moment::Moment;
pub use redact::{RedactOptions, RedactReport, redact};
pub use tables::{TablesReport, write_tables};
pub use verify::{Fault, Verdict, verify};
pub use video::{Pace, VideoReport, write_video};

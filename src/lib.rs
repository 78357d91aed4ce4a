//! Sidecarm: rides beside a mobile C-arm and a snake robot, recovers the pose of each radiograph from beads, renders the matched
//! DeepDRR and lays it beside the acquired frame, with numbers.
//!
//! Data flows down this list; a module uses only modules above it (`tests/architecture.rs`).

pub mod units;
pub mod time;
pub mod random;
pub mod memory;
pub mod regular;
pub mod json;
pub mod spelling;
pub mod table;
pub mod image;
pub mod reporter;
pub mod foreign;

pub mod geometry;
pub mod estimate;
pub mod gpu;
pub mod telemetry;
pub mod acquire;
pub mod mask;
pub mod timeline;
pub mod beads;
pub mod pose;
#[cfg(feature = "learn")]
pub mod infer;
pub mod scene;
pub mod render;
pub mod transport;
pub mod compare;
#[cfg(feature = "learn")]
pub mod learn;
pub mod record;
pub mod calibrate;
pub mod report;
pub mod igtl;
pub mod session;
#[cfg(feature = "viewer")]
pub mod viewer;
pub mod cli;

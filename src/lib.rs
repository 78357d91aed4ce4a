//! Sidecarm: rides beside a mobile C-arm and a snake robot, recovers the pose of each radiograph from beads, renders the matched
//! DeepDRR and lays it beside the acquired frame, with numbers.
//!
//! Data flows down this list; a module uses only modules above it (`tests/architecture.rs`).

pub mod units;
pub mod time;
pub mod random;
pub mod image;
pub mod reporter;

pub mod geometry;

pub mod gpu;

pub mod scene;

pub mod render;

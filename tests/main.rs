//! The integration tests: one binary.

mod acquire_frames;
mod acquire_info;
mod acquire_watch;
mod architecture;
mod telemetry_frames;
mod telemetry_port;
mod telemetry_wire;
mod timeline_clock;
mod record_log;

//! The integration tests: one binary.

mod acquire_frames;
mod acquire_info;
mod acquire_watch;
mod architecture;
mod record_log;

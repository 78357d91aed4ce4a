//! The integration tests: one binary.

mod architecture;
mod timeline_clock;

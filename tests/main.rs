//! The integration tests: one binary.

mod architecture;
mod telemetry_devices;
mod telemetry_frames;
mod telemetry_port;
mod telemetry_wire;
mod timeline_binding;
mod timeline_clock;
mod timeline_joints;

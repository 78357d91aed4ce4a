//! The integration tests: one binary.

mod acquire_frames;
mod acquire_info;
mod acquire_watch;
mod architecture;
mod telemetry_devices;
mod telemetry_frames;
mod telemetry_port;
mod telemetry_wire;
mod timeline_binding;
mod timeline_clock;
mod record_log;
mod beads_detection;
mod beads_layout;
mod pose_registration;
mod pose_synthetic;
mod timeline_joints;
mod compare_command;
mod compare_synthetic;
mod report_files;
mod viewer_window;

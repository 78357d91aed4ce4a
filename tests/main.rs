//! The integration tests: one binary.

mod architecture;
mod beads_detection;
mod beads_layout;
mod pose_registration;
mod pose_synthetic;

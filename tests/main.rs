//! The integration tests: one binary.

mod architecture;
mod beads_detection;
mod pose_registration;
mod pose_synthetic;

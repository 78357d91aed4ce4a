//! The integration tests: one binary.

mod architecture;
mod compare_synthetic;
mod report_files;

//! Commands: what was typed and what it means.

pub mod devices;
pub mod info;

/// Runs the program.
#[must_use]
pub fn main() -> std::process::ExitCode {
    std::process::ExitCode::SUCCESS
}

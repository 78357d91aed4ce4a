//! Commands: what was typed and what it means.

pub mod devices;
pub mod info;
pub mod register;

/// Runs the program.
#[must_use]
pub fn main() -> std::process::ExitCode {
    std::process::ExitCode::SUCCESS
}

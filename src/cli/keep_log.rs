//! `sidecarm keep-log`: the process that writes the log of another one (see [`crate::record::keep`]). Not for people.

use std::path::PathBuf;

/// Writes what a recording process hands over, to the end, whatever becomes of that process.
#[derive(Debug, clap::Args)]
#[command(hide = true)]
pub struct KeepLogArgs {
    /// The log, which is open as standard output.
    pub path: PathBuf,
    /// Bytes of it that are written already.
    pub at: u64,
}

/// Keeps the log; says nothing in words, because standard error belongs to the recording process.
#[must_use]
pub fn run(args: &KeepLogArgs) -> u8 {
    u8::from(crate::record::keep(&args.path, args.at).is_err())
}

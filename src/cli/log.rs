//! `sidecarm log`: what is in a log, whether it is whole, and logs, tables and gifts made of it.

mod csv;
mod cut;
mod info;
mod merge;
mod outcome;
mod redact;
mod verify;
mod video;

use clap::Subcommand;

use crate::reporter::Reporter;
use crate::session::logbook::LogbookError;

/// What a log holds, whether it is whole, and other logs and tables made of it. Logs are read, never changed.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm log info run-1/session.mcap
  sidecarm log csv run-1/session.mcap --out tables")]
pub struct LogArgs {
    #[command(subcommand)]
    command: LogCommand,
}

#[derive(Debug, Subcommand)]
enum LogCommand {
    Info(info::InfoArgs),
    Verify(verify::VerifyArgs),
    Cut(cut::CutArgs),
    Merge(merge::MergeArgs),
    Csv(csv::CsvArgs),
    Redact(redact::RedactArgs),
    Video(video::VideoArgs),
}

/// Does what was asked; exit code 0, or 3 where something is lost from the log.
///
/// # Errors
/// When the log cannot be read or the result cannot be written.
pub fn run(args: &LogArgs, reporter: &Reporter) -> Result<u8, LogbookError> {
    match &args.command {
        LogCommand::Info(args) => info::run(args, reporter),
        LogCommand::Verify(args) => verify::run(args, reporter),
        LogCommand::Cut(args) => cut::run(args, reporter),
        LogCommand::Merge(args) => merge::run(args, reporter),
        LogCommand::Csv(args) => csv::run(args, reporter),
        LogCommand::Redact(args) => redact::run(args, reporter),
        LogCommand::Video(args) => video::run(args, reporter),
    }
}

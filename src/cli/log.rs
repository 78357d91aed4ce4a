//! `sidecarm log`: what is in a log, whether it is whole, and logs, tables and gifts made of it.

mod csv;
mod cut;
mod info;
mod merge;
mod redact;
mod verify;

use clap::Subcommand;

use crate::reporter::Reporter;
use crate::session::logbook::LogbookError;

/// Exit code of a complete result.
const GOOD: u8 = 0;
/// Exit code of a result from which something is lost.
const LOSS: u8 = 3;

/// What a log holds, whether it is whole, and other logs and tables made of it. Logs are read, never changed.
#[derive(Debug, clap::Args)]
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
    }
}

/// Says what is lost from the log that was read; the exit code.
fn say(losses: &[String], reporter: &Reporter) -> u8 {
    losses.iter().for_each(|loss| reporter.warn("loss", format!("lost from the log: {loss}")));
    if losses.is_empty() { GOOD } else { LOSS }
}

/// `1 frame`, `2 frames`.
fn counted(count: usize, what: &str) -> String {
    if count == 1 { format!("1 {what}") } else { format!("{count} {what}s") }
}

/// Numbers in a row, for people.
fn listed(numbers: &[u32]) -> String {
    const SHOWN: usize = 20;
    let shown = numbers.iter().take(SHOWN).map(u32::to_string).collect::<Vec<_>>().join(", ");
    if numbers.len() > SHOWN { format!("{shown}, … ({} in all)", numbers.len()) } else { shown }
}

//! `sidecarm log merge`.

use std::path::PathBuf;

use super::outcome::{counted, say};
use crate::reporter::Reporter;
use crate::session::logbook::{LogbookError, MergeReport, merge};

/// Join the logs of one session that was recorded in pieces, in order of time.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm log merge run-1/session.mcap run-1b/session.mcap --out day.mcap\n\n\
    The logs must have the same session, scene and calibrations, and follow each other. Frames of later logs are numbered on, in every message \
    that names them. A session that is started again learns clocks, exposures and the specimen's place anew, and so does the replay at the \
    seam: poses and images are those of the single logs.")]
pub struct MergeArgs {
    /// The logs, in any order.
    #[arg(required = true, num_args = 2..)]
    pub logs: Vec<PathBuf>,
    /// The new log.
    #[arg(long, value_name = "NEW.mcap")]
    pub out: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Joins and says what was joined.
///
/// # Errors
/// When a log cannot be read, they do not belong together, or the new one cannot be written.
pub fn run(args: &MergeArgs, reporter: &Reporter) -> Result<u8, LogbookError> {
    let report = merge(&args.logs, &args.out, reporter)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).unwrap_or_default());
    } else {
        tell(&report);
    }
    report.notes.iter().for_each(|note| reporter.note(format!("note: {note}")));
    Ok(say(&report.losses, reporter))
}

fn tell(report: &MergeReport) {
    println!("{}: {} messages of {}", report.path.display(), report.messages, counted(report.logs.len(), "log"));
    let mut end_us: Option<i64> = None;
    for log in &report.logs {
        let length_s = log.end_us.saturating_sub(log.start_us) as f64 * 1e-6;
        let after =
            end_us.map(|end_us| format!(", {:.3} s after the one before", log.start_us.saturating_sub(end_us) as f64 * 1e-6));
        let numbers = match (log.frames, log.numbers_from) {
            (0, _) | (_, 0) => String::new(),
            (_, from) => format!(", numbered from {} on", from + 1),
        };
        let (path, frames) = (log.path.display(), counted(log.frames, "frame"));
        println!("  {path}: {length_s:.3} s{}, {frames}{numbers}", after.unwrap_or_default());
        end_us = Some(log.end_us);
    }
}

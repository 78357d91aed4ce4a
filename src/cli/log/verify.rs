//! `sidecarm log verify`.

use std::path::PathBuf;

use super::outcome::{GOOD, LOSS, counted};
use crate::reporter::{Reporter, printable};
use crate::session::logbook::{Fault, LogbookError, Verdict, verify};

/// Check whether a log is whole: every chunk by its checksum, every message, frame and DRR by what it promises, serial bytes by their packets,
/// and whatever names a frame by that frame.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm log verify run-1/session.mcap\n\n\
    Each fault is told with its place: byte of the file, topic, seconds from the start. Packets that the session lost on its lines are told as \
    well; the log holds them as they were, so they are no fault of it (--lines lists where).\n\n\
    Exit codes: 0 whole, 1 unreadable, 3 readable with losses (said which).")]
pub struct VerifyArgs {
    /// The log.
    pub log: PathBuf,
    /// List where the lines lost something.
    #[arg(long)]
    pub lines: bool,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Prints what was found.
///
/// # Errors
/// When the log cannot be read at all.
pub fn run(args: &VerifyArgs, reporter: &Reporter) -> Result<u8, LogbookError> {
    let verdict = verify(&args.log, reporter)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&verdict).unwrap_or_default());
    } else {
        print!("{}", printable(&text(&verdict, args.lines)));
    }
    Ok(if verdict.is_whole() { GOOD } else { LOSS })
}

fn text(verdict: &Verdict, with_lines: bool) -> String {
    let place = |fault: &Fault| {
        let time = fault.time_us.map(|us| format!(", {:.3} s", us.saturating_sub(verdict.start_us) as f64 * 1e-6));
        let topic = fault.topic.as_ref().map(|topic| format!(", {topic}"));
        format!("byte {}{}{}: {}", fault.at_byte, topic.unwrap_or_default(), time.unwrap_or_default(), fault.what)
    };
    let mut lines = vec![format!(
        "{} bytes, {} messages, {}, {} poses, {} DRRs, {} packets",
        verdict.bytes,
        verdict.messages,
        counted(verdict.frames as usize, "frame"),
        verdict.poses,
        verdict.drrs,
        verdict.packets
    )];
    if verdict.frames_without_pixels > 0 {
        lines.push(format!("the pixels of {} frames were left out of this log on purpose", verdict.frames_without_pixels));
    }
    lines.extend(verdict.line_losses.iter().map(|loss| format!("lost in the session, not in the log: {loss}")));
    if with_lines {
        lines.extend(verdict.line_places.iter().map(|fault| format!("  {}", place(fault))));
    }
    lines.extend(verdict.faults.iter().map(|fault| format!("fault at {}", place(fault))));
    if verdict.more_faults > 0 {
        lines.push(format!("{} more faults", verdict.more_faults));
    }
    lines.push(match verdict.is_whole() {
        true => "whole".to_owned(),
        false => format!("{}; what else is in the log can be read", counted(verdict.faults.len(), "fault")),
    });
    lines.join("\n") + "\n"
}

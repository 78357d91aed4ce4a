//! `sidecarm log cut`.

use std::path::PathBuf;

use super::outcome::{counted, listed, say};
use crate::reporter::Reporter;
use crate::session::logbook::{LogbookError, Moment, cut};

/// Cut a part out of a log, so that it replays to the same poses.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm log cut run-1/session.mcap --from 120 --to 180 --out moved.mcap\n  \
    sidecarm log cut run-1/session.mcap --from 2026-11-21T10:00:00Z --to 2026-11-21T10:05:00Z --out moved.mcap\n\n\
    What lies within stays as it is, byte for byte. A frame is within when it came or was taken within; all that was made of it stays too. \
    Of what lies before (and after, until the last of these frames was developed) the log keeps what the poses rest on: the setup, frames on \
    which the specimen's place in the room rests, and of the other frames their tags and what tells copies of them. The devices' bytes and the \
    clock's ticks are kept from the start of the log on, however late the part begins: from them a replay learns the devices' clocks, counters \
    and exposures, and it would bind frames otherwise without them. So the part is that much larger (`serial_bytes_before`).")]
pub struct CutArgs {
    /// The log.
    pub log: PathBuf,
    /// From here on: seconds from the start of the log, or a time with its zone (RFC 3339).
    #[arg(long, value_name = "T")]
    pub from: Moment,
    /// Up to here.
    #[arg(long, value_name = "T")]
    pub to: Moment,
    /// The new log.
    #[arg(long, value_name = "NEW.mcap")]
    pub out: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Cuts and says what was kept.
///
/// # Errors
/// When the log cannot be read, nothing lies within, or the new one cannot be written.
pub fn run(args: &CutArgs, reporter: &Reporter) -> Result<u8, LogbookError> {
    let report = cut(&args.log, args.from, args.to, &args.out, reporter)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).unwrap_or_default());
        return Ok(say(&report.losses, reporter));
    }
    println!("{}: {} messages", report.path.display(), report.messages);
    match &report.frames[..] {
        [] => println!("no frame came or was taken within"),
        frames => println!("{} within: {}", counted(frames.len(), "frame"), listed(frames)),
    }
    if !report.frames_from_outside.is_empty() {
        println!("  taken within, and come before or after: {}", listed(&report.frames_from_outside));
    }
    if !report.frames_of_the_tie.is_empty() {
        println!("  kept besides, because the specimen's place in the room rests on them: {}", listed(&report.frames_of_the_tie));
    }
    if report.frames_without_pixels > 0 {
        let frames = counted(report.frames_without_pixels, "other frame");
        println!("  kept besides, without pixels: what {frames} said of exposures, because other frames are bound by it");
    }
    if report.serial_bytes_before > 0 {
        let bytes = report.serial_bytes_before;
        println!(
            "  kept besides: {bytes} bytes of the devices since the start of the log, because clocks and exposures are learnt from them"
        );
    }
    Ok(say(&report.losses, reporter))
}

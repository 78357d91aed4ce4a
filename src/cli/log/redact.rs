//! `sidecarm log redact`.

use std::path::PathBuf;

use super::outcome::{counted, say};
use crate::reporter::Reporter;
use crate::session::logbook::{LogbookError, RedactOptions, redact};

/// Make a log that can be given away: it replays to the same poses, and tells no names, paths, serial numbers or free text beyond what that needs.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm log redact run-1/session.mcap --out for-the-vendor.mcap\n\n\
    Taken out: labels of frames, names of files and ports, names of beads, bodies, landmarks and labels of a label map that may be of persons, origins \
    of calibrations, what a line adapter ignores and calls its groups and columns, told events, persons' notes, sentences about pairs, headers' tags \
    besides physics and time, serial numbers, firmware and other words in the devices' bytes, and topics that are not known here. What stays: times, \
    numbers, units, hashes of files and of names of labels (whoever guesses a name can check it), the words by which a line adapter reads its lines (a \
    pattern's own text, columns that a header names, keys of JSON, words of flags, how comments begin), and whatever is burned into the pixels \
    (--no-pixels leaves out frames and DRRs; then nothing is posed anew, and a replay says so). The CT and the tools are not in a log.")]
pub struct RedactArgs {
    /// The log.
    pub log: PathBuf,
    /// Leave out the pixels of frames and DRRs.
    #[arg(long)]
    pub no_pixels: bool,
    /// The new log.
    #[arg(long, value_name = "NEW.mcap")]
    pub out: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Redacts and says what was taken out.
///
/// # Errors
/// When the log cannot be read or the new one cannot be written.
pub fn run(args: &RedactArgs, reporter: &Reporter) -> Result<u8, LogbookError> {
    let report = redact(&args.log, RedactOptions { no_pixels: args.no_pixels }, &args.out, reporter)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).unwrap_or_default());
        return Ok(say(&report.losses, reporter));
    }
    println!("{}: {} messages", report.path.display(), report.messages);
    println!(
        "taken out: {}, {}, {}, what devices say of themselves in {}, pixels of {}",
        counted(report.names, "name"),
        counted(report.events, "event"),
        counted(report.notes, "note"),
        counted(report.serial_numbers, "packet"),
        counted(report.pixels, "frame")
    );
    for (topic, messages) in &report.unknown_topics {
        println!("  left out, because it is not known here: {topic} ({})", counted(*messages as usize, "message"));
    }
    Ok(say(&report.losses, reporter))
}

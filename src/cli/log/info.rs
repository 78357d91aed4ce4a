//! `sidecarm log info`.

use std::path::PathBuf;

use super::outcome::{GOOD, LOSS, counted};
use crate::reporter::{Reporter, printable};
use crate::session::logbook::{FrameTold, Inventory, LogbookError, Pixels, take_inventory};
use crate::time::rfc3339_from_us;

/// Say what is in a log: start and length, topics, devices, frames with their exposures and poses, and what is damaged.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm log info run-1/session.mcap\n  sidecarm log info run-1/session.mcap --json\n\n\
    Exit codes: 0 good, 1 no log, 3 readable with losses (said which). What the session lost on its lines is said and is no loss of the log.")]
pub struct InfoArgs {
    /// The log.
    pub log: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// Prints what is in the log.
///
/// # Errors
/// When it cannot be read.
pub fn run(args: &InfoArgs, reporter: &Reporter) -> Result<u8, LogbookError> {
    let inventory = take_inventory(&args.log, reporter)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&inventory).unwrap_or_default());
    } else {
        print!("{}", printable(&text(&inventory)));
    }
    let losses = inventory.losses();
    losses.iter().for_each(|loss| reporter.warn("loss", format!("{}: {loss}", args.log.display())));
    Ok(if losses.is_empty() { GOOD } else { LOSS })
}

fn text(told: &Inventory) -> String {
    let mut lines = Vec::new();
    let start_us = told.start_us.unwrap_or(0);
    let seconds = |us: i64| us.saturating_sub(start_us) as f64 * 1e-6;
    let length_s = told.end_us.map_or(0.0, seconds);
    if let Some(from) = &told.provenance {
        lines.push(format!("recorded by {} {} on {}", from.program, from.version, from.host));
    }
    lines.push(format!(
        "start {}, {length_s:.3} s from the first message to the last, {} bytes",
        rfc3339_from_us(start_us),
        told.bytes
    ));
    let end = match (told.closed, told.has_session, told.ended) {
        (false, ..) => "not closed: the program was stopped, or the file is cut",
        (true, true, false) => "closed, but the session was cut short",
        (true, true, true) => "closed; the session came to its end",
        (true, false, _) => "closed; it holds no session, so it does not replay",
    };
    lines.push(end.to_owned());
    if told.joined > 0 {
        lines.push(format!("joined of {} logs", told.joined + 1));
    }
    if let Some(cut) = &told.cut {
        let at = |key: &str| cut[key].as_i64().map_or(f64::NAN, seconds);
        lines.push(format!(
            "cut to {:.3} s … {:.3} s; the bytes of the devices from before are there",
            at("from_us"),
            at("to_us")
        ));
    }
    if told.redacted.is_some() {
        lines.push("redacted: names, serial numbers and free text were taken out".to_owned());
    }
    lines.push(format!("\n{:28} {:>9} {:>12} {:>9}  {:>9} {:>9}", "topic", "messages", "bytes", "1/s", "first s", "last s"));
    for (topic, of) in &told.topics {
        let rate = of.per_s.map(|rate| format!("{rate:.2}")).unwrap_or_default();
        let (first_s, last_s) = (seconds(of.first_us), seconds(of.last_us));
        lines.push(format!("{topic:28} {:>9} {:>12} {rate:>9}  {first_s:>9.3} {last_s:>9.3}", of.messages, of.bytes));
    }
    for (name, bytes) in &told.attachments {
        lines.push(format!("attached: {name}, {bytes} bytes"));
    }
    lines.push(String::new());
    for device in &told.devices {
        let span = device.first_us.zip(device.last_us).map(|(first, last)| (seconds(first), seconds(last)));
        let span = span.map_or("no packet".to_owned(), |(first_s, last_s)| format!("{first_s:.3} s … {last_s:.3} s"));
        let rate = device.per_s.map(|rate| format!(", {rate:.1}/s")).unwrap_or_default();
        lines.push(format!("{}: {} packets{rate}, {span}", device.device, device.packets));
    }
    for loss in &told.line_losses {
        lines.push(format!("    lost in the session: {loss}"));
    }
    let [accepted, refused, untried, none] = told.poses();
    lines.push(format!("{}, {}", counted(told.exposures, "exposure"), counted(told.frames.len(), "frame")));
    let untried = if untried > 0 { format!(", {untried} not registered") } else { String::new() };
    lines.push(format!("poses: {accepted} accepted, {refused} refused{untried}, {none} frames without one"));
    lines.extend(told.frames.iter().map(|frame| row(frame, seconds(frame.arrival_us))));
    if told.damage.is_empty() && told.malformed.is_empty() {
        lines.push("no damage found (`sidecarm log verify` looks closer)".to_owned());
    }
    lines.join("\n") + "\n"
}

fn row(frame: &FrameTold, arrival_s: f64) -> String {
    let [columns, rows] = frame.size_px;
    let pixels = match frame.pixels {
        Pixels::There => "",
        Pixels::LeftOut => ", pixels left out",
        Pixels::Missing => ", PIXELS ARE GONE",
    };
    let (exposure, pose) = match &frame.pose {
        None => ("-".to_owned(), "not posed".to_owned()),
        Some(pose) => {
            let exposure = match (pose.exposure_counter, pose.exposure) {
                (Some(counter), _) => format!("exposure {counter} by {}", pose.binding),
                (None, Some(index)) => format!("exposure #{} by {}", index + 1, pose.binding),
                (None, None) => "no exposure".to_owned(),
            };
            let words = match (pose.accepted, pose.rms_px, &pose.reason) {
                (true, Some(rms_px), _) => format!("accepted, rms {rms_px:.3} px"),
                (true, None, _) => "accepted".to_owned(),
                (false, _, reason) => {
                    let what = if pose.tried { "refused" } else { "not registered" };
                    format!("{what}, {}", reason.as_deref().unwrap_or("no reason is told"))
                }
            };
            (exposure, words)
        }
    };
    format!("  {:>4}  {:20} {columns}x{rows}{pixels}  {arrival_s:>9.3} s  {exposure:24} {pose}", frame.number, frame.label)
}

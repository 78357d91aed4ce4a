//! `sidecarm replay`: a log through the same code; says whether the same came out.

use std::path::PathBuf;

use crate::reporter::Reporter;
use crate::session::SessionError;
use crate::session::board::Board;
use crate::session::replay::{ReplayOptions, run as replay};

/// Replay a log: the same poses byte for byte, the same images.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm replay run-1/session.mcap --rate max --out replayed")]
pub struct ReplayArgs {
    /// The log.
    pub log: PathBuf,
    /// Speed: 1 as it was, 0.5 half as fast, or max.
    #[arg(long, default_value = "max", value_parser = rate)]
    pub rate: Rate,
    /// Folder with the scene file and its CT, if they are not where the session had them.
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// Folder for strips, DRRs, pairs and report; LOG.replay beside the log when absent.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// A parsed `--rate`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate(pub Option<f64>);

fn rate(text: &str) -> Result<Rate, String> {
    if text == "max" {
        return Ok(Rate(None));
    }
    match text.parse::<f64>() {
        Ok(rate) if rate > 0.0 && rate.is_finite() => Ok(Rate(Some(rate))),
        _ => Err("expected a positive number or max".to_owned()),
    }
}

/// Replays; exit code 0, or 3 when the log had lost something or something came out differently.
///
/// # Errors
/// When the log or the scene's files cannot be read.
pub fn run(args: &ReplayArgs, reporter: &Reporter) -> Result<u8, SessionError> {
    let out = args.out.clone().unwrap_or_else(|| args.log.with_extension("replay"));
    let options = ReplayOptions { out, data: args.data.clone(), rate: args.rate.0 };
    let (folder, report) = replay(&args.log, &options, &Board::default(), reporter)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).unwrap_or_default());
    } else {
        println!("{} frames replayed into {}", report.frames, folder.path.display());
        println!("poses: {} identical, {} different", report.poses_identical, report.poses_different.len());
        println!("images: {} identical, {} different", report.images_identical, report.images_different.len());
        for (frame, largest, bound) in &report.images_different {
            println!("  {frame}: largest difference {largest:.3e} nepers, bound of its plan {bound:.1e}");
        }
        for frame in &report.poses_different {
            println!("  {frame}: pose differs from the log");
        }
        for missing in &report.not_in_log {
            println!("  not in the log: {missing}");
        }
        for loss in &report.losses {
            println!("  lost: {loss}");
        }
    }
    Ok(if report.losses.is_empty() && report.is_faithful() { 0 } else { 3 })
}

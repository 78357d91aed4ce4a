//! `sidecarm replay`: a log through the same code; says whether the same came out.

use std::path::PathBuf;

use crate::reporter::Reporter;
use crate::session::SessionError;
use crate::session::board::Board;
use crate::session::folder::Folder;
use crate::session::replay::{ReplayOptions, ReplayReport, run as replay};
use crate::session::servers::IgtlServer;

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
    /// Folder for strips, DRRs, pairs and report; beside the log when absent, under its name with .replay in place of .mcap: session.replay for session.mcap.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Send what is replayed over OpenIGTLink as well, on this port of this machine; best with --rate 1.
    #[arg(long, value_name = "PORT")]
    pub igtl: Option<u16>,
    /// Show it in the window of a session; closing that does not end the replay. With --rate 1 exposures come as they came.
    #[cfg(feature = "viewer")]
    #[arg(long)]
    pub window: bool,
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

/// With the window where one is asked for.
fn replayed(args: &ReplayArgs, options: ReplayOptions, reporter: &Reporter) -> Result<(Folder, ReplayReport), SessionError> {
    let board = Board::default();
    #[cfg(feature = "viewer")]
    if args.window {
        let (log, of_replay, words) = (args.log.clone(), board.clone(), reporter.clone());
        let work = move || replay(&log, &options, &of_replay, &words);
        return super::windowed::beside_window(board, None, reporter, work, || false, || ());
    }
    replay(&args.log, &options, &board, reporter)
}

/// Replays; exit code 0, or 3 when the log had lost something or something came out differently.
///
/// # Errors
/// When the log or the scene's files cannot be read.
pub fn run(args: &ReplayArgs, reporter: &Reporter) -> Result<u8, SessionError> {
    let out = args.out.clone().unwrap_or_else(|| args.log.with_extension("replay"));
    let options = ReplayOptions { out, data: args.data.clone(), rate: args.rate.0, igtl: args.igtl.map(IgtlServer::on_port) };
    let (folder, report) = replayed(args, options, reporter)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report).unwrap_or_default());
    } else {
        println!("{} frames replayed into {}", report.frames, folder.path.display());
        println!("poses: {} identical, {} different", report.poses_identical, report.poses_different.len());
        println!("images: {} identical, {} different", report.images_identical, report.images_different.len());
        println!("scores: {} identical, {} different", report.scores_identical, report.scores_different.len());
        for found in &report.images_different {
            let largest = found.largest_nepers.map_or("not finite".to_owned(), |largest| format!("{largest:.3e} nepers"));
            let detail = found.detail.as_ref().map(|detail| format!(" ({detail})")).unwrap_or_default();
            println!("  frame {}: largest difference {largest}, bound of its plan {:.1e}{detail}", found.number, found.bound);
        }
        for number in &report.images_missing {
            println!("  frame {number}: the log has a DRR, none was rendered now");
        }
        for number in &report.poses_different {
            println!("  frame {number}: pose differs from the log");
        }
        for number in &report.poses_missing {
            println!("  frame {number}: the log has a pose, but no frame for it");
        }
        for number in &report.scores_different {
            println!("  frame {number}: pose and DRR are those of the log, its scores are not");
        }
        if report.samples_different > 0 {
            println!("  {} samples of the devices are not what the log's bytes say", report.samples_different);
        }
        for missing in &report.not_in_log {
            println!("  not in the log: {missing}");
        }
        for loss in &report.losses {
            println!("  lost: {loss}");
        }
        for loss in &report.session_losses {
            println!("  lost in the session: {loss}");
        }
    }
    Ok(if report.losses.is_empty() && report.is_faithful() { 0 } else { 3 })
}

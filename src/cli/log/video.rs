//! `sidecarm log video`.

use std::path::PathBuf;

use crate::reporter::Reporter;
use crate::session::logbook::{LogbookError, Pace, write_video};

/// Make a video of a session's pairs: acquired frame, DRR, difference and edges, one exposure after the other.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm log video run-1/session.mcap --out run-1.avi --pair-s 2\n\n\
    The pictures are the strips of the session's folder, beside the log; `sidecarm replay` makes them anew. Motion-JPEG in AVI, two pictures \
    a second. Pairs that have no strip are counted. Exit code 0; 3 where strips are missing.")]
pub struct VideoArgs {
    /// The log of a session, in its folder.
    pub log: PathBuf,
    /// The video.
    #[arg(long, value_name = "FILE.avi", value_parser = avi)]
    pub out: PathBuf,
    /// Seconds for which each pair is shown.
    #[arg(long, value_name = "S", default_value_t = 1.5, value_parser = seconds)]
    pub pair_s: f64,
    /// Each pair is shown until the next exposure, half a second to ten.
    #[arg(long, conflicts_with = "pair_s")]
    pub real_time: bool,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

fn avi(name: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(name);
    let is_avi = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("avi"));
    if is_avi { Ok(path) } else { Err("expected a name that ends in .avi".to_owned()) }
}

fn seconds(text: &str) -> Result<f64, String> {
    let good = text.parse().ok().filter(|s: &f64| (0.5..=60.0).contains(s));
    good.ok_or_else(|| "expected 0.5 to 60 s".to_owned())
}

/// Writes the video and says how long it is.
///
/// # Errors
/// When pairs or strips cannot be read, or the video cannot be written.
pub fn run(args: &VideoArgs, reporter: &Reporter) -> Result<u8, LogbookError> {
    let pace = if args.real_time { Pace::RealTime } else { Pace::Each { s: args.pair_s } };
    let report = write_video(&args.log, &args.out, pace, reporter)?;
    if args.json {
        println!("{}", serde_json::to_string(&report).unwrap_or_default());
    } else {
        println!("{}: {} pairs, {:.1} s", report.path.display(), report.pairs, report.seconds);
    }
    if report.without_strip > 0 {
        reporter.warn("strips", format!("{} pairs have no strip and are not in the video", report.without_strip));
    }
    Ok(if report.without_strip > 0 { 3 } else { 0 })
}

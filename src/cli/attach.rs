//! `sidecarm attach`: frames exported after a session, tied to the exposures in its log.

use std::path::PathBuf;

use crate::image::{ImageFileError, write_atomically};
use crate::reporter::Reporter;
use crate::session::attach::{AttachError, AttachReport, Attached, attach};
use crate::timeline::TOO_FEW_AGREE;

/// Tie frames that were exported after a session to the exposures in its log. The log is not changed.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm attach run-1/session.mcap export/ --out bindings.json\n\n\
    Exit code 3: some frames could not be tied, but for those that are certainly of another study; the table says why.")]
pub struct AttachArgs {
    /// The session's log.
    pub log: PathBuf,
    /// Frames, or folders of frames, which are read with the folders below them.
    #[arg(required = true)]
    pub frames: Vec<PathBuf>,
    /// Write the bindings (exposure, times, joints, evidence of each frame) to this JSON file.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// What helps where too few frames agree.
const MORE_TO_AGREE: &str = "name all frames of the session at once, the first and the last too; it helps to set the console's clock to the host's, \
                             and to have it write date, time and the C-arm's exposure counter (Acquisition Number) into its frames";
/// So many exposures without a frame are named; the JSON has all.
const NAMED: usize = 20;

/// Why the command failed.
#[derive(Debug, thiserror::Error)]
pub enum AttachCommandError {
    /// Log or frames.
    #[error(transparent)]
    Attach(#[from] AttachError),
    /// The result cannot be written.
    #[error(transparent)]
    Out(#[from] ImageFileError),
    /// `--out` names the log or one of the frames.
    #[error("{path}: is one of the inputs; choose another --out", path = path.display())]
    Overwrites {
        /// The file.
        path: PathBuf,
    },
}

/// Attaches; exit code 0, or 3 when some frames of the session could not be tied, or some not read.
///
/// # Errors
/// When log or frames cannot be read, or the result cannot be written.
pub fn run(args: &AttachArgs, reporter: &Reporter) -> Result<u8, AttachCommandError> {
    if let Some(out) = &args.out {
        let same = |input: &PathBuf| std::fs::canonicalize(input).ok() == std::fs::canonicalize(out).ok();
        let inside =
            |input: &PathBuf| input.is_dir() && out.exists() && out.parent().is_some_and(|folder| is_within(folder, input));
        if out.exists() && (same(&args.log) || args.frames.iter().any(|input| same(input) || inside(input))) {
            return Err(AttachCommandError::Overwrites { path: out.clone() });
        }
    }
    let report = attach(&args.log, &args.frames, reporter)?;
    let json = serde_json::to_string_pretty(&report).unwrap_or_default();
    if let Some(out) = &args.out {
        write_atomically(out, |file| file.write_all(format!("{json}\n").as_bytes()))?;
    }
    if args.json {
        println!("{json}");
    } else {
        table(&report);
    }
    let all = report.bound() + report.of_another_study == report.frames.len();
    Ok(if all && report.losses.is_empty() { 0 } else { 3 })
}

/// Whether `folder` is `root` or lies below it.
fn is_within(folder: &std::path::Path, root: &std::path::Path) -> bool {
    let folder = if folder.as_os_str().is_empty() { std::path::Path::new(".") } else { folder };
    matches!((std::fs::canonicalize(folder), std::fs::canonicalize(root)), (Ok(folder), Ok(root)) if folder.starts_with(&root))
}

fn table(report: &AttachReport) {
    println!(
        "{} exposures and {} frames in the log, {} frames to attach",
        report.exposures,
        report.frames_in_log,
        report.frames.len()
    );
    if let Some(clock) = report.console {
        println!("console clock: {}, from {} frames", clock.words_beside_zone(report.console_zone_min), clock.frames);
    }
    for frame in &report.frames {
        println!("{}", row(frame));
        for flag in &frame.binding.flags {
            println!("    {flag}");
        }
    }
    for loss in &report.losses {
        println!("lost: {loss}");
    }
    println!("{} of {} frames tied", report.bound(), report.frames.len());
    if report.of_another_study > 0 {
        println!(
            "{} frames of another study: none of it has an exposure, and each exposure has its frame without them",
            report.of_another_study
        );
    }
    if report.frames.iter().any(|frame| frame.binding.evidence.last().is_some_and(|words| words == TOO_FEW_AGREE)) {
        println!("{MORE_TO_AGREE}");
    }
    let without = &report.exposures_without_frame;
    if !without.is_empty() {
        let more = if without.len() > NAMED { ", …" } else { "" };
        let named = without.iter().take(NAMED).map(String::as_str).collect::<Vec<_>>().join(", ");
        println!("{} of {} exposures still have no frame ({named}{more})", without.len(), report.exposures);
    }
}

fn row(frame: &Attached) -> String {
    let reason = frame.binding.evidence.last().map_or("", String::as_str);
    let [image, count] = frame.image_of_file;
    let label = if count > 1 { format!("{} image {}", frame.label, image + 1) } else { frame.label.clone() };
    match &frame.binding.exposure {
        Some(exposure) => format!("{label:24} {:14} {reason}", exposure.label()),
        None => format!("{label:24} {:14} {reason}", "not tied"),
    }
}

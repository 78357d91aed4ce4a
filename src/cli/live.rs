//! `sidecarm live`: a session with real (or mocked) devices.

use std::path::PathBuf;

use super::signals::{REMOVED_WITHIN, left, on_signals};
use crate::image::remove_temporaries;
use crate::reporter::{Reporter, to_stdout};
use crate::session::board::Board;
use crate::session::file::Setup;
use crate::session::folder::Folder;
use crate::session::live::{LiveOptions, run as run_session};
use crate::session::{SessionError, Stop};

/// Ride along: telemetry and frames in, matched DRRs, log and report out. Ends with Ctrl-C, or when its window is closed.
///
/// In the window F1 lists the keys: exposures to step through, overlays, gray values, notes, beads to edit.
///
/// With "igtl": {"port": 18944} in the session file, 3D Slicer and others hear poses, pictures and lines over OpenIGTLink meanwhile.
/// With "dicom": {"port": 11112} under "frames", consoles may send frames (C-STORE to SIDECARM); they are kept in the watched folder.
/// With "video": {"from": "/dev/video0"} there, pictures that stand still on a monitor's output are grabbed into it (see `sidecarm grab`).
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  sidecarm check session.json && sidecarm live session.json --out run-1")]
pub struct LiveArgs {
    /// The session file.
    pub session: PathBuf,
    /// Folder of the session; the session file's `out` when absent.
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// No window.
    #[arg(long)]
    pub headless: bool,
    /// End after this many seconds.
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,
    /// Also take frames that are in the folder already.
    #[arg(long)]
    pub include_existing: bool,
    /// A sound for each exposure: one high tone for an accepted pose, two for one to beware of, a low one for none.
    #[arg(long)]
    pub sound: bool,
}

/// Runs a session; exit code 0, or 3 when something was lost.
///
/// # Errors
/// When the session cannot start.
pub fn run(args: &LiveArgs, reporter: &Reporter) -> Result<u8, SessionError> {
    keep_memory();
    let setup = Setup::load(&args.session)?;
    let beside = args.session.parent().unwrap_or(std::path::Path::new(".")).to_owned();
    let named = setup.session.out.as_ref().map(|out| beside.join(out));
    let out = args.out.clone().or(named).unwrap_or_else(|| beside.join("session"));
    let stop = Stop::default();
    stop_on_signals(&stop, reporter);
    let options = LiveOptions { out, stop, seconds: args.seconds, include_existing: args.include_existing, sound: args.sound };
    let folder = watch(setup, options, args.headless, reporter)?;
    summary(&folder, reporter);
    Ok(if folder.losses.is_empty() { 0 } else { 3 })
}

/// How long the allocator keeps what is free, ms; it is told by its environment alone.
#[cfg(unix)]
const KEPT: (&str, &str) = ("MIMALLOC_PURGE_DELAY", "600000");

/// Begins anew with memory that is kept between frames: to give it back after each pair and to have it cleared again for the next one costs a
/// large pair a tenth of its time. Where that fails it goes on as it is.
fn keep_memory() {
    #[cfg(unix)]
    if std::env::var_os(KEPT.0).is_none()
        && let Ok(program) = std::env::current_exe()
    {
        use std::os::unix::process::CommandExt;
        let mut again = std::process::Command::new(program);
        drop(again.args(std::env::args_os().skip(1)).env(KEPT.0, KEPT.1).exec());
    }
}

/// Runs the session, in a window unless `headless` or where no window can be opened. A session that cannot start closes its window.
///
/// # Errors
/// As [`run_session`].
pub(super) fn watch(setup: Setup, options: LiveOptions, headless: bool, reporter: &Reporter) -> Result<Folder, SessionError> {
    let board = Board::default();
    if headless || !cfg!(feature = "viewer") {
        return run_session(setup, &options, None, &board, reporter);
    }
    #[cfg(not(feature = "viewer"))]
    unreachable!("returned above");
    #[cfg(feature = "viewer")]
    {
        let (stop, asked) = (options.stop.clone(), options.stop.clone());
        let (of_session, words) = (board.clone(), reporter.clone());
        let (requests, edits) = std::sync::mpsc::channel();
        let session = move || run_session(setup, &options, Some(edits), &of_session, &words);
        let asks = move || asked.is_interrupted();
        super::windowed::beside_window(board, Some(requests), reporter, session, asks, move || stop.finish())
    }
}

/// Ctrl-C ends the session in order, with log and report complete; a second one at once, with nothing lost that was recorded. SIGTERM and
/// SIGHUP end it as Ctrl-C does.
pub(super) fn stop_on_signals(stop: &Stop, reporter: &Reporter) {
    let (stop, reporter) = (stop.clone(), reporter.clone());
    on_signals(move |_| match stop.ask() {
        1 => reporter.note("ending the session; again to leave at once"),
        2 => {
            reporter.note("leaving at once; what is recorded is kept");
            leave_in_any_case(&reporter);
        }
        _ => leave_now(&reporter),
    });
}

/// Whoever leaves at once waits no longer than this, whatever stands still.
const LEAVES_WITHIN: std::time::Duration = std::time::Duration::from_secs(10);

/// Where a disk stands still, so does who writes the report.
fn leave_in_any_case(reporter: &Reporter) {
    let reporter = reporter.clone();
    std::thread::spawn(move || {
        std::thread::sleep(LEAVES_WITHIN);
        leave_now(&reporter);
    });
}

fn leave_now(reporter: &Reporter) -> ! {
    left(&remove_temporaries(REMOVED_WITHIN)).into_iter().for_each(|words| reporter.note(words));
    reporter.note("left without a report: `sidecarm replay` makes it from the log");
    std::process::exit(3);
}

/// Where everything is, on standard output.
fn summary(folder: &Folder, reporter: &Reporter) {
    let report = folder.path.join("report.html");
    let place = if report.is_file() { report.display().to_string() } else { "no report could be written".to_owned() };
    to_stdout(&format!("{}: {place}", crate::report::counted_of(&folder.pairs, folder.frames, folder.unfinished)));
    for (kind, counted) in reporter.warnings() {
        to_stdout(&format!("{} x {kind}: {}", counted.count, counted.latest));
    }
    for loss in &folder.losses {
        to_stdout(&format!("lost: {loss}"));
    }
}

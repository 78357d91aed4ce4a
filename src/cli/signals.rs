//! Signals that end a program: Ctrl-C, SIGTERM and SIGHUP.

use std::path::PathBuf;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::time::Duration;

use crate::image::remove_temporaries;
use crate::reporter::Reporter;

/// Files that were not whole are gone by then, or are told.
pub(super) const REMOVED_WITHIN: Duration = Duration::from_millis(500);
/// A program whose libraries do not come to their end, or whose words nobody takes, is ended without them.
#[cfg(unix)]
const ENDED_WITHIN: Duration = Duration::from_secs(5);

/// The command at hand ends in its own way, as the check at the end of `session new` does.
static IS_HEARD: AtomicBool = AtomicBool::new(false);

/// What ended a program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Signal {
    Interrupt,
    #[cfg(unix)]
    Terminate,
    #[cfg(unix)]
    Hangup,
}

impl Signal {
    /// Its number, and what it is called.
    fn described(self) -> (u8, &'static str) {
        match self {
            Self::Interrupt => (2, "Ctrl-C"),
            #[cfg(unix)]
            Self::Terminate => (15, "SIGTERM"),
            #[cfg(unix)]
            Self::Hangup => (1, "SIGHUP"),
        }
    }

    /// Whoever started the program had it ignore the signal.
    fn was_ignored(self) -> bool {
        let (number, _) = self.described();
        IGNORED.get_or_init(ignored) & (1u64 << (number - 1)) != 0
    }

    /// A program that is to outlive its terminal, as by `nohup`, hears nothing of the terminal's end. Ctrl-C it hears all the same: a script's
    /// background has every command ignore that.
    fn is_heard(self) -> bool {
        #[cfg(unix)]
        return self != Self::Hangup || !self.was_ignored();
        #[cfg(not(unix))]
        return true;
    }
}

/// Ends the program at one of them, and leaves nothing that is not whole: for every command that has no end of its own. What was ignored when the
/// program started, as by `nohup`, stays ignored.
pub(super) fn end_on_signals(reporter: &Reporter) {
    let reporter = reporter.clone();
    listen(move |signal| {
        if !signal.was_ignored() && !IS_HEARD.load(Ordering::Relaxed) {
            let (number, name) = signal.described();
            end(number, name, &reporter);
        }
    });
}

/// What could not be removed, for people; `None` where all was.
pub(super) fn left(paths: &[PathBuf]) -> Option<String> {
    let names: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
    (!names.is_empty()).then(|| format!("left half-written, remove it: {}", names.join(", ")))
}

fn end(number: u8, name: &str, reporter: &Reporter) -> ! {
    #[cfg(unix)]
    let _ = std::thread::Builder::new().name("end".into()).spawn(|| {
        std::thread::sleep(ENDED_WITHIN);
        let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL);
    });
    let left = left(&remove_temporaries(REMOVED_WITHIN)).unwrap_or_else(|| "nothing half-written is left".to_owned());
    reporter.note(format!("sidecarm: ended by {name}; {left}"));
    // Of the signal itself, so that a shell ends the loop in which it runs the program.
    #[cfg(unix)]
    let _ = signal_hook::low_level::emulate_default_handler(i32::from(number));
    std::process::exit(128 + i32::from(number))
}

/// What was to be ignored when the program started.
static IGNORED: OnceLock<u64> = OnceLock::new();

/// A bit for each signal that whoever started the program had it ignore.
#[cfg(target_os = "linux")]
fn ignored() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    mask.unwrap_or(0)
}

/// Elsewhere no system says it without being asked in unsafe ways.
#[cfg(not(target_os = "linux"))]
fn ignored() -> u64 {
    0
}

/// Calls `act` at each of them, on a thread of its own, in place of what the system or [`end_on_signals`] would do. Holds from its return on; where
/// the system gives no such thread, all stays as it was.
pub(super) fn on_signals(act: impl Fn(Signal) + Send + 'static) {
    let act = move |signal: Signal| {
        if signal.is_heard() {
            act(signal);
        }
    };
    if listen(act) {
        IS_HEARD.store(true, Ordering::Relaxed);
    }
}

/// Whether it hears them.
fn listen(act: impl Fn(Signal) + Send + 'static) -> bool {
    // Before the first handler takes its place.
    IGNORED.get_or_init(ignored);
    let (sender, installed) = channel();
    std::thread::spawn(move || {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() else { return };
        runtime.block_on(async {
            let Ok(mut signals) = Signals::new() else { return };
            let _ = sender.send(());
            while let Some(signal) = signals.next().await {
                act(signal);
            }
        });
    });
    // Nothing comes where there are none.
    installed.recv().is_ok()
}

#[cfg(unix)]
struct Signals([tokio::signal::unix::Signal; 3]);

#[cfg(unix)]
impl Signals {
    fn new() -> std::io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self([signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?, signal(SignalKind::hangup())?]))
    }

    /// Waits for the next one; `None` when there will be none.
    async fn next(&mut self) -> Option<Signal> {
        let [interrupt, terminate, hangup] = &mut self.0;
        tokio::select! {
            found = interrupt.recv() => found.map(|()| Signal::Interrupt),
            found = terminate.recv() => found.map(|()| Signal::Terminate),
            found = hangup.recv() => found.map(|()| Signal::Hangup),
        }
    }
}

#[cfg(not(unix))]
struct Signals;

#[cfg(not(unix))]
impl Signals {
    fn new() -> std::io::Result<Self> {
        Ok(Self)
    }

    /// Waits for the next one; `None` when there will be none.
    async fn next(&mut self) -> Option<Signal> {
        tokio::signal::ctrl_c().await.ok().map(|()| Signal::Interrupt)
    }
}

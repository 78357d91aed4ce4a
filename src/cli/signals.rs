//! Signals that end a program: Ctrl-C, SIGTERM and SIGHUP.

use std::sync::mpsc::channel;

/// Calls `act` at each of them, on a thread of its own, in place of what the system would do. Holds from its return on; where the system gives no
/// such thread, all stays as it was.
pub(super) fn on_signals(act: impl Fn() + Send + 'static) {
    let (sender, installed) = channel();
    std::thread::spawn(move || {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() else { return };
        runtime.block_on(async {
            let Ok(mut signals) = Signals::new() else { return };
            let _ = sender.send(());
            while signals.next().await {
                act();
            }
        });
    });
    // Nothing comes where there are none.
    let _ = installed.recv();
}

#[cfg(unix)]
struct Signals([tokio::signal::unix::Signal; 3]);

#[cfg(unix)]
impl Signals {
    fn new() -> std::io::Result<Self> {
        use tokio::signal::unix::{SignalKind, signal};
        Ok(Self([signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?, signal(SignalKind::hangup())?]))
    }

    /// Waits for the next one; false when there will be none.
    async fn next(&mut self) -> bool {
        let [interrupt, terminate, hangup] = &mut self.0;
        tokio::select! {
            found = interrupt.recv() => found.is_some(),
            found = terminate.recv() => found.is_some(),
            found = hangup.recv() => found.is_some(),
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

    /// Waits for the next one; false when there will be none.
    async fn next(&mut self) -> bool {
        tokio::signal::ctrl_c().await.is_ok()
    }
}

//! Work on a thread of its own beside a window, which needs the main one.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::mpsc::Sender;
use std::time::Duration;

use crate::reporter::Reporter;
use crate::session::SessionError;
use crate::session::board::Board;
use crate::session::edit::EditRequest;

/// How often it is asked whether a window leaves.
const LOOK: Duration = Duration::from_millis(200);

const RUNS: u8 = 0;
const ENDED: u8 = 1;
const FAILED: u8 = 2;

/// How the work ended, said however it ends, and to a window that waits for nothing else.
struct Fate {
    told: Arc<AtomicU8>,
    board: Board,
    is: u8,
}

/// A window that is not drawn is not asked whether it leaves: it is woken when it does.
fn wake_when(board: Board, leaves: impl Fn() -> bool + Send + 'static) {
    std::thread::spawn(move || {
        while !leaves() {
            std::thread::sleep(LOOK);
        }
        board.update(|_| ());
    });
}

impl Fate {
    fn is(&mut self, good: bool) {
        self.is = if good { ENDED } else { FAILED };
    }
}

impl Drop for Fate {
    fn drop(&mut self) {
        self.told.store(self.is, Ordering::Relaxed);
        self.board.update(|_| ());
    }
}

/// Runs `work` beside a window that shows `board` and sends what a person edits to `edits`. Closing the window runs `closed`; the window closes
/// by itself where the work fails, and where it has ended and `leaves` says that nobody wants to look any more. Without a window the work goes
/// on alone.
///
/// # Errors
/// Those of `work`.
pub(super) fn beside_window<T: Send + 'static>(
    board: Board,
    edits: Option<Sender<EditRequest>>,
    reporter: &Reporter,
    work: impl FnOnce() -> Result<T, SessionError> + Send + 'static,
    leaves: impl Fn() -> bool + Clone + Send + 'static,
    closed: impl Fn() + 'static,
) -> Result<T, SessionError> {
    board.update(|state| state.watched = true);
    let told = Arc::new(AtomicU8::new(RUNS));
    let mut fate = Fate { told: Arc::clone(&told), board: board.clone(), is: FAILED };
    let asked = leaves.clone();
    let thread = std::thread::spawn(move || {
        let done = work();
        fate.is(done.is_ok());
        if done.is_ok() {
            wake_when(fate.board.clone(), asked);
        }
        done
    });
    let is_over = move || match told.load(Ordering::Relaxed) {
        FAILED => true,
        ENDED => leaves(),
        _ => false,
    };
    if let Err(error) = crate::viewer::run(board.clone(), edits, is_over, closed) {
        reporter.warn("no window", error);
    }
    // Pictures that nobody looks at are not made.
    board.update(|state| state.watched = false);
    thread.join().map_err(|_| SessionError::WorkshopDied)?
}

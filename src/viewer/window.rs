//! The native window around the panes.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Sender;
use std::time::Duration;

use eframe::egui;

use super::layout::draw;
use super::state::ViewState;
use crate::session::board::Board;
use crate::session::edit::EditRequest;
use crate::time::host_now_us;

/// Why no window opens.
#[derive(Debug, thiserror::Error)]
pub enum ViewerError {
    /// No display, or no graphics adapter.
    #[error("no window can be opened ({detail}); run with --headless")]
    NoWindow {
        /// What the system said.
        detail: String,
    },
}

/// The board rings for whatever is worth a look. This is for counters and rates, which are not.
const TICK: Duration = Duration::from_secs(10);
/// How often the board is told the time, whatever the session's own thread does: where that stands still, lines look silent all the same.
const WATCH: Duration = Duration::from_millis(500);

struct Window {
    board: Board,
    state: ViewState,
    /// Where what a person edits goes; absent where nothing can be edited.
    edits: Option<Sender<EditRequest>>,
    leaves: Box<dyn Fn() -> bool>,
    on_close: Box<dyn Fn()>,
}

impl eframe::App for Window {
    fn logic(&mut self, context: &egui::Context, _frame: &mut eframe::Frame) {
        self.board.heard();
        if (self.leaves)() {
            context.send_viewport_cmd(egui::ViewportCommand::Close);
        }
        // A hidden window is asked too whether it leaves.
        context.request_repaint_after(TICK);
    }

    fn ui(&mut self, ui: &mut egui::Ui, _frame: &mut eframe::Frame) {
        let mut snapshot = self.board.snapshot();
        if !(snapshot.replayed || snapshot.finished) {
            // Ages are those of this moment, even where the session's own thread stands still.
            snapshot.now_us = host_now_us();
        }
        draw(ui, &snapshot, &mut self.state);
        if let Some(pair) = self.state.shown(&snapshot) {
            self.board.look_at(pair.number());
        }
        let asked = self.state.editing.take_asked();
        if let Some(edits) = &self.edits {
            // A session that has ended takes none.
            asked.into_iter().for_each(|request| drop(edits.send(request)));
        }
    }

    fn on_exit(&mut self) {
        (self.on_close)();
    }
}

/// Tells `board` the time until it is `over`; it rings where a line is silent by then.
fn watch(board: Board, over: Arc<AtomicBool>) {
    let watching = move || {
        while !over.load(Ordering::Relaxed) {
            std::thread::sleep(WATCH);
            board.tick(|state| {
                if !(state.replayed || state.finished) {
                    state.now_us = host_now_us();
                }
            });
        }
    };
    // Without it the session's own thread tells the time, as long as it runs.
    drop(std::thread::Builder::new().name("watch".to_owned()).spawn(watching));
}

/// Shows `board`, and sends what a person edits to `edits`, until the window is closed, or `leaves` says that there is nothing more to see;
/// `on_close` runs then. It is drawn when the board changes, and every ten seconds.
///
/// # Errors
/// When there is no display or no graphics adapter.
pub fn run(
    board: Board,
    edits: Option<Sender<EditRequest>>,
    leaves: impl Fn() -> bool + 'static,
    on_close: impl Fn() + 'static,
) -> Result<(), ViewerError> {
    let options = eframe::NativeOptions {
        viewport: egui::ViewportBuilder::default().with_title("Sidecarm").with_inner_size([1400.0, 900.0]),
        // Noise for each pixel is dear where software draws.
        dithering: false,
        ..Default::default()
    };
    // Opening a window without a display server ends in an error or, in some back ends, a panic: both become one sentence.
    let has_display = cfg!(not(target_os = "linux"))
        || ["DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"]
            .iter()
            .any(|name| std::env::var_os(name).is_some_and(|v| !v.is_empty()));
    if !has_display {
        return Err(ViewerError::NoWindow { detail: "neither DISPLAY nor WAYLAND_DISPLAY is set".to_owned() });
    }
    let over = Arc::new(AtomicBool::new(false));
    watch(board.clone(), Arc::clone(&over));
    let window = move |context: &eframe::CreationContext| {
        let woken = context.egui_ctx.clone();
        board.on_change(move |after| woken.request_repaint_after(after));
        let (leaves, on_close) = (Box::new(leaves), Box::new(on_close));
        Ok(Box::new(Window { board, state: ViewState::default(), edits, leaves, on_close }) as Box<dyn eframe::App>)
    };
    let ran = eframe::run_native("sidecarm", options, Box::new(window));
    over.store(true, Ordering::Relaxed);
    ran.map_err(|error| ViewerError::NoWindow { detail: error.to_string() })
}

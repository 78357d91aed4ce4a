//! The native window around the panes.

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

/// The board rings for whatever is worth a look. This is for readings that creep, and for a session that has stopped to publish anything: its
/// lines look stale after this at the latest.
const TICK: Duration = Duration::from_secs(10);

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
    let window = move |context: &eframe::CreationContext| {
        let woken = context.egui_ctx.clone();
        board.on_change(move |after| woken.request_repaint_after(after));
        let (leaves, on_close) = (Box::new(leaves), Box::new(on_close));
        Ok(Box::new(Window { board, state: ViewState::default(), edits, leaves, on_close }) as Box<dyn eframe::App>)
    };
    eframe::run_native("sidecarm", options, Box::new(window)).map_err(|error| ViewerError::NoWindow { detail: error.to_string() })
}

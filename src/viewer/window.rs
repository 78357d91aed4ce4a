//! The native window around the panes.

use eframe::egui;

use super::ViewState;
use crate::session::board::Board;

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

struct Window {
    board: Board,
    state: ViewState,
    on_close: Box<dyn Fn()>,
}

impl eframe::App for Window {
    fn ui(&mut self, ui: &mut egui::Ui, _frame: &mut eframe::Frame) {
        let snapshot = self.board.snapshot();
        super::draw(ui, &snapshot, &mut self.state);
        // Stale marks must appear by themselves, so the window repaints even when nothing arrives.
        ui.ctx().request_repaint_after(std::time::Duration::from_millis(100));
    }

    fn on_exit(&mut self) {
        (self.on_close)();
    }
}

/// Shows `board` until the window is closed; `on_close` runs then.
///
/// # Errors
/// When there is no display or no graphics adapter.
pub fn run(board: Board, on_close: impl Fn() + 'static) -> Result<(), ViewerError> {
    let options = eframe::NativeOptions {
        viewport: egui::ViewportBuilder::default().with_title("Sidecarm").with_inner_size([1400.0, 760.0]),
        ..Default::default()
    };
    let window = Window { board, state: ViewState::default(), on_close: Box::new(on_close) };
    // Opening a window without a display server ends in an error or, in some back ends, a panic: both become one sentence.
    let has_display = cfg!(not(target_os = "linux"))
        || ["DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"]
            .iter()
            .any(|name| std::env::var_os(name).is_some_and(|v| !v.is_empty()));
    if !has_display {
        return Err(ViewerError::NoWindow { detail: "neither DISPLAY nor WAYLAND_DISPLAY is set".to_owned() });
    }
    eframe::run_native("sidecarm", options, Box::new(move |_| Ok(Box::new(window))))
        .map_err(|error| ViewerError::NoWindow { detail: error.to_string() })
}

//! The whole window: what is known on the left, pictures in the middle, the exposures below.

use eframe::egui::{self, Frame, Margin, ScrollArea, Ui};

use super::state::ViewState;
use super::theme::{BACKGROUND, dress};
use super::{devices, keys, pictures, pose_pane, scores, standing, timeline, toolbar};
use crate::session::board::BoardState;

/// Of the left column.
const COLUMN: f32 = 316.0;

/// Draws everything into `ui`.
pub fn draw(ui: &mut Ui, board: &BoardState, state: &mut ViewState) {
    dress(ui);
    if state.editing.is_on() {
        match state.shown(board).filter(|_| board.editable).cloned() {
            Some(pair) => state.editing.look_at(&pair),
            None => state.leave_editing(),
        }
    }
    if !board.editable {
        state.note = None;
    }
    keys::obey(ui, board, state);
    timeline::advance(ui, board, state);
    let bare = |horizontal, vertical| Frame::new().fill(BACKGROUND).inner_margin(Margin::symmetric(horizontal, vertical));
    standing::alarm(ui, board);
    let shown = state.shown(board).cloned();
    egui::Panel::left("told").frame(bare(8, 6)).resizable(false).exact_size(COLUMN).show(ui, |ui| {
        let pair = shown.as_deref();
        // Of the newest exposure of a session that goes on, what stands now is worth more than what stood then.
        let past = pair.filter(|_| state.selected.is_some() || board.finished);
        standing::show(ui, board, pair);
        ScrollArea::vertical().auto_shrink(false).show(ui, |ui| {
            pose_pane::show(ui, pair);
            scores::show(ui, pair);
            devices::show(ui, board, past);
        });
    });
    egui::Panel::bottom("exposures").frame(bare(6, 4)).resizable(false).show(ui, |ui| {
        ui.horizontal(|ui| toolbar::readout(ui, board, state));
        timeline::show(ui, board, state);
        standing::backlog(ui, board, shown.as_deref());
    });
    egui::Panel::top("tools").frame(bare(6, 3)).resizable(false).show(ui, |ui| toolbar::show(ui, board, state));
    egui::CentralPanel::default().frame(bare(4, 0)).show(ui, |ui| pictures::show(ui, board, state));
    keys::show(ui, state, board.editable);
}

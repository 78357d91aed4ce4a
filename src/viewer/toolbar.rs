//! What is shown how: panes, overlay, marks, gray levels.

use eframe::egui::{self, RichText, Ui};

use super::editing::{EditCommand, words};
use super::keys::{Binding, Command, KEYS, run};
use super::readout::under_cursor;
use super::state::{Arrangement, Mark, Overlay, ViewState};
use super::theme::{CAUTION, DIM, SMALL, TEXT};
use crate::report::short;
use crate::session::board::BoardState;

/// Draws it.
pub(super) fn show(ui: &mut Ui, board: &BoardState, state: &mut ViewState) {
    let mut asked = None;
    ui.horizontal_wrapped(|ui| {
        // In a window as wide as it opens, one line holds them all.
        ui.spacing_mut().item_spacing.x = 3.0;
        for arrangement in Arrangement::ALL {
            button(ui, arrangement.word(), state.arrangement == arrangement, Command::Arrange(arrangement), &mut asked);
        }
        ui.separator();
        for overlay in Overlay::ALL {
            button(ui, overlay.word(), state.overlay == overlay, Command::Overlay(overlay), &mut asked);
        }
        if state.overlay == Overlay::Opacity {
            ui.add(egui::Slider::new(&mut state.opacity, 0.0..=1.0).show_value(false));
        }
        ui.separator();
        for mark in Mark::ALL {
            button(ui, mark.word(), state.draws(mark), Command::Toggle(mark), &mut asked);
        }
        ui.separator();
        button(ui, "fit", state.sight == Default::default(), Command::Fit, &mut asked);
        button(ui, "auto gray", state.window.is_none(), Command::AutoWindow, &mut asked);
        if board.editable {
            let toggle = Command::Edit(EditCommand::Toggle);
            button(ui, "edit Ctrl E", state.editing.is_on(), toggle, &mut asked);
        }
        button(ui, "keys F1", state.shows_keys, Command::Keys, &mut asked);
    });
    if let Some(command) = asked {
        run(command, ui.input(|input| input.time), board, state);
    }
}

/// A button for what a key does; the key is said under the cursor.
fn button(ui: &mut Ui, words: &str, chosen: bool, command: Command, asked: &mut Option<Command>) {
    let key = KEYS.iter().find(|binding| binding.command == command).map(Binding::label).unwrap_or_default();
    let response = ui.selectable_label(chosen, RichText::new(words).size(SMALL).color(if chosen { TEXT } else { DIM }));
    if response.on_hover_text(key).clicked() {
        *asked = Some(command);
    }
}

/// A line about what lies under the cursor.
pub(super) fn readout(ui: &mut Ui, board: &BoardState, state: &ViewState) {
    let pair = state.shown(board);
    if let Some(pair) = pair.filter(|_| state.editing.is_on()) {
        ui.label(RichText::new(words(pair, &state.editing)).size(SMALL).color(CAUTION));
        return;
    }
    let told = pair.zip(state.cursor_px).and_then(|(pair, at)| under_cursor(pair, at));
    let idle = || {
        let [low, high] = pair.map(|pair| state.window_of(pair))?;
        let unit = pair.map(|pair| pair.pictures.unit.clone()).unwrap_or_default();
        Some(format!("gray from {} to {} {unit}", short(low, high - low), short(high, high - low)))
    };
    let zoom = (state.sight.zoom > 1.0).then(|| format!("zoom {:.1}×", state.sight.zoom));
    let words: Vec<String> = [told.or_else(idle), zoom].into_iter().flatten().collect();
    let words = words.join("  ·  ");
    ui.label(RichText::new(words).size(SMALL).color(TEXT));
}

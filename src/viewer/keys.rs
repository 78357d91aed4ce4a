//! What keys do: one table, which is both obeyed and shown.

use eframe::egui::{self, Align2, Key, Modifiers, RichText, Ui};

use super::state::{Arrangement, Mark, Overlay, ViewState};
use super::theme::{BODY, DIM, TEXT};
use crate::session::board::BoardState;

/// What a key, or a button, asks for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Command {
    /// To the exposure so many further, or back.
    Step(isize),
    Oldest,
    Newest,
    Play,
    Speed(isize),
    Arrange(Arrangement),
    Overlay(Overlay),
    Opacity(f32),
    Zoom(f32),
    Fit,
    Pan([f32; 2]),
    /// Moves gray levels by this share of their range, and widens it by that.
    Window {
        level: f64,
        width: f64,
    },
    AutoWindow,
    Toggle(Mark),
    Keys,
    Close,
}

/// A key and what it does.
pub(super) struct Binding {
    pub(super) key: Key,
    pub(super) shift: bool,
    pub(super) command: Command,
    pub(super) words: &'static str,
}

const fn on(key: Key, command: Command, words: &'static str) -> Binding {
    Binding { key, shift: false, command, words }
}

const fn shifted(key: Key, command: Command, words: &'static str) -> Binding {
    Binding { key, shift: true, command, words }
}

/// All of them, as they are listed.
pub(super) const KEYS: [Binding; 44] = [
    on(Key::ArrowLeft, Command::Step(-1), "the exposure before"),
    on(Key::ArrowRight, Command::Step(1), "the next exposure"),
    on(Key::PageUp, Command::Step(-10), "ten exposures back"),
    on(Key::PageDown, Command::Step(10), "ten exposures further"),
    on(Key::Home, Command::Oldest, "the first exposure"),
    on(Key::End, Command::Newest, "the newest exposure, and follow it"),
    on(Key::Space, Command::Play, "play, or stand still"),
    on(Key::Plus, Command::Speed(1), "play faster"),
    // Where it is above another sign.
    shifted(Key::Plus, Command::Speed(1), "play faster"),
    on(Key::Minus, Command::Speed(-1), "play slower"),
    on(Key::Num1, Command::Arrange(Arrangement::All), "all four panes"),
    on(Key::Num2, Command::Arrange(Arrangement::Two), "acquired and DRR"),
    on(Key::Num3, Command::Arrange(Arrangement::Difference), "difference alone"),
    on(Key::Num4, Command::Arrange(Arrangement::Overlay), "overlay alone"),
    on(Key::E, Command::Overlay(Overlay::Edges), "overlay: edges of the DRR"),
    on(Key::B, Command::Overlay(Overlay::Blink), "overlay: blink"),
    on(Key::C, Command::Overlay(Overlay::Checkerboard), "overlay: checkerboard"),
    on(Key::O, Command::Overlay(Overlay::Opacity), "overlay: opacity"),
    on(Key::OpenBracket, Command::Opacity(-0.1), "less of the DRR"),
    on(Key::CloseBracket, Command::Opacity(0.1), "more of the DRR"),
    on(Key::Z, Command::Zoom(1.25), "zoom in"),
    on(Key::X, Command::Zoom(0.8), "zoom out"),
    on(Key::F, Command::Fit, "the whole frame"),
    shifted(Key::ArrowLeft, Command::Pan([-0.1, 0.0]), "look further left"),
    shifted(Key::ArrowRight, Command::Pan([0.1, 0.0]), "look further right"),
    shifted(Key::ArrowUp, Command::Pan([0.0, -0.1]), "look further up"),
    shifted(Key::ArrowDown, Command::Pan([0.0, 0.1]), "look further down"),
    on(Key::ArrowUp, Command::Window { level: -0.05, width: 0.0 }, "brighter"),
    on(Key::ArrowDown, Command::Window { level: 0.05, width: 0.0 }, "darker"),
    on(Key::Comma, Command::Window { level: 0.0, width: -0.1 }, "more contrast"),
    on(Key::Period, Command::Window { level: 0.0, width: 0.1 }, "less contrast"),
    on(Key::W, Command::AutoWindow, "gray levels as each pair needs them"),
    on(Key::D, Command::Toggle(Mark::Beads), "beads"),
    on(Key::N, Command::Toggle(Mark::Names), "names"),
    on(Key::R, Command::Toggle(Mark::Residuals), "residuals"),
    on(Key::S, Command::Toggle(Mark::Robot), "robot: centreline and tip"),
    on(Key::L, Command::Toggle(Mark::Landmarks), "landmarks"),
    on(Key::M, Command::Toggle(Mark::Masks), "what is masked"),
    on(Key::F1, Command::Keys, "these keys"),
    on(Key::Questionmark, Command::Keys, "these keys"),
    shifted(Key::Questionmark, Command::Keys, "these keys"),
    on(Key::H, Command::Keys, "these keys"),
    on(Key::Equals, Command::Speed(1), "play faster"),
    on(Key::Escape, Command::Close, "close this list"),
];

/// Does what the keys pressed since the last look ask for.
pub(super) fn obey(ui: &Ui, board: &BoardState, state: &mut ViewState) {
    for binding in &KEYS {
        let modifiers = if binding.shift { Modifiers::SHIFT } else { Modifiers::NONE };
        let pressed = ui.input_mut(|input| {
            // A question mark needs shift on some keyboards and not on others; everywhere else shift is another key.
            let shift = input.modifiers.shift;
            (shift == binding.shift) && input.consume_key(modifiers, binding.key)
        });
        if pressed {
            run(binding.command, ui.input(|input| input.time), board, state);
        }
    }
}

/// Does what a key or a button asks for.
pub(super) fn run(command: Command, now_s: f64, board: &BoardState, state: &mut ViewState) {
    let shown = state.shown_index(board);
    match command {
        Command::Step(by) => {
            state.player.stop();
            if let Some(at) = shown {
                state.select(board, at.saturating_add_signed(by));
            }
        }
        Command::Oldest => {
            state.player.stop();
            state.select(board, 0);
        }
        Command::Newest => {
            state.player.stop();
            state.selected = None;
        }
        Command::Play if state.player.is_playing() => state.player.stop(),
        Command::Play => play(now_s, board, state),
        Command::Speed(by) => state.player.shift_speed(by),
        Command::Arrange(arrangement) => state.arrangement = arrangement,
        Command::Overlay(overlay) => {
            state.overlay = overlay;
            // Somebody who asks for an overlay wants to see it.
            if matches!(state.arrangement, Arrangement::Two | Arrangement::Difference) {
                state.arrangement = Arrangement::All;
            }
        }
        Command::Opacity(by) => {
            state.overlay = Overlay::Opacity;
            state.opacity = (state.opacity + by).clamp(0.0, 1.0);
        }
        Command::Zoom(factor) => state.sight.zoom = (state.sight.zoom * factor).clamp(1.0, 64.0),
        Command::Fit => state.sight = Default::default(),
        Command::Pan(by) => state.sight.step(by),
        Command::Window { level, width } => {
            if let Some(pair) = state.shown(board) {
                state.shift_window(pair, level, width);
            }
        }
        Command::AutoWindow => state.window = None,
        Command::Toggle(mark) => state.toggle(mark),
        Command::Keys => state.shows_keys = !state.shows_keys,
        Command::Close => state.shows_keys = false,
    }
}

/// From the exposure shown, or from the first one where the last is shown.
fn play(now_s: f64, board: &BoardState, state: &mut ViewState) {
    let Some(at) = state.shown_index(board) else { return };
    let from = if at + 1 < board.pairs.len() { at } else { 0 };
    state.select(board, from);
    state.player.start(now_s, board.pairs[from].time_us);
}

/// The list, over everything.
pub(super) fn show(ui: &mut Ui, state: &ViewState) {
    if !state.shows_keys {
        return;
    }
    egui::Window::new("Keys").anchor(Align2::CENTER_CENTER, [0.0, 0.0]).collapsible(false).resizable(false).show(ui.ctx(), |ui| {
        egui::Grid::new("keys").num_columns(6).spacing([14.0, 3.0]).show(ui, |ui| {
            for row in KEYS.chunks(3) {
                for Binding { key, shift, words, .. } in row {
                    let shift = if *shift { "Shift " } else { "" };
                    ui.label(RichText::new(format!("{shift}{}", key.name())).size(BODY).color(TEXT));
                    ui.label(RichText::new(*words).size(BODY).color(DIM));
                }
                ui.end_row();
            }
        });
        let mouse = "Mouse in a picture: wheel zooms, drag moves, right drag sets gray levels (up and down, left and right), double click shows the whole frame";
        ui.label(RichText::new(mouse).size(BODY).color(DIM));
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_key_does_two_things_and_each_does_what_it_says() {
        let keys: std::collections::BTreeSet<_> = KEYS.iter().map(|binding| (binding.key.name(), binding.shift)).collect();
        assert_eq!(keys.len(), KEYS.len());
        let board = BoardState::default();
        let mut state = ViewState::default();
        run(Command::Overlay(Overlay::Checkerboard), 0.0, &board, &mut state);
        run(Command::Toggle(Mark::Masks), 0.0, &board, &mut state);
        run(Command::Zoom(2.0), 0.0, &board, &mut state);
        assert_eq!((state.overlay, state.draws(Mark::Masks), state.sight.zoom), (Overlay::Checkerboard, true, 2.0));
        run(Command::Fit, 0.0, &board, &mut state);
        run(Command::Toggle(Mark::Masks), 0.0, &board, &mut state);
        // Without a pair there is nothing to step to or to play.
        for command in [Command::Step(1), Command::Step(-1), Command::Play, Command::Newest, Command::Oldest] {
            run(command, 0.0, &board, &mut state);
        }
        assert_eq!((state.selected, state.sight.zoom, state.player.is_playing()), (None, 1.0, false));
    }
}

//! What keys do: one table, which is both obeyed and shown.

use eframe::egui::{self, Align2, Event, Key, Modifiers, RichText, Ui};

use super::editing::EditCommand;
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
    Edit(EditCommand),
    Note,
    Keys,
    Close,
}

/// Under which keys are listed.
const GROUPS: [&str; 7] = ["exposures", "play", "panes", "view", "marks", "edit", "list"];

impl Command {
    /// One of [`GROUPS`].
    fn group(self) -> &'static str {
        match self {
            Self::Step(_) | Self::Oldest | Self::Newest => "exposures",
            Self::Play | Self::Speed(_) => "play",
            Self::Arrange(_) | Self::Overlay(_) | Self::Opacity(_) => "panes",
            Self::Zoom(_) | Self::Fit | Self::Pan(_) | Self::Window { .. } | Self::AutoWindow => "view",
            Self::Toggle(_) => "marks",
            Self::Edit(_) | Self::Note => "edit",
            Self::Keys | Self::Close => "list",
        }
    }
}

/// A key and what it does.
pub(super) struct Binding {
    pub(super) key: Key,
    pub(super) with: Modifiers,
    pub(super) command: Command,
    pub(super) words: &'static str,
}

const fn on(key: Key, command: Command, words: &'static str) -> Binding {
    Binding { key, with: Modifiers::NONE, command, words }
}

const fn shifted(key: Key, command: Command, words: &'static str) -> Binding {
    Binding { key, with: Modifiers::SHIFT, command, words }
}

const fn edits(key: Key, command: EditCommand, words: &'static str) -> Binding {
    on(key, Command::Edit(command), words)
}

const fn with_control(key: Key, command: EditCommand, words: &'static str) -> Binding {
    Binding { key, with: Modifiers::COMMAND, command: Command::Edit(command), words }
}

impl Binding {
    /// A question mark needs shift on some keyboards and not on others; everywhere else what is held makes another key.
    fn is_pressed_by(&self, event: &Event) -> bool {
        let Event::Key { key, pressed: true, modifiers, .. } = event else { return false };
        *key == self.key && modifiers.shift == self.with.shift && modifiers.command == self.with.command
    }

    /// As it is listed.
    pub(super) fn label(&self) -> String {
        let held = [(self.with.command, "Ctrl "), (self.with.shift, "Shift ")];
        let held: String = held.into_iter().filter(|(is_held, _)| *is_held).map(|(_, word)| word).collect();
        let key = match self.key {
            // Not every font has arrows.
            Key::ArrowLeft | Key::ArrowRight | Key::ArrowUp | Key::ArrowDown => self.key.name(),
            key => key.symbol_or_name(),
        };
        format!("{held}{key}")
    }
}

/// All of them, as they are listed.
pub(super) const KEYS: [Binding; 46] = [
    with_control(Key::E, EditCommand::Toggle, "edit the beads of this exposure, or stop"),
    on(Key::T, Command::Note, "write a note about this exposure"),
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

/// A step with an arrow, px of the frame, and a fine one.
const STEP_PX: f64 = 1.0;
const FINE_PX: f64 = 0.1;

/// Those that hold while beads are edited, before all others.
pub(super) const EDIT_KEYS: [Binding; 24] = [
    edits(Key::N, EditCommand::Next(1), "choose the next bead or shadow"),
    shifted(Key::N, Command::Edit(EditCommand::Next(-1)), "choose the one before"),
    edits(Key::A, EditCommand::Add, "add the nearest free bead under the cursor"),
    edits(Key::Delete, EditCommand::Drop, "what is chosen is no bead"),
    edits(Key::Backspace, EditCommand::Drop, "what is chosen is no bead"),
    edits(Key::Num1, EditCommand::Name(0), "name it as the first that is listed"),
    edits(Key::Num2, EditCommand::Name(1), "the second"),
    edits(Key::Num3, EditCommand::Name(2), "the third"),
    edits(Key::Num4, EditCommand::Name(3), "the fourth"),
    edits(Key::Num5, EditCommand::Name(4), "the fifth"),
    edits(Key::Num6, EditCommand::Name(5), "the sixth"),
    edits(Key::Num7, EditCommand::Name(6), "the seventh"),
    edits(Key::Num8, EditCommand::Name(7), "the eighth"),
    edits(Key::Num9, EditCommand::Name(8), "the ninth"),
    edits(Key::ArrowLeft, EditCommand::Nudge([-STEP_PX, 0.0]), "move it a pixel left"),
    edits(Key::ArrowRight, EditCommand::Nudge([STEP_PX, 0.0]), "right"),
    edits(Key::ArrowUp, EditCommand::Nudge([0.0, -STEP_PX]), "up"),
    edits(Key::ArrowDown, EditCommand::Nudge([0.0, STEP_PX]), "down"),
    shifted(Key::ArrowLeft, Command::Edit(EditCommand::Nudge([-FINE_PX, 0.0])), "a tenth of a pixel left"),
    shifted(Key::ArrowRight, Command::Edit(EditCommand::Nudge([FINE_PX, 0.0])), "right"),
    shifted(Key::ArrowUp, Command::Edit(EditCommand::Nudge([0.0, -FINE_PX])), "up"),
    shifted(Key::ArrowDown, Command::Edit(EditCommand::Nudge([0.0, FINE_PX])), "down"),
    edits(Key::Enter, EditCommand::Put, "put it where it was moved to"),
    edits(Key::Escape, EditCommand::Leave, "stop editing"),
];

/// As it is in every program.
const UNDO: Binding = with_control(Key::Z, EditCommand::Undo, "take the latest edit of this exposure back");

/// Does what the keys pressed since the last look ask for.
pub(super) fn obey(ui: &Ui, board: &BoardState, state: &mut ViewState) {
    // They are letters of a note.
    if state.note.is_some() {
        return;
    }
    let edits = state.editing.is_on();
    let of_edits = EDIT_KEYS.iter().chain([&UNDO]).filter(|_| edits);
    for binding in of_edits.chain(&KEYS) {
        let pressed = ui.input_mut(|input| {
            let before = input.events.len();
            input.events.retain(|event| !binding.is_pressed_by(event));
            input.events.len() < before
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
        Command::Edit(EditCommand::Leave) if state.shows_keys => state.shows_keys = false,
        Command::Edit(edit) => state.edit(edit, board),
        Command::Note => state.begin_note(board),
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

/// The list, over everything; without what only a session that goes on takes where it is not `editable`.
pub(super) fn show(ui: &mut Ui, state: &ViewState, editable: bool) {
    if !state.shows_keys {
        return;
    }
    egui::Window::new("Keys").anchor(Align2::CENTER_CENTER, [0.0, 0.0]).collapsible(false).resizable(false).show(ui.ctx(), |ui| {
        let groups = GROUPS.iter().filter(|group| editable || **group != "edit");
        let of = |group: &str| KEYS.iter().filter(|binding| binding.command.group() == group).collect::<Vec<_>>();
        list(ui, "keys", groups.map(|&group| (group, of(group))));
        if editable {
            ui.label(RichText::new("While beads are edited, before all others:").size(BODY).color(TEXT));
            list(ui, "keys of edits", [("", EDIT_KEYS.iter().chain([&UNDO]).collect())]);
            let edit = "Mouse while beads are edited, in the acquired picture and the overlay: a click chooses, dragging a bead or a shadow moves it";
            ui.label(RichText::new(edit).size(BODY).color(DIM));
        }
        let mouse = "Mouse in a picture: wheel zooms, drag moves, right drag sets gray levels (up and down, left and right), double click shows the whole frame";
        ui.label(RichText::new(mouse).size(BODY).color(DIM));
    });
}

/// Three keys a row, each group in rows of its own behind its name.
fn list<'a>(ui: &mut Ui, name: &str, groups: impl IntoIterator<Item = (&'static str, Vec<&'a Binding>)>) {
    egui::Grid::new(name).num_columns(7).spacing([14.0, 3.0]).show(ui, |ui| {
        for (group, bindings) in groups {
            for (row, three) in bindings.chunks(3).enumerate() {
                ui.label(RichText::new(if row == 0 { group } else { "" }).size(BODY).color(TEXT));
                for binding in three {
                    ui.label(RichText::new(binding.label()).size(BODY).color(TEXT));
                    ui.label(RichText::new(binding.words).size(BODY).color(DIM));
                }
                ui.end_row();
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_key_does_two_things_and_each_does_what_it_says() {
        let of_edits: Vec<&Binding> = EDIT_KEYS.iter().chain([&UNDO]).collect();
        for table in [KEYS.iter().collect::<Vec<_>>(), of_edits] {
            let keys: std::collections::BTreeSet<String> = table.iter().map(|binding| binding.label()).collect();
            assert_eq!(keys.len(), table.len());
        }
        assert!(KEYS.iter().all(|binding| GROUPS.contains(&binding.command.group())), "every key is listed");
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

    #[test]
    fn the_documentation_names_every_key_with_what_it_does_and_no_other() {
        let page = include_str!("../../docs/window.md");
        let rows: Vec<&str> = page.lines().filter(|line| line.starts_with("| `")).collect();
        let bindings: Vec<&Binding> = KEYS.iter().chain(&EDIT_KEYS).chain([&UNDO]).collect();
        for binding in &bindings {
            let key = format!("`{}`", binding.label());
            let is_named = rows.iter().any(|row| row.contains(&key) && row.contains(binding.words));
            assert!(is_named, "docs/window.md has no row of {key}: {}", binding.words);
        }
        let mut named = 0;
        for key in rows.iter().flat_map(|row| row.split('|').nth(1).unwrap_or_default().split('`').skip(1).step_by(2)) {
            assert!(bindings.iter().any(|binding| binding.label() == key), "docs/window.md has {key}, which does nothing");
            named += 1;
        }
        assert!(named >= bindings.len(), "{named} keys in {} rows", rows.len());
    }
}

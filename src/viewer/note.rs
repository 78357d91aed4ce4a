//! A note about an exposure, while it is written.

use eframe::egui::{Id, Key, RichText, TextEdit, Ui};

use super::theme::{CAUTION, SMALL};
use crate::session::edit::MOST_NOTE;

/// See the module.
#[derive(Debug)]
pub(super) struct NoteField {
    number: u32,
    before: String,
    words: String,
    has_focus: bool,
}

/// What came of a look at it.
pub(super) enum Written {
    /// It is still written.
    Open,
    /// The frame's number and its note; nothing where it is what it was.
    Done(Option<(u32, String)>),
}

impl NoteField {
    /// Of a frame, with what was noted before.
    pub(super) fn of(number: u32, before: Option<&str>) -> Self {
        let before = before.unwrap_or_default().to_owned();
        Self { number, words: before.clone(), before, has_focus: false }
    }

    /// Draws it. Who looks elsewhere has done with it, and what was written stays.
    pub(super) fn show(&mut self, ui: &mut Ui) -> Written {
        let what = format!("note on frame {} (Enter keeps it, Esc does not)", self.number);
        ui.label(RichText::new(what).size(SMALL).color(CAUTION));
        // Of its own: what else is drawn must not take the focus away, nor another frame's note come back by undo.
        let field = TextEdit::singleline(&mut self.words).id(Id::unique(("note", self.number)));
        let response = ui.add(field.char_limit(MOST_NOTE).desired_width(f32::INFINITY));
        if !std::mem::replace(&mut self.has_focus, true) {
            response.request_focus();
        }
        let (left, kept) = ui.input(|input| (input.key_pressed(Key::Escape), input.key_pressed(Key::Enter)));
        if left {
            Written::Done(None)
        } else if kept || response.lost_focus() {
            let has_changed = self.words.trim() != self.before;
            Written::Done(has_changed.then(|| (self.number, self.words.trim().to_owned())))
        } else {
            Written::Open
        }
    }
}

//! Edits of a frame's beads: what a person asks for in the window, what a log keeps of it, and what a frame's edits come to. And what a person
//! notes of a frame, in words of his own, which change nothing that is computed.

use std::collections::BTreeMap;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::pose::{HandMark, HandSays};
use crate::reporter::printable;

/// Edits of beads, as they were asked for: [`EditRecord`].
pub(super) const EDIT_TOPIC: &str = "/session/edits";
/// What a person noted of frames: [`NoteRecord`]. Words of his own may hold anybody's name, so they stand here and nowhere else in a log.
pub(super) const NOTE_TOPIC: &str = "/session/notes";

/// Longest note, characters.
pub const MOST_NOTE: usize = 200;

/// Marks closer together than this are of one place, px.
const SAME_PX: f64 = 2.0;

/// One edit. Places are the frame's continuous pixels, as it was acquired.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum BeadEdit {
    /// The bead's centre is here: it was moved, or added.
    Put {
        /// Its name in the layout.
        bead: String,
        /// Its centre.
        image_px: DVec2,
    },
    /// The shadow here, or the bead that a hand put here, is this bead's.
    Name {
        /// Its name in the layout.
        bead: String,
        /// In the shadow.
        image_px: DVec2,
    },
    /// The shadow here is no bead's.
    Drop {
        /// In the shadow.
        image_px: DVec2,
    },
    /// Takes back the latest edit of the frame that is not taken back yet.
    Undo,
    /// Changes no bead: what a person notes of the frame, in place of what was noted before. A log keeps it apart.
    #[serde(skip)]
    Note {
        /// Without words the note before is taken back.
        words: String,
    },
}

impl BeadEdit {
    /// The place that it names.
    #[must_use]
    pub fn image_px(&self) -> Option<DVec2> {
        match self {
            Self::Put { image_px, .. } | Self::Name { image_px, .. } | Self::Drop { image_px } => Some(*image_px),
            Self::Undo | Self::Note { .. } => None,
        }
    }

    /// The bead that it names.
    #[must_use]
    pub fn bead(&self) -> Option<&str> {
        match self {
            Self::Put { bead, .. } | Self::Name { bead, .. } => Some(bead),
            Self::Drop { .. } | Self::Undo | Self::Note { .. } => None,
        }
    }

    /// Whether it is words.
    #[must_use]
    pub fn is_note(&self) -> bool {
        matches!(self, Self::Note { .. })
    }

    /// Whether its place is one.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.image_px().is_none_or(|at| at.is_finite())
    }
}

/// An edit on its way from the window to the session.
#[derive(Clone, Debug, PartialEq)]
pub struct EditRequest {
    /// The frame's number of arrival.
    pub number: u32,
    /// What is asked.
    pub edit: BeadEdit,
}

/// What a log keeps of an edit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct EditRecord {
    /// The frame's number of arrival.
    pub number: u32,
    /// When it was asked for, host time.
    pub host_us: i64,
    /// What was asked for.
    pub edit: BeadEdit,
}

/// What a log keeps of a note.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NoteRecord {
    /// The frame's number of arrival.
    pub number: u32,
    /// When it was written, host time.
    pub host_us: i64,
    /// The words; none take back what was noted before.
    pub words: String,
}

/// Takes a note among those of other frames.
pub(super) fn take_note(notes: &mut BTreeMap<u32, String>, number: u32, words: &str) {
    // A log may be anybody's: nothing that a terminal obeys, one line, no more than the window takes.
    let one_line = words.trim().replace(['\n', '\t'], " ");
    let words: String = printable(&one_line).chars().take(MOST_NOTE).collect();
    if words.is_empty() {
        notes.remove(&number);
    } else {
        notes.insert(number, words);
    }
}

/// What `edits`, in their order and without those that were taken back, say of a frame: of no bead twice, and of no place.
pub(super) fn marks_of(edits: &[BeadEdit]) -> Vec<HandMark> {
    let mut marks: Vec<HandMark> = Vec::new();
    for edit in edits {
        let Some(image_px) = edit.image_px() else { continue };
        let here = marks.iter().position(|mark| mark.image_px.distance(image_px) <= SAME_PX);
        let before = here.map(|here| marks.remove(here));
        if let Some(bead) = edit.bead() {
            marks.retain(|mark| mark.bead() != Some(bead));
        }
        let of_hand = before.filter(|mark| matches!(mark.says, HandSays::Put(_))).map(|mark| mark.image_px);
        marks.push(match (edit, of_hand) {
            (BeadEdit::Put { bead, .. }, _) => HandMark { image_px, says: HandSays::Put(bead.clone()) },
            // What a hand put stays where it was put, under its new name.
            (BeadEdit::Name { bead, .. }, Some(at)) => HandMark { image_px: at, says: HandSays::Put(bead.clone()) },
            (BeadEdit::Name { bead, .. }, None) => HandMark { image_px, says: HandSays::Named(bead.clone()) },
            (BeadEdit::Drop { .. } | BeadEdit::Undo | BeadEdit::Note { .. }, _) => HandMark { image_px, says: HandSays::NoBead },
        });
    }
    marks
}

/// What is said of a frame that was posed before: `development` times, by itself or as a hand `edited` it.
#[must_use]
pub fn again(edited: bool, development: u32) -> &'static str {
    match (edited, development) {
        (true, _) => ", edited by hand",
        (false, 0) => "",
        (false, _) => ", posed again",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn put(bead: &str, u: f64) -> BeadEdit {
        BeadEdit::Put { bead: bead.to_owned(), image_px: DVec2::new(u, 50.0) }
    }

    fn name(bead: &str, u: f64) -> BeadEdit {
        BeadEdit::Name { bead: bead.to_owned(), image_px: DVec2::new(u, 50.0) }
    }

    #[test]
    fn later_edits_replace_what_was_said_of_the_same_bead_and_of_the_same_place() {
        let told = |edits: &[BeadEdit]| -> Vec<(f64, HandSays)> {
            marks_of(edits).into_iter().map(|mark| (mark.image_px.x, mark.says)).collect()
        };
        let (is_put, is_named) = (|bead: &str| HandSays::Put(bead.to_owned()), |bead: &str| HandSays::Named(bead.to_owned()));
        assert_eq!(told(&[put("B1", 10.0), put("B1", 40.0)]), [(40.0, is_put("B1"))]);
        assert_eq!(told(&[name("B1", 10.0), name("B1", 40.0)]), [(40.0, is_named("B1"))]);
        assert_eq!(told(&[put("B1", 10.0), name("B2", 10.5)]), [(10.0, is_put("B2"))], "the hand's own place stays");
        assert_eq!(told(&[name("B1", 10.0), name("B2", 10.5)]), [(10.5, is_named("B2"))]);
        let dropped = BeadEdit::Drop { image_px: DVec2::new(11.0, 50.0) };
        assert_eq!(told(&[put("B1", 10.0), name("B2", 90.0), dropped]), [(90.0, is_named("B2")), (11.0, HandSays::NoBead)]);
    }

    #[test]
    fn a_logged_edit_comes_back_bit_for_bit_and_an_unknown_one_is_an_error() {
        for edit in [put("B 1", 310.1 + 0.2), name("B2", 1e-9), BeadEdit::Drop { image_px: DVec2::ONE }, BeadEdit::Undo] {
            let record = EditRecord { number: 3, host_us: 17, edit };
            let text = serde_json::to_string(&record).expect("JSON");
            assert_eq!(serde_json::from_str::<EditRecord>(&text).expect("an edit"), record, "{text}");
        }
        let unknown = r#"{"number": 1, "host_us": 2, "edit": {"turn": {"bead": "B1", "image_px": [1, 2]}}}"#;
        assert!(serde_json::from_str::<EditRecord>(unknown).is_err());
        assert!(!put("B1", f64::NAN).is_finite() && BeadEdit::Undo.is_finite());
    }
}

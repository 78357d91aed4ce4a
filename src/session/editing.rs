//! Frames whose beads may be edited: what their poses rest on, and the edits of each. An edited pose is made of what the automatic one was
//! made of, and changes nothing for other frames: where the specimen lies in the room rests on what frames say by themselves.

use std::collections::BTreeMap;

use super::basis::Basis;
use super::edit::{BeadEdit, marks_of};
use super::posed::Posed;
use crate::pose::{HandMark, Refusal};
use crate::time::{StageTimes, Stopwatch};

/// Pictures of frames that may be edited, the latest ones, up to this much.
const MOST_BYTES: usize = 128 << 20;

/// A frame and its edits.
struct Editable {
    basis: Basis,
    automatic: Posed,
    edits: Vec<BeadEdit>,
}

/// See the module; empty where nobody edits.
#[derive(Default)]
pub(super) struct Editing {
    keeps: bool,
    frames: BTreeMap<u32, Editable>,
}

impl Editing {
    /// From now on frames may be edited.
    pub(super) fn begin(&mut self) {
        self.keeps = true;
    }

    /// Whether frames are kept for it.
    pub(super) fn keeps(&self) -> bool {
        self.keeps
    }

    /// A frame is posed anew, upon other things than its edits were: how many of those are lost.
    pub(super) fn forget(&mut self, number: u32) -> usize {
        self.frames.remove(&number).map_or(0, |editable| editable.edits.len())
    }

    /// Keeps a frame with its pose; the pictures of the oldest are let go where there are too many.
    pub(super) fn keep(&mut self, basis: Basis, automatic: Posed) {
        self.frames.insert(automatic.number, Editable { basis, automatic, edits: Vec::new() });
        let mut kept_bytes = 0;
        self.frames = std::mem::take(&mut self.frames)
            .into_iter()
            .rev()
            .filter(|(_, editable)| {
                kept_bytes += size_of_val(editable.automatic.frame.pixels.pixels.as_slice());
                kept_bytes <= MOST_BYTES
            })
            .collect();
    }

    /// Takes an edit of a frame that was posed `development` times before.
    ///
    /// # Errors
    /// In words, when the frame is not there any more, or the edit cannot be made.
    pub(super) fn edit(&mut self, number: u32, edit: &BeadEdit, development: u32) -> Result<EditJob, String> {
        let gone = || "it has no pose yet, or was let go for newer ones".to_owned();
        let editable = self.frames.get_mut(&number).ok_or_else(gone)?;
        if !edit.is_finite() {
            return Err("its place is none".to_owned());
        }
        if let Some(bead) = edit.bead()
            && !editable.basis.knows(bead)
        {
            return Err(format!("the layout has no bead called {bead:?} on which a pose may rest"));
        }
        match edit {
            BeadEdit::Undo => _ = editable.edits.pop().ok_or("nothing is left to take back")?,
            edit => editable.edits.push(edit.clone()),
        }
        let (basis, automatic) = (editable.basis.clone(), Box::new(editable.automatic.clone()));
        Ok(EditJob { basis, automatic, marks: marks_of(&editable.edits), development })
    }
}

/// An edited frame to be posed again; it may run on any thread.
#[derive(Clone, Debug)]
pub struct EditJob {
    basis: Basis,
    automatic: Box<Posed>,
    marks: Vec<HandMark>,
    development: u32,
}

impl EditJob {
    /// Which frame.
    #[must_use]
    pub fn number(&self) -> u32 {
        self.automatic.number
    }

    /// Solves and judges the pose; without edits that are left it is the automatic one, byte for byte.
    #[must_use]
    pub fn run(self) -> Posed {
        let Self { basis, automatic, marks, development } = self;
        let posed = Posed { development, ..*automatic };
        if marks.is_empty() {
            return posed;
        }
        let watch = Stopwatch::start();
        let pose = basis.edited(&marks, &posed);
        let mut stages = StageTimes::default();
        stages.add("edit", watch.ms());
        basis.posed_by(pose, Posed { stages, ..posed })
    }

    /// A refusal in place of a result: running it failed.
    #[must_use]
    pub fn failed(self, reason: &str) -> Posed {
        let Self { basis, automatic, development, .. } = self;
        let pose = automatic.pose.clone().refused_for(Refusal::Fault { detail: reason.to_owned() });
        basis.posed_by(pose, Posed { development, ..*automatic })
    }
}

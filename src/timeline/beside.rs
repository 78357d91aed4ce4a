//! Frames of another console in the same folder, told by their study. Where the frame of one study has an exposure, and one of another study,
//! of which no frame has any, came after the same exposure and claims it too, that study is another room's: its counter, its stamps and its
//! arrivals say nothing of this arm, and would only make what its own console says ambiguous.
//!
//! A console that begins a new study goes on with exposures that have no frame yet, and is not left out by that.

use std::collections::{BTreeMap, BTreeSet};

use super::evidence::Binding;
use super::known::{Known, MINUTE_US, Pending};

/// The studies of frames, and those that are left out.
#[derive(Clone, Debug, Default)]
pub(super) struct Beside {
    of: BTreeMap<u32, String>,
    out: BTreeSet<String>,
}

impl Beside {
    /// Takes the study of a frame.
    pub(super) fn note(&mut self, frame: u32, study: &str) {
        self.of.insert(frame, study.to_owned());
    }

    /// Whether the frame is of a study that is left out.
    pub(super) fn is_out(&self, frame: u32) -> bool {
        self.of.get(&frame).is_some_and(|study| self.out.contains(study))
    }

    /// The study of `frame`, where that of `other` is known to be another one.
    pub(super) fn other_study(&self, frame: u32, other: u32) -> Option<&str> {
        let (study, its) = (self.of.get(&frame)?, self.of.get(&other)?);
        (study != its).then_some(study.as_str())
    }

    /// The frames of a study, in order of arrival.
    pub(super) fn frames_of(&self, study: &str) -> Vec<u32> {
        self.of.iter().filter(|(_, its)| *its == study).map(|(frame, _)| *frame).collect()
    }

    /// Frames of the study take no part from now on.
    pub(super) fn leave_out(&mut self, study: String) {
        self.out.insert(study);
    }
}

/// What a frame has that takes no part.
pub(super) fn left_out() -> Binding {
    let words = "it is of another study than the frames that have exposures, and that study claimed an exposure of theirs: another console's, \
                 it takes no part";
    Binding { evidence: vec![words.to_owned()], settled: true, ..Binding::default() }
}

impl Known {
    /// Takes back all that an unbound frame has said.
    pub(super) fn forget(&mut self, frame: u32) -> Option<Pending> {
        let pending = self.frames.remove(&frame)?;
        self.open.remove(&frame);
        self.voters.retain(|voter| *voter != frame);
        self.counting.settled(frame);
        for at in pending.prompt.iter().flatten().copied() {
            let shot = self.shots.get_mut(at);
            shot.prompt_frames = shot.prompt_frames.saturating_sub(1);
        }
        let said = &pending.evidence;
        if said.arrival_us.is_some() && pending.prompt.as_ref().is_some_and(Vec::is_empty) {
            self.strays = self.strays.saturating_sub(1);
        }
        if let Some(counter) = said.counter {
            self.counting.unsee(counter);
        }
        if let Some(console_us) = said.console_us {
            if let Some(frames) = self.by_stamp.get_mut(&console_us) {
                frames.retain(|other| *other != frame);
                if frames.is_empty() {
                    self.by_stamp.remove(&console_us);
                }
            }
            let stamps = if console_us.rem_euclid(MINUTE_US) == 0 { &mut self.whole_minutes } else { &mut self.other_stamps };
            *stamps = stamps.saturating_sub(1);
        }
        Some(pending)
    }
}

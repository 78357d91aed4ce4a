//! What a session has lost, and what was never matched, as its engine knows it.

use std::collections::BTreeSet;

use super::super::losses::{Untied, all_shown, few_bound, line_losses, of_no_exposure, without_frame};
use super::Engine;
use super::counted_on::is_no_exposure;
use crate::telemetry::{DeviceKind, NO_EXPOSURES};
use crate::timeline::BindingFlag;

impl Engine {
    /// What the lines have lost, a sentence each.
    #[must_use]
    pub fn line_losses(&self) -> Vec<String> {
        let packets = self.links.values().filter_map(line_losses);
        let no_time = self.timeline.summaries().into_iter().filter(|track| track.no_time > 0).map(|track| {
            let (device, count) = (track.device, track.no_time);
            format!("{device}: {count} packets whose device time is none, 285 years and more from that of the first")
        });
        let stands_for_another =
            |number| self.binder.binding(number).is_some_and(|binding| binding.flags.iter().any(is_no_exposure));
        packets.chain(no_time).chain(self.hearing.losses(self.ended_us.unwrap_or(self.now_us), stands_for_another)).collect()
    }

    /// Whether frames are expected to give poses by beads or tags.
    #[must_use]
    pub fn seeks_beads(&self) -> bool {
        self.layout.is_some() || self.tags.is_some()
    }

    /// Exposures without a frame, frames of no exposure, and frames that count on without the C-arm, each with the kind of warning that it is.
    pub fn unmatched(&self) -> impl Iterator<Item = (&'static str, String)> {
        let all = [
            ("exposures without a frame", self.exposures_without_frame()),
            ("frames of no exposure", self.frames_of_no_exposure()),
            ("C-arm counter", self.frames_that_count_on()),
        ];
        all.into_iter().filter_map(|(kind, words)| Some((kind, words?)))
    }

    /// Exposures that telemetry tells of and no frame came of, in words.
    #[must_use]
    pub fn exposures_without_frame(&self) -> Option<String> {
        without_frame(&self.timeline.exposures(), &self.shown, self.untied().all())
    }

    /// Frames that are bound to none of the exposures, each of which has its frame, in words.
    #[must_use]
    pub fn frames_of_no_exposure(&self) -> Option<String> {
        of_no_exposure(all_shown(&self.timeline.exposures(), &self.shown), self.untied())
    }

    /// Where no more frames were tied to exposures than were not, in words: the session has lost what telemetry knew of them.
    #[must_use]
    pub fn hardly_bound(&self) -> Option<String> {
        let (exposures, untied) = (self.timeline.exposures(), self.untied());
        // Where each exposure has its frame, nothing is lost with a second picture of it, nor with those of another study.
        let second = if all_shown(&exposures, &self.shown) { untied.second } else { 0 };
        let tells_of_none = self.setup.adapters.unknowns().iter().any(|(kind, _)| *kind == NO_EXPOSURES);
        let heard = self.timeline.carm().newest().is_some() && !tells_of_none;
        few_bound(exposures.len(), untied.all() - second - untied.of_another_study, self.tied.len(), heard)
    }

    /// Frames that may be of an exposure and are bound to none: no copies, and no pictures that were taken back.
    fn untied(&self) -> Untied {
        let end_us = self.ended_us.unwrap_or(self.now_us);
        let counted_on = self.counted_on().map(|counted_on| counted_on.frames).unwrap_or_default();
        let strangers = self.strangers();
        let mut untied = Untied::default();
        for number in self.unbound.keys() {
            let binding = self.binder.binding(*number);
            if binding.is_some_and(|binding| binding.flags.iter().any(is_no_exposure)) {
                continue;
            }
            if strangers.contains(number) {
                untied.of_another_study += 1;
            } else if binding
                .is_some_and(|binding| binding.flags.iter().any(|flag| matches!(flag, BindingFlag::SecondPicture { .. })))
            {
                untied.second += 1;
            } else if self.hearing.came_unheard(*number, DeviceKind::Carm, end_us) {
                untied.unheard += 1;
            } else if counted_on.iter().any(|(frame, _)| frame == number) {
                untied.counted_on += 1;
            } else {
                untied.other += 1;
            }
        }
        untied
    }

    /// Unbound frames that are certainly of another study than the session's: each exposure has its frame, none of their study has one, and the
    /// C-arm was heard when they came and told of the exposure of a later frame, so that it missed none of theirs.
    fn strangers(&self) -> BTreeSet<u32> {
        let latest = self.tied.last().copied().filter(|_| all_shown(&self.timeline.exposures(), &self.shown));
        let end_us = self.ended_us.unwrap_or(self.now_us);
        let came_between = |number: &u32| {
            latest.is_some_and(|latest| *number < latest) && !self.hearing.came_unheard(*number, DeviceKind::Carm, end_us)
        };
        self.studies.strangers(self.tied.iter().copied(), self.unbound.keys().copied().filter(came_between))
    }
}

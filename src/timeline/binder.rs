//! Frames to exposures, whichever console they come from.
//!
//! A folder may get frames of another console, or of another day, as well: what its clock, its counter and its arrivals say would spoil what those
//! of the session's own say. Which is which nobody knows beforehand, and one console writes two studies where somebody begins a new one. So all
//! frames are bound together, as of one console, and those of each study are looked at by themselves beside that. Where so many of a study fit
//! exposures, each by itself, that it is no accident ([`super::accident`]), frames that together have none get the exposures that they have alone:
//! as if the other studies were absent. No study is left out, none goes before another: what two of them claim alone neither gets, and what all
//! together say stays.
//!
//! Pure: no clock, no disk. The same calls give the same answers, live and in a replay.

use std::collections::{BTreeMap, BTreeSet};

use super::Timeline;
use super::console::ConsoleClock;
use super::console_binder::ConsoleBinder;
use super::evidence::{Binding, FrameEvidence};
use super::known::Pending;

/// Fewer frames than this are no study that could be believed by itself.
const LEAST: usize = 6;
/// Why a frame has the exposure that it has not among all.
const ALONE: &str = "by the frames of its own study alone, of which so many fit exposures that it is no accident; those of other studies are another \
                     console's, or of another time";

/// Binds frames to the exposures of a [`Timeline`].
#[derive(Clone, Debug, Default)]
pub struct Binder {
    /// All frames, as of one console.
    together: ConsoleBinder,
    /// Those of each study by themselves; those without one are as of one study.
    alone: BTreeMap<Option<String>, ConsoleBinder>,
    zone_min: Option<i32>,
}

impl Binder {
    /// Nothing known yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes a frame of which nobody knows the study, as [`Binder::push_of`] does.
    pub fn push(&mut self, evidence: FrameEvidence) {
        self.push_of(None, evidence);
    }

    /// Takes a frame of a study (its identifier, or the hash of that); frames are pushed in the order of their arrival, images of a run one by one.
    pub fn push_of(&mut self, study: Option<&str>, evidence: FrameEvidence) {
        let alone = self.alone.entry(study.map(str::to_owned)).or_default();
        alone.note_zone(self.zone_min);
        alone.push(evidence.clone());
        self.together.push(evidence);
    }

    /// Notes the time zone that stamps are in, where files state one, minutes east of UTC: what is said of the console's clock states it apart.
    pub fn note_zone(&mut self, minutes: Option<i32>) {
        self.zone_min = minutes;
        self.together.note_zone(minutes);
        self.alone.values_mut().for_each(|alone| alone.note_zone(minutes));
    }

    /// The picture of `content`, which says nothing of its exposure, came again as `frame`, which does: the first one is the copy, unless it has
    /// an exposure already.
    pub fn was_copied_by(&mut self, content: &str, frame: u32) {
        self.together.was_copied_by(content, frame);
        self.alone.values_mut().for_each(|alone| alone.was_copied_by(content, frame));
    }

    /// Looks at what `timeline` has learnt; `now_us` is the host time. Returns the frames whose binding changed.
    pub fn update(&mut self, timeline: &Timeline, now_us: i64) -> Vec<u32> {
        let changed = self.together.update(timeline, now_us);
        self.with_those_alone(timeline, changed, |alone| alone.update(timeline, now_us))
    }

    /// No more telemetry will come: judges every frame with what there is.
    pub fn finish(&mut self, timeline: &Timeline) -> Vec<u32> {
        let changed = self.together.finish(timeline);
        self.with_those_alone(timeline, changed, |alone| alone.finish(timeline))
    }

    /// A frame's binding as it stands.
    #[must_use]
    pub fn binding(&self, frame: u32) -> Option<&Binding> {
        self.together.binding(frame)
    }

    /// The console's clock, once frames agree on it: of two, that which more frames confirm.
    #[must_use]
    pub fn clock(&self) -> Option<ConsoleClock> {
        let alone = self.believed().into_iter().filter_map(ConsoleBinder::clock);
        alone.chain(self.together.clock()).max_by_key(|clock| clock.frames)
    }

    /// Judges the studies by themselves (`judge`: the frames that changed there), and gives frames that together have no exposure those that they
    /// have there. Returns the frames that changed, with those that `changed` before.
    fn with_those_alone(
        &mut self,
        timeline: &Timeline,
        changed: Vec<u32>,
        judge: impl Fn(&mut ConsoleBinder) -> Vec<u32>,
    ) -> Vec<u32> {
        if self.alone.len() < 2 {
            return changed;
        }
        let mut is_new = !changed.is_empty();
        for alone in self.alone.values_mut().filter(|alone| alone.frames() >= LEAST) {
            is_new |= !judge(alone).is_empty();
        }
        if !is_new {
            return changed;
        }
        for (frame, there) in self.claimed_by_one_alone() {
            self.together.adopt(timeline, frame, &there, ALONE);
        }
        let changed: BTreeSet<u32> = changed.into_iter().chain(self.together.take_changed()).collect();
        changed.into_iter().collect()
    }

    /// Studies of which so many frames fit exposures that it is no accident, and none another one than it has among all frames.
    fn believed(&self) -> Vec<&ConsoleBinder> {
        let several = self.alone.len() > 1;
        let is_believed = |alone: &&ConsoleBinder| {
            several && alone.frames() >= LEAST && alone.is_no_accident() && self.together.agrees_with(alone)
        };
        self.alone.values().filter(is_believed).collect()
    }

    /// Frames that together have no exposure, as one study, and no other that is believed, has tied them.
    fn claimed_by_one_alone(&self) -> Vec<(u32, Pending)> {
        let believed = self.believed();
        let mut claims: BTreeMap<u64, usize> = BTreeMap::new();
        for exposure in believed.iter().flat_map(|alone| alone.tied()).flat_map(|(_, there)| there.exposures()) {
            *claims.entry(exposure.index).or_default() += 1;
        }
        let is_sole = |there: &Pending| there.exposures().iter().all(|exposure| claims.get(&exposure.index) == Some(&1));
        let tied = believed.iter().flat_map(|alone| alone.tied());
        let given = tied.filter(|(frame, there)| self.together.is_open(*frame) && is_sole(there));
        given.map(|(frame, there)| (frame, there.clone())).collect()
    }
}

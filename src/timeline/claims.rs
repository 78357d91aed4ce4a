//! Pictures that claim one exposure, none of which came promptly after it: neither their names nor their order chooses among them.
//!
//! The counter does, then how long the header says that the exposure took. Two pictures with one stamp, or one count, are one exposure's, as it
//! came and processed: the lower checksum keeps it. Of two that nothing of this tells apart neither is bound.

use super::evidence::{BindingHow, FrameEvidence, seconds};
use super::judgement::{Judgement, Weighed, none};
use super::known::{MINUTE_US, Pending};
use super::stated_length::{Length, are_unlike, length_of};

/// Which of two pictures has the better claim.
enum Better {
    /// This one, for this reason.
    This(&'static str),
    /// The other one, for this reason.
    Other(&'static str),
    /// Nothing tells.
    Neither,
}

impl Weighed<'_> {
    /// What is made of the frame, which gets no exposure that another one has as good a claim to.
    pub(super) fn judge(&self) -> Judgement {
        match self.claim() {
            Judgement::Of { shot, how, evidence, teaches } => self.among_rivals(shot, how, evidence, teaches),
            judgement => judgement,
        }
    }

    fn among_rivals(&self, at: usize, how: BindingHow, mut evidence: Vec<String>, teaches: bool) -> Judgement {
        for (rival, rival_how) in self.rivals(at) {
            let (frame, label) = (rival.frame, self.label(at));
            match self.better(at, how, rival, rival_how) {
                Better::This(reason) => evidence.insert(0, format!("frame {frame} fits {label} as well, but {reason}")),
                Better::Other(reason) => {
                    evidence.push(format!("frame {frame} fits {label} as well, and {reason}"));
                    return none(evidence);
                }
                Better::Neither => {
                    evidence.push(format!("frame {frame} fits {label} as well: ambiguous"));
                    return none(evidence);
                }
            }
        }
        Judgement::Of { shot: at, how, evidence, teaches }
    }

    /// Other pictures that wait and would be given the exposure at `at`, and what ties each. None where this one came promptly after it, and none
    /// that did: then the arrival tells.
    fn rivals(&self, at: usize) -> Vec<(&FrameEvidence, BindingHow)> {
        let came_apart = |pending: &Pending| pending.prompt.as_ref().is_some_and(|prompt| !prompt.contains(&at));
        let said = &self.pending.evidence;
        let console_us = said.console_us.filter(|_| came_apart(self.pending));
        let Some((console_us, stamp)) = console_us.and_then(|us| Some((us, self.by_stamp()?))) else { return Vec::new() };
        let shot = self.known.shots.get(at);
        let beam_us = shot.end_us.saturating_sub(shot.start_us);
        let wide_us = stamp.to_us.saturating_sub(stamp.from_us).saturating_add(beam_us);
        // The other stamp may be of a whole minute.
        let reach_us = wide_us.saturating_add(MINUTE_US).max(0);
        let near = self.known.by_stamp.range(console_us.saturating_sub(reach_us)..=console_us.saturating_add(reach_us));
        let waiting = near.flat_map(|(_, frames)| frames).filter(|frame| self.known.open.contains(frame));
        let others = waiting.filter_map(|frame| self.known.frames.get(frame));
        others
            .filter_map(|pending| {
                if pending.evidence.frame == said.frame || !came_apart(pending) {
                    return None;
                }
                let Self { known, timeline, newest_us, now_us, .. } = *self;
                let other = Weighed { known, timeline, newest_us, now_us, pending };
                other.by_stamp().filter(|stamp| stamp.fitting.contains(&at))?;
                match other.claim() {
                    Judgement::Of { shot, how, .. } if shot == at => Some((&pending.evidence, how)),
                    _ => None,
                }
            })
            .collect()
    }

    fn better(&self, at: usize, how: BindingHow, other: &FrameEvidence, other_how: BindingHow) -> Better {
        let said = &self.pending.evidence;
        let by_count = [how, other_how].map(|how| how == BindingHow::Counter);
        match by_count {
            [true, false] => return Better::This("its counter does not name it"),
            [false, true] => return Better::Other("its counter names it"),
            _ => {}
        }
        match [said, other].map(|said| self.length(at, said)) {
            [Length::Alike, Length::Unlike] => return Better::This("its header states another length of the exposure"),
            [Length::Unlike, Length::Alike] => return Better::Other("its header states the length of the exposure"),
            _ => {}
        }
        // A whole minute holds more than one picture, and what is counted apart may be of two exposures.
        let is_fine = self.known.resolution_us(said) < MINUTE_US;
        let counted_apart = said.counter.zip(other.counter).is_some_and(|(own, other)| own != other);
        let one_stamp = said.console_us == other.console_us && is_fine && !counted_apart;
        let one_count = by_count == [true; 2] && said.counter == other.counter;
        let two_lengths = said.stated_length_us.zip(other.stated_length_us).is_some_and(|(own, other)| are_unlike(own, other));
        if !(one_stamp || one_count) || two_lengths {
            return Better::Neither;
        }
        match said.content < other.content {
            true => Better::This("is a second picture of it, with the higher checksum"),
            false => Better::Other("is the picture of it with the lower checksum"),
        }
    }

    /// What the length that the header of `said` states says of the exposure at `at`.
    fn length(&self, at: usize, said: &FrameEvidence) -> Length {
        let exposure = self.timeline.exposure(self.known.shots.get(at).index);
        exposure.map_or(Length::Untold, |exposure| length_of(said.stated_length_us, exposure))
    }

    /// Why the frame, which fits the exposure at `at` that `other` has, is no second picture of it: its header states another length, and that of the
    /// other one this length.
    pub(super) fn other_length_words(&self, at: usize, other: u32) -> Option<String> {
        let stated_us = self.pending.evidence.stated_length_us?;
        let has = &self.known.frames.get(&other)?.evidence;
        let exposure = self.timeline.exposure(self.known.shots.get(at).index)?;
        let is_other = self.length(at, &self.pending.evidence) == Length::Unlike && self.length(at, has) == Length::Alike;
        is_other.then(|| {
            let beam_us = exposure.end_us.saturating_sub(exposure.start_us);
            format!("its header states an exposure of {}, the beam was on for {}", seconds(stated_us), seconds(beam_us))
        })
    }
}

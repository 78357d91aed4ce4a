//! A file of several images whose images may be of exposures of their own: a console may store a series as one file, with one stamp.
//!
//! The times from image to image tell: a run within one exposure is as long as that, and a series has an image for each exposure, as long after
//! the first as its exposure. Where they say neither, or nothing at all, and as many exposures wait for a picture, it is not told.

use super::Timeline;
use super::evidence::{Binding, BindingHow, FrameEvidence, LONG_BEAM_US, flags_of, seconds, time_within};
use super::exposure::ExposureInterval;
use super::judgement::Judgement;
use super::known::Known;

/// A run that is longer than its exposure by a factor and this is none.
const LONGER: i64 = 2;
const LONGER_US: i64 = 1_000_000;
/// What the times from image to image may differ from those between exposures.
const BESIDE_US: i64 = 300_000;
/// Exposures farther apart are hardly of one series where nothing says so.
const SERIES_US: i64 = 60_000_000;

/// What says that it holds more is no file that was read.
const MOST_IMAGES: usize = 65_536;

/// Which exposures the images of a file are of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Images {
    /// All of the one that the file names.
    OfOne,
    /// Each of its own, the first of the one at this position.
    OfEach(usize),
    /// It is not told, and why.
    Untold(String),
}

impl Known {
    /// Of which exposures the images of a file are that names the one at `shot`.
    pub(super) fn images_of(&self, said: &FrameEvidence, shot: usize, timeline: &Timeline) -> Images {
        let count = said.image_of_file[1] as usize;
        let Some(exposure) = timeline.exposure(self.shots.get(shot).index).filter(|_| count > 1) else {
            return Images::OfOne;
        };
        // Of an exposure of which only the counter tells that is the most.
        let beam_us = exposure.end_us.saturating_sub(exposure.start_us);
        let times_us = Self::image_times_us(said, count);
        let run_us = times_us.as_ref().and_then(|times_us| times_us.last().copied());
        let came = |at: usize| said.arrival_us.is_none_or(|arrival_us| self.shots.get(at).over_us <= arrival_us);
        let waits = |at: usize| came(at) && self.shots.get(at).frame.is_none_or(|frame| frame == said.frame);
        let from = shot.saturating_sub(count - 1);
        let series = (from..=shot).filter(|first| first + count <= self.shots.len() && (*first..first + count).all(waits));
        let series: Vec<usize> = series.collect();
        let middle_us = |at: usize| {
            let shot = self.shots.get(at);
            shot.start_us.saturating_add(shot.end_us.saturating_sub(shot.start_us) / 2)
        };
        let fits = |times_us: &[i64], first: usize| {
            let off_us =
                |(image, at_us): (usize, &i64)| middle_us(first + image).saturating_sub(middle_us(first)).saturating_sub(*at_us);
            times_us.iter().enumerate().all(|image| off_us(image).saturating_abs() <= BESIDE_US)
        };
        let fitting: Vec<usize> = match &times_us {
            Some(times_us) => series.iter().copied().filter(|first| fits(times_us, *first)).collect(),
            None => Vec::new(),
        };
        // One that goes on after its beam, just as a series would, may be that.
        let outlasts = run_us.is_some_and(|us| {
            us > LONGER.saturating_mul(beam_us).saturating_add(LONGER_US)
                || us > beam_us.saturating_add(BESIDE_US) && !fitting.is_empty()
        });
        if !outlasts {
            let near = |first: &usize| middle_us(first + count - 1).saturating_sub(middle_us(*first)) <= SERIES_US;
            let is_long = exposure.samples > 0 && beam_us >= LONG_BEAM_US;
            if run_us.is_some() || is_long || !series.iter().any(near) {
                return Images::OfOne;
            }
            return Images::Untold(format!(
                "one file of {count} images came when {count} exposures waited for a picture, and it does not say how long after each other \
                 they were taken: each may be of its own exposure: ambiguous"
            ));
        }
        match fitting[..] {
            [first] if !self.hidden(first, first + count - 1, timeline) => Images::OfEach(first),
            _ => Images::Untold(format!(
                "one file of {count} images, which by its times took {}, names an exposure of {}; {} series of exposures have these times: \
                 ambiguous",
                seconds(run_us.unwrap_or_default()),
                seconds(beam_us),
                fitting.len()
            )),
        }
    }

    /// How long after the first each image of a file was taken, as far as the file says it.
    fn image_times_us(said: &FrameEvidence, count: usize) -> Option<Vec<i64>> {
        if said.image_times_us.len() == count {
            return Some(said.image_times_us.clone());
        }
        let step_us = said.frame_time_us.filter(|step_us| *step_us > 0 && count <= MOST_IMAGES)?;
        Some((0..count as i64).map(|image| step_us.saturating_mul(image)).collect())
    }

    /// The verdict for a frame that is `judged`: of a file whose images have exposures of their own, or may have, another one.
    pub(super) fn judge_images(&self, said: &FrameEvidence, judged: Judgement, timeline: &Timeline) -> Judgement {
        let (shot, how, mut evidence, teaches) = match judged {
            Judgement::Of { shot, how, evidence, teaches } => (shot, how, evidence, teaches),
            other => return other,
        };
        match self.images_of(said, shot, timeline) {
            Images::OfOne => Judgement::Of { shot, how, evidence, teaches },
            Images::OfEach(first) => {
                let count = said.image_of_file[1];
                evidence.push(format!(
                    "the {count} images of the file are as long after each other as {count} exposures: each is of its own"
                ));
                Judgement::OfEach { first, how, evidence }
            }
            Images::Untold(words) => {
                evidence.push(words);
                Judgement::None { evidence, taken_by: None }
            }
        }
    }

    /// Ties the images of a file to exposures of their own, the first of which is at `first`; the exposures.
    pub(super) fn bind_each(&mut self, frame: u32, first: usize, timeline: &Timeline) -> Option<Vec<ExposureInterval>> {
        let count = self.frames.get(&frame)?.evidence.image_of_file[1] as usize;
        let exposure = |at: usize| timeline.exposure(self.shots.get(at).index).cloned();
        let exposures: Vec<ExposureInterval> = (first..first + count).map(exposure).collect::<Option<_>>()?;
        self.open.remove(&frame);
        self.counting.settled(frame);
        for at in first..first + count {
            self.shots.get_mut(at).frame = Some(frame);
        }
        self.frames.get_mut(&frame)?.apart.clone_from(&exposures);
        Some(exposures)
    }
}

/// The binding of one image of a file whose images are of these exposures.
pub(super) fn of_its_own(
    (how, evidence): (BindingHow, &[String]),
    exposures: &[ExposureInterval],
    image: &FrameEvidence,
) -> Binding {
    let Some(exposure) = exposures.get(image.image_of_file[0] as usize).cloned() else { return Binding::default() };
    let alone = FrameEvidence { image_of_file: [0, 1], ..image.clone() };
    let span_us = [exposure.start_us, exposure.end_us];
    let (time_us, flags) = (Some(time_within(&alone, &exposure, span_us)), flags_of(&alone, &exposure, span_us));
    Binding { exposure: Some(exposure), how, evidence: evidence.to_vec(), settled: true, time_us, flags }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_of_images_that_no_file_holds_takes_no_memory() {
        let said =
            |count: u32| FrameEvidence { image_of_file: [0, count], frame_time_us: Some(40_000), ..FrameEvidence::default() };
        assert_eq!(Known::image_times_us(&said(3), 3), Some(vec![0, 40_000, 80_000]));
        assert_eq!(Known::image_times_us(&said(u32::MAX), u32::MAX as usize), None);
    }
}

//! Exposures of an arm that counts them and never says when the beam is on: the count is taken to move when it goes on, and how long it stays on
//! is what the picture's header states, or not known.

use super::Timeline;
use super::evidence::{Binding, BindingFlag, GAP_LIMIT_US, LONG_BEAM_US, MOVED_LIMITS, is_angle, seconds};
use super::stated_length::stated_us;
use super::travel::Travel;

impl Binding {
    /// When the frame was taken, from the count to the end of the beam as far as it may have been on, where only an arm's count says so; `None`
    /// for any other exposure.
    #[must_use]
    pub fn counted_span_us(&self, timeline: &Timeline) -> Option<[i64; 2]> {
        let exposure = self.exposure.as_ref()?;
        // What the counter says across a silence is as uncertain as that is long.
        let at_once = exposure.end_us.saturating_sub(exposure.start_us) <= GAP_LIMIT_US;
        if exposure.samples > 0 || !at_once || timeline.exposure_tracker().has_seen_beam() {
            return None;
        }
        let is_run = self.flags.iter().any(|flag| matches!(flag, BindingFlag::Run { .. }));
        let within_us = self.flags.iter().find_map(|flag| match flag {
            BindingFlag::Unseen { within_us } if !is_run => Some(*within_us),
            _ => None,
        })?;
        let from_us = self.time_us?.saturating_sub(within_us / 2);
        Some([from_us, from_us.saturating_add(within_us)])
    }

    /// The same with the beam's length in its time, and word of joints that moved meanwhile: `exposure_ms` is what the header of the frame, which
    /// came at `arrival_us`, states.
    #[must_use]
    pub fn with_beam_length(mut self, timeline: &Timeline, exposure_ms: Option<f64>, arrival_us: i64) -> Self {
        let Some([from_us, count_us]) = self.counted_span_us(timeline) else { return self };
        let stated_us = stated_us(exposure_ms);
        // No radiograph takes longer.
        let beam_us = stated_us.unwrap_or(LONG_BEAM_US);
        let whole_us = count_us.saturating_add(beam_us);
        // It shows nothing of what came after it.
        let to_us = if (count_us..whole_us).contains(&arrival_us) { arrival_us } else { whole_us };
        let length = match stated_us {
            Some(us) => format!("the picture's header states {}", seconds(us)),
            None => format!("nothing states its length, which may be up to {}", seconds(beam_us)),
        };
        self.evidence.push(format!("the C-arm counts and does not say when the beam is on: from the count on, {length}"));
        let within_us = to_us.saturating_sub(from_us);
        self.time_us = Some(from_us.saturating_add(within_us / 2));
        self.flags.retain(|flag| !matches!(flag, BindingFlag::Unseen { .. }));
        self.flags.push(BindingFlag::Unseen { within_us });
        self.flags.extend(moved(timeline, [from_us, to_us]));
        self
    }
}

/// Joints of the C-arm that moved farther than they may between two host times.
fn moved(timeline: &Timeline, [from_us, to_us]: [i64; 2]) -> Vec<BindingFlag> {
    let carm = timeline.carm();
    let during = carm.entries().rev().map(|entry| (carm.mapped(entry).0, entry.value.joints.to_array()));
    let during = during.skip_while(|(at_us, _)| *at_us > to_us).take_while(|(at_us, _)| *at_us >= from_us);
    let mut travel = None;
    for (_, joints) in during {
        travel.get_or_insert_with(|| Travel::of_arm(joints)).push(joints);
    }
    let range = travel.map_or([0.0; 7], |travel| travel.range());
    let far = |(i, (joint, limit)): (usize, (&'static str, f64))| {
        let moved = if is_angle(i) { range[i].to_degrees() } else { range[i] };
        // A joint without an encoder is NaN here; that it moved is not known.
        (moved > limit).then_some(BindingFlag::Moved { joint, moved, limit })
    };
    MOVED_LIMITS.into_iter().enumerate().filter_map(far).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CarmJoints;
    use crate::telemetry::{CarmSample, DeviceKind, Sample, SequenceTracker};

    /// An arm of 50 Hz that counts an exposure at 1 s while its lift goes down by so much in a second; whether it ever said that the beam is on.
    fn bound(mm_per_s: f64, says_beam: bool, exposure_ms: Option<f64>, arrival_us: i64) -> (i64, Binding) {
        let mut timeline = Timeline::new();
        let mut sequence = SequenceTracker::default();
        for n in 0..200u32 {
            let device_us = 20_000 * u64::from(n);
            let joints = CarmJoints { lift_mm: mm_per_s * 0.02 * f64::from(n), ..CarmJoints::ZERO };
            let xray_on = says_beam && (100..110).contains(&n);
            let exposure_counter = Some(u32::from(n >= 50) + u32::from(n >= 100));
            let sample = CarmSample { device_us, sequence: n, joints, xray_on, exposure_counter, ..CarmSample::UNTOLD };
            let sequenced = sequence.take(n, device_us);
            timeline.push_sample(DeviceKind::Carm, device_us as i64, 0, sequenced, Sample::Carm(sample));
        }
        let exposure = timeline.exposures().into_iter().next().expect("the count tells of it");
        assert_eq!((exposure.samples, exposure.counter), (0, Some(1)));
        let (mid_us, within_us) = (exposure.mid_us(), exposure.end_us - exposure.start_us);
        let flags = vec![BindingFlag::Unseen { within_us }];
        let binding = Binding { exposure: Some(exposure), time_us: Some(mid_us), flags, ..Binding::default() };
        (mid_us, binding.with_beam_length(&timeline, exposure_ms, arrival_us))
    }

    fn within_us(binding: &Binding) -> Option<i64> {
        binding.flags.iter().find_map(|flag| if let BindingFlag::Unseen { within_us } = flag { Some(*within_us) } else { None })
    }

    fn has_moved(binding: &Binding) -> bool {
        binding.flags.iter().any(|flag| matches!(flag, BindingFlag::Moved { joint: "lift", .. }))
    }

    /// The time of a frame was that of the count, to 0.03 s, and the middle of its beam 0.3 s later; the lift had moved meanwhile, without a word.
    #[test]
    fn the_time_of_a_counted_exposure_includes_the_length_of_its_beam() {
        let late_us = 9_000_000;
        for (exposure_ms, arrival_us, beam_us, words) in [
            (Some(400.0), late_us, 400_000, "header states 0.400 s"),
            (None, late_us, LONG_BEAM_US, "up to 1.000 s"),
            (Some(0.0), late_us, LONG_BEAM_US, "up to 1.000 s"),
            // It came 0.3 s after the count.
            (None, 1_300_000, 300_000, "up to 1.000 s"),
        ] {
            let (count_us, binding) = bound(10.0, false, exposure_ms, arrival_us);
            let middle_us = binding.time_us.expect("a time") - count_us;
            assert!((middle_us - beam_us / 2).abs() <= 20_000, "{middle_us} of {beam_us}");
            assert!(within_us(&binding).is_some_and(|us| (us - beam_us).abs() <= 40_000), "{binding:?}");
            assert!(binding.evidence.iter().any(|said| said.contains(words)) && has_moved(&binding), "{binding:?}");
        }
        let (_, still) = bound(0.0, false, Some(400.0), late_us);
        assert!(!has_moved(&still), "{still:?}");
    }

    /// Where the arm says when the beam is on, what it does not say so of was over between two samples.
    #[test]
    fn an_arm_that_says_when_the_beam_is_on_leaves_nothing_to_guess() {
        let (count_us, binding) = bound(10.0, true, Some(400.0), 9_000_000);
        assert_eq!((binding.time_us, binding.evidence.len()), (Some(count_us), 0));
        assert!(within_us(&binding).is_some_and(|us| us <= 40_000) && !has_moved(&binding), "{binding:?}");
    }
}

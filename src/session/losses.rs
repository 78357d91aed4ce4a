//! What was lost, in a sentence; counters alone do not reach anybody.

use std::collections::BTreeSet;

use crate::report::Pair;
use crate::telemetry::Link;
use crate::timeline::ExposureInterval;

/// So many exposures are named.
const NAMED: usize = 8;
/// Beams are on for a smaller share of the time between the first and the last, or fewer tell nothing of it.
const MOSTLY: f64 = 0.6;
const LEAST_EXPOSURES: usize = 3;

/// How an event of the log begins that tells of a loss which a replay cannot find out by itself: no frame came that it could miss.
const LOST: &str = "lost: ";
/// The same, where it was none after all.
const CAME: &str = "not lost after all: ";

/// An event that a replay repeats.
pub(super) fn lost(what: &str) -> String {
    format!("{LOST}{what}")
}

/// An event that takes an earlier one back.
pub(super) fn came(what: &str) -> String {
    format!("{CAME}{what}")
}

/// Sentences about what was lost, each once and in the order in which they came. What turns out not to be lost is taken back.
#[derive(Debug, Default)]
pub(super) struct Losses(Vec<(String, u32)>);

impl Losses {
    pub(super) fn add(&mut self, what: String) {
        match self.0.iter_mut().find(|(known, _)| *known == what) {
            Some((_, times)) => *times += 1,
            None => self.0.push((what, 1)),
        }
    }

    /// Whether it was there to be taken back; of two alike, one is.
    pub(super) fn take_back(&mut self, what: &str) -> bool {
        let Some(at) = self.0.iter().position(|(known, _)| known == what) else { return false };
        self.0[at].1 -= 1;
        if self.0[at].1 == 0 {
            self.0.remove(at);
        }
        true
    }

    /// Takes what an event of a log says of losses; all others say nothing.
    pub(super) fn hear(&mut self, event: &str) {
        if let Some(what) = event.strip_prefix(LOST) {
            self.add(what.to_owned());
        } else if let Some(what) = event.strip_prefix(CAME) {
            self.take_back(what);
        }
    }

    pub(super) fn sentences(&self) -> Vec<String> {
        self.0.iter().map(|(what, _)| what.clone()).collect()
    }
}

/// `None` when nothing was lost.
pub(super) fn line_losses(link: &Link) -> Option<String> {
    let (device, health, [one, all]) = (link.device(), link.health(), link.units());
    let counted = [
        (health.lost, format!("{all} lost on the line")),
        (health.missed_unplugged, format!("{all} missed while it was unplugged")),
        (health.corrupt, format!("corrupt {all}")),
        (health.wrong_device, "packets of the other device (are the ports swapped?)".to_owned()),
        (health.schema_mismatch + health.version_mismatch, "packets of another protocol (other firmware?)".to_owned()),
        (health.malformed + health.unknown_message, "packets that make no sense".to_owned()),
        (health.overlong, format!("stretches of bytes that are no {all} (another speed, or another device?)")),
    ];
    let mut words: Vec<String> =
        counted.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}")).collect();
    if health.bytes > 0 && health.frames == 0 {
        words.push(format!("{} bytes and not one {one} of it", health.bytes));
    }
    // Counters do not say what is wrong with a declaration.
    let latest = link.latest_fault().map(|fault| format!("; of the latest corrupt one: {fault}")).unwrap_or_default();
    (!words.is_empty()).then(|| format!("{device}: {}{latest}", words.join(", ")))
}

/// That the beam is on most of the time, as it is not; `None` where it is not.
fn mostly_on(exposures: &[ExposureInterval]) -> Option<String> {
    let seen = || exposures.iter().filter(|exposure| exposure.samples > 0);
    let span_us = seen().map(|exposure| exposure.end_us).max()?.saturating_sub(seen().map(|exposure| exposure.start_us).min()?);
    let on_us = seen().map(|exposure| exposure.end_us.saturating_sub(exposure.start_us)).fold(0, i64::saturating_add);
    let [on_s, span_s] = [on_us, span_us].map(|us| us as f64 * 1e-6);
    (seen().count() >= LEAST_EXPOSURES && on_s >= MOSTLY * span_s).then(|| {
        format!(
            "; by telemetry the beam is on for {on_s:.1} s of {span_s:.1} s: does its X-ray flag say the opposite (`on` and `off` exchanged)?"
        )
    })
}

/// Exposures that are not among those that frames show, and how many frames (`unbound`) may be of them; `None` where each has one.
pub(super) fn without_frame(exposures: &[ExposureInterval], shown: &BTreeSet<u64>, unbound: usize) -> Option<String> {
    let alone: Vec<String> =
        exposures.iter().filter(|exposure| !shown.contains(&exposure.index)).map(ExposureInterval::label).collect();
    let more = if alone.len() > NAMED { ", …" } else { "" };
    let named = alone.iter().take(NAMED).cloned().collect::<Vec<_>>().join(", ");
    (!alone.is_empty()).then(|| {
        let (alone, count) = (alone.len(), exposures.len());
        match unbound {
            0 => format!(
                "{alone} of {count} exposures have no frame ({named}{more}); where they were saved, export them: `sidecarm attach` ties them \
                 to the log"
            ),
            _ => format!(
                "{alone} of {count} exposures have no frame ({named}{more}), and {unbound} frames no exposure: which belongs to which is not \
                 certain, so their pairs have no joints, robot or beam of telemetry; `binding_evidence` of each pair says why{}",
                mostly_on(exposures).filter(|_| alone == count).unwrap_or_default()
            ),
        }
    })
}

/// Frames that are bound to no exposure, by what is known of why.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Untied {
    /// What they say names an exposure that has its frame.
    pub(super) second: usize,
    /// They came while nothing was heard of the C-arm.
    pub(super) unheard: usize,
    /// They count on where the C-arm's counter stood still, which is said apart.
    pub(super) counted_on: usize,
    /// They are of another study than those that have exposures, and each exposure has its frame: nothing is lost with them.
    pub(super) of_another_study: usize,
    /// Nothing that telemetry tells of fits.
    pub(super) other: usize,
}

impl Untied {
    pub(super) fn all(self) -> usize {
        self.second + self.unheard + self.counted_on + self.of_another_study + self.other
    }
}

/// Whether each of the exposures (their indices) that telemetry tells of has its frame.
pub(super) fn all_shown(exposures: &[ExposureInterval], shown: &BTreeSet<u64>) -> bool {
    !exposures.is_empty() && exposures.iter().all(|exposure| shown.contains(&exposure.index))
}

/// That frames are bound to none of the exposures that telemetry tells of, where each of those has its frame (`all_shown`).
pub(super) fn of_no_exposure(all_shown: bool, untied: Untied) -> Option<String> {
    let Untied { second, unheard, of_another_study, other, .. } = untied;
    let parts = [
        (second, "are second pictures of exposures that have their frame (processed ones beside raw ones?)"),
        (unheard, "came while nothing was heard of the C-arm: of which exposures they are is not known"),
        (of_another_study, "are of another study than those that have the exposures"),
        (other, "are of no exposure that telemetry tells of: pictures of another day or another room?"),
    ];
    let parts: Vec<String> =
        parts.iter().filter(|(count, _)| *count > 0).map(|(count, words)| format!("{count} frames {words}")).collect();
    let end = if other > 0 { "" } else { "." };
    (all_shown && !parts.is_empty()).then(|| {
        format!(
            "{}{end} Their pairs have no joints, robot or beam of telemetry; `binding_evidence` of each pair says why",
            parts.join("; ")
        )
    })
}

/// That `unbound` frames could not be tied to one of `exposures`, and no more (`bound`) could; `None` where most could. `heard`: the C-arm was, and
/// it says when the beam is on.
pub(super) fn few_bound(exposures: usize, unbound: usize, bound: usize, heard: bool) -> Option<String> {
    if exposures == 0 && unbound > 0 && heard {
        let came = if unbound == 1 { "a frame".to_owned() } else { format!("{unbound} frames") };
        return Some(format!(
            "{came} came, and the C-arm's telemetry told of no exposure: no pair has joints, robot or beam of telemetry; check its \
             X-ray flag and exposure counter"
        ));
    }
    if exposures > 0 && unbound == 0 && bound == 0 {
        return Some(format!(
            "telemetry tells of {exposures} exposures, and no frame came: check that the console writes into the session's frame folder"
        ));
    }
    if exposures == 0 || unbound == 0 || bound > unbound {
        return None;
    }
    Some(match bound {
        0 => format!(
            "not one of {unbound} frames could be tied to one of {exposures} exposures: no pair has joints, robot or beam of telemetry"
        ),
        _ => format!(
            "{unbound} of {} frames could not be tied to one of {exposures} exposures: their pairs have no joints, robot or beam of telemetry",
            unbound + bound
        ),
    })
}

/// That `pairs` are there and not one has a pose by its beads; `None` where one has.
pub(super) fn none_accepted(pairs: &[Pair]) -> Option<String> {
    let latest = pairs.last().filter(|_| !pairs.iter().any(Pair::is_from_beads))?;
    let reason = latest.reason.as_deref().unwrap_or("no reason given");
    let count = pairs.len();
    Some(format!("not one of {count} frames gave a pose by its beads; of the last one: {reason}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::PairStatus;

    #[test]
    fn what_is_not_lost_after_all_is_taken_back_and_its_like_stays() {
        let mut losses = Losses::default();
        for what in ["latest: cut", "half a packet", "latest: cut"] {
            losses.add(what.to_owned());
        }
        assert_eq!(losses.sentences(), ["latest: cut", "half a packet"]);
        assert!(losses.take_back("latest: cut") && !losses.take_back("another"));
        assert_eq!(losses.sentences(), ["latest: cut", "half a packet"], "one of the two is lost still");
        assert!(losses.take_back("latest: cut") && !losses.take_back("latest: cut"));
        assert_eq!(losses.sentences(), ["half a packet"]);
    }

    /// A replay said "nothing was lost" of a session that had lost half a file.
    #[test]
    fn what_events_say_of_losses_is_heard_and_taken_back() {
        let mut losses = Losses::default();
        for event in [lost("f1: half a file"), lost("f2: half a file"), "line lost: f3".to_owned(), came("f2: half a file")] {
            losses.hear(&event);
        }
        assert_eq!(losses.sentences(), ["f1: half a file"]);
    }

    #[test]
    fn a_session_without_one_pose_by_beads_has_lost_what_it_was_for() {
        let refused = || Pair::unmatched("a", "no beads");
        assert!(none_accepted(&[refused(), refused()]).is_some_and(|words| words.contains("not one of 2 frames")));
        let accepted = Pair { status: PairStatus::AcceptedImageDisagrees, ..refused() };
        assert_eq!(none_accepted(&[accepted.clone(), refused()]), None);
        // A pose of a torn picture is taken back.
        let mut torn = accepted;
        torn.replace_by(2);
        assert!(none_accepted(&[torn, refused()]).is_some());
        assert_eq!(none_accepted(&[]), None);
    }

    /// Processed pictures beside raw ones, and all that came while the C-arm was unplugged, were said to be of another day.
    #[test]
    fn frames_without_an_exposure_are_said_by_what_is_known_of_why() {
        let says = |untied, all: &[&str], none: &[&str]| {
            let words = of_no_exposure(true, untied).expect("something to say");
            assert!(all.iter().all(|word| words.contains(word)) && !none.iter().any(|word| words.contains(word)), "{words}");
        };
        says(
            Untied { other: 3, ..Untied::default() },
            &["3 frames are of no exposure", "another room? Their"],
            &["second", "heard"],
        );
        says(
            Untied { second: 5, ..Untied::default() },
            &["5 frames are second pictures", "ones?). Their"],
            &["another day", "heard"],
        );
        says(Untied { unheard: 4, ..Untied::default() }, &["4 frames came while nothing was heard"], &["another day", "second"]);
        says(
            Untied { of_another_study: 4, ..Untied::default() },
            &["4 frames are of another study than those that have the exposures. Their"],
            &["another day", "second", "heard"],
        );
        let mixed = Untied { second: 3, unheard: 1, counted_on: 0, of_another_study: 0, other: 2 };
        says(mixed, &["3 frames are second", "; 1 frames came while", "; 2 frames are of no exposure"], &[]);
        assert_eq!(mixed.all(), 6);
        // What is said apart is not said to be of another day.
        let counted_on = Untied { counted_on: 3, ..Untied::default() };
        assert_eq!((of_no_exposure(true, counted_on), counted_on.all()), (None, 3));
        // Else they may be of the exposures that have none, which is said.
        assert_eq!([of_no_exposure(true, Untied::default()), of_no_exposure(false, mixed)], [None, None]);
    }

    /// On for 1.3 s of every 1.6 s, and nothing said why no frame could be tied.
    #[test]
    fn a_beam_that_is_on_most_of_the_time_has_its_flag_inverted() {
        let exposures = |on_us: i64| -> Vec<ExposureInterval> {
            let exposure = |index: i64| ExposureInterval {
                index: index as u64,
                counter: None,
                epoch: 0,
                start_us: 1_600_000 * index,
                end_us: 1_600_000 * index + on_us,
                segment: 0,
                device_us: [0, on_us],
                start_uncertainty_us: 1e4,
                end_uncertainty_us: 1e4,
                open: false,
                start_seen: true,
                end_seen: true,
                samples: 39,
                tube_kvp: 60.0,
                tube_ma: 2.0,
                joints: None,
                beam: None,
                joint_range: [0.0; 7],
                control_angles_deg: None,
                tracker_from_base: None,
            };
            (0..5).map(exposure).collect()
        };
        let says = |exposures: &[ExposureInterval], shown: &[u64], unbound: usize| {
            let words = without_frame(exposures, &shown.iter().copied().collect(), unbound).expect("some have none");
            words.contains("for 6.5 s of 7.7 s: does its X-ray flag say the opposite")
        };
        assert!(says(&exposures(1_300_000), &[], 4));
        assert!(!says(&exposures(300_000), &[], 4), "as beams are");
        assert!(!says(&exposures(1_300_000)[..2], &[], 4), "two long runs");
        assert!(!says(&exposures(1_300_000), &[2], 4), "one has its frame");
        assert!(!says(&exposures(1_300_000), &[], 0), "no frame to tie");
    }

    #[test]
    fn a_session_that_ties_no_more_frames_than_it_leaves_has_lost_them() {
        assert!(few_bound(8, 4, 4, true).is_some_and(|words| words.contains("4 of 8 frames")));
        assert!(few_bound(8, 0, 0, true).is_some_and(|words| words.contains("no frame came")));
        assert!(few_bound(8, 3, 0, true).is_some_and(|words| words.contains("not one of 3")));
        assert!(few_bound(0, 3, 0, true).is_some_and(|words| words.contains("told of no exposure")));
        for (exposures, unbound, bound) in [(8, 3, 5), (0, 3, 0), (0, 0, 0), (8, 0, 8)] {
            assert_eq!(few_bound(exposures, unbound, bound, exposures > 0), None);
        }
    }
}

//! What was lost, in a sentence; counters alone do not reach anybody.

use std::collections::BTreeSet;

use crate::report::Pair;
use crate::telemetry::Link;
use crate::timeline::ExposureInterval;

/// So many exposures are named.
const NAMED: usize = 8;

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
                 certain, so their pairs have no joints, robot or beam of telemetry; `binding_evidence` of each pair says why"
            ),
        }
    })
}

/// That `unbound` frames are of none of the exposures (their indices) that telemetry tells of, where each of those has its frame.
pub(super) fn of_no_exposure(exposures: &BTreeSet<u64>, shown: &BTreeSet<u64>, unbound: usize) -> Option<String> {
    let all_shown = !exposures.is_empty() && exposures.is_subset(shown);
    (all_shown && unbound > 0).then(|| {
        format!(
            "{unbound} frames are of no exposure that telemetry tells of: pictures of another day or another room? Their pairs have no joints, \
             robot or beam of telemetry; `binding_evidence` of each pair says why"
        )
    })
}

/// That `unbound` frames could not be tied to one of `exposures`, and no more (`bound`) could; `None` where most could.
pub(super) fn few_bound(exposures: usize, unbound: usize, bound: usize) -> Option<String> {
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

    #[test]
    fn frames_of_another_day_are_said_where_every_exposure_has_its_own() {
        let of = |shown: &[u64], unbound| of_no_exposure(&BTreeSet::from([0, 1]), &shown.iter().copied().collect(), unbound);
        assert!(of(&[0, 1], 3).is_some_and(|words| words.contains("3 frames are of no exposure")));
        // Else they may be of the exposures that have none, which is said.
        assert_eq!([of(&[0, 1], 0), of(&[0], 3), of_no_exposure(&BTreeSet::new(), &BTreeSet::new(), 3)], [None, None, None]);
    }

    #[test]
    fn a_session_that_ties_no_more_frames_than_it_leaves_has_lost_them() {
        assert!(few_bound(8, 4, 4).is_some_and(|words| words.contains("4 of 8 frames")));
        assert!(few_bound(8, 0, 0).is_some_and(|words| words.contains("no frame came")));
        assert!(few_bound(8, 3, 0).is_some_and(|words| words.contains("not one of 3")));
        for (exposures, unbound, bound) in [(8, 3, 5), (0, 3, 0), (0, 0, 0), (8, 0, 8)] {
            assert_eq!(few_bound(exposures, unbound, bound), None);
        }
    }
}

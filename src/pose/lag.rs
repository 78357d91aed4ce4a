//! A former frame's ghost: a detector that lags, or a console that blends frames, shows the beads a second time where they were before, much
//! fainter and all of them alike. A second specimen's beads are as deep as the first one's.

use super::bodies;
use super::explained::{FoundReading, Reading, Rejected, RejectedReading};
use super::prior::Prior;
use super::record::Pose;
use super::refusal::{Refusal, Rival};
use super::request::Registration;
use super::search::apart;
use super::shadow::Shadow;
use crate::beads::Detection;
use crate::estimate::median;

/// Times as faint as the clear shadows from which on a second set is set aside, and from which on it is called fainter.
const MUCH_FAINTER: f64 = 3.0;
const FAINTER: f64 = 1.3;
/// Beads that both sets show, at least.
const FEWEST: usize = 4;
/// By how much the logarithm of a bead's two depths' ratio may differ from the others' (a display curve is steeper here than there), and how
/// many standard deviations of the fainter depth besides.
const UNIFORM_LN: f64 = 0.45;
const SIGMAS: f64 = 2.5;
/// By how much the logarithm of its two radii may differ: the arm may have moved along the beam.
const RADII_LN: f64 = 0.3;
/// Gaps between depths that are tried, the widest, and the narrowest of them (natural logarithm).
const MOST_CUTS: usize = 3;
const LEAST_GAP_LN: f64 = 0.18;

/// The layout a second time.
struct Ghost {
    found: FoundReading,
    /// How many times fainter than the clear shadows.
    times: f64,
}

/// A pose that was refused because a second set of shadows fits the layout as well: where that set is uniformly and far fainter, the pose of
/// the clear ones, in doubt; where it is fainter by less, the refusal with a word of it.
pub(super) fn without_ghost(
    request: &Registration,
    pose: Pose,
    detections: &[Detection],
    register: &dyn Fn(&Registration, &[Detection]) -> Pose,
) -> Pose {
    let could_be = matches!(pose.refusal, Some(Refusal::Ambiguous { rival: Rival::SecondSet | Rival::OtherNames, .. }));
    // What a person says of shadows is not told from what they look like.
    if !could_be || !request.correspondences.is_empty() || !request.by_hand.marks.is_empty() {
        return pose;
    }
    let apart_at = |cut: f64| {
        let (clear, faint): (Vec<Detection>, Vec<Detection>) = detections.iter().partition(|seen| seen.contrast > cut);
        let now = bodies::apart(request, &clear, register(request, &clear), register);
        let (intrinsics, camera_from_lps) = now.camera()?;
        let prior = Prior { camera_from_lps, covariance: None };
        let before = Registration {
            intrinsics: Some(intrinsics),
            intrinsics_prior: None,
            prior: Some(&prior),
            fuse: false,
            ignore_prior: true,
            ..*request
        };
        let former = register(&before, &faint);
        let ghost = ghost(request, &now, &former, detections)?;
        Some((now, ghost))
    };
    let Some((mut now, ghost)) = cuts(detections, request.fewest()).into_iter().find_map(apart_at) else { return pose };
    let Ghost { found, times } = ghost;
    if !(times >= MUCH_FAINTER) {
        let reason = pose.reason.clone().map(|reason| {
            format!(
                "{reason}; the second set is uniformly {times:.1} times fainter: does the detector lag, or the console blend frames? wait \
                 longer between exposures, or switch its averaging off, and take the frame again"
            )
        });
        return Pose { reason, ..pose };
    }
    let own = |seen: &Detection| now.shadows.iter().find(|shadow| shadow.is_of(seen)).cloned();
    let shadows: Vec<Shadow> = detections.iter().map(|seen| own(seen).unwrap_or_else(|| Shadow::of(seen, None))).collect();
    (now.shadows, now.detections) = (shadows, detections.len());
    let explained = now.explained.get_or_insert_default();
    explained.readings.retain(|other| !matches!(other.reading, Reading::SecondSet | Reading::SecondSetClose));
    explained.readings.push(RejectedReading { reading: Reading::SecondSet, found: Some(found), why: Rejected::Doubted });
    let FoundReading { matched, angle_deg, shift_mm, .. } = found;
    now.doubt(format!(
        "{matched} shadows are the layout a second time, uniformly {times:.1} times fainter, {angle_deg:.1}° and {shift_mm:.1} mm away: the \
         detector lags, or the console blends frames; the pose is that of the clear shadows: wait longer between exposures, or switch the \
         console's averaging off"
    ));
    now
}

/// What `former` is of `now`: the same beads, of the same size, all as many times fainter.
fn ghost(request: &Registration, now: &Pose, former: &Pose, detections: &[Detection]) -> Option<Ghost> {
    let ((_, own), (_, other)) = now.camera().zip(former.camera())?;
    let named = former.shadows.iter().filter_map(|shadow| shadow.bead.as_deref());
    let seen = |pose: &Pose, bead: &str| Shadow::detected(&pose.shadows, bead, detections);
    let pair = |bead: &str| Some((seen(now, bead)?, seen(former, bead)?));
    let (matched, pairs): (usize, Vec<(&Detection, &Detection)>) = (named.clone().count(), named.filter_map(pair).collect());
    let times_of = |(clear, faint): &(&Detection, &Detection)| clear.contrast / faint.contrast;
    let times = median(pairs.iter().map(times_of))?;
    let is_alike = |pair: &&(&Detection, &Detection)| {
        let (clear, faint) = **pair;
        let slack_ln = UNIFORM_LN.hypot(SIGMAS / faint.snr.max(1.0));
        (times_of(pair) / times).ln().abs() <= slack_ln
            && (clear.radius_px / faint.radius_px).ln().abs() <= faint.radius_slack_ln(RADII_LN)
    };
    let alike = pairs.iter().filter(is_alike).count();
    // One in five may lie over something else.
    let is_uniform = pairs.len() >= FEWEST && 3 * pairs.len() >= 2 * matched && 5 * alike >= 4 * pairs.len();
    if !(is_uniform && times >= FAINTER) {
        return None;
    }
    let (angle_rad, shift_mm) = apart(&other, &own, request.layout.centroid_lps_mm());
    let found = FoundReading { matched, rms_px: former.rms_px?, angle_deg: angle_rad.to_degrees(), shift_mm };
    Some(Ghost { found, times })
}

/// Contrasts that may part clear shadows from faint ones, in the middle of the widest gap first; a pose's fewest shadows lie on either side.
fn cuts(detections: &[Detection], fewest: usize) -> Vec<f64> {
    let mut depths: Vec<f64> = detections.iter().filter(|seen| seen.contrast > 0.0).map(|seen| seen.contrast.ln()).collect();
    depths.sort_by(f64::total_cmp);
    let at = fewest.max(1)..=depths.len().saturating_sub(fewest);
    let mut gaps: Vec<(f64, f64)> =
        at.map(|n| (depths[n] - depths[n - 1], 0.5 * (depths[n] + depths[n - 1]))).filter(|gap| gap.0 >= LEAST_GAP_LN).collect();
    gaps.sort_by(|a, b| b.0.total_cmp(&a.0));
    gaps.into_iter().take(MOST_CUTS).map(|(_, middle)| middle.exp()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shadows_are_parted_where_their_depths_leave_the_widest_gap() {
        let of = |depths: &[f64]| -> Vec<Detection> {
            depths.iter().map(|contrast| Detection { contrast: *contrast, ..Detection::default() }).collect()
        };
        let two = of(&[0.1, 2.0, 0.12, 1.8, 0.11, 2.1, 0.1, 1.9, f64::NAN, -0.3]);
        let found = cuts(&two, 4);
        assert!(found.len() == 1 && (0.13..1.7).contains(&found[0]), "{found:?}");
        // Too few on one side, and none that differ.
        assert!(cuts(&two, 5).is_empty() && cuts(&of(&[0.4; 20]), 4).is_empty() && cuts(&[], 4).is_empty());
    }
}

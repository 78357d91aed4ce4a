//! What the people at the C-arm can do about a frame whose pose is refused or doubted.

use super::posed::Posed;
use crate::geometry::CarmCalibrationError;
use crate::pose::{MEASURE_K, Pose, Refusal};
use crate::report::{Pair, Standing};

/// Of a pose whose K nobody knows.
pub(super) const K_REMEDY: &str = "give intrinsics in the session, or the C-arm's calibration";

/// Of a pose that is refused with a K that the frame's own header contradicts.
const HEADER_REMEDY: &str = "correct K, or the calibration that it is of: the reason says its focal length and what the header's distance and pitch \
                             give; where one is a whole multiple of the other, K is of frames that are binned otherwise";

/// What follows where joints give no camera, and what helps.
pub(super) fn no_joints(error: &CarmCalibrationError) -> String {
    format!(
        "{error}: there is no pose by joints, so nothing checks the poses of the beads, or stands in for one; let the arm, or its adapter, send \
         it (where the arm cannot move it, the number at which it stands)"
    )
}

/// Whether a doubt ends with the advice to state K.
fn is_of_k(words: &str) -> bool {
    words.ends_with(K_REMEDY) || words.ends_with(MEASURE_K)
}

/// In a sentence; `None` where nothing needs mending.
pub(super) fn remedy(posed: &Posed, pair: &Pair) -> Option<String> {
    let caution = posed.robot.iter().flat_map(|robot| &robot.cautions).map(|caution| caution.remedy()).next();
    let words = match pair.standing() {
        Standing::Accepted => return caution.map(str::to_owned),
        Standing::ImageDisagrees => {
            "expose once more with nothing moving; if the image disagrees again, check which scan and which side the layout is of"
        }
        Standing::InDoubt if posed.pose.doubt.is_none() => "a replay of the log puts its image against other poses",
        Standing::InDoubt if posed.pose.doubt.as_deref().is_some_and(is_of_k) => K_REMEDY,
        Standing::InDoubt => {
            "check what the reason names; where it leaves two readings, another direction or more beads in view tell them apart"
        }
        Standing::TelemetryDisagrees if posed.other_depth.is_some() => {
            "check the source-to-detector distance, and that the picture comes as the panel took it (zoom, crop, pitch), then expose again"
        }
        Standing::TelemetryDisagrees => {
            "check that the specimen has not moved and that the arm's joints read right, then expose again"
        }
        _ => match of_refused(&posed.pose) {
            Some(words) => words,
            None if pair.binding == "none" => "check the C-arm's line: no exposure in its telemetry belongs to this frame",
            None => return None,
        },
    };
    Some(words.to_owned())
}

/// Of a refused pose, where to look first; `None` where nobody said why it is refused.
pub(super) fn of_refused(pose: &Pose) -> Option<&'static str> {
    if pose.is_refused_against_header() {
        return Some(HEADER_REMEDY);
    }
    pose.refusal.as_ref().map(of_refusal)
}

/// The sentence of a refusal says what was found; this is where to look first.
pub(super) fn of_refusal(refusal: &Refusal) -> &'static str {
    match refusal {
        Refusal::TooFewBeads { .. } | Refusal::TooFewShadows { .. } | Refusal::NoMatch { .. } | Refusal::Chance { .. } => {
            "bring more beads into the open field: open the collimator, or aim at them, and expose again"
        }
        Refusal::Collinear { .. } | Refusal::Coplanar { .. } | Refusal::Ambiguous { .. } | Refusal::FlatTags { .. } => {
            "bring beads into the field that lie deeper or higher than these, or give a prior"
        }
        Refusal::Residual { .. } | Refusal::Displaced { .. } | Refusal::Missing { .. } | Refusal::Radii { .. } => {
            "check that no bead has moved since the scan, and that layout and calibration belong to this specimen and arm"
        }
        Refusal::PriorContradicted { .. }
        | Refusal::PriorAgainstTags { .. }
        | Refusal::BehindSource { .. }
        | Refusal::Prior { .. } => "check the arm's telemetry and where the session puts the specimen (world_from_lps)",
        Refusal::Mirrored { .. }
        | Refusal::MirroredTags { .. }
        | Refusal::SeenFromBehind { .. }
        | Refusal::NoOrientation { .. }
        | Refusal::EitherOrientation { .. }
        | Refusal::Axes { .. } => "check the console's flip and rotation, and the axes (LPS or RAS) of the layout",
        Refusal::Distorted { .. } | Refusal::Distortion { .. } => {
            "calibrate the image intensifier in this field and at these angles"
        }
        Refusal::Sense { .. } | Refusal::NoSignal { .. } => {
            "check the frame's domain: the session's \"domain\", or the console's look-up table"
        }
        Refusal::Pixels { .. } => "undo what stretched the picture on its way: the aspect of a video grabber or of an export",
        Refusal::Intrinsics { .. } | Refusal::IntrinsicsContradicted { .. } | Refusal::FocalDegenerate { .. } => {
            "check the calibration of the arm: SID, pitch, binning, crop"
        }
        Refusal::OtherSize { .. } => {
            "give \"intrinsics\" for frames as they arrive, or declare what the console does (\"console\")"
        }
        Refusal::Bodies { .. } | Refusal::BodySplit { .. } => "a part of the specimen has moved: fix it, or register on one body",
        Refusal::Uncertain { .. } => "bring more beads, farther apart, into the field and expose again",
        Refusal::TagsWithoutIntrinsics
        | Refusal::NoTags { .. }
        | Refusal::TagsDisagree { .. }
        | Refusal::TagCorners { .. }
        | Refusal::TagsContradicted { .. } => {
            "bring the listed tags into the field, flat and unmoved, and check their sizes and places"
        }
        Refusal::ByHand { .. } => "take that edit back (Ctrl Z), or put the bead where its shadow is",
        Refusal::Layout { .. } => "run sidecarm check on the session: it names no beads, or their layout is not usable",
        Refusal::Fault { .. } | Refusal::Unsolved | Refusal::Correspondences { .. } => {
            "expose again; the log keeps this frame as it came"
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::PairStatus;

    /// An adapter without one joint gave no pose by joints in a whole session, and only the joint was named.
    #[test]
    fn a_joint_that_is_not_sent_says_what_follows_and_what_helps() {
        let words = no_joints(&CarmCalibrationError::NotMeasured { joint: "detector_rotation_deg" });
        for part in [
            "detector_rotation_deg is not measured",
            "no pose by joints",
            "nothing checks the poses of the beads",
            "adapter, send it",
        ] {
            assert!(words.contains(part), "{part} in {words}");
        }
    }

    #[test]
    fn a_depth_that_is_another_sends_people_to_the_distance() {
        let pair = Pair { status: PairStatus::AcceptedTelemetryDisagrees, ..Pair::unmatched("a", "another depth") };
        let of =
            |other_depth: Option<&str>| remedy(&Posed { other_depth: other_depth.map(str::to_owned), ..Posed::bare(1) }, &pair);
        assert!(of(Some("nearer")).is_some_and(|words| words.contains("source-to-detector distance")));
        assert!(of(None).is_some_and(|words| words.contains("specimen has not moved")));
    }
}

//! A frame whose beads a person has edited, registered and judged again.
//!
//! A hand knows which of the shadows are beads, and it can fool itself: whoever sees where P puts a bead may see it there. Therefore
//! - the verdict is the one of every pose, with its accidents, gates and cautions, and shadows that a hand drops still count as shadows;
//! - what a hand says must go with the pose: one bead that it put or named elsewhere refuses the pose;
//! - the shadows are named by the geometry first. Only where that does not come to the hand's names are they held, and the pose is in doubt;
//! - a frame that gave no pose by itself gives one in doubt at most, and so does a pose away from the one that the frame gave by itself:
//!   the number of accidents does not know how many things a hand has tried.

use super::hand_marks::{ByHand, Edited, HandMark, HandSays, is_meant};
use super::hand_shadows::HAND_SIGMA_PX;
use super::record::Pose;
use super::refusal::Refusal;
use super::request::Registration;
use super::search::apart;
use super::shadow::Shadow;

/// A place that a hand put, and on which P does not rest, agrees with P within so many of its standard deviations.
const AGREES_SIGMAS: f64 = 4.0;
/// Poses farther from each other are different readings of a frame: degrees, mm at the beads.
const ANOTHER: (f64, f64) = (2.0, 15.0);

/// The pose with what a hand says in `marks`; `automatic` is what the frame gave by itself, and `register` how it is registered.
#[must_use]
pub fn register_edited(
    request: &Registration,
    marks: &[HandMark],
    automatic: &Pose,
    register: &dyn Fn(&Registration) -> Pose,
) -> Pose {
    let by_hand = |holds_names: bool| register(&Registration { by_hand: ByHand { marks, holds_names }, ..*request });
    let names = marks.iter().any(|mark| mark.bead().is_some());
    let free = by_hand(false);
    let agrees = free.is_accepted() && first_broken(request, marks, &free).is_none();
    let holds = names && !agrees;
    let mut pose = if holds { by_hand(true) } else { free };
    if pose.is_accepted() {
        match first_broken(request, marks, &pose) {
            Some(refusal) => pose = pose.without_pose(refusal),
            None => doubt(request, automatic, holds, &mut pose),
        }
    }
    if pose.is_accepted() {
        let unused = marks.iter().filter(|mark| !is_used(request, mark, &pose)).filter_map(HandMark::bead);
        let word = |bead: &str| format!("{bead}: P rests on the others, and agrees with the place that a hand put");
        let notes: Vec<String> = unused.map(word).collect();
        pose.notes.extend(notes);
    }
    pose.edited = Some(Edited::of(marks, automatic.reason.clone().filter(|_| !automatic.is_accepted())));
    pose
}

fn doubt(request: &Registration, automatic: &Pose, holds: bool, pose: &mut Pose) {
    if holds {
        pose.doubt("which shadow is which bead rests on a hand: by themselves the shadows do not tell it".to_owned());
    }
    let Some(((_, before), (_, now))) = automatic.camera().zip(pose.camera()) else {
        pose.doubt("the frame gave no pose by itself: this one rests on what a hand said of it".to_owned());
        return;
    };
    let (angle_rad, shift_mm) = apart(&before, &now, request.layout.centroid_lps_mm());
    let angle_deg = angle_rad.to_degrees();
    if !(angle_deg <= ANOTHER.0 && shift_mm <= ANOTHER.1) {
        pose.doubt(format!(
            "a hand moved the pose by {angle_deg:.1}° and {shift_mm:.1} mm from the one that the frame gave by itself"
        ));
    }
}

/// The shadow that a mark means.
fn shadow_of<'p>(request: &Registration, mark: &HandMark, pose: &'p Pose) -> Option<&'p Shadow> {
    let at = request.straight(mark.image_px);
    let distance = |shadow: &Shadow| at.distance(shadow.image_px.into());
    let nearest = pose.shadows.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.filter(|shadow| is_meant(distance(shadow), shadow.radius_px))
}

fn is_used(request: &Registration, mark: &HandMark, pose: &Pose) -> bool {
    mark.bead().is_none() || shadow_of(request, mark, pose).is_some_and(|shadow| shadow.bead.as_deref() == mark.bead())
}

/// The first thing that a hand said and that an accepted pose contradicts.
fn first_broken(request: &Registration, marks: &[HandMark], pose: &Pose) -> Option<Refusal> {
    marks.iter().filter(|mark| !is_used(request, mark, pose)).find_map(|mark| {
        let bead = mark.bead()?;
        let row = pose.beads.iter().find(|row| row.name == bead);
        let at = request.straight(mark.image_px);
        let off_px = row.and_then(|row| row.predicted_px).map(|predicted| at.distance(predicted.into()));
        let is_free = shadow_of(request, mark, pose).is_some_and(|shadow| shadow.bead.is_none());
        let is_put = matches!(mark.says, HandSays::Put(_));
        // A hand's place that is left out beside sharper ones may be right all the same.
        let agrees = is_put && is_free && off_px.is_some_and(|off_px| off_px <= AGREES_SIGMAS * HAND_SIGMA_PX);
        (!agrees).then(|| Refusal::ByHand { bead: bead.to_owned(), image_px: mark.image_px.to_array(), off_px })
    })
}

//! What a frame shows of what the session names: tags, or shadows that may be beads. It is looked for once, and registered as often as need
//! be: fused, or with what a person says of the beads.

use std::sync::Arc;

use crate::acquire::Frame;
use crate::beads::tags::{SeenTag, TagLayout, TagsError, find_tags};
use crate::mask::Masks;
use crate::pose::{self, Looked, Pose, Refusal, Registration};

/// See the module.
#[derive(Clone, Debug)]
pub(super) enum Shown {
    /// The session names tags; beads beside them are sought where these put them.
    Tags { layout: Arc<TagLayout>, seen: Result<Vec<SeenTag>, TagsError> },
    /// It names beads alone.
    Beads(Looked),
    /// It names neither.
    Nothing,
}

impl Shown {
    /// Looks for `tags`, if the session names any, else for beads, if it `names_beads`.
    pub(super) fn in_frame(
        frame: &Frame,
        masks: &Masks,
        tags: Option<&Arc<TagLayout>>,
        names_beads: bool,
        registration: &Registration,
    ) -> Self {
        match (tags, names_beads) {
            (Some(tags), _) => Self::Tags { layout: Arc::clone(tags), seen: find_tags(frame, tags.family) },
            (None, true) => Self::Beads(pose::look(registration, frame, masks)),
            (None, false) => Self::Nothing,
        }
    }

    /// The pose of the same frame by what it shows.
    pub(super) fn register(&self, registration: &Registration, frame: &Frame, masks: &Masks) -> Pose {
        match self {
            Self::Tags { layout, seen: Ok(seen) } => pose::register_tagged(registration, frame, masks, layout, seen),
            Self::Tags { seen: Err(error), .. } => {
                let mut pose = pose::register_masked(registration, frame, masks);
                pose.cautions.push(format!("tags were not looked for: {error}"));
                pose
            }
            Self::Beads(looked) => pose::register_looked(registration, frame, looked),
            Self::Nothing => {
                let detail = "the session names no beads".to_owned();
                pose::register_masked(registration, frame, masks).refused_for(Refusal::Layout { detail })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;
    use crate::acquire::Domain;
    use crate::beads::BeadLayout;
    use crate::beads::tags::{CORNERS, Family, Tag};
    use crate::geometry::{Intrinsics, Rigid};
    use crate::image::Image;

    /// A fused registration looked for the tags a second time. What was seen is handed on: even of a frame that shows nothing.
    #[test]
    fn tags_that_were_seen_are_not_looked_for_again() {
        let frame = Frame::from_pixels("empty", Image::filled(64, 48, 100.0f32), Domain::Linear).expect("a frame");
        let family = Family::Tag36h11;
        let lps_from_tag = Rigid::IDENTITY;
        let tag = Tag { id: 7, size_mm: 20.0, lps_from_tag, body: "specimen".to_owned(), sigma_mm: 0.1 };
        let layout = Arc::new(TagLayout { family, tags: vec![tag] });
        let centre_px = DVec2::new(32.0, 24.0);
        let corners_px = CORNERS.map(|[x, y]| centre_px + 10.0 * DVec2::new(x, y));
        let seen = SeenTag { id: 7, family, centre_px, corners_px, margin: 90.0, hamming: 0, inverted: false, mirrored: false };
        let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 31.5, cy: 23.5 };
        let none = BeadLayout::none();
        let registration = Registration { intrinsics: Some(intrinsics), ..Registration::new([64, 48], &none) };
        let by = |seen: Vec<SeenTag>| {
            let shown = Shown::Tags { layout: Arc::clone(&layout), seen: Ok(seen) };
            shown.register(&registration, &frame, &Masks::default()).tags.iter().map(|tag| tag.id).collect::<Vec<u32>>()
        };
        assert_eq!((by(vec![seen]), by(Vec::new())), (vec![7], Vec::new()));
    }
}

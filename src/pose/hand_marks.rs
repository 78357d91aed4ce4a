//! What a person says of single places of a frame, beside what is found in it.

use std::fmt;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::beads::{BeadLayout, Detection};

/// Of the shadows, a mark means the nearest one: so many radii from it, at most, or so many px.
const MARK_RADII: f64 = 2.0;
const MARK_PX: f64 = 6.0;

/// What a hand says of a place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum HandSays {
    /// This bead's centre is just here, whatever shadow is found.
    Put(String),
    /// The shadow that is found here is this bead's.
    Named(String),
    /// The shadow that is found here is no bead's.
    NoBead,
}

/// A place and what a hand says of it.
#[derive(Clone, Debug, PartialEq)]
pub struct HandMark {
    /// The frame's continuous pixels, as it was acquired.
    pub image_px: DVec2,
    /// What is said.
    pub says: HandSays,
}

impl HandMark {
    /// The bead that is said to be here.
    #[must_use]
    pub fn bead(&self) -> Option<&str> {
        match &self.says {
            HandSays::Put(bead) | HandSays::Named(bead) => Some(bead),
            HandSays::NoBead => None,
        }
    }
}

/// A hand's marks as a registration takes them.
#[derive(Clone, Copy, Debug, Default)]
pub struct ByHand<'a> {
    /// All of them; no two of one bead.
    pub marks: &'a [HandMark],
    /// Whether names hold as well; else shadows are named by the geometry alone, and only places are the hand's.
    pub holds_names: bool,
}

/// Bead and shadow that belong together, and shadows that are no bead's.
pub(super) type Pairs = (Vec<(usize, usize)>, Vec<usize>);

impl ByHand<'_> {
    /// Where beads were put, the frame's pixels.
    pub(super) fn put_px(&self) -> impl Iterator<Item = DVec2> + '_ {
        self.marks.iter().filter(|mark| matches!(mark.says, HandSays::Put(_))).map(|mark| mark.image_px)
    }

    /// What the marks say of `detections`; `straight` undistorts a place of the frame. Marks without a shadow say nothing here.
    pub(super) fn pairs(&self, layout: &BeadLayout, detections: &[Detection], straight: impl Fn(DVec2) -> DVec2) -> Pairs {
        let (mut pinned, mut barred) = (Vec::new(), Vec::new());
        for mark in self.marks {
            let Some(shadow) = nearest_shadow(detections, straight(mark.image_px)) else { continue };
            let bead = mark.bead().map(|name| layout.beads.iter().position(|bead| bead.name == name));
            match bead {
                None => barred.push(shadow),
                Some(_) if !self.holds_names => {}
                Some(Some(bead)) => pinned.push((bead, shadow)),
                // Of another body, whose beads are not looked for now.
                Some(None) => barred.push(shadow),
            }
        }
        (pinned, barred)
    }
}

/// The shadow that a mark at `at`, px of the undistorted picture, means.
pub(super) fn nearest_shadow(detections: &[Detection], at: DVec2) -> Option<usize> {
    let distance = |n: &usize| detections[*n].image_px.distance(at);
    let nearest = (0..detections.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.filter(|n| is_meant(distance(n), detections[*n].radius_px))
}

/// Whether a mark so far from a shadow of such a radius means it, px.
pub(super) fn is_meant(distance_px: f64, radius_px: f64) -> bool {
    distance_px <= (MARK_RADII * radius_px).max(MARK_PX)
}

/// What of a pose's observations comes from a hand. In a pose's file, and in `pairs.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Edited {
    /// Beads whose centres in the frame a hand put.
    pub placed: Vec<String>,
    /// Beads whose shadows a hand named.
    pub named: Vec<String>,
    /// Where a hand said of a shadow that it is no bead's, px of the frame.
    pub dropped_px: Vec<[f64; 2]>,
    /// Why the frame gave no pose before; absent where it gave one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused_before: Option<String>,
}

impl Edited {
    /// `refused_before`: why the frame's own shadows gave no pose.
    pub(super) fn of(marks: &[HandMark], refused_before: Option<String>) -> Self {
        let mut edited = Self { refused_before, ..Self::default() };
        for mark in marks {
            match &mark.says {
                HandSays::Put(bead) => edited.placed.push(bead.clone()),
                HandSays::Named(bead) => edited.named.push(bead.clone()),
                HandSays::NoBead => edited.dropped_px.push(mark.image_px.to_array()),
            }
        }
        edited
    }

    /// Whether a hand put or named this bead.
    #[must_use]
    pub fn is_of(&self, bead: &str) -> bool {
        self.placed.iter().chain(&self.named).any(|name| name == bead)
    }
}

impl fmt::Display for Edited {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let list = |what: &str, names: &[String]| (!names.is_empty()).then(|| format!("{} {what}", names.join(", ")));
        let dropped = match self.dropped_px.len() {
            0 => None,
            1 => Some("1 shadow dropped".to_owned()),
            count => Some(format!("{count} shadows dropped")),
        };
        let parts: Vec<String> =
            [list("placed", &self.placed), list("named", &self.named), dropped].into_iter().flatten().collect();
        write!(f, "edited by hand: {}", parts.join("; "))
    }
}

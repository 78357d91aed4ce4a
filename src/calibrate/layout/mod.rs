//! What a bead layout is worth before it is used: does it resemble itself, is it flat, how well will it fix a pose.

mod map;
mod predict;
mod resemble;

pub use map::map;
pub use predict::{Planned, PlannedView, predict};
pub use resemble::{SelfMatch, self_match};

use serde::Serialize;

use crate::beads::BeadLayout;
use crate::pose::extents_mm;

/// Third extent over the first below which a layout counts as flat: mirrored poses fit nearly as well, and K cannot be solved.
const FLAT: f64 = 0.15;
/// A layout resembles itself when so large a share of its beads falls on others, and so many.
const ALIKE: (f64, usize) = (0.6, 5);

/// A layout's score.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LayoutScore {
    /// Beads.
    pub beads: usize,
    /// Standard deviations along the principal axes, largest first.
    pub extents_mm: [f64; 3],
    /// Third extent over the first.
    pub flatness: f64,
    /// The motion, other than none, that puts most beads onto beads; `None` with fewer than three.
    pub self_match: Option<SelfMatch>,
    /// The same for the mirror image.
    pub mirrored_match: Option<SelfMatch>,
    /// What is predicted for planned views.
    pub views: Vec<PlannedView>,
    /// What speaks against the layout.
    pub warnings: Vec<String>,
    /// What a person should know of the score.
    pub notes: Vec<String>,
}

/// Scores a layout; beads within `tolerance_mm` of each other are taken for the same.
#[must_use]
pub fn score(layout: &BeadLayout, tolerance_mm: f64, planned: Option<&Planned>) -> LayoutScore {
    let places: Vec<_> = layout.beads.iter().map(|bead| bead.lps_mm).collect();
    let names: Vec<&str> = layout.beads.iter().map(|bead| bead.name.as_str()).collect();
    let extents_mm = extents_mm(&places);
    let flatness = if extents_mm[0] > 0.0 { extents_mm[2] / extents_mm[0] } else { 0.0 };
    let [itself, image] = [false, true].map(|mirrored| self_match(&places, &names, mirrored, tolerance_mm));
    let mut notes = Vec::new();
    if itself.1 || image.1 {
        notes.push(
            "so many beads, or so regular ones, that not every three of them were tried: another motion may put more beads onto beads"
                .to_owned(),
        );
    }
    let found = [itself.0, image.0];
    let mut warnings = Vec::new();
    if !(flatness >= FLAT) {
        warnings.push(format!(
            "flat: extents {:.1}, {:.1}, {:.1} mm; move beads out of the plane, by {:.0} mm or more",
            extents_mm[0],
            extents_mm[1],
            extents_mm[2],
            2.0 * FLAT * extents_mm[0]
        ));
    }
    for (found, image) in found.iter().zip(["itself", "its mirror image"]) {
        if let Some(SelfMatch { beads, pairs, angle_deg, .. }) = found
            && *beads >= ALIKE.1
            && *beads as f64 >= ALIKE.0 * places.len() as f64
        {
            let first: Vec<String> = pairs.iter().take(4).map(|[from, to]| format!("{from} on {to}")).collect();
            warnings.push(format!(
                "alike: {beads} of {} beads fall on beads of {image} turned by {angle_deg:.0}° ({}); move one of them by more than {:.0} mm",
                places.len(),
                first.join(", "),
                4.0 * tolerance_mm
            ));
        }
    }
    let views = planned.map_or_else(Vec::new, |planned| predict(layout, planned));
    let [self_match, mirrored_match] = found;
    LayoutScore { beads: places.len(), extents_mm, flatness, self_match, mirrored_match, views, warnings, notes }
}

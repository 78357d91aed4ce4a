//! Beads that moved together: the pose of those that agree may be that of the moved ones, and one view hardly tells which they are.

use glam::DVec2;

use super::case::Case;
use super::cautions::Cautions;
use super::settle::Settled;

/// A shadow so far from a bead's place may still be that bead's, mm at its depth.
const REACH_MM: f64 = 12.0;
/// What is nearer to its place has not moved, px.
const LEAST_PX: f64 = 3.0;
/// Two beads of one part are off by the same: so many px, and that share of it for what they differ in depth and turn.
const SAME_PX: f64 = 2.0;
const SAME_SHARE: f64 = 0.1;
/// Radii of shadows against those of the beads that the pose rests on: a factor's natural logarithm.
const BEAD_SIZED: f64 = 0.285;
/// A pose whose beads are farther from where the others put them (root mean square) may put landmarks as far off, px.
const LOOSE_PX: f64 = 2.0;

impl Case<'_> {
    /// Says where the beads do not hold a pose as tightly as landmarks want it, and where some of them seem to have moved together.
    pub(super) fn doubt_moved(&self, last: &Settled, cautions: &mut Cautions) {
        let off_px: Vec<f64> = self.left_out(last).iter().flatten().map(|bead| bead.offset.norm_squared()).collect();
        let rms_px = (off_px.iter().sum::<f64>() / off_px.len().max(1) as f64).sqrt();
        // Not a number is beyond any limit.
        if !(rms_px <= LOOSE_PX) {
            cautions.doubt(format!(
                "each bead is {rms_px:.1} px (rms) from where the others put it, and landmarks may be as far off: bring more beads into view, \
                 or measure their places better"
            ));
        }
        if let Some((names, off)) = self.moved_together(last) {
            cautions.doubt(format!(
                "the shadows of {} lie all about {:.0} px {} and {:.0} px {} their places: did they move together, or did those that the pose \
                 rests on?",
                names.join(", "),
                off.x.abs(),
                if off.x < 0.0 { "left" } else { "right" },
                off.y.abs(),
                if off.y < 0.0 { "above" } else { "below" }
            ));
        }
    }

    /// Beads that the pose does not rest on and that are off by the same, and by how much.
    fn moved_together(&self, last: &Settled) -> Option<(Vec<String>, DVec2)> {
        let beads = &self.request.layout.beads;
        let usual_px = self.usual(&last.matches, |shadow| shadow.radius_px)?;
        let usual_slack_ln = self.usual(&last.matches, |shadow| shadow.radius_slack_ln(BEAD_SIZED))?;
        let is_free = |n: usize| !last.matches.iter().chain(last.merged.iter().map(|(m, _)| m)).any(|m| m.detection == n);
        let is_sized = |n: usize| {
            let shadow = &self.detections[n];
            // A faint blob of any size is not bead-sized for not knowing its own.
            (shadow.radius_px / usual_px).ln().abs() < shadow.radius_slack_ln(BEAD_SIZED).min(usual_slack_ln)
        };
        let free: Vec<DVec2> =
            (0..self.detections.len()).filter(|n| is_free(*n) && is_sized(*n)).map(|n| self.detections[n].image_px).collect();
        let rests = |bead: usize| {
            last.matches.iter().any(|m| m.bead == bead) || last.merged.iter().any(|(m, other)| m.bead == bead || *other == bead)
        };
        let mut offs: Vec<(usize, DVec2)> = Vec::new();
        for bead in (0..beads.len()).filter(|bead| !rests(*bead)) {
            let depth_mm = last.solution.camera_from_lps.transform_point(beads[bead].lps_mm).z;
            let reach_px = REACH_MM * last.solution.intrinsics.fx / depth_mm;
            let Some(place) = last.solution.place(beads[bead].lps_mm).1 else { continue };
            let off = free.iter().map(|at| *at - place).filter(|off| (LEAST_PX..reach_px).contains(&off.length()));
            offs.extend(off.map(|off| (bead, off)));
        }
        let alike = |own: DVec2, other: DVec2| own.distance(other) <= SAME_PX + SAME_SHARE * own.length();
        let party = |own: DVec2| {
            let mut party: Vec<usize> = offs.iter().filter(|(_, other)| alike(own, *other)).map(|(bead, _)| *bead).collect();
            party.dedup();
            party
        };
        let largest = offs.iter().map(|(_, own)| (party(*own), *own)).max_by_key(|(party, _)| party.len())?;
        let (party, off) = Some(largest).filter(|(party, _)| party.len() >= 2)?;
        Some((party.into_iter().map(|bead| beads[bead].name.clone()).collect(), off))
    }
}

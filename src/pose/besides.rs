//! What a frame shows besides a match: beads that should be seen and are not, shadows that belong to none.

use super::case::Case;
use super::settle::Settled;
use super::solve::Match;
use crate::beads::{Bead, Detection};

/// A bead is missing for certain where its place is less deep than this share of the others' contrast …
const LEAST_SHARE: f64 = 0.3;
/// … by so many standard deviations.
const SIGMAS: f64 = 3.0;
/// Shadows closer than so many radii hide each other.
const APART_RADII: f64 = 2.5;
/// A shadow is another bead's if radius and contrast are within these factors of what a bead would have (natural logarithms).
const ALIKE: (f64, f64) = (0.25, 0.4);
/// Contrast over noise from which on a shadow is clear.
const CLEAR_SNR: f64 = 10.0;

/// What a frame shows besides the match.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Besides {
    /// Beads that the pose puts into the open field and that are certainly not there.
    pub missing: Vec<String>,
    /// Beads whose shadow is there, but beside its place: outliers, and what no bead claims close by.
    pub displaced: Vec<String>,
    /// Clear shadows like the matched ones that belong to no bead.
    pub unexplained: Vec<usize>,
}

impl Case<'_> {
    pub fn besides(&self, last: &Settled) -> Besides {
        let usual = |of: fn(&Detection) -> f64| self.usual(&last.matches, of);
        let (Some(usual_contrast), Some(usual_radius_px), Some(usual_slack_ln)) =
            (usual(|d| d.contrast), usual(|d| d.radius_px), usual(|d| d.radius_slack_ln(ALIKE.0)))
        else {
            return Besides::default();
        };
        let (pose, k) = (last.solution.camera_from_lps, last.solution.intrinsics);
        let layout = self.request.layout;
        let mut besides = Besides::default();
        let radius_at = |depth_mm: f64, index: usize| {
            layout.radius_mm(index, self.request.bead_radius_mm).map(|radius_mm| k.fx * radius_mm / depth_mm)
        };
        // A faint blob of any size is not bead-sized for not knowing its own.
        let alike = |d: &Detection| {
            (d.radius_px / usual_radius_px).ln().abs() < d.radius_slack_ln(ALIKE.0).min(usual_slack_ln)
                && (d.contrast / usual_contrast).ln().abs() < ALIKE.1
                && d.snr >= CLEAR_SNR
        };
        let explained = |n: usize| {
            let taken = last.known().any(|m| m.detection == n);
            let beside = |m: &Match| m.image_px.distance(self.detections[n].image_px) < usual_radius_px;
            let of_check = |bead: &Bead| {
                let at = last.solution.place(bead.lps_mm).1;
                at.is_some_and(|at| at.distance(self.detections[n].image_px) < APART_RADII * usual_radius_px)
            };
            taken || last.matches.iter().any(beside) || layout.checks.iter().any(of_check)
        };
        besides.unexplained = (0..self.detections.len()).filter(|n| alike(&self.detections[*n]) && !explained(*n)).collect();
        // Without the picture nobody knows what the masks hide.
        let Some(probe) = &self.probe else { return besides };
        besides.displaced.extend(last.left_out.iter().map(|(m, _)| layout.beads[m.bead].name.clone()));
        for (index, bead) in layout.beads.iter().enumerate() {
            let p = pose.transform_point(bead.lps_mm);
            let known = last.known().any(|m| m.bead == index);
            if known || !(p.z > 1.0) {
                continue;
            }
            let (at, radius_px) = (k.project(p), radius_at(p.z, index).unwrap_or(usual_radius_px));
            let hidden = |d: &Detection| d.image_px.distance(at) < APART_RADII * radius_px.max(d.radius_px);
            let in_frame = self.request.in_frame(at);
            if !probe.is_usable(in_frame) {
                continue;
            }
            if let Some(n) = self.detections.iter().position(hidden) {
                // What hides it may be its own shadow.
                if alike(&self.detections[n]) && !explained(n) {
                    besides.displaced.push(bead.name.clone());
                }
                continue;
            }
            // Beads stand where the layout has them to a fraction of their radius; nothing within that counts as there.
            let contrast = probe.contrast(in_frame, radius_px);
            let is_there = contrast.is_none_or(|(contrast, sigma)| !(contrast + SIGMAS * sigma < LEAST_SHARE * usual_contrast));
            if !is_there {
                besides.missing.push(bead.name.clone());
            }
        }
        besides
    }
}

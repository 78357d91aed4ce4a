//! Beads that a hand put into a frame, as shadows among those that were found, and what the picture says of their places.

use glam::DVec2;

use super::case::Case;
use super::cautions::Cautions;
use super::request::Registration;
use super::settle::Settled;
use super::solve::Match;
use crate::beads::Detection;

/// Standard deviation of a centre that a hand put, per axis: a pixel of the frame.
pub(super) const HAND_SIGMA_PX: f64 = 1.0;
/// A shadow whose centre lies so near a bead that was put is the same shadow, px at least.
const LEAST_PX: f64 = 3.0;
/// Radius of a bead's shadow where nothing tells it, px.
const ANY_RADIUS_PX: f64 = 6.0;
/// As for beads that a pose misses: nothing is there where the place is less deep than this share of the others' contrast …
const LEAST_SHARE: f64 = 0.3;
/// … by so many standard deviations.
const SIGMAS: f64 = 3.0;

impl Registration<'_> {
    /// The shadows that were found, best first, behind the beads that a hand put; a shadow on which one was put is not there twice.
    pub(super) fn with_put(&self, seen: &[Detection]) -> Vec<Detection> {
        let put: Vec<DVec2> = self.by_hand.put_px().map(|at| self.straight(at)).filter(|at| at.is_finite()).collect();
        let same = |d: &Detection, at: DVec2| d.image_px.distance(at) <= d.radius_px.max(LEAST_PX);
        let mut all: Vec<Detection> = put.iter().map(|at| self.put(*at, seen)).collect();
        all.extend(seen.iter().filter(|d| !put.iter().any(|at| same(d, *at))).copied());
        all
    }

    /// As large and deep as the shadow that it stands for, else as the others are.
    fn put(&self, at: DVec2, seen: &[Detection]) -> Detection {
        let near = seen.iter().filter(|d| d.image_px.distance(at) <= d.radius_px.max(LEAST_PX));
        let nearest = near.min_by(|a, b| a.image_px.distance(at).total_cmp(&b.image_px.distance(at)));
        let mut by_radius: Vec<&Detection> = seen.iter().collect();
        by_radius.sort_by(|a, b| a.radius_px.total_cmp(&b.radius_px));
        let expected = self.expectation().radius_px.map_or(ANY_RADIUS_PX, |(least, most)| (least * most).sqrt());
        let like = match nearest.or(by_radius.get(by_radius.len() / 2).copied()) {
            Some(like) => *like,
            None => Detection { radius_px: expected, ..Detection::default() },
        };
        let variance = HAND_SIGMA_PX.powi(2);
        Detection {
            image_px: at,
            sigma_px: HAND_SIGMA_PX,
            covariance_px2: [[variance, 0.0], [0.0, variance]],
            quality: 1.0,
            ..like
        }
    }
}

impl Case<'_> {
    /// Says of beads that a hand put where the picture shows nothing like one.
    pub(super) fn doubt_put(&self, last: &Settled, cautions: &mut Cautions) {
        let Some(probe) = &self.probe else { return };
        let put: Vec<DVec2> = self.request.by_hand.put_px().map(|at| self.request.straight(at)).collect();
        let of_hand = |m: &Match| put.iter().any(|at| self.detections[m.detection].image_px == *at);
        // Where a hand put all of them, the picture's own shadows say what a bead is like.
        let usual = self.usual(last.matches.iter().filter(|m| !of_hand(m)), |shadow| shadow.contrast);
        for m in last.matches.iter().filter(|m| of_hand(m)) {
            let shadow = &self.detections[m.detection];
            let usual = usual.unwrap_or(shadow.contrast);
            let seen = probe.contrast(self.request.in_frame(shadow.image_px), shadow.radius_px);
            let is_there = seen.is_none_or(|(contrast, sigma)| !(contrast + SIGMAS * sigma < LEAST_SHARE * usual));
            if !is_there {
                let name = &self.request.layout.beads[m.bead].name;
                cautions.doubt(format!("nothing like a bead is seen where a hand put {name}"));
            }
        }
    }
}

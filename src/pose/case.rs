//! One registration under way: the request, the shadows, and what every step asks of them.

use std::cell::RefCell;
use std::sync::Arc;

use glam::{DVec2, DVec3};
use nalgebra::{Matrix2, Matrix3, Matrix6, Vector2};

use super::explained::{FoundReading, Reading, Rejected, RejectedReading};
use super::gate::{Gate, information_about};
use super::hand_marks::nearest_shadow;
use super::prior::Prior;
use super::record::Pose;
use super::refusal::{Refusal, Rival};
use super::request::Registration;
use super::search::{Found, Hypothesis, ROUGH_GATE, Search};
use super::shadow::Shadow;
use super::solve::{Free, Match, image_by_point, point_by_pose};
use super::tables::{Depths, Target};
use super::verdict::chance;
use crate::beads::{Detection, Probe};
use crate::estimate::median;
use crate::geometry::{Intrinsics, Rigid};

/// Standard deviations of a prior without covariance: about the bead centroid, per axis.
pub const PRIOR_SIGMA: (f64, f64) = (5.0 * std::f64::consts::PI / 180.0, 15.0);
/// Squared deviation from a prior up to which a pose is sought: with its covariance, and without one.
pub const GATE: (f64, f64) = (30.0, 60.0);
/// Turns within a gate up to which it bounds depths.
const MOST_TURN_RAD: f64 = 1.0;

/// See the module.
pub(super) struct Case<'a> {
    pub request: &'a Registration<'a>,
    /// The best shadows, best first.
    pub detections: &'a [Detection],
    /// Bead and shadow that a person has put together.
    pub pinned: Vec<(usize, usize)>,
    /// Shadows of which a person has said that they are no bead's; other readings may take them all the same.
    pub barred: Vec<usize>,
    /// Looks at the frame; `None` where there is none.
    pub probe: Option<Probe<'a>>,
    /// Nothing matched near the prior: it no longer gates.
    pub without_prior: bool,
    /// What all shadows give wherever the camera is, for the K that it was last asked of.
    pub everywhere: RefCell<Option<(Intrinsics, Arc<Found>)>>,
    /// Other readings that were looked at, and why they do not stand.
    pub heard: RefCell<Vec<RejectedReading>>,
}

impl<'a> Case<'a> {
    /// Takes a person's correspondences to the shadows that they mean.
    pub fn new(request: &'a Registration<'a>, detections: &'a [Detection], probe: Option<Probe<'a>>) -> Result<Self, Refusal> {
        let mut pinned: Vec<(usize, usize)> = Vec::new();
        for given in request.correspondences {
            let refuse = |detail: String| Refusal::Correspondences { detail };
            let place = format!("{} at ({:.1}, {:.1}) px", given.bead, given.image_px.x, given.image_px.y);
            let Some(bead) = request.layout.beads.iter().position(|bead| bead.name == given.bead) else {
                return Err(refuse(format!("the layout has no bead called {:?}", given.bead)));
            };
            let Some(shadow) = nearest_shadow(detections, request.straight(given.image_px)) else {
                return Err(refuse(format!("there is no bead-like shadow where {place} is said to be")));
            };
            if pinned.iter().any(|(other, n)| *other == bead || *n == shadow) {
                return Err(refuse(format!("{place}: its bead or its shadow is named twice")));
            }
            pinned.push((bead, shadow));
        }
        let (of_hand, barred) = request.by_hand.pairs(request.layout, detections, |at| request.straight(at));
        pinned.extend(of_hand);
        let (everywhere, heard) = (RefCell::default(), RefCell::default());
        Ok(Self { request, detections, pinned, barred, probe, without_prior: false, everywhere, heard })
    }

    /// The median of what `of` says of the shadows of `matches`; `None` where there are none.
    pub fn usual<'m>(&self, matches: impl IntoIterator<Item = &'m Match>, of: impl Fn(&Detection) -> f64) -> Option<f64> {
        median(matches.into_iter().filter_map(|m| self.detections.get(m.detection)).map(of))
    }

    /// The answer that there is no pose, with what the frame shows.
    pub fn refuse(&self, refusal: &Refusal, notes: Vec<String>) -> Pose {
        let shadows = self.detections.iter().map(|detection| Shadow::of(detection, None)).collect();
        let explained = Some(self.explained(None));
        Pose { notes, detections: self.detections.len(), shadows, explained, ..self.request.refuse(refusal) }
    }

    /// Keeps that a reading does not stand; `found` is its pose, how many beads it explains, and how well (px), `own` the pose that is judged.
    pub fn hear(&self, reading: Reading, found: Option<(&Rigid, usize, f64)>, own: &Rigid, why: Rejected) {
        let found = found.and_then(|(pose, matched, rms_px)| {
            let (angle_deg, shift_mm) = self.distance(pose, own);
            let all = [rms_px, angle_deg, shift_mm];
            all.iter().all(|x| x.is_finite()).then_some(FoundReading { matched, rms_px, angle_deg, shift_mm })
        });
        self.heard.borrow_mut().push(RejectedReading { reading, found, why: why.finite() });
    }

    /// Whether a bead could be seen at a place of the undistorted picture.
    pub fn can_show(&self, at_px: DVec2) -> bool {
        self.probe.is_none_or(|probe| probe.is_usable(self.request.in_frame(at_px)))
    }

    pub fn targets(&self) -> Vec<Target> {
        let layout = self.request.layout;
        let target = |(n, bead): (usize, &crate::beads::Bead)| Target {
            lps_mm: bead.lps_mm,
            sigma_mm: bead.most_sigma_mm(),
            place_mm2: bead.place_mm2(),
            radius_mm: layout.radius_mm(n, self.request.bead_radius_mm),
        };
        layout.beads.iter().enumerate().map(target).collect()
    }

    pub fn gate(&self, prior: &Prior) -> Gate {
        let (information, limit) = match prior.covariance {
            Some(rows) => (Matrix6::from_fn(|i, j| rows[i][j]).try_inverse().unwrap_or_else(Matrix6::zeros), GATE.0),
            None => {
                let centre = prior.camera_from_lps.transform_point(self.request.layout.centroid_lps_mm());
                (information_about(centre, PRIOR_SIGMA.0, PRIOR_SIGMA.1), GATE.1)
            }
        };
        Gate { camera_from_lps: prior.camera_from_lps, information, limit }
    }

    /// Squared deviation from the prior in its standard deviations (six degrees of freedom), and the limit of its gate; `None` without a
    /// prior that holds.
    pub fn off_prior(&self, pose: &Rigid) -> Option<(f64, f64)> {
        let gate = self.gate(self.request.prior.filter(|_| !self.without_prior)?);
        Some((gate.squares(pose), gate.limit))
    }

    /// Whether the prior, if it holds, says that the pose cannot be.
    pub fn gate_excludes(&self, pose: &Rigid) -> bool {
        self.off_prior(pose).is_some_and(|(squares, limit)| !(squares <= limit))
    }

    /// A search of some of the shadows, `own` telling which each is among all.
    pub fn search<'s>(
        &self,
        targets: &'s [Target],
        detections: &'s [Detection],
        own: impl Fn(usize) -> Option<usize>,
        k: &Intrinsics,
        gate: Option<Gate>,
    ) -> Search<'s>
    where
        'a: 's,
    {
        let (probe, request) = (self.probe, self.request);
        let pinned = self
            .pinned
            .iter()
            .filter_map(|(bead, shadow)| (0..detections.len()).find(|n| own(*n) == Some(*shadow)).map(|n| (*bead, n)));
        Search {
            targets,
            detections,
            intrinsics: *k,
            size_px: self.request.size_px,
            depth_mm: self.request.depth_range_mm(k.fx),
            allowed: allowed(targets, detections, k, gate.as_ref()),
            in_gate: in_gate(targets, gate.as_ref()),
            pinned: pinned.collect(),
            barred: Vec::new(),
            gate,
            slack_px: 0.0,
            budget: super::search::BUDGET,
            groups: Vec::new(),
            fewest: super::search::FEWEST,
            shows: Box::new(move |at_px| probe.is_none_or(|probe| probe.is_usable(request.in_frame(at_px)))),
        }
    }

    /// That another reading (its pose, how many beads it explains, how well) stands against the match.
    pub fn ambiguous(&self, rival: Rival, own: (&Rigid, usize, f64), other: (&Rigid, usize, f64)) -> Refusal {
        let (angle_deg, shift_mm) = self.distance(other.0, own.0);
        let (matched, fit, other_matched, other_fit) = (own.1, own.2, other.1, other.2);
        let prior_given = self.request.prior.is_some();
        Refusal::Ambiguous { rival, angle_deg, shift_mm, matched, fit, other_matched, other_fit, prior_given }
    }

    /// Degrees and millimetres between two poses, at the beads.
    pub fn distance(&self, a: &Rigid, b: &Rigid) -> (f64, f64) {
        let (angle, shift) = super::search::apart(a, b, self.request.layout.centroid_lps_mm());
        (angle.to_degrees(), shift)
    }

    /// Accidents expected behind a match of `detections` after `tried` tries, where so many `parameters` were solved.
    fn chance_with(&self, hypothesis: &Hypothesis, tried: u64, detections: &[Detection], parameters: usize) -> f64 {
        let area = area_px2(self.request.size_px, detections);
        // A random shadow agrees where it lies in an ellipse of S: a circle as large has this radius.
        let agree_px = hypothesis.rms_px * hypothesis.roundness.sqrt();
        chance(tried, hypothesis.matches.len(), hypothesis.in_view, agree_px, detections.len(), area, parameters)
    }

    /// Accidents expected behind a match of `detections` after `tried` tries, K held.
    pub fn chance_among(&self, hypothesis: &Hypothesis, tried: u64, detections: &[Detection]) -> f64 {
        self.chance_with(hypothesis, tried, detections, 6)
    }

    /// The same among all shadows.
    pub fn chance_of(&self, hypothesis: &Hypothesis, tried: u64) -> f64 {
        self.chance_among(hypothesis, tried, self.detections)
    }

    /// The same of what is solved for the frame: a free K makes up for accidents as well.
    pub fn chance_of_solved(&self, hypothesis: &Hypothesis, tried: u64) -> f64 {
        let parameters = if self.request.free() == Free::Square { 9 } else { 6 };
        self.chance_with(hypothesis, tried, self.detections, parameters)
    }
}

/// Area on which shadows lie: that of their bounds, a twentieth of the picture at least.
pub(super) fn area_px2(size_px: [u32; 2], detections: &[Detection]) -> f64 {
    let [width, height] = size_px.map(f64::from);
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for detection in detections {
        low = low.min(detection.image_px);
        high = high.max(detection.image_px);
    }
    ((high - low).x * (high - low).y).clamp(0.05 * width * height, width * height)
}

/// Pairs bead × detection that the gate leaves, row by row of beads.
fn allowed(targets: &[Target], detections: &[Detection], k: &Intrinsics, gate: Option<&Gate>) -> Vec<bool> {
    let mut allowed = vec![true; targets.len() * detections.len()];
    let Some((gate, covariance)) = gate.and_then(|gate| Some((gate, gate.information.try_inverse()?))) else {
        return allowed;
    };
    for (bead, target) in targets.iter().enumerate() {
        let p = gate.camera_from_lps.transform_point(target.lps_mm);
        if !(p.z > 1.0) {
            continue;
        }
        let j = image_by_point(k, p) * point_by_pose(p, DVec3::ZERO);
        let spread = j * covariance * j.transpose() + Matrix2::identity() * 9.0;
        let Some(inverse) = spread.try_inverse() else { continue };
        let at = k.project(p);
        for (n, detection) in detections.iter().enumerate() {
            let d = detection.image_px - at;
            let d = Vector2::new(d.x, d.y);
            allowed[bead * detections.len() + n] = (d.transpose() * inverse * d)[(0, 0)] <= gate.limit;
        }
    }
    allowed
}

/// Depths at which the gate lets each bead be: by the linear rule, and half of the turn times the shift for what it leaves out.
fn in_gate(targets: &[Target], gate: Option<&Gate>) -> Vec<Depths> {
    let anywhere = vec![Depths::ALL; targets.len()];
    let Some((gate, covariance)) = gate.and_then(|gate| Some((gate, gate.information.try_inverse()?))) else { return anywhere };
    let limit = gate.limit * ROUGH_GATE;
    let largest = |variances: Matrix3<f64>| (limit * variances.symmetric_eigenvalues().max()).sqrt();
    let turn_rad = largest(covariance.fixed_view::<3, 3>(0, 0).into_owned());
    if !(turn_rad < MOST_TURN_RAD) {
        return anywhere;
    }
    let of = |target: &Target| {
        let p = gate.camera_from_lps.transform_point(target.lps_mm);
        let by_pose = point_by_pose(p, DVec3::ZERO);
        let moved = by_pose * covariance * by_pose.transpose();
        let reach_mm = (limit * moved[(2, 2)]).sqrt() + 0.5 * turn_rad * largest(moved);
        if reach_mm.is_finite() { Depths { near: p.z - reach_mm, far: p.z + reach_mm } } else { Depths::ALL }
    };
    targets.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::random::{Purpose, Stream};

    /// Poses on the very edge of gates of every shape.
    #[test]
    fn a_gate_bounds_no_depth_that_it_lets_pass() {
        let mut random = Stream::new(8, 0, 0, Purpose::Evaluation);
        let mut bounded = 0;
        for _ in 0..300 {
            let mut between = |low: f64, high: f64| low + (high - low) * random.uniform();
            let centre = DVec3::new(between(-80.0, 80.0), between(-80.0, 80.0), between(450.0, 900.0));
            let (turn_rad, shift_mm) = (between(0.001, 0.1), between(0.5, 40.0));
            let camera_from_lps = Rigid::translation(centre) * Rigid::exp(DVec3::new(between(-3.0, 3.0), 1.0, 0.3), DVec3::ZERO);
            let gate =
                Gate { camera_from_lps, information: information_about(centre, turn_rad, shift_mm), limit: between(20.0, 60.0) };
            let mut place = || DVec3::new(between(-70.0, 70.0), between(-70.0, 70.0), between(-70.0, 70.0));
            let place_mm2 = DMat3::from_diagonal(DVec3::splat(0.01));
            let target = |lps_mm| Target { lps_mm, sigma_mm: 0.1, place_mm2, radius_mm: None };
            let targets: Vec<Target> = (0..6).map(|_| target(place())).collect();
            let depths = in_gate(&targets, Some(&gate));
            bounded += usize::from(depths[0].far.is_finite());
            let covariance = gate.information.try_inverse().expect("positive");
            let root = covariance.cholesky().expect("positive").l();
            for _ in 0..50 {
                let direction = nalgebra::Vector6::from_fn(|_, _| random.normal()).normalize();
                let off = root * direction * (gate.limit * ROUGH_GATE).sqrt();
                let moved = Rigid::exp(DVec3::new(off[0], off[1], off[2]), DVec3::new(off[3], off[4], off[5])) * camera_from_lps;
                assert!((gate.squares(&moved) / gate.limit / ROUGH_GATE - 1.0).abs() < 1e-6, "on the edge");
                for (target, depths) in targets.iter().zip(&depths) {
                    let depth_mm = moved.transform_point(target.lps_mm).z;
                    assert!(depths.contain(depth_mm), "{depth_mm} in {depths:?}, turn {turn_rad}, shift {shift_mm}");
                }
            }
        }
        assert!(bounded > 100, "{bounded} gates bound anything");
        let nothing = Gate { camera_from_lps: Rigid::IDENTITY, information: Matrix6::zeros(), limit: 30.0 };
        let target = Target { lps_mm: DVec3::Z, sigma_mm: 0.1, place_mm2: DMat3::IDENTITY, radius_mm: None };
        assert!(in_gate(&[target], Some(&nothing))[0].contain(1e6));
    }
}

//! From a frame and a layout to a pose, or to the reason why there is none.

use glam::{DVec2, DVec3};
use nalgebra::Matrix6;

use super::record::{BeadResidual, Pose, Prior, Status};
use super::search::{BUDGET, Found, Gate, Hypothesis, Search, Target, information_about};
use super::solve::{Free, Match, Options, Solution, image_by_point, point_by_pose, solve};
use super::transform;
use super::verdict::{chance, check_geometry};
use crate::acquire::Frame;
use crate::beads::{BeadLayout, Detection, Expectation, Landmark, Polarity, Probe, detect};
use crate::geometry::{Intrinsics, Rigid};
use crate::mask::{self, Cause, Masks};

/// Standard deviations of a prior without covariance: about the bead centroid, per axis.
pub const PRIOR_SIGMA: (f64, f64) = (5.0 * std::f64::consts::PI / 180.0, 15.0);

/// What to register.
#[derive(Clone, Copy, Debug)]
pub struct Registration<'a> {
    /// The radiograph.
    pub frame: &'a Frame,
    /// The beads in the specimen.
    pub layout: &'a BeadLayout,
    /// K of the frame; `None`: solved, which takes six beads that are not coplanar.
    pub intrinsics: Option<Intrinsics>,
    /// Side of a pixel: bounds depths (no bead lies behind the detector) and makes pixels square when K is solved.
    pub pitch_mm: Option<f64>,
    /// Where the pose is expected.
    pub prior: Option<&'a Prior>,
    /// Whether the prior is also a measurement.
    pub fuse: bool,
    /// Where uncertainty is wanted.
    pub landmarks: &'a [Landmark],
    /// Radius of beads whose description gives none.
    pub bead_radius_mm: Option<f64>,
}

/// The same without a frame: shadows that are already found.
#[derive(Clone, Copy, Debug)]
pub struct Matching<'a> {
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// As in [`Registration`].
    pub layout: &'a BeadLayout,
    /// As in [`Registration`].
    pub intrinsics: Option<Intrinsics>,
    /// As in [`Registration`].
    pub pitch_mm: Option<f64>,
    /// As in [`Registration`].
    pub prior: Option<&'a Prior>,
    /// As in [`Registration`].
    pub fuse: bool,
    /// As in [`Registration`].
    pub landmarks: &'a [Landmark],
    /// As in [`Registration`].
    pub bead_radius_mm: Option<f64>,
}

/// Shadows used in the search: the best.
const MOST_DETECTIONS: usize = 40;
/// Focal lengths tried when K is unknown, in frame widths.
const FOCAL_GUESSES: [f64; 6] = [1.6, 2.3, 3.3, 4.7, 6.7, 9.5];

/// Registers a frame. A refusal is a result, not an error: `status` is refused and `reason` says why.
#[must_use]
pub fn register(request: &Registration) -> Pose {
    register_masked(request, &mask::of_frame(request.frame))
}

/// [`register`] where the frame's masks are known.
#[must_use]
pub fn register_masked(request: &Registration, masks: &Masks) -> Pose {
    let size_px = request.frame.size_px.map(|n| n as u32);
    let matching = Matching {
        size_px,
        layout: request.layout,
        intrinsics: request.intrinsics,
        pitch_mm: request.pitch_mm,
        prior: request.prior,
        fuse: request.fuse,
        landmarks: request.landmarks,
        bead_radius_mm: request.bead_radius_mm,
    };
    if let Some(refused) = refuse_early(&matching) {
        return refused;
    }
    let expected = Expectation { radius_px: expected_radius_px(&matching) };
    // A bead before clipped air is still a shadow, and a row of beads clipped to black looks like writing; writing has no round shadows.
    // What is behind the shutters or dead is none.
    let [width, height] = request.frame.size_px;
    let usable = masks.usable(width, height, &[Cause::Saturation, Cause::NoSignal, Cause::BurnedIn]);
    let detections = detect(request.frame, Some(&usable), &expected);
    let probe = |polarity| Some(Probe::new(request.frame, &usable, polarity));
    let mut pose = attempt(&matching, &detections.found, probe(detections.polarity));
    pose.notes.insert(0, detections.evidence.clone());
    if !pose.is_accepted() && !detections.opposite.is_empty() {
        let polarity = match detections.polarity {
            Polarity::Dark => Polarity::Bright,
            Polarity::Bright => Polarity::Dark,
        };
        let mut other = attempt(&matching, &detections.opposite, probe(polarity));
        if other.is_accepted() {
            other.notes.insert(0, detections.evidence);
            other.notes.push("the beads matched in the other polarity than most shadows have".to_owned());
            pose = other;
        }
    }
    pose
}

/// Matches shadows to beads and solves.
#[must_use]
pub fn register_detections(matching: &Matching, detections: &[Detection]) -> Pose {
    attempt(matching, detections, None)
}

fn attempt(matching: &Matching, detections: &[Detection], probe: Option<Probe>) -> Pose {
    if let Some(refused) = refuse_early(matching) {
        return refused;
    }
    let detections: Vec<Detection> =
        detections.iter().filter(|d| d.image_px.is_finite() && d.sigma_px.is_finite()).take(MOST_DETECTIONS).copied().collect();
    Attempt { matching, detections: &detections, probe, without_prior: false }.run()
}

fn refused(matching: &Matching, reason: String) -> Pose {
    let beads = matching.layout.beads.iter().map(|bead| BeadResidual {
        name: bead.name.clone(),
        body: bead.body.clone(),
        lps_mm: bead.lps_mm,
        image_px: None,
        predicted_px: None,
        residual_px: None,
        sigma_px: None,
        left_out_px: None,
        used: false,
        reason: Some("no pose".to_owned()),
    });
    Pose {
        status: Status::Refused,
        reason: Some(reason),
        size_px: Some(matching.size_px),
        pitch_mm: matching.pitch_mm,
        intrinsics: matching.intrinsics,
        intrinsics_source: matching.intrinsics.map(|_| "given".to_owned()),
        beads: beads.collect(),
        notes: matching.layout.notes.clone(),
        version: Some(env!("CARGO_PKG_VERSION").to_owned()),
        ..Pose::default()
    }
}

fn refuse_early(matching: &Matching) -> Option<Pose> {
    if let Some(reason) = &matching.layout.refused {
        return Some(refused(matching, reason.clone()));
    }
    let points: Vec<DVec3> = matching.layout.beads.iter().map(|bead| bead.lps_mm).collect();
    if let Err(degenerate) = check_geometry(&points, matching.intrinsics.is_some(), "of the layout") {
        return Some(refused(matching, degenerate.to_string()));
    }
    if let Some(prior) = matching.prior {
        if let Some(fault) = prior.fault() {
            return Some(refused(matching, format!("prior: its covariance is unusable: {fault}")));
        }
        let depth_mm = prior.camera_from_lps.transform_point(matching.layout.centroid_lps_mm()).z;
        if !(depth_mm > 0.0) {
            let reason = format!(
                "behind_source: the prior puts the bead centroid at depth {depth_mm:.1} mm, behind the source; check its direction (camera_from_lps) and units"
            );
            return Some(refused(matching, reason));
        }
    }
    if matching.fuse && matching.prior.is_none() {
        return Some(refused(matching, "prior: fusing needs a prior".to_owned()));
    }
    None
}

/// Depths at which beads may lie, mm from the source.
fn depth_range_mm(matching: &Matching, fx: f64) -> (f64, f64) {
    match matching.pitch_mm {
        Some(pitch) => (0.2 * fx * pitch, 1.02 * fx * pitch),
        None => (150.0, 2500.0),
    }
}

fn expected_radius_px(matching: &Matching) -> Option<(f64, f64)> {
    let fx = matching.intrinsics?.fx;
    let mut radii = Vec::new();
    for index in 0..matching.layout.beads.len() {
        radii.push(matching.layout.radius_mm(index, matching.bead_radius_mm)?);
    }
    let (near, far) = match matching.prior {
        Some(prior) => {
            let depth = |p: DVec3| prior.camera_from_lps.transform_point(p).z;
            let depths: Vec<f64> = matching.layout.beads.iter().map(|bead| depth(bead.lps_mm)).collect();
            let fold = |start: f64, f: fn(f64, f64) -> f64| depths.iter().copied().fold(start, f);
            ((0.6 * fold(f64::INFINITY, f64::min)).max(100.0), 1.5 * fold(0.0, f64::max))
        }
        None => depth_range_mm(matching, fx),
    };
    let fold = |start: f64, f: fn(f64, f64) -> f64| radii.iter().copied().fold(start, f);
    Some((fx * fold(f64::INFINITY, f64::min) / far, fx * fold(0.0, f64::max) / near.max(1.0)))
}

/// One try: shadows against a layout.
pub(super) struct Attempt<'a> {
    pub(super) matching: &'a Matching<'a>,
    pub(super) detections: &'a [Detection],
    /// Looks at the frame; `None` where there is none.
    pub(super) probe: Option<Probe<'a>>,
    /// Nothing matched near the prior: it no longer gates.
    pub(super) without_prior: bool,
}

/// A match with what the search knows of it.
pub(super) struct Candidate {
    pub(super) hypothesis: Hypothesis,
    pub(super) others: Vec<Hypothesis>,
    pub(super) intrinsics: Intrinsics,
    pub(super) tried: u64,
}

impl Attempt<'_> {
    fn run(mut self) -> Pose {
        let mut notes = self.matching.layout.notes.clone();
        let least = if self.matching.intrinsics.is_some() { 4 } else { 6 };
        if self.detections.len() < least {
            let reason = format!(
                "too_few_shadows: {} bead-like shadows in the frame, {least} are needed; open the collimator, raise the dose, or check --bead-radius",
                self.detections.len()
            );
            return self.refuse(reason, notes);
        }
        let near = match self.matching.intrinsics {
            Some(k) => self.find(&k, 0.0, self.matching.prior),
            None => self.find_without_intrinsics(),
        };
        let near = near.map(|candidate| self.judge(candidate, notes.clone()));
        // A match that accident explains is as good as none: the prior may be of another specimen, or of yesterday.
        let by_accident = |pose: &Pose| pose.reason.as_ref().is_some_and(|reason| reason.starts_with("chance"));
        if let Some(pose) = near.as_ref().filter(|pose| !by_accident(pose)) {
            return pose.clone();
        }
        if let (Some(k), Some(prior), false) = (self.matching.intrinsics, self.matching.prior, self.matching.fuse)
            && (near.is_none() || prior.covariance.is_none())
        {
            self.without_prior = true;
            if let Some(found) = self.find(&k, 0.0, None) {
                let centroid = self.matching.layout.centroid_lps_mm();
                let (angle, shift) = super::search::apart(&prior.camera_from_lps, &found.hypothesis.camera_from_lps, centroid);
                // Who states a covariance means it.
                if prior.covariance.is_some() {
                    let reason = format!(
                        "prior_contradicted: the only match, {} beads to {:.2} px, is {:.1}° and {shift:.1} mm away from the prior, more than its covariance allows; check prior, K, and the layout's scale, or leave the prior out",
                        found.hypothesis.matches.len(),
                        found.hypothesis.rms_px,
                        angle.to_degrees()
                    );
                    return self.refuse(reason, notes);
                }
                notes.push(format!(
                    "nothing matched near the prior; this match is {:.1}° and {shift:.1} mm away from it: check the prior",
                    angle.to_degrees()
                ));
                let far = self.judge(found, notes.clone());
                if far.is_accepted() || near.is_none() {
                    return far;
                }
            }
        }
        if let Some(pose) = near {
            return pose;
        }
        if let Some(reason) = self.matching.intrinsics.and_then(|k| self.mirrored(&k, 3)) {
            return self.refuse(reason, notes);
        }
        let reason = format!(
            "no_match: {} bead-like shadows, but no pose puts four of the {} beads on them",
            self.detections.len(),
            self.matching.layout.beads.len()
        );
        self.refuse(reason, notes)
    }

    pub(super) fn refuse(&self, reason: String, notes: Vec<String>) -> Pose {
        Pose { notes, detections: self.detections.len(), ..refused(self.matching, reason) }
    }

    pub(super) fn depth_range_mm(&self, fx: f64) -> (f64, f64) {
        depth_range_mm(self.matching, fx)
    }

    pub(super) fn targets(&self) -> Vec<Target> {
        let layout = self.matching.layout;
        let target = |(n, bead): (usize, &crate::beads::Bead)| Target {
            lps_mm: bead.lps_mm,
            sigma_mm: bead.sigma_or_default_mm(),
            radius_mm: layout.radius_mm(n, self.matching.bead_radius_mm),
        };
        layout.beads.iter().enumerate().map(target).collect()
    }

    pub(super) fn gate(&self, prior: &Prior) -> Gate {
        let (information, limit) = match prior.covariance {
            Some(rows) => {
                let matrix = Matrix6::from_fn(|i, j| rows[i][j]);
                (matrix.try_inverse().unwrap_or_else(Matrix6::zeros), 30.0)
            }
            None => {
                let centre = prior.camera_from_lps.transform_point(self.matching.layout.centroid_lps_mm());
                (information_about(centre, PRIOR_SIGMA.0, PRIOR_SIGMA.1), 60.0)
            }
        };
        Gate { camera_from_lps: prior.camera_from_lps, information, limit }
    }

    /// Pairs bead × detection that the gate leaves, row by row of beads.
    pub(super) fn allowed(&self, targets: &[Target], detections: &[Detection], k: &Intrinsics, gate: Option<&Gate>) -> Vec<bool> {
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
            let spread = j * covariance * j.transpose() + nalgebra::Matrix2::identity() * 9.0;
            let Some(inverse) = spread.try_inverse() else { continue };
            let at = k.project(p);
            for (n, detection) in detections.iter().enumerate() {
                let d = detection.image_px - at;
                let d = nalgebra::Vector2::new(d.x, d.y);
                allowed[bead * detections.len() + n] = (d.transpose() * inverse * d)[(0, 0)] <= gate.limit;
            }
        }
        allowed
    }

    fn find(&self, k: &Intrinsics, slack_px: f64, prior: Option<&Prior>) -> Option<Candidate> {
        let targets = self.targets();
        let gate = prior.map(|prior| self.gate(prior));
        let allowed = self.allowed(&targets, self.detections, k, gate.as_ref());
        let search = Search {
            targets: &targets,
            detections: self.detections,
            intrinsics: *k,
            size_px: self.matching.size_px,
            depth_mm: depth_range_mm(self.matching, k.fx),
            gate,
            allowed,
            slack_px,
            budget: BUDGET,
        };
        let enough = |best: &Hypothesis, tried: u64| {
            let count = best.matches.len();
            count >= 5 && 10 * count >= 7 * best.in_view && self.chance_of(best, tried) < 1e-6
        };
        let Found { hypotheses, tried } = search.run(enough);
        let mut all = hypotheses.into_iter();
        let best = all.next()?;
        let mut others: Vec<Hypothesis> = all.collect();
        // The shadows of the best match against every other order of beads: symmetric layouts show here.
        let matched: Vec<Detection> = best.matches.iter().map(|m| self.detections[m.detection]).collect();
        let narrow = Search {
            targets: &targets,
            detections: &matched,
            intrinsics: *k,
            size_px: self.matching.size_px,
            depth_mm: search.depth_mm,
            gate,
            allowed: (0..targets.len())
                .flat_map(|bead| best.matches.iter().map(move |m| (bead, m.detection)))
                .map(|(bead, n)| search.allowed[bead * self.detections.len() + n])
                .collect(),
            slack_px,
            budget: BUDGET,
        };
        for mut other in narrow.run(|_, _| false).hypotheses {
            for m in &mut other.matches {
                m.detection = best.matches[m.detection].detection;
            }
            others.push(other);
        }
        Some(Candidate { hypothesis: best, others, intrinsics: *k, tried })
    }

    /// K unknown: a few focal lengths with the principal point in the middle are close enough to find the match.
    fn find_without_intrinsics(&self) -> Option<Candidate> {
        let [width, height] = self.matching.size_px.map(f64::from);
        let mut best: Option<Candidate> = None;
        let mut tried = 0;
        for guess in FOCAL_GUESSES {
            let fx = guess * width.max(height);
            let k = Intrinsics { fx, fy: fx, skew: 0.0, cx: 0.5 * (width - 1.0), cy: 0.5 * (height - 1.0) };
            let Some(mut found) = self.find(&k, 6.0 * width.max(height) / 620.0, None) else { continue };
            tried += found.tried;
            let key = |c: &Candidate| (c.hypothesis.matches.len() as f64) * 100.0 - c.hypothesis.rms_px;
            if let Some(solved) = self.solve_intrinsics(&found.hypothesis.matches, &found.hypothesis.camera_from_lps, &k) {
                found.intrinsics = solved.intrinsics;
                found.hypothesis.camera_from_lps = solved.camera_from_lps;
                let mean = solved.residuals_px.iter().map(|r| r.length_squared()).sum::<f64>() / solved.residuals_px.len() as f64;
                found.hypothesis.rms_px = mean.sqrt();
                if best.as_ref().is_none_or(|b| key(&found) > key(b)) {
                    best = Some(found);
                }
            }
        }
        let mut best = best?;
        best.tried = tried;
        // With K near the truth, the beads that the guess put too far off are found as well.
        if let Some(again) = self.find(&best.intrinsics, 1.0, None)
            && again.hypothesis.matches.len() >= best.hypothesis.matches.len()
        {
            best = Candidate { tried: tried + again.tried, ..again };
        }
        Some(best)
    }

    pub(super) fn free(&self) -> Free {
        // Detectors have square pixels; a second focal length would mostly fit noise.
        if self.matching.intrinsics.is_some() { Free::Pose } else { Free::Square }
    }

    pub(super) fn solve_intrinsics(&self, matches: &[Match], pose: &Rigid, k: &Intrinsics) -> Option<Solution> {
        if matches.len() < 6 {
            return None;
        }
        let options = Options { loss: 3.0, iterations: 60, ..Options::least_squares(Free::Square) };
        let direct = transform::direct(matches).map(|(found, pose)| {
            let f = 0.5 * (found.fx + found.fy);
            (pose, Intrinsics { fx: f, fy: f, skew: 0.0, cx: found.cx, cy: found.cy })
        });
        let total = |s: &Solution| s.chi2.iter().map(|c| c.min(50.0)).sum::<f64>();
        [Some((*pose, *k)), direct]
            .into_iter()
            .flatten()
            .filter_map(|(pose, k)| solve(matches, &pose, &k, &options))
            .min_by(|a, b| total(a).total_cmp(&total(b)))
    }

    pub(super) fn chance_of(&self, hypothesis: &Hypothesis, tried: u64) -> f64 {
        self.chance_among(hypothesis, tried, self.detections)
    }

    pub(super) fn chance_among(&self, hypothesis: &Hypothesis, tried: u64, detections: &[Detection]) -> f64 {
        let [width, height] = self.matching.size_px.map(f64::from);
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for detection in detections {
            low = low.min(detection.image_px);
            high = high.max(detection.image_px);
        }
        let area = ((high - low).x * (high - low).y).clamp(0.05 * width * height, width * height);
        chance(tried, hypothesis.matches.len(), hypothesis.in_view, hypothesis.rms_px, detections.len(), area)
    }
}

/// K and pixel pitch from a frame's own header, with words that say what was assumed: f = SID / pitch, the principal point in the
/// middle. `None` when the header lacks either.
#[must_use]
pub fn intrinsics_of(frame: &Frame) -> Option<(Intrinsics, f64, String)> {
    let sid_mm = frame.tags.sid_mm.filter(|sid| *sid > 0.0)?;
    let [across, down] = frame.tags.pitch_mm.filter(|pitch| pitch.iter().all(|p| *p > 0.0))?;
    let [width, height] = frame.size_px.map(|n| n as f64);
    let intrinsics =
        Intrinsics { fx: sid_mm / across, fy: sid_mm / down, skew: 0.0, cx: 0.5 * (width - 1.0), cy: 0.5 * (height - 1.0) };
    let note = format!(
        "K is taken from the header: SID {sid_mm} mm over a pitch of {across} x {down} mm, and the principal point is assumed in the middle; give --intrinsics for a calibrated K"
    );
    Some((intrinsics, across, note))
}

//! From a frame and a layout to a pose, or to the reason why there is none.

use std::sync::{Arc, OnceLock};

use glam::DVec3;

use super::bodies;
use super::case::Case;
use super::explained::{Reading, Rejected};
use super::lag::without_ghost;
use super::prior::Prior;
use super::radii::{RadiusRatio, SizedShadow};
use super::record::Pose;
use super::refusal::Refusal;
use super::request::Registration;
use super::residual::BeadResidual;
use super::shadow::Shadow;
use crate::acquire::{Domain, Frame};
use crate::beads::{Detection, Detections, Polarity, Probe, Signal, detect, detect_image};
use crate::geometry::{Intrinsics, Rigid};
use crate::image::Image;
use crate::mask::{self, Cause, Disc, Masks};

/// Shadows used in the search: the best.
const MOST_DETECTIONS: usize = 40;
/// So many of the others, where they are as clear as the beads that match, may be another match.
const RIVAL_SHADOWS: usize = 4;
/// They are as clear where they stand out of the noise as far, and look like beads to this share of the worst that matches.
const LIKE_A_BEAD: f64 = 0.9;

/// Registers a frame. A refusal is a result, not an error: `status` is refused and `reason` says why.
#[must_use]
pub fn register(request: &Registration, frame: &Frame) -> Pose {
    register_masked(request, frame, &mask::of_frame(frame))
}

/// [`register`] where the frame's masks are known.
#[must_use]
pub fn register_masked(request: &Registration, frame: &Frame, masks: &Masks) -> Pose {
    match request.fault() {
        Some(fault) => request.refuse(&fault).on_panel(frame),
        None => register_looked(request, frame, &look(request, frame, masks)),
    }
}

/// What a frame shows that looks like beads: the slow half of a registration, which does not depend on what a person says of the beads.
#[derive(Clone, Debug)]
pub struct Looked {
    /// In the undistorted picture.
    detections: Detections,
    usable: Image<bool>,
    /// Of a frame that an image intensifier may have taken.
    round_field: Option<Disc>,
    /// What looks like beads where metal is not what the frame's domain says; sought once, where nothing else matches.
    otherwise: Arc<OnceLock<Vec<Detection>>>,
}

/// Looks for bead-like shadows.
#[must_use]
pub fn look(request: &Registration, frame: &Frame, masks: &Masks) -> Looked {
    if request.fault().is_some() {
        // No picture makes it good.
        let (found, opposite, evidence) = (Vec::new(), Vec::new(), String::new());
        let detections = Detections { found, polarity: Polarity::Dark, opposite, evidence };
        let usable = Image { width: 0, height: 0, pixels: Vec::new() };
        return Looked { detections, usable, round_field: None, otherwise: Arc::default() };
    }
    // A bead before clipped air is still a shadow, and a row of beads clipped to black looks like writing; writing has no round shadows.
    // What is behind the shutters or dead is none.
    let [width, height] = frame.size_px;
    let usable = masks.usable(width, height, &[Cause::Saturation, Cause::NoSignal, Cause::BurnedIn]);
    let found = detect(frame, Some(&usable), &request.expectation());
    let straight = |shadows| request.straight_shadows(shadows);
    let detections = Detections { found: straight(found.found), opposite: straight(found.opposite), ..found };
    let round_field = request.round_field_of(frame, masks);
    Looked { detections, usable, round_field, otherwise: Arc::default() }
}

/// [`register_masked`] where it is known what the frame shows.
#[must_use]
pub fn register_looked(request: &Registration, frame: &Frame, looked: &Looked) -> Pose {
    let request = &Registration { round_field: looked.round_field, ..*request };
    let pose = match request.fault() {
        Some(fault) => request.refuse(&fault),
        None => {
            let pose = other_sense(request, frame, looked, either_polarity(request, frame, looked));
            let refusal = if pose.is_accepted() { None } else { no_signal(frame, &looked.usable) };
            match refusal {
                Some(refusal) => pose.refused_for(refusal),
                None => pose,
            }
        }
    };
    pose.on_panel(frame)
}

fn either_polarity(request: &Registration, frame: &Frame, looked: &Looked) -> Pose {
    let Looked { detections, usable, .. } = looked;
    let probe = |polarity| Some(Probe::new(frame, usable, polarity));
    let mut pose = attempt(request, &detections.found, probe(detections.polarity));
    pose.notes.insert(0, detections.evidence.clone());
    if !pose.is_accepted() && !detections.opposite.is_empty() {
        let polarity = match detections.polarity {
            Polarity::Dark => Polarity::Bright,
            Polarity::Bright => Polarity::Dark,
        };
        let mut other = attempt(request, &detections.opposite, probe(polarity));
        let why = |refused: &Pose| Rejected::Refused { reason: refused.reason.clone().unwrap_or_default() };
        if other.is_accepted() {
            other.notes.insert(0, detections.evidence.clone());
            other.cautions.push("the beads matched in the other polarity than most shadows have".to_owned());
            other.reject(Reading::OtherPolarity, why(&pose));
            pose = other;
        } else {
            pose.reject(Reading::OtherPolarity, why(&other));
        }
    }
    pose
}

/// That linear values are of something else: none is above zero, and they are not those of a panel without X-rays, zero all over.
fn no_signal(frame: &Frame, usable: &Image<bool>) -> Option<Refusal> {
    let open = frame.pixels.pixels.iter().zip(&usable.pixels).filter(|(value, usable)| **usable && value.is_finite());
    let (lowest, highest) = open.fold((f32::MAX, f32::MIN), |(low, high), (value, _)| (low.min(*value), high.max(*value)));
    let is_none = frame.domain == Domain::Linear && highest <= 0.0 && lowest < 0.0 && lowest <= highest;
    is_none.then(|| Refusal::NoSignal { highest: f64::from(highest) })
}

/// A refused pose of a frame whose domain says what metal is, where the beads match the other way round.
fn other_sense(request: &Registration, frame: &Frame, looked: &Looked, pose: Pose) -> Pose {
    use Refusal::{Chance, NoMatch, TooFewShadows};
    let expected = match frame.domain {
        Domain::Linear => Polarity::Dark,
        Domain::Log => Polarity::Bright,
        Domain::Display | Domain::Unknown => return pose,
    };
    if !matches!(pose.refusal, Some(TooFewShadows { .. } | NoMatch { .. } | Chance { .. })) {
        return pose;
    }
    let otherwise = looked.otherwise.get_or_init(|| {
        let found = detect_image(&frame.pixels, Signal::Unknown, Some(&looked.usable), &request.expectation());
        request.straight_shadows(if found.polarity == expected { found.opposite } else { found.found })
    });
    if otherwise.len() < request.fewest() {
        return pose;
    }
    let other = attempt(request, otherwise, None);
    if !other.is_accepted() {
        return pose;
    }
    let matched = other.beads.iter().filter(|bead| bead.used).count();
    let domain = frame.domain.to_string();
    pose.refused_for(Refusal::Sense { matched, domain, dark: expected == Polarity::Dark })
}

/// The same from shadows that are already found.
#[must_use]
pub fn register_shadows(request: &Registration, detections: &[Detection]) -> Pose {
    match request.fault() {
        Some(fault) => request.refuse(&fault),
        None => attempt(request, detections, None),
    }
}

/// The pose under which a short search explains most shadows, near the prior if there is one; K must be known. It is not judged: for
/// callers who try many assumptions about one frame and tell by more than the pose which of them holds.
#[must_use]
pub fn rough_pose(request: &Registration, detections: &[Detection]) -> Option<Rigid> {
    if request.fault().is_some() {
        return None;
    }
    Case::new(request, &best_of(detections), None).ok()?.rough_pose()
}

fn best_of(detections: &[Detection]) -> Vec<Detection> {
    placed(detections).take(MOST_DETECTIONS).copied().collect()
}

fn placed(detections: &[Detection]) -> impl Iterator<Item = &Detection> {
    detections.iter().filter(|d| d.image_px.is_finite() && d.sigma_px.is_finite())
}

fn attempt(request: &Registration, seen: &[Detection], probe: Option<Probe>) -> Pose {
    let seen = &request.with_put(seen);
    let detections = best_of(seen);
    let one = |request: &Registration, detections: &[Detection]| match request.fault() {
        Some(fault) => request.refuse(&fault),
        None => match Case::new(request, detections, probe) {
            Ok(case) => case.run(),
            Err(refusal) => request.refuse(&refusal),
        },
    };
    let pose = bodies::apart(request, &detections, one(request, &detections), &one);
    let pose = without_ghost(request, pose, &detections, &one);
    let mut pose = match without_radii(request, &pose, &detections, &one) {
        Some((without, radii)) if radii.is_hidden() => told_without_radii(without, radii),
        // The other match is no match, and what was said of it means nothing. Of grey values too: no radii have led this one.
        Some((_, radii)) if radii.is_contradicting() => {
            Pose { cautions: Vec::new(), doubt: None, ..pose }.refused_for(Refusal::Radii { ratio: radii.ratio })
        }
        _ => pose,
    };
    let is_used = |seen: &&Detection| pose.shadows.iter().any(|shadow| shadow.bead.is_some() && shadow.is_of(seen));
    let least = |of: fn(&Detection) -> f64| detections.iter().filter(is_used).map(of).fold(f64::INFINITY, f64::min);
    let (snr, quality) = (least(|seen| seen.snr), LIKE_A_BEAD * least(|seen| seen.quality));
    let as_clear = placed(seen).skip(MOST_DETECTIONS).filter(|other| other.snr >= snr && other.quality >= quality).count();
    if pose.is_accepted() && as_clear >= RIVAL_SHADOWS {
        pose.doubt(format!(
            "{as_clear} more shadows are as clear as those of the beads, and no match was sought among them: {}",
            request.fewer_shadows(false)
        ));
    }
    let tried = pose.shadows.len();
    pose.shadows.extend(placed(seen).skip(MOST_DETECTIONS).map(|detection| Shadow::of(detection, None)));
    let more = pose.shadows.len() - tried;
    if more > 0 {
        pose.detections += more;
        pose.notes.push(format!(
            "{more} more shadows, which look less like beads than the {MOST_DETECTIONS} others, were not tried: {}",
            request.fewer_shadows(false)
        ));
    }
    pose
}

/// The pose that the frame gives once the beads' stated radius, which bounds their depth, is left out, and how far that radius is off.
fn without_radii(
    request: &Registration,
    pose: &Pose,
    detections: &[Detection],
    register: &dyn Fn(&Registration, &[Detection]) -> Pose,
) -> Option<(Pose, RadiusRatio)> {
    let could_be = matches!(pose.refusal, Some(Refusal::Chance { .. } | Refusal::NoMatch { .. }));
    let stated = |index: usize| request.layout.radius_mm(index, request.bead_radius_mm);
    let beads = request.layout.beads.len();
    let intrinsics = request.intrinsics.filter(|_| could_be && beads > 0 && (0..beads).all(|index| stated(index).is_some()))?;
    let mut layout = request.layout.clone();
    layout.beads.iter_mut().for_each(|bead| bead.radius_mm = None);
    let changed = Registration { layout: &layout, bead_radius_mm: None, ..*request };
    let without = bodies::apart(&changed, detections, register(&changed, detections), register);
    let camera_from_lps = without.camera_from_lps.filter(|_| without.is_accepted())?;
    let own = |bead: &BeadResidual| {
        let index = request.layout.beads.iter().position(|other| other.name == bead.name)?;
        let depth_mm = camera_from_lps.transform_point(without.place_of(&bead.body, bead.lps_mm)).z;
        let seen = Shadow::detected(&without.shadows, &bead.name, detections)?;
        Some(SizedShadow::new(seen, intrinsics.fx * stated(index)? / depth_mm))
    };
    let radii = RadiusRatio::of(without.beads.iter().filter(|bead| bead.used).filter_map(own).collect())?;
    Some((without, radii))
}

/// A pose for which the beads' radii counted for nothing, with the words that say so.
fn told_without_radii(mut pose: Pose, radii: RadiusRatio) -> Pose {
    pose.doubt(format!(
        "blur hides the size of the shadows, which may be off by a factor of {:.1}: the beads' radii were left out of the match, and their depth \
         rests on their places alone",
        radii.hidden.exp()
    ));
    pose
}

impl Case<'_> {
    fn run(mut self) -> Pose {
        let notes = self.request.layout.notes.clone();
        let (found, required) = (self.detections.len(), self.request.fewest());
        if found < required {
            let prior_puts_into_frame = self.request.prior_puts_into_frame();
            return self.refuse(&Refusal::TooFewShadows { found, required, prior_puts_into_frame, hidden_by: Vec::new() }, notes);
        }
        let candidate = self.propose(self.request.prior);
        let near = candidate.as_ref().map(|candidate| self.judge(candidate, notes.clone()));
        // A match that accident explains, or that the frame speaks against, is as good as none: the prior may be of another specimen, or of
        // yesterday.
        let as_good_as_none = |pose: &Pose| {
            use Refusal::{Chance, Displaced, Mirrored, Missing, Residual};
            let code = &pose.refusal;
            matches!(code, Some(Chance { .. } | Displaced { .. } | Mirrored { .. } | Missing { .. } | Residual { .. }))
        };
        if let Some(pose) = near.as_ref().filter(|pose| !as_good_as_none(pose)) {
            return pose.clone();
        }
        if let (Some(prior), Some(found), Some(pose)) = (self.request.prior, &candidate, &near) {
            let (matched, rms_px) = (found.hypothesis.matches.len(), found.hypothesis.rms_px);
            let reading = (&found.hypothesis.camera_from_lps, matched, rms_px);
            let why = Rejected::Refused { reason: pose.reason.clone().unwrap_or_default() };
            // What was heard of others was heard of this match.
            self.heard.borrow_mut().clear();
            self.hear(Reading::NearPrior, Some(reading), &prior.camera_from_lps, why);
        }
        // A prior that is fused is not given up; that it contradicts the beads is said.
        let may_differ = |prior: &&Prior| !self.request.fuse || near.is_none() && prior.covariance.is_some();
        if let Some(prior) = self.request.prior.filter(|_| self.request.intrinsics.is_some()).filter(may_differ)
            && (near.is_none() || prior.covariance.is_none() || self.request.ignore_prior)
            && let Some(far) = self.without_prior(prior, near.is_none(), &notes)
        {
            return far;
        }
        if let Some(pose) = near {
            return pose;
        }
        let mirrored = self.request.intrinsics.and_then(|k| self.mirrored(&k, 3, None));
        let beads = self.request.layout.beads.len();
        self.refuse(&mirrored.unwrap_or(Refusal::NoMatch { shadows: found, beads }), notes)
    }

    /// Looks everywhere, and says how far that is from the prior. `None` where what was found near the prior says more.
    fn without_prior(&mut self, prior: &Prior, nothing_near: bool, notes: &[String]) -> Option<Pose> {
        let found = self.propose(None)?;
        let (angle_deg, shift_mm) = self.distance(&prior.camera_from_lps, &found.hypothesis.camera_from_lps);
        let half_turn = Rigid::exp(DVec3::Z * std::f64::consts::PI, DVec3::ZERO);
        if !self.gate_excludes(&(found.hypothesis.camera_from_lps * half_turn)) {
            return Some(self.refuse(&Refusal::Axes { matched: found.hypothesis.matches.len() }, notes.to_vec()));
        }
        if let Some(refusal) = self.mirrored_near(found.hypothesis.matches.len()) {
            return Some(self.refuse(&refusal, notes.to_vec()));
        }
        if !self.request.ignore_prior && self.is_seen_from_behind(&found.hypothesis, &prior.camera_from_lps) {
            let matched = found.hypothesis.matches.len();
            return Some(self.refuse(&Refusal::SeenFromBehind { matched, angle_deg, shift_mm }, notes.to_vec()));
        }
        self.without_prior = true;
        // Who states a covariance means it.
        if prior.covariance.is_some() && !self.request.ignore_prior {
            let (matched, rms_px) = (found.hypothesis.matches.len(), found.hypothesis.rms_px);
            return Some(self.refuse(&Refusal::PriorContradicted { matched, rms_px, angle_deg, shift_mm }, notes.to_vec()));
        }
        let mut far = self.judge(&found, notes.to_vec());
        let caution = format!(
            "nothing matched near the prior; this match is {angle_deg:.1}° and {shift_mm:.1} mm away from it: check the prior"
        );
        far.doubt(caution);
        (far.is_accepted() || nothing_near).then_some(far)
    }
}

/// K and pixel pitch from a frame's own header, with words that say what was assumed: f = SID / pitch, the principal point in the
/// middle. `None` when the header lacks either. Where a calibrated K is given is for who asks to say.
#[must_use]
pub fn intrinsics_of(frame: &Frame) -> Option<(Intrinsics, f64, String)> {
    let sid_mm = frame.tags.sid_mm.filter(|sid| *sid > 0.0)?;
    let [across, down] = frame.tags.pitch_mm.filter(|pitch| pitch.iter().all(|p| *p > 0.0))?;
    let [width, height] = frame.size_px.map(|n| n as f64);
    let intrinsics =
        Intrinsics { fx: sid_mm / across, fy: sid_mm / down, skew: 0.0, cx: 0.5 * (width - 1.0), cy: 0.5 * (height - 1.0) };
    let note = format!(
        "K is taken from the header: SID {sid_mm} mm over a pitch of {across} x {down} mm, and the principal point is assumed in the middle"
    );
    Some((intrinsics, across, note))
}

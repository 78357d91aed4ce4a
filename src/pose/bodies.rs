//! Beads on several rigid parts: each body's own pose, and whether it has moved against the others since the scan.
//!
//! The camera is that of the body with most beads. A body's place is lps_from_body = camera_from_lps⁻¹ · camera_from_body, where
//! camera_from_body is the pose that its own beads give. It has moved when that differs from the identity by more than both poses'
//! covariances allow (χ² with six degrees of freedom), or than residuals allow where no deviation of the places is stated. Where but three of
//! its beads are seen, a prior must say where it is expected.

use glam::DVec3;
use nalgebra::{Matrix6, Vector6};

use super::case::area_px2;
use super::prior::Prior;
use super::record::{BodyPose, Pose};
use super::refusal::Refusal;
use super::request::Registration;
use super::residual::BeadResidual;
use super::solve::{about, deviation};
use super::three::{self, Expected, Placed};
use super::tightness::Tightness;
use super::unseen::Unseen;
use crate::beads::{Bead, BeadLayout, Correspondence, Detection};
use crate::geometry::Rigid;

/// Fewest beads from which a body's place is solved without a prior.
pub(super) const FEWEST: usize = 4;
/// Squared deviation, in standard deviations, beyond which a body has moved: one in 10⁵ by accident.
pub(super) const MOVED: f64 = 33.0;
/// The same as a chance.
const BY_ACCIDENT: f64 = 1e-5;
/// What a focal length may be off, of itself, without anybody having said so.
const SCALE_SHARE: f64 = 0.01;
/// Smaller motions are within what a scan and a few beads can tell, whatever their covariance says: degrees, mm.
pub(super) const LEAST_MOTION: (f64, f64) = (0.15, 0.3);
/// A shadow closer than this to one that is taken is that one, px.
const SAME_PX: f64 = 0.5;

/// Registers a layout without regard to bodies.
type Register<'f> = &'f dyn Fn(&Registration, &[Detection]) -> Pose;

impl Pose {
    /// Each body's name and place, of an accepted pose.
    #[must_use]
    pub fn places(&self) -> Vec<(&str, Rigid)> {
        let bodies = self.bodies.iter().filter(|_| self.is_accepted());
        bodies.map(|body| (body.name.as_str(), body.lps_from_body)).collect()
    }

    /// Where a point of a body is now.
    #[must_use]
    pub fn place_of(&self, body: &str, lps_mm: DVec3) -> DVec3 {
        let places = self.places();
        places.iter().find(|(name, _)| *name == body).map_or(lps_mm, |(_, place)| place.transform_point(lps_mm))
    }
}

/// A body with a pose of its own.
struct Apart {
    name: String,
    pose: Pose,
    lps_from_body: Rigid,
    angle_deg: f64,
    shift_mm: f64,
    moved: bool,
}

/// Names of the layout's bodies, the one with most beads first.
pub(super) fn names(layout: &BeadLayout) -> Vec<String> {
    let mut names: Vec<(String, usize)> = Vec::new();
    for bead in &layout.beads {
        match names.iter_mut().find(|(name, _)| *name == bead.body) {
            Some((_, count)) => *count += 1,
            None => names.push((bead.body.clone(), 1)),
        }
    }
    // Stable: of bodies with as many beads the first named comes first.
    names.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    names.into_iter().map(|(name, _)| name).collect()
}

fn layout_of(layout: &BeadLayout, body: &str) -> BeadLayout {
    let of_body = |beads: &[Bead]| beads.iter().filter(|bead| bead.body == body).cloned().collect();
    BeadLayout { beads: of_body(&layout.beads), checks: of_body(&layout.checks), ..layout.clone() }
}

fn of_layout(given: &[Correspondence], layout: &BeadLayout) -> Vec<Correspondence> {
    given.iter().filter(|given| layout.beads.iter().any(|bead| bead.name == given.bead)).cloned().collect()
}

/// `one` is the pose of all beads taken as one rigid specimen. Gives it back where no body has moved, the camera and each body's place
/// where one has, and a refusal where one has and the request takes them as one all the same.
pub(super) fn apart(request: &Registration, detections: &[Detection], one: Pose, register: Register) -> Pose {
    let names = names(request.layout);
    let [reference, others @ ..] = names.as_slice() else { return one };
    if others.is_empty() {
        return one;
    }
    let alone = |body: &str, changed: Registration, detections: &[Detection]| {
        let layout = layout_of(request.layout, body);
        let correspondences = of_layout(changed.correspondences, &layout);
        register(&Registration { layout: &layout, correspondences: &correspondences, ..changed }, detections)
    };
    let first = alone(reference, *request, detections);
    let Some((intrinsics, camera_from_lps)) = first.camera() else { return split(one, others) };
    let prior = Prior { camera_from_lps, covariance: None };
    // K that one body's beads gave holds for the others, and its uncertainty moves them all alike.
    let held = request.intrinsics_prior.map(|_| {
        let known = Registration { intrinsics: Some(intrinsics), intrinsics_prior: None, ..*request };
        alone(reference, known, detections)
    });
    let held = held.filter(Pose::is_accepted).unwrap_or_else(|| first.clone());
    let mut left: Vec<Detection> = without(detections, &first);
    let mut bodies: Vec<Apart> = Vec::new();
    let mut unplaced: Vec<(&String, String)> = Vec::new();
    for name in others {
        let known = Registration {
            intrinsics: Some(intrinsics),
            intrinsics_prior: None,
            prior: Some(&prior),
            fuse: false,
            ignore_prior: false,
            // They are places of the reference body, and so is what the field may say of them.
            landmarks: &[],
            round_field: None,
            is_k_of_header: false,
            ..*request
        };
        let layout = layout_of(request.layout, name);
        let by_four = (layout.beads.len() >= FEWEST).then(|| alone(name, known, &left));
        let found = match by_four {
            Some(pose) if pose.is_accepted() => Ok(Placed { pose, off: None }),
            // What is refused for another reason than that too few are seen is not right by three of them.
            Some(Pose { refusal, reason, .. })
                if !matches!(refusal, Some(Refusal::TooFewShadows { .. } | Refusal::NoMatch { .. })) =>
            {
                Err(reason.unwrap_or_default())
            }
            _ if request.prior.is_none() && layout.beads.len() >= 3 => Err(
                "no four of its beads are found; three would leave several places open, and without a prior nothing says which"
                    .to_owned(),
            ),
            _ => match held.camera_from_lps.zip(held.covariance) {
                Some((camera_from_lps, covariance)) => {
                    let correspondences = of_layout(request.correspondences, &layout);
                    let body = Registration { layout: &layout, correspondences: &correspondences, ..known };
                    let area_px2 = area_px2(request.size_px, detections);
                    three::place(&body, &left, &Expected { camera_from_lps, covariance, intrinsics, area_px2 })
                }
                None => Err("the camera's own covariance is not known".to_owned()),
            },
        };
        match found {
            Ok(placed) => {
                left = without(&left, &placed.pose);
                bodies.extend(motion(request, name, &held, placed));
            }
            Err(why) => unplaced.push((name, why)),
        }
    }
    let Some(moved) = bodies.iter().filter(|body| body.moved).max_by(|a, b| a.angle_deg.total_cmp(&b.angle_deg)) else {
        let mut one = split(one, others);
        let rests_on_all = |body: &String| one.beads.iter().all(|bead| bead.check || bead.used || bead.body != *body);
        let told: Vec<String> = unplaced
            .iter()
            .filter(|(body, _)| !rests_on_all(body))
            .map(|(body, why)| format!("{body} has no place of its own: {why}"))
            .collect();
        one.notes.extend(told);
        return one;
    };
    if request.one_body {
        let (angle_deg, shift_mm) = (moved.angle_deg, moved.shift_mm);
        let refusal = Refusal::Bodies { body: moved.name.clone(), reference: reference.clone(), angle_deg, shift_mm };
        return request.refuse(&refusal).with_shadows_of(&one);
    }
    together(request, first, &bodies, &unplaced, reference)
}

/// Shadows that the beads of a pose do not take.
fn without(detections: &[Detection], pose: &Pose) -> Vec<Detection> {
    let taken = |d: &Detection| {
        let near = |at: [f64; 2]| d.image_px.distance(at.into()) < SAME_PX;
        pose.shadows.iter().any(|shadow| shadow.bead.is_some() && near(shadow.image_px))
    };
    detections.iter().filter(|d| !taken(d)).copied().collect()
}

/// How a body has moved; one of three beads is placed by what is expected of it as well, so that its shadows alone say whether it has.
fn motion(request: &Registration, name: &str, first: &Pose, Placed { pose, off }: Placed) -> Option<Apart> {
    let (reference, own) = (first.camera_from_lps?, pose.camera().map(|(_, own)| own)?);
    let lps_from_body = reference.inverse() * own;
    let centre_lps = pose.centroid_lps_mm?;
    let centre = own.transform_point(centre_lps);
    // Both covariances, of what each pose says of the place of the body's beads.
    let matrix = |rows: [[f64; 6]; 6]| Matrix6::from_fn(|i, j| rows[i][j]);
    let shift = about(centre);
    let covariance = shift * (matrix(first.covariance?) + matrix(pose.covariance?)) * shift.transpose();
    let xi: Vector6<f64> = shift * deviation(&own, &reference);
    let angle_deg = lps_from_body.angle_to_rad(&Rigid::IDENTITY).to_degrees();
    let shift_mm = lps_from_body.transform_point(centre_lps).distance(centre_lps);
    let chi2 = match off {
        Some(off) => off,
        None => (xi.transpose() * covariance.try_inverse()? * xi)[(0, 0)],
    };
    let solved = if request.intrinsics.is_none() || request.intrinsics_prior.is_some() { 3 } else { 0 };
    // Where residuals are smaller than what is taken for them, so is what may be an accident; but a K that is a little off shifts bodies
    // against each other along the beam, and leaves next to nothing in the residuals.
    let by_residuals = |tightness: Tightness| {
        let apart_mm = first.centroid_lps_mm.map_or(0.0, |other| other.distance(centre_lps));
        let mut covariance = covariance * tightness.variance;
        covariance[(5, 5)] += (SCALE_SHARE * apart_mm).powi(2);
        Some(tightness.chance((xi.transpose() * covariance.try_inverse()? * xi)[(0, 0)]) < BY_ACCIDENT)
    };
    let tightness = if off.is_none() { Tightness::of(request.layout, [first, &pose], solved) } else { None };
    let is_beyond = chi2 > MOVED || tightness.and_then(by_residuals).unwrap_or(false);
    let moved = is_beyond && (angle_deg > LEAST_MOTION.0 || shift_mm > LEAST_MOTION.1);
    Some(Apart { name: name.to_owned(), pose, lps_from_body, angle_deg, shift_mm, moved })
}

/// A pose of all beads from which most of one body's are left out does not hold for that body.
fn split(one: Pose, others: &[String]) -> Pose {
    if !one.is_accepted() {
        return one;
    }
    let off = |body: &String| {
        let of_body = || one.beads.iter().filter(|bead| bead.body == *body && bead.image_px.is_some());
        let (seen, left_out) = (of_body().count(), of_body().filter(|bead| !bead.used).count());
        (left_out >= 2 && 2 * left_out >= seen).then(|| Refusal::BodySplit { body: body.clone(), left_out, seen })
    };
    match others.iter().find_map(off) {
        Some(refusal) => one.without_pose(refusal),
        None => one,
    }
}

/// The camera by the first body, each bead's residual by its own body's place.
fn together(request: &Registration, first: Pose, bodies: &[Apart], unplaced: &[(&String, String)], reference: &str) -> Pose {
    let mut pose = first;
    let all = &request.layout.beads;
    let count = |body: &str| all.iter().filter(|bead| bead.body == body).count();
    let mut beads = std::mem::take(&mut pose.beads);
    for body in bodies {
        beads.extend(body.pose.beads.iter().cloned());
        let used = body.pose.beads.iter().filter(|bead| bead.used).count();
        pose.bodies.push(BodyPose {
            name: body.name.clone(),
            lps_from_body: body.lps_from_body,
            beads: count(&body.name),
            used,
            covariance_at_centroid: body.pose.covariance_at_centroid,
        });
        if let Some(rows) = body.pose.covariance_at_centroid.filter(|_| used < FEWEST) {
            let sigma = |from: usize| (from..from + 3).map(|n| rows[n][n].sqrt()).fold(0.0, f64::max);
            pose.cautions.push(format!(
                "{} is placed by {used} beads and by where the others' beads have the specimen, to {:.2}° and {:.2} mm: more of its beads in view would \
                 tell whether one of them has moved",
                body.name,
                sigma(0).to_degrees(),
                sigma(3)
            ));
        }
        // What leaves a body's place open leaves that of the whole open, once each.
        if let Some(words) = &body.pose.doubt {
            pose.doubt(format!("{}: {words}", body.name));
        }
        for shadow in body.pose.shadows.iter().filter(|shadow| shadow.bead.is_some()) {
            if let Some(known) = pose.shadows.iter_mut().find(|known| known.image_px == shadow.image_px) {
                known.bead.clone_from(&shadow.bead);
            }
        }
        if body.moved {
            pose.cautions.push(format!(
                "{} has moved against {reference} since the scan, by {:.2}° and {:.2} mm: a DRR follows where its scene names that body",
                body.name, body.angle_deg, body.shift_mm
            ));
        }
    }
    let mm_per_px = pose.rms_mm.zip(pose.rms_px).map_or(f64::NAN, |(mm, px)| mm / px);
    let row = |bead: &Bead, check: bool| {
        let solved = beads.iter().find(|row| row.name == bead.name).cloned();
        let why = unplaced.iter().find(|(body, _)| **body == bead.body);
        let why = why.map_or("too few of its beads are seen, or they do not fit", |(_, why)| why.as_str());
        let without = format!("its body gave no pose of its own: {why}");
        solved.unwrap_or_else(|| BeadResidual { check, ..request.row(bead, &without) })
    };
    let checks = request.layout.checks.iter().map(|bead| row(bead, true));
    pose.beads = all.iter().map(|bead| row(bead, false)).chain(checks).collect();
    pose.unseen = Unseen::of(&pose.beads, mm_per_px);
    pose
}

//! The bundle adjustment of shots: arm, joints, bead places and the specimen's place in the room, by the one least-squares core.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use nalgebra::DMatrix;

use super::Sensors;
use super::parameters::{Parameter, moved};
use super::shot::{JOINTS, Shot, ShotBeads};
use crate::beads::DEFAULT_SIGMA_MM;
use crate::estimate::{BeadImage, EstimateError, Freedom, Loss, Place, Problem, Reading, Settings, VectorBlock};
use crate::geometry::{CarmCalibration, CarmCalibrationError, CarmJoints, Intrinsics, Rigid};

/// The arm as some shots have it.
#[derive(Clone, Debug)]
pub(super) struct Solution {
    pub calibration: CarmCalibration,
    pub world_from_lps: Rigid,
    /// Where `world_from_lps` turns.
    pub pivot_lps_mm: DVec3,
    /// Of each parameter, in prior standard deviations.
    pub sigmas: Vec<f64>,
    /// Of the parameters, in prior standard deviations, then of (ω, v) of `world_from_lps` about its pivot, rad and mm.
    pub covariance: DMatrix<f64>,
    /// Σ of squares in standard deviations, over beads, readings and priors.
    pub chi2: f64,
    pub degrees_of_freedom: i64,
    /// Of each shot: √mean(dx² + dy²) over its beads, px, and its readings' offset in standard deviations, √mean over joints.
    pub shots: Vec<(f64, f64)>,
}

/// Where joint readings alone put the specimen in the camera.
pub(super) fn predicted(
    carm: &CarmCalibration,
    world_from_lps: &Rigid,
    joints: &CarmJoints,
) -> Result<(Rigid, Intrinsics), CarmCalibrationError> {
    Ok((carm.world_from_camera(joints)?.inverse() * *world_from_lps, carm.intrinsics(joints)?))
}

/// The middle of the beads of all shots.
pub(super) fn centre_lps_mm(shots: &[&Shot]) -> DVec3 {
    let beads = || shots.iter().flat_map(|shot| &shot.beads);
    beads().map(|bead| bead.lps_mm).sum::<DVec3>() / beads().count().max(1) as f64
}

/// Where most shots put the specimen in the room by `nominal`: the one nearest to all others.
fn start(nominal: &CarmCalibration, shots: &[&Shot]) -> Result<Rigid, CarmCalibrationError> {
    let ties = shots.iter().map(|shot| Ok(nominal.world_from_camera(&shot.joints)? * shot.camera_from_lps));
    let ties: Vec<Rigid> = ties.collect::<Result<_, CarmCalibrationError>>()?;
    let centre = centre_lps_mm(shots);
    let far = |a: &Rigid| -> f64 {
        ties.iter().map(|b| a.transform_point(centre).distance(b.transform_point(centre)) + 100.0 * a.angle_to_rad(b)).sum()
    };
    let best = ties.iter().min_by(|a, b| far(a).total_cmp(&far(b)));
    Ok(best.copied().unwrap_or(Rigid::IDENTITY))
}

/// Solves for everything, from nominal.
pub(super) fn solve(
    shots: &[&Shot],
    nominal: &CarmCalibration,
    parameters: &[Parameter],
    sensors: &Sensors,
) -> Result<Solution, super::CarmFitError> {
    let mut problem = Problem::new();
    let pivot_lps_mm = centre_lps_mm(shots);
    let tie = problem.pose("world_from_lps", start(nominal, shots)?, pivot_lps_mm, true);
    let zeros = vec![0.0; parameters.len()];
    let arm = problem.vector("arm", &zeros, Freedom::All);
    problem.add(Reading::with_sigmas(arm, &zeros, &vec![1.0; parameters.len()]), Loss::None);
    let mut places: BTreeMap<&str, VectorBlock> = BTreeMap::new();
    for bead in shots.iter().flat_map(|shot| &shot.beads) {
        if !places.contains_key(bead.name.as_str()) {
            let at = bead.lps_mm.to_array();
            let place = problem.vector("bead", &at, Freedom::All);
            problem.add(Reading::with_sigmas(place, &at, &[DEFAULT_SIGMA_MM; 3]), Loss::None);
            places.insert(&bead.name, place);
        }
    }
    let mut residuals = Vec::new();
    for shot in shots {
        let readings = shot.joints.to_array();
        let joints = problem.eliminated("joints", &readings[..JOINTS]);
        let reading = problem.add(Reading::with_sigmas(joints, &readings[..JOINTS], &sensors.sigmas()), Loss::None);
        let places: Vec<VectorBlock> = shot.beads.iter().map(|bead| places[bead.name.as_str()]).collect();
        let ids = [arm.id(), tie.id(), joints.id()].into_iter().chain(places.iter().map(VectorBlock::id)).collect();
        let beads = problem.add(ShotBeads { nominal, parameters, shot, arm, tie, joints, places, ids }, Loss::None);
        residuals.push((beads, reading));
    }
    let estimate = problem.solve(&Settings { step_sigmas: 1e-5, ..Settings::default() })?;
    let covariance = estimate.covariance()?.of(&[arm.id(), tie.id()]);
    let of_shot = |(beads, reading): &(usize, usize)| {
        let squares: f64 = estimate.offset(*beads).iter().map(|px| px * px).sum();
        let count = estimate.offset(*beads).len() / 2;
        ((squares / count.max(1) as f64).sqrt(), (estimate.chi2(*reading) / JOINTS as f64).sqrt())
    };
    Ok(Solution {
        calibration: moved(nominal, parameters, estimate.state().vector(arm)),
        world_from_lps: *estimate.state().pose(tie),
        pivot_lps_mm,
        sigmas: covariance.diagonal().iter().take(parameters.len()).map(|variance| variance.sqrt()).collect(),
        covariance,
        chi2: estimate.chi2_sum(),
        degrees_of_freedom: estimate.degrees_of_freedom(),
        shots: residuals.iter().map(of_shot).collect(),
    })
}

/// The specimen in the camera by a shot's beads alone, seen through `intrinsics`.
pub(super) fn by_beads(shot: &Shot, intrinsics: &Intrinsics) -> Result<Rigid, EstimateError> {
    let mut problem = Problem::new();
    let camera = problem.pose("camera_from_lps", shot.camera_from_lps, centre_lps_mm(&[shot]), true);
    let Intrinsics { fx, fy, skew, cx, cy } = *intrinsics;
    let k = problem.vector("intrinsics", &[fx, fy, skew, cx, cy], Freedom::Constant);
    for bead in &shot.beads {
        let place = Place::Known {
            body_mm: bead.lps_mm,
            covariance_mm2: glam::DMat3::from_diagonal(DVec3::splat(DEFAULT_SIGMA_MM.powi(2))),
            share: 1.0,
        };
        let variance = bead.sigma_px.powi(2);
        problem.add(BeadImage::new(camera, k, place, bead.image_px, [variance, 0.0, variance]), Loss::None);
    }
    Ok(*problem.solve(&Settings::default())?.state().pose(camera))
}

/// How far a predicted camera is from the one that the beads show.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct CameraError {
    /// Between the piercing points on the detector of the ray from the focal spot through the isocentre, mm.
    pub piercing_mm: f64,
    /// Between the directions of that ray in the specimen, degrees.
    pub ray_deg: f64,
    /// Between the attitudes of the cameras, the panel's turn in its plane included, degrees.
    pub attitude_deg: f64,
    /// Between the places of the isocentre in the cameras, along x, y and z, mm.
    pub isocentre_mm: [f64; 3],
}

impl CameraError {
    /// `predicted` against `seen`, each (camera_from_lps, K), for a panel of `pitch_mm` and an isocentre at `source_to_isocentre_mm`.
    #[must_use]
    pub fn between(
        predicted: (&Rigid, &Intrinsics),
        seen: (&Rigid, &Intrinsics),
        source_to_isocentre_mm: f64,
        pitch_mm: f64,
    ) -> Self {
        let in_predicted = DVec3::new(0.0, 0.0, source_to_isocentre_mm);
        let isocentre = predicted.0.inverse().transform_point(in_predicted);
        let in_seen = seen.0.transform_point(isocentre);
        let pierced = |k: &Intrinsics, p: DVec3| -> DVec2 { k.project(p) };
        let ray = |camera: &Rigid| isocentre - camera.inverse().translation_mm;
        Self {
            piercing_mm: pierced(predicted.1, in_predicted).distance(pierced(seen.1, in_seen)) * pitch_mm,
            ray_deg: ray(predicted.0).angle_between(ray(seen.0)).to_degrees(),
            attitude_deg: predicted.0.angle_to_rad(seen.0).to_degrees(),
            isocentre_mm: (in_predicted - in_seen).to_array(),
        }
    }
}

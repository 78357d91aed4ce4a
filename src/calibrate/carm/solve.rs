//! The bundle adjustment of shots: arm, joints, bead places and the specimen's place in the room, by the one least-squares core.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use nalgebra::DMatrix;

use super::Sensors;
use super::parameters::{Parameter, moved};
use super::shot::{JOINTS, Shot, ShotBeads};
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

/// Solves for everything, from nominal; all shots state the same of a bead's place.
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
            let place = problem.vector("bead", &bead.lps_mm.to_array(), Freedom::All);
            problem.add(Reading::of_place(place, bead.lps_mm, &bead.place_mm2), Loss::None);
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
        let place = Place::Known { body_mm: bead.lps_mm, covariance_mm2: bead.place_mm2, share: 1.0 };
        problem.add(BeadImage::new(camera, k, place, bead.image_px, bead.noise_px2), Loss::None);
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

#[cfg(test)]
mod tests {
    use glam::{DMat3, DQuat};
    use nalgebra::DVector;

    use super::super::shot::ShotBead;
    use super::*;
    use crate::estimate::{about, deviation};
    use crate::random::{Purpose, Stream};

    /// Beads of a CT of thick slices, along its axes.
    const PLACE_MM: DVec3 = DVec3::new(0.05, 0.05, 0.8);
    /// Shadows that moved while the beam was on: along their way and across it.
    const SHADOW_PX: [f64; 2] = [0.3, 0.04];
    const SENSORS: Sensors = Sensors { sigma_deg: 0.02, sigma_mm: 0.1 };
    const DRAWS: u64 = 16;

    fn nominal() -> CarmCalibration {
        serde_json::from_str(include_str!("../../../calibration/carm/nominal-mobile.json")).expect("a calibration of the project")
    }

    /// An arm of a few unknowns, drawn from their priors, and its shots; all else is off by what is stated of it.
    struct Drawn {
        parameters: Vec<Parameter>,
        carm: CarmCalibration,
        world_from_lps: Rigid,
        shots: Vec<Shot>,
    }

    impl Drawn {
        fn new(seed: u64) -> Self {
            let mut random = Stream::new(seed, 61, 0, Purpose::Evaluation);
            let mut carm = nominal();
            let is_unknown = |parameter: &Parameter| {
                let lengths = ["source_to_isocentre_mm", "offsets.source_to_detector_mm"];
                lengths.contains(&parameter.key.as_str()) || parameter.key.starts_with("principal_point_px")
            };
            let parameters: Vec<Parameter> = Parameter::all(carm.pitch_mm).into_iter().filter(is_unknown).collect();
            parameters.iter().for_each(|parameter| parameter.shift(&mut carm, random.normal()));
            // About the isocentre, the slices across the axis of the orbit.
            let translation_mm = DVec3::new(805.0, -4.0, 1022.0);
            let world_from_lps = Rigid { rotation: DQuat::from_rotation_x(1.5), translation_mm };
            let mut beads: Vec<(DVec3, DVec3)> = Vec::new();
            for _ in 0..8 {
                let mut normal = || DVec3::new(random.normal(), random.normal(), random.normal());
                let truth = normal().normalize() * 60.0;
                beads.push((truth, truth + normal() * PLACE_MM));
            }
            let mut shots = Vec::new();
            for n in 0..10 {
                let mut within = |half: f64| half * (2.0 * random.uniform() - 1.0);
                let orbital_deg: f64 = -81.0 + 18.0 * n as f64 + within(5.0);
                let angulation_deg: f64 = [-20.0, 20.0, 0.0][n % 3] + within(4.0);
                let [lift_mm, longitudinal_mm] = [20.0 + within(10.0), within(20.0)];
                let truth = [lift_mm, 0.05, longitudinal_mm, angulation_deg.to_radians(), orbital_deg.to_radians(), 0.1, 1020.0];
                let mut read = truth;
                read.iter_mut().zip(SENSORS.sigmas()).for_each(|(joint, sigma)| *joint += sigma * random.normal());
                let seen = predicted(&carm, &world_from_lps, &CarmJoints::from_array(truth));
                let (camera_from_lps, k) = seen.expect("all joints");
                let along = DVec2::from_angle(0.6 * n as f64);
                let [long, short] = SHADOW_PX;
                let (wide, least) = (long * long - short * short, short * short);
                let noise_px2 = [least + wide * along.x * along.x, wide * along.x * along.y, least + wide * along.y * along.y];
                let bead = |(b, (truth, stated)): (usize, &(DVec3, DVec3))| {
                    let noise = along * (long * random.normal()) + along.perp() * (short * random.normal());
                    ShotBead {
                        name: format!("bead-{b}"),
                        lps_mm: *stated,
                        image_px: k.project(camera_from_lps.transform_point(*truth)) + noise,
                        noise_px2,
                        place_mm2: DMat3::from_diagonal(PLACE_MM * PLACE_MM),
                    }
                };
                let beads = beads.iter().enumerate().map(bead).collect();
                let joints = CarmJoints::from_array(read);
                shots.push(Shot { name: format!("shot-{n}"), size_px: [1536, 1536], joints, beads, camera_from_lps });
            }
            Self { parameters, carm, world_from_lps, shots }
        }

        /// The same shots, all that is known of places and shadows being alike along all directions, and as much in the mean.
        fn alike(&self) -> Vec<Shot> {
            let mut shots = self.shots.clone();
            for bead in shots.iter_mut().flat_map(|shot| &mut shot.beads) {
                let [uu, _, vv] = bead.noise_px2;
                bead.noise_px2 = [0.5 * (uu + vv), 0.0, 0.5 * (uu + vv)];
                bead.place_mm2 = DMat3::from_diagonal(DVec3::splat(PLACE_MM.length_squared() / 3.0));
            }
            shots
        }

        fn solved(&self, shots: &[Shot]) -> Solution {
            let shots: Vec<&Shot> = shots.iter().collect();
            solve(&shots, &nominal(), &self.parameters, &SENSORS).expect("they tell an arm")
        }

        /// What is off, in the order of [`Solution::covariance`].
        fn off(&self, found: &Solution) -> DVector<f64> {
            let of = |own: &Parameter| (own.value(&self.carm) - own.value(&found.calibration)) / own.prior_sigma;
            let centre = found.world_from_lps.transform_point(found.pivot_lps_mm);
            let tie = about(centre) * deviation(&self.world_from_lps, &found.world_from_lps);
            let count = self.parameters.len() + 6;
            DVector::from_iterator(count, self.parameters.iter().map(of).chain(tie.iter().copied()))
        }
    }

    /// The truth, arm and place in the room, lies as far off as is stated, over draws.
    #[test]
    fn what_is_stated_holds_where_beads_are_known_far_worse_along_one_axis() {
        let (mut own, mut alike, mut numbers) = (0.0, 0.0, 0.0);
        for seed in 0..DRAWS {
            let drawn = Drawn::new(seed);
            let found = drawn.solved(&drawn.shots);
            let stated = found.covariance.clone().cholesky().expect("positive definite");
            let sigmas2 = |found: &Solution| {
                let off = drawn.off(found);
                off.dot(&stated.solve(&off))
            };
            own += sigmas2(&found);
            alike += sigmas2(&drawn.solved(&drawn.alike()));
            numbers += found.covariance.nrows() as f64;
        }
        // χ² of n numbers scatters by √(2 n) about n; 4.5 times that is accident once in some 100 000 times.
        let most = 4.5 * (2.0 * numbers).sqrt();
        assert!((own - numbers).abs() < most, "{own} of {numbers} ± {most}");
        // The control: weights that are alike along all directions put the same shots further off than these state.
        assert!(alike > 3.0 * numbers, "{alike} of {numbers}");
    }
}

//! A shot: shadows that may be beads, and roughly where its camera was.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{Matrix6, Vector6};

use crate::beads::known_at_best;
use crate::calibrate::carm::Sensors;
use crate::estimate::about;
use crate::geometry::{CarmCalibration, CarmCalibrationError, CarmJoints, Intrinsics, Rigid};
use crate::pose::{Covariance, PRIOR_SIGMA, Prior};

/// A shadow that may be a bead's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShotShadow {
    /// Its centre.
    pub image_px: DVec2,
    /// Covariance of the centre: uu, uv, vv.
    pub noise_px2: [f64; 3],
    /// Its radius, where the frame's values tell it.
    pub radius_px: Option<f64>,
}

/// No shadow is better than this along any direction.
const LEAST_SIGMA_PX: f64 = 0.01;

impl ShotShadow {
    /// What it is weighed by: its covariance, nowhere less than a shadow can be known.
    pub(super) fn weighed_px2(&self) -> [f64; 3] {
        known_at_best(self.noise_px2, LEAST_SIGMA_PX)
    }

    /// Standard deviation per axis, the mean of both.
    pub(super) fn sigma_px(&self) -> f64 {
        (0.5 * (self.noise_px2[0] + self.noise_px2[2])).sqrt()
    }
}

/// A shot.
#[derive(Clone, Debug, PartialEq)]
pub struct PhantomShot {
    /// How people call it.
    pub name: String,
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// K.
    pub intrinsics: Intrinsics,
    /// Where the camera is expected.
    pub camera_from_world: Rigid,
    /// Of ξ in exp(ξ̂)·camera_from_world, rad and mm, independent of all other shots.
    pub covariance: Covariance,
    /// What may be beads, best first.
    pub shadows: Vec<ShotShadow>,
}

/// What may be wrong with K and with all cameras alike, one standard deviation; 0: known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraErrors {
    /// From the focal spot to the world, along the beam.
    pub depth_mm: f64,
    /// Of the focal length in all shots alike, as a share of it.
    pub focal: f64,
    /// Of the principal point in all shots alike, per axis.
    pub principal_point_px: f64,
    /// Of each focal length by itself, as a share of it.
    pub each_focal: f64,
    /// Of each principal point by itself, per axis.
    pub each_principal_point_px: f64,
}

/// How far an arm is from what its calibration and its encoders say, one standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmSigma {
    /// Encoders.
    pub encoders: Sensors,
    /// Of each camera's attitude by itself, per axis.
    pub each_deg: f64,
    /// Of the isocentre in each camera by itself, per axis.
    pub each_mm: f64,
    /// From the focal spot to the isocentre, in all shots alike.
    pub source_to_isocentre_mm: f64,
    /// From the focal spot to the detector, in all shots alike.
    pub source_to_detector_mm: f64,
    /// Of the principal point on the detector, in all shots alike.
    pub principal_point_mm: f64,
    /// Of the detector against the focal spot in each shot by itself, per axis.
    pub each_detector_mm: f64,
}

impl ArmSigma {
    /// A calibrated arm states how far its cameras are off, encoders included; one as drawn sags by some degrees and millimetres.
    #[must_use]
    pub fn of(carm: &CarmCalibration) -> Self {
        match carm.camera_sigma_deg.zip(carm.camera_sigma_mm) {
            Some((each_deg, each_mm)) => Self {
                encoders: Sensors { sigma_deg: 0.0, sigma_mm: 0.0 },
                each_deg,
                each_mm,
                source_to_isocentre_mm: 1.0,
                source_to_detector_mm: 1.0,
                principal_point_mm: 1.0,
                each_detector_mm: 0.2,
            },
            None => Self {
                encoders: Sensors::default(),
                each_deg: 1.0,
                each_mm: 6.0,
                source_to_isocentre_mm: 10.0,
                source_to_detector_mm: 3.0,
                principal_point_mm: 5.0,
                each_detector_mm: 3.0,
            },
        }
    }

    /// What of it concerns K, or all cameras alike.
    #[must_use]
    pub fn errors(&self, carm: &CarmCalibration, intrinsics: &Intrinsics) -> CameraErrors {
        let distance_mm = intrinsics.source_to_detector_mm(carm.pitch_mm);
        CameraErrors {
            depth_mm: self.source_to_isocentre_mm,
            focal: self.source_to_detector_mm / distance_mm,
            principal_point_px: self.principal_point_mm / carm.pitch_mm,
            each_focal: self.each_detector_mm / distance_mm,
            each_principal_point_px: self.each_detector_mm / carm.pitch_mm,
        }
    }
}

/// Where the cameras were, roughly: with each its K and its covariance.
pub struct Cameras;

/// What no arm is better known to than: keeps the information finite where the joints leave a direction exact.
const LEAST: (f64, f64) = (1e-5, 0.005);
/// Steps of central differences, mm and rad.
const STEP: (f64, f64) = (1e-2, 1e-5);

impl Cameras {
    /// The camera in the room by the joints, K, and the covariance of ξ.
    ///
    /// # Errors
    /// When a joint or the distance to the detector is not measured.
    pub fn by_joints(
        carm: &CarmCalibration,
        joints: &CarmJoints,
        sigma: &ArmSigma,
    ) -> Result<(Rigid, Intrinsics, Covariance), CarmCalibrationError> {
        let at = |joints: &CarmJoints| carm.world_from_camera(joints).map(Rigid::inverse);
        let (camera, intrinsics) = (at(joints)?, carm.intrinsics(joints)?);
        let isocentre = DVec3::Z * carm.source_to_isocentre_mm;
        let each = (sigma.each_deg.to_radians(), sigma.each_mm);
        let mut covariance = about_point(isocentre, [each.0, each.1]) + about_point(isocentre, [LEAST.0, LEAST.1]);
        for joint in 0..6 {
            let is_length = matches!(joint, 0 | 2);
            let (step, sigma) = match is_length {
                true => (STEP.0, sigma.encoders.sigma_mm),
                false => (STEP.1, sigma.encoders.sigma_deg.to_radians()),
            };
            let moved = |by: f64| {
                let mut all = joints.to_array();
                all[joint] += by;
                at(&CarmJoints::from_array(all))
            };
            let (turn, shift) = (moved(step)? * moved(-step)?.inverse()).log();
            let slope = Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z) * (0.5 * sigma / step);
            covariance += slope * slope.transpose();
        }
        Ok((camera, intrinsics, rows(&covariance)))
    }

    /// The covariances of prior poses: as stated, else those of any prior about the point nearest to all principal rays.
    #[must_use]
    pub fn by_priors(priors: &[Prior]) -> Vec<Covariance> {
        let cameras: Vec<Rigid> = priors.iter().map(|prior| prior.camera_from_lps).collect();
        let middle = middle_of(&cameras);
        let own = |prior: &Prior| {
            let centre = prior.camera_from_lps.transform_point(middle);
            prior.covariance.unwrap_or_else(|| rows(&about_point(centre, [PRIOR_SIGMA.0, PRIOR_SIGMA.1])))
        };
        priors.iter().map(own).collect()
    }
}

/// The covariance of ξ about the origin, from independent (ω, v) of these standard deviations (rad, mm) about `centre`.
fn about_point(centre: DVec3, [rad, mm]: [f64; 2]) -> Matrix6<f64> {
    let own = Matrix6::from_diagonal(&Vector6::new(rad, rad, rad, mm, mm, mm).map(|sigma| sigma * sigma));
    let to_origin = about(-centre);
    to_origin * own * to_origin.transpose()
}

fn rows(matrix: &Matrix6<f64>) -> Covariance {
    std::array::from_fn(|i| std::array::from_fn(|j| matrix[(i, j)]))
}

/// The point nearest to the principal rays of all cameras; 600 mm before the first where they are parallel.
pub(super) fn middle_of(cameras: &[Rigid]) -> DVec3 {
    let rays = cameras.iter().map(|camera| {
        let world_from_camera = camera.inverse();
        (world_from_camera.translation_mm, world_from_camera.transform_vector(DVec3::Z))
    });
    let ahead = cameras.first().map_or(DVec3::ZERO, |camera| camera.inverse().transform_point(DVec3::Z * 600.0));
    nearest(rays).unwrap_or(ahead)
}

/// The point with the least sum of squared distances to rays (origin, unit direction).
pub(super) fn nearest(rays: impl Iterator<Item = (DVec3, DVec3)>) -> Option<DVec3> {
    let (mut sum, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for (origin, way) in rays {
        let across = DMat3::IDENTITY - DMat3::from_cols(way * way.x, way * way.y, way * way.z);
        sum += across;
        right += across * origin;
    }
    let determinant = sum.determinant();
    (determinant > 1e-4).then(|| sum.inverse() * right).filter(|point| point.is_finite())
}

//! Where one frame of a session puts the specimen, and how far two of them are apart.

use glam::DVec3;

use crate::geometry::{CarmJoints, Rigid};

/// Joints that differ by no more are the same stand: mm and rad. Over so little an arm sags alike.
const SAME_MM: f64 = 10.0;
const SAME_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;

/// A mobile arm sags by 16 mm, differently at every angle: so much more is allowed for each degree between two beams.
pub(super) const SAG_MM_PER_DEG: f64 = 0.1;
/// Standard deviations of both poses that are added to what two frames may differ by.
pub(super) const SIGMAS: f64 = 4.0;

/// A frame's word of where the specimen is.
#[derive(Clone, Debug)]
pub(super) struct Stand {
    pub(super) number: u32,
    pub(super) joints: CarmJoints,
    pub(super) world_from_lps: Rigid,
    /// Along +z of the camera.
    pub(super) beam_in_world: DVec3,
    /// Of the specimen from the focal spot.
    pub(super) depth_mm: f64,
    pub(super) sigma_mm: f64,
    pub(super) sigma_depth_mm: f64,
}

impl Stand {
    /// Whether the arm stands where it stood for the other; joints without an encoder are NaN in both.
    pub(super) fn is_where(&self, other: &Self) -> bool {
        let (a, b) = (&self.joints, &other.joints);
        let within = |a: f64, b: f64, limit: f64| (a.is_nan() && b.is_nan()) || (a - b).abs() <= limit;
        let turned = |a: f64, b: f64| (a.is_nan() && b.is_nan()) || crate::units::wrap_rad(a - b).abs() <= SAME_RAD;
        within(a.lift_mm, b.lift_mm, SAME_MM)
            && within(a.longitudinal_mm, b.longitudinal_mm, SAME_MM)
            && within(a.source_to_detector_mm, b.source_to_detector_mm, SAME_MM)
            && turned(a.wig_wag_rad, b.wig_wag_rad)
            && turned(a.angulation_rad, b.angulation_rad)
            && turned(a.orbital_rad, b.orbital_rad)
            && turned(a.detector_rotation_rad, b.detector_rotation_rad)
    }

    /// How far lift and longitudinal axis are apart; an axis without an encoder counts as none.
    pub(super) fn travel_mm(&self, other: &Self) -> f64 {
        let (a, b) = (&self.joints, &other.joints);
        let apart_mm = [a.lift_mm - b.lift_mm, a.longitudinal_mm - b.longitudinal_mm];
        apart_mm.iter().filter(|mm| mm.is_finite()).map(|mm| mm.abs()).sum()
    }

    /// Between the two beams.
    pub(super) fn beams_deg(&self, other: &Self) -> f64 {
        self.beam_in_world.angle_between(other.beam_in_world).to_degrees()
    }

    /// Of its place across the beam.
    pub(super) fn sigma_across_mm(&self) -> f64 {
        (self.sigma_mm.powi(2) - self.sigma_depth_mm.powi(2)).max(0.0).sqrt()
    }
}

#[cfg(test)]
impl Stand {
    /// With the arm at an orbital angle, the specimen at a place in the room, for tests.
    pub(super) fn at(number: u32, orbital_deg: f64, place_mm: DVec3, sigma_mm: f64) -> Self {
        let joints = CarmJoints { orbital_rad: orbital_deg.to_radians(), lift_mm: f64::NAN, ..CarmJoints::ZERO };
        let turn = Rigid::exp(DVec3::Y * orbital_deg.to_radians(), DVec3::ZERO);
        let (beam_in_world, world_from_lps) = (turn.transform_vector(DVec3::Z), Rigid::translation(place_mm));
        Self { number, joints, world_from_lps, beam_in_world, depth_mm: 700.0, sigma_mm, sigma_depth_mm: sigma_mm }
    }
}

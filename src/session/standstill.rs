//! A specimen that moves while the arm stands still: what sag and an uncalibrated arm explain is the same for both frames, so far less is
//! allowed than between any two.

use std::collections::VecDeque;

use glam::DVec3;

use super::posing::Posed;
use crate::geometry::{CarmJoints, Rigid};

/// Joints that differ by no more are the same stand: mm and rad. Over so little an arm sags alike.
const SAME_MM: f64 = 10.0;
const SAME_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;
/// Sensors of ±0.2° in three joints, 630 mm away, twice.
const MOVED_MM: f64 = 6.0;
const MOVED_DEG: f64 = 1.5;
/// Standard deviations of both poses that are added to it.
const SIGMAS: f64 = 4.0;
/// Frames that are remembered.
const KEPT: usize = 32;

#[derive(Clone, Debug)]
struct Stand {
    number: u32,
    joints: CarmJoints,
    world_from_lps: Rigid,
    sigma_mm: f64,
}

/// See the module.
#[derive(Clone, Debug)]
pub(super) struct Standstill {
    centre_lps_mm: DVec3,
    /// In the order in which they were registered.
    stands: VecDeque<Stand>,
}

impl Standstill {
    pub(super) fn new(centre_lps_mm: DVec3) -> Self {
        Self { centre_lps_mm, stands: VecDeque::new() }
    }

    /// Takes a posed frame and where its beads put the specimen; words where a frame at the same stand put it elsewhere.
    pub(super) fn observe(&mut self, posed: &Posed, world_from_lps: Option<Rigid>) -> Option<String> {
        let (joints, world_from_lps) = posed.joints.zip(world_from_lps)?;
        let covariance = posed.pose.covariance_at_centroid?;
        let sigma_mm = (3..6).map(|n| covariance[n][n]).sum::<f64>().sqrt();
        let now = Stand { number: posed.number, joints, world_from_lps, sigma_mm };
        let words =
            self.stands.iter().rev().find(|before| is_same(&before.joints, &now.joints)).and_then(|b| self.moved(b, &now));
        self.stands.push_back(now);
        if self.stands.len() > KEPT {
            self.stands.pop_front();
        }
        words
    }

    fn moved(&self, before: &Stand, now: &Stand) -> Option<String> {
        let at = |stand: &Stand| stand.world_from_lps.transform_point(self.centre_lps_mm);
        let (mm, deg) = (at(before).distance(at(now)), before.world_from_lps.angle_to_rad(&now.world_from_lps).to_degrees());
        let allowed_mm = MOVED_MM + SIGMAS * before.sigma_mm.hypot(now.sigma_mm);
        (mm > allowed_mm || deg > MOVED_DEG).then(|| {
            format!(
                "the specimen lies {mm:.1} mm and {deg:.1} degrees from where frame {} shows it, with the arm in the same place: specimen, \
                 table or the arm's base was moved, or an encoder jumped",
                before.number
            )
        })
    }
}

/// Whether two readings are one stand of the arm; joints without an encoder are NaN in both.
fn is_same(a: &CarmJoints, b: &CarmJoints) -> bool {
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

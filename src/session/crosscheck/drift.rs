//! Telemetry against the beads over frames: differences that are no jump, each by itself, and the same every time.

use std::collections::VecDeque;

use glam::DVec3;

use super::exposure::TELEMETRY_AND_BEADS;
use super::finding::Finding;
use crate::geometry::Rigid;
use crate::pose::TelemetryInnovation;

/// So many frames in a row tell.
const FRAMES: usize = 5;
/// Squares of their common part beyond which it is no accident. Of six equal numbers once in 25 000 times; where one axis is less sure than
/// the others, more often.
const COMMON_CHI2: f64 = 30.0;
/// Frames are of one stand where the camera has turned and moved by no more: degrees, mm.
const SAME_STAND: (f64, f64) = (2.0, 10.0);

/// One frame's difference in the axes of the specimen, turn and shift.
#[derive(Clone, Copy, Debug)]
struct Difference {
    /// In standard deviations, the mean over axes.
    in_sigmas: [DVec3; 2],
    /// Degrees and mm.
    measured: [DVec3; 2],
    /// From where the specimen was seen.
    lps_from_camera: Rigid,
}

/// See the module.
#[derive(Clone, Debug, Default)]
pub struct DriftWatch {
    latest: VecDeque<Difference>,
    told: bool,
}

impl DriftWatch {
    /// Takes an accepted frame's difference; a finding where the latest agree beyond chance, once. A jump is said by itself, and the frames
    /// after it are counted anew.
    pub fn take(&mut self, innovation: &TelemetryInnovation) -> Option<Finding> {
        if innovation.is_jump() {
            *self = Self::default();
            return None;
        }
        let lps_from_camera = innovation.camera_from_lps.inverse();
        let in_lps = |numbers: [f64; 3]| lps_from_camera.transform_vector(DVec3::from_array(numbers));
        let measured = [in_lps(innovation.turn_deg), in_lps(innovation.shift_mm)];
        let usual = |sigmas: [f64; 3]| DVec3::from_array(sigmas).length() / 3f64.sqrt();
        let in_sigmas = [measured[0] / usual(innovation.sigma_deg), measured[1] / usual(innovation.sigma_mm)];
        // At one stand the arm errs alike in every frame: the latest one counts.
        let is_same_stand = |other: &Difference| {
            let (turn_deg, shift_mm) = SAME_STAND;
            other.lps_from_camera.angle_to_rad(&lps_from_camera).to_degrees() <= turn_deg
                && other.lps_from_camera.translation_mm.distance(lps_from_camera.translation_mm) <= shift_mm
        };
        self.latest.retain(|other| !is_same_stand(other));
        self.latest.push_back(Difference { in_sigmas, measured, lps_from_camera });
        if self.latest.len() > FRAMES {
            self.latest.pop_front();
        }
        if self.told || self.latest.len() < FRAMES {
            return None;
        }
        let sum = |of: fn(&Difference) -> DVec3| self.latest.iter().map(of).sum::<DVec3>();
        let squares = sum(|one| one.in_sigmas[0]).length_squared() + sum(|one| one.in_sigmas[1]).length_squared();
        // Half of each variance is that of the frame that tied the specimen to the room, the same in all of them: n²/2 + n/2.
        let frames = FRAMES as f64;
        if !(squares / (0.5 * frames * (frames + 1.0)) > COMMON_CHI2) {
            return None;
        }
        self.told = true;
        let mean = |of: fn(&Difference) -> DVec3| sum(of).length() / frames;
        let detail = format!(
            "in the latest {FRAMES} frames telemetry is off the beads in the same way, {:.1} mm and {:.2} degrees in the mean, which neither \
             encoders nor beads do by accident",
            mean(|one| one.measured[1]),
            mean(|one| one.measured[0])
        );
        let remedy =
            "the arm, its base or the specimen has shifted so far: tie the specimen anew; if it stays, calibrate the arm anew";
        Some(Finding::warn(TELEMETRY_AND_BEADS, detail, remedy))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A difference along the specimen's x, seen from a camera that is turned by `turn_rad`, in standard deviations.
    fn off(sigmas: f64, turn_rad: f64) -> TelemetryInnovation {
        let camera_from_lps = Rigid::exp(DVec3::Y * turn_rad, DVec3::new(0.0, 0.0, 600.0));
        let shift_mm = camera_from_lps.transform_vector(DVec3::X * sigmas * 0.5).to_array();
        TelemetryInnovation {
            chi2: sigmas * sigmas,
            degrees_of_freedom: 6,
            turn_deg: [0.0; 3],
            shift_mm,
            sigma_deg: [0.1; 3],
            sigma_mm: [0.5; 3],
            camera_from_lps,
        }
    }

    fn told(differences: &[TelemetryInnovation]) -> Vec<usize> {
        let mut watch = DriftWatch::default();
        (0..differences.len()).filter(|n| watch.take(&differences[*n]).is_some()).collect()
    }

    #[test]
    fn what_is_off_in_the_same_way_is_said_once_and_what_alternates_is_not() {
        let turns = [0.0, 0.4, -0.6, 1.2, 0.9, -1.0, 0.2, 0.5];
        assert_eq!(told(&turns.map(|turn| off(4.5, turn))), [4], "once, at the fifth frame, from wherever the specimen is seen");
        let alternating: Vec<TelemetryInnovation> =
            (0..40).map(|n| off(if n % 2 == 0 { 4.5 } else { -4.5 }, 0.3 * f64::from(n % 6))).collect();
        assert!(told(&alternating).is_empty(), "each as far off, but not in one way");
        assert!(told(&turns.map(|turn| off(2.0, turn))).is_empty(), "the frame that tied the specimen may be off by so much");
        assert!(told(&(0..8).map(|n| off(4.5, 0.8 * f64::from(n))).map(turned_with_the_camera).collect::<Vec<_>>()).is_empty());
        // A jump is another matter, and begins anew.
        let mut broken = turns.map(|turn| off(4.5, turn));
        broken[3] = off(9.0, 0.0);
        assert!(told(&broken).is_empty(), "four after it");
    }

    /// The same difference along the camera's axes: not that of a specimen.
    fn turned_with_the_camera(innovation: TelemetryInnovation) -> TelemetryInnovation {
        TelemetryInnovation { shift_mm: [2.25, 0.0, 0.0], ..innovation }
    }
}

//! Telemetry as a measurement beside the beads: how good it is, how far it is from what they say, and the pose of both.
//!
//! The measurement is of the camera as beads show it through the arm's own K, in which they are solved as well: K's error is that of both.

use glam::DVec3;
use nalgebra::{Matrix6, Vector6};

use super::accept::rows_of;
use super::cautions::{is_of_header_k, is_of_looseness, is_of_round_field};
use super::prior::Prior;
use super::record::{Covariance, Pose, TelemetryInnovation};
use crate::estimate::{about, deviation};
use crate::geometry::{CarmCalibration, CarmJoints, Rigid};

/// So far beyond the angles of its shots an arm still bends as they say.
const BEYOND_DEG: f64 = 5.0;

fn matrix(rows: &Covariance) -> Matrix6<f64> {
    Matrix6::from_fn(|i, j| rows[i][j])
}

impl Prior {
    /// The specimen in the camera by the joints of a calibrated arm; `None` where its calibration does not say how good that is, or not at
    /// these angles. Where the specimen lies in the room was told by the joints of another frame, which err alike: variances count twice.
    #[must_use]
    pub fn by_joints(carm: &CarmCalibration, joints: &CarmJoints, camera_from_lps: Rigid) -> Option<Self> {
        let (mm, deg) = carm.camera_sigma_mm.zip(carm.camera_sigma_deg).filter(|(mm, deg)| *mm > 0.0 && *deg > 0.0)?;
        let within = |rad: f64, [low, high]: [f64; 2]| (low - BEYOND_DEG..=high + BEYOND_DEG).contains(&rad.to_degrees());
        if let Some([orbital, angulation]) = carm.calibrated_angles_deg
            && !(within(joints.orbital_rad, orbital) && within(joints.angulation_rad, angulation))
        {
            return None;
        }
        let rad = deg.to_radians();
        let variances = Vector6::new(rad, rad, rad, mm, mm, mm).map(|sigma| 2.0 * sigma * sigma);
        let to_focal_spot = about(DVec3::new(0.0, 0.0, -carm.source_to_isocentre_mm));
        let covariance = to_focal_spot * Matrix6::from_diagonal(&variances) * to_focal_spot.transpose();
        Some(Self { camera_from_lps, covariance: Some(rows_of(&covariance)) })
    }
}

/// How far `measured` is from `pose`, which does not rest on it, against the covariances of both; `None` where one has none.
#[must_use]
pub fn innovation(pose: &Pose, measured: &Prior) -> Option<TelemetryInnovation> {
    let (_, camera_from_lps) = pose.camera()?;
    innovation_of(&camera_from_lps, &pose.covariance?, pose.centroid_lps_mm?, measured)
}

/// The same of a camera that beads about `centroid_lps` gave with a covariance.
pub(super) fn innovation_of(
    camera_from_lps: &Rigid,
    by_beads: &Covariance,
    centroid_lps: DVec3,
    measured: &Prior,
) -> Option<TelemetryInnovation> {
    let by_telemetry = measured.covariance?;
    let to_centroid = about(camera_from_lps.transform_point(centroid_lps));
    let off = to_centroid * deviation(&measured.camera_from_lps, camera_from_lps);
    let both = to_centroid * (matrix(by_beads) + matrix(&by_telemetry)) * to_centroid.transpose();
    let chi2 = off.dot(&both.cholesky()?.solve(&off));
    let sigma = |n: usize| both[(n, n)].sqrt();
    Some(TelemetryInnovation {
        chi2,
        degrees_of_freedom: 6,
        turn_deg: [0, 1, 2].map(|n| off[n].to_degrees()),
        shift_mm: [3, 4, 5].map(|n| off[n]),
        sigma_deg: [0, 1, 2].map(|n| sigma(n).to_degrees()),
        sigma_mm: [3, 4, 5].map(sigma),
        camera_from_lps: *camera_from_lps,
    })
}

/// `measured`, less sure by the beads of the frame that tied the specimen to the room: they err about as much as those of `pose`, along
/// axes that nobody knows here.
fn with_the_tie(measured: &Prior, pose: &Pose) -> Option<Prior> {
    let (_, camera_from_lps) = pose.camera()?;
    let beads = matrix(&pose.covariance_at_centroid?);
    let mean = |first: usize| (first..first + 3).map(|n| beads[(n, n)]).sum::<f64>() / 3.0;
    let (turn, shift) = (mean(0), mean(3));
    let local = Matrix6::from_diagonal(&Vector6::new(turn, turn, turn, shift, shift, shift));
    let back = about(-camera_from_lps.transform_point(pose.centroid_lps_mm?));
    let covariance = matrix(&measured.covariance?) + back * local * back.transpose();
    Some(Prior { covariance: Some(rows_of(&covariance)), ..*measured })
}

/// The beads' pose and `measured` together, where they do not contradict each other; `register` solves the beads with a prior that is fused.
/// Where they do, the pose stays that of the beads and is in doubt. What the beads alone do not give telemetry does not give either.
#[must_use]
pub fn fuse(mut pose: Pose, measured: &Prior, register: &dyn Fn(&Prior) -> Pose) -> Pose {
    let Some(measured) = &with_the_tie(measured, &pose) else { return pose };
    let Some(innovation) = innovation(&pose, measured) else { return pose };
    if innovation.is_jump() {
        let length = |numbers: [f64; 3]| DVec3::from_array(numbers).length();
        pose.doubt(format!(
            "telemetry is {:.1} mm and {:.2} degrees from the beads, {:.0} standard deviations of both (by accident {:.1} at most), and is not \
             fused: something was moved, an encoder jumped, or the arm bends otherwise than when it was calibrated",
            length(innovation.shift_mm),
            length(innovation.turn_deg),
            innovation.chi2.sqrt(),
            TelemetryInnovation::MOST_SIGMAS
        ));
    } else {
        let both = register(measured);
        let used = |pose: &Pose| pose.beads.iter().filter(|bead| bead.used).map(|bead| bead.name.clone()).collect::<Vec<_>>();
        if both.is_accepted() && used(&both) == used(&pose) {
            let mut both = Pose { innovation: Some(innovation), ..both };
            // What the beads alone leave open telemetry does not settle, but for how tightly the pose is held: that is said of both.
            let is_told_anew = |words: &str| is_of_looseness(words) || is_of_round_field(words) || is_of_header_k(words);
            let is_open = |words: &String| !is_told_anew(words.as_str()) && both.doubt.as_deref().is_none_or(is_of_looseness);
            if let Some(doubt) = pose.doubt.filter(is_open) {
                both.doubt(doubt);
            }
            return both;
        }
        let why = match &both.reason {
            Some(reason) if !both.is_accepted() => format!("with it the beads give no pose ({reason})"),
            _ => "with it other beads would carry the pose than by themselves".to_owned(),
        };
        pose.notes.push(format!("telemetry is not fused: {why}"));
    }
    Pose { innovation: Some(innovation), ..pose }
}

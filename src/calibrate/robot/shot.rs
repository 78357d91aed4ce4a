//! A shot: an acquired frame as attenuation, its pose, what the robot reported at the exposure, and what carried its base.

use glam::DVec2;

use crate::acquire::{Domain, Frame};
use crate::geometry::{Rigid, View};
use crate::image::{Image, quantile};
use crate::mask::{self, Masks};
use crate::pose::{Covariance, Pose};

/// A frame in which the robot may be seen.
#[derive(Clone, Debug)]
pub struct Shot {
    /// How people call it.
    pub name: String,
    /// The camera.
    pub view: View,
    /// Rises with attenuation: nepers, or grey levels of a processed picture.
    pub attenuation: Image<f32>,
    /// Pixels that mean anything.
    pub usable: Image<bool>,
    /// Whether `attenuation` is in nepers, so that metal's contrast is known.
    pub in_nepers: bool,
    /// Control angles as the robot reported them.
    pub readings_deg: [f64; 5],
    /// What the base is fixed to: the specimen's body, or the marker that a tracker follows.
    pub lps_from_carrier: Rigid,
    /// Of the pose, ξ about the focal spot.
    pub pose_covariance: Option<Covariance>,
    /// Why the pose may be another one.
    pub doubt: Option<String>,
}

/// Why a frame is no shot.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NoShot {
    /// Without a pose nobody knows where to look.
    #[error("its pose was refused")]
    Refused,
    /// A pose of another picture.
    #[error("the frame is {} x {} px, its pose is of {} x {}", frame[0], frame[1], pose[0], pose[1])]
    Size {
        /// Columns and rows of the frame.
        frame: [u32; 2],
        /// Columns and rows that the pose was made for.
        pose: [u32; 2],
    },
    /// A reading that is no number.
    #[error("control angle {} is {value_deg}", index + 1)]
    Angle {
        /// Which of the five, from 0.
        index: usize,
        /// What was read.
        value_deg: f64,
    },
    /// Nothing tells the control angles.
    #[error("it is not bound to an exposure with control angles")]
    NoAngles,
    /// The base is carried by a marker that the tracker did not see.
    #[error("there is no tracked base of it")]
    NotTracked,
    /// Nobody read the encoders.
    #[error("the robot's telemetry has a gap at its exposure")]
    Gap,
}

/// Share of the unattenuated signal below which a logarithm says nothing.
const LEAST_SIGNAL: f64 = 1e-4;
/// The bright end of a frame.
const BRIGHT: f64 = 0.99;
/// Of a matched bead's shadow, what is masked.
const BEAD_MARGIN: f64 = 1.2;

impl Shot {
    /// `frame` is the one that `pose` was made from, with the console's doing undone; `lps_from_carrier` is what the base is fixed to.
    ///
    /// # Errors
    /// Why it is no shot.
    pub fn of(name: &str, frame: &Frame, pose: &Pose, readings_deg: [f64; 5], lps_from_carrier: Rigid) -> Result<Self, NoShot> {
        Self::masked(name, frame, &mask::of_frame(frame), pose, readings_deg, lps_from_carrier)
    }

    /// [`Shot::of`] with the frame's masks, which are at hand.
    pub(super) fn masked(
        name: &str,
        frame: &Frame,
        masks: &Masks,
        pose: &Pose,
        readings_deg: [f64; 5],
        lps_from_carrier: Rigid,
    ) -> Result<Self, NoShot> {
        let (intrinsics, camera_from_lps) = pose.camera().ok_or(NoShot::Refused)?;
        let size_px = frame.size_px.map(|side| side as u32);
        let of_pose = pose.size_px.unwrap_or(size_px);
        if of_pose != size_px {
            return Err(NoShot::Size { frame: size_px, pose: of_pose });
        }
        if let Some(index) = readings_deg.iter().position(|angle| !angle.is_finite()) {
            return Err(NoShot::Angle { index, value_deg: readings_deg[index] });
        }
        let [width, height] = frame.size_px;
        let mut usable = masks.usable(width, height, &[]);
        let seen = pose.shadows.iter().filter(|shadow| shadow.bead.is_some());
        let beads: Vec<(DVec2, f64)> =
            seen.map(|shadow| (DVec2::from_array(shadow.image_px), BEAD_MARGIN * shadow.radius_px)).collect();
        let covered = mask::discs(width, height, &beads);
        usable.pixels.iter_mut().zip(&covered.pixels).for_each(|(usable, covered)| *usable &= !covered);
        let (attenuation, in_nepers) = attenuation(frame);
        Ok(Self {
            name: name.to_owned(),
            view: View { size_px, intrinsics, camera_from_lps },
            attenuation,
            usable,
            in_nepers,
            readings_deg,
            lps_from_carrier,
            pose_covariance: pose.covariance,
            doubt: pose.doubt.clone(),
        })
    }
}

fn attenuation(frame: &Frame) -> (Image<f32>, bool) {
    match frame.domain {
        Domain::Log => (frame.pixels.clone(), frame.unit.as_deref() == Some("neper")),
        Domain::Linear => {
            let mut values: Vec<f32> = frame.pixels.pixels.iter().copied().filter(|value| value.is_finite()).collect();
            let bright = quantile(&mut values, BRIGHT).unwrap_or(1.0).max(f64::MIN_POSITIVE);
            (frame.pixels.map(|value| -(f64::from(*value) / bright).max(LEAST_SIGNAL).ln() as f32), true)
        }
        Domain::Display | Domain::Unknown => (frame.pixels.map(|value| -value), false),
    }
}

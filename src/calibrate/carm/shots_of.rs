//! Shots from what a user has: pose files, or the poses and joints of a session's log.

use std::path::Path;

use glam::{DMat3, DVec2, DVec3};
use serde::Deserialize;

use super::shot::{Shot, ShotBead};
use crate::beads::DEFAULT_SIGMA_MM;
use crate::calibrate::logged_poses::{LoggedPose, shots_of};
use crate::geometry::{CarmJoints, PanelWindow, Rigid, noise_through};
use crate::pose::{BeadResidual, Pose};
use crate::record::RecordError;

#[derive(Deserialize)]
struct BindingRecord {
    exposure: Option<ExposureRecord>,
    #[serde(default)]
    flags: Vec<FlagRecord>,
}

#[derive(Deserialize)]
struct FlagRecord {
    flag: String,
}

#[derive(Deserialize)]
struct ExposureRecord {
    joints: Option<JointsRecord>,
}

#[derive(Deserialize)]
struct JointsRecord {
    value: CarmJoints,
}

/// Why a frame is no shot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoShot {
    /// Without a pose there are no beads.
    #[error("its pose was refused, or its file does not say of which frame size it is")]
    Refused,
    /// A picture that the console moved, of a panel of unknown size.
    #[error(
        "its console turned, cropped or enlarged the picture, and the pose does not say of which panel; give register K with size_px"
    )]
    PanelUnknown,
    /// Nothing tells the joints.
    #[error("it is not bound to an exposure with joints")]
    NoJoints,
    /// The readings are those of another moment, or of several.
    #[error("the arm moved while the beam was on")]
    Moved,
    /// Nobody read the encoders.
    #[error("telemetry has a gap at its exposure")]
    Gap,
}

impl Shot {
    /// An accepted pose with the joints at its exposure, in pixels of the panel where a console is known to have made another picture of
    /// it. Beads of a body that has moved since the scan are left out: the layout does not tell where they are.
    ///
    /// # Errors
    /// Why it is no shot.
    pub fn of(name: &str, pose: &Pose, joints: CarmJoints) -> Result<Self, NoShot> {
        let ((_, camera_from_lps), size_px) = pose.camera().zip(pose.size_px).ok_or(NoShot::Refused)?;
        let window = pose.console.as_ref().map_or(PanelWindow::WHOLE, |console| console.window(console.stored_size(size_px)));
        let panel = pose.detector.as_ref().and_then(|detector| detector.size_px.zip(detector.camera_from_lps));
        let (size_px, camera_from_lps) = match panel {
            Some(panel) => panel,
            None if window == PanelWindow::WHOLE => (size_px, camera_from_lps),
            None => return Err(NoShot::PanelUnknown),
        };
        let panel_from_picture = window.detector_from_oriented();
        let moved =
            |bead: &BeadResidual| pose.bodies.iter().any(|body| body.name == bead.body && body.lps_from_body != Rigid::IDENTITY);
        let bead = |bead: &BeadResidual| {
            let is_known = bead.used && !moved(bead) && bead.sigma_px.is_some_and(|sigma_px| sigma_px > 0.0);
            let (image_px, noise_px2) = bead.image_px.filter(|_| is_known).zip(bead.noise_px2())?;
            let unstated = || DMat3::from_diagonal(DVec3::splat(DEFAULT_SIGMA_MM.powi(2)));
            Some(ShotBead {
                name: bead.name.clone(),
                lps_mm: bead.lps_mm,
                image_px: panel_from_picture.transform_point2(DVec2::from_array(image_px)),
                noise_px2: noise_through(panel_from_picture.matrix2, noise_px2),
                place_mm2: bead.covariance_mm2.map_or_else(unstated, |own| own.mm2()),
            })
        };
        let beads = pose.beads.iter().filter_map(bead).collect();
        Ok(Self { name: name.to_owned(), size_px, joints, beads, camera_from_lps })
    }
}

impl BindingRecord {
    /// The joints at the exposure, if they are those of the picture.
    fn joints(&self) -> Result<CarmJoints, NoShot> {
        let joints = self.exposure.as_ref().and_then(|exposure| exposure.joints.as_ref()).ok_or(NoShot::NoJoints)?;
        let flagged = |names: &[&str]| self.flags.iter().any(|flag| names.contains(&flag.flag.as_str()));
        if flagged(&["moved"]) {
            return Err(NoShot::Moved);
        }
        if flagged(&["telemetry_gap", "unseen"]) {
            return Err(NoShot::Gap);
        }
        Ok(joints.value)
    }
}

/// The shots of a session's log: frames that are bound to an exposure during which the arm stood still, with an accepted pose, in order of
/// arrival; a frame that was posed again counts with its last pose. Second: what is no shot and why, which shots' poses are in doubt, and
/// what of the log could not be read.
///
/// # Errors
/// When the file cannot be read or is no log.
pub fn shots_of_log(path: &Path) -> Result<(Vec<Shot>, Vec<String>), RecordError> {
    let (found, mut notes) = shots_of(path, |name, record: LoggedPose<BindingRecord>| {
        let shot = Shot::of(name, &record.pose, record.binding.joints()?)?;
        Ok::<_, NoShot>((shot, record.pose.doubt))
    })?;
    let mut shots = Vec::new();
    for (shot, doubt) in found {
        notes.extend(doubt.map(|words| format!("{} is a shot, but its pose is in doubt: {words}", shot.name)));
        shots.push(shot);
    }
    Ok((shots, notes))
}

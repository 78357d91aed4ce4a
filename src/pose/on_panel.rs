//! What a pose of a picture that a console turned, mirrored, cropped or enlarged says of the panel.

use std::path::Path;

use super::file::{PoseFileError, read_json};
use super::prior::Prior;
use super::record::{Covariance, DetectorPose, Pose};
use crate::acquire::{Frame, Stored};
use crate::geometry::{
    ConsoleGeometry, Intensifier, IntensifierError, Projection, homogeneous_rows, seen_through, turned_camera,
};

/// Reads what a console does: the keys of a session's `console`.
///
/// # Errors
/// When the file cannot be read, is not JSON, holds unknown keys, or says what no console does.
pub fn read_console(path: &Path) -> Result<ConsoleGeometry, PoseFileError> {
    let console: ConsoleGeometry = read_json(path)?;
    console.check().map_err(|error| {
        let (place, message) = ("console".to_owned(), error.to_string());
        PoseFileError::Form { path: path.to_owned(), place, message }
    })?;
    Ok(console)
}

impl Prior {
    /// The same camera with its axes turned by `turn_rad` about the beam.
    #[must_use]
    pub fn turned(&self, turn_rad: f64) -> Self {
        let turn = turned_camera(turn_rad);
        Self { camera_from_lps: turn * self.camera_from_lps, covariance: self.covariance.map(|rows| turned(&rows, turn_rad)) }
    }
}

/// A covariance of ξ in axes that are turned about z: rotation and translation turn alike, since the axis goes through the origin.
fn turned(rows: &Covariance, turn_rad: f64) -> Covariance {
    let r = nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::z_axis(), turn_rad);
    let mut adjoint = nalgebra::Matrix6::zeros();
    adjoint.fixed_view_mut::<3, 3>(0, 0).copy_from(r.matrix());
    adjoint.fixed_view_mut::<3, 3>(3, 3).copy_from(r.matrix());
    let turned = adjoint * nalgebra::Matrix6::from_fn(|i, j| rows[i][j]) * adjoint.transpose();
    std::array::from_fn(|i| std::array::from_fn(|j| turned[(i, j)]))
}

impl Pose {
    /// With what it says of the panel, if the frame's console is known.
    pub(super) fn on_panel(self, frame: &Frame) -> Self {
        match frame.correction.as_ref().and_then(|correction| correction.stored.as_ref()) {
            Some(stored) => self.of_stored(stored, frame.unmirrored),
            None => Self { mirrored: frame.unmirrored, ..self },
        }
    }

    /// The same after its camera or K has changed: what it says of the panel follows.
    pub(super) fn on_panel_anew(self) -> Self {
        let (Some(stored), mirrored) = (self.stored(), self.mirrored) else { return self };
        self.of_stored(&stored, mirrored)
    }

    /// How the console stored the frame, if that is known.
    fn stored(&self) -> Option<Stored> {
        let (console, oriented_px, detector) = (self.console.clone()?, self.size_px?, self.detector.as_ref()?);
        Some(Stored { size_px: console.stored_size(oriented_px), console, panel_px: detector.size_px })
    }

    /// What an intensifier that is `whole` in the panel's picture did to the frame of this pose, in the frame's pixels.
    ///
    /// # Errors
    /// When the panel's picture is no other size of the one it was measured in.
    pub fn frame_seen_through(&self, whole: &Intensifier) -> Result<Intensifier, IntensifierError> {
        self.stored().map_or_else(|| Ok(whole.clone()), |stored| stored.seen_through(whole))
    }

    fn of_stored(self, stored: &Stored, unmirrored: bool) -> Self {
        let Stored { console, size_px, panel_px } = stored;
        let detector_from_oriented = console.window(*size_px).detector_from_oriented();
        let panel = self.intrinsics.map(|k| seen_through(&detector_from_oriented, &k));
        let camera_from_lps = panel.zip(self.camera_from_lps).map(|((_, turn_rad), camera)| turned_camera(turn_rad) * camera);
        let covariance = panel.zip(self.covariance).map(|((_, turn_rad), rows)| turned(&rows, turn_rad));
        let k = panel.map(|(k, _)| k);
        let accepted = self.is_accepted();
        let detector = DetectorPose {
            detector_from_image: homogeneous_rows(&console.detector_from_image(*size_px)),
            size_px: *panel_px,
            projection: k.zip(camera_from_lps).filter(|_| accepted).map(|(k, camera)| Projection::compose(&k, &camera)),
            intrinsics: k,
            camera_from_lps,
            covariance,
        };
        Self { mirrored: unmirrored || console.is_mirrored(), console: Some(console.clone()), detector: Some(detector), ..self }
    }
}

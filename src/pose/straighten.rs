//! Places in a frame of an image intensifier, as they are in the undistorted picture, and back.

use glam::{DMat2, DVec2};

use super::record::Pose;
use super::request::Registration;
use crate::beads::Detection;
use crate::beads::tags::SeenTag;
use crate::geometry::Distortion;

impl Registration<'_> {
    /// A place of the frame in the undistorted picture.
    pub(super) fn straight(&self, p: DVec2) -> DVec2 {
        self.distortion.map_or(p, |distortion| distortion.undistorted(p))
    }

    /// A place of the undistorted picture in the frame; NaN where the frame does not show it.
    pub(super) fn in_frame(&self, p: DVec2) -> DVec2 {
        Distortion::shown(self.distortion, p).unwrap_or(DVec2::NAN)
    }

    /// Shadows with place, covariance and size in the undistorted picture; those outside the disc are none.
    pub(super) fn straight_shadows(&self, found: Vec<Detection>) -> Vec<Detection> {
        let Some(distortion) = self.distortion else { return found };
        found.iter().filter(|shadow| distortion.sees(shadow.image_px)).map(|shadow| shadow.straightened(distortion)).collect()
    }

    /// Tags with their places in the undistorted picture.
    pub(super) fn straight_tags(&self, seen: &[SeenTag]) -> Vec<SeenTag> {
        let straight = |tag: &SeenTag| SeenTag {
            centre_px: self.straight(tag.centre_px),
            corners_px: tag.corners_px.map(|corner| self.straight(corner)),
            ..tag.clone()
        };
        seen.iter().map(straight).collect()
    }
}

impl Pose {
    /// The same with the places of beads, shadows, landmarks and tags where the distorted frame shows them: to be drawn on it.
    #[must_use]
    pub fn drawn_on_distorted(&self, distortion: &Distortion) -> Self {
        let shown = |p: [f64; 2]| Distortion::shown(Some(distortion), DVec2::from_array(p)).map(|p| p.to_array());
        let mut pose = self.clone();
        for bead in &mut pose.beads {
            bead.image_px = bead.image_px.and_then(shown);
            bead.predicted_px = bead.predicted_px.and_then(shown);
        }
        pose.shadows.iter_mut().for_each(|shadow| shadow.image_px = shown(shadow.image_px).unwrap_or(shadow.image_px));
        for landmark in &mut pose.landmarks {
            landmark.image_px = landmark.image_px.and_then(shown);
            let placed = landmark.image_px.zip(landmark.covariance_px2);
            landmark.covariance_px2 = placed.map(|(at, covariance)| {
                // What is a step on the straight picture is one through the inverse Jacobian on the frame.
                let back = distortion.jacobian(DVec2::from_array(at)).inverse();
                (back * DMat2::from_cols_array_2d(&covariance) * back.transpose()).to_cols_array_2d()
            });
        }
        for corner in pose.tags.iter_mut().flat_map(|tag| &mut tag.corners_px) {
            *corner = shown(*corner).unwrap_or(*corner);
        }
        pose
    }
}

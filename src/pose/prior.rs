//! What is known of a pose before the beads are seen.

use std::path::Path;

use super::cautions::is_of_looseness;
use super::file::PoseFileError;
use super::record::{Covariance, Pose, Status};
use crate::geometry::Rigid;

/// What is known of a pose before the beads are seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prior {
    /// The expected pose.
    pub camera_from_lps: Rigid,
    /// Of ξ; `None` means σ = 5° about the bead centroid and 15 mm of the centroid, per axis.
    pub covariance: Option<Covariance>,
}

impl Prior {
    /// Reads a pose file; only `camera_from_lps` is needed, `covariance` is used if there.
    ///
    /// # Errors
    /// As [`Pose::read`]; also when there is no pose, or the covariance is not one.
    pub fn read(path: &Path) -> Result<Self, PoseFileError> {
        Ok(Self::read_with_doubt(path)?.0)
    }

    /// [`Prior::read`], and why the pose it is read from may be another, where it may.
    ///
    /// # Errors
    /// As [`Prior::read`].
    pub fn read_with_doubt(path: &Path) -> Result<(Self, Option<String>), PoseFileError> {
        let pose = Pose::read(path)?;
        let refused = pose.status == Status::Refused;
        let why = if refused { ": the pose was refused".to_owned() } else { String::new() };
        let camera_from_lps =
            pose.camera_from_lps.filter(|_| !refused).ok_or(PoseFileError::NoPose { path: path.to_owned(), why })?;
        // What is expected is expected of the panel, whatever a console did to the picture.
        let (camera_from_lps, covariance) = match pose.detector {
            Some(detector) => (detector.camera_from_lps.unwrap_or(camera_from_lps), detector.covariance),
            None => (camera_from_lps, pose.covariance),
        };
        let prior = Self { camera_from_lps, covariance };
        if let Some(detail) = prior.fault() {
            return Err(PoseFileError::Covariance { path: path.to_owned(), detail });
        }
        // How loosely it is held its covariance says.
        let doubt = pose.doubt.filter(|words| covariance.is_none() || !is_of_looseness(words));
        Ok((prior, doubt))
    }

    /// What is wrong with the covariance, if anything.
    #[must_use]
    pub fn fault(&self) -> Option<String> {
        let rows = self.covariance.as_ref()?;
        let matrix = nalgebra::Matrix6::from_fn(|i, j| rows[i][j]);
        if !matrix.iter().all(|x| x.is_finite()) {
            return Some("it holds a number that is not finite".to_owned());
        }
        let scale = |i: usize, j: usize| (matrix[(i, i)] * matrix[(j, j)]).abs().sqrt().max(f64::MIN_POSITIVE);
        for i in 0..6 {
            for j in 0..i {
                let gap = (matrix[(i, j)] - matrix[(j, i)]).abs();
                if !(gap <= 1e-6 * scale(i, j)) {
                    return Some(format!("entries ({i}, {j}) and ({j}, {i}) differ by {gap:.3e}"));
                }
            }
        }
        matrix.cholesky().is_none().then(|| "an eigenvalue is zero or negative".to_owned())
    }
}

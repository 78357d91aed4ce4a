//! The file of K, and how sure K is.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::file::{PoseFileError, read_json};
use super::solve::IntrinsicsPrior;
use crate::geometry::Intrinsics;

/// No pixel of a detector is larger.
pub(super) const MOST_PITCH_MM: f64 = 100.0;
/// Below this a pitch in mm was written in metres: no detector of X-rays has pixels that small.
const METRES_BELOW_MM: f64 = 0.01;

/// Whether pixels may be so far apart.
#[must_use]
pub fn is_pitch(pitch_mm: f64) -> bool {
    pitch_mm > 0.0 && pitch_mm <= MOST_PITCH_MM
}

/// Standard deviations with which K is stated; with them K is solved, and what the file says is a measurement of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IntrinsicsSigma {
    /// Of the distance from source to detector.
    pub source_to_detector_mm: f64,
    /// Of the principal point, per axis.
    pub principal_point_px: f64,
    /// Of the side of a pixel; 0 where absent.
    #[serde(default)]
    pub pitch_mm: f64,
}

/// The file of K: `{"intrinsics": 3×3, "size_px": [columns, rows], "pitch_mm": …, "sigma": {…}}`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IntrinsicsFile {
    /// K.
    pub intrinsics: Intrinsics,
    /// Frame it is for.
    #[serde(default)]
    pub size_px: Option<[u32; 2]>,
    /// Side of a pixel.
    #[serde(default)]
    pub pitch_mm: Option<f64>,
    /// How sure K is; absent: it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigma: Option<IntrinsicsSigma>,
}

impl IntrinsicsFile {
    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, is not JSON, holds unknown keys, or K, the pitch or a standard deviation is impossible.
    pub fn read(path: &Path) -> Result<Self, PoseFileError> {
        let file: Self = read_json(path)?;
        let form = |place: &str, message: String| PoseFileError::Form { path: path.to_owned(), place: place.to_owned(), message };
        let good = |x: f64| x > 0.0 && x.is_finite();
        if let Some(pitch) = file.pitch_mm.filter(|pitch| !is_pitch(*pitch)) {
            return Err(form("pitch_mm", format!("pitch is {pitch} mm, it must be positive, at most {MOST_PITCH_MM} mm")));
        }
        if let Some(pitch) = file.pitch_mm.filter(|pitch| *pitch < METRES_BELOW_MM) {
            return Err(form("pitch_mm", format!("pitch is {pitch} mm: pitch_mm {pitch} is in metres? write it in mm")));
        }
        let Some(IntrinsicsSigma { source_to_detector_mm, principal_point_px, pitch_mm }) = file.sigma else { return Ok(file) };
        for (key, sigma) in [("source_to_detector_mm", source_to_detector_mm), ("principal_point_px", principal_point_px)] {
            if !good(sigma) {
                return Err(form(&format!("sigma.{key}"), format!("the standard deviation is {sigma}, it must be positive")));
            }
        }
        if !(pitch_mm >= 0.0 && pitch_mm.is_finite()) {
            return Err(form("sigma.pitch_mm", format!("the standard deviation is {pitch_mm}, it must be zero or positive")));
        }
        if file.pitch_mm.is_none() {
            return Err(form("sigma", "without pitch_mm the distance from source to detector says nothing of K".to_owned()));
        }
        Ok(file)
    }

    /// K with its standard deviations; `None` where the file states none, or no pitch.
    #[must_use]
    pub fn prior(&self) -> Option<IntrinsicsPrior> {
        let (sigma, pitch_mm) = (self.sigma?, self.pitch_mm?);
        let distance_mm = (self.intrinsics.source_to_detector_mm(pitch_mm), sigma.source_to_detector_mm);
        let pitch_mm = (pitch_mm, sigma.pitch_mm);
        Some(IntrinsicsPrior::from_distance(self.intrinsics, distance_mm, pitch_mm, sigma.principal_point_px))
    }
}

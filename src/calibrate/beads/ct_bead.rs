//! A metal bead as a CT shows it.

use glam::DVec3;

/// A metal bead of a CT.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct CtBead {
    /// `bead-01` and on, from the feet up; or that of the nearest place of a list.
    pub name: String,
    /// The rigid part it is fixed to.
    pub body: String,
    /// Centre.
    pub lps_mm: [f64; 3],
    /// Covariance of the centre.
    pub covariance_mm2: [[f64; 3]; 3],
    /// Standard deviation per axis: the root of the covariance's mean diagonal.
    pub sigma_mm: f64,
    /// Radius, given or estimated.
    pub radius_mm: f64,
    /// Its standard deviation; of little meaning beside a large `radius_mm` prior: see `radius_stated`.
    pub radius_sigma_mm: f64,
    /// Whether the radius is certain enough to be used: within 15 %, or given.
    pub radius_stated: bool,
    /// HU above tissue inside the ball.
    pub contrast_hu: f64,
    /// Contrast times volume: what a small or clipped ball does tell.
    pub mass_hu_mm3: f64,
    /// Full width at half maximum of the point spread.
    pub point_spread_fwhm_mm: f64,
    /// Largest value in it.
    pub peak_hu: f32,
    /// Clipped voxels.
    pub clipped_voxels: usize,
    /// Root mean square of what the model misses.
    pub missed_hu: f64,
}

impl CtBead {
    /// Centre.
    #[must_use]
    pub fn centre(&self) -> DVec3 {
        DVec3::from_array(self.lps_mm)
    }
}

//! What is known of the beads: names, places, sizes.

use glam::DVec3;

/// Standard deviation, per axis in mm, of a bead's position when its description gives none: good CT with sub-voxel centres.
pub const DEFAULT_SIGMA_MM: f64 = 0.1;

/// Body of a bead whose description names none.
pub const DEFAULT_BODY: &str = "specimen";

/// A metal sphere on or in the specimen.
#[derive(Clone, Debug, PartialEq)]
pub struct Bead {
    /// Unique in its layout.
    pub name: String,
    /// The rigid part it is fixed to.
    pub body: String,
    /// Centre in the CT's patient axes.
    pub lps_mm: DVec3,
    /// From `radius_mm=` of the description.
    pub radius_mm: Option<f64>,
    /// Standard deviation of `lps_mm` per axis, from `sigma_mm=` of the description.
    pub sigma_mm: Option<f64>,
}

impl Bead {
    /// `sigma_mm`, or [`DEFAULT_SIGMA_MM`].
    #[must_use]
    pub fn sigma_or_default_mm(&self) -> f64 {
        self.sigma_mm.unwrap_or(DEFAULT_SIGMA_MM)
    }
}

/// The beads of a specimen, in the order of their file.
#[derive(Clone, Debug, PartialEq)]
pub struct BeadLayout {
    /// At least one.
    pub beads: Vec<Bead>,
    /// Beads of role `check`: no pose rests on them, each is judged by them.
    pub checks: Vec<Bead>,
    /// Where they come from: a path, or words.
    pub source: String,
    /// What was assumed or left out while reading.
    pub notes: Vec<String>,
    /// Why no frame may be registered on it, where something known besides contradicts it.
    pub refused: Option<String>,
}

impl BeadLayout {
    /// No beads at all.
    #[must_use]
    pub fn none() -> Self {
        Self { beads: Vec::new(), checks: Vec::new(), source: "none".to_owned(), notes: Vec::new(), refused: None }
    }

    /// Mean position.
    #[must_use]
    pub fn centroid_lps_mm(&self) -> DVec3 {
        self.beads.iter().map(|bead| bead.lps_mm).sum::<DVec3>() / self.beads.len().max(1) as f64
    }

    /// Radius of bead `index`: its own, else `fallback_mm`.
    #[must_use]
    pub fn radius_mm(&self, index: usize, fallback_mm: Option<f64>) -> Option<f64> {
        self.beads[index].radius_mm.or(fallback_mm)
    }
}

/// A named point at which uncertainty is wanted.
#[derive(Clone, Debug, PartialEq)]
pub struct Landmark {
    /// Label.
    pub name: String,
    /// Position.
    pub lps_mm: DVec3,
}

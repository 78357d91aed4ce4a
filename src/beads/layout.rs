//! What is known of the beads: names, places, sizes.

use glam::{DMat3, DVec3};

use super::place_covariance::{LEAST_MM, PlaceCovariance};

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
    /// Standard deviation of `lps_mm` per axis, from `sigma_mm=` of the description; else, or where that contradicts the covariance, the root
    /// mean square over axes of the latter.
    pub sigma_mm: Option<f64>,
    /// Covariance of `lps_mm`, from `covariance_mm2=` of the description; it counts where both are stated.
    pub covariance_mm2: Option<PlaceCovariance>,
}

impl Bead {
    /// Of the default body, with nothing stated of its radius and of how well its place is known.
    #[must_use]
    pub fn new(name: impl Into<String>, lps_mm: DVec3) -> Self {
        Self { name: name.into(), body: DEFAULT_BODY.to_owned(), lps_mm, radius_mm: None, sigma_mm: None, covariance_mm2: None }
    }

    /// `sigma_mm`, or [`DEFAULT_SIGMA_MM`].
    #[must_use]
    pub fn sigma_or_default_mm(&self) -> f64 {
        self.sigma_mm.unwrap_or(DEFAULT_SIGMA_MM)
    }

    /// Covariance of `lps_mm` as the layout states it, by one standard deviation for all axes too; `None` where it states neither, or none
    /// that a place has.
    #[must_use]
    pub fn stated_mm2(&self) -> Option<PlaceCovariance> {
        let alike = |sigma_mm: f64| {
            let mm2 = DMat3::from_diagonal(DVec3::splat(sigma_mm.powi(2)));
            PlaceCovariance::new(mm2.to_cols_array_2d()).ok()
        };
        self.covariance_mm2.or_else(|| self.sigma_mm.and_then(alike))
    }

    /// Covariance of `lps_mm`, positive definite: as it is stated, else the same along every axis.
    #[must_use]
    pub fn place_mm2(&self) -> DMat3 {
        let alike = || DMat3::from_diagonal(DVec3::splat(self.sigma_or_default_mm().max(LEAST_MM).powi(2)));
        self.covariance_mm2.map_or_else(alike, |own| own.mm2())
    }

    /// Standard deviation of `lps_mm` along the direction that is known worst.
    #[must_use]
    pub fn most_sigma_mm(&self) -> f64 {
        self.covariance_mm2.map_or_else(|| self.sigma_or_default_mm(), |own| own.most_sigma_mm())
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
    /// Those of the notes that say what a description probably means and does not say; a person should put it right.
    pub doubts: Vec<String>,
    /// Why no frame may be registered on it, where something known besides contradicts it.
    pub refused: Option<String>,
}

impl BeadLayout {
    /// No beads at all.
    #[must_use]
    pub fn none() -> Self {
        Self {
            beads: Vec::new(),
            checks: Vec::new(),
            source: "none".to_owned(),
            notes: Vec::new(),
            doubts: Vec::new(),
            refused: None,
        }
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

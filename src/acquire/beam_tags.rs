//! What a DICOM header says of the filter and the collimator. Words are variants of the standard's terms and all else is a number, so that
//! no text can pass.

use serde::{Deserialize, Serialize};

/// Filters in the beam (PS3.3 C.8.7.10).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct FilterTags {
    /// Filter type (0018,1160), where it is one of the standard's terms: that attribute may hold any text.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub form: Option<FilterForm>,
    /// One for each filter material (0018,7050).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub layers: Vec<FilterLayer>,
}

/// Shape of a filter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum FilterForm {
    /// Over a part of the field.
    Strip,
    /// Thicker to one side.
    Wedge,
    /// Thicker to two sides.
    Butterfly,
    /// Several.
    Multiple,
    /// Of one thickness.
    Flat,
    /// None is in the beam.
    #[serde(rename = "NONE")]
    NoFilter,
}

/// What a filter is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum FilterMaterial {
    /// Mo.
    Molybdenum,
    /// Al.
    Aluminum,
    /// Cu.
    Copper,
    /// Rh.
    Rhodium,
    /// Nb.
    Niobium,
    /// Eu.
    Europium,
    /// Pb.
    Lead,
    /// Ag.
    Silver,
    /// One for which the standard has no term: what its word is, is not kept.
    Other,
}

impl FilterMaterial {
    /// All that have a name.
    pub const ALL: [Self; 8] =
        [Self::Aluminum, Self::Copper, Self::Molybdenum, Self::Rhodium, Self::Niobium, Self::Europium, Self::Lead, Self::Silver];

    /// Its name and its symbol, as scenes and commands have them.
    #[must_use]
    pub fn names(self) -> [&'static str; 2] {
        match self {
            Self::Molybdenum => ["molybdenum", "Mo"],
            Self::Aluminum => ["aluminium", "Al"],
            Self::Copper => ["copper", "Cu"],
            Self::Rhodium => ["rhodium", "Rh"],
            Self::Niobium => ["niobium", "Nb"],
            Self::Europium => ["europium", "Eu"],
            Self::Lead => ["lead", "Pb"],
            Self::Silver => ["silver", "Ag"],
            Self::Other => ["another material", "another"],
        }
    }

    /// The one of this name or symbol, in any case and either spelling.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        let name = name.trim();
        let own = |material: &Self| material.names().iter().any(|own| own.eq_ignore_ascii_case(name));
        let american = name.eq_ignore_ascii_case("aluminum").then_some(Self::Aluminum);
        american.or_else(|| Self::ALL.into_iter().find(own))
    }
}

/// Copper beyond this is another filter: it changes the spectrum visibly, and is half a step of the filters of C-arms, which are of tenths of a
/// millimetre.
pub const COPPER_APART_MM: f64 = 0.05;
/// Aluminium beyond this is another filter.
pub const ALUMINIUM_APART_MM: f64 = 0.3;
/// A tube, its housing and its collimator have at most this of their own, as aluminium. A sheet that is fixed in the housing is added to one
/// maker and the tube's own to the next, and some tell the total: of two who tell of aluminium, either may count what the other leaves out.
pub const OWN_ALUMINIUM_MM: f64 = 4.0;

/// Least and most thickness, one number where they are alike.
#[must_use]
pub fn thickness_words([least_mm, most_mm]: [f64; 2]) -> String {
    if most_mm - least_mm >= 0.005 { format!("{least_mm:.2} to {most_mm:.2} mm") } else { format!("{most_mm:.2} mm") }
}

/// A filter of one material.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FilterLayer {
    /// Of what.
    pub material: FilterMaterial,
    /// Least and most thickness (0018,7052) and (0018,7054); the one is both where the other is not there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub thickness_mm: Option<[f64; 2]>,
}

/// Shape of the opening.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum CollimatorShape {
    /// Four shutters.
    Rectangular,
    /// An iris.
    Circular,
    /// Any other.
    Polygonal,
    /// Pixel by pixel, of what a console shows alone; which pixels is not kept.
    Bitmap,
}

/// The opening of the collimator (PS3.3 C.8.7.3), or of the display shutter (C.7.6.11), in pixels of the picture as stored, whose first column and
/// row are 1.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct CollimatorTags {
    /// (0018,1700), (0018,1600); several lie over each other.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub shapes: Vec<CollimatorShape>,
    /// Columns of the left and right edge, rows of the upper and lower, as left, top, right, bottom: (0018,1702), 1706, 1704, 1708, or
    /// (0018,1602), 1606, 1604, 1608. They may lie outside the picture.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub edges_px: Option<[f64; 4]>,
    /// Column and row of the iris's middle (0018,1710), (0018,1610).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub centre_px: Option<[f64; 2]>,
    /// Radius of the iris (0018,1712), (0018,1612).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius_px: Option<f64>,
    /// Columns and rows of a polygon's corners, in their order (0018,1720), (0018,1620).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub corners_px: Vec<[f64; 2]>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn materials_are_known_by_name_and_symbol() {
        for material in FilterMaterial::ALL {
            assert_eq!(material.names().map(FilterMaterial::named), [Some(material); 2]);
        }
        assert_eq!(["Aluminum", "ALUMINIUM", " cu"].map(FilterMaterial::named).iter().flatten().count(), 3);
        assert_eq!(["", "water", "A"].map(FilterMaterial::named), [None; 3]);
    }
}

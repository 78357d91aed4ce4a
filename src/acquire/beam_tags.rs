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

impl FilterTags {
    /// Least and most thickness of `material` in the beam, its layers together; `None` where the header does not say it. A zero says
    /// nothing: consoles write it where they do not know. "No filter" says nothing of aluminium, because sheets that are fixed in the
    /// housing were never put in.
    #[must_use]
    pub fn thickness_mm(&self, material: FilterMaterial) -> Option<[f64; 2]> {
        if self.form == Some(FilterForm::NoFilter) && self.layers.is_empty() {
            return (material != FilterMaterial::Aluminum).then_some([0.0; 2]);
        }
        let mut total_mm = [0.0; 2];
        for layer in self.layers.iter().filter(|layer| layer.material == material) {
            let [least_mm, most_mm] = layer.thickness_mm?;
            total_mm = [total_mm[0] + least_mm, total_mm[1] + most_mm];
        }
        (total_mm[1] > 0.0).then_some(total_mm)
    }
}

/// Shape of the opening.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum CollimatorShape {
    /// Four shutters.
    Rectangular,
    /// An iris.
    Circular,
    /// Any other; its corners are not kept.
    Polygonal,
}

/// The collimator's opening (PS3.3 C.8.7.3) in pixels of the picture as stored, whose first column and row are 1.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct CollimatorTags {
    /// (0018,1700); several lie over each other.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub shapes: Vec<CollimatorShape>,
    /// Columns of the left and right edge, rows of the upper and lower, as left, top, right, bottom: (0018,1702), 1706, 1704, 1708. They
    /// may lie outside the picture.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub edges_px: Option<[f64; 4]>,
    /// Column and row of the iris's middle (0018,1710).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub centre_px: Option<[f64; 2]>,
    /// Radius of the iris (0018,1712).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius_px: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layers_of_a_material_add_up_and_what_is_not_said_is_not_zero() {
        use FilterMaterial::{Aluminum, Copper, Lead};
        let layer = |material, thickness_mm| FilterLayer { material, thickness_mm };
        let layers = vec![layer(Copper, Some([0.25, 0.25])), layer(Copper, Some([0.5, 1.0])), layer(Lead, None)];
        let filter = FilterTags { form: None, layers };
        assert_eq!(filter.thickness_mm(Copper), Some([0.75, 1.25]));
        assert_eq!([Lead, Aluminum].map(|material| filter.thickness_mm(material)), [None; 2]);
        let zero = FilterTags { form: Some(FilterForm::NoFilter), layers: vec![layer(Copper, Some([0.0; 2]))] };
        assert_eq!(zero.thickness_mm(Copper), None);
        let none = FilterTags { form: Some(FilterForm::NoFilter), layers: Vec::new() };
        assert_eq!([Copper, Aluminum].map(|material| none.thickness_mm(material)), [Some([0.0; 2]), None]);
    }
}

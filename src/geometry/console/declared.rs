//! What a console did to the panel's picture, as a person declares it.

use glam::{DAffine2, DMat2, DVec2};
use serde::{Deserialize, Serialize};

/// About which line a console mirrored the picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Flip {
    /// Not at all.
    #[default]
    None,
    /// Columns are in reverse order.
    Horizontal,
    /// Rows are in reverse order.
    Vertical,
}

/// What a console did to the panel's picture: `detector_from_image` in the words of a session file, or as a matrix.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConsoleGeometry {
    /// Clockwise, before the flip, about the middle of the picture. What it is beside whole quarter turns leaves the picture's size.
    pub rotation_deg: f64,
    /// After the rotation.
    pub flip: Flip,
    /// Left, top, columns and rows of the part that is shown, in pixels of the C-arm's calibration; all of it when absent.
    pub crop_px: Option<[u32; 4]>,
    /// Pixels of the calibration, each way, that were averaged into one.
    pub binning: u32,
    /// Enlargement after binning; 1 for none.
    pub zoom: f64,
    /// In place of the five above: pixels of the stored picture to pixels of the calibration, homogeneous rows; centres at integers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detector_from_image: Option<[[f64; 3]; 3]>,
    /// Left, top, columns and rows of areas that the console wrote into, in pixels of the stored picture.
    pub burned_in_px: Vec<[u32; 4]>,
}

impl Default for ConsoleGeometry {
    fn default() -> Self {
        Self {
            rotation_deg: 0.0,
            flip: Flip::None,
            crop_px: None,
            binning: 1,
            zoom: 1.0,
            detector_from_image: None,
            burned_in_px: Vec::new(),
        }
    }
}

/// Why a console's geometry cannot be undone.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConsoleError {
    /// A number that no console has.
    #[error("{key} is {found}, expected {expected}")]
    Value {
        /// Key in the session file.
        key: &'static str,
        /// What was found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// The cropped part reaches beyond the panel.
    #[error("crop_px {crop_px:?} reaches beyond the calibrated {panel_px:?} px")]
    CropOutside {
        /// Left, top, columns, rows.
        crop_px: [u32; 4],
        /// Columns and rows of the calibration.
        panel_px: [u32; 2],
    },
    /// The frame has another size than it should have.
    #[error("the frame is {found:?} px, the C-arm calibration and the console geometry give {expected:?} px; {remedy}")]
    Size {
        /// As stored.
        found: [u32; 2],
        /// As it should be stored.
        expected: [u32; 2],
        /// What to declare.
        remedy: String,
    },
}

impl ConsoleGeometry {
    /// What a console did that took `stored` to `detector` so: a similarity, mirrored or not.
    #[must_use]
    pub fn of_matrix(detector_from_image: &DAffine2) -> Self {
        Self { detector_from_image: Some(homogeneous_rows(detector_from_image)), ..Self::default() }
    }

    /// The first number that no console has.
    ///
    /// # Errors
    /// Which one.
    pub fn check(&self) -> Result<(), ConsoleError> {
        let wrong = |key, found: String, expected| Err(ConsoleError::Value { key, found, expected });
        if !(self.rotation_deg.abs() <= 360.0) {
            return wrong("rotation_deg", self.rotation_deg.to_string(), "-360 to 360 degrees, clockwise");
        }
        if !(1..=16).contains(&self.binning) {
            return wrong("binning", self.binning.to_string(), "1 to 16 pixels");
        }
        if !(self.zoom >= 0.05 && self.zoom <= 20.0) {
            return wrong("zoom", self.zoom.to_string(), "0.05 to 20");
        }
        if let Some(crop) = self.crop_px.filter(|crop| crop[2] == 0 || crop[3] == 0) {
            return wrong("crop_px", format!("{crop:?}"), "[left, top, columns, rows] with at least one column and row");
        }
        if let Some(area) = self.burned_in_px.iter().find(|area| area[2] == 0 || area[3] == 0) {
            return wrong("burned_in_px", format!("{area:?}"), "[left, top, columns, rows] with at least one column and row");
        }
        let Some(rows) = self.detector_from_image else { return Ok(()) };
        let in_words = Self { detector_from_image: None, burned_in_px: Vec::new(), ..self.clone() };
        if in_words != Self::default() {
            return wrong(
                "detector_from_image",
                "given beside words".to_owned(),
                "either the matrix or rotation_deg, flip, crop_px, binning and zoom",
            );
        }
        let matrix = affine(&rows).matrix2;
        let scale = matrix.determinant().abs().sqrt();
        // Columns of equal length at a right angle.
        let alike = (matrix.x_axis.length() - scale).abs().max((matrix.y_axis.length() - scale).abs()) <= 1e-3 * scale
            && matrix.x_axis.dot(matrix.y_axis).abs() <= 1e-3 * scale * scale;
        let finite = rows.iter().flatten().all(|x| x.is_finite());
        if !(finite && alike && (0.05..=20.0).contains(&scale) && rows[2] == [0.0, 0.0, 1.0]) {
            return wrong(
                "detector_from_image",
                format!("{rows:?}"),
                "three rows that turn, mirror, enlarge once for both axes (0.05 to 20) and shift, last row [0, 0, 1]; a picture that was \
                 stretched along one axis cannot be declared: give K of the picture as it is, with fx and fy, or resample it to square pixels",
            );
        }
        Ok(())
    }
}

/// The 3×3 of an affine map of the plane, row by row.
#[must_use]
pub fn homogeneous_rows(affine: &DAffine2) -> [[f64; 3]; 3] {
    let [x, y, t] = [affine.matrix2.x_axis, affine.matrix2.y_axis, affine.translation];
    [[x.x, y.x, t.x], [x.y, y.y, t.y], [0.0, 0.0, 1.0]]
}

/// The affine map of [`homogeneous_rows`].
pub(super) fn affine(rows: &[[f64; 3]; 3]) -> DAffine2 {
    let [[a, b, x], [c, d, y], _] = *rows;
    DAffine2::from_mat2_translation(DMat2::from_cols(DVec2::new(a, c), DVec2::new(b, d)), DVec2::new(x, y))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A matrix that stretched one axis was refused without a word of what to do.
    #[test]
    fn a_stretched_picture_is_told_what_to_give_instead() {
        let check = |x: f64, y: f64| {
            let rows = [[x, 0.0, 3.0], [0.0, y, -2.0], [0.0, 0.0, 1.0]];
            ConsoleGeometry { detector_from_image: Some(rows), ..ConsoleGeometry::default() }.check()
        };
        assert_eq!([check(1.2, 1.2), check(-0.5, 0.5)], [Ok(()), Ok(())], "enlarged, and mirrored");
        let words = check(1.2, 1.0).map_or_else(|error| error.to_string(), |()| String::new());
        for part in ["detector_from_image is [[1.2", "stretched along one axis cannot be declared", "with fx and fy"] {
            assert!(words.contains(part), "{part} in {words}");
        }
    }
}

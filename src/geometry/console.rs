//! What a console did to the panel's picture before it stored it, and how that is undone.
//!
//! The console crops the panel's picture, bins and enlarges it, turns it clockwise, then mirrors it (the order of DICOM's field of view
//! rotation and flip). Turning and mirroring are undone on the pixels, exactly; cropping, binning and enlarging are folded into the
//! C-arm's calibration, because resampled pixels would be worse ones.

use serde::{Deserialize, Serialize};

use super::CarmCalibration;
use crate::image::Image;

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

/// What a console did to the panel's picture: `detector_from_image` in the words of a session file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConsoleGeometry {
    /// Clockwise, before the flip: 0, 90, 180 or 270.
    pub rotation_deg: u32,
    /// After the rotation.
    pub flip: Flip,
    /// Left, top, columns and rows of the part that is shown, in pixels of the C-arm's calibration; all of it when absent.
    pub crop_px: Option<[u32; 4]>,
    /// Pixels of the calibration, each way, that were averaged into one.
    pub binning: u32,
    /// Enlargement after binning; 1 for none.
    pub zoom: f64,
    /// Left, top, columns and rows of areas that the console wrote into, in pixels of the stored picture.
    pub burned_in_px: Vec<[u32; 4]>,
}

impl Default for ConsoleGeometry {
    fn default() -> Self {
        Self { rotation_deg: 0, flip: Flip::None, crop_px: None, binning: 1, zoom: 1.0, burned_in_px: Vec::new() }
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

/// Where the pixels of an oriented frame lie on the panel: `panel + ½ = first + step · (pixel + ½)`, per axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PanelWindow {
    /// Left and top edge of the frame in pixels of the panel.
    pub first_px: [f64; 2],
    /// Panel pixels per pixel of the frame.
    pub step: f64,
}

impl PanelWindow {
    /// The frame is the panel's picture, pixel by pixel.
    pub const WHOLE: Self = Self { first_px: [0.0; 2], step: 1.0 };
}

impl ConsoleGeometry {
    /// The first number that no console has.
    ///
    /// # Errors
    /// Which one.
    pub fn check(&self) -> Result<(), ConsoleError> {
        let wrong = |key, found: String, expected| Err(ConsoleError::Value { key, found, expected });
        if !matches!(self.rotation_deg, 0 | 90 | 180 | 270) {
            return wrong("rotation_deg", self.rotation_deg.to_string(), "0, 90, 180 or 270");
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
        Ok(())
    }

    /// Quarter turns clockwise, and whether the columns were reversed after them. A vertical flip is half a turn and a horizontal one.
    fn turns_and_mirror(&self) -> (u32, bool) {
        let quarter_turns = self.rotation_deg / 90;
        match self.flip {
            Flip::None => (quarter_turns % 4, false),
            Flip::Horizontal => (quarter_turns % 4, true),
            Flip::Vertical => ((quarter_turns + 2) % 4, true),
        }
    }

    /// Columns and rows as stored of a picture that has `oriented` columns and rows on the panel.
    #[must_use]
    pub fn stored_size<N: Copy>(&self, oriented: [N; 2]) -> [N; 2] {
        let [columns, rows] = oriented;
        if self.turns_and_mirror().0 % 2 == 1 { [rows, columns] } else { [columns, rows] }
    }

    /// The picture as it lies on the panel: an exact permutation of the pixels. `unmirrored`: the columns were put back in order at
    /// import already, because the file itself says that they were reversed.
    #[must_use]
    pub fn orient<T: Clone>(&self, stored: &Image<T>, unmirrored: bool) -> Image<T> {
        let (quarter_turns, mirrored) = self.turns_and_mirror();
        let mirrored = mirrored && !unmirrored;
        let [width, height] = self.stored_size([stored.width, stored.height]);
        let mut pixels = Vec::with_capacity(stored.pixels.len());
        for v in 0..height {
            for u in 0..width {
                // A clockwise quarter turn takes the top row to the last column.
                let (column, row) = match quarter_turns {
                    0 => (u, v),
                    1 => (height - 1 - v, u),
                    2 => (width - 1 - u, height - 1 - v),
                    _ => (v, width - 1 - u),
                };
                let column = if mirrored { stored.width - 1 - column } else { column };
                pixels.push(stored.pixels[row * stored.width + column].clone());
            }
        }
        Image { width, height, pixels }
    }

    /// Where an oriented frame's pixels lie on the panel.
    #[must_use]
    pub fn window(&self) -> PanelWindow {
        let [left, top] = self.crop_px.map_or([0.0; 2], |crop| [f64::from(crop[0]), f64::from(crop[1])]);
        PanelWindow { first_px: [left, top], step: f64::from(self.binning) / self.zoom }
    }

    /// Columns and rows of an oriented frame from a panel of `panel_px`.
    fn oriented_size(&self, panel_px: [u32; 2]) -> Result<[u32; 2], ConsoleError> {
        let crop_px = self.crop_px.unwrap_or([0, 0, panel_px[0], panel_px[1]]);
        let reaches = |axis: usize| crop_px[axis].checked_add(crop_px[axis + 2]).is_none_or(|end| end > panel_px[axis]);
        if reaches(0) || reaches(1) {
            return Err(ConsoleError::CropOutside { crop_px, panel_px });
        }
        let side = |count: u32| (f64::from(count / self.binning.max(1)) * self.zoom).round() as u32;
        Ok([side(crop_px[2]), side(crop_px[3])])
    }

    /// Whether the cropped part lies on the panel of `carm`.
    ///
    /// # Errors
    /// When it reaches beyond.
    pub fn check_on(&self, carm: &CarmCalibration) -> Result<(), ConsoleError> {
        self.oriented_size([carm.columns_px, carm.rows_px]).map(|_| ())
    }

    /// The calibration of an oriented frame that was stored with `stored_px` columns and rows: cropping, binning and enlargement are
    /// folded into its size, pitch and principal point.
    ///
    /// # Errors
    /// When the crop does not lie on the panel, or the frame has another size than panel and console give it; the message says what to
    /// declare.
    pub fn calibration_of(&self, carm: &CarmCalibration, stored_px: [u32; 2]) -> Result<CarmCalibration, ConsoleError> {
        let panel_px = [carm.columns_px, carm.rows_px];
        let oriented = self.oriented_size(panel_px)?;
        let expected = self.stored_size(oriented);
        // An enlarged picture may have been cut to a whole number of pixels either way.
        let slack = if self.zoom == 1.0 { 0 } else { 1 };
        if expected[0].abs_diff(stored_px[0]) > slack || expected[1].abs_diff(stored_px[1]) > slack {
            return Err(ConsoleError::Size { found: stored_px, expected, remedy: remedy(expected, stored_px) });
        }
        let PanelWindow { first_px, step } = self.window();
        let middle = [f64::from(carm.columns_px) * 0.5 - 0.5, f64::from(carm.rows_px) * 0.5 - 0.5];
        let principal = carm.principal_point_px.unwrap_or(middle);
        let in_frame = |axis: usize| (principal[axis] + 0.5 - first_px[axis]) / step - 0.5;
        let [columns_px, rows_px] = self.stored_size(stored_px);
        Ok(CarmCalibration {
            columns_px,
            rows_px,
            pitch_mm: carm.pitch_mm * step,
            principal_point_px: Some([in_frame(0), in_frame(1)]),
            ..carm.clone()
        })
    }

    /// What is undone, in words; empty when there is nothing to undo.
    #[must_use]
    pub fn words(&self) -> Vec<String> {
        let mut words = Vec::new();
        if self.rotation_deg != 0 {
            words.push(format!("turned back by {} degrees", self.rotation_deg));
        }
        if self.flip != Flip::None {
            words.push(format!("un-mirrored ({})", if self.flip == Flip::Horizontal { "horizontal" } else { "vertical" }));
        }
        if let Some(crop) = self.crop_px {
            words.push(format!("cropped by the console to {crop:?}"));
        }
        if self.binning != 1 || self.zoom != 1.0 {
            words.push(format!("binned by {} and enlarged {} times by the console", self.binning, self.zoom));
        }
        words
    }
}

/// What a person can declare about a frame of another size.
fn remedy(expected: [u32; 2], found: [u32; 2]) -> String {
    let factor = expected[0].checked_div(found[0]).unwrap_or(0);
    if found == [expected[1], expected[0]] {
        "it looks turned: declare \"console\": {\"rotation_deg\": 90 or 270} in the session file".to_owned()
    } else if factor >= 2 && found == expected.map(|side| side / factor) {
        format!("it looks binned: declare \"console\": {{\"binning\": {factor}}} in the session file")
    } else if found[0] <= expected[0] && found[1] <= expected[1] {
        "declare the shown part as \"console\": {\"crop_px\": [left, top, columns, rows]}, or its \"binning\" or \"zoom\", in the \
         session file, or name the C-arm calibration of this mode"
            .to_owned()
    } else {
        "name the C-arm calibration of this mode, or declare \"console\": {\"zoom\": …} in the session file".to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three columns, two rows, no two pixels alike.
    fn asymmetric() -> Image<u8> {
        Image { width: 3, height: 2, pixels: vec![1, 2, 3, 4, 5, 6] }
    }

    fn stored(rotation_deg: u32, flip: Flip) -> (ConsoleGeometry, Image<u8>) {
        // Written down by hand from the picture 123/456: what a person sees after turning it clockwise, then mirroring.
        let rows: &[&[u8]] = match (rotation_deg, flip) {
            (0, Flip::None) => &[&[1, 2, 3], &[4, 5, 6]],
            (90, Flip::None) => &[&[4, 1], &[5, 2], &[6, 3]],
            (180, Flip::None) => &[&[6, 5, 4], &[3, 2, 1]],
            (270, Flip::None) => &[&[3, 6], &[2, 5], &[1, 4]],
            (0, Flip::Horizontal) => &[&[3, 2, 1], &[6, 5, 4]],
            (90, Flip::Horizontal) => &[&[1, 4], &[2, 5], &[3, 6]],
            (180, Flip::Horizontal) => &[&[4, 5, 6], &[1, 2, 3]],
            (270, Flip::Horizontal) => &[&[6, 3], &[5, 2], &[4, 1]],
            (0, Flip::Vertical) => &[&[4, 5, 6], &[1, 2, 3]],
            (90, Flip::Vertical) => &[&[6, 3], &[5, 2], &[4, 1]],
            (180, Flip::Vertical) => &[&[3, 2, 1], &[6, 5, 4]],
            _ => &[&[1, 4], &[2, 5], &[3, 6]],
        };
        let image = Image { width: rows[0].len(), height: rows.len(), pixels: rows.concat() };
        (ConsoleGeometry { rotation_deg, flip, ..ConsoleGeometry::default() }, image)
    }

    #[test]
    fn every_orientation_comes_back_pixel_by_pixel() {
        let mut cases = 0;
        for rotation_deg in [0, 90, 180, 270] {
            for flip in [Flip::None, Flip::Horizontal, Flip::Vertical] {
                let (console, picture) = stored(rotation_deg, flip);
                assert_eq!(console.orient(&picture, false), asymmetric(), "{rotation_deg} {flip:?}");
                if flip != Flip::None {
                    let mut read = picture.clone();
                    read.pixels.chunks_exact_mut(picture.width).for_each(<[u8]>::reverse);
                    assert_eq!(console.orient(&read, true), asymmetric(), "un-mirrored at import: {rotation_deg} {flip:?}");
                }
                cases += 1;
            }
        }
        assert_eq!(cases, 12);
        let (quarter, picture) = stored(90, Flip::None);
        let wrong = ConsoleGeometry { rotation_deg: 270, ..quarter };
        assert_ne!(wrong.orient(&picture, false), asymmetric(), "control: the other way round");
    }

    fn carm() -> CarmCalibration {
        serde_json::from_value(serde_json::json!({
            "origin": "test", "columns_px": 600, "rows_px": 400, "pitch_mm": 0.2, "source_to_isocentre_mm": 600.0,
            "principal_point_px": [310.0, 190.0], "source_to_detector_mm": 1000.0, "column_to_isocentre_mm": [0.0, 0.0, 0.0]
        }))
        .expect("valid")
    }

    #[test]
    fn a_ray_hits_the_same_place_on_the_panel() {
        let console = ConsoleGeometry { crop_px: Some([100, 40, 400, 300]), binning: 2, zoom: 1.5, ..ConsoleGeometry::default() };
        let folded = console.calibration_of(&carm(), [300, 225]).expect("fits");
        let joints = crate::geometry::CarmJoints::ZERO;
        let (panel, frame) = (carm().intrinsics(&joints).expect("K"), folded.intrinsics(&joints).expect("K"));
        let window = console.window();
        let mut cases = 0;
        for [x, y] in [[0.0, 0.0], [0.03, -0.02], [-0.041, 0.037]] {
            let on_panel = [panel.fx * x + panel.cx, panel.fy * y + panel.cy];
            let in_frame = [frame.fx * x + frame.cx, frame.fy * y + frame.cy];
            for axis in 0..2 {
                let back = window.first_px[axis] + window.step * (in_frame[axis] + 0.5) - 0.5;
                assert!((back - on_panel[axis]).abs() < 1e-9, "{back} {on_panel:?}");
            }
            cases += 1;
        }
        assert_eq!(cases, 3);
        assert!((frame.source_to_detector_mm(folded.pitch_mm) - 1000.0).abs() < 1e-9, "the panel stays where it is");
    }

    #[test]
    fn a_size_that_does_not_fit_is_told_what_to_declare() {
        let plain = ConsoleGeometry::default();
        let turned = ConsoleGeometry { rotation_deg: 90, ..plain.clone() };
        assert!(plain.calibration_of(&carm(), [600, 400]).is_ok() && turned.calibration_of(&carm(), [400, 600]).is_ok());
        for (found, says) in
            [([400, 600], "rotation_deg"), ([300, 200], "\"binning\": 2"), ([500, 400], "crop_px"), ([900, 600], "zoom")]
        {
            let error = plain.calibration_of(&carm(), found).expect_err("another size").to_string();
            assert!(error.contains(says), "{error}");
        }
        assert!(turned.calibration_of(&carm(), [600, 400]).is_err());
        let beyond = ConsoleGeometry { crop_px: Some([500, 0, 101, 10]), ..plain.clone() };
        assert!(matches!(beyond.calibration_of(&carm(), [101, 10]), Err(ConsoleError::CropOutside { .. })));
        for wrong in [
            ConsoleGeometry { rotation_deg: 45, ..plain.clone() },
            ConsoleGeometry { zoom: f64::NAN, ..plain.clone() },
            ConsoleGeometry { binning: 0, ..plain.clone() },
            ConsoleGeometry { crop_px: Some([0, 0, 0, 4]), ..plain.clone() },
        ] {
            assert!(wrong.check().is_err(), "{wrong:?}");
        }
        assert!(plain.check().is_ok());
    }
}

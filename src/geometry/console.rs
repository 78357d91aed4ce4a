//! What a console did to the panel's picture before it stored it, and how that is undone.
//!
//! The console crops the panel's picture, bins and enlarges it, turns it clockwise, then mirrors it (the order of DICOM's field of view
//! rotation and flip). Quarter turns and mirroring are undone on the pixels, exactly; the rest of a turn, cropping, binning and enlarging
//! are folded into K and the camera's axes ([`PanelWindow`]), because resampled pixels would be worse ones.

use glam::{DAffine2, DMat2, DVec2};
use serde::{Deserialize, Serialize};

use super::panel_window::PanelWindow;
use super::{CarmCalibration, Intrinsics};
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

/// A turn in parts: whole quarters clockwise, and what is left of it, within an eighth of a turn.
#[must_use]
pub fn quarters_and_rest(turned_rad: f64) -> (u32, f64) {
    let quarters = (turned_rad / std::f64::consts::FRAC_PI_2).round();
    (quarters.rem_euclid(4.0) as u32, turned_rad - quarters * std::f64::consts::FRAC_PI_2)
}

/// How a picture lies besides where: `turns` quarters clockwise and `turned_rad` more, then its columns reversed if `mirrored`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Lie {
    turns: u32,
    turned_rad: f64,
    mirrored: bool,
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
                "three rows that turn, mirror, enlarge (0.05 to 20) and shift, last row [0, 0, 1]",
            );
        }
        Ok(())
    }

    fn lie(&self) -> Lie {
        let Some(rows) = &self.detector_from_image else {
            let (turns, turned_rad) = quarters_and_rest(self.rotation_deg.to_radians());
            // A vertical flip is half a turn and a horizontal one.
            let (half, mirrored) = match self.flip {
                Flip::None => (0, false),
                Flip::Horizontal => (0, true),
                Flip::Vertical => (2, true),
            };
            let exact = self.rotation_deg.rem_euclid(90.0) == 0.0;
            return Lie { turns: (turns + half) % 4, turned_rad: if exact { 0.0 } else { turned_rad }, mirrored };
        };
        let matrix = affine(rows).matrix2;
        let mirrored = matrix.determinant() < 0.0;
        let x = if mirrored { -matrix.x_axis } else { matrix.x_axis };
        // The matrix turns back.
        let (turns, turned_rad) = quarters_and_rest(-x.y.atan2(x.x));
        Lie { turns, turned_rad, mirrored }
    }

    /// Whether columns and rows of the stored picture are those of a mirror image.
    #[must_use]
    pub fn is_mirrored(&self) -> bool {
        self.lie().mirrored
    }

    /// Columns and rows as stored of a picture that has `oriented` columns and rows on the panel.
    #[must_use]
    pub fn stored_size<N: Copy>(&self, oriented: [N; 2]) -> [N; 2] {
        let [columns, rows] = oriented;
        if self.lie().turns % 2 == 1 { [rows, columns] } else { [columns, rows] }
    }

    /// The picture as it lies on the panel: an exact permutation of the pixels. `unmirrored`: the columns were put back in order at
    /// import already, because the file itself says that they were reversed.
    #[must_use]
    pub fn orient<T: Clone>(&self, stored: &Image<T>, unmirrored: bool) -> Image<T> {
        let Lie { turns, mirrored, .. } = self.lie();
        let mirrored = mirrored && !unmirrored;
        let [width, height] = self.stored_size([stored.width, stored.height]);
        let mut pixels = Vec::with_capacity(stored.pixels.len());
        for v in 0..height {
            for u in 0..width {
                // A clockwise quarter turn takes the top row to the last column.
                let (column, row) = match turns {
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

    /// Pixels of the oriented frame to those of the stored one of `stored_px` columns and rows.
    #[must_use]
    pub fn stored_from_oriented(&self, stored_px: [u32; 2]) -> DAffine2 {
        let Lie { turns, mirrored, .. } = self.lie();
        let [width, height] = self.stored_size(stored_px).map(f64::from);
        let (x, y, origin) = match turns {
            0 => (DVec2::X, DVec2::Y, DVec2::ZERO),
            1 => (DVec2::Y, -DVec2::X, DVec2::new(height - 1.0, 0.0)),
            2 => (-DVec2::X, -DVec2::Y, DVec2::new(width - 1.0, height - 1.0)),
            _ => (-DVec2::Y, DVec2::X, DVec2::new(0.0, width - 1.0)),
        };
        let turned = DAffine2::from_mat2_translation(DMat2::from_cols(x, y), origin);
        if !mirrored {
            return turned;
        }
        let last = f64::from(stored_px[0]) - 1.0;
        DAffine2::from_mat2_translation(DMat2::from_diagonal(DVec2::new(-1.0, 1.0)), DVec2::new(last, 0.0)) * turned
    }

    /// Where the pixels of the oriented frame lie on the panel; `stored_px`: columns and rows of the frame as stored.
    #[must_use]
    pub fn window(&self, stored_px: [u32; 2]) -> PanelWindow {
        let Lie { turned_rad, .. } = self.lie();
        if let Some(rows) = &self.detector_from_image {
            let detector_from_image = affine(rows);
            let corner = (detector_from_image * self.stored_from_oriented(stored_px)).transform_point2(DVec2::splat(-0.5));
            let step = detector_from_image.matrix2.determinant().abs().sqrt();
            return PanelWindow { first_px: (corner + 0.5).to_array(), step, turned_rad };
        }
        let [left, top] = self.crop_px.map_or([0.0; 2], |crop| [f64::from(crop[0]), f64::from(crop[1])]);
        let step = f64::from(self.binning) / self.zoom;
        // The middle stays where it is.
        let middle = 0.5 * DVec2::from_array(self.stored_size(stored_px).map(f64::from));
        let shift = step * (middle - DVec2::from_angle(-turned_rad).rotate(middle));
        let first_px = if turned_rad == 0.0 { [left, top] } else { [left + shift.x, top + shift.y] };
        PanelWindow { first_px, step, turned_rad }
    }

    /// Pixels of a stored picture of `stored_px` columns and rows to pixels of the panel; centres at integers.
    #[must_use]
    pub fn detector_from_image(&self, stored_px: [u32; 2]) -> DAffine2 {
        match &self.detector_from_image {
            Some(rows) => affine(rows),
            None => self.window(stored_px).detector_from_oriented() * self.stored_from_oriented(stored_px).inverse(),
        }
    }

    /// Left, top, columns and rows of the part of the panel that is shown, or `None` when it reaches beyond.
    fn shown(&self, panel_px: [u32; 2]) -> Result<[u32; 4], ConsoleError> {
        let crop_px = self.crop_px.unwrap_or([0, 0, panel_px[0], panel_px[1]]);
        let reaches = |axis: usize| crop_px[axis].checked_add(crop_px[axis + 2]).is_none_or(|end| end > panel_px[axis]);
        if reaches(0) || reaches(1) { Err(ConsoleError::CropOutside { crop_px, panel_px }) } else { Ok(crop_px) }
    }

    /// Whether the console leaves pixels without anything of a panel of `panel_px` in the oriented frame, by place; `None` where it
    /// leaves none.
    #[must_use]
    pub fn beside_the_panel(&self, panel_px: [u32; 2], stored_px: [u32; 2]) -> Option<impl Fn(usize, usize) -> bool> {
        let window = self.window(stored_px);
        if self.detector_from_image.is_none() && window.turned_rad == 0.0 {
            return None;
        }
        let detector_from_oriented = window.detector_from_oriented();
        let [left, top, columns, rows] = self.shown(panel_px).ok()?.map(f64::from);
        Some(move |column: usize, row: usize| {
            let p = detector_from_oriented.transform_point2(DVec2::new(column as f64, row as f64)) + 0.5;
            !(p.x >= left && p.x <= left + columns && p.y >= top && p.y <= top + rows)
        })
    }

    /// Columns and rows of a picture from a panel of `panel_px`, oriented and as stored; `None` when the matrix leaves them open.
    fn expected(&self, panel_px: [u32; 2]) -> Result<Option<[u32; 2]>, ConsoleError> {
        let [_, _, columns, rows] = self.shown(panel_px)?;
        let side = |count: u32| (f64::from(count / self.binning.max(1)) * self.zoom).round() as u32;
        Ok(self.detector_from_image.is_none().then(|| self.stored_size([side(columns), side(rows)])))
    }

    /// Whether the cropped part lies on the panel of `carm`.
    ///
    /// # Errors
    /// When it reaches beyond.
    pub fn check_on(&self, carm: &CarmCalibration) -> Result<(), ConsoleError> {
        self.shown([carm.columns_px, carm.rows_px]).map(|_| ())
    }

    /// Where a frame that was stored with `stored_px` columns and rows lies on a panel of `panel_px`.
    ///
    /// # Errors
    /// When the crop does not lie on the panel, or the frame has another size than panel and console give it; the message says what to
    /// declare.
    pub fn window_on(&self, panel_px: [u32; 2], stored_px: [u32; 2]) -> Result<PanelWindow, ConsoleError> {
        if let Some(expected) = self.expected(panel_px)? {
            // An enlarged picture may have been cut to a whole number of pixels either way.
            let slack = if self.zoom == 1.0 { 0 } else { 1 };
            if expected[0].abs_diff(stored_px[0]) > slack || expected[1].abs_diff(stored_px[1]) > slack {
                return Err(ConsoleError::Size { found: stored_px, expected, remedy: remedy(expected, stored_px) });
            }
        }
        Ok(self.window(stored_px))
    }

    /// The calibration of an oriented frame that was stored with `stored_px` columns and rows: cropping, binning, enlargement and the
    /// rest of a turn are folded into its size, pitch, principal point and turn.
    ///
    /// # Errors
    /// As [`ConsoleGeometry::window_on`].
    pub fn calibration_of(&self, carm: &CarmCalibration, stored_px: [u32; 2]) -> Result<CarmCalibration, ConsoleError> {
        let panel_px = [carm.columns_px, carm.rows_px];
        let window = self.window_on(panel_px, stored_px)?;
        let middle = panel_px.map(|side| f64::from(side) * 0.5 - 0.5);
        let [cx, cy] = carm.principal_point_px.unwrap_or(middle);
        let (k, turn_rad) = window.intrinsics(&Intrinsics { fx: 1.0, fy: 1.0, skew: 0.0, cx, cy });
        let [columns_px, rows_px] = self.stored_size(stored_px);
        Ok(CarmCalibration {
            columns_px,
            rows_px,
            pitch_mm: carm.pitch_mm * window.step,
            principal_point_px: Some([k.cx, k.cy]),
            picture_turn_deg: carm.picture_turn_deg + turn_rad.to_degrees(),
            ..carm.clone()
        })
    }

    /// What is undone, in words; empty when there is nothing to undo.
    #[must_use]
    pub fn words(&self) -> Vec<String> {
        let mut words = Vec::new();
        if let Some(rows) = &self.detector_from_image {
            let Lie { turns, turned_rad, mirrored } = self.lie();
            let step = affine(rows).matrix2.determinant().abs().sqrt();
            words.push(format!(
                "detector_from_image undone: turned by {:.3} degrees{}, {:.4} times as large",
                90.0 * f64::from(turns) + turned_rad.to_degrees(),
                if mirrored { ", then mirrored" } else { "" },
                1.0 / step
            ));
        }
        if self.rotation_deg != 0.0 {
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

/// The 3×3 of an affine map of the plane, row by row.
#[must_use]
pub fn homogeneous_rows(affine: &DAffine2) -> [[f64; 3]; 3] {
    let [x, y, t] = [affine.matrix2.x_axis, affine.matrix2.y_axis, affine.translation];
    [[x.x, y.x, t.x], [x.y, y.y, t.y], [0.0, 0.0, 1.0]]
}

fn affine(rows: &[[f64; 3]; 3]) -> DAffine2 {
    let [[a, b, x], [c, d, y], _] = *rows;
    DAffine2::from_mat2_translation(DMat2::from_cols(DVec2::new(a, c), DVec2::new(b, d)), DVec2::new(x, y))
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

    fn stored(rotation_deg: i32, flip: Flip) -> (ConsoleGeometry, Image<u8>) {
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
        (ConsoleGeometry { rotation_deg: f64::from(rotation_deg), flip, ..ConsoleGeometry::default() }, image)
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
        let wrong = ConsoleGeometry { rotation_deg: 270.0, ..quarter };
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
        let window = console.window([300, 225]);
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
    fn a_turned_picture_is_that_of_a_turned_camera() {
        let console = ConsoleGeometry { rotation_deg: 193.0, flip: Flip::Horizontal, zoom: 1.5, ..ConsoleGeometry::default() };
        let sagging: CarmCalibration = CarmCalibration {
            sag: Some(serde_json::from_value(serde_json::json!({
                "translation_mm": [[1.0, 0.0, 2.0], [0.0, 3.0, 0.0], [0.0, 0.0, 1.0]], "rotation_deg": [[0.5, 0.0, 0.2], [0.0, 0.1, 0.0], [0.3, 0.0, 0.0]]
            })).expect("sag")),
            misalignment: crate::geometry::Misalignment { detector_offset_mm: [7.0, -4.0], ..Default::default() },
            ..carm()
        };
        let folded = console.calibration_of(&sagging, [900, 600]).expect("fits");
        let joints = crate::geometry::CarmJoints { orbital_rad: 0.4, angulation_rad: -0.2, ..crate::geometry::CarmJoints::ZERO };
        let seen = |carm: &CarmCalibration, p_in_world: glam::DVec3| {
            let camera_from_world = carm.world_from_camera(&joints).expect("measured").inverse();
            carm.intrinsics(&joints).expect("K").project(camera_from_world.transform_point(p_in_world))
        };
        let detector_from_oriented = console.window([900, 600]).detector_from_oriented();
        for p in [glam::DVec3::new(0.0, 0.0, 0.0), glam::DVec3::new(30.0, -20.0, 40.0)] {
            let there = detector_from_oriented.transform_point2(seen(&folded, p));
            assert!(there.distance(seen(&sagging, p)) < 1e-8, "{there} {}", seen(&sagging, p));
        }
    }

    #[test]
    fn a_size_that_does_not_fit_is_told_what_to_declare() {
        let plain = ConsoleGeometry::default();
        let turned = ConsoleGeometry { rotation_deg: 90.0, ..plain.clone() };
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
            ConsoleGeometry { rotation_deg: 400.0, ..plain.clone() },
            ConsoleGeometry { zoom: f64::NAN, ..plain.clone() },
            ConsoleGeometry { binning: 0, ..plain.clone() },
            ConsoleGeometry { crop_px: Some([0, 0, 0, 4]), ..plain.clone() },
        ] {
            assert!(wrong.check().is_err(), "{wrong:?}");
        }
        assert!(plain.check().is_ok());
    }
}

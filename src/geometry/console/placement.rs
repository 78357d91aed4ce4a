//! Where a stored picture lies on the panel, and what that makes of the C-arm's calibration.

use glam::{DAffine2, DVec2};

use super::declared::{ConsoleError, ConsoleGeometry, affine};
use super::orientation::Lie;
use crate::geometry::panel_window::PanelWindow;
use crate::geometry::{CarmCalibration, Intrinsics};

impl ConsoleGeometry {
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

    /// Columns and rows as stored of the picture of a panel of `panel_px`; `None` where a matrix leaves them open, or the crop lies beside it.
    #[must_use]
    pub fn stored_px(&self, panel_px: [u32; 2]) -> Option<[u32; 2]> {
        self.expected(panel_px).ok().flatten()
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
}

/// What a person can declare about a frame of another size.
fn remedy(expected: [u32; 2], found: [u32; 2]) -> String {
    let binned = |px: [u32; 2]| (1..=8).find(|factor| px == expected.map(|side| side / factor));
    let [columns, rows] = found;
    if let Some(factor) = binned(found) {
        format!("it looks binned: declare \"console\": {{\"binning\": {factor}}} in the session file")
    } else if let Some(factor) = binned([rows, columns]) {
        let (looks, key) =
            if factor > 1 { ("binned and turned", format!("\"binning\": {factor}, ")) } else { ("turned", String::new()) };
        format!("it looks {looks}: declare \"console\": {{{key}\"rotation_deg\": 90 or 270}} in the session file")
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
    use super::super::Flip;
    use super::*;

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
        for (found, says) in [
            ([400, 600], "looks turned: declare \"console\": {\"rotation_deg\": 90 or 270}"),
            ([300, 200], "{\"binning\": 2}"),
            ([200, 300], "{\"binning\": 2, \"rotation_deg\""),
            ([500, 400], "crop_px"),
            ([900, 600], "zoom"),
        ] {
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

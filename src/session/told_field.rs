//! Where telemetry puts the shutters in a frame.

use glam::DVec2;

use crate::acquire::Frame;
use crate::geometry::{CarmCalibration, PanelWindow};
use crate::mask::{FieldShape, HalfPlane};

/// The blades of `field_mm` (left, top, right, bottom at the detector, from the panel's middle) as they lie in an imported frame; those
/// that were not measured, or that stand outside the panel, are left out.
pub(super) fn told_field(field_mm: [f64; 4], carm: &CarmCalibration, frame: &Frame) -> FieldShape {
    let stored = frame.correction.as_ref().and_then(|correction| correction.stored.as_ref());
    let window = stored.map_or(PanelWindow::WHOLE, |stored| stored.console.window(stored.size_px));
    let detector_from_frame = window.detector_from_oriented();
    let panel_px = DVec2::new(f64::from(carm.columns_px), f64::from(carm.rows_px));
    let middle = 0.5 * (panel_px - DVec2::ONE);
    let [left, top, right, bottom] = field_mm;
    let sides = [(DVec2::NEG_X, -left), (DVec2::NEG_Y, -top), (DVec2::X, right), (DVec2::Y, bottom)];
    let in_frame = |(normal, reach_mm): (DVec2, f64)| {
        let on_panel = (reach_mm / carm.pitch_mm).abs() < 0.5 * panel_px.dot(normal.abs());
        let limit = middle.dot(normal) + reach_mm / carm.pitch_mm - normal.dot(detector_from_frame.translation);
        let across = detector_from_frame.matrix2.transpose() * normal;
        on_panel.then(|| HalfPlane { normal: across.normalize(), limit_px: limit / across.length() })
    };
    FieldShape { half_planes: sides.into_iter().filter_map(in_frame).collect(), ..FieldShape::default() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::Domain;
    use crate::geometry::ConsoleGeometry;
    use crate::image::Image;

    fn carm() -> CarmCalibration {
        serde_json::from_str(include_str!("../../calibration/carm/live-620x480.json")).expect("a calibration")
    }

    #[test]
    fn a_blade_lies_where_telemetry_says_in_whole_and_in_cropped_and_binned_frames() {
        let carm = carm();
        let (columns, rows) = (carm.columns_px as usize, carm.rows_px as usize);
        let whole = Frame::from_pixels("whole", Image::filled(columns, rows, 1.0f32), Domain::Linear).expect("a frame");
        // 40 px of the panel from its left edge; the others outside or not measured.
        let left_mm = (40.0 - 0.5 * columns as f64) * carm.pitch_mm;
        let told = told_field([left_mm, f64::NAN, 1e4, f64::NAN], &carm, &whole);
        assert_eq!(told.half_planes.len(), 1);
        assert!((told.half_planes[0].limit_px + 39.5).abs() < 1e-9, "{told:?}");
        let console: ConsoleGeometry =
            serde_json::from_str(r#"{"crop_px": [20, 0, 200, 200], "binning": 2}"#).expect("a console");
        let stored = Frame::from_pixels("cut", Image::filled(100, 100, 1.0f32), Domain::Linear).expect("a frame");
        let cut = stored.oriented(&console, Some([carm.columns_px, carm.rows_px]));
        let told = told_field([left_mm, f64::NAN, f64::NAN, f64::NAN], &carm, &cut);
        // Panel's x = 39.5 is 20 of the crop's from its left edge at 19.5: 10 binned pixels, whose first centre is at half a one.
        assert!((told.half_planes[0].limit_px + 9.5).abs() < 1e-9, "{told:?}");
    }
}

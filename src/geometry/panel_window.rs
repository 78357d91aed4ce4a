//! Where the pixels of an oriented frame lie on the panel, and what that makes of K and of the camera's axes.

use glam::{DAffine2, DMat2, DQuat, DVec2};

use super::{Intrinsics, Rigid};

/// Where the pixels of an oriented frame lie on the panel: `panel + ½ = first + step · R(−turned) · (pixel + ½)`, R clockwise as seen.
///
/// Oriented: whole quarter turns and mirroring are undone. What is left is no reason to resample the picture: it is part of K and of a
/// turn of the camera about its z axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PanelWindow {
    /// Left top corner of the frame in pixels of the panel, from the panel's left top corner.
    pub first_px: [f64; 2],
    /// Panel pixels per pixel of the frame.
    pub step: f64,
    /// How far the picture was turned clockwise, besides quarter turns.
    pub turned_rad: f64,
}

impl PanelWindow {
    /// The frame is the panel's picture, pixel by pixel.
    pub const WHOLE: Self = Self { first_px: [0.0; 2], step: 1.0, turned_rad: 0.0 };

    /// Pixels of the oriented frame to pixels of the panel; centres at integers.
    #[must_use]
    pub fn detector_from_oriented(&self) -> DAffine2 {
        let linear = DMat2::from_scale_angle(DVec2::splat(self.step), -self.turned_rad);
        let half = DVec2::splat(0.5);
        DAffine2::from_mat2_translation(linear, DVec2::from_array(self.first_px) + linear * half - half)
    }

    /// K of the oriented frame, and the turn about z (rad) from the panel's camera axes to the frame's; see [`seen_through`].
    #[must_use]
    pub fn intrinsics(&self, detector: &Intrinsics) -> (Intrinsics, f64) {
        seen_through(&self.detector_from_oriented().inverse(), detector)
    }
}

/// K of a picture whose pixels are `new_from_old` of another's with `old`, and the turn about z (rad) from the other camera's axes to
/// its own: `new_from_old · old = K · Rz(turn)`, an RQ decomposition of two columns.
#[must_use]
pub fn seen_through(new_from_old: &DAffine2, old: &Intrinsics) -> (Intrinsics, f64) {
    let linear = new_from_old.matrix2 * DMat2::from_cols(DVec2::new(old.fx, 0.0), DVec2::new(old.skew, old.fy));
    let turn_rad = linear.x_axis.y.atan2(linear.y_axis.y);
    let k = linear * DMat2::from_angle(-turn_rad);
    // Rounding makes no skew where pixels are square.
    let skew = if k.y_axis.x.abs() < 1e-9 * k.x_axis.x { 0.0 } else { k.y_axis.x };
    let centre = new_from_old.transform_point2(DVec2::new(old.cx, old.cy));
    (Intrinsics { fx: k.x_axis.x, fy: k.y_axis.y, skew, cx: centre.x, cy: centre.y }, turn_rad)
}

/// A camera whose picture is turned clockwise by `turn_rad`, in the camera whose picture is not.
#[must_use]
pub fn turned_camera(turn_rad: f64) -> Rigid {
    Rigid::rotation(DQuat::from_rotation_z(turn_rad))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn k_and_turn_see_what_the_panel_sees() {
        let panel = Intrinsics { fx: 5200.0, fy: 5100.0, skew: 3.0, cx: 700.0, cy: 810.0 };
        let mut cases = 0;
        for (turned_deg, step) in [(0.0, 1.0), (13.0, 1.0 / 1.4), (-44.0, 2.0), (30.0, 0.3)] {
            let window = PanelWindow { first_px: [120.0, -33.0], step, turned_rad: f64::to_radians(turned_deg) };
            let (k, turn_rad) = window.intrinsics(&panel);
            for p in [DVec3::new(10.0, -20.0, 600.0), DVec3::new(-70.0, 55.0, 800.0)] {
                let there =
                    window.detector_from_oriented().transform_point2(k.project(turned_camera(turn_rad).transform_point(p)));
                assert!(there.distance(panel.project(p)) < 1e-9, "{turned_deg}: {there} {}", panel.project(p));
                cases += 1;
            }
        }
        assert_eq!(cases, 8);
        assert_eq!(PanelWindow::WHOLE.intrinsics(&panel), (panel, 0.0), "bit for bit");
    }
}

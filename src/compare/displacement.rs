//! How differently two views show what lies in the field.

use glam::DVec2;

use crate::geometry::View;

/// The largest distance, in pixels of `a`, between where two views of one raster show a point that `a` sees: points all over the field, from
/// half its width nearer than `depth_mm` to as much farther away. Infinite where `b` has one behind its source.
#[must_use]
pub fn farthest_apart_px(a: &View, b: &View, depth_mm: f64) -> f64 {
    let b_from_a = b.camera_from_lps * a.camera_from_lps.inverse();
    let [width, height] = a.size_px.map(|n| f64::from(n) - 1.0);
    // Half the field's width at this depth, as a share of the depth.
    let deep = (0.5 * width.max(height) / a.intrinsics.fx).min(0.5);
    let mut farthest = 0.0f64;
    for index in 0..27 {
        let [across, down, along] = [index % 3, index / 3 % 3, index / 9].map(f64::from);
        let in_image = DVec2::new(0.5 * across * width, 0.5 * down * height);
        let in_a = a.intrinsics.unproject(in_image) * depth_mm * (1.0 + (along - 1.0) * deep);
        let in_b = b_from_a.transform_point(in_a);
        let apart_px = b.intrinsics.project(in_b).distance(in_image);
        if !(in_b.z > 0.0 && apart_px.is_finite()) {
            return f64::INFINITY;
        }
        farthest = farthest.max(apart_px);
    }
    farthest
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::geometry::{Intrinsics, Rigid};

    #[test]
    fn a_shift_counts_most_where_it_is_nearest_and_behind_the_source_is_infinitely_far() {
        let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 100.0, cy: 80.0 };
        let camera_from_lps = Rigid { rotation: DQuat::from_rotation_x(0.7), translation_mm: DVec3::new(1.0, 2.0, 500.0) };
        let view = View { size_px: [201, 161], intrinsics, camera_from_lps };
        let at = |motion: Rigid| farthest_apart_px(&view, &View { camera_from_lps: motion * camera_from_lps, ..view }, 500.0);
        assert!(at(Rigid::translation(DVec3::ZERO)) < 1e-9);
        // The field is 100 mm wide at 500 mm, so it begins at 450 mm: 2 mm across are 2 · 1000 / 450 px there.
        assert!((at(Rigid::translation(DVec3::new(0.0, 2.0, 0.0))) - 2000.0 / 450.0).abs() < 1e-9);
        assert_eq!(at(Rigid::rotation(DQuat::from_rotation_x(std::f64::consts::PI))), f64::INFINITY);
        assert_eq!(at(Rigid::translation(DVec3::new(f64::NAN, 0.0, 0.0))), f64::INFINITY);
    }
}

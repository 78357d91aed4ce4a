//! The open field's outline: an intersection of half planes and at most one disc, in image coordinates (px).

use glam::DVec2;
use rayon::prelude::*;

use crate::image::Image;

/// Points with `normal · x <= limit_px` are on the open side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HalfPlane {
    /// Unit vector out of the field.
    pub normal: DVec2,
    pub limit_px: f64,
}

/// Points within `radius_px` of `centre` are on the open side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disc {
    pub centre: DVec2,
    pub radius_px: f64,
}

/// Where half of the beam passes; the open field lies on the open side of all.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FieldShape {
    pub half_planes: Vec<HalfPlane>,
    pub disc: Option<Disc>,
    /// Radius of the corners between neighbouring half planes that are at right angles; 0 for sharp ones.
    pub corner_radius_px: f64,
}

impl FieldShape {
    /// The same outline where `factor` × `factor` pixels stand for each.
    pub(super) fn enlarged(&self, factor: f64) -> Self {
        // The middle of the first block.
        let origin = DVec2::splat(0.5 * (factor - 1.0));
        let plane = |plane: &HalfPlane| HalfPlane { limit_px: factor * plane.limit_px + plane.normal.dot(origin), ..*plane };
        let disc = |disc: Disc| Disc { centre: factor * disc.centre + origin, radius_px: factor * disc.radius_px };
        Self {
            half_planes: self.half_planes.iter().map(plane).collect(),
            disc: self.disc.map(disc),
            corner_radius_px: factor * self.corner_radius_px,
        }
    }

    /// Distance to the outline, positive in the open field.
    #[must_use]
    pub fn depth_px(&self, x: DVec2) -> f64 {
        let disc = self.disc.map_or(f64::INFINITY, |disc| disc.radius_px - (x - disc.centre).length());
        let depth = |plane: &HalfPlane| plane.limit_px - plane.normal.dot(x);
        let radius = self.corner_radius_px;
        let mut least = disc;
        for (index, plane) in self.half_planes.iter().enumerate() {
            least = least.min(depth(plane));
            if radius > 0.0 && depth(plane) < radius {
                let right_angled = self.half_planes[..index].iter().filter(|other| other.normal.dot(plane.normal).abs() < 0.05);
                for other in right_angled.filter(|other| depth(other) < radius) {
                    least = least.min(radius - DVec2::new(radius - depth(plane), radius - depth(other)).length());
                }
            }
        }
        least
    }

    /// Pixels that are not at least `margin_px` inside.
    pub(super) fn outside(&self, width: usize, height: usize, margin_px: f64) -> Image<bool> {
        let mut outside = Image::filled(width, height, true);
        if width == 0 {
            return outside;
        }
        outside.pixels.par_chunks_mut(width).enumerate().for_each(|(row, pixels)| {
            let Some((first, last)) = self.open_columns(row as f64, width, margin_px) else { return };
            pixels[first..=last].fill(false);
            if self.corner_radius_px > 0.0 {
                for (column, pixel) in pixels.iter_mut().enumerate() {
                    *pixel |= !(self.depth_px(DVec2::new(column as f64, row as f64)) >= margin_px);
                }
            }
        });
        outside
    }

    /// First and last column of a row that lie inside by the margin, round corners apart.
    fn open_columns(&self, v: f64, width: usize, margin_px: f64) -> Option<(usize, usize)> {
        let (mut least, mut most) = (0.0_f64, width as f64 - 1.0);
        for plane in &self.half_planes {
            let room = plane.limit_px - margin_px - plane.normal.y * v;
            if plane.normal.x.abs() < 1e-12 {
                if room < 0.0 {
                    return None;
                }
            } else if plane.normal.x > 0.0 {
                most = most.min(room / plane.normal.x);
            } else {
                least = least.max(room / plane.normal.x);
            }
        }
        if let Some(disc) = self.disc {
            let radius = disc.radius_px - margin_px;
            let squared = radius * radius - (v - disc.centre.y).powi(2);
            if !(radius > 0.0 && squared >= 0.0) {
                return None;
            }
            least = least.max(disc.centre.x - squared.sqrt());
            most = most.min(disc.centre.x + squared.sqrt());
        }
        let (first, last) = (least.ceil(), most.floor());
        (first <= last).then_some((first as usize, last as usize))
    }

    /// Short, for people.
    pub(super) fn describe(&self, width: usize, height: usize) -> String {
        let middle = DVec2::new(width as f64 - 1.0, height as f64 - 1.0) / 2.0;
        let mut parts = Vec::new();
        for plane in &self.half_planes {
            // Depth below the border, at the middle of that side of the frame that the blade comes from.
            let (side, reach, along) = if plane.normal.x.abs() > plane.normal.y.abs() {
                let from = if plane.normal.x < 0.0 { 0.0 } else { 2.0 * middle.x };
                (if plane.normal.x < 0.0 { "left" } else { "right" }, DVec2::new(from, middle.y), plane.normal.x.abs())
            } else {
                let from = if plane.normal.y < 0.0 { 0.0 } else { 2.0 * middle.y };
                (if plane.normal.y < 0.0 { "top" } else { "bottom" }, DVec2::new(middle.x, from), plane.normal.y.abs())
            };
            let tilt_deg = along.min(1.0).acos().to_degrees();
            let depth = (plane.normal.dot(reach) - plane.limit_px) / along;
            if tilt_deg < 0.5 {
                parts.push(format!("{side} edge {depth:.0} px deep"));
            } else {
                parts.push(format!("{side} edge {depth:.0} px deep in its middle, tilted by {tilt_deg:.0}°"));
            }
        }
        if let Some(disc) = self.disc {
            parts.push(format!("disc of radius {:.0} px about ({:.0}, {:.0})", disc.radius_px, disc.centre.x, disc.centre.y));
        }
        if self.corner_radius_px > 0.0 {
            parts.push(format!("corners of radius {:.0} px", self.corner_radius_px));
        }
        parts.join("; ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rectangle(corner_radius_px: f64) -> FieldShape {
        let plane = |normal: DVec2, limit_px| HalfPlane { normal, limit_px };
        let half_planes = vec![
            plane(DVec2::NEG_X, -20.0),
            plane(DVec2::X, 80.0),
            plane(DVec2::NEG_Y, -10.0),
            plane(DVec2::from_angle(1.6), 50.0),
        ];
        FieldShape { half_planes, disc: None, corner_radius_px }
    }

    #[test]
    fn the_mask_is_where_the_depth_says() {
        let disc = Some(Disc { centre: DVec2::new(45.0, 30.0), radius_px: 33.0 });
        for (radius, disc) in [(0.0, None), (12.0, None), (0.0, disc)] {
            let shape = FieldShape { disc, ..rectangle(radius) };
            let outside = shape.outside(100, 70, 2.5);
            let mut open = 0;
            for row in 0..70 {
                for column in 0..100 {
                    let depth = shape.depth_px(DVec2::new(column as f64, row as f64));
                    assert_eq!(*outside.at(column, row), depth < 2.5, "({column}, {row}) is {depth} deep");
                    open += usize::from(depth >= 2.5);
                }
            }
            assert!(open > 1000, "{open} open pixels");
        }
    }

    #[test]
    fn an_enlarged_outline_has_the_same_places() {
        let disc = Some(Disc { centre: DVec2::new(45.0, 30.0), radius_px: 33.0 });
        let shape = FieldShape { disc, ..rectangle(6.0) };
        let large = shape.enlarged(3.0);
        for at in [DVec2::new(21.0, 11.0), DVec2::new(50.0, 40.0), DVec2::new(79.0, 47.0), DVec2::new(5.0, 60.0)] {
            // Pixel (c, r) became the block about (3c + 1, 3r + 1).
            let there = large.depth_px(3.0 * at + DVec2::ONE);
            assert!((there - 3.0 * shape.depth_px(at)).abs() < 1e-9, "{at}: {there}");
        }
    }

    /// A quarter of a disc replaces a square of its radius: the corner at (20, 10) with radius 12 has its arc about (32, 22).
    #[test]
    fn a_round_corner_is_an_arc() {
        let shape = rectangle(12.0);
        let arc = DVec2::new(32.0, 22.0) - DVec2::splat(12.0 / std::f64::consts::SQRT_2);
        assert!(shape.depth_px(arc).abs() < 1e-9, "{}", shape.depth_px(arc));
        assert!((shape.depth_px(DVec2::new(20.0, 30.0))).abs() < 1e-9, "straight beside the corner");
        assert!(rectangle(0.0).depth_px(arc) > 3.0, "control: a sharp corner is open there");
    }
}

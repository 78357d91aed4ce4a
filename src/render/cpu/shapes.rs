//! Where a ray runs inside an analytic shape.

use glam::DVec3;

use crate::scene::model::Shape;

/// At most two intervals: a tube has two walls.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Spans {
    spans: [(f64, f64); 2],
    count: usize,
}

impl Spans {
    fn one(from: f64, to: f64) -> Self {
        if to > from { Self { spans: [(from, to), (0.0, 0.0)], count: 1 } } else { Self::default() }
    }

    fn push(&mut self, from: f64, to: f64) {
        if to > from {
            self.spans[self.count] = (from, to);
            self.count += 1;
        }
    }

    /// The intervals in order.
    #[must_use]
    pub fn as_slice(&self) -> &[(f64, f64)] {
        &self.spans[..self.count]
    }
}

/// The parameters t at which `p + q t` is inside the cylinder x² + y² ≤ r², or the unit sphere with `dims` = 3.
// The point of closest approach comes first, so that the discriminant r² − d² loses nothing to the distance of the source.
fn quadric(p: DVec3, q: DVec3, radius: f64) -> Option<(f64, f64)> {
    let qq = q.length_squared();
    if !(qq > 0.0) {
        return (p.length_squared() < radius * radius).then_some((f64::NEG_INFINITY, f64::INFINITY));
    }
    let middle = -p.dot(q) / qq;
    let nearest = p + q * middle;
    let discriminant = radius * radius - nearest.length_squared();
    if !(discriminant > 0.0) {
        return None;
    }
    let half = (discriminant / qq).sqrt();
    Some((middle - half, middle + half))
}

fn slab(p: f64, q: f64, lo: f64, hi: f64) -> Option<(f64, f64)> {
    if q == 0.0 {
        return (p >= lo && p <= hi).then_some((f64::NEG_INFINITY, f64::INFINITY));
    }
    let (a, b) = ((lo - p) / q, (hi - p) / q);
    Some((a.min(b), a.max(b)))
}

fn meet(a: (f64, f64), b: (f64, f64)) -> (f64, f64) {
    (a.0.max(b.0), a.1.min(b.1))
}

/// Parameters t for which `p + q t` (in the shape's frame, mm) lies in its matter; a lumen is no matter.
#[must_use]
pub fn intersect(shape: &Shape, p: DVec3, q: DVec3) -> Spans {
    match *shape {
        Shape::Ellipsoid { semi_axes_mm } => {
            quadric(p / semi_axes_mm, q / semi_axes_mm, 1.0).map_or_else(Spans::default, |(a, b)| Spans::one(a, b))
        }
        Shape::Cuboid { half_size_mm: h } => cuboid(p, q, -h, h).map_or_else(Spans::default, |(a, b)| Spans::one(a, b)),
        Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } => {
            let Some(caps) = slab(p.z, q.z, 0.0, length_mm) else { return Spans::default() };
            let (p, q) = (p.with_z(0.0), q.with_z(0.0));
            let Some(outer) = quadric(p, q, radius_mm) else { return Spans::default() };
            let (from, to) = meet(outer, caps);
            match quadric(p, q, inner_radius_mm).filter(|_| inner_radius_mm > 0.0) {
                None => Spans::one(from, to),
                Some((inner_from, inner_to)) => {
                    let mut spans = Spans::default();
                    spans.push(from, to.min(inner_from));
                    spans.push(from.max(inner_to), to);
                    spans
                }
            }
        }
    }
}

/// Parameters t for which `p + q t` lies in the box [`lo`, `hi`].
#[must_use]
pub fn cuboid(p: DVec3, q: DVec3, lo: DVec3, hi: DVec3) -> Option<(f64, f64)> {
    let x = slab(p.x, q.x, lo.x, hi.x)?;
    let y = slab(p.y, q.y, lo.y, hi.y)?;
    let z = slab(p.z, q.z, lo.z, hi.z)?;
    let (from, to) = meet(meet(x, y), z);
    (to > from).then_some((from, to))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn length(shape: Shape, p: DVec3, q: DVec3) -> f64 {
        intersect(&shape, p, q).as_slice().iter().map(|(a, b)| b - a).sum()
    }

    #[test]
    fn chords_are_closed_form() {
        let far = DVec3::new(12.0, 0.0, -1000.0);
        let sphere = Shape::Ellipsoid { semi_axes_mm: DVec3::splat(20.0) };
        assert!((length(sphere, far, DVec3::Z) - 32.0).abs() < 1e-9);
        let cuboid = Shape::Cuboid { half_size_mm: DVec3::new(20.0, 1.0, 5.0) };
        assert!((length(cuboid, far, DVec3::Z) - 10.0).abs() < 1e-9);
        assert_eq!(length(cuboid, far + DVec3::X * 9.0, DVec3::Z), 0.0);
        let tube = Shape::Cylinder { length_mm: 35.0, radius_mm: 3.0, inner_radius_mm: 2.0 };
        assert!((length(tube, DVec3::new(0.0, -100.0, 10.0), DVec3::Y) - 2.0).abs() < 1e-9, "both walls");
        assert!((length(tube, DVec3::new(2.5, 0.0, -100.0), DVec3::Z) - 35.0).abs() < 1e-9, "along the wall");
        assert_eq!(length(tube, DVec3::new(0.5, 0.0, -100.0), DVec3::Z), 0.0, "down the lumen");
        assert!((length(tube, DVec3::new(2.5, -100.0, 10.0), DVec3::Y) - 2.0 * (9.0f64 - 6.25).sqrt()).abs() < 1e-9, "beside the lumen");
    }

    #[test]
    fn a_tilted_ray_through_the_end_of_a_tube() {
        let rod = Shape::Cylinder { length_mm: 10.0, radius_mm: 3.0, inner_radius_mm: 0.0 };
        let q = DVec3::new(0.0, 1.0, 1.0);
        // Enters through the mantle at y = −3 (z = 7 − …), leaves through the cap at z = 10.
        assert!((length(rod, DVec3::new(0.0, -10.0, 0.0), q) - 3.0).abs() < 1e-9);
    }
}

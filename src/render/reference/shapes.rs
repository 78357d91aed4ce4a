//! Where a ray is inside a shape, exactly.

use glam::DVec3;

use super::intervals::Intervals;
use crate::scene::model::{Shape, Solid};

/// A half line: `origin + depth · direction`, depth in mm from the focal spot along the camera's axis, up to the detector.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Focal spot, lps mm.
    pub origin: DVec3,
    /// Displacement per mm of depth; its length is 1/cos of the angle with the axis.
    pub direction: DVec3,
    /// Depth of the detector.
    pub end_mm: f64,
}

/// Depths at which `ray` is inside `solid`, between source and detector.
#[must_use]
pub fn inside(solid: &Solid, ray: &Ray) -> Intervals {
    let local_from_lps = solid.lps_from_local.inverse();
    let direction = local_from_lps.transform_vector(ray.direction);
    let (centre, _) = solid.shape.bounding_sphere();
    // Depths are measured from the point nearest to the shape, so that the numbers are of the shape's size, not of the room's.
    let start = local_from_lps.transform_point(ray.origin) - centre;
    let nearest_mm = -start.dot(direction) / direction.length_squared();
    let origin = local_from_lps.transform_point(ray.origin + ray.direction * nearest_mm);
    let (outer, lumen) = match solid.shape {
        Shape::Ellipsoid { semi_axes_mm } => {
            (between(quadric(origin / semi_axes_mm, direction / semi_axes_mm, DVec3::ONE)), Intervals::default())
        }
        Shape::Cuboid { half_size_mm } => {
            let slabs = (0..3).map(|axis| slab(origin[axis], direction[axis], -half_size_mm[axis], half_size_mm[axis]));
            let both = slabs.reduce(|a, b| [a[0].max(b[0]), a[1].min(b[1])]);
            (between(both), Intervals::default())
        }
        Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } => {
            let across = DVec3::new(1.0, 1.0, 0.0);
            let [from, to] = slab(origin.z, direction.z, 0.0, length_mm);
            let clipped = |roots: Option<[f64; 2]>| between(roots.map(|[a, b]| [a.max(from), b.min(to)]));
            let lumen = if inner_radius_mm > 0.0 {
                clipped(quadric(origin / inner_radius_mm, direction / inner_radius_mm, across))
            } else {
                Intervals::default()
            };
            (clipped(quadric(origin / radius_mm, direction / radius_mm, across)), lumen)
        }
    };
    let shifted = outer.without(&lumen).iter().map(|[from, to]| [from + nearest_mm, to + nearest_mm]).collect();
    Intervals::of(shifted).intersection(&Intervals::between(0.0, ray.end_mm))
}

fn between(range: Option<[f64; 2]>) -> Intervals {
    range.map_or_else(Intervals::default, |[from, to]| Intervals::between(from, to))
}

/// Depths at which a coordinate is between `low` and `high`: everything or nothing when the ray runs parallel.
fn slab(origin: f64, direction: f64, low: f64, high: f64) -> [f64; 2] {
    if direction == 0.0 {
        let inside = origin >= low && origin <= high;
        return if inside { [f64::NEG_INFINITY, f64::INFINITY] } else { [f64::INFINITY, f64::NEG_INFINITY] };
    }
    let (a, b) = ((low - origin) / direction, (high - origin) / direction);
    [a.min(b), a.max(b)]
}

/// Depths at which Σ mask·(origin + t·direction)² ≤ 1.
fn quadric(origin: DVec3, direction: DVec3, mask: DVec3) -> Option<[f64; 2]> {
    let (o, d) = (origin * mask, direction * mask);
    let a = d.length_squared();
    if a == 0.0 {
        return (o.length_squared() <= 1.0).then_some([f64::NEG_INFINITY, f64::INFINITY]);
    }
    // a t² + 2 b t + c = 0. The discriminant b² − a c equals a − |o × d|²: the cross product has no cancellation between large terms.
    let (b, c) = (o.dot(d), o.length_squared() - 1.0);
    let discriminant = a - o.cross(d).length_squared();
    if !(discriminant > 0.0) {
        return None;
    }
    // q avoids subtracting nearly equal numbers; the other root follows from the product of roots c/a.
    let q = -(b + discriminant.sqrt().copysign(b));
    let (t0, t1) = (q / a, c / q);
    Some([t0.min(t1), t0.max(t1)])
}

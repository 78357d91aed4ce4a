//! Where an image can change from one pixel to the next: tiles that hold the outline of a shape, an edge of a mesh, metal in a volume.

use glam::{DVec2, DVec3};

use super::bounds::{Bounds, sphere_bounds};
use super::cells::BRICK;
use super::cpu::shapes::intersect;
use super::prepared::{Prepared, SeenMesh, SeenSolid, SeenVolume};
use super::tiles::{TILE_PX, Tiles};
use crate::scene::model::Shape;

/// Pixels between the points of an edge that are looked at.
const EDGE_STEP_PX: f64 = 4.0;

/// Tiles of `prepared`'s view that hold the outline of a shape or mesh, a sharp edge of a mesh, or a brick of a volume in which density
/// jumps as from tissue to metal.
#[must_use]
pub fn outlined(prepared: &Prepared) -> Tiles {
    let mut tiles = Tiles::none(prepared.view.size_px);
    for seen in &prepared.solids {
        mark_solid(prepared, seen, &mut tiles);
    }
    for seen in &prepared.meshes {
        mark_mesh(prepared, seen, &mut tiles);
    }
    for seen in &prepared.volumes {
        mark_volume(prepared, seen, &mut tiles);
    }
    tiles
}

/// What a tile's rays have in common: directions of its middle and corners, and how far any is from the middle, per mm of depth.
struct Fan {
    middle: DVec3,
    corners: [DVec3; 4],
    spread: f64,
}

impl Fan {
    // A tile's pixels are interpolated between cast ones up to the first pixel of the next tile.
    fn of(prepared: &Prepared, tiles: &Tiles, index: usize) -> Self {
        let from = tiles.bounds(index).from.map(f64::from);
        let edge = f64::from(TILE_PX);
        let ray = |u: f64, v: f64| prepared.view.intrinsics.unproject(DVec2::new(from[0] + u, from[1] + v));
        let middle = ray(0.5 * edge, 0.5 * edge);
        let (low, high) = (-0.5, edge + 0.5);
        let corners = [ray(low, low), ray(high, low), ray(low, high), ray(high, high)];
        let spread = corners.iter().map(|corner| corner.distance(middle)).fold(0.0, f64::max);
        Self { middle, corners, spread }
    }
}

fn mark_solid(prepared: &Prepared, seen: &SeenSolid, tiles: &mut Tiles) {
    if seen.bounds.is_empty() {
        return;
    }
    let radius_mm = seen.solid.shape.bounding_sphere().1;
    let far_mm = (seen.centre_in_camera.z + radius_mm).min(prepared.detector_mm);
    for index in 0..tiles.count() {
        let own = tiles.bounds(index);
        // A column or row beyond the tile counts as well.
        let reach = Bounds { to: own.to.map(|n| n + 1), ..own };
        if tiles.is_full(index) || !seen.bounds.meets(&reach) {
            continue;
        }
        let fan = Fan::of(prepared, tiles, index);
        let steady = |shape: &Shape| {
            let length = |shape: &Shape, shift_mm: f64, direction: DVec3| -> f64 {
                let source = seen.source_in_local - DVec3::Z * shift_mm;
                let spans = intersect(shape, source, seen.local_from_camera * direction);
                let within = |(from, to): &(f64, f64)| (to.min(prepared.detector_mm) - from.max(0.0)).max(0.0);
                spans.as_slice().iter().map(within).sum()
            };
            // A convex shape that the four corners meet is met by all rays between them.
            let inside = || fan.corners.iter().all(|corner| length(shape, 0.0, *corner) > 0.0);
            let outside =
                || hulls(shape, fan.spread * far_mm).iter().any(|(hull, shift_mm)| length(hull, *shift_mm, fan.middle) == 0.0);
            outside() || inside()
        };
        let (outer, lumen) = without_lumen(&seen.solid.shape);
        if !(steady(&outer) && lumen.is_none_or(|lumen| steady(&lumen))) {
            tiles.fill(index);
        }
    }
}

/// A shape without its lumen, and the lumen.
fn without_lumen(shape: &Shape) -> (Shape, Option<Shape>) {
    match *shape {
        Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } if inner_radius_mm > 0.0 => {
            let cylinder = |radius_mm| Shape::Cylinder { length_mm, radius_mm, inner_radius_mm: 0.0 };
            (cylinder(radius_mm), Some(cylinder(inner_radius_mm)))
        }
        other => (other, None),
    }
}

/// Shapes that hold every point within `margin_mm` of a convex one that has its centre where these have theirs.
// An ellipsoid's support h(n) = |(a n_x, b n_y, c n_z)| is at least its least half axis, so scaling it by 1 + m / min(a, b, c) adds at least m;
// of a needle the box around it is the better hull. Boxes grow as they are. A cylinder grows at both ends; as it begins at 0, so does the
// grown one, and the second part says how far it is shifted along z.
fn hulls(shape: &Shape, margin_mm: f64) -> Vec<(Shape, f64)> {
    match *shape {
        Shape::Ellipsoid { semi_axes_mm } => vec![
            (Shape::Ellipsoid { semi_axes_mm: semi_axes_mm * (1.0 + margin_mm / semi_axes_mm.min_element()) }, 0.0),
            (Shape::Cuboid { half_size_mm: semi_axes_mm + margin_mm }, 0.0),
        ],
        Shape::Cuboid { half_size_mm } => vec![(Shape::Cuboid { half_size_mm: half_size_mm + margin_mm }, 0.0)],
        Shape::Cylinder { length_mm, radius_mm, .. } => {
            let (length_mm, radius_mm) = (length_mm + 2.0 * margin_mm, radius_mm + margin_mm);
            vec![(Shape::Cylinder { length_mm, radius_mm, inner_radius_mm: 0.0 }, -margin_mm)]
        }
    }
}

fn mark_mesh(prepared: &Prepared, seen: &SeenMesh, tiles: &mut Tiles) {
    if seen.bounds.is_empty() {
        return;
    }
    let camera_from_lps = &prepared.view.camera_from_lps;
    let k = &prepared.view.intrinsics;
    let pixel = |point: DVec3| {
        let v = point.y / point.z;
        DVec2::new(k.fx * point.x / point.z + k.skew * v + k.cx, k.fy * v + k.cy)
    };
    for edge in seen.made.edges().iter().filter(|edge| edge.shows_from(seen.source_in_lps)) {
        let [a, b] = edge.ends.map(|end| camera_from_lps.transform_point(end));
        // Beside or behind the source an edge reaches over the border of the image.
        if !(a.z > 1e-3 && b.z > 1e-3) {
            tiles.fill_between([f64::NEG_INFINITY; 2], [f64::INFINITY; 2]);
            return;
        }
        let (p, q) = (pixel(a), pixel(b));
        let pieces = ((q - p).length() / EDGE_STEP_PX).ceil().clamp(1.0, 4096.0);
        let step = (q - p) / pieces;
        for piece in 0..pieces as u32 {
            let (from, to) = (p + step * f64::from(piece), p + step * f64::from(piece + 1));
            tiles.fill_between(from.min(to).to_array(), from.max(to).to_array());
        }
    }
}

fn mark_volume(prepared: &Prepared, seen: &SeenVolume, tiles: &mut Tiles) {
    let camera_from_cell = seen.cell_from_camera.inverse();
    // Half a brick and a voxel more: as far as the interpolant of its voxels reaches.
    let half = 0.5 * BRICK as f64 + 1.0;
    let reach = |x: f64, y: f64| (camera_from_cell.matrix3 * DVec3::new(x, y, 1.0)).length();
    let radius_mm = half * reach(1.0, 1.0).max(reach(-1.0, 1.0)).max(reach(1.0, -1.0)).max(reach(-1.0, -1.0));
    for middle in seen.cells.steep_bricks(seen.volume) {
        let bounds = sphere_bounds(&prepared.view, camera_from_cell.transform_point3(*middle), radius_mm);
        if !bounds.is_empty() {
            tiles.fill_between(bounds.from.map(f64::from), bounds.to.map(f64::from));
        }
    }
}

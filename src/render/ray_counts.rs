//! What lies along one ray, in the units of [`super::costs::Costs`].

use glam::{DVec2, DVec3};

use super::cells::{EMPTY, EMPTY_BRICK};
use super::cpu::bundles::Rays;
use super::cpu::claims::occupied_depths;
use super::cpu::integrate_density::{around_one_volume, steps_around};
use super::cpu::intervals::Intervals;
use super::cpu::shapes::intersect;
use super::cpu::walk_cells::CellRay;
use super::prepared::{Prepared, SeenVolume, Step};

/// Cells of a volume that caches hold: 32 MB of density and kind.
const CACHED_CELLS: f64 = 32e6 / 5.0;

/// What a ray meets.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RayCounts {
    /// Volumes that it may cross.
    pub volumes: f64,
    /// Slabs that hold something.
    pub slabs: f64,
    /// Those among them in bricks filled with one density.
    pub filled: f64,
    /// Cells that hold something.
    pub cells: f64,
    /// Cells between it and the rays of neighbouring pixels, on the average over its slabs.
    pub apart: f64,
    /// Share of the slabs that lie in memory, because no cache holds the volume.
    pub remote: f64,
    /// Whether its volumes cannot be crossed in bundles: another volume, or air that is kept, lies along them.
    pub walked: bool,
    /// Cells that are looked at one by one because the volume displaces something there.
    pub displacing: f64,
    /// Shapes that it is tried against, and those that it meets.
    pub solids: [f64; 2],
    /// Boxes and triangles of meshes that it is tried against.
    pub mesh_tests: f64,
}

impl RayCounts {
    /// Of the ray through pixel (u, v) of the image that `prepared` sees, of whose volumes it crosses `slabs`.
    #[must_use]
    pub fn of(prepared: &Prepared, pixel: [u32; 2], slabs: &[SlabsOfRay]) -> Self {
        let direction = prepared.view.intrinsics.unproject(DVec2::from_array(pixel.map(f64::from)));
        let steps = steps_around(prepared, pixel);
        let stack = around_one_volume(&steps);
        let mut counts = Self::default();
        let (mut apart, mut remote) = (0.0, 0.0);
        // What displaces the volume, and what it displaces.
        let (mut above, mut below) = (Intervals::default(), Intervals::default());
        let mut own = Vec::new();
        for (order, step) in steps.iter().enumerate() {
            own.clear();
            match *step {
                Step::Volume(index) | Step::VolumeAir(index) => {
                    let seen = &prepared.volumes[index];
                    let found = slabs[index];
                    counts.volumes += 1.0;
                    counts.slabs += found.slabs;
                    counts.filled += found.filled;
                    counts.cells += found.cells;
                    apart += found.apart;
                    remote += found.slabs * (1.0 - CACHED_CELLS / seen.cells.kind.len() as f64).max(0.0);
                }
                Step::Solid(index) => {
                    let seen = &prepared.solids[index];
                    let found = intersect(&seen.solid.shape, seen.source_in_local, seen.local_from_camera * direction);
                    counts.solids[0] += 1.0;
                    counts.solids[1] += if found.as_slice().is_empty() { 0.0 } else { 1.0 };
                    own.extend_from_slice(found.as_slice());
                }
                Step::Mesh(index) => {
                    let seen = &prepared.meshes[index];
                    let (source, direction) = (seen.source_in_lps, seen.lps_from_camera * direction);
                    counts.mesh_tests += seen.made.tree.tests(source, direction) as f64;
                    seen.made.tree.inside(source, direction, &mut own);
                }
            }
            let side = if stack.is_some_and(|stack| order < stack.above.len()) { &mut above } else { &mut below };
            own.iter().for_each(|(from, to)| side.insert(from.max(0.0), to.min(prepared.detector_mm)));
        }
        counts.walked = stack.is_none() && counts.volumes > 0.0;
        (counts.apart, counts.remote) = (apart / counts.slabs.max(1e-9), remote / counts.slabs.max(1e-9));
        if let Some(stack) = stack {
            counts.displacing = cells_between(prepared, &prepared.volumes[stack.volume], direction, &above, &below);
        }
        counts
    }
}

/// Slabs of a volume along a ray.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SlabsOfRay {
    /// Those that hold something.
    pub slabs: f64,
    /// Those among them in bricks filled with one density.
    pub filled: f64,
    /// Cells in slabs that hold something.
    pub cells: f64,
    /// Cells between neighbouring rays, summed over the slabs.
    pub apart: f64,
    /// Centimetres of the ray in a slab.
    pub slab_cm: f64,
}

impl SlabsOfRay {
    /// Of all volumes along the ray through pixel (u, v).
    #[must_use]
    pub fn all(prepared: &Prepared, pixel: [u32; 2]) -> Vec<Self> {
        prepared.volumes.iter().map(|seen| Self::of(prepared, seen, pixel.map(f64::from))).collect()
    }

    fn of(prepared: &Prepared, seen: &SeenVolume, [u, v]: [f64; 2]) -> Self {
        let rays = Rays::new(&prepared.view, &seen.cell_from_camera);
        let q = rays.direction(u, v);
        let axis = Rays::dominant(q);
        let cells = &seen.cells;
        // What a pixel moves the ray by in the slab, at depth 1.
        let moved = |to: [f64; 3]| {
            let by = DVec3::from_array(to) - DVec3::from_array(q);
            by - DVec3::from_array(q) * (by[axis] / q[axis])
        };
        let [right, down] = [moved(rays.direction(u + 1.0, v)), moved(rays.direction(u, v + 1.0))];
        let pixel = right.cross(down).length().sqrt();
        let mm_per_depth = prepared.view.intrinsics.unproject(DVec2::new(u, v)).length();
        let mut found = Self { slab_cm: 0.1 * mm_per_depth / q[axis].abs(), ..Self::default() };
        for slab in 0..cells.size[axis] {
            let t = (slab as f64 + 0.5 - rays.p[axis]) / q[axis];
            if !(t > 0.0 && t < prepared.detector_mm) {
                continue;
            }
            let mut cell = [0usize; 3];
            let inside = (0..3).all(|axis| {
                let x = (rays.p[axis] + q[axis] * t).floor();
                cell[axis] = x.max(0.0) as usize;
                x >= 0.0 && cell[axis] < cells.size[axis]
            });
            if inside && !matches!(cells.kind[cells.index(cell)], EMPTY_BRICK | EMPTY) {
                found.slabs += 1.0;
                found.apart += pixel * t;
                if seen.slabs.as_ref().is_some_and(|slabs| slabs.is_filled(cell)) {
                    found.filled += 1.0;
                }
            }
        }
        // A slanted ray crosses faces along the other axes as well.
        found.cells = found.slabs * q.iter().map(|q| q.abs()).sum::<f64>() / q[axis].abs();
        found
    }
}

/// Cells of the volume where something lies below it and nothing above.
fn cells_between(prepared: &Prepared, seen: &SeenVolume, direction: DVec3, above: &Intervals, below: &Intervals) -> f64 {
    let ray = CellRay { p: seen.cell_from_camera.translation, q: seen.cell_from_camera.matrix3 * direction };
    let Some((enter, leave)) = occupied_depths(seen, &ray) else { return 0.0 };
    let (enter, leave) = (enter.max(0.0), leave.min(prepared.detector_mm));
    let mut depths_mm = 0.0;
    for (from, to) in below.spans() {
        above.for_each_gap(from.max(enter), to.min(leave), |from, to| depths_mm += (to - from).max(0.0));
    }
    depths_mm * ray.q.abs().element_sum()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::geometry::Rigid;
    use crate::render::cells::Cells;
    use crate::render::meshes::MadeMesh;
    use crate::render::slabs::Slabs;
    use crate::render::timed_scenes::{EDGE, cells_per_slab, test_scene, test_volume, timed_mesh};
    use crate::scene::model::{Matter, Object, Shape, Solid};

    fn ball(at: DVec3, radius_mm: f64) -> Matter {
        let lps_from_local = Rigid { translation_mm: at, ..Rigid::IDENTITY };
        let shape = Shape::Ellipsoid { semi_axes_mm: DVec3::splat(radius_mm) };
        Matter::Solids(vec![Solid { shape, lps_from_local, material: 0, density_g_per_cm3: 1.0 }])
    }

    /// What the ray in the middle of the timed scenes' image meets, later objects displacing earlier ones.
    fn counts(matters: Vec<Matter>) -> RayCounts {
        let mut scene = test_scene("").expect("a scene");
        scene.objects =
            matters.into_iter().map(|matter| Object { name: "timed".to_owned(), body: String::new(), matter }).collect();
        let prepared = Prepared::new(
            &scene,
            scene.view.expect("has one"),
            |volume, _| {
                let cells = Arc::new(Cells::new(volume, None).expect("few materials"));
                let slabs = Slabs::new(volume, &cells).map(Arc::new);
                Ok((cells, slabs))
            },
            |mesh| Arc::new(MadeMesh::new(mesh)),
        );
        let (prepared, pixel) = (prepared.expect("prepared"), [EDGE as u32 / 2; 2]);
        RayCounts::of(&prepared, pixel, &SlabsOfRay::all(&prepared, pixel))
    }

    fn volume() -> Matter {
        Matter::Volume(Arc::new(test_volume(EDGE, 1, 1)))
    }

    #[test]
    fn a_ray_through_a_volume_counts_its_slabs_and_cells() {
        let found = counts(vec![volume()]);
        assert!(found.slabs >= EDGE as f64 && found.slabs <= EDGE as f64 + 1.0, "{found:?}");
        assert!((found.cells / found.slabs - cells_per_slab()).abs() < 0.02 && cells_per_slab() > 1.4, "{found:?}");
        assert!(found.apart > 0.4 && found.apart < 0.6 && !found.walked && found.remote == 0.0, "{found:?}");
        let twice = counts(vec![volume(), volume()]);
        assert!(twice.walked && twice.slabs == 2.0 * found.slabs && (twice.apart - found.apart).abs() < 1e-9, "{twice:?}");
    }

    #[test]
    fn shapes_passed_by_and_met_are_told_apart_and_what_lies_below_a_volume_is_walked() {
        let met = counts(vec![volume(), ball(DVec3::ZERO, 10.0)]);
        assert_eq!((met.solids, met.displacing), ([1.0, 1.0], 0.0), "the ball displaces the volume");
        // Half the diagonal of a block of rays away: the block sees it, the ray does not.
        let passed = counts(vec![ball(DVec3::ZERO, 1.0), ball(DVec3::new(2.0, 2.0, 0.0), 1.5)]);
        assert_eq!(passed.solids, [2.0, 1.0]);
        let below = counts(vec![ball(DVec3::ZERO, 10.0), volume()]);
        assert!(below.displacing > 20.0 && below.displacing < 1.05 * 20.0 * cells_per_slab(), "{below:?}");
        // Another one in the same place adds nothing, one above both takes it away.
        let again = counts(vec![ball(DVec3::ZERO, 10.0), ball(DVec3::ZERO, 9.0), volume()]);
        assert_eq!(again.displacing, below.displacing);
        let hidden = counts(vec![ball(DVec3::ZERO, 10.0), volume(), ball(DVec3::ZERO, 12.0)]);
        assert_eq!(hidden.displacing, 0.0);
    }

    #[test]
    fn boxes_and_triangles_of_a_mesh_are_counted_as_they_are_tried() {
        let mesh = timed_mesh();
        let triangles = mesh.triangles.len() as f64;
        let found = counts(vec![Matter::Mesh(Arc::new(mesh))]);
        assert!(found.mesh_tests > triangles.log2() && found.mesh_tests < 0.1 * triangles, "{found:?}");
    }
}

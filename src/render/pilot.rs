//! A few small blocks of an image, cast before planning: how long the paths are, and what lies along the rays.

use glam::{DVec2, DVec3};

use super::RenderError;
use super::cells::{EMPTY, EMPTY_BRICK};
use super::cpu::bundles::Rays;
use super::cpu::claims::occupied_depths;
use super::cpu::integrate_density::{Density, around_one_volume, integrate_density, walked_share};
use super::cpu::shapes::{cuboid, intersect};
use super::cpu::walk_cells::CellRay;
use super::cut_faces;
use super::plan::Sampling;
use super::prepared::{Prepared, SeenMesh, Step};
use super::survey::part;
use crate::geometry::View;
use crate::random::{Purpose, Stream};

/// Blocks along either side of the image.
const BLOCKS: u32 = 6;
/// Pixels along either side of a block.
const EDGE: u32 = 9;

/// Words by which a ray that crosses so many slabs is off in fixed point, where densities, positions and weights are all rounded to one part
/// in 2¹⁵ or 2¹⁶: some of it in one direction, the rest at random. Measured (`render_fixed` in the tests, `scripts/evaluate`), not derived.
#[must_use]
pub fn words_off(slabs: f64) -> f64 {
    0.7 * slabs + 2.0 * slabs.sqrt()
}

/// What the pilot rays found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pilot {
    /// Largest area density of each material, g/cm².
    pub largest_g_per_cm2: Vec<f64>,
    /// Volumes that an average ray may cross.
    pub volumes_per_ray: f64,
    /// Slabs that hold something, crossed by an average ray.
    pub slabs_per_ray: f64,
    /// Those among them in bricks filled with one density.
    pub filled_per_ray: f64,
    /// Cells between the rays of neighbouring pixels in an average slab.
    pub cells_apart: f64,
    /// Along the rays in the middle and at the corners of each block, by material of the scene: what [`words_off`] amounts to, and the path;
    /// g/cm².
    pub rounding_g_per_cm2: Vec<Vec<[f64; 2]>>,
    /// Share of the pixels that see a volume whose rays cannot be crossed in bundles.
    pub walked_share: f64,
    /// Slabs along an average ray that are looked at cell by cell because the volume displaces something there.
    pub displacing_per_ray: f64,
    /// Shapes that an average ray is tried against.
    pub solids_per_ray: f64,
    /// Doublings of triangles in the meshes that an average ray is tried against.
    pub mesh_levels_per_ray: f64,
    /// How many times a ray of the whole image is tried against a face where a scan was cut off.
    pub face_tests: f64,
}

/// Casts pilot rays of `view`, sampling volumes as told; `prepare` looks at the scene from a view.
///
/// # Errors
/// As [`Prepared::new`].
pub fn cast<'a>(
    view: View,
    sampling: Sampling,
    mut prepare: impl FnMut(View) -> Result<Prepared<'a>, RenderError>,
) -> Result<Pilot, RenderError> {
    let mut pilot = Pilot::default();
    let mut stream = Stream::new(0, 0, 0, Purpose::Evaluation);
    let [width, height] = view.size_px;
    let (across, down) = (BLOCKS.min(width.div_ceil(EDGE)), BLOCKS.min(height.div_ceil(EDGE)));
    for block in 0..across * down {
        let place = |index: u32, count: u32, length: u32, shift: u32| {
            let (low, high) = (length * index / count, length * (index + 1) / count);
            low + shift % (high.saturating_sub(low).saturating_sub(EDGE) + 1)
        };
        let u = place(block % across, across, width, stream.next_u32());
        let v = place(block / across, down, height, stream.next_u32());
        let size_px = [EDGE.min(width - u), EDGE.min(height - v)];
        let prepared = prepare(part(view, [u, v], size_px))?;
        let density = integrate_density(&prepared, sampling);
        pilot.note(&prepared, &density);
    }
    let blocks = f64::from(across * down).max(1.0);
    pilot.cells_apart /= pilot.slabs_per_ray.max(1e-9);
    pilot.volumes_per_ray /= blocks;
    pilot.slabs_per_ray /= blocks;
    pilot.filled_per_ray /= blocks;
    pilot.displacing_per_ray /= blocks;
    pilot.solids_per_ray /= blocks;
    pilot.mesh_levels_per_ray /= blocks;
    let whole = prepare(view)?;
    pilot.walked_share = walked_share(&whole);
    pilot.face_tests = cut_faces::tests(&whole) as f64;
    Ok(pilot)
}

impl Pilot {
    fn note(&mut self, prepared: &Prepared, density: &Density) {
        let materials = density.material_count;
        self.largest_g_per_cm2.resize(materials, 0.0);
        for paths in density.g_per_cm2.chunks_exact(materials.max(1)) {
            for (largest, path) in self.largest_g_per_cm2.iter_mut().zip(paths) {
                *largest = largest.max(f64::from(*path));
            }
        }
        self.volumes_per_ray += prepared.volumes.iter().filter(|seen| !seen.bounds.is_empty()).count() as f64;
        let solids = prepared.solids.iter().filter(|seen| !seen.bounds.is_empty());
        self.solids_per_ray += solids.count() as f64;
        let middle = prepared.view.size_px.map(|n| 0.5 * (f64::from(n) - 1.0));
        let meshes = prepared.meshes.iter().filter(|seen| !seen.bounds.is_empty());
        self.mesh_levels_per_ray += meshes.map(|seen| levels(seen, prepared, middle)).sum::<f64>();
        let [width, height] = prepared.view.size_px.map(|n| n as usize);
        let (right, bottom) = (width - 1, height - 1);
        for [u, v] in [[0, 0], [right, 0], [0, bottom], [right, bottom], [width / 2, height / 2]] {
            let first = (v * width + u) * materials;
            let paths = density.g_per_cm2[first..first + materials].iter().map(|path| [0.0, f64::from(*path)]);
            let mut rounding: Vec<[f64; 2]> = paths.collect();
            slabs_of_ray(prepared, [u as f64, v as f64], &mut rounding);
            self.rounding_g_per_cm2.push(rounding);
        }
        let [slabs, filled, apart] = slabs_of_ray(prepared, middle, &mut vec![[0.0; 2]; materials]);
        self.slabs_per_ray += slabs;
        self.filled_per_ray += filled;
        self.cells_apart += apart;
        self.displacing_per_ray += displacing(prepared, middle);
    }
}

/// Doublings of its triangles where a ray meets the box around a mesh; one step where it passes by.
fn levels(seen: &SeenMesh, prepared: &Prepared, [u, v]: [f64; 2]) -> f64 {
    let direction = seen.lps_from_camera * prepared.view.intrinsics.unproject(DVec2::new(u, v));
    let meets = |([low, high], ..): ([DVec3; 2], usize, usize)| cuboid(seen.source_in_lps, direction, low, high).is_some();
    if seen.made.tree.nodes().next().is_some_and(meets) { (1.0 + seen.mesh.triangles.len() as f64).log2() } else { 1.0 }
}

/// Slabs that hold something along a ray, those in bricks filled with one density, and the sum over all of the cells between neighbouring
/// rays; adds to the first of each material's two.
fn slabs_of_ray(prepared: &Prepared, [u, v]: [f64; 2], rounding: &mut [[f64; 2]]) -> [f64; 3] {
    let (mut slabs, mut filled, mut apart) = (0.0, 0.0, 0.0);
    for seen in &prepared.volumes {
        let before = slabs;
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
                slabs += 1.0;
                apart += pixel * t;
                if seen.slabs.as_ref().is_some_and(|slabs| slabs.is_filled(cell)) {
                    filled += 1.0;
                }
            }
        }
        let Some(made) = &seen.slabs else { continue };
        let slab_cm = 0.1 * prepared.view.intrinsics.unproject(DVec2::new(u, v)).length() / q[axis].abs();
        let words = words_off(slabs - before);
        for (material, word) in cells.materials.iter().zip(made.word_g_per_cm3()) {
            rounding[*material][0] += words * slab_cm * f64::from(word);
        }
    }
    [slabs, filled, apart]
}

/// Slabs of the volume along a ray where something lies that the volume displaces.
fn displacing(prepared: &Prepared, [u, v]: [f64; 2]) -> f64 {
    let Some(stack) = around_one_volume(&prepared.steps) else { return 0.0 };
    let direction = prepared.view.intrinsics.unproject(DVec2::new(u, v));
    let seen = &prepared.volumes[stack.volume];
    let ray = CellRay { p: seen.cell_from_camera.translation, q: seen.cell_from_camera.matrix3 * direction };
    let Some((enter, leave)) = occupied_depths(seen, &ray) else { return 0.0 };
    let (enter, leave) = (enter.max(0.0), leave.min(prepared.detector_mm));
    let mut spans = Vec::new();
    for step in stack.below {
        match *step {
            Step::Solid(index) => {
                let seen = &prepared.solids[index];
                let found = intersect(&seen.solid.shape, seen.source_in_local, seen.local_from_camera * direction);
                spans.extend_from_slice(found.as_slice());
            }
            Step::Mesh(index) => {
                let seen = &prepared.meshes[index];
                seen.made.tree.inside(seen.source_in_lps, seen.lps_from_camera * direction, &mut spans);
            }
            Step::Volume(_) | Step::VolumeAir(_) => {}
        }
    }
    let cells_per_mm = ray.q.abs().max_element();
    spans.iter().map(|(from, to)| (to.min(leave) - from.max(enter)).max(0.0) * cells_per_mm).sum()
}

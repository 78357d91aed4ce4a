//! A few small blocks of an image, cast before planning: how long the paths are, and what lies along the rays.

use super::RenderError;
use super::cpu::integrate_density::{Density, integrate_density, walked_share};
use super::cut_faces;
use super::plan::Sampling;
use super::prepared::Prepared;
use super::ray_counts::{RayCounts, SlabsOfRay};
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
    /// Pixels in the middle and at the corners of each block, and what their rays meet.
    pub rays: Vec<([u32; 2], RayCounts)>,
    /// Along the rays in the middle and at the corners of each block, by material of the scene: what [`words_off`] amounts to, and the path;
    /// g/cm².
    pub rounding_g_per_cm2: Vec<Vec<[f64; 2]>>,
    /// Share of the pixels that see a volume whose rays cannot be crossed in bundles.
    pub walked_share: f64,
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
    let mut seen: Vec<([u32; 2], Vec<f32>)> = Vec::new();
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
        let last = size_px.map(|n| n - 1);
        let places = [[0, 0], [last[0], 0], [0, last[1]], last, size_px.map(|n| n / 2)];
        pilot.note(&density);
        seen.extend(places.map(|[column, row]| {
            let first = (row * size_px[0] + column) as usize * density.material_count;
            ([u + column, v + row], density.g_per_cm2[first..first + density.material_count].to_vec())
        }));
    }
    let whole = prepare(view)?;
    for (pixel, paths) in seen {
        let slabs = SlabsOfRay::all(&whole, pixel);
        pilot.rounding_g_per_cm2.push(rounding(&whole, &slabs, &paths));
        pilot.rays.push((pixel, RayCounts::of(&whole, pixel, &slabs)));
    }
    pilot.walked_share = walked_share(&whole);
    pilot.face_tests = cut_faces::tests(&whole) as f64;
    Ok(pilot)
}

impl Pilot {
    /// Notes the paths in a block.
    fn note(&mut self, density: &Density) {
        let materials = density.material_count;
        self.largest_g_per_cm2.resize(materials, 0.0);
        for paths in density.g_per_cm2.chunks_exact(materials.max(1)) {
            for (largest, path) in self.largest_g_per_cm2.iter_mut().zip(paths) {
                *largest = largest.max(f64::from(*path));
            }
        }
    }
}

/// How far off fixed point is along a ray, and its path, by material of the scene; g/cm².
fn rounding(prepared: &Prepared, slabs: &[SlabsOfRay], paths: &[f32]) -> Vec<[f64; 2]> {
    let mut rounding: Vec<[f64; 2]> = paths.iter().map(|path| [0.0, f64::from(*path)]).collect();
    for (seen, found) in prepared.volumes.iter().zip(slabs) {
        let Some(made) = &seen.slabs else { continue };
        let off_cm = words_off(found.slabs) * found.slab_cm;
        for (material, word) in seen.cells.materials.iter().zip(made.word_g_per_cm3()) {
            rounding[*material][0] += off_cm * f64::from(word);
        }
    }
    rounding
}

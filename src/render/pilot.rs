//! A few small blocks of an image, cast before planning: how long the paths are, and how far interpolated pixels are off in this very view.

use super::RenderError;
use super::cells::{EMPTY, EMPTY_BRICK};
use super::cpu::attenuate_spectrum::attenuate_spectrum;
use super::cpu::bundles::Rays;
use super::cpu::integrate_density::{Density, integrate_density};
use super::plan::Sampling;
use super::prepared::{Prepared, Step};
use super::spectrum::Bins;
use crate::geometry::View;
use crate::random::{Purpose, Stream};

/// Blocks along either side of the image.
const BLOCKS: u32 = 6;
/// Pixels along either side of a block.
const EDGE: u32 = 9;
/// The interpolation's error in the image is taken to be at most this many times its largest error on the pilot rays.
const SAFETY: f64 = 3.0;

/// Words by which a ray that crosses so many slabs is off in fixed point, where densities, positions and weights are all rounded to one part
/// in 2¹⁵ or 2¹⁶: some of it in one direction, the rest at random. Measured (`render_fixed` in the tests, `scripts/evaluate`), not derived.
#[must_use]
pub fn words_off(slabs: f64) -> f64 {
    0.3 * slabs + 1.5 * slabs.sqrt()
}

/// What the pilot rays found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pilot {
    /// Largest area density of each material, g/cm².
    pub largest_g_per_cm2: Vec<f64>,
    /// Largest −ln intensity.
    pub largest_line_integral: f64,
    /// Bounds for casting every second and every fourth pixel.
    pub interpolation_error: [f64; 2],
    /// Slabs that hold something, crossed by an average ray.
    pub slabs_per_ray: f64,
    /// Those among them in bricks filled with one density.
    pub filled_per_ray: f64,
    /// Along the rays in the middle and at the corners of each block, by material of the scene: what [`words_off`] amounts to, and the path;
    /// g/cm².
    pub rounding_g_per_cm2: Vec<Vec<[f64; 2]>>,
    /// Shapes and meshes that an average ray is tried against.
    pub solids_per_ray: f64,
}

/// Casts pilot rays of `view`, sampling volumes as told; `prepare` looks at the scene from a view. Without `bins` only paths are found.
///
/// # Errors
/// As [`Prepared::new`].
pub fn cast<'a>(
    view: View,
    bins: Option<&Bins>,
    compare: bool,
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
        let Some(bins) = bins else { continue };
        let line = attenuate_spectrum(&density, bins, false).line_integral;
        let error = |other: f32, this: f32| f64::from((other - this).abs()) / f64::from(this).max(1.0);
        let raise = |worst: &mut f64, found: f64| *worst = if found <= *worst { *worst } else { found };
        line.iter().for_each(|line| raise(&mut pilot.largest_line_integral, f64::from(*line)));
        if !compare {
            continue;
        }
        for (step, worst) in [2, 4].into_iter().zip(&mut pilot.interpolation_error) {
            let other = attenuate_spectrum(&thinned(&density, size_px, step), bins, false).line_integral;
            other.iter().zip(&line).for_each(|(other, this)| raise(worst, SAFETY * error(*other, *this)));
        }
    }
    let blocks = f64::from(across * down).max(1.0);
    pilot.slabs_per_ray /= blocks;
    pilot.filled_per_ray /= blocks;
    pilot.solids_per_ray /= blocks;
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
        let solids = prepared.steps.iter().filter(|step| match step {
            Step::Solid(index) => !prepared.solids[*index].bounds.is_empty(),
            Step::Mesh(index) => !prepared.meshes[*index].bounds.is_empty(),
            _ => false,
        });
        self.solids_per_ray += solids.count() as f64;
        let [width, height] = prepared.view.size_px.map(|n| n as usize);
        let (right, bottom) = (width - 1, height - 1);
        for [u, v] in [[0, 0], [right, 0], [0, bottom], [right, bottom], [width / 2, height / 2]] {
            let first = (v * width + u) * materials;
            let paths = density.g_per_cm2[first..first + materials].iter().map(|path| [0.0, f64::from(*path)]);
            let mut rounding: Vec<[f64; 2]> = paths.collect();
            slabs_of_ray(prepared, [u as f64, v as f64], &mut rounding);
            self.rounding_g_per_cm2.push(rounding);
        }
        let middle = prepared.view.size_px.map(|n| 0.5 * (f64::from(n) - 1.0));
        let [slabs, filled] = slabs_of_ray(prepared, middle, &mut vec![[0.0; 2]; materials]);
        self.slabs_per_ray += slabs;
        self.filled_per_ray += filled;
    }
}

/// Slabs that hold something along a ray, and those in bricks filled with one density; adds to the first of each material's two.
fn slabs_of_ray(prepared: &Prepared, [u, v]: [f64; 2], rounding: &mut [[f64; 2]]) -> [f64; 2] {
    let (mut slabs, mut filled) = (0.0, 0.0);
    for seen in &prepared.volumes {
        let before = slabs;
        let rays = Rays::new(&prepared.view, &seen.cell_from_camera);
        let q = rays.direction(u, v);
        let axis = Rays::dominant(q);
        let cells = &seen.cells;
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
                if seen.slabs.as_ref().is_some_and(|slabs| slabs.is_filled(cell)) {
                    filled += 1.0;
                }
            }
        }
        let Some(made) = &seen.slabs else { continue };
        let slab_cm = 0.1 * prepared.view.intrinsics.unproject(glam::DVec2::new(u, v)).length() / q[axis].abs();
        let words = words_off(slabs - before);
        for (material, word) in cells.materials.iter().zip(made.word_g_per_cm3()) {
            rounding[*material][0] += words * slab_cm * f64::from(word);
        }
    }
    [slabs, filled]
}

/// The part of an image from pixel `from` on.
fn part(view: View, from: [u32; 2], size_px: [u32; 2]) -> View {
    let mut part = View { size_px, ..view };
    part.intrinsics.cx -= f64::from(from[0]);
    part.intrinsics.cy -= f64::from(from[1]);
    part
}

/// What casting every `step`-th pixel and interpolating gives.
fn thinned(density: &Density, size_px: [u32; 2], step: usize) -> Density {
    let [width, height] = size_px.map(|n| n as usize);
    let coarse = [width.div_ceil(step), height.div_ceil(step)];
    let materials = density.material_count;
    let pick = |index: usize| {
        let (u, v) = (index % coarse[0] * step, index / coarse[0] * step);
        &density.g_per_cm2[(v * width + u) * materials..][..materials]
    };
    let g_per_cm2 = (0..coarse[0] * coarse[1]).flat_map(pick).copied().collect();
    let valid = vec![1; coarse[0] * coarse[1]];
    let thin = Density { material_count: materials, g_per_cm2, valid, unscanned_mm: 0.0 };
    super::cpu::enlarge_density::enlarge_density(&thin, coarse, [width, height], step)
}

/// The view that casts every `step`-th pixel of `view`, far enough to interpolate the last ones.
#[must_use]
pub fn every(view: &View, step: u32) -> View {
    let mut coarse = *view;
    let scale = f64::from(step);
    let k = &mut coarse.intrinsics;
    (k.fx, k.fy, k.skew) = (k.fx / scale, k.fy / scale, k.skew / scale);
    (k.cx, k.cy) = (k.cx / scale, k.cy / scale);
    coarse.size_px = view.size_px.map(|n| n.div_ceil(step) + u32::from(n > 1));
    coarse
}

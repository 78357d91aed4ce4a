//! Twin of `shaders/integrate_density.wgsl`: area density of each material along each ray, later objects displacing earlier ones.
//!
//! Positions and sums are f64 here and f32 there; the cell rule and the order of the objects are the same.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::claims::{Claims, Stack, claim_solids, occupied_depths};
use super::crossing::Crossing;
use super::integrate_block::{BLOCK, Block};
use super::intervals::Intervals;
use super::walk_cells::{CellRay, Field, Found, Pass};
use crate::render::plan_parts::Sampling;
use crate::render::prepared::{Bounds, Prepared, SeenVolume, Step};

/// Area densities of an image.
#[derive(Clone, Debug)]
pub struct Density {
    /// Materials a pixel holds.
    pub material_count: usize,
    /// g/cm², by pixel (row-major), then by scene material.
    pub g_per_cm2: Vec<f32>,
    /// 1 where the scan was complete along the ray.
    pub valid: Vec<u8>,
}

const TILE_COLUMNS: usize = 32;
/// Images of fewer rows are cast in bands of one block, so that all cores have some.
const FEW_ROWS: usize = 512;

/// Rows of a tile, and of the bands that cores take, in an image of `height` rows.
#[must_use]
pub fn band_rows(height: usize) -> usize {
    if height < FEW_ROWS { BLOCK } else { 4 * BLOCK }
}

/// Everything a ray needs to work in.
struct Scratch {
    covered: Intervals,
    gaps: Vec<(f64, f64)>,
    own: Vec<(f64, f64)>,
    /// What the volumes of the present object cover.
    pending: Vec<(f64, f64)>,
    found: Found,
    sums: Vec<f64>,
}

/// Integrates every ray on all cores; the result does not depend on how many there are.
#[must_use]
pub fn integrate_density(prepared: &Prepared, sampling: Sampling) -> Density {
    let [width, height] = prepared.view.size_px.map(|n| n as usize);
    let materials = prepared.material_count;
    let (g_per_cm2, valid) = (vec![0.0f32; width * height * materials], vec![1u8; width * height]);
    let mut density = Density { material_count: materials, g_per_cm2, valid };
    integrate_blocks(prepared, sampling, &mut density, &|_| true);
    density
}

/// Integrates the rays of those blocks of [`BLOCK`]² pixels for which `wanted` is true, by their first column and row, into `density`, an
/// image of this view; leaves all others as they are.
pub fn integrate_blocks(
    prepared: &Prepared,
    sampling: Sampling,
    density: &mut Density,
    wanted: &(dyn Fn([u32; 2]) -> bool + Sync),
) {
    Integrator::new(prepared, sampling, wanted).run(density);
}

/// Share of the pixels that see a volume whose rays cannot be crossed in bundles: another volume, or air that is kept, lies along them.
#[must_use]
pub fn walked_share(prepared: &Prepared) -> f64 {
    let [width, height] = prepared.view.size_px;
    let (mut with_volume, mut walked) = (0u64, 0u64);
    let rows = band_rows(height as usize) as u32;
    for v in (0..height).step_by(rows as usize) {
        for u in (0..width).step_by(TILE_COLUMNS) {
            let steps = steps_around(prepared, [u, v]);
            let pixels = u64::from((u + TILE_COLUMNS as u32).min(width) - u) * u64::from((v + rows).min(height) - v);
            if steps.iter().any(|step| matches!(step, Step::Volume(_) | Step::VolumeAir(_))) {
                with_volume += pixels;
                walked += if around_one_volume(&steps).is_none() { pixels } else { 0 };
            }
        }
    }
    walked as f64 / with_volume.max(1) as f64
}

/// What may be seen by the rays that are cast together with that of pixel (u, v).
#[must_use]
pub fn steps_around(prepared: &Prepared, [u, v]: [u32; 2]) -> Vec<Step> {
    let [width, height] = prepared.view.size_px;
    let edges = [TILE_COLUMNS as u32, band_rows(height as usize) as u32];
    let from = [u / edges[0] * edges[0], v / edges[1] * edges[1]];
    let tile = Bounds { from, to: [(from[0] + edges[0]).min(width), (from[1] + edges[1]).min(height)] };
    prepared.steps.iter().filter(|step| seen_in(prepared, step, &tile)).copied().collect()
}

/// What all rays of an image share.
struct Integrator<'a> {
    prepared: &'a Prepared<'a>,
    crossings: Vec<Option<Crossing<'a>>>,
    wanted: &'a (dyn Fn([u32; 2]) -> bool + Sync),
}

/// What one thread works with.
struct Worker {
    scratch: Scratch,
    claims: [Claims; 2],
    steps: Vec<Step>,
}

impl<'a> Integrator<'a> {
    fn new(prepared: &'a Prepared<'a>, sampling: Sampling, wanted: &'a (dyn Fn([u32; 2]) -> bool + Sync)) -> Self {
        let crossing = |index| match sampling {
            Sampling::ExactSlabs => Crossing::new(prepared, index, false),
            Sampling::FixedSlabs => Crossing::new(prepared, index, true),
            Sampling::ExactCells | Sampling::PiecewiseConstant | Sampling::None => None,
        };
        let crossings = (0..prepared.volumes.len()).map(crossing).collect();
        Self { prepared, crossings, wanted }
    }

    fn worker(&self) -> Worker {
        let materials = self.prepared.material_count;
        let scratch = Scratch {
            covered: Intervals::default(),
            gaps: Vec::new(),
            own: Vec::new(),
            pending: Vec::new(),
            found: Found::default(),
            sums: vec![0.0; materials],
        };
        Worker { scratch, claims: [Claims::new(materials), Claims::new(materials)], steps: Vec::new() }
    }

    fn run(&self, density: &mut Density) {
        let width = self.prepared.view.size_px[0] as usize;
        // Scenes without materials have rows all the same.
        let row = width * self.prepared.material_count;
        let mut nothing = vec![0.0f32; if row == 0 { density.valid.len() } else { 0 }];
        let (g_per_cm2, row) = if row == 0 { (&mut nothing, width) } else { (&mut density.g_per_cm2, row) };
        let band_rows = band_rows(self.prepared.view.size_px[1] as usize);
        let bands = g_per_cm2.par_chunks_mut(band_rows * row).zip(density.valid.par_chunks_mut(band_rows * width));
        bands.enumerate().for_each(|(band, (g_per_cm2, valid))| {
            let mut worker = self.worker();
            let first_row = band * band_rows;
            let rows = valid.len() / width;
            for first_column in (0..width).step_by(TILE_COLUMNS) {
                let columns = TILE_COLUMNS.min(width - first_column);
                let tile = Bounds {
                    from: [first_column as u32, first_row as u32],
                    to: [(first_column + columns) as u32, (first_row + rows) as u32],
                };
                self.fill(&mut worker, &tile, first_row, g_per_cm2, valid);
            }
        });
    }

    /// Integrates the wanted rays of a tile in the band of rows that begins at `first_row`.
    fn fill(&self, worker: &mut Worker, tile: &Bounds, first_row: usize, density: &mut [f32], valid: &mut [u8]) {
        let prepared = self.prepared;
        let width = prepared.view.size_px[0] as usize;
        let materials = prepared.material_count;
        let Worker { scratch, claims, steps } = worker;
        steps.clear();
        steps.extend(prepared.steps.iter().filter(|step| seen_in(prepared, step, tile)));
        let in_bundles = around_one_volume(steps).and_then(|stack| Some((self.crossings[stack.volume].as_ref()?, stack)));
        for v in (tile.from[1]..tile.to[1]).step_by(BLOCK) {
            for u in (tile.from[0]..tile.to[0]).step_by(BLOCK) {
                if !(self.wanted)([u, v]) {
                    continue;
                }
                let to = [(u + BLOCK as u32).min(tile.to[0]), (v + BLOCK as u32).min(tile.to[1])];
                let pixels = |row: u32| {
                    let first = (row as usize - first_row) * width;
                    first + u as usize..first + to[0] as usize
                };
                for row in v..to[1] {
                    let pixels = pixels(row);
                    density[pixels.start * materials..pixels.end * materials].fill(0.0);
                    valid[pixels].fill(1);
                }
                if let Some((crossing, stack)) = in_bundles {
                    let mut walk = |at: DVec2, out: &mut [f32]| {
                        let cut = integrate_ray(prepared, steps, at, scratch);
                        out.iter_mut().zip(&scratch.sums).for_each(|(out, sum)| *out = *sum as f32);
                        cut
                    };
                    let block = Block { bounds: Bounds { from: [u, v], to }, first_row, stack, g_per_cm2: density, valid, width };
                    crossing.fill(block, claims, &mut walk);
                    continue;
                }
                for row in v..to[1] {
                    for (pixel, column) in pixels(row).zip(u..) {
                        let at = DVec2::new(f64::from(column), f64::from(row));
                        let cut = integrate_ray(prepared, steps, at, scratch);
                        for (out, sum) in density[pixel * materials..].iter_mut().zip(&scratch.sums) {
                            *out = *sum as f32;
                        }
                        if cut {
                            valid[pixel] = 0;
                        }
                    }
                }
            }
        }
    }
}

/// What lies along rays that meet one volume, once, whose air is dropped.
#[must_use]
pub fn around_one_volume(steps: &[Step]) -> Option<Stack<'_>> {
    let is_solid = |step: &Step| matches!(step, Step::Solid(_) | Step::Mesh(_));
    let at = steps.iter().position(|step| !is_solid(step))?;
    let Step::Volume(volume) = steps[at] else { return None };
    let (above, below) = (&steps[..at], &steps[at + 1..]);
    below.iter().all(is_solid).then_some(Stack { above, volume, below })
}

fn seen_in(prepared: &Prepared, step: &Step, tile: &Bounds) -> bool {
    match *step {
        Step::Solid(index) => prepared.solids[index].bounds.meets(tile),
        Step::Mesh(index) => prepared.meshes[index].bounds.meets(tile),
        Step::Volume(index) | Step::VolumeAir(index) => prepared.volumes[index].bounds.meets(tile),
    }
}

/// Volumes of one object, and their air, displace what follows together and one another not at all.
fn group_of(prepared: &Prepared, step: &Step) -> Option<(usize, bool)> {
    match *step {
        Step::Solid(_) | Step::Mesh(_) => None,
        Step::Volume(index) => Some((prepared.volumes[index].object, false)),
        Step::VolumeAir(index) => Some((prepared.volumes[index].object, true)),
    }
}

/// Fills `scratch.sums` with g/cm²; returns whether the ray meets matter that borders on the unknown. Where a scan was cut off at its faces is
/// for [`super::super::cut_faces`] to say.
fn integrate_ray(prepared: &Prepared, steps: &[Step], at: DVec2, scratch: &mut Scratch) -> bool {
    let direction = prepared.view.intrinsics.unproject(at);
    let mm_per_depth = direction.length();
    let Scratch { covered, gaps, own, pending, found, sums } = scratch;
    covered.clear();
    pending.clear();
    sums.fill(0.0);
    let mut cut = false;
    let mut group = None;
    for (order, step) in steps.iter().enumerate() {
        let is_last = order + 1 == steps.len();
        let next = group_of(prepared, step);
        if next != group {
            pending.drain(..).for_each(|(from, to)| covered.insert(from, to));
            group = next;
        }
        match *step {
            Step::Solid(_) | Step::Mesh(_) => {
                claim_solids(prepared, std::slice::from_ref(step), direction, covered, own, sums);
            }
            Step::Volume(index) | Step::VolumeAir(index) => {
                let pass = if matches!(step, Step::Volume(_)) { Pass::Matter } else { Pass::Air };
                let seen = &prepared.volumes[index];
                found.spans.clear();
                found.collect = !is_last;
                found.cut = false;
                cross_volume(prepared, seen, direction, pass, covered, gaps, sums, found);
                pending.extend_from_slice(&found.spans);
                cut |= pass == Pass::Matter && found.cut;
            }
        }
    }
    // ρ dt is per mm of depth; the ray is `mm_per_depth` long in it, and there are 10 mm in a cm.
    sums.iter_mut().for_each(|sum| *sum *= 0.1 * mm_per_depth);
    cut
}

/// Integrates what is not covered.
#[expect(clippy::too_many_arguments, reason = "the scratch of a ray, borrowed apart")]
fn cross_volume(
    prepared: &Prepared,
    seen: &SeenVolume,
    direction: DVec3,
    pass: Pass,
    covered: &Intervals,
    gaps: &mut Vec<(f64, f64)>,
    sums: &mut [f64],
    found: &mut Found,
) {
    let field = Field { volume: seen.volume, cells: &seen.cells, air_kind: seen.air_kind };
    let ray = CellRay { p: seen.cell_from_camera.translation, q: seen.cell_from_camera.matrix3 * direction };
    if let Some((from, to)) = occupied_depths(seen, &ray) {
        let (from, to) = (from.max(0.0), to.min(prepared.detector_mm));
        if to > from && covered.is_empty() {
            field.integrate(&ray, from, to, pass, sums, found);
        } else if to > from {
            gaps.clear();
            covered.for_each_gap(from, to, |a, b| gaps.push((a, b)));
            for &(a, b) in gaps.iter() {
                field.integrate(&ray, a, b, pass, sums, found);
            }
        }
    }
}

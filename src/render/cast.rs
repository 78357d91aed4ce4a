//! What executors give back, and the CPU executor's steps.

use rayon::prelude::*;

use super::RenderError;
use super::blur::FEWEST_PX;
use super::cpu::attenuate_spectrum::{Signal, attenuate_spectrum};
use super::cpu::enlarge_density::enlarge_density;
use super::cpu::integrate_block::BLOCK;
use super::cpu::integrate_density::{Density, integrate_blocks, integrate_density};
use super::plan::Plan;
use super::prepared::Prepared;
use super::spectrum::{Bins, whole_spectrum};
use super::tiles::Tiles;
use crate::gpu::cpu_name;
use crate::scene::model::Scene;
use crate::time::StageTimes;

/// Casts and attenuates on all cores; `coarse` is the scene as the plan's coarse image sees it, where pixels are skipped.
pub(super) fn cast_cpu(
    prepared: &Prepared,
    coarse: Option<&Prepared>,
    plan: &Plan,
    bins: Option<&Bins>,
    noisy: bool,
    stages: &mut StageTimes,
) -> Cast {
    let density = stages.measure("integrate_density", || match coarse {
        None => integrate_density(prepared, plan.sampling),
        Some(coarse) => skip_pixels(prepared, coarse, plan),
    });
    let signal = bins.map(|bins| stages.measure("attenuate_spectrum", || attenuate_spectrum(&density, bins, noisy)));
    Cast::of(density, signal.unwrap_or_default(), cpu_name())
}

/// Casts every n-th pixel where that will do, interpolates, and casts full tiles pixel by pixel.
fn skip_pixels(prepared: &Prepared, coarse: &Prepared, plan: &Plan) -> Density {
    let none = Tiles::none(plan.size_px);
    let (tiles, step) = (plan.full_tiles.as_ref().unwrap_or(&none), plan.step_px);
    let edge = BLOCK as u32;
    let cast_px = coarse.view.size_px.map(|n| n as usize);
    let materials = coarse.material_count;
    let (g_per_cm2, valid) = (vec![0.0f32; cast_px[0] * cast_px[1] * materials], vec![1u8; cast_px[0] * cast_px[1]]);
    let mut thin = Density { material_count: materials, g_per_cm2, valid };
    // A cast pixel serves those up to the next ones around it.
    let serves = |[u, v]: [u32; 2]| {
        let last = |n: u32, axis: usize| (n + edge).min(coarse.view.size_px[axis]) * step;
        let inside = |n: u32, axis: usize| n.min(plan.size_px[axis].saturating_sub(1));
        let from = [inside((u * step).saturating_sub(step - 1), 0), inside((v * step).saturating_sub(step - 1), 1)];
        tiles.skips_between(from, [last(u, 0), last(v, 1)])
    };
    integrate_blocks(coarse, plan.sampling, &mut thin, &serves);
    let mut density = enlarge_density(&thin, cast_px, plan.size_px.map(|n| n as usize), step as usize);
    integrate_blocks(prepared, plan.sampling, &mut density, &|from| tiles.is_full_at(from));
    density
}

/// Evaluates every bin in pixels whose paths are longer than those that the plan's nodes were fitted to.
pub(super) fn attenuate_beyond(scene: &Scene, plan: &Plan, cast: &mut Cast, noisy: bool) -> Result<(), RenderError> {
    let materials = cast.density.material_count;
    if cast.density.g_per_cm2.is_empty() {
        // A GPU found none, or there is no matter.
        return Ok(());
    }
    let paths = |pixel: usize| &cast.density.g_per_cm2[pixel * materials..(pixel + 1) * materials];
    // NaN counts as beyond.
    let beyond =
        |pixel: &usize| paths(*pixel).iter().zip(&plan.fitted_up_to_g_per_cm2).any(|(path, up_to)| !(f64::from(*path) <= *up_to));
    let pixels: Vec<usize> = (0..cast.density.valid.len()).into_par_iter().with_min_len(FEWEST_PX).filter(beyond).collect();
    if pixels.is_empty() || cast.signal.line_integral.is_empty() {
        return Ok(());
    }
    let g_per_cm2 = pixels.iter().flat_map(|pixel| paths(*pixel)).copied().collect();
    let density = Density { material_count: materials, g_per_cm2, valid: vec![1; pixels.len()] };
    let bins = Bins::new(scene, &whole_spectrum(scene))?;
    let signal = attenuate_spectrum(&density, &bins, noisy);
    for (index, pixel) in pixels.into_iter().enumerate() {
        cast.signal.line_integral[pixel] = signal.line_integral[index];
        if let (Some(arriving), Some(exact)) = (cast.signal.arriving.get_mut(pixel), signal.arriving.get(index)) {
            *arriving = *exact;
        }
    }
    Ok(())
}

/// What an executor found.
pub(super) struct Cast {
    /// Without area densities where a GPU was not asked for them.
    pub density: Density,
    /// Whether any ray met matter.
    pub matter: bool,
    /// Whether a GPU found paths longer than those that the energies were fitted to.
    pub beyond: bool,
    pub signal: Signal,
    pub deviates: Option<Vec<f32>>,
    pub adapter: String,
    pub gpu_ms: StageTimes,
    pub read_back_bytes: u64,
}

impl Cast {
    /// Without a GPU.
    pub fn of(density: Density, signal: Signal, adapter: String) -> Self {
        let matter = density.g_per_cm2.iter().any(|path| *path != 0.0);
        let gpu_ms = StageTimes::default();
        Self { density, matter, beyond: false, signal, deviates: None, adapter, gpu_ms, read_back_bytes: 0 }
    }
}

/// Says how many pixels the scan was incomplete for, and how long the longest path outside it is, where that is known.
pub(super) fn note_invalid(valid: &[u8], unscanned_mm: f32, notes: &mut Vec<String>) {
    let invalid = valid.iter().filter(|valid| **valid == 0).count();
    if invalid > 0 {
        let share = 100.0 * invalid as f64 / valid.len() as f64;
        let bound = if unscanned_mm > 0.0 {
            format!("; at most {unscanned_mm:.0} mm of their paths are unscanned")
        } else {
            String::new()
        };
        notes.push(format!("{invalid} pixels ({share:.1} %) look through matter that the scan cut off{bound}"));
    }
}

/// One page a material.
pub(super) fn area_pages(density: &Density) -> Vec<Vec<f32>> {
    let materials = density.material_count;
    (0..materials).map(|material| density.g_per_cm2.iter().skip(material).step_by(materials).copied().collect()).collect()
}

//! What executors give back, and the CPU executor's steps.

use super::RenderError;
use super::cpu::attenuate_spectrum::{Signal, attenuate_spectrum};
use super::cpu::enlarge_density::enlarge_density;
use super::cpu::integrate_density::{Density, integrate_density};
use super::plan::Plan;
use super::prepared::Prepared;
use super::spectrum::{Bins, whole_spectrum};
use crate::gpu::cpu_name;
use crate::scene::model::Scene;
use crate::time::StageTimes;

/// Casts and attenuates on all cores.
pub(super) fn cast_cpu(prepared: &Prepared, plan: &Plan, bins: Option<&Bins>, noisy: bool, stages: &mut StageTimes) -> Cast {
    let density = stages.measure("integrate_density", || {
        let density = integrate_density(prepared, plan.sampling);
        match plan.step_px {
            0 | 1 => density,
            step => {
                let cast_px = prepared.view.size_px.map(|n| n as usize);
                enlarge_density(&density, cast_px, plan.size_px.map(|n| n as usize), step as usize)
            }
        }
    });
    let signal = bins.map(|bins| stages.measure("attenuate_spectrum", || attenuate_spectrum(&density, bins, noisy)));
    Cast::of(density, signal.unwrap_or_default(), cpu_name())
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
    let pixels: Vec<usize> = (0..cast.density.valid.len()).filter(beyond).collect();
    if pixels.is_empty() || cast.signal.line_integral.is_empty() {
        return Ok(());
    }
    let g_per_cm2 = pixels.iter().flat_map(|pixel| paths(*pixel)).copied().collect();
    let density = Density { material_count: materials, g_per_cm2, valid: vec![1; pixels.len()], unscanned_mm: 0.0 };
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

/// Says how many pixels the scan was incomplete for.
pub(super) fn note_invalid(density: &Density, notes: &mut Vec<String>) {
    let invalid = density.valid.iter().filter(|valid| **valid == 0).count();
    if invalid > 0 {
        let share = 100.0 * invalid as f64 / density.valid.len() as f64;
        let bound = if density.unscanned_mm > 0.0 {
            format!("; at most {:.0} mm of their paths are unscanned", density.unscanned_mm)
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

//! Renders scenes; keeps the device and what was prepared of the volumes between images.

use std::sync::Arc;

use super::cells::Cells;
use super::cpu::add_noise::add_noise;
use super::cpu::attenuate_spectrum::{Signal, attenuate_spectrum};
use super::cpu::integrate_density::{Density, integrate_density};
use super::detector;
use super::explain::explain_empty;
use super::plan::{Executor, Plan, noise_applies};
use super::prepared::Prepared;
use super::spectrum::Bins;
use super::wgsl::{self, Executed, NoiseKey, WgslExecutor};
use super::{Quantity, RenderError, chain, flood, reference};
use crate::geometry::View;
use crate::gpu::{Device, DeviceChoice, cpu_name};
use crate::image::Image;
use crate::reporter::Reporter;
use crate::scene::model::{Scene, Volume};
use crate::time::StageTimes;

/// What to make of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Options {
    /// What the pages hold.
    pub quantity: Quantity,
    /// The slow f64 yardstick instead of the fast path.
    pub reference: bool,
    /// Keys the noise, with the scene's seed and the pixel.
    pub frame_index: u32,
    /// A logged plan to execute as it is, instead of planning.
    pub plan: Option<Plan>,
}

/// An image with its provenance.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// One page, or one per material for `area_density`.
    pub pages: Vec<Image<f32>>,
    /// What they hold.
    pub quantity: Quantity,
    /// 1 where the ray stayed inside the scan and the pixel lies wholly inside the field.
    pub valid: Image<u8>,
    /// The executed [`Plan`].
    pub plan: serde_json::Value,
    /// Device, driver, version.
    pub adapter: String,
    /// Wall milliseconds per stage.
    pub stages: StageTimes,
    /// Bound of |Δ line_integral| / max(1, line_integral), noise aside.
    pub stated_error: f64,
    /// What a person should know: why the image is empty, floors, invalid pixels.
    pub notes: Vec<String>,
}

/// Renders; owns the device and what it prepared of volumes.
#[derive(Debug)]
pub struct Renderer {
    device: Device,
    reporter: Reporter,
    cells: Vec<(Arc<Volume>, Arc<Cells>)>,
    wgsl: Option<WgslExecutor>,
}

impl Renderer {
    /// Opens the device.
    ///
    /// # Errors
    /// When a device was named that is not there.
    pub fn new(choice: DeviceChoice, reporter: &Reporter) -> Result<Self, RenderError> {
        Ok(Self { device: Device::open(choice, reporter)?, reporter: reporter.clone(), cells: Vec::new(), wgsl: None })
    }

    /// Device, driver, version.
    #[must_use]
    pub fn adapter(&self) -> String {
        self.device.name()
    }

    /// The plan that [`Renderer::render`] would execute.
    ///
    /// # Errors
    /// When the scene has no view.
    pub fn plan(&self, scene: &Scene, options: &Options) -> Result<Plan, RenderError> {
        let view = scene.view.ok_or(RenderError::NoView)?;
        if let Some(plan) = &options.plan {
            return Ok(plan.clone());
        }
        let unsupported = wgsl::unsupported(scene);
        let (executor, cpu_because) = match (&self.device, options.reference) {
            (_, true) => (Executor::Reference, None),
            (Device::Cpu, false) => (Executor::Cpu, None),
            (Device::Gpu(_), false) if unsupported.is_some() => (Executor::Cpu, unsupported.as_deref()),
            (Device::Gpu(_), false) => (Executor::Wgsl, None),
        };
        Ok(Plan::new(scene, view.size_px, options.quantity, executor, options.frame_index, cpu_because))
    }

    /// Renders `scene` from its view.
    ///
    /// # Errors
    /// When the scene has no view, a number in it makes no sense, attenuation is not tabulated, or the device fails.
    pub fn render(&mut self, scene: &Scene, options: &Options) -> Result<Rendered, RenderError> {
        let view = scene.view.ok_or(RenderError::NoView)?;
        check(scene)?;
        let plan = self.plan(scene, options)?;
        check_plan(&plan, scene)?;
        let mut stages = StageTimes::default();
        let mut notes = Vec::new();
        let prepared = {
            let cache = &mut self.cells;
            stages.measure("prepare", || {
                cache.retain(|(volume, _)| scene_holds(scene, volume));
                Prepared::new(scene, view, |volume, name| cached_cells(cache, volume, name))
            })?
        };
        let size = view.size_px.map(|n| n as usize);
        let image = |pixels: Vec<f32>| Image { width: size[0], height: size[1], pixels };
        let noisy = noise_applies(scene, plan.quantity);
        let bins = if plan.quantity == Quantity::AreaDensity { None } else { Some(Bins::new(scene, &plan.energy_nodes)?) };
        let mut cast = match plan.executor {
            Executor::Reference => self.cast_reference(scene, &view, bins.as_ref(), noisy, &mut stages)?,
            Executor::Wgsl => self.cast_wgsl(scene, &prepared, bins.as_ref(), noisy.then_some(&plan), &mut stages, &mut notes)?,
            Executor::Cpu => self.cast_cpu(&prepared, bins.as_ref(), noisy, &mut stages),
        };
        note_invalid(&cast.density, &mut notes);
        if cast.density.g_per_cm2.iter().all(|path| *path == 0.0) {
            let why = explain_empty(scene, &prepared);
            self.reporter.warn("empty image", &why);
            notes.push(why);
        }
        let mut valid = Image { width: size[0], height: size[1], pixels: cast.density.valid.clone() };
        let pages = match &bins {
            None => area_pages(&cast.density).into_iter().map(image).collect(),
            Some(bins) => {
                let photons = noisy || plan.quantity == Quantity::Counts;
                let made_by = (plan.energy_nodes.as_slice(), plan.executor);
                let flood = stages.measure("shape_beam", || {
                    chain::shape(scene, &view, made_by, &cast.density, bins, &mut cast.signal, photons)
                })?;
                chain::close(&flood, &mut valid.pixels, &mut notes);
                let noise = if noisy {
                    stages.measure("add_noise", || {
                        let deviates = cast.deviates.filter(|_| flood::is_plain(scene)).unwrap_or_else(|| {
                            add_noise(&detector::expected_photons(&cast.signal, &flood), plan.seed, plan.frame_index)
                        });
                        detector::intensity_noise(scene, &view, &flood, &cast.signal, &deviates, plan.frame_index)
                    })
                } else {
                    Vec::new()
                };
                if noisy && plan.quantity == Quantity::LineIntegral {
                    let floor = 0.5 / scene.beam.photons_per_pixel;
                    let highest = -floor.ln();
                    notes.push(format!(
                        "noisy line integrals are -ln max(I, 1/(2 N0)) with 1/(2 N0) = {floor:.3e}: none exceeds {highest:.2}"
                    ));
                }
                let page = stages.measure("detect", || {
                    let line = detector::seen_line_integral(scene, &view, &cast.signal.line_integral, &flood);
                    detector::page(scene, plan.quantity, &line, &noise, &flood)
                });
                chain::note_clipped(scene, plan.quantity, &page, &flood, &mut notes);
                vec![image(page)]
            }
        };
        Ok(Rendered {
            pages,
            quantity: plan.quantity,
            valid,
            stated_error: plan.stated_error,
            plan: serde_json::to_value(&plan).expect("a plan is plain data"),
            adapter: cast.adapter,
            stages,
            notes,
        })
    }

    fn cast_cpu(&self, prepared: &Prepared, bins: Option<&Bins>, noisy: bool, stages: &mut StageTimes) -> Cast {
        let density = stages.measure("integrate_density", || integrate_density(prepared));
        let signal = bins.map(|bins| stages.measure("attenuate_spectrum", || attenuate_spectrum(&density, bins, noisy)));
        Cast { density, signal: signal.unwrap_or_default(), deviates: None, adapter: cpu_name() }
    }

    fn cast_wgsl(
        &mut self,
        scene: &Scene,
        prepared: &Prepared,
        bins: Option<&Bins>,
        noise: Option<&Plan>,
        stages: &mut StageTimes,
        notes: &mut Vec<String>,
    ) -> Result<Cast, RenderError> {
        let unsupported = wgsl::unsupported(scene);
        let reason = match (&self.device, &unsupported) {
            (_, Some(reason)) => reason.clone(),
            (Device::Cpu, None) => "the plan was made for a GPU, which is not open here".to_owned(),
            (Device::Gpu(gpu), None) => {
                let executor = match &mut self.wgsl {
                    Some(executor) => executor,
                    None => self.wgsl.insert(stages.measure("compile_shaders", || WgslExecutor::new(gpu))?),
                };
                let photons_per_pixel = scene.beam.photons_per_pixel;
                let key = noise.map(|plan| NoiseKey { seed: plan.seed, frame: plan.frame_index, photons_per_pixel });
                let executed = stages.measure("shaders", || executor.execute(gpu, prepared, bins, key))?;
                if executed.overflows == 0 {
                    let Executed { density, signal, deviates, .. } = executed;
                    let deviates = noise.is_some().then_some(deviates);
                    return Ok(Cast { density, signal, deviates, adapter: gpu.adapter.clone() });
                }
                format!("{} rays cross more intervals than the shader holds", executed.overflows)
            }
        };
        let message = format!("{reason}: rendered by the CPU executor instead, whose error is smaller");
        self.reporter.warn("executor", &message);
        notes.push(message);
        Ok(self.cast_cpu(prepared, bins, noise.is_some(), stages))
    }

    fn cast_reference(
        &self,
        scene: &Scene,
        view: &View,
        bins: Option<&Bins>,
        noisy: bool,
        stages: &mut StageTimes,
    ) -> Result<Cast, RenderError> {
        let areas = stages.measure("reference", || reference::render(scene, view, Quantity::AreaDensity))?;
        let valid = stages.measure("reference", || reference::valid(scene, view))?;
        let pixels = valid.pixels.len();
        let g_per_cm2 = (0..pixels).flat_map(|pixel| areas.iter().map(move |page| page.pixels[pixel] as f32)).collect();
        let density = Density { material_count: areas.len(), g_per_cm2, valid: valid.pixels, unscanned_mm: 0.0 };
        let mut signal = bins.map(|bins| attenuate_spectrum(&density, bins, noisy)).unwrap_or_default();
        if bins.is_some() {
            let line = stages.measure("reference", || reference::render(scene, view, Quantity::LineIntegral))?;
            signal.line_integral = line.iter().flat_map(|page| &page.pixels).map(|value| *value as f32).collect();
        }
        Ok(Cast { density, signal, deviates: None, adapter: format!("f64 reference on {}", cpu_name()) })
    }
}

/// What an executor found.
struct Cast {
    density: Density,
    signal: Signal,
    deviates: Option<Vec<f32>>,
    adapter: String,
}

fn note_invalid(density: &Density, notes: &mut Vec<String>) {
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

fn scene_holds(scene: &Scene, volume: &Arc<Volume>) -> bool {
    use crate::scene::model::Matter;
    scene.objects.iter().any(|object| matches!(&object.matter, Matter::Volume(held) if Arc::ptr_eq(held, volume)))
}

fn cached_cells(cache: &mut Vec<(Arc<Volume>, Arc<Cells>)>, volume: &Arc<Volume>, name: &str) -> Result<Arc<Cells>, RenderError> {
    if let Some((_, cells)) = cache.iter().find(|(held, _)| Arc::ptr_eq(held, volume)) {
        return Ok(cells.clone());
    }
    let wrong = |detail: String| RenderError::Volume { name: name.to_owned(), detail };
    let voxels = volume.size.iter().product::<usize>();
    if voxels == 0 || volume.density_g_per_cm3.len() != voxels || volume.class.len() != voxels {
        let found = volume.density_g_per_cm3.len();
        return Err(wrong(format!(
            "a grid of {:?} voxels holds {found} densities and {} classes",
            volume.size,
            volume.class.len()
        )));
    }
    if !(volume.lps_from_voxel.matrix3.determinant().abs() > 0.0) {
        return Err(wrong("its affine is singular".to_owned()));
    }
    let cells = Cells::new(volume).ok_or_else(|| wrong("more than 250 materials in one volume".to_owned()))?;
    let cells = Arc::new(cells);
    cache.push((volume.clone(), cells.clone()));
    Ok(cells)
}

fn check(scene: &Scene) -> Result<(), RenderError> {
    chain::check(scene)?;
    let n0 = scene.beam.photons_per_pixel;
    if !(n0 > 0.0 && n0.is_finite()) {
        return Err(RenderError::Number { what: "beam.photons_per_pixel", value: n0, expected: "a positive number" });
    }
    let kernel = &scene.detector.crosstalk;
    if kernel.iter().any(|row| row.len() != kernel.len()) || (!kernel.is_empty() && kernel.len().is_multiple_of(2)) {
        return Err(RenderError::Number {
            what: "detector.crosstalk: rows",
            value: kernel.len() as f64,
            expected: "an odd square",
        });
    }
    if let Some(readout) = scene.detector.readout_noise
        && !(readout.row_correlation >= 0.0 && readout.row_correlation < 1.0)
    {
        let value = readout.row_correlation;
        return Err(RenderError::Number { what: "detector.readout_noise.row_correlation", value, expected: "from 0 to below 1" });
    }
    Ok(())
}

fn check_plan(plan: &Plan, scene: &Scene) -> Result<(), RenderError> {
    let names: Vec<String> = scene.materials.iter().map(|material| material.name.clone()).collect();
    if plan.materials != names {
        return Err(RenderError::PlanMismatch { what: "materials", planned: plan.materials.join(", "), found: names.join(", ") });
    }
    let size = scene.view.map_or([0, 0], |view| view.size_px);
    if plan.size_px != size {
        return Err(RenderError::PlanMismatch {
            what: "size_px",
            planned: format!("{:?}", plan.size_px),
            found: format!("{size:?}"),
        });
    }
    Ok(())
}

fn area_pages(density: &Density) -> Vec<Vec<f32>> {
    let materials = density.material_count;
    (0..materials).map(|material| density.g_per_cm2.iter().skip(material).step_by(materials).copied().collect()).collect()
}

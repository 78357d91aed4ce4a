//! Renders scenes; keeps the device and what was prepared of the volumes between images.

use super::achieved::Achieved;
use super::cast::{Cast, area_pages, attenuate_beyond, cast_cpu, note_invalid};
use super::checks::{check, check_plan};
use super::cpu::add_noise::add_noise;
use super::cpu::attenuate_spectrum::attenuate_spectrum;
use super::cpu::integrate_density::Density;
use super::detector;
use super::explain::explain_empty;
use super::non_finite::{self, NonFinite};
use super::plan::{Executor, Plan, Sampling, noise_applies};
use super::planner::{DEFAULT_MAX_ERROR, Goal, Planner, Task};
use super::prepared::Prepared;
use super::spectrum::Bins;
use super::volumes::VolumeCache;
use super::wgsl::{self, Executed, NoiseKey, WgslExecutor};
use super::{Quantity, RenderError, chain, flood, pilot, reference};
use crate::geometry::View;
use crate::gpu::{Device, DeviceChoice, cpu_name};
use crate::image::Image;
use crate::reporter::Reporter;
use crate::scene::model::{Noise, Scene, Voxels};
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
    /// The wish; an error of 1e-5 where none is given.
    pub goal: Option<Goal>,
    /// Count NaN and infinity after every pass.
    pub count_non_finite: bool,
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
    /// Milliseconds by pass, by the GPU's own clock; empty without one.
    pub gpu_ms: StageTimes,
    /// Bound of |Δ line_integral| / max(1, line_integral), noise aside.
    pub stated_error: f64,
    /// What a person should know: why the image is empty, floors, invalid pixels.
    pub notes: Vec<String>,
    /// NaN and infinity per pass, where [`Options::count_non_finite`] asks.
    pub non_finite: Option<NonFinite>,
    /// What another plan achieved, measured against this image.
    pub achieved: Option<(Plan, Achieved)>,
}

/// Renders; owns the device and what it prepared of volumes.
#[derive(Debug)]
pub struct Renderer {
    device: Device,
    reporter: Reporter,
    choice: DeviceChoice,
    volumes: VolumeCache,
    planner: Planner,
    wgsl: Option<WgslExecutor>,
}

impl Renderer {
    /// Opens the device.
    ///
    /// # Errors
    /// When a device was named that is not there.
    pub fn new(choice: DeviceChoice, reporter: &Reporter) -> Result<Self, RenderError> {
        let device = Device::open(choice, reporter)?;
        let planner = Planner::default();
        Ok(Self { device, reporter: reporter.clone(), choice, volumes: VolumeCache::default(), planner, wgsl: None })
    }

    /// Device, driver, version.
    #[must_use]
    pub fn adapter(&self) -> String {
        self.device.name()
    }

    /// The plan that [`Renderer::render`] would execute. Pilot rays are cast for it.
    ///
    /// # Errors
    /// When the scene has no view, or a number in it makes no sense.
    pub fn plan(&mut self, scene: &Scene, options: &Options) -> Result<Plan, RenderError> {
        let view = scene.view.ok_or(RenderError::NoView)?;
        if let Some(plan) = &options.plan {
            return Ok(plan.clone());
        }
        check(scene)?;
        if scene.model.voxels == Voxels::PiecewiseConstant && !options.reference {
            return Err(RenderError::ReferenceOnly { what: "model.voxels \"piecewise_constant\"" });
        }
        let unsupported = wgsl::unsupported(scene);
        // A GPU's bound is that of f32 throughout: what must be closer is rendered by the CPU, unless the GPU was named.
        let finer = match options.goal {
            Some(Goal::MaxError(error))
                if self.choice == DeviceChoice::Auto && !(error >= 1.1 * Executor::Wgsl.stated_error()) =>
            {
                Some("the error asked for is below the GPU's bound")
            }
            Some(Goal::Explicit { .. }) => Some("a way of sampling was named that only the CPU executor has"),
            _ => None,
        };
        let (executor, cpu_because) = match (&self.device, options.reference) {
            (_, true) => (Executor::Reference, None),
            (Device::Cpu, false) => (Executor::Cpu, None),
            (Device::Gpu(_), false) if unsupported.is_some() => (Executor::Cpu, unsupported.as_deref()),
            (Device::Gpu(_), false) if finer.is_some() => (Executor::Cpu, finer),
            (Device::Gpu(_), false) => (Executor::Wgsl, None),
        };
        let plan = Plan::new(scene, view.size_px, options.quantity, executor, options.frame_index, cpu_because);
        if executor == Executor::Reference {
            return Ok(plan);
        }
        self.volumes.keep(scene);
        let slabs = executor == Executor::Cpu;
        let whole = self.volumes.prepare(scene, view, slabs)?;
        whole.make_slabs();
        let all_slabs = whole.volumes.iter().all(|seen| seen.slabs.is_some() && seen.air_kind.is_none());
        let task = Task {
            scene,
            view,
            quantity: options.quantity,
            executor,
            slabs: slabs && all_slabs,
            goal: options.goal.unwrap_or(Goal::MaxError(DEFAULT_MAX_ERROR)),
        };
        let goal = match (executor, options.goal) {
            // Without a wish a GPU adds its own bound to that of the energies.
            (Executor::Wgsl, None) => Goal::MaxError(DEFAULT_MAX_ERROR + Executor::Wgsl.stated_error()),
            _ => task.goal,
        };
        let cache = &mut self.volumes;
        self.planner.refine(plan, &Task { goal, ..task }, |view| cache.prepare(scene, view, slabs))
    }

    /// Renders `scene` from its view.
    ///
    /// # Errors
    /// When the scene has no view, a number in it makes no sense, attenuation is not tabulated, or the device fails.
    pub fn render(&mut self, scene: &Scene, options: &Options) -> Result<Rendered, RenderError> {
        let view = scene.view.ok_or(RenderError::NoView)?;
        check(scene)?;
        let mut stages = StageTimes::default();
        let plan = stages.measure("plan", || self.plan(scene, options))?;
        check_plan(&plan, scene)?;
        let mut notes = Vec::new();
        let prepared = stages.measure("prepare", || {
            let slabs = plan.executor == Executor::Cpu && plan.sampling == Sampling::ExactSlabs;
            self.volumes.keep(scene);
            let mut prepared = self.volumes.prepare(scene, view, slabs)?;
            if plan.step_px > 1 {
                // The detector stays where it is, however few of its pixels are cast.
                let detector_mm = prepared.detector_mm;
                prepared = self.volumes.prepare(scene, pilot::every(&view, plan.step_px), slabs)?;
                prepared.detector_mm = detector_mm;
            }
            prepared.make_slabs();
            Ok::<_, RenderError>(prepared)
        })?;
        let size = view.size_px.map(|n| n as usize);
        let image = |pixels: Vec<f32>| Image { width: size[0], height: size[1], pixels };
        let noisy = noise_applies(scene, plan.quantity);
        let bins = if plan.quantity == Quantity::AreaDensity { None } else { Some(Bins::new(scene, &plan.energy_nodes)?) };
        let mut cast = match plan.executor {
            Executor::Reference => self.cast_reference(scene, &view, bins.as_ref(), noisy, &mut stages)?,
            Executor::Wgsl => self.cast_wgsl(scene, &prepared, bins.as_ref(), &plan, &mut stages, &mut notes)?,
            Executor::Cpu => cast_cpu(&prepared, &plan, bins.as_ref(), noisy, &mut stages),
        };
        if !plan.fitted_up_to_g_per_cm2.is_empty() {
            stages.measure("attenuate_spectrum", || attenuate_beyond(scene, &plan, &mut cast, noisy))?;
        }
        let deviates = cast.deviates.as_deref().unwrap_or_default();
        let mut non_finite = options.count_non_finite.then(|| NonFinite::of(&cast.density, &cast.signal, deviates));
        note_invalid(&cast.density, &mut notes);
        if cast.density.g_per_cm2.iter().all(|path| *path == 0.0) {
            let why = explain_empty(scene, &prepared);
            self.reporter.warn("empty image", &why);
            notes.push(why);
        }
        let mut valid = Image { width: size[0], height: size[1], pixels: cast.density.valid.clone() };
        let pages: Vec<Image<f32>> = match &bins {
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
                if let Some(counts) = &mut non_finite {
                    counts.add_noise += non_finite::count(&noise);
                }
                let page = stages.measure("detect", || {
                    let line = detector::seen_line_integral(scene, &view, &cast.signal.line_integral, &flood);
                    detector::page(scene, plan.quantity, &line, &noise, &flood)
                });
                chain::note_clipped(scene, plan.quantity, &page, &flood, &mut notes);
                vec![image(page)]
            }
        };
        if let Some(counts) = &mut non_finite {
            counts.detect = pages.iter().map(|page| non_finite::count(&page.pixels)).sum();
        }
        Ok(Rendered {
            pages,
            quantity: plan.quantity,
            valid,
            stated_error: plan.stated_error,
            plan: serde_json::to_value(&plan).expect("a plan is plain data"),
            adapter: cast.adapter,
            stages,
            gpu_ms: cast.gpu_ms,
            notes,
            non_finite,
            achieved: None,
        })
    }

    /// Executes the plan for `goal` as well and compares it with `rendered`, the yardstick's image of the same scene.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn judge(&mut self, scene: &Scene, goal: Goal, rendered: &mut Rendered) -> Result<(), RenderError> {
        let mut quiet = scene.clone();
        quiet.model.noise = Noise::Off;
        let quantity = Quantity::LineIntegral;
        let line = |page: &Image<f32>| page.pixels.clone();
        let expected = match (rendered.quantity, scene.model.noise) {
            (Quantity::LineIntegral, Noise::Off) => line(&rendered.pages[0]),
            _ => line(&self.render(&quiet, &Options { quantity, reference: true, ..Options::default() })?.pages[0]),
        };
        let options = Options { quantity, goal: Some(goal), ..Options::default() };
        let plan = self.plan(&quiet, &options)?;
        let fast = self.render(&quiet, &Options { plan: Some(plan.clone()), ..options })?;
        let ms = fast.stages.iter().filter(|(stage, _)| !matches!(*stage, "plan" | "prepare")).map(|(_, ms)| ms).sum();
        rendered.achieved = Some((plan, Achieved::of(&fast.pages[0].pixels, &expected, ms)));
        Ok(())
    }

    fn cast_wgsl(
        &mut self,
        scene: &Scene,
        prepared: &Prepared,
        bins: Option<&Bins>,
        plan: &Plan,
        stages: &mut StageTimes,
        notes: &mut Vec<String>,
    ) -> Result<Cast, RenderError> {
        let noise = noise_applies(scene, plan.quantity).then_some(plan);
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
                    let Executed { density, signal, deviates, pass_ms, .. } = executed;
                    let deviates = noise.is_some().then_some(deviates);
                    let mut gpu_ms = StageTimes::default();
                    pass_ms.into_iter().for_each(|(pass, ms)| gpu_ms.add(pass, ms));
                    return Ok(Cast { density, signal, deviates, adapter: gpu.adapter.clone(), gpu_ms });
                }
                format!("{} rays cross more intervals than the shader holds", executed.overflows)
            }
        };
        let message = format!("{reason}: rendered by the CPU executor instead, whose error is smaller");
        self.reporter.warn("executor", &message);
        notes.push(message);
        let whole = Plan { sampling: Sampling::ExactCells, step_px: 1, ..plan.clone() };
        Ok(cast_cpu(prepared, &whole, bins, noise.is_some(), stages))
    }

    fn cast_reference(
        &self,
        scene: &Scene,
        view: &View,
        bins: Option<&Bins>,
        noisy: bool,
        stages: &mut StageTimes,
    ) -> Result<Cast, RenderError> {
        let traced = stages.measure("reference", || reference::trace(scene, view, bins.is_some()))?;
        let single = |values: &[f64]| values.iter().map(|value| *value as f32).collect::<Vec<f32>>();
        let density = Density {
            material_count: scene.materials.len(),
            g_per_cm2: single(&traced.g_per_cm2),
            valid: traced.valid,
            unscanned_mm: 0.0,
        };
        let mut signal = bins.map(|bins| attenuate_spectrum(&density, bins, noisy)).unwrap_or_default();
        signal.line_integral = single(&traced.line_integral);
        Ok(Cast {
            density,
            signal,
            deviates: None,
            adapter: format!("f64 reference on {}", cpu_name()),
            gpu_ms: StageTimes::default(),
        })
    }
}

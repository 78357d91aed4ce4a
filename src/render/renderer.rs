//! Renders scenes; keeps the device and what was prepared of the volumes between images.

use std::sync::Arc;

use super::achieved::Achieved;
use super::before_panel::{before_panel, is_before_panel};
use super::checks::check;
use super::cpu::fixed_lanes::is_fast;
use super::guessed::{LEAST_GUESSED_MM, guessed, guessed_share};
use super::made::Made;
use super::non_finite::NonFinite;
use super::plan::{Executor, Plan, Sampling};
use super::planner::{DEFAULT_MAX_ERROR, Goal, LEAST_FIXED_ERROR, Planner, Task};
use super::scattered::{Added, Scatter};
use super::volumes::VolumeCache;
use super::wgsl::{self, WgslExecutor};
use super::{Quantity, RenderError};
use crate::geometry::View;
use crate::gpu::{Device, DeviceChoice, Gpu};
use crate::image::Image;
use crate::reporter::Reporter;
use crate::scene::model::{Object, Scene, Voxels};
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
    /// Say which pixels show a guess ([`Rendered::guessed`]).
    pub guessed: bool,
    /// One of many pictures beside the one that is wanted: that it is empty warns nobody.
    pub beside: bool,
    /// Scatter to add, where the scene asks for it and somebody has followed photons.
    pub scatter: Option<Arc<Scatter>>,
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
    /// 1 where the ray runs through what fills the place that a body left ([`super::guessed()`]); `None` where none has moved, or unless
    /// [`Options::guessed`] asks.
    pub guessed: Option<Image<u8>>,
    /// The executed [`Plan`].
    pub plan: serde_json::Value,
    /// Device, driver, version.
    pub adapter: String,
    /// Wall milliseconds per stage.
    pub stages: StageTimes,
    /// Milliseconds by pass, by the GPU's own clock; empty without one.
    pub gpu_ms: StageTimes,
    /// Bytes that came back from the GPU.
    pub read_back_bytes: u64,
    /// Bound of |Δ line_integral| / max(1, line_integral), noise aside.
    pub stated_error: f64,
    /// What a person should know: why the image is empty, floors, invalid pixels.
    pub notes: Vec<String>,
    /// The scatter in it.
    pub scatter: Option<Added>,
    /// NaN and infinity per pass, where [`Options::count_non_finite`] asks.
    pub non_finite: Option<NonFinite>,
    /// What another plan achieved, measured against this image.
    pub achieved: Option<(Plan, Achieved)>,
    /// What had to be made for it; nothing where the renderer was warm.
    pub made: Made,
}

/// Renders; owns the device and what it prepared of volumes.
#[derive(Debug)]
pub struct Renderer {
    pub(super) device: Device,
    pub(super) reporter: Reporter,
    choice: DeviceChoice,
    pub(super) volumes: VolumeCache,
    planner: Planner,
    pub(super) wgsl: Option<WgslExecutor>,
    pub(super) volume_bytes: Option<u64>,
}

/// What is fitted while a session waits covers paths so many times those of the view it waits with.
const WARM_ROOM: f64 = 1.6;

/// Whether fixed point comes into question: on processors with AVX-512, where its bound may do.
fn fixed_may_do(goal: Goal) -> bool {
    match goal {
        Goal::MaxError(error) => is_fast() && error >= LEAST_FIXED_ERROR,
        Goal::BudgetMs(_) => is_fast(),
        Goal::Explicit { sampling, .. } => sampling == Sampling::FixedSlabs,
    }
}

impl Renderer {
    /// Opens the device.
    ///
    /// # Errors
    /// When a device was named that is not there.
    pub fn new(choice: DeviceChoice, reporter: &Reporter) -> Result<Self, RenderError> {
        let device = Device::open(choice, reporter)?;
        let planner = Planner::default();
        Ok(Self {
            device,
            reporter: reporter.clone(),
            choice,
            volumes: VolumeCache::default(),
            planner,
            wgsl: None,
            volume_bytes: None,
        })
    }

    /// Leaves a volume no more than `bytes` of a GPU's memory; what is larger is crossed part by part, uploaded for every view.
    pub fn limit_gpu_memory(&mut self, bytes: u64) {
        self.volume_bytes = Some(bytes);
    }

    /// Device, driver, version.
    #[must_use]
    pub fn adapter(&self) -> String {
        self.device.name()
    }

    /// The same, and how many threads the CPU has: beside times.
    #[must_use]
    pub fn adapter_with_threads(&self) -> String {
        self.device.name_with_threads()
    }

    /// The device, where it is a GPU.
    #[must_use]
    pub fn gpu(&self) -> Option<&Gpu> {
        match &self.device {
            Device::Gpu(gpu) => Some(gpu),
            Device::Cpu => None,
        }
    }

    /// The plan that [`Renderer::render`] would execute. Pilot rays are cast for it.
    ///
    /// # Errors
    /// When the scene has no view, or a number in it makes no sense.
    pub fn plan(&mut self, scene: &Scene, options: &Options) -> Result<Plan, RenderError> {
        self.plan_timed(scene, options, &mut StageTimes::default())
    }

    /// The same; what it takes is booked in `stages`: `prepare` (volumes and meshes that are new), `calibrate` (the first plan of a machine
    /// measures what it costs), `plan` (pilot rays, energies that are fitted).
    ///
    /// # Errors
    /// As [`Renderer::plan`].
    pub fn plan_timed(&mut self, scene: &Scene, options: &Options, stages: &mut StageTimes) -> Result<Plan, RenderError> {
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
        let slabs = executor == Executor::Cpu;
        let asked = options.goal.unwrap_or(Goal::MaxError(DEFAULT_MAX_ERROR));
        let (all_slabs, fixed_step_px) = stages.measure("prepare", || {
            self.volumes.keep(scene, options.beside);
            let whole = self.volumes.prepare(scene, view, slabs)?;
            let all_slabs = slabs && whole.volumes.iter().all(|seen| seen.slabs.is_some() && seen.air_kind.is_none());
            let fixed_step_px = if all_slabs && fixed_may_do(asked) { whole.coarsest_rounded() } else { 0 };
            whole.make_slabs(fixed_step_px > 0);
            Ok::<_, RenderError>((all_slabs, fixed_step_px))
        })?;
        let task = Task { scene, view, quantity: options.quantity, executor, slabs: all_slabs, fixed_step_px, goal: asked };
        let goal = match (executor, options.goal) {
            // Without a wish a GPU adds its own bound to that of the energies.
            (Executor::Wgsl, None) => Goal::MaxError(DEFAULT_MAX_ERROR + Executor::Wgsl.stated_error()),
            _ => task.goal,
        };
        stages.measure("calibrate", || self.planner.calibrate());
        let cache = &mut self.volumes;
        stages.measure("plan", || self.planner.refine(plan, &Task { goal, ..task }, |view| cache.prepare(scene, view, slabs)))
    }

    /// All that was made so far of volumes and spectra.
    #[must_use]
    pub fn made(&self) -> Made {
        let [volumes, copies] = self.volumes.made();
        Made { volumes, copies, fits: self.planner.fits.tried }
    }

    /// The objects of `scene` for small pictures about `view`, on the processor: with fewer slices, which are kept for the next.
    #[must_use]
    pub fn thinned(&mut self, scene: &Scene, view: &View) -> Vec<Object> {
        if self.gpu().is_some() { scene.objects.clone() } else { self.volumes.thinned(scene, view) }
    }

    /// Does now what the first image of `scene` from `view` would wait for: volumes, meshes, costs of this machine, energies, all with room
    /// for other views and poses; renders it once, so that memory is there. Returns what each took.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn warm(&mut self, scene: &Scene, view: View, options: &Options) -> Result<StageTimes, RenderError> {
        let scene = scene.with_view(view);
        let mut stages = StageTimes::default();
        let (room, usual) = (WARM_ROOM, self.planner.fits.room);
        self.planner.fits.room = room;
        let plan = self.plan_timed(&scene, options, &mut stages);
        self.planner.fits.room = usual;
        let plan = plan?;
        let in_slabs = matches!(plan.sampling, Sampling::ExactSlabs | Sampling::FixedSlabs);
        stages.measure("prepare", || {
            let prepared = self.volumes.prepare(&scene, view, in_slabs)?;
            // Another view may look along any axis.
            prepared.make_all_slabs(plan.sampling == Sampling::FixedSlabs);
            Ok::<_, RenderError>(())
        })?;
        let rendered = self.render(&scene, &Options { plan: Some(plan), ..options.clone() })?;
        stages.merge(&rendered.stages);
        Ok(stages)
    }

    /// Renders `scene` from its view.
    ///
    /// # Errors
    /// When the scene has no view, a number in it makes no sense, attenuation is not tabulated, or the device fails.
    pub fn render(&mut self, scene: &Scene, options: &Options) -> Result<Rendered, RenderError> {
        scene.view.ok_or(RenderError::NoView)?;
        check(scene)?;
        let before = self.made();
        let mut stages = StageTimes::default();
        let plan = self.plan_timed(scene, options, &mut stages)?;
        let mut ready = [self.ready(scene, plan, options, stages)?];
        let cast = self.cast(&mut ready)?;
        let [ready] = ready;
        let cast = cast.into_iter().next().ok_or(RenderError::NoView)?;
        let mut rendered = self.finish(ready, cast, options)?;
        rendered.made = self.made() - before;
        if options.guessed
            && let Some(mask) = rendered.stages.measure("guessed", || guessed(scene))?
        {
            rendered.notes.push(format!(
                "{:.1} % of the pixels look through more than {LEAST_GUESSED_MM} mm of what fills the place that a body left: a guess",
                100.0 * guessed_share(&mask)
            ));
            rendered.guessed = Some(mask);
        }
        Ok(rendered)
    }

    /// Renders `scene` from many views of one size by one plan, that of the first; `take` is given each image in turn. A GPU is given
    /// several views at a time. Noise is keyed by the frame index of the options plus the view's.
    ///
    /// # Errors
    /// As [`Renderer::render`], or when a view has another size than the first.
    pub fn render_views(
        &mut self,
        scene: &Scene,
        views: &[View],
        options: &Options,
        take: &mut dyn FnMut(usize, Rendered),
    ) -> Result<(), RenderError> {
        let Some(first) = views.first() else { return Ok(()) };
        let from = |view: &View| Scene { view: Some(*view), ..scene.clone() };
        let plan = self.plan(&from(first), options)?;
        for (batch, views) in views.chunks(wgsl::VIEWS_PER_SUBMISSION).enumerate() {
            let scenes: Vec<Scene> = views.iter().map(from).collect();
            let mut ready = Vec::new();
            for (index, scene) in scenes.iter().enumerate() {
                check(scene)?;
                let frame_index = options.frame_index + (batch * wgsl::VIEWS_PER_SUBMISSION + index) as u32;
                let mut stages = StageTimes::default();
                // Which pixels may be skipped is a matter of the view.
                let plan = match plan.step_px {
                    1 => plan.clone(),
                    _ => self.plan_timed(scene, options, &mut stages)?,
                };
                ready.push(self.ready(scene, Plan { frame_index, ..plan }, options, stages)?);
            }
            let casts = self.cast(&mut ready)?;
            for (index, (ready, cast)) in ready.into_iter().zip(casts).enumerate() {
                take(batch * wgsl::VIEWS_PER_SUBMISSION + index, self.finish(ready, cast, options)?);
            }
        }
        Ok(())
    }

    /// Executes the plan for `goal` as well and compares it with `rendered`, the yardstick's image of the same scene: line integrals before
    /// the panel and without noise, as stated errors are meant.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn judge(&mut self, scene: &Scene, goal: Goal, rendered: &mut Rendered) -> Result<(), RenderError> {
        let before = before_panel(scene);
        let quantity = Quantity::LineIntegral;
        let expected = match rendered.quantity == quantity && is_before_panel(scene) {
            true => rendered.pages[0].pixels.clone(),
            false => self.render(&before, &Options { quantity, reference: true, ..Options::default() })?.pages.remove(0).pixels,
        };
        let options = Options { quantity, goal: Some(goal), ..Options::default() };
        let plan = self.plan(&before, &options)?;
        let fast = self.render(&before, &Options { plan: Some(plan.clone()), ..options })?;
        rendered.achieved = Some((plan, Achieved::of(&fast.pages[0].pixels, &expected, fast.image_ms())));
        Ok(())
    }
}

impl Rendered {
    /// Milliseconds of the image itself: what plans predict. Planning and preparation stand in `stages` beside it.
    #[must_use]
    pub fn image_ms(&self) -> f64 {
        image_ms(&self.stages)
    }

    /// Books what was done for this image before it was rendered.
    pub fn booked_before(&mut self, stages: &StageTimes) {
        let mut all = stages.clone();
        all.merge(&self.stages);
        self.stages = all;
    }
}

/// Milliseconds of the stages that make an image, planning and preparation aside, and what is found out about it besides.
#[must_use]
pub fn image_ms(stages: &StageTimes) -> f64 {
    stages.iter().filter(|(stage, _)| !matches!(*stage, "plan" | "prepare" | "calibrate" | "guessed")).map(|(_, ms)| ms).sum()
}

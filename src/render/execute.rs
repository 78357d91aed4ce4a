//! From a plan to an image: what is prepared, what an executor casts, what detector and notes make of it.

use super::cast::{Cast, area_pages, attenuate_beyond, cast_cpu, note_invalid};
use super::chain::{self, Wanted};
use super::checks::check_plan;
use super::cpu::add_noise::add_noise;
use super::cpu::attenuate_spectrum::attenuate_spectrum;
use super::cpu::integrate_density::Density;
use super::detector;
use super::explain::explain_empty;
use super::made::Made;
use super::non_finite::{self, NonFinite};
use super::plan::{Executor, Plan, Sampling, noise_applies, scatter_left_out};
use super::prepared::Prepared;
use super::renderer::{Options, Rendered, Renderer};
use super::spectrum::Bins;
use super::survey::every;
use super::wgsl::{self, Executed, NoiseKey, Request, WgslExecutor};
use super::{Quantity, RenderError, cut_faces, flood, intensifier, reference};
use crate::geometry::View;
use crate::gpu::{Device, cpu_name};
use crate::image::Image;
use crate::reporter::Reporter;
use crate::scene::model::{ScatterModel, Scene};
use crate::time::StageTimes;

/// All that casting needs.
pub(super) struct Ready<'s> {
    scene: &'s Scene,
    view: View,
    plan: Plan,
    prepared: Prepared<'s>,
    /// As the plan's coarse image sees the scene, where pixels are skipped.
    coarse: Option<Prepared<'s>>,
    bins: Option<Bins>,
    /// Whether area densities must come back from a GPU.
    paths: bool,
    stages: StageTimes,
    notes: Vec<String>,
}

impl Ready<'_> {
    fn noisy(&self) -> bool {
        noise_applies(self.scene, self.plan.quantity)
    }

    fn cast_cpu(&mut self, plan: &Plan) -> Cast {
        let noisy = self.noisy();
        let coarse = self.coarse.as_ref().filter(|_| plan.step_px > 1);
        // Heel and bow-tie attenuate pixel by pixel, by the density alone.
        let bins = self.bins.as_ref().filter(|_| !flood::shapes_spectrum(self.scene));
        cast_cpu(&self.prepared, coarse, plan, bins, noisy, &mut self.stages)
    }
}

impl Renderer {
    /// Prepares what `plan` needs of the scene.
    pub(super) fn ready<'s>(
        &mut self,
        scene: &'s Scene,
        plan: Plan,
        options: &Options,
        mut stages: StageTimes,
    ) -> Result<Ready<'s>, RenderError> {
        let view = scene.view.ok_or(RenderError::NoView)?;
        check_plan(&plan, scene)?;
        let (prepared, coarse) = stages.measure("prepare", || {
            let slabs = plan.executor == Executor::Cpu && matches!(plan.sampling, Sampling::ExactSlabs | Sampling::FixedSlabs);
            self.volumes.keep(scene, options.beside);
            let prepared = self.volumes.prepare(scene, view, slabs)?;
            prepared.make_slabs(plan.sampling == Sampling::FixedSlabs);
            if plan.step_px <= 1 {
                return Ok((prepared, None));
            }
            let mut coarse = self.volumes.prepare(scene, every(&view, plan.step_px), slabs)?;
            // The detector stays where it is, however few of its pixels are cast.
            coarse.detector_mm = prepared.detector_mm;
            coarse.make_slabs(plan.sampling == Sampling::FixedSlabs);
            Ok::<_, RenderError>((prepared, Some(coarse)))
        })?;
        let bins = if plan.quantity == Quantity::AreaDensity { None } else { Some(Bins::new(scene, &plan.energy_nodes)?) };
        // Only where something besides line integrals is made of them.
        let paths = bins.is_none() || scene.beam.shape.varies() || options.count_non_finite;
        Ok(Ready { scene, view, plan, prepared, coarse, bins, paths, stages, notes: Vec::new() })
    }

    /// Casts every view; all of them have the executor of the first.
    pub(super) fn cast(&mut self, ready: &mut [Ready]) -> Result<Vec<Cast>, RenderError> {
        match ready.first().map(|ready| ready.plan.executor) {
            None => Ok(Vec::new()),
            Some(Executor::Wgsl) => self.cast_wgsl(ready),
            Some(Executor::Reference) => ready.iter_mut().map(cast_reference).collect(),
            Some(Executor::Cpu) => Ok(ready.iter_mut().map(|ready| ready.cast_cpu(&ready.plan.clone())).collect()),
        }
    }

    /// Everything after the rays: noise, detector, notes.
    pub(super) fn finish(&self, ready: Ready, mut cast: Cast, options: &Options) -> Result<Rendered, RenderError> {
        let noisy = ready.noisy();
        let Ready { scene, view, mut plan, prepared, bins, mut stages, mut notes, .. } = ready;
        let size = view.size_px.map(|n| n as usize);
        let image = |pixels: Vec<f32>| Image { width: size[0], height: size[1], pixels };
        if !plan.fitted_up_to_g_per_cm2.is_empty() {
            stages.measure("attenuate_spectrum", || attenuate_beyond(scene, &plan, &mut cast, noisy))?;
        }
        let deviates = cast.deviates.as_deref().unwrap_or_default();
        let mut non_finite = options.count_non_finite.then(|| NonFinite::of(&cast.density, &cast.signal, deviates));
        // The reference marks its rays itself, one by one.
        let unscanned_mm = match plan.executor {
            Executor::Reference => 0.0,
            _ => stages.measure("cut_faces", || cut_faces::mark(&prepared, &mut cast.density.valid)),
        };
        note_invalid(&cast.density.valid, unscanned_mm, &mut notes);
        notes.extend(scene.model.noise_left_out().map(str::to_owned));
        let is_asked_for = bins.is_some() && scene.model.scatter != ScatterModel::Off;
        let scatter = options.scatter.as_ref().filter(|_| is_asked_for);
        match scatter {
            Some(scatter) => {
                plan.say("scatter", true, scatter.words());
                notes.extend(scatter.unlike());
            }
            None => notes.extend(scatter_left_out(scene, plan.quantity).filter(|_| bins.is_some()).map(str::to_owned)),
        }
        let mut added = None;
        if !cast.matter {
            let why = explain_empty(scene, &prepared);
            if !options.beside {
                self.reporter.warn("empty image", &why);
            }
            notes.push(why);
        }
        let mut valid = Image { width: size[0], height: size[1], pixels: cast.density.valid.clone() };
        let pages: Vec<Image<f32>> = match &bins {
            None => area_pages(&cast.density).into_iter().map(image).collect(),
            Some(bins) => {
                let intensifier = intensifier::of_view(scene, &view)?;
                let glares = intensifier.as_ref().is_some_and(|intensifier| intensifier.glare.is_some());
                let wanted =
                    Wanted { photons: noisy || plan.quantity == Quantity::Counts || glares || scatter.is_some(), moments: noisy };
                let made_by = (plan.energy_nodes.as_slice(), plan.executor);
                let mut flood = stages.measure("shape_beam", || {
                    chain::shape(scene, &view, made_by, &cast.density, bins, &mut cast.signal, wanted)
                })?;
                if let Some(counts) = non_finite.as_mut().filter(|_| flood::shapes_spectrum(scene)) {
                    counts.attenuate_spectrum += non_finite::count_signal(&cast.signal);
                }
                if let Some(scatter) = scatter {
                    // Scatter reaches what the field closes.
                    chain::close(&flood, &mut valid.pixels, &mut notes, chain::BESIDE_WITH_SCATTER);
                    let sum = || scatter.add_to(&mut cast.signal, &mut flood, bins, size, &valid.pixels);
                    added = Some(stages.measure("add_scatter", sum));
                }
                if let Some(intensifier) = &intensifier {
                    stages.measure("distort", || {
                        intensifier::distort(intensifier, &mut cast.signal, &mut flood, &mut valid.pixels)
                    });
                    notes.extend(intensifier.note.clone());
                }
                if scatter.is_none() {
                    chain::close(&flood, &mut valid.pixels, &mut notes, chain::BESIDE);
                }
                chain::note_extrapolated(&flood, &mut notes);
                let mut noise = if noisy {
                    stages.measure("add_noise", || {
                        let as_cast = flood::is_plain(scene) && scatter.is_none();
                        let deviates = cast.deviates.filter(|_| as_cast).unwrap_or_else(|| {
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
                let (page, underflowed) = stages.measure("detect", || {
                    let mut line = detector::seen_line_integral(scene, &view, &cast.signal.line_integral, &flood);
                    if let Some(intensifier) = &intensifier {
                        intensifier::veil(intensifier, &mut line, &mut noise, &mut flood);
                    }
                    let page = detector::page(scene, plan.quantity, &line, &noise, &flood);
                    let underflowed = chain::note_underflowed(plan.quantity, &page, &line, !noise.is_empty(), &mut notes);
                    (page, underflowed)
                });
                if let Some(words) = underflowed.filter(|_| !options.beside) {
                    self.reporter.warn("underflow", words);
                }
                if let Some(words) = chain::note_clipped(scene, plan.quantity, &page, &flood, &mut notes) {
                    self.reporter.warn("saturated", words);
                }
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
            guessed: None,
            stated_error: plan.stated_error + added.as_ref().map_or(0.0, |added| added.stated_error),
            scatter: added,
            plan: serde_json::to_value(&plan).expect("a plan is plain data"),
            adapter: cast.adapter,
            stages,
            gpu_ms: cast.gpu_ms,
            read_back_bytes: cast.read_back_bytes,
            notes,
            non_finite,
            achieved: None,
            made: Made::default(),
        })
    }

    fn cast_wgsl(&mut self, ready: &mut [Ready]) -> Result<Vec<Cast>, RenderError> {
        let unsupported = ready.first().and_then(|ready| wgsl::unsupported(ready.scene));
        let reason = match (&self.device, unsupported) {
            (_, Some(reason)) => reason,
            (Device::Cpu, None) => "the plan was made for a GPU, which is not open here".to_owned(),
            (Device::Gpu(gpu), None) => {
                let executor = match (&mut self.wgsl, ready.first_mut()) {
                    (Some(executor), _) => executor,
                    (empty, Some(first)) => empty.insert(first.stages.measure("compile_shaders", || WgslExecutor::new(gpu))?),
                    (_, None) => return Ok(Vec::new()),
                };
                if let Some(bytes) = self.volume_bytes.take() {
                    executor.limit_memory(bytes);
                }
                let requests: Vec<Request> = ready.iter().map(request).collect();
                let mut submitted = StageTimes::default();
                let executed = submitted.measure("shaders", || executor.execute(gpu, &requests))?;
                let shaders_ms = submitted.get("shaders").unwrap_or(0.0) / ready.len() as f64;
                let mut casts = Vec::new();
                for (slot, (executed, ready)) in executed.into_iter().zip(ready.iter_mut()).enumerate() {
                    ready.stages.add("shaders", shaders_ms);
                    if executed.overflows > 0 {
                        let reason = format!("{} rays cross more intervals than the shader holds", executed.overflows);
                        casts.push(on_cpu(&self.reporter, ready, &reason));
                        continue;
                    }
                    let mut cast = unpack(executed, ready, &gpu.adapter);
                    if cast.beyond && cast.density.g_per_cm2.is_empty() {
                        cast.density.g_per_cm2 = ready.stages.measure("shaders", || executor.paths(gpu, slot))?;
                        cast.read_back_bytes += 4 * cast.density.g_per_cm2.len() as u64;
                    }
                    casts.push(cast);
                }
                return Ok(casts);
            }
        };
        Ok(ready.iter_mut().map(|ready| on_cpu(&self.reporter, ready, &reason)).collect())
    }
}

/// What the shaders are asked for.
fn request<'r>(ready: &'r Ready<'r>) -> Request<'r> {
    let photons_per_pixel = ready.scene.beam.photons_per_pixel;
    let Plan { seed, frame_index, .. } = ready.plan;
    Request {
        prepared: &ready.prepared,
        bins: ready.bins.as_ref(),
        noise: ready.noisy().then_some(NoiseKey { seed, frame: frame_index, photons_per_pixel }),
        fitted_up_to: &ready.plan.fitted_up_to_g_per_cm2,
        paths: ready.paths,
    }
}

fn unpack(executed: Executed, ready: &Ready, adapter: &str) -> Cast {
    let Executed { g_per_cm2, valid, matter, beyond, signal, deviates, pass_ms, read_back_bytes, .. } = executed;
    let mut gpu_ms = StageTimes::default();
    pass_ms.into_iter().for_each(|(pass, ms)| gpu_ms.add(pass, ms));
    Cast {
        density: Density { material_count: ready.prepared.material_count, g_per_cm2, valid },
        matter,
        beyond: beyond && !ready.plan.fitted_up_to_g_per_cm2.is_empty(),
        signal,
        deviates: ready.noisy().then_some(deviates),
        adapter: adapter.to_owned(),
        gpu_ms,
        read_back_bytes,
    }
}

fn on_cpu(reporter: &Reporter, ready: &mut Ready, reason: &str) -> Cast {
    let message = format!("{reason}: rendered by the CPU executor instead, whose error is smaller");
    reporter.warn("executor", &message);
    ready.notes.push(message);
    let whole = Plan { sampling: Sampling::ExactCells, step_px: 1, full_tiles: None, ..ready.plan.clone() };
    ready.cast_cpu(&whole)
}

fn cast_reference(ready: &mut Ready) -> Result<Cast, RenderError> {
    let noisy = ready.noisy();
    let Ready { scene, view, bins, stages, .. } = ready;
    let traced = stages.measure("reference", || reference::trace(scene, view, bins.is_some()))?;
    let single = |values: &[f64]| values.iter().map(|value| *value as f32).collect::<Vec<f32>>();
    let density = Density { material_count: scene.materials.len(), g_per_cm2: single(&traced.g_per_cm2), valid: traced.valid };
    let mut signal = bins.as_ref().map(|bins| attenuate_spectrum(&density, bins, noisy)).unwrap_or_default();
    signal.line_integral = single(&traced.line_integral);
    Ok(Cast::of(density, signal, format!("f64 reference on {}", cpu_name())))
}

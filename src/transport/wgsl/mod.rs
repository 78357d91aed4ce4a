//! The transport on a GPU: `shaders/follow_photons.wgsl` over the same tables and boxes as on the processor, in f32.
//!
//! Its random numbers are its own, so it agrees with the processor within statistics, not bit by bit. Its sums are whole numbers, so that on one
//! device it gives the same bits every time.

pub mod layout;
mod pack;

use self::pack::{Packed, unsupported};
use super::simulation::Simulation;
use super::tally::{Batch, FATES, PAGES, Tally};
use crate::gpu::{Gpu, GpuError, compile, dispatch, finish, wait};
use crate::time::Stopwatch;

/// Units of the shader's sums per keV, or photon.
const QUANTA: f64 = 64.0;
/// Batches that are followed at once.
pub const BATCHES: u64 = 32;
/// Histories of the smallest batch, where a processor plays the GPU and elsewhere.
const SOFTWARE_BATCH: u64 = 4096;
const BATCH: u64 = 65_536;
/// Histories of one invocation in it. Mesa's software Vulkan ends every loop of an invocation once all of them together have turned 65535 times.
const SOFTWARE_EACH: u64 = 1;
const EACH: u64 = 8;
/// Where many histories are asked for, a batch and an invocation have so many times more at most: a large GPU is done with fewer sooner than their
/// sums are fetched.
const SOFTWARE_TIMES: u64 = 1;
const MOST_TIMES: u64 = 4;
/// What a dispatch may take: a driver waits for a second or two before it gives a device up. The first one is this share of the batches, whatever
/// the device.
const DISPATCH_MS: f64 = 200.0;
const FIRST_SHARE: u64 = 64;
/// Why the shader gives a history up, in the order of its constants.
const CAUSES: [&str; 4] = ["a signal that is no number", "no direction in the field", "a flight without end", "no angle"];
const TROUBLE_BYTES: u64 = 4 * CAUSES.len() as u64;
/// Invocations of one group.
const GROUP: u64 = 64;

/// Why a GPU follows no photons.
#[derive(Debug, thiserror::Error)]
pub enum GpuTransportError {
    /// What the scene holds.
    #[error("{0}: use --device cpu")]
    Unsupported(String),
    /// The device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Loops that did not end.
    #[error("{adapter}: histories were given up ({what}), so the sums are not whole; use --device cpu")]
    GivenUp {
        /// Device.
        adapter: String,
        /// How many, and why.
        what: String,
    },
}

/// A simulation on a device.
pub struct GpuTransport<'a> {
    gpu: &'a Gpu,
    pipeline: wgpu::ComputePipeline,
    job: layout::Job,
    uniform: wgpu::Buffer,
    inputs: Vec<wgpu::Buffer>,
    sums: wgpu::Buffer,
    trouble: wgpu::Buffer,
    read_back: wgpu::Buffer,
    pixels: usize,
    materials: usize,
    histories_per_batch: u64,
    advances: u64,
    /// Groups of one dispatch.
    groups_at_once: u64,
}

impl<'a> GpuTransport<'a> {
    /// Brings `simulation` to `gpu`.
    ///
    /// # Errors
    /// When the shader cannot follow photons through it, or the device has no room.
    pub fn new(gpu: &'a Gpu, simulation: &Simulation) -> Result<Self, GpuTransportError> {
        if let Some(reason) = unsupported(simulation.world()) {
            return Err(GpuTransportError::Unsupported(reason));
        }
        let limit = gpu.device.limits().max_storage_buffer_binding_size;
        let adapter = || gpu.adapter.clone();
        let voxels = 4 * pack::voxels(simulation.world());
        if voxels > limit {
            return Err(GpuError::Limit { adapter: adapter(), what: "the CT", needed: voxels, limit }.into());
        }
        let packed = Packed::new(simulation.world());
        let (pixels, materials) = (simulation.unattenuated().len(), simulation.materials());
        let (least, each, most) = match gpu.software {
            true => (SOFTWARE_BATCH, SOFTWARE_EACH, SOFTWARE_TIMES),
            false => (BATCH, EACH, MOST_TIMES),
        };
        // A pilot takes no longer than it must.
        let times = simulation.histories().count.div_ceil(BATCHES * least).clamp(1, most);
        let (histories_per_batch, each) = (least * times, each * times);
        let seed = simulation.histories().seed;
        let job = layout::Job {
            seed: [seed as u32, (seed >> 32) as u32],
            each: each as u32,
            groups_per_batch: (histories_per_batch / (each * GROUP)) as u32,
            ..packed.job
        };
        let sums_bytes = BATCHES * (PAGES * pixels + materials + FATES) as u64 * 8;
        let tables: [(&'static str, &[u8]); 5] = [
            ("tables", bytemuck::cast_slice(&packed.numbers)),
            ("indices", bytemuck::cast_slice(&packed.indices)),
            ("super-voxels", bytemuck::cast_slice(&packed.boxes)),
            ("shapes", bytemuck::cast_slice(&packed.things)),
            ("the CT", bytemuck::cast_slice(&packed.voxels)),
        ];
        let needs = tables.iter().map(|(what, bytes)| (*what, bytes.len() as u64)).chain([("the sums", sums_bytes)]);
        for (what, needed) in needs {
            if needed > limit {
                return Err(GpuError::Limit { adapter: adapter(), what, needed, limit }.into());
            }
        }
        let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let buffer = |label, size, usage| {
            gpu.device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false })
        };
        use wgpu::BufferUsages as Usage;
        let inputs = tables.map(|(label, bytes)| buffer(label, bytes.len() as u64, Usage::STORAGE | Usage::COPY_DST)).to_vec();
        let uniform = buffer("job", size_of::<layout::Job>() as u64, Usage::UNIFORM | Usage::COPY_DST);
        let sums = buffer("sums", sums_bytes, Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST);
        let trouble = buffer("trouble", TROUBLE_BYTES, Usage::STORAGE | Usage::COPY_SRC | Usage::COPY_DST);
        let read_back = buffer("read back", sums_bytes + TROUBLE_BYTES, Usage::MAP_READ | Usage::COPY_DST);
        if pollster::block_on(scope.pop()).is_some() {
            let needed_mib = (tables.iter().map(|(_, bytes)| bytes.len() as u64).sum::<u64>() + 2 * sums_bytes) >> 20;
            return Err(GpuError::Memory { adapter: gpu.adapter.clone(), what: "photons' surroundings", needed_mib }.into());
        }
        for (input, (_, bytes)) in inputs.iter().zip(tables) {
            gpu.queue.write_buffer(input, 0, bytes);
        }
        let constants: Vec<(&str, f64)> = pack::constants().into_iter().chain([("QUANTA", QUANTA)]).collect();
        let pipeline = compile(gpu, "follow_photons", &constants)?;
        let advances = simulation.histories().count.div_ceil(BATCHES * histories_per_batch);
        let groups_at_once = (BATCHES * u64::from(job.groups_per_batch) / FIRST_SHARE).max(1);
        Ok(Self {
            gpu,
            pipeline,
            job,
            uniform,
            inputs,
            sums,
            trouble,
            read_back,
            pixels,
            materials,
            histories_per_batch,
            advances,
            groups_at_once,
        })
    }

    /// An empty tally for this device's batches.
    #[must_use]
    pub fn tally(&self) -> Tally {
        Tally::new(self.pixels, self.materials, self.histories_per_batch)
    }

    /// The device.
    #[must_use]
    pub fn adapter(&self) -> &str {
        &self.gpu.adapter
    }

    /// All histories.
    #[must_use]
    pub fn histories(&self) -> u64 {
        self.advances * BATCHES * self.histories_per_batch
    }

    /// Whether `tally` has all histories that `simulation` asks for, or its precision.
    #[must_use]
    pub fn is_done(&self, simulation: &Simulation, tally: &Tally) -> bool {
        let wanted = simulation.histories().rel_error;
        tally.batches >= self.advances * BATCHES || wanted.is_some_and(|wanted| simulation.relative_error(tally) <= wanted)
    }

    /// The next [`BATCHES`], added to `tally`.
    ///
    /// # Errors
    /// When the device is lost, or a history did not end.
    pub fn advance(&mut self, tally: &mut Tally) -> Result<(), GpuTransportError> {
        let encoder = || self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("photons") });
        let buffers = std::iter::once(&self.uniform).chain(&self.inputs).chain([&self.sums, &self.trouble]);
        let bindings: Vec<_> = buffers.map(wgpu::Buffer::as_entire_binding).collect();
        let first = tally.batches * self.histories_per_batch;
        self.job.first = [first as u32, (first >> 32) as u32];
        let groups = BATCHES * u64::from(self.job.groups_per_batch);
        let mut done = 0;
        while done < groups {
            let these = self.groups_at_once.min(groups - done);
            self.job.first_group = done as u32;
            self.gpu.queue.write_buffer(&self.uniform, 0, bytemuck::bytes_of(&self.job));
            let mut commands = encoder();
            if done == 0 {
                commands.clear_buffer(&self.sums, 0, None);
                commands.clear_buffer(&self.trouble, 0, None);
            }
            dispatch(self.gpu, &mut commands, &self.pipeline, &bindings, [these as u32, 1], None);
            let watch = Stopwatch::start();
            self.gpu.queue.submit([commands.finish()]);
            done += these;
            if done < groups {
                finish(self.gpu)?;
                let grown = (DISPATCH_MS / watch.ms().max(1e-3)).clamp(0.25, 8.0);
                self.groups_at_once = ((these as f64 * grown) as u64).max(1);
            }
        }
        let mut commands = encoder();
        commands.copy_buffer_to_buffer(&self.sums, 0, &self.read_back, 0, self.sums.size());
        commands.copy_buffer_to_buffer(&self.trouble, 0, &self.read_back, self.sums.size(), TROUBLE_BYTES);
        self.gpu.queue.submit([commands.finish()]);
        let (sender, receiver) = std::sync::mpsc::channel();
        self.read_back.slice(..).map_async(wgpu::MapMode::Read, move |result| drop(sender.send(result)));
        wait(self.gpu, &receiver, 1)?;
        let what = {
            let lost =
                |error: wgpu::MapRangeError| GpuError::Lost { adapter: self.gpu.adapter.clone(), detail: error.to_string() };
            let bytes = self.read_back.slice(..).get_mapped_range().map_err(lost)?;
            let words: &[u32] = bytemuck::cast_slice(&bytes);
            let (sums, trouble) = words.split_at(words.len() - CAUSES.len());
            let slots = sums.len() / (2 * BATCHES as usize);
            for slots in sums.chunks_exact(2 * slots) {
                let mut batch = Batch::new(self.pixels, self.materials);
                for (sum, pair) in batch.sums.iter_mut().zip(slots.chunks_exact(2)) {
                    *sum = (f64::from(pair[1]) * 4_294_967_296.0 + f64::from(pair[0])) / QUANTA;
                }
                tally.add(&batch);
            }
            let causes = CAUSES.iter().zip(trouble).filter(|(_, histories)| **histories > 0);
            causes.map(|(cause, histories)| format!("{histories}: {cause}")).collect::<Vec<_>>().join(", ")
        };
        self.read_back.unmap();
        match what.is_empty() {
            true => Ok(()),
            false => Err(GpuTransportError::GivenUp { adapter: self.gpu.adapter.clone(), what }),
        }
    }

    /// Runs until all histories or the wanted precision are there, and says after every step how far it is.
    ///
    /// # Errors
    /// As [`Self::advance`]; what `after` says.
    pub fn run<E: From<GpuTransportError>>(
        &mut self,
        simulation: &Simulation,
        tally: &mut Tally,
        mut after: impl FnMut(&Tally) -> Result<(), E>,
    ) -> Result<(), E> {
        while !self.is_done(simulation, tally) {
            self.advance(tally)?;
            after(tally)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2, DVec3};

    use super::*;
    use crate::geometry::{Intrinsics, Rigid, View};
    use crate::gpu::{Device, DeviceChoice};
    use crate::reporter::Reporter;
    use crate::scene::model::{Matter, Scene, Shape, Voxels};
    use crate::scene::optics::{Axis, BowTie, Field, Grid, Heel, Strips, Towards};
    use crate::scene::physics::{Material, Spectrum};
    use crate::transport::fixture::{everything, solid};
    use crate::transport::{Estimator, Histories, Page};

    /// Everything but what only the processor takes, 600 mm from the source.
    fn lab() -> (Scene, View) {
        let mut scene = everything();
        scene.objects.retain(|object| !matches!(object.matter, Matter::Mesh(_)));
        let aluminium = Material::parse("aluminium").expect("known");
        scene.beam.spectrum = Spectrum::tungsten(90.0, 12.0, &[(aluminium, 3.0)]).expect("inside");
        scene.detector.pitch_mm = 1.0;
        let intrinsics = Intrinsics { fx: 1000.0, fy: 990.0, skew: 3.0, cx: 165.0, cy: 118.0 };
        let camera_from_lps = Rigid { rotation: DQuat::from_rotation_x(0.4), translation_mm: DVec3::new(5.0, -10.0, 600.0) };
        (scene, View { size_px: [320, 240], intrinsics, camera_from_lps })
    }

    /// Software Vulkan, or `None` with the reason printed.
    fn software() -> Option<Box<Gpu>> {
        match Device::open(DeviceChoice::SoftwareVulkan, &Reporter::silent()) {
            Ok(Device::Gpu(gpu)) => Some(gpu),
            Ok(Device::Cpu) => None,
            Err(error) => {
                println!("skipped: {error}");
                None
            }
        }
    }

    fn run(gpu: &Gpu, scene: &Scene, view: &View, asked: Histories) -> Tally {
        let simulation = Simulation::new(scene, view, asked).expect("good");
        let mut transport = GpuTransport::new(gpu, &simulation).expect("the shader takes it");
        let mut tally = transport.tally();
        transport.run(&simulation, &mut tally, |_| Ok::<(), GpuTransportError>(())).expect("runs");
        tally
    }

    /// Mean of the squares of z over pixels and pages, and the largest |z| of whole pages, of what materials absorb, and of fates.
    fn apart(gpu: &Tally, cpu: &Tally, pixels: usize, materials: usize) -> (f64, f64) {
        let z = |a: crate::transport::Estimate, b: crate::transport::Estimate| {
            // Where hardly a photon comes, errors are no better known than themselves.
            (a.mean - b.mean) / (a.standard_error.hypot(b.standard_error) + 1e-4 * a.mean.abs() + 1e-12)
        };
        let pages = Page::ALL.iter().flat_map(|page| (0..pixels).map(move |pixel| (*page, pixel)));
        let squares: Vec<f64> = pages.map(|(page, pixel)| z(gpu.signal(page, pixel), cpu.signal(page, pixel)).powi(2)).collect();
        let whole = |page: Page| {
            let sum = |tally: &Tally| (0..pixels).map(|pixel| tally.signal(page, pixel).mean).sum::<f64>();
            let variance = |tally: &Tally| (0..pixels).map(|pixel| tally.signal(page, pixel).standard_error.powi(2)).sum::<f64>();
            (sum(gpu) - sum(cpu)) / ((variance(gpu) + variance(cpu)).sqrt() + 1e-4 * sum(gpu) + 1e-12)
        };
        let whole = Page::ALL.into_iter().map(whole);
        let sums = (0..materials).map(|n| z(gpu.absorbed(n), cpu.absorbed(n)));
        let fates = (0..FATES).map(|n| z(gpu.fate(n), cpu.fate(n)));
        (squares.iter().sum::<f64>() / squares.len() as f64, whole.chain(sums).chain(fates).map(f64::abs).fold(0.0, f64::max))
    }

    /// Scenes with every kind of field, grid and estimator: page by page, pixel by pixel, and in energy.
    #[test]
    fn a_gpu_finds_what_the_processor_finds() {
        let Some(gpu) = software() else { return };
        let (plain, view) = lab();
        let mut shaped = plain.clone();
        shaped.beam.shape.heel = Some(Heel { tube_kvp: 90.0, anode_angle_deg: 12.0, anode_towards: Towards::PlusRow });
        shaped.beam.shape.field =
            Some(Field::Rectangle { size_mm: DVec2::new(180.0, 150.0), centre_mm: DVec2::new(10.0, -8.0), rotation_deg: 20.0 });
        let thickness_mm = vec![[-8.0, 15.0], [0.5, 0.5], [8.0, 12.0]];
        let material = Material::parse("aluminium").expect("known");
        shaped.beam.shape.bowtie = Some(BowTie { material, density_g_per_cm3: 2.7, axis: Axis::Column, thickness_mm });
        shaped.beam.shape.focal_spot_mm = [0.8, 1.2];
        let strips = Strips { ratio: 6.0, across: Axis::Row };
        shaped.detector.panel.grid = Some(Grid { primary_transmission: 0.7, strips: Some(strips) });
        let mut round = plain.clone();
        round.beam.shape.field = Some(Field::Circle { diameter_mm: 200.0, centre_mm: DVec2::new(-6.0, 4.0) });
        round.model.voxels = Voxels::PiecewiseConstant;
        let mut cut = plain;
        let corners_mm = [[-90.0, -60.0], [80.0, -70.0], [60.0, 75.0], [-20.0, 20.0]].map(DVec2::from_array).to_vec();
        cut.beam.shape.field = Some(Field::Polygon { corners_mm });
        // One round of batches: what software follows at once.
        let asked = Histories { count: BATCHES * SOFTWARE_BATCH, seed: 3, grid_px: [8, 6], ..Histories::default() };
        let mut first = None;
        for (name, scene, estimator) in
            [("round", &round, Estimator::Expected), ("shaped", &shaped, Estimator::Expected), ("cut", &cut, Estimator::Analogue)]
        {
            let asked = Histories { estimator, ..asked };
            let tally = run(&gpu, scene, &view, asked);
            let simulation = Simulation::new(scene, &view, Histories { count: 150_000, ..asked }).expect("good");
            let mut cpu = simulation.tally();
            let Ok(()) = simulation.run(&mut cpu, |_| Ok::<(), std::convert::Infallible>(()));
            let (square, largest) = apart(&tally, &cpu, 48, simulation.materials());
            println!("{name}: mean square of z {square:.2}, largest of sums {largest:.2}");
            // 192 squares of z: a standard deviation of 0.1 about 1, and what empty pixels leave.
            assert!(square < 1.6 && largest < 4.5, "{name}: {square} {largest}");
            let balance = |tally: &Tally| {
                let absorbed: f64 = (0..simulation.materials()).map(|n| tally.absorbed(n).mean).sum();
                (absorbed + tally.fate(1).mean + tally.fate(2).mean) / tally.fate(0).mean
            };
            assert!((balance(&tally) - 1.0).abs() < 1e-4, "{name}: {}", balance(&tally));
            first.get_or_insert(tally);
        }
        let first = first.expect("the round one");
        // The control: a fifth more density is seen, and another seed is another image.
        let mut denser = round.clone();
        for object in &mut denser.objects {
            if let Matter::Solids(solids) = &mut object.matter {
                solids.iter_mut().for_each(|solid| solid.density_g_per_cm3 *= 1.2);
            }
        }
        assert!(first == run(&gpu, &round, &view, asked), "the same bits");
        let other = run(&gpu, &round, &view, Histories { seed: 4, ..asked });
        assert!(other != first && apart(&other, &first, 48, 6).0 < 1.6);
        let (square, _) = apart(&run(&gpu, &denser, &view, asked), &first, 48, 6);
        assert!(square > 3.0, "{square}");
    }

    /// Nothing in the beam: the flood, and no buffer is empty. Matter down to the detector: nothing beyond it counts.
    #[test]
    fn an_empty_scene_and_one_on_the_detector_are_followed() {
        let Some(gpu) = software() else { return };
        let (mut scene, view) = lab();
        scene.objects.clear();
        scene.materials.clear();
        let asked = Histories { count: BATCHES * SOFTWARE_BATCH, seed: 3, grid_px: [4, 3], ..Histories::default() };
        let tally = run(&gpu, &scene, &view, asked);
        let simulation = Simulation::new(&scene, &view, asked).expect("good");
        for (pixel, unattenuated) in simulation.unattenuated().iter().enumerate() {
            let found = tally.signal(Page::Primary, pixel);
            assert!((found.mean - unattenuated).abs() < 5.0 * found.standard_error + 1e-3 * unattenuated, "{pixel}: {found:?}");
        }
        assert!(tally.fate(1).mean > 0.0 && (tally.fate(1).mean / tally.fate(0).mean - 1.0).abs() < 1e-5);
        let slab = Shape::Cuboid { half_size_mm: DVec3::new(200.0, 200.0, 60.0) };
        let behind = view.camera_from_lps.inverse();
        let mut lying = solid(slab, DVec3::ZERO, DVec3::ZERO, 0, 1.0);
        lying.lps_from_local = Rigid { translation_mm: behind.transform_point(DVec3::new(0.0, 0.0, 990.0)), ..behind };
        let mut on_panel = crate::transport::fixture::scene(&["water"], vec![Matter::Solids(vec![lying])]);
        (on_panel.beam, on_panel.detector) = (scene.beam, scene.detector);
        let tally = run(&gpu, &on_panel, &view, asked);
        assert!(tally.scatter(5).mean > 0.0);
    }

    #[test]
    fn what_has_no_shader_is_said() {
        let Some(gpu) = software() else { return };
        let (_, view) = lab();
        let scene = Scene { beam: lab().0.beam, detector: lab().0.detector, ..everything() };
        let simulation = Simulation::new(&scene, &view, Histories::default()).expect("good");
        let said = GpuTransport::new(&gpu, &simulation).err().expect("refused").to_string();
        assert!(said.contains("meshes") && said.contains("--device cpu"), "{said}");
        let (mut dense, _) = lab();
        for object in &mut dense.objects {
            if let Matter::Parts(parts) = &mut object.matter {
                std::sync::Arc::make_mut(&mut parts[0]).density_g_per_cm3[7] = 42.0;
            }
        }
        let simulation = Simulation::new(&dense, &view, Histories::default()).expect("good");
        let said = GpuTransport::new(&gpu, &simulation).err().expect("refused").to_string();
        assert!(said.contains("42.0 g/cm3"), "{said}");
        let (scene, _) = lab();
        let simulation = Simulation::new(&scene, &view, Histories::default()).expect("good").with_dose(&scene, 1000);
        let said = GpuTransport::new(&gpu, &simulation).err().expect("refused").to_string();
        assert!(said.contains("map of the dose") && said.contains("--device cpu"), "{said}");
    }
}

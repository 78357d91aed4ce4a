//! The transport on a GPU: `shaders/follow_photons.wgsl` over the same tables and boxes as on the processor, in f32.
//!
//! Its random numbers are its own, so it agrees with the processor within statistics, not bit by bit. Its sums are whole numbers, so that on one
//! device it gives the same bits every time.

pub mod layout;
mod pack;
#[cfg(test)]
mod draws;
#[cfg(test)]
mod kernel;
#[cfg(test)]
mod meshes;
#[cfg(test)]
mod tests;

use self::pack::{Packed, unsupported};
use super::simulation::Simulation;
use super::tally::{Batch, FATES, PAGES, Tally};
use crate::gpu::{Gpu, GpuError, compile, dispatch, finish, wait};
use crate::render::wgsl::layout::MESH;
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
/// By cause, and how many invocations did all of their histories.
const TROUBLE_BYTES: u64 = 4 * (CAUSES.len() as u64 + 1);
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
        let tables: [(&'static str, &[u8]); 6] = [
            ("tables and triangles", bytemuck::cast_slice(&packed.numbers)),
            ("indices", bytemuck::cast_slice(&packed.indices)),
            ("super-voxels", bytemuck::cast_slice(&packed.boxes)),
            ("shapes", bytemuck::cast_slice(&packed.things)),
            ("the CT", bytemuck::cast_slice(&packed.voxels)),
            ("trees of meshes", bytemuck::cast_slice(&packed.nodes)),
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
        // Without meshes it is smaller, and faster.
        let has_meshes = packed.things.iter().any(|thing| thing.kind == MESH);
        let own = [("QUANTA", QUANTA), ("has_meshes", f64::from(u8::from(has_meshes)))];
        let constants: Vec<(&str, f64)> = pack::constants().into_iter().chain(own).collect();
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
        tally.batches >= self.advances * BATCHES || wanted.is_some_and(|wanted| simulation.stated_error(tally) <= wanted)
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
            let (sums, trouble) = words.split_at(words.len() - CAUSES.len() - 1);
            let slots = sums.len() / (2 * BATCHES as usize);
            for slots in sums.chunks_exact(2 * slots) {
                let mut batch = Batch::new(self.pixels, self.materials);
                for (sum, pair) in batch.sums.iter_mut().zip(slots.chunks_exact(2)) {
                    *sum = (f64::from(pair[1]) * 4_294_967_296.0 + f64::from(pair[0])) / QUANTA;
                }
                tally.add(&batch);
            }
            let (given_up, done) = trouble.split_at(CAUSES.len());
            let causes = CAUSES.iter().zip(given_up).map(|(cause, histories)| (*cause, u64::from(*histories)));
            let cut_short = (groups * GROUP).saturating_sub(done.iter().copied().map(u64::from).sum()) * u64::from(self.job.each);
            let told = causes.chain([("loops that the driver ended", cut_short)]).filter(|(_, histories)| *histories > 0);
            told.map(|(cause, histories)| format!("{histories}: {cause}")).collect::<Vec<_>>().join(", ")
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

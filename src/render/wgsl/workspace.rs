//! Buffers of one view in flight; the next view of the same kind finds them there.

use super::layout;
use super::pass_times::PassTimes;
use super::request::Request;
use crate::gpu::{Gpu, GpuError, wait};

/// What a view needs room for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Needs {
    /// Pixels of the image.
    pub pixels: usize,
    /// Materials of the scene.
    pub materials: usize,
    /// Shapes and meshes.
    pub solids: usize,
    /// Nodes of the meshes' trees.
    pub nodes: usize,
    /// Corners of their triangles.
    pub corners: usize,
    /// Padded energies; 0 without a spectrum.
    pub energies: usize,
    /// Whether noise is drawn, and with it everything that it needs.
    pub noise: bool,
    /// Whether area densities are read back.
    pub paths: bool,
}

impl Needs {
    /// Those of a request.
    #[must_use]
    pub fn of(request: &Request, packed: &layout::Packed) -> Self {
        Self {
            pixels: request.prepared.view.size_px.iter().map(|n| *n as usize).product(),
            materials: request.prepared.material_count,
            solids: packed.solids.len(),
            nodes: packed.nodes.len(),
            corners: packed.corners.len(),
            energies: request.bins.map_or(0, |bins| bins.padded),
            noise: request.noise.is_some() && request.bins.is_some(),
            paths: request.paths,
        }
    }
}

/// Where in the words that come back each part begins and ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Parts {
    /// `layout::Flags`.
    pub flags: [usize; 2],
    /// A bit a pixel.
    pub invalid: [usize; 2],
    /// Planes of what arrives: one, or four with noise.
    pub signal: [usize; 2],
    /// Poisson(N) − N.
    pub deviates: [usize; 2],
    /// Area densities.
    pub paths: [usize; 2],
    /// Ticks of the device's clock.
    pub times: [usize; 2],
}

impl Parts {
    fn of(needs: &Needs, time_words: usize) -> Self {
        let mut end = 0;
        let mut next = |words: usize| {
            // Copies begin at multiples of eight bytes, as resolved queries have it.
            let from = end;
            end += words.next_multiple_of(2);
            [from, from + words]
        };
        let planes = if needs.noise { 4 } else { usize::from(needs.energies > 0) };
        Self {
            flags: next(size_of::<layout::Flags>() / 4),
            invalid: next(needs.pixels.div_ceil(32)),
            signal: next(planes * needs.pixels),
            deviates: next(if needs.noise { needs.pixels } else { 0 }),
            paths: next(if needs.paths { needs.pixels * needs.materials } else { 0 }),
            times: next(time_words),
        }
    }

    fn words(&self) -> usize {
        self.times[1].next_multiple_of(2)
    }
}

/// The buffers.
#[derive(Debug)]
pub struct Workspace {
    needs: Needs,
    /// `layout::View`.
    pub view: wgpu::Buffer,
    /// `layout::Grid`.
    pub grid: wgpu::Buffer,
    /// `layout::Solid`, each.
    pub solids: wgpu::Buffer,
    /// `layout::Node`, each.
    pub nodes: wgpu::Buffer,
    /// Three corners a triangle.
    pub corners: wgpu::Buffer,
    /// `layout::Bin`, each.
    pub weights: wgpu::Buffer,
    /// cm²/g by material, then energy.
    pub table: wgpu::Buffer,
    /// g/cm² by pixel, then material.
    pub density: wgpu::Buffer,
    /// A bit a pixel.
    pub invalid: wgpu::Buffer,
    /// `layout::Flags`.
    pub flags: wgpu::Buffer,
    /// Planes of what arrives.
    pub signal: wgpu::Buffer,
    /// Poisson(N) − N.
    pub deviates: wgpu::Buffer,
    /// The device's clock.
    pub times: Option<PassTimes>,
    back: wgpu::Buffer,
    parts: Parts,
}

fn buffer(gpu: &Gpu, label: &str, words: usize, usage: wgpu::BufferUsages) -> wgpu::Buffer {
    let size = words.max(4) as u64 * 4;
    gpu.device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false })
}

impl Workspace {
    /// Makes room.
    ///
    /// # Errors
    /// When the image does not fit the device.
    pub fn new(gpu: &Gpu, needs: Needs) -> Result<Self, GpuError> {
        let limit = gpu.device.limits().max_storage_buffer_binding_size;
        for (what, needed) in [("the image", needs.pixels * needs.materials.max(4) * 4), ("a mesh", needs.corners * 16)] {
            let needed = needed as u64;
            if needed > limit {
                return Err(GpuError::Limit { adapter: gpu.adapter.clone(), what, needed, limit });
            }
        }
        let times = PassTimes::new(gpu);
        let parts = Parts::of(&needs, times.as_ref().map_or(0, PassTimes::words));
        let given = wgpu::BufferUsages::COPY_DST;
        let storage = wgpu::BufferUsages::STORAGE;
        let found = storage | wgpu::BufferUsages::COPY_SRC;
        let words = |part: [usize; 2]| part[1] - part[0];
        let whole = |name, words| buffer(gpu, name, words, storage | given);
        Ok(Self {
            needs,
            view: buffer(gpu, "view", size_of::<layout::View>() / 4, wgpu::BufferUsages::UNIFORM | given),
            grid: buffer(gpu, "grid", size_of::<layout::Grid>() / 4, wgpu::BufferUsages::UNIFORM | given),
            solids: whole("solids", needs.solids.max(1) * size_of::<layout::Solid>() / 4),
            nodes: whole("nodes", needs.nodes.max(1) * size_of::<layout::Node>() / 4),
            corners: whole("corners", needs.corners.max(1) * 4),
            weights: whole("weights", needs.energies.max(1) * size_of::<layout::Bin>() / 4),
            table: whole("attenuation", needs.energies * needs.materials),
            density: buffer(gpu, "area densities", needs.pixels * needs.materials, found),
            invalid: buffer(gpu, "invalid", words(parts.invalid), found | given),
            flags: buffer(gpu, "flags", words(parts.flags), found | given),
            signal: buffer(gpu, "signal", words(parts.signal), found),
            deviates: buffer(gpu, "deviates", words(parts.deviates), found),
            back: buffer(gpu, "read back", parts.words(), wgpu::BufferUsages::MAP_READ | given),
            times,
            parts,
        })
    }

    /// Whether a view with `needs` can use this; shapes and energies may be fewer.
    #[must_use]
    pub fn serves(&self, needs: &Needs) -> bool {
        let Needs { solids, nodes, corners, energies, .. } = *needs;
        let own = Needs { solids, nodes, corners, energies, ..self.needs };
        let has_energies = |needs: &Needs| needs.energies > 0;
        own == *needs
            && solids <= self.needs.solids
            && nodes <= self.needs.nodes
            && corners <= self.needs.corners
            && energies <= self.needs.energies
            && has_energies(needs) == has_energies(&self.needs)
    }

    /// Bytes that come back of every view.
    #[must_use]
    pub fn read_back_bytes(&self) -> u64 {
        self.parts.words() as u64 * 4
    }

    /// Copies what was asked for to where it can be read.
    pub fn bring_back(&self, commands: &mut wgpu::CommandEncoder) {
        let parts = &self.parts;
        let mut copy = |from: &wgpu::Buffer, [begin, end]: [usize; 2]| {
            if end > begin {
                commands.copy_buffer_to_buffer(from, 0, &self.back, begin as u64 * 4, (end - begin) as u64 * 4);
            }
        };
        copy(&self.flags, parts.flags);
        copy(&self.invalid, parts.invalid);
        copy(&self.signal, parts.signal);
        copy(&self.deviates, parts.deviates);
        copy(&self.density, parts.paths);
        if let Some(times) = &self.times {
            let resolved = times.resolve(commands);
            commands.copy_buffer_to_buffer(resolved, 0, &self.back, parts.times[0] as u64 * 4, times.words() as u64 * 4);
        }
    }

    /// What [`Workspace::bring_back`] copied; the device must be done with it.
    ///
    /// # Errors
    /// When the device is lost.
    pub fn words(&self, gpu: &Gpu) -> Result<(Vec<f32>, Parts), GpuError> {
        let words = mapped(gpu, &self.back)?;
        Ok((words, self.parts))
    }

    /// Asks for the words.
    pub fn map(&self, done: impl FnOnce(Result<(), wgpu::BufferAsyncError>) + Send + 'static) {
        self.back.map_async(wgpu::MapMode::Read, .., done);
    }

    /// Reads the area densities of the last view.
    ///
    /// # Errors
    /// When the device is lost.
    pub fn paths(&self, gpu: &Gpu) -> Result<Vec<f32>, GpuError> {
        let words = self.needs.pixels * self.needs.materials;
        let to = buffer(gpu, "area densities, read back", words, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
        let mut commands = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("paths") });
        commands.copy_buffer_to_buffer(&self.density, 0, &to, 0, words as u64 * 4);
        gpu.queue.submit([commands.finish()]);
        let (sender, receiver) = std::sync::mpsc::channel();
        to.map_async(wgpu::MapMode::Read, .., move |result| drop(sender.send(result)));
        wait(gpu, &receiver, 1)?;
        let mut paths = mapped(gpu, &to)?;
        paths.truncate(words);
        Ok(paths)
    }
}

fn mapped(gpu: &Gpu, buffer: &wgpu::Buffer) -> Result<Vec<f32>, GpuError> {
    let view = buffer
        .get_mapped_range(..)
        .map_err(|error| GpuError::Lost { adapter: gpu.adapter.clone(), detail: error.to_string() })?;
    let words = bytemuck::pod_collect_to_vec(&view[..]);
    drop(view);
    buffer.unmap();
    Ok(words)
}

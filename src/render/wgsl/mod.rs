//! The GPU executor: dispatches `shaders/*.wgsl`; volumes stay resident between images.

pub mod layout;
mod pass_times;
mod resident;
mod sources;

use std::sync::Arc;

use wgpu::util::DeviceExt;

pub use sources::{STEMS, source};

use self::pass_times::PassTimes;
use self::resident::Resident;
use super::cpu::attenuate_spectrum::{Arriving, Signal};
use super::cpu::integrate_density::Density;
use super::prepared::{Prepared, Step};
use super::spectrum::Bins;
use crate::gpu::{Gpu, GpuError};
use crate::scene::model::{Matter, Scene, Volume};

/// Materials that a ray can accumulate.
const MATERIALS: usize = 8;

/// Why this scene needs the CPU executor; `None` when the shaders can do it.
#[must_use]
pub fn unsupported(scene: &Scene) -> Option<String> {
    let volumes = scene.objects.iter().filter(|object| matches!(object.matter, Matter::Volume(_))).count();
    if scene.objects.iter().any(|object| matches!(object.matter, Matter::Mesh(_))) {
        return Some("meshes have no shader yet".to_owned());
    }
    if volumes > 1 {
        return Some(format!("{volumes} volumes, the shader takes one"));
    }
    if scene.materials.len() > MATERIALS {
        return Some(format!("{} materials, the shader takes {MATERIALS}", scene.materials.len()));
    }
    (0..scene.materials.len()).any(|material| scene.is_air(material)).then(|| "kept air has no shader yet".to_owned())
}

/// What the shaders gave back.
#[derive(Debug)]
pub struct Executed {
    /// Area densities and validity.
    pub density: Density,
    /// What arrives; empty without a spectrum.
    pub signal: Signal,
    /// Poisson(N) − N; empty without noise.
    pub deviates: Vec<f32>,
    /// Milliseconds by pass, by the device's clock; empty where it has none.
    pub pass_ms: Vec<(&'static str, f64)>,
    /// Rays on which intervals did not fit; their pixels are wrong, render on the CPU.
    pub overflows: u32,
}

/// Noise to draw.
#[derive(Clone, Copy, Debug)]
pub struct NoiseKey {
    /// Seed.
    pub seed: u64,
    /// Frame.
    pub frame: u32,
    /// N₀.
    pub photons_per_pixel: f64,
}

/// Pipelines and resident volumes of one device.
#[derive(Debug)]
pub struct WgslExecutor {
    integrate: wgpu::ComputePipeline,
    attenuate: wgpu::ComputePipeline,
    noise: wgpu::ComputePipeline,
    resident: Option<(Arc<Volume>, Resident)>,
    nothing: Resident,
}

impl WgslExecutor {
    /// Compiles the shaders.
    ///
    /// # Errors
    /// When the driver refuses one.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let pipeline = |stem: &str| {
            let text = source(stem).expect("every stem is embedded");
            let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(stem),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            });
            gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(stem),
                layout: None,
                module: &module,
                entry_point: Some("main"),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                cache: None,
            })
        };
        let [integrate, attenuate, noise] = STEMS.map(pipeline);
        if let Some(error) = pollster::block_on(scope.pop()) {
            return Err(GpuError::Open { adapter: gpu.adapter.clone(), detail: error.to_string() });
        }
        let nothing = Resident::nothing(gpu)?;
        Ok(Self { integrate, attenuate, noise, resident: None, nothing })
    }

    /// Renders area densities, and from them signal and noise where asked.
    ///
    /// # Errors
    /// When the volume or the image does not fit the device, or the device is lost.
    pub fn execute(
        &mut self,
        gpu: &Gpu,
        prepared: &Prepared,
        bins: Option<&Bins>,
        noise: Option<NoiseKey>,
    ) -> Result<Executed, GpuError> {
        self.upload(gpu, prepared)?;
        let packed = layout::pack(prepared);
        let pixels = prepared.view.size_px.iter().map(|n| *n as usize).product::<usize>();
        let materials = prepared.material_count;
        let limit = gpu.device.limits().max_storage_buffer_binding_size;
        let needed = (pixels * materials.max(4) * 4) as u64;
        if needed > limit {
            return Err(GpuError::Limit { adapter: gpu.adapter.clone(), what: "the image", needed, limit });
        }
        let mut view = packed.view;
        if let Some(bins) = bins {
            view.bin_count = bins.padded as u32;
            view.mean_response = bins.mean_response as f32;
            view.mean_square_response = bins.mean_square_response as f32;
        }
        if let Some(key) = noise {
            view.seed = [key.seed as u32, (key.seed >> 32) as u32];
            view.frame = key.frame;
            view.photons_per_pixel = key.photons_per_pixel as f32;
        }
        let uniform = |bytes: &[u8]| init(gpu, bytes, wgpu::BufferUsages::UNIFORM);
        let storage = |bytes: &[u8]| init(gpu, bytes, wgpu::BufferUsages::STORAGE);
        let resident = self.resident.as_ref().map_or(&self.nothing, |(_, resident)| resident);
        let view_buffer = uniform(bytemuck::bytes_of(&view));
        let density = output(gpu, pixels * materials.max(1));
        let missing = output(gpu, pixels);
        let overflows = init(gpu, &[0; 4], wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC);
        let solids = if packed.solids.is_empty() { vec![layout::Solid::default()] } else { packed.solids };
        let mut commands = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("render") });
        let solid_buffer = storage(bytemuck::cast_slice(&solids));
        let grid_buffer = uniform(bytemuck::bytes_of(&packed.grid));
        let bindings = [
            view_buffer.as_entire_binding(),
            solid_buffer.as_entire_binding(),
            grid_buffer.as_entire_binding(),
            resident.material_of_kind.as_entire_binding(),
            wgpu::BindingResource::TextureView(&resident.density),
            wgpu::BindingResource::TextureView(&resident.material),
            wgpu::BindingResource::TextureView(&resident.cells),
            density.as_entire_binding(),
            missing.as_entire_binding(),
            overflows.as_entire_binding(),
        ];
        let [width, height] = prepared.view.size_px;
        let mut times = PassTimes::new(gpu);
        let mut run = |commands: &mut wgpu::CommandEncoder, stem, pipeline, bindings: &[wgpu::BindingResource], groups| {
            let writes = times.as_mut().and_then(|times| times.next(stem));
            dispatch(gpu, commands, pipeline, bindings, groups, writes);
        };
        run(&mut commands, "integrate_density", &self.integrate, &bindings, [width.div_ceil(8), height.div_ceil(8)]);
        let flat = flat_groups(pixels);
        let mut downloads = vec![download(gpu, &mut commands, &density), download(gpu, &mut commands, &missing)];
        downloads.push(download(gpu, &mut commands, &overflows));
        if let Some(bins) = bins {
            let signal = output(gpu, pixels * 4);
            let weight = |b: usize| layout::Bin {
                signal: bins.signal_weight[b],
                photons: bins.photon_weight[b],
                squares: bins.square_weight[b],
                padding: 0.0,
            };
            let weights: Vec<layout::Bin> = (0..bins.padded).map(weight).collect();
            let weights = storage(bytemuck::cast_slice(&weights));
            let table = if bins.cm2_per_g.is_empty() { storage(&[0; 4]) } else { storage(bytemuck::cast_slice(&bins.cm2_per_g)) };
            let bindings = [&view_buffer, &weights, &table, &density, &signal].map(wgpu::Buffer::as_entire_binding);
            run(&mut commands, "attenuate_spectrum", &self.attenuate, &bindings, flat);
            downloads.push(download(gpu, &mut commands, &signal));
            if noise.is_some() {
                let deviates = output(gpu, pixels);
                let bindings = [&view_buffer, &signal, &deviates].map(wgpu::Buffer::as_entire_binding);
                run(&mut commands, "add_noise", &self.noise, &bindings, flat);
                downloads.push(download(gpu, &mut commands, &deviates));
            }
        }
        if let Some(times) = &times {
            let resolved = times.resolve(&mut commands);
            downloads.push(download(gpu, &mut commands, resolved));
        }
        gpu.queue.submit([commands.finish()]);
        let mut words = read_back(gpu, &downloads)?;
        let pass_ms = times.map(|times| times.ms(&words.pop().unwrap_or_default())).unwrap_or_default();
        Ok(Executed { pass_ms, ..unpack(words, materials, pixels) })
    }

    fn upload(&mut self, gpu: &Gpu, prepared: &Prepared) -> Result<(), GpuError> {
        debug_assert!(prepared.steps.iter().all(|step| !matches!(step, Step::Mesh(_) | Step::VolumeAir(_))));
        let Some(seen) = prepared.volumes.first() else {
            self.resident = None;
            return Ok(());
        };
        if !self.resident.as_ref().is_some_and(|(held, _)| Arc::ptr_eq(held, seen.volume)) {
            self.resident = None;
            self.resident = Some((seen.volume.clone(), Resident::upload(gpu, seen)?));
        }
        Ok(())
    }
}

fn unpack(mut words: Vec<Vec<f32>>, materials: usize, pixels: usize) -> Executed {
    let mut next = || if words.is_empty() { Vec::new() } else { words.remove(0) };
    let (mut g_per_cm2, missing, overflows) = (next(), next(), next());
    g_per_cm2.truncate(materials * pixels);
    let density = Density {
        material_count: materials,
        g_per_cm2,
        valid: missing.iter().map(|mm| u8::from(*mm < 0.0)).collect(),
        unscanned_mm: missing.iter().copied().fold(0.0, f32::max),
    };
    let signal = next();
    let (values, _) = signal.as_chunks::<4>();
    let arriving = |v: &[f32; 4]| Arriving { photon_fraction: v[1], mean_response: v[2], mean_square_response: v[3] };
    let signal = Signal { line_integral: values.iter().map(|v| v[0]).collect(), arriving: values.iter().map(arriving).collect() };
    Executed {
        density,
        signal,
        deviates: next(),
        pass_ms: Vec::new(),
        overflows: overflows.first().map_or(0, |word| word.to_bits()),
    }
}

/// Groups of 64 in two dimensions: 65535 in one would end at 4 million pixels.
fn flat_groups(pixels: usize) -> [u32; 2] {
    let groups = pixels.div_ceil(64) as u32;
    let rows = groups.div_ceil(32_768);
    [groups.div_ceil(rows.max(1)), rows.max(1)]
}

fn init(gpu: &Gpu, contents: &[u8], usage: wgpu::BufferUsages) -> wgpu::Buffer {
    gpu.device.create_buffer_init(&wgpu::util::BufferInitDescriptor { label: None, contents, usage })
}

fn output(gpu: &Gpu, words: usize) -> wgpu::Buffer {
    gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: words as u64 * 4,
        usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    })
}

fn download(gpu: &Gpu, commands: &mut wgpu::CommandEncoder, from: &wgpu::Buffer) -> wgpu::Buffer {
    let to = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: from.size(),
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    commands.copy_buffer_to_buffer(from, 0, &to, 0, from.size());
    to
}

fn dispatch(
    gpu: &Gpu,
    commands: &mut wgpu::CommandEncoder,
    pipeline: &wgpu::ComputePipeline,
    bindings: &[wgpu::BindingResource],
    groups: [u32; 2],
    timestamp_writes: Option<wgpu::ComputePassTimestampWrites>,
) {
    let entries: Vec<wgpu::BindGroupEntry> = bindings
        .iter()
        .enumerate()
        .map(|(binding, resource)| wgpu::BindGroupEntry { binding: binding as u32, resource: resource.clone() })
        .collect();
    let layout = pipeline.get_bind_group_layout(0);
    let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout: &layout, entries: &entries });
    let mut pass = commands.begin_compute_pass(&wgpu::ComputePassDescriptor { label: None, timestamp_writes });
    pass.set_pipeline(pipeline);
    pass.set_bind_group(0, &group, &[]);
    pass.dispatch_workgroups(groups[0], groups[1], 1);
}

fn read_back(gpu: &Gpu, buffers: &[wgpu::Buffer]) -> Result<Vec<Vec<f32>>, GpuError> {
    let lost = |detail: String| GpuError::Lost { adapter: gpu.adapter.clone(), detail };
    let (sender, mapped) = std::sync::mpsc::channel();
    for buffer in buffers {
        let sender = sender.clone();
        buffer.map_async(wgpu::MapMode::Read, .., move |result| {
            let _ = sender.send(result);
        });
    }
    gpu.device.poll(wgpu::PollType::wait_indefinitely()).map_err(|error| lost(error.to_string()))?;
    for _ in buffers {
        let result = mapped.recv().map_err(|_| lost("the device gave no answer".to_owned()))?;
        result.map_err(|error| lost(error.to_string()))?;
    }
    let read = |buffer: &wgpu::Buffer| {
        let view = buffer.get_mapped_range(..).map_err(|error| lost(error.to_string()))?;
        Ok(bytemuck::pod_collect_to_vec(&view[..]))
    };
    buffers.iter().map(read).collect()
}

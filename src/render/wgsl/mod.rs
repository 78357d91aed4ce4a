//! The GPU executor: dispatches `shaders/*.wgsl`; volumes stay resident between images.

pub mod layout;
mod pass_times;
mod pipelines;
mod request;
mod resident;
mod workspace;

use std::ops::Range;
use std::sync::Arc;

pub use request::{NoiseKey, Request};

use self::pipelines::Pipelines;
use self::resident::Resident;
use self::workspace::{Needs, Workspace};
use super::cells::BRICK;
use super::cpu::attenuate_spectrum::{Arriving, Signal};
use super::prepared::{Prepared, Step};
use crate::gpu::{Gpu, GpuError, dispatch, finish, flat_groups, wait};
use crate::scene::model::{Matter, Scene, Volume};

/// Materials that a ray can accumulate.
const MATERIALS: usize = 8;

/// Why this scene needs the CPU executor; `None` when the shaders can do it.
#[must_use]
pub fn unsupported(scene: &Scene) -> Option<String> {
    let volumes = scene.objects.iter().filter(|object| !object.matter.volumes().is_empty()).count();
    if volumes > 1 {
        return Some(format!("{volumes} volumes, the shader takes one"));
    }
    // Parts are crossed one after the other: each would take off anew what they displace together.
    if scene.objects.iter().position(|object| matches!(object.matter, Matter::Parts(_))).is_some_and(|first| first > 0) {
        return Some("a CT with moved bodies displaces objects before it".to_owned());
    }
    if scene.materials.len() > MATERIALS {
        return Some(format!("{} materials, the shader takes {MATERIALS}", scene.materials.len()));
    }
    (0..scene.materials.len()).any(|material| scene.is_air(material)).then(|| "kept air has no shader yet".to_owned())
}

/// What the shaders gave back.
#[derive(Debug)]
pub struct Executed {
    /// g/cm², by pixel, then by material; empty unless they were asked for.
    pub g_per_cm2: Vec<f32>,
    /// 1 where the scan was complete along the ray.
    pub valid: Vec<u8>,
    /// Whether any ray met matter.
    pub matter: bool,
    /// Whether any path is longer than those that the energies were fitted to, or no number.
    pub beyond: bool,
    /// What arrives; empty without a spectrum, moments only with noise.
    pub signal: Signal,
    /// Poisson(N) − N; empty without noise.
    pub deviates: Vec<f32>,
    /// Milliseconds by pass, by the device's clock; empty where it has none.
    pub pass_ms: Vec<(&'static str, f64)>,
    /// Rays on which intervals did not fit; their pixels are wrong, render on the CPU.
    pub overflows: u32,
    /// Bytes that came back.
    pub read_back_bytes: u64,
}

/// Pipelines and resident volumes of one device.
#[derive(Debug)]
pub struct WgslExecutor {
    pipelines: Pipelines,
    /// Every volume of the scene in order, or the part of one that is being crossed.
    resident: Vec<(Arc<Volume>, Resident)>,
    nothing: Resident,
    workspaces: Vec<Workspace>,
    /// Bytes that a volume may take on the device.
    room_bytes: u64,
}

/// Views that are submitted together.
pub const VIEWS_PER_SUBMISSION: usize = 8;

impl WgslExecutor {
    /// Compiles the shaders.
    ///
    /// # Errors
    /// When the driver refuses one.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let pipelines = Pipelines::new(gpu)?;
        let nothing = Resident::nothing(gpu)?;
        Ok(Self { pipelines, resident: Vec::new(), nothing, workspaces: Vec::new(), room_bytes: u64::MAX })
    }

    /// Leaves a volume no more than `bytes` of the device's memory; what is larger is crossed part by part, uploaded for every view.
    pub fn limit_memory(&mut self, bytes: u64) {
        self.room_bytes = bytes;
        self.resident.clear();
    }

    /// Renders views of one scene, at most [`VIEWS_PER_SUBMISSION`]: in one submission, unless the volume does not fit the device.
    ///
    /// # Errors
    /// When a slice of the volume or an image does not fit the device, or the device is lost.
    pub fn execute(&mut self, gpu: &Gpu, requests: &[Request]) -> Result<Vec<Executed>, GpuError> {
        let requests = &requests[..requests.len().min(VIEWS_PER_SUBMISSION)];
        let Some(first) = requests.first() else { return Ok(Vec::new()) };
        let parts = self.upload(gpu, first.prepared)?;
        let mut commands = encoder(gpu);
        for (slot, request) in requests.iter().enumerate() {
            let packed = layout::pack(request.prepared);
            let needs = Needs::of(request, &packed);
            if !self.workspaces.get(slot).is_some_and(|workspace| workspace.serves(&needs)) {
                self.workspaces.truncate(slot);
                self.workspaces.push(Workspace::new(gpu, needs)?);
            }
            write(gpu, &self.workspaces[slot], request, packed, &needs);
            self.begin(&mut commands, slot);
            for (index, (volume, part)) in parts.iter().enumerate() {
                let seen = &request.prepared.volumes[*volume];
                self.resident.clear();
                self.resident.push((seen.volume.clone(), Resident::upload(gpu, seen, part)?));
                let grid = layout::Grid {
                    cells_from: part.start as u32,
                    cells_to: part.end as u32,
                    voxels_from: resident::voxels_of(part, seen.volume.size[2]).start as u32,
                    adds: u32::from(index > 0),
                    ..layout::grid_of(request.prepared, *volume)
                };
                self.cross(gpu, &mut commands, slot, request, (0, grid))?;
                // The next part takes this one's room.
                finish(gpu)?;
            }
            if !parts.is_empty() {
                self.resident.clear();
            } else if self.resident.len() > 1 {
                for volume in 0..self.resident.len() {
                    let grid = layout::Grid { adds: u32::from(volume > 0), ..layout::grid_of(request.prepared, volume) };
                    self.cross(gpu, &mut commands, slot, request, (volume, grid))?;
                }
            } else {
                self.integrate(gpu, &mut commands, slot, request, 0)?;
            }
            self.attenuate(gpu, &mut commands, slot, &needs);
        }
        gpu.queue.submit([commands.finish()]);
        let workspaces = &self.workspaces[..requests.len()];
        let (sender, mapped) = std::sync::mpsc::channel();
        for workspace in workspaces {
            let sender = sender.clone();
            workspace.map(move |result| drop(sender.send(result)));
        }
        wait(gpu, &mapped, workspaces.len())?;
        let executed = workspaces.iter().zip(requests).map(|(workspace, request)| unpack(gpu, workspace, request));
        executed.collect()
    }

    /// Area densities of view `slot` of the last submission, g/cm² by pixel, then by material.
    ///
    /// # Errors
    /// When the device is lost.
    pub fn paths(&self, gpu: &Gpu, slot: usize) -> Result<Vec<f32>, GpuError> {
        self.workspaces.get(slot).map_or_else(|| Ok(Vec::new()), |workspace| workspace.paths(gpu))
    }

    fn begin(&mut self, commands: &mut wgpu::CommandEncoder, slot: usize) {
        let workspace = &mut self.workspaces[slot];
        commands.clear_buffer(&workspace.flags, 0, None);
        commands.clear_buffer(&workspace.invalid, 0, None);
        if let Some(times) = &mut workspace.times {
            times.begin();
        }
    }

    /// Submits what there is and one resident volume more, described by its `grid`.
    fn cross(
        &mut self,
        gpu: &Gpu,
        commands: &mut wgpu::CommandEncoder,
        slot: usize,
        request: &Request,
        (volume, grid): (usize, layout::Grid),
    ) -> Result<(), GpuError> {
        gpu.queue.write_buffer(&self.workspaces[slot].grid, 0, bytemuck::bytes_of(&grid));
        self.integrate(gpu, commands, slot, request, volume)?;
        gpu.queue.submit([std::mem::replace(commands, encoder(gpu)).finish()]);
        Ok(())
    }

    fn integrate(
        &mut self,
        gpu: &Gpu,
        commands: &mut wgpu::CommandEncoder,
        slot: usize,
        request: &Request,
        volume: usize,
    ) -> Result<(), GpuError> {
        let meshes = request.prepared.steps.iter().any(|step| matches!(step, Step::Mesh(_)));
        let resident = self.resident.get(volume).map_or(&self.nothing, |(_, resident)| resident);
        let workspace = &mut self.workspaces[slot];
        let texture = wgpu::BindingResource::TextureView;
        let bindings = [
            workspace.view.as_entire_binding(),
            workspace.solids.as_entire_binding(),
            workspace.grid.as_entire_binding(),
            resident.material_of_kind.as_entire_binding(),
            texture(&resident.density),
            texture(&resident.material),
            texture(&resident.cells),
            workspace.density.as_entire_binding(),
            workspace.invalid.as_entire_binding(),
            workspace.flags.as_entire_binding(),
            workspace.nodes.as_entire_binding(),
            workspace.corners.as_entire_binding(),
        ];
        let tiles = request.prepared.view.size_px.map(|n| n.div_ceil(8));
        let writes = workspace.times.as_mut().and_then(|times| times.next("integrate_density"));
        dispatch(gpu, commands, self.pipelines.integrate(gpu, meshes)?, &bindings, tiles, writes);
        Ok(())
    }

    /// Everything after the rays.
    fn attenuate(&mut self, gpu: &Gpu, commands: &mut wgpu::CommandEncoder, slot: usize, needs: &Needs) {
        let workspace = &mut self.workspaces[slot];
        let flat = flat_groups(needs.pixels);
        if needs.energies > 0 {
            let buffers = [&workspace.view, &workspace.weights, &workspace.table, &workspace.density, &workspace.signal];
            let writes = workspace.times.as_mut().and_then(|times| times.next("attenuate_spectrum"));
            dispatch(gpu, commands, &self.pipelines.attenuate, &buffers.map(wgpu::Buffer::as_entire_binding), flat, writes);
        }
        if needs.noise {
            let buffers = [&workspace.view, &workspace.signal, &workspace.deviates];
            let writes = workspace.times.as_mut().and_then(|times| times.next("add_noise"));
            dispatch(gpu, commands, &self.pipelines.noise, &buffers.map(wgpu::Buffer::as_entire_binding), flat, writes);
        }
        workspace.bring_back(commands);
    }

    /// Makes the volumes resident; where they do not fit the device, says in which parts of each they do.
    fn upload(&mut self, gpu: &Gpu, prepared: &Prepared) -> Result<Vec<(usize, Range<usize>)>, GpuError> {
        debug_assert!(prepared.steps.iter().all(|step| !matches!(step, Step::VolumeAir(_))));
        let volumes = &prepared.volumes;
        let held = self.resident.len() == volumes.len()
            && self.resident.iter().zip(volumes).all(|((held, _), seen)| Arc::ptr_eq(held, seen.volume));
        if held {
            return Ok(Vec::new());
        }
        self.resident.clear();
        let longest = gpu.device.limits().max_texture_dimension_3d as usize;
        let parts: Vec<Vec<Range<usize>>> =
            volumes.iter().map(|seen| resident::parts(seen.volume.size, self.room_bytes, longest)).collect();
        if parts.iter().any(|parts| parts.len() > 1) {
            let numbered = parts.into_iter().enumerate();
            return Ok(numbered.flat_map(|(volume, parts)| parts.into_iter().map(move |part| (volume, part))).collect());
        }
        for (seen, part) in volumes.iter().zip(parts.iter().flatten()) {
            match Resident::upload(gpu, seen, part) {
                Ok(resident) => self.resident.push((seen.volume.clone(), resident)),
                Err(GpuError::Memory { needed_mib, .. }) if needed_mib > 1 && seen.volume.size[2] > BRICK => {
                    // Half of what did not fit, and half again until it does.
                    self.room_bytes = (needed_mib << 20) / 2;
                    return self.upload(gpu, prepared);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(Vec::new())
    }
}

/// Writes what changes from view to view.
fn write(gpu: &Gpu, workspace: &Workspace, request: &Request, packed: layout::Packed, needs: &Needs) {
    let mut view = packed.view;
    view.fitted_up_to = [[f32::MAX; 4]; 2];
    for (material, up_to) in request.fitted_up_to.iter().enumerate().take(MATERIALS) {
        view.fitted_up_to[material / 4][material % 4] = *up_to as f32;
    }
    let put = |buffer: &wgpu::Buffer, bytes: &[u8]| gpu.queue.write_buffer(buffer, 0, bytes);
    if let Some(bins) = request.bins {
        view.bin_count = bins.padded as u32;
        view.mean_response = bins.mean_response as f32;
        view.mean_square_response = bins.mean_square_response as f32;
        let weight = |b: usize| layout::Bin {
            signal: bins.signal_weight[b],
            photons: bins.photon_weight[b],
            squares: bins.square_weight[b],
            padding: 0.0,
        };
        let weights: Vec<layout::Bin> = (0..bins.padded).map(weight).collect();
        put(&workspace.weights, bytemuck::cast_slice(&weights));
        put(&workspace.table, bytemuck::cast_slice(&bins.cm2_per_g));
    }
    if let Some(key) = request.noise {
        view.seed = [key.seed as u32, (key.seed >> 32) as u32];
        view.frame = key.frame;
        view.photons_per_pixel = key.photons_per_pixel as f32;
    }
    view.moments = u32::from(needs.noise);
    put(&workspace.view, bytemuck::bytes_of(&view));
    put(&workspace.grid, bytemuck::bytes_of(&packed.grid));
    put(&workspace.solids, bytemuck::cast_slice(&packed.solids));
    put(&workspace.nodes, bytemuck::cast_slice(&packed.nodes));
    put(&workspace.corners, bytemuck::cast_slice(&packed.corners));
}

fn unpack(gpu: &Gpu, workspace: &Workspace, request: &Request) -> Result<Executed, GpuError> {
    let (words, parts) = workspace.words(gpu)?;
    let part = |[from, to]: [usize; 2]| &words[from..to];
    let flags: layout::Flags = bytemuck::pod_read_unaligned(bytemuck::cast_slice(part(parts.flags)));
    let pixels = request.prepared.view.size_px.iter().map(|n| *n as usize).product::<usize>();
    let invalid = part(parts.invalid);
    let valid = |pixel: usize| u8::from(invalid[pixel / 32].to_bits() >> (pixel % 32) & 1 == 0);
    let planes: Vec<&[f32]> = part(parts.signal).chunks_exact(pixels.max(1)).collect();
    let arriving = match planes[..] {
        [_, photons, mean, square] => (0..pixels)
            .map(|pixel| Arriving {
                photon_fraction: photons[pixel],
                mean_response: mean[pixel],
                mean_square_response: square[pixel],
            })
            .collect(),
        _ => Vec::new(),
    };
    let line_integral = planes.first().map_or_else(Vec::new, |plane| plane.to_vec());
    Ok(Executed {
        g_per_cm2: part(parts.paths).to_vec(),
        valid: (0..pixels).map(valid).collect(),
        matter: flags.matter != 0,
        beyond: flags.beyond != 0,
        signal: Signal { line_integral, arriving },
        deviates: part(parts.deviates).to_vec(),
        pass_ms: workspace.times.as_ref().map(|times| times.ms(part(parts.times))).unwrap_or_default(),
        overflows: flags.overflows,
        read_back_bytes: workspace.read_back_bytes(),
    })
}

fn encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("render") })
}

//! The shaders, compiled, and how they are dispatched.

use super::sources::source;
use crate::gpu::{Gpu, GpuError};

/// One pipeline a shader; that of the rays twice, as most scenes have no mesh and compile and run faster without.
#[derive(Debug)]
pub struct Pipelines {
    integrate: wgpu::ComputePipeline,
    with_meshes: Option<wgpu::ComputePipeline>,
    /// `attenuate_spectrum`.
    pub attenuate: wgpu::ComputePipeline,
    /// `add_noise`.
    pub noise: wgpu::ComputePipeline,
}

impl Pipelines {
    /// Compiles what every scene needs.
    ///
    /// # Errors
    /// When the driver refuses a shader.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self {
            integrate: compile(gpu, "integrate_density", &[("has_meshes", 0.0)])?,
            with_meshes: None,
            attenuate: compile(gpu, "attenuate_spectrum", &[])?,
            noise: compile(gpu, "add_noise", &[])?,
        })
    }

    /// `integrate_density`, with or without meshes.
    ///
    /// # Errors
    /// When the driver refuses the shader.
    pub fn integrate(&mut self, gpu: &Gpu, meshes: bool) -> Result<&wgpu::ComputePipeline, GpuError> {
        match (meshes, &mut self.with_meshes) {
            (false, _) => Ok(&self.integrate),
            (true, Some(pipeline)) => Ok(pipeline),
            (true, empty) => Ok(empty.insert(compile(gpu, "integrate_density", &[("has_meshes", 1.0)])?)),
        }
    }
}

fn compile(gpu: &Gpu, stem: &str, constants: &[(&str, f64)]) -> Result<wgpu::ComputePipeline, GpuError> {
    let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::Validation);
    let text = source(stem).expect("every stem is embedded");
    let module = gpu
        .device
        .create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(stem), source: wgpu::ShaderSource::Wgsl(text.into()) });
    let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(stem),
        layout: None,
        module: &module,
        entry_point: Some("main"),
        compilation_options: wgpu::PipelineCompilationOptions { constants, ..wgpu::PipelineCompilationOptions::default() },
        cache: None,
    });
    match pollster::block_on(scope.pop()) {
        None => Ok(pipeline),
        Some(error) => Err(GpuError::Open { adapter: gpu.adapter.clone(), detail: error.to_string() }),
    }
}

/// Groups of 64 in two dimensions: 65535 in one would end at 4 million pixels.
#[must_use]
pub fn flat_groups(pixels: usize) -> [u32; 2] {
    let groups = pixels.div_ceil(64) as u32;
    let rows = groups.div_ceil(32_768);
    [groups.div_ceil(rows.max(1)), rows.max(1)]
}

/// Records a pass.
pub fn dispatch(
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

//! Shaders compiled, dispatched and waited for.

use super::shaders::source;
use super::{Gpu, GpuError};

/// The pipeline of shader `stem`, one of [`super::STEMS`], with its override constants.
///
/// # Errors
/// When the driver refuses it.
///
/// # Panics
/// When there is no such shader.
pub fn compile(gpu: &Gpu, stem: &str, constants: &[(&str, f64)]) -> Result<wgpu::ComputePipeline, GpuError> {
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

/// Waits for everything that was submitted.
///
/// # Errors
/// When the device is lost.
pub fn finish(gpu: &Gpu) -> Result<(), GpuError> {
    let lost = |error: wgpu::PollError| GpuError::Lost { adapter: gpu.adapter.clone(), detail: error.to_string() };
    gpu.device.poll(wgpu::PollType::wait_indefinitely()).map(drop).map_err(lost)
}

/// Waits for the device, and for `count` buffers to be mapped.
///
/// # Errors
/// When the device is lost.
pub fn wait(
    gpu: &Gpu,
    mapped: &std::sync::mpsc::Receiver<Result<(), wgpu::BufferAsyncError>>,
    count: usize,
) -> Result<(), GpuError> {
    finish(gpu)?;
    let lost = |detail: String| GpuError::Lost { adapter: gpu.adapter.clone(), detail };
    for _ in 0..count {
        let result = mapped.recv().map_err(|_| lost("the device gave no answer".to_owned()))?;
        result.map_err(|error| lost(error.to_string()))?;
    }
    Ok(())
}

//! Kernels of the tests: functions of the shader alone, on a device.

use wgpu::util::DeviceExt;

use super::QUANTA;
use super::pack;
use super::tests::software;
use crate::gpu::{Gpu, source, wait};

/// One of them.
pub struct Kernel {
    gpu: Box<Gpu>,
    pipeline: wgpu::ComputePipeline,
}

impl Kernel {
    /// Entry point `name` of `text`, which stands after the shader; `None` (said) where there is no software Vulkan.
    pub fn new(name: &str, text: &str) -> Option<Self> {
        let gpu = software()?;
        let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::Validation);
        let text = source("follow_photons").expect("embedded") + text;
        let label = Some(name);
        let text = wgpu::ShaderSource::Wgsl(text.into());
        let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor { label, source: text });
        let constants: Vec<(&str, f64)> = pack::constants().into_iter().chain([("QUANTA", QUANTA)]).collect();
        let compilation_options =
            wgpu::PipelineCompilationOptions { constants: &constants, ..wgpu::PipelineCompilationOptions::default() };
        let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label,
            layout: None,
            module: &module,
            entry_point: label,
            compilation_options,
            cache: None,
        });
        let refused = pollster::block_on(scope.pop()).map(|error| error.to_string());
        assert_eq!(refused, None);
        Some(Self { gpu, pipeline })
    }

    /// What `groups` groups leave in `outputs` (binding and bytes), one after the other. `inputs` and they are those bindings that the kernel
    /// uses, as the shader numbers them.
    pub fn run(&self, inputs: &[(u32, &[u8])], outputs: &[(u32, u64)], groups: u32) -> Vec<u32> {
        use wgpu::BufferUsages as Usage;
        let device = &self.gpu.device;
        let filled = |&(binding, contents): &(u32, &[u8])| {
            let usage = if binding == 0 { Usage::UNIFORM } else { Usage::STORAGE };
            device.create_buffer_init(&wgpu::util::BufferInitDescriptor { label: None, contents, usage })
        };
        let empty =
            |size, usage| device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false });
        let given: Vec<wgpu::Buffer> = inputs.iter().map(filled).collect();
        let left: Vec<wgpu::Buffer> = outputs.iter().map(|(_, bytes)| empty(*bytes, Usage::STORAGE | Usage::COPY_SRC)).collect();
        let read_back = empty(outputs.iter().map(|(_, bytes)| bytes).sum(), Usage::MAP_READ | Usage::COPY_DST);
        let bindings = inputs.iter().map(|(binding, _)| *binding).chain(outputs.iter().map(|(binding, _)| *binding));
        let entries: Vec<wgpu::BindGroupEntry> = bindings
            .zip(given.iter().chain(&left))
            .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let layout = self.pipeline.get_bind_group_layout(0);
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout: &layout, entries: &entries });
        let mut commands = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: None });
        {
            let mut pass = commands.begin_compute_pass(&wgpu::ComputePassDescriptor { label: None, timestamp_writes: None });
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &group, &[]);
            pass.dispatch_workgroups(groups, 1, 1);
        }
        let mut at = 0;
        for buffer in &left {
            commands.copy_buffer_to_buffer(buffer, 0, &read_back, at, buffer.size());
            at += buffer.size();
        }
        self.gpu.queue.submit([commands.finish()]);
        let (sender, receiver) = std::sync::mpsc::channel();
        read_back.slice(..).map_async(wgpu::MapMode::Read, move |result| drop(sender.send(result)));
        wait(&self.gpu, &receiver, 1).expect("runs");
        let bytes = read_back.slice(..).get_mapped_range().expect("mapped");
        bytemuck::cast_slice(&bytes).to_vec()
    }
}

//! The shaders of an image, compiled.

use crate::gpu::{Gpu, GpuError, compile};

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

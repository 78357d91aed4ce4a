//! A volume on the device: densities, materials and cell kinds as 3-D textures.

use wgpu::util::DeviceExt;

use crate::gpu::{Gpu, GpuError};
use crate::render::prepared::SeenVolume;

/// Textures of a volume.
#[derive(Debug)]
pub struct Resident {
    /// g/cm³ per voxel, `r32float`.
    pub density: wgpu::TextureView,
    /// 0, or kind of the voxel, `r8uint`.
    pub material: wgpu::TextureView,
    /// Kind of each cell, `r8uint`.
    pub cells: wgpu::TextureView,
    /// Scene material of each kind.
    pub material_of_kind: wgpu::Buffer,
}

impl Resident {
    /// One empty voxel, for scenes without a volume.
    ///
    /// # Errors
    /// Never in practice: 1×1×1 fits every device.
    pub fn nothing(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::new(gpu, [1; 3], &[0; 4], &[0], &[0; 8], &[0])
    }

    /// Uploads `seen`.
    ///
    /// # Errors
    /// When an edge is longer than the device's textures.
    pub fn upload(gpu: &Gpu, seen: &SeenVolume) -> Result<Self, GpuError> {
        let volume = seen.volume;
        let kind = |class: &u8| if *class == 0 { 0 } else { seen.cells.material_of_class[usize::from(class - 1)] + 1 };
        let materials: Vec<u8> = volume.class.iter().map(kind).collect();
        let mut of_kind = vec![0u32];
        of_kind.extend(seen.cells.materials.iter().map(|material| *material as u32));
        Self::new(gpu, volume.size, bytemuck::cast_slice(&volume.density_g_per_cm3), &materials, &seen.cells.kind, &of_kind)
    }

    fn new(
        gpu: &Gpu,
        size: [usize; 3],
        density: &[u8],
        material: &[u8],
        cells: &[u8],
        of_kind: &[u32],
    ) -> Result<Self, GpuError> {
        let limit = gpu.device.limits().max_texture_dimension_3d;
        let longest = size.iter().max().copied().unwrap_or(0) as u64 + 1;
        if longest > u64::from(limit) {
            return Err(GpuError::Limit {
                adapter: gpu.adapter.clone(),
                what: "a volume's edge",
                needed: longest,
                limit: limit.into(),
            });
        }
        let texture = |size: [usize; 3], format: wgpu::TextureFormat, data: &[u8]| {
            let descriptor = wgpu::TextureDescriptor {
                label: None,
                size: wgpu::Extent3d { width: size[0] as u32, height: size[1] as u32, depth_or_array_layers: size[2] as u32 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D3,
                format,
                usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
                view_formats: &[],
            };
            gpu.device
                .create_texture_with_data(&gpu.queue, &descriptor, wgpu::util::TextureDataOrder::LayerMajor, data)
                .create_view(&wgpu::TextureViewDescriptor::default())
        };
        Ok(Self {
            density: texture(size, wgpu::TextureFormat::R32Float, density),
            material: texture(size, wgpu::TextureFormat::R8Uint, material),
            cells: texture(size.map(|n| n + 1), wgpu::TextureFormat::R8Uint, cells),
            material_of_kind: gpu.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: None,
                contents: bytemuck::cast_slice(of_kind),
                usage: wgpu::BufferUsages::STORAGE,
            }),
        })
    }
}

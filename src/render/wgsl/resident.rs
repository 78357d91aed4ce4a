//! A volume on the device, whole or in parts: densities, materials and cell kinds as 3-D textures.

use std::ops::Range;

use wgpu::util::DeviceExt;

use crate::gpu::{Gpu, GpuError, finish};
use crate::render::cells::BRICK;
use crate::render::prepared::SeenVolume;

/// Bytes that are on their way to the device at a time.
const STAGED_BYTES: usize = 256 << 20;

/// Bytes of a voxel: a density, a material, a cell.
const VOXEL_BYTES: u64 = 6;

/// Textures of the cells between two slices of a volume.
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

/// Voxels that the cells of some slices lie between.
#[must_use]
pub fn voxels_of(cells: &Range<usize>, voxels: usize) -> Range<usize> {
    cells.start.saturating_sub(1)..cells.end.min(voxels)
}

/// Slices of cells of each part of a volume, for a device that has room for `room_bytes`; one part where all fits.
#[must_use]
pub fn parts(size: [usize; 3], room_bytes: u64, longest_edge: usize) -> Vec<Range<usize>> {
    let slice_bytes = (size[0] as u64 + 1) * (size[1] as u64 + 1) * VOXEL_BYTES;
    let slices = size[2] + 1;
    // A slice of voxels more than of cells, at most.
    let fit = usize::try_from(room_bytes / slice_bytes).unwrap_or(usize::MAX).min(longest_edge).saturating_sub(1);
    // Bricks stay whole.
    let step = if fit >= slices { slices } else { (fit / BRICK * BRICK).max(BRICK) };
    (0..slices).step_by(step).map(|from| from..(from + step).min(slices)).collect()
}

impl Resident {
    /// One empty voxel, for scenes without a volume.
    ///
    /// # Errors
    /// Never in practice: 1×1×1 fits every device.
    pub fn nothing(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::new(gpu, [[1; 3], [2; 3]], &[0])
    }

    /// Uploads the cells of some slices of `seen`, and the voxels around them.
    ///
    /// # Errors
    /// When an edge is longer than the device's textures, or there is no room.
    pub fn upload(gpu: &Gpu, seen: &SeenVolume, cells: &Range<usize>) -> Result<Self, GpuError> {
        let volume = seen.volume;
        let [nx, ny, nz] = volume.size;
        let held = voxels_of(cells, nz);
        let voxels = held.start * nx * ny..held.end * nx * ny;
        let kind = |class: &u8| if *class == 0 { 0 } else { seen.cells.material_of_class[usize::from(class - 1)] + 1 };
        let mut of_kind = vec![0u32];
        of_kind.extend(seen.cells.materials.iter().map(|material| *material as u32));
        let resident = Self::new(gpu, [[nx, ny, held.len()], [nx + 1, ny + 1, cells.len()]], &of_kind)?;
        let density = &volume.density_g_per_cm3[voxels.clone()];
        resident.fill(gpu, &resident.density, [nx, ny], density, |density| bytemuck::cast_slice(density).to_vec())?;
        let classes = &volume.class[voxels];
        resident.fill(gpu, &resident.material, [nx, ny], classes, |classes| classes.iter().map(kind).collect())?;
        let slice = (nx + 1) * (ny + 1);
        let kinds = &seen.cells.kind[cells.start * slice..cells.end * slice];
        resident.fill(gpu, &resident.cells, [nx + 1, ny + 1], kinds, <[u8]>::to_vec)?;
        Ok(resident)
    }

    fn new(gpu: &Gpu, [size, cells_size]: [[usize; 3]; 2], of_kind: &[u32]) -> Result<Self, GpuError> {
        let limit = gpu.device.limits().max_texture_dimension_3d;
        let longest = size.iter().chain(&cells_size).max().copied().unwrap_or(0) as u64;
        if longest > u64::from(limit) {
            return Err(GpuError::Limit {
                adapter: gpu.adapter.clone(),
                what: "a volume's edge",
                needed: longest,
                limit: limit.into(),
            });
        }
        let texture = |size: [usize; 3], format: wgpu::TextureFormat| {
            gpu.device.create_texture(&wgpu::TextureDescriptor {
                label: None,
                size: wgpu::Extent3d { width: size[0] as u32, height: size[1] as u32, depth_or_array_layers: size[2] as u32 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D3,
                format,
                usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
                view_formats: &[],
            })
        };
        let seen = |texture: wgpu::Texture| texture.create_view(&wgpu::TextureViewDescriptor::default());
        let scope = gpu.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let resident = Self {
            density: seen(texture(size, wgpu::TextureFormat::R32Float)),
            material: seen(texture(size, wgpu::TextureFormat::R8Uint)),
            cells: seen(texture(cells_size, wgpu::TextureFormat::R8Uint)),
            material_of_kind: gpu.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: None,
                contents: bytemuck::cast_slice(of_kind),
                usage: wgpu::BufferUsages::STORAGE,
            }),
        };
        match pollster::block_on(scope.pop()) {
            None => Ok(resident),
            Some(_) => Err(GpuError::Memory {
                adapter: gpu.adapter.clone(),
                what: "a volume",
                needed_mib: (size.iter().product::<usize>() as u64 * VOXEL_BYTES) >> 20,
            }),
        }
    }

    /// Writes `values`, slices of `columns` × `rows`, a few slices at a time: the whole of a large volume would be staged twice.
    fn fill<T>(
        &self,
        gpu: &Gpu,
        view: &wgpu::TextureView,
        [columns, rows]: [usize; 2],
        values: &[T],
        bytes: impl Fn(&[T]) -> Vec<u8>,
    ) -> Result<(), GpuError> {
        let slice = columns * rows;
        let slices = (STAGED_BYTES / (4 * slice)).max(1);
        let several = values.len() > slices * slice;
        for (index, values) in values.chunks(slices * slice).enumerate() {
            let bytes = bytes(values);
            let into = wgpu::TexelCopyTextureInfo {
                texture: view.texture(),
                mip_level: 0,
                origin: wgpu::Origin3d { x: 0, y: 0, z: (index * slices) as u32 },
                aspect: wgpu::TextureAspect::All,
            };
            let layout = wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some((bytes.len() / values.len() * columns) as u32),
                rows_per_image: Some(rows as u32),
            };
            let depth_or_array_layers = (values.len() / slice) as u32;
            let size = wgpu::Extent3d { width: columns as u32, height: rows as u32, depth_or_array_layers };
            gpu.queue.write_texture(into, &bytes, layout, size);
            if several {
                gpu.queue.submit([]);
                finish(gpu)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_cover_every_cell_once_and_keep_bricks_whole() {
        let size = [100, 90, 133];
        let slice = 101 * 91 * VOXEL_BYTES;
        let one = |room| parts(size, room, 2048).iter().map(Range::len).collect::<Vec<_>>();
        assert_eq!((one(u64::MAX), one(135 * slice)), (vec![134], vec![134]));
        for room in [0, slice, 20 * slice, 60 * slice, 134 * slice] {
            let found = parts(size, room, 2048);
            assert!(found.len() > 1, "{room}");
            assert_eq!((found[0].start, found[found.len() - 1].end), (0, 134));
            assert!(found.windows(2).all(|pair| pair[0].end == pair[1].start && pair[0].end % BRICK == 0));
            let fits = |part: &Range<usize>| (part.len() as u64 + 1) * slice <= room;
            assert!(room < 9 * slice || found.iter().all(fits), "{room}: {found:?}");
        }
        assert_eq!(parts([4, 4, 4000], u64::MAX, 2048).len(), 2);
        assert_eq!((voxels_of(&(0..8), 133), voxels_of(&(128..134), 133)), (0..8, 127..133));
    }
}

//! Scenes, volumes and files for the tests of scene and reference.

use std::path::Path;
use std::sync::Arc;

use glam::{DAffine3, DQuat, DVec3};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::image::cache_file;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Detector, Matter, Object, Shape, Solid, Volume};

use crate::render_scenes::empty;

/// Lets a program that keeps what it knows in `cache` know what renders cost on this machine, where anybody has measured it.
pub fn tell_costs(cache: &Path) {
    let folder = cache.join("sidecarm");
    std::fs::create_dir_all(&folder).expect("a folder");
    for name in ["costs.json", "costs-debug.json"] {
        if let Some(measured) = cache_file(name).filter(|path| path.is_file()) {
            std::fs::copy(measured, folder.join(name)).expect("copied");
        }
    }
}

/// Numbers in [0, 1) that are the same in every run.
pub struct Dice(u64);

impl Dice {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    pub fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    pub fn vector(&mut self, half: f64) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| self.between(-half, half)))
    }

    pub fn rotation(&mut self) -> DQuat {
        let q =
            DQuat::from_xyzw(self.between(-1.0, 1.0), self.between(-1.0, 1.0), self.between(-1.0, 1.0), self.between(0.1, 1.0));
        q.normalize()
    }
}

/// fx 5000 px, pitch 0.2 mm: detector at 1000 mm; the source at `-distance_mm` on the camera's axis.
pub fn view(distance_mm: f64) -> View {
    View {
        size_px: [64, 48],
        intrinsics: Intrinsics { fx: 5000.0, fy: 5000.0, skew: 0.0, cx: 31.5, cy: 23.5 },
        camera_from_lps: Rigid::translation(DVec3::new(0.0, 0.0, distance_mm)),
    }
}

pub fn scene(materials: &[&str], matters: Vec<Matter>) -> Scene {
    let objects = matters
        .into_iter()
        .enumerate()
        .map(|(index, matter)| Object { name: format!("objects[{index}]"), body: "specimen".to_owned(), matter })
        .collect();
    let empty = empty(materials);
    let detector = Detector { pitch_mm: 0.2, crosstalk: vec![vec![1.0]], ..empty.detector };
    Scene { objects, view: None, detector, ..empty }
}

/// One shape of density 1 g/cm³.
pub fn solid(shape: Shape, lps_from_local: Rigid, material: usize) -> Solid {
    Solid { shape, lps_from_local, material, density_g_per_cm3: 1.0 }
}

pub fn ball(centre: DVec3, radius_mm: f64, material: usize) -> Solid {
    solid(Shape::Ellipsoid { semi_axes_mm: DVec3::splat(radius_mm) }, Rigid::translation(centre), material)
}

/// A volume whose voxels are drawn from `dice`: a third nothing, the others of classes 1 and 2 (scene materials 0 and 1).
pub fn random_volume(dice: &mut Dice, size: [usize; 3], lps_from_voxel: DAffine3) -> Volume {
    let count = size.iter().product();
    let class: Vec<u8> = (0..count).map(|_| (dice.unit() * 3.0) as u8).collect();
    let density = class.iter().map(|class| if *class == 0 { 0.0 } else { dice.between(0.3, 2.0) as f32 }).collect();
    Volume {
        size,
        lps_from_voxel,
        density_g_per_cm3: density,
        class,
        class_materials: vec![0, 1],
        truncated_at_faces: false,
        unknown: Vec::new(),
    }
}

pub fn volume(volume: Volume) -> Matter {
    Matter::Volume(Arc::new(volume))
}

/// The definition of DESIGN §5, read off the text: ρ_m at continuous voxel coordinates.
pub fn field(volume: &Volume, voxel: DVec3, materials: usize) -> Vec<f64> {
    let mut sums = vec![0.0; materials];
    let inside = (0..3).all(|axis| voxel[axis] >= -0.5 && voxel[axis] <= volume.size[axis] as f64 - 0.5);
    if !inside {
        return sums;
    }
    let clamped: [f64; 3] = std::array::from_fn(|axis| voxel[axis].clamp(0.0, volume.size[axis] as f64 - 1.0));
    for (index, class) in volume.class.iter().enumerate() {
        let at = [index % volume.size[0], index / volume.size[0] % volume.size[1], index / (volume.size[0] * volume.size[1])];
        // The tent of linear interpolation.
        let weight: f64 = (0..3).map(|axis| (1.0 - (clamped[axis] - at[axis] as f64).abs()).max(0.0)).product();
        if *class > 0 && weight > 0.0 {
            sums[volume.class_materials[usize::from(*class) - 1]] += weight * f64::from(volume.density_g_per_cm3[index]);
        }
    }
    sums
}

/// Whether a point (lps) is in a shape, by its definition.
pub fn contains(solid: &Solid, point: DVec3) -> bool {
    let p = solid.lps_from_local.inverse().transform_point(point);
    match solid.shape {
        Shape::Ellipsoid { semi_axes_mm } => (p / semi_axes_mm).length() <= 1.0,
        Shape::Cuboid { half_size_mm } => (0..3).all(|axis| p[axis].abs() <= half_size_mm[axis]),
        Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } => {
            let across = p.x.hypot(p.y);
            p.z >= 0.0 && p.z <= length_mm && across <= radius_mm && across >= inner_radius_mm
        }
    }
}

/// A NIfTI-1 file as bytes, written from the standard's table of offsets; nothing here uses the reader's library.
#[derive(Clone)]
pub struct NiftiFile {
    pub dim: [i16; 8],
    pub datatype: i16,
    pub pixdim: [f32; 8],
    pub slope_intercept: [f32; 2],
    pub qform: Option<[f32; 6]>,
    pub sform: Option<[[f32; 4]; 3]>,
    pub units: u8,
    pub big_endian: bool,
    pub voxels: Vec<u8>,
}

impl NiftiFile {
    /// Signed 16-bit, 1 mm, RAS sform.
    pub fn int16(size: [i16; 3], values: &[i16]) -> Self {
        Self {
            dim: [3, size[0], size[1], size[2], 1, 1, 1, 1],
            datatype: 4,
            pixdim: [1.0; 8],
            slope_intercept: [1.0, 0.0],
            qform: None,
            sform: Some([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]),
            units: 2,
            big_endian: false,
            voxels: values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        }
    }

    pub fn bytes(&self) -> Vec<u8> {
        let mut header = vec![0u8; 352];
        let order = |bytes: &mut [u8], big: bool| {
            if big {
                bytes.reverse();
            }
        };
        let big = self.big_endian;
        let mut put16 = |at: usize, value: i16| {
            let mut bytes = value.to_le_bytes();
            order(&mut bytes, big);
            header[at..at + 2].copy_from_slice(&bytes);
        };
        self.dim.iter().enumerate().for_each(|(i, n)| put16(40 + 2 * i, *n));
        put16(70, self.datatype);
        put16(252, i16::from(self.qform.is_some()));
        put16(254, i16::from(self.sform.is_some()));
        let mut put32 = |at: usize, bytes: [u8; 4]| {
            let mut bytes = bytes;
            order(&mut bytes, big);
            header[at..at + 4].copy_from_slice(&bytes);
        };
        put32(0, 348i32.to_le_bytes());
        self.pixdim.iter().enumerate().for_each(|(i, x)| put32(76 + 4 * i, x.to_le_bytes()));
        put32(108, 352f32.to_le_bytes());
        put32(112, self.slope_intercept[0].to_le_bytes());
        put32(116, self.slope_intercept[1].to_le_bytes());
        for (i, x) in self.qform.unwrap_or_default().iter().enumerate() {
            put32(256 + 4 * i, x.to_le_bytes());
        }
        for (i, x) in self.sform.unwrap_or_default().iter().flatten().enumerate() {
            put32(280 + 4 * i, x.to_le_bytes());
        }
        header[123] = self.units;
        header[344..348].copy_from_slice(b"n+1\0");
        header.extend_from_slice(&self.voxels);
        header
    }

    pub fn write(&self, path: &Path) {
        let bytes = self.bytes();
        if path.extension().is_some_and(|extension| extension == "gz") {
            let mut zipped = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            std::io::Write::write_all(&mut zipped, &bytes).expect("memory");
            std::fs::write(path, zipped.finish().expect("memory")).expect("temporary folder");
        } else {
            std::fs::write(path, bytes).expect("temporary folder");
        }
    }
}

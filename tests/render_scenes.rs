//! Scenes built in memory, and how images are compared.

use std::sync::Arc;

use glam::{DAffine3, DMat3, DQuat, DVec3};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::gpu::DeviceChoice;
use sidecarm::random::{Purpose, Stream};
use sidecarm::render::{Options, Quantity, Rendered, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Object, Scene, Shape, Solid, Volume};
use sidecarm::scene::physics::{Bin, Material, Spectrum};

/// A camera at the origin of `lps` that looks along +z; 96×96 pixels of 1 mm, detector at 1000 mm.
pub fn view() -> View {
    View {
        size_px: [96, 96],
        intrinsics: Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 47.5, cy: 47.5 },
        camera_from_lps: Rigid::IDENTITY,
    }
}

/// A scene without objects: 60 keV, counting, no noise.
pub fn empty(materials: &[&str]) -> Scene {
    let mut scene = Scene::plain(Spectrum::mono(60.0).expect("inside"));
    scene.materials = materials.iter().map(|name| Material::parse(name).expect("known")).collect();
    scene.view = Some(view());
    scene.beam.photons_per_pixel = 5e5;
    scene.detector.crosstalk = Vec::new();
    scene
}

pub fn spectrum(bins: &[(f64, f64)]) -> Spectrum {
    Spectrum { bins: bins.iter().map(|(energy_kev, fluence)| Bin { energy_kev: *energy_kev, fluence: *fluence }).collect() }
}

pub fn solid(shape: Shape, centre: DVec3, material: usize, density_g_per_cm3: f64) -> Solid {
    Solid { shape, lps_from_local: Rigid::translation(centre), material, density_g_per_cm3 }
}

pub fn sphere(centre: DVec3, radius_mm: f64, material: usize, density: f64) -> Solid {
    solid(Shape::Ellipsoid { semi_axes_mm: DVec3::splat(radius_mm) }, centre, material, density)
}

pub fn cuboid(centre: DVec3, half_size_mm: DVec3, material: usize, density: f64) -> Solid {
    solid(Shape::Cuboid { half_size_mm }, centre, material, density)
}

impl With for Scene {
    fn with(mut self, matter: Matter) -> Self {
        let name = format!("objects[{}]", self.objects.len());
        self.objects.push(Object { name, body: "specimen".to_owned(), matter });
        self
    }
}

/// Adds objects one after the other.
pub trait With {
    fn with(self, matter: Matter) -> Self;
}

pub fn solids(solids: &[Solid]) -> Matter {
    Matter::Solids(solids.to_vec())
}

/// A volume whose voxels `f(i, j, k)` gives as (class, density).
pub fn volume(
    size: [usize; 3],
    lps_from_voxel: DAffine3,
    class_materials: &[usize],
    f: impl Fn([usize; 3]) -> (u8, f32),
) -> Volume {
    let voxels: Vec<(u8, f32)> = (0..size[0] * size[1] * size[2])
        .map(|index| f([index % size[0], index / size[0] % size[1], index / (size[0] * size[1])]))
        .collect();
    Volume {
        size,
        lps_from_voxel,
        density_g_per_cm3: voxels.iter().map(|voxel| voxel.1).collect(),
        class: voxels.iter().map(|voxel| voxel.0).collect(),
        class_materials: class_materials.to_vec(),
        truncated_at_faces: false,
        unknown: Vec::new(),
    }
}

/// Voxels of `spacing_mm` about `centre`, turned, and mirrored when a spacing is negative.
pub fn placed(size: [usize; 3], centre: DVec3, spacing_mm: DVec3, turn: DQuat) -> DAffine3 {
    let matrix = DMat3::from_quat(turn) * DMat3::from_diagonal(spacing_mm);
    let middle = DVec3::from_array(size.map(|n| 0.5 * (n as f64 - 1.0)));
    DAffine3 { matrix3: matrix, translation: centre - matrix * middle }
}

/// A random scene: a lumpy two-material volume, turned, and solids over and inside it.
pub fn random(seed: u64) -> Scene {
    let mut stream = Stream::new(seed, 0, 0, Purpose::Evaluation);
    let mut uniform = |low: f64, high: f64| low + (high - low) * stream.uniform();
    let spread = |uniform: &mut dyn FnMut(f64, f64) -> f64, r: f64| DVec3::new(uniform(-r, r), uniform(-r, r), uniform(-r, r));
    let centre = DVec3::new(0.0, 0.0, 600.0);
    let size = [20, 24, 28].map(|n| n + uniform(0.0, 8.0) as usize);
    let turn = DQuat::from_scaled_axis(spread(&mut uniform, 1.5));
    let mirror = if uniform(0.0, 1.0) < 0.5 { -1.0 } else { 1.0 };
    let spacing = DVec3::new(uniform(0.5, 2.5), uniform(0.5, 2.5) * mirror, uniform(0.5, 2.5));
    let lumps: Vec<DVec3> = (0..4).map(|_| DVec3::new(uniform(0.0, 28.0), uniform(0.0, 28.0), uniform(0.0, 28.0))).collect();
    let grain = Stream::new(seed, 1, 0, Purpose::Evaluation).next_u32() as usize;
    let filled = |[i, j, k]: [usize; 3]| {
        let x = DVec3::new(i as f64, j as f64, k as f64);
        let nearest = lumps.iter().map(|lump| lump.distance(x)).fold(f64::INFINITY, f64::min);
        let wobble = 0.9 + 0.2 * ((i * 31 + j * 17 + k * 7 + grain) % 11) as f32 / 11.0;
        if nearest < 4.0 {
            (2, 1.8 * wobble)
        } else if nearest < 9.0 {
            (1, wobble)
        } else {
            (0, 0.0)
        }
    };
    let voxels = volume(size, placed(size, centre, spacing, turn), &[0, 1], filled);
    let tube = Shape::Cylinder { length_mm: uniform(20.0, 60.0), radius_mm: 3.0, inner_radius_mm: 2.0 };
    let pose = |uniform: &mut dyn FnMut(f64, f64) -> f64| Rigid {
        rotation: DQuat::from_scaled_axis(spread(uniform, 2.0)),
        translation_mm: centre + spread(uniform, 15.0),
    };
    let part = |shape: Shape, material: usize, density: f64, lps_from_local: Rigid| Solid {
        shape,
        lps_from_local,
        material,
        density_g_per_cm3: density,
    };
    let before = part(Shape::Cuboid { half_size_mm: DVec3::new(30.0, 20.0, 25.0) }, 0, 1.0, pose(&mut uniform));
    let robot = [
        part(tube, 2, 6.45, pose(&mut uniform)),
        part(Shape::Cylinder { length_mm: 40.0, radius_mm: 1.0, inner_radius_mm: 0.0 }, 3, 8.0, pose(&mut uniform)),
        part(Shape::Ellipsoid { semi_axes_mm: DVec3::new(2.0, 3.0, 5.0) }, 3, 8.0, pose(&mut uniform)),
    ];
    let mut scene = empty(&["water", "bone_cortical", "nitinol", "steel_316l"])
        .with(solids(&[before]))
        .with(Matter::Volume(Arc::new(voxels)))
        .with(solids(&robot));
    scene.beam.spectrum = Spectrum::tungsten(110.0, 12.0, &[(Material::parse("Al").expect("known"), 3.0)]).expect("inside");
    scene
}

pub fn render_on(device: DeviceChoice, scene: &Scene, quantity: Quantity) -> Rendered {
    let mut renderer = Renderer::new(device, &Reporter::silent()).expect("device");
    renderer.render(scene, &Options { quantity, ..Options::default() }).expect("renders")
}

pub fn line_integral(scene: &Scene) -> sidecarm::image::Image<f32> {
    render_on(DeviceChoice::Cpu, scene, Quantity::LineIntegral).pages.remove(0)
}

/// Software Vulkan, or `None` with the reason printed.
pub fn software_vulkan() -> Option<Renderer> {
    match Renderer::new(DeviceChoice::SoftwareVulkan, &Reporter::silent()) {
        Ok(renderer) => Some(renderer),
        Err(error) => {
            println!("skipped: {error}");
            None
        }
    }
}

/// max |a − b| / max(1, b).
pub fn worst(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    assert!(!a.is_empty());
    let error = |(a, b): (&f32, &f32)| f64::from((a - b).abs()) / f64::from(*b).max(1.0);
    a.iter().zip(b).map(error).fold(0.0, |worst, e| if e.is_nan() { f64::INFINITY } else { worst.max(e) })
}

/// Path length per unit depth through pixel (column, row).
pub fn obliquity(view: &View, column: f64, row: f64) -> f64 {
    view.intrinsics.unproject(glam::DVec2::new(column, row)).length()
}

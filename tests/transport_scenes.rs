//! Scenes, views and statistics for the tests of the Monte Carlo.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::image::Image;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Mesh, Shape, Solid};
use sidecarm::transport::{Estimator, Histories, ScatterImage, scatter};

use crate::scene_support::{Dice, random_volume, scene, volume};

/// A source at the origin of lps looking along +z onto a detector of whole millimetres, one pixel each.
pub fn view(width_mm: u32, height_mm: u32, sdd_mm: f64) -> View {
    let centre = |n: u32| 0.5 * f64::from(n) - 0.5;
    View {
        size_px: [width_mm, height_mm],
        intrinsics: Intrinsics { fx: sdd_mm, fy: sdd_mm, skew: 0.0, cx: centre(width_mm), cy: centre(height_mm) },
        camera_from_lps: Rigid::IDENTITY,
    }
}

pub fn cuboid(centre: [f64; 3], size: [f64; 3], material: usize, density_g_per_cm3: f64) -> Solid {
    let shape = Shape::Cuboid { half_size_mm: 0.5 * DVec3::from_array(size) };
    Solid { shape, lps_from_local: Rigid::translation(DVec3::from_array(centre)), material, density_g_per_cm3 }
}

/// As [`scene`], with pixels of 1 mm.
pub fn scene_of(materials: &[&str], matters: Vec<Matter>) -> Scene {
    let mut scene = scene(materials, matters);
    scene.detector.pitch_mm = 1.0;
    scene
}

/// 20 cm of water from 600 to 800 mm.
pub fn slab() -> Scene {
    scene_of(&["water"], vec![Matter::Solids(vec![cuboid([0.0, 0.0, 700.0], [400.0, 400.0, 200.0], 0, 1.0)])])
}

/// A body of water with a turned CT in it, a steel tube, a titanium mesh and an aluminium ellipsoid that overlap, and kept air around.
pub fn mixed() -> Scene {
    let mut dice = Dice::new(11);
    let turn = DMat3::from_quat(DQuat::from_rotation_y(0.4) * DQuat::from_rotation_x(0.2));
    let lps_from_voxel = DAffine3 { matrix3: turn * 9.0, translation: DVec3::new(-40.0, -30.0, 640.0) };
    let mut ct = random_volume(&mut dice, [9, 7, 8], lps_from_voxel);
    ct.density_g_per_cm3.iter_mut().for_each(|density| *density *= 1.3);
    let tube = Solid {
        shape: Shape::Cylinder { length_mm: 80.0, radius_mm: 6.0, inner_radius_mm: 4.0 },
        lps_from_local: Rigid { rotation: DQuat::from_rotation_x(1.2), translation_mm: DVec3::new(10.0, 30.0, 680.0) },
        material: 2,
        density_g_per_cm3: 8.0,
    };
    let ellipsoid = Solid {
        shape: Shape::Ellipsoid { semi_axes_mm: DVec3::new(25.0, 12.0, 18.0) },
        lps_from_local: Rigid { rotation: DQuat::from_rotation_z(0.7), translation_mm: DVec3::new(-30.0, -20.0, 700.0) },
        material: 3,
        density_g_per_cm3: 2.7,
    };
    let corner = |i: usize| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64) * 2.0 - 1.0;
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let mesh = Mesh {
        vertices_lps_mm: (0..8).map(|i| DVec3::new(35.0, -25.0, 690.0) + DQuat::from_rotation_y(0.5) * corner(i) * 9.0).collect(),
        triangles: quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect(),
        material: 4,
        density_g_per_cm3: 4.5,
    };
    let air = cuboid([0.0, 0.0, 500.0], [300.0, 300.0, 900.0], 5, 0.1);
    scene_of(
        &["water", "bone_cortical", "steel_316l", "aluminium", "titanium", "air"],
        vec![
            Matter::Solids(vec![air]),
            Matter::Solids(vec![cuboid([0.0, 0.0, 690.0], [130.0, 110.0, 100.0], 0, 1.0)]),
            volume(ct),
            Matter::Solids(vec![ellipsoid]),
            Matter::Mesh(std::sync::Arc::new(mesh)),
            Matter::Solids(vec![tube]),
        ],
    )
}

pub fn histories(count: u64, seed: u64, grid_px: [usize; 2], estimator: Estimator) -> Histories {
    Histories { count, seed, grid_px, estimator, rel_error: None }
}

pub fn run(scene: &Scene, view: &View, histories: Histories) -> ScatterImage {
    scatter(scene, view, histories, &mut |_| {}).expect("transports")
}

/// Σ z² and the number of pixels, of differences between two images with independent standard errors.
pub fn z_squared(a: &Image<f64>, a_error: &Image<f64>, b: &Image<f64>, b_error: &Image<f64>) -> (f64, usize) {
    let errors = a_error.pixels.iter().zip(&b_error.pixels).map(|(x, y)| x.hypot(*y));
    let rows = a.pixels.iter().zip(&b.pixels).zip(errors).filter(|(_, error)| *error > 0.0);
    rows.fold((0.0, 0), |(sum, count), ((x, y), error)| (sum + ((x - y) / error).powi(2), count + 1))
}

/// Whether Σ z² of so many pixels is what chance gives: within 5 standard deviations of χ², with 5 % for errors that are estimates.
pub fn is_chance((sum, count): (f64, usize)) -> bool {
    let count = count as f64;
    count > 10.0 && sum < 1.05 * count + 5.0 * (2.0 * count).sqrt()
}

/// Sum over the pixels with its standard error, pixels taken as independent.
pub fn total(image: &Image<f64>, error: &Image<f64>) -> (f64, f64) {
    (image.pixels.iter().sum(), error.pixels.iter().map(|error| error * error).sum::<f64>().sqrt())
}

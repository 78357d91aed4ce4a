//! Scenes for the tests of what is where.

use std::sync::Arc;

use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::stream::Stream;
use crate::geometry::Rigid;
use crate::scene::model::{Matter, Mesh, Object, Scene, Shape, Solid, Volume};
use crate::scene::physics::{Material, Spectrum};

/// A scene of these materials and things.
pub fn scene(materials: &[&str], matters: Vec<Matter>) -> Scene {
    let object = |(n, matter)| Object { name: format!("objects[{n}]"), body: "specimen".to_owned(), matter };
    Scene {
        materials: materials.iter().map(|name| Material::parse(name).expect("known")).collect(),
        objects: matters.into_iter().enumerate().map(object).collect(),
        ..Scene::plain(Spectrum::mono(60.0).expect("inside"))
    }
}

/// A shape turned at random, or straight.
pub fn solid(shape: Shape, centre: DVec3, turn: DVec3, material: usize, density_g_per_cm3: f64) -> Solid {
    let lps_from_local = Rigid { rotation: DQuat::from_scaled_axis(turn), translation_mm: centre };
    Solid { shape, lps_from_local, material, density_g_per_cm3 }
}

/// A box as a mesh, where [`solid`] would have it.
pub fn block(half_size_mm: DVec3, centre: DVec3, turn: DVec3, material: usize, density_g_per_cm3: f64) -> Mesh {
    let corner = |i: usize| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64) * 2.0 - 1.0;
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let turn = DQuat::from_scaled_axis(turn);
    Mesh {
        vertices_lps_mm: (0..8).map(|i| centre + turn * (corner(i) * half_size_mm)).collect(),
        triangles: quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect(),
        material,
        density_g_per_cm3,
    }
}

/// Everything that a scene can hold, on top of each other: kept air, boxes, a CT in two parts, a tube, an ellipsoid, a mesh.
pub fn everything() -> Scene {
    let mut stream = Stream::new(17, 0);
    let mut volume = |size: [usize; 3], turn: DVec3, at: DVec3| {
        let count: usize = size.iter().product();
        let class: Vec<u8> = (0..count).map(|_| [1, 1, 1, 2, 2, 3, 0][(stream.uniform() * 7.0) as usize]).collect();
        let density = |class: &u8| if *class == 0 { 0.0 } else { (0.4 + stream.uniform()) as f32 };
        let density_g_per_cm3 = class.iter().map(density).collect();
        let axes = DMat3::from_quat(DQuat::from_scaled_axis(turn)) * DMat3::from_diagonal(DVec3::new(5.0, -4.0, 6.0));
        Arc::new(Volume {
            size,
            lps_from_voxel: DAffine3 { matrix3: axes, translation: at },
            density_g_per_cm3,
            class,
            class_materials: vec![0, 1, 5],
            truncated_at_faces: false,
            unknown: Vec::new(),
        })
    };
    let parts = vec![
        volume([12, 11, 10], DVec3::new(0.2, 0.1, 0.4), DVec3::new(-30.0, 20.0, -20.0)),
        volume([6, 9, 1], DVec3::ZERO, DVec3::new(-10.0, 20.0, 10.0)),
    ];
    let cube = Shape::Cuboid { half_size_mm: DVec3::new(60.0, 50.0, 40.0) };
    let tube = Shape::Cylinder { length_mm: 60.0, radius_mm: 9.0, inner_radius_mm: 6.0 };
    let ellipsoid = Shape::Ellipsoid { semi_axes_mm: DVec3::new(30.0, 12.0, 18.0) };
    let mesh = block(DVec3::splat(14.0), DVec3::new(20.0, 10.0, 5.0), DVec3::new(0.0, 0.5, 0.0), 4, 4.5);
    scene(
        &["water", "bone_cortical", "steel_316l", "aluminium", "titanium", "air"],
        vec![
            Matter::Solids(vec![solid(cube, DVec3::new(20.0, 0.0, 0.0), DVec3::ZERO, 5, 0.0012)]),
            Matter::Solids(vec![solid(cube, DVec3::new(-20.0, 4.0, 0.0), DVec3::ZERO, 0, 1.0)]),
            Matter::Parts(parts),
            Matter::Solids(vec![
                solid(tube, DVec3::new(0.0, 0.0, -30.0), DVec3::new(0.3, 0.4, 0.0), 2, 8.0),
                solid(ellipsoid, DVec3::new(5.0, -15.0, 0.0), DVec3::new(0.0, 0.5, 1.0), 3, 2.7),
            ]),
            Matter::Mesh(Arc::new(mesh)),
        ],
    )
}

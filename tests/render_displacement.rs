//! Displacement case by case: closed forms along every ray, the reference, the CPU executor, and the shaders where they can.

use std::sync::Arc;

use glam::{DMat3, DQuat, DVec2, DVec3};
use sidecarm::geometry::Rigid;
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::cpu::resample_overlap::overlap_by_resampling;
use sidecarm::render::reference::trace;
use sidecarm::render::{Options, Quantity, Rendered, Renderer, wgsl};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Mesh, Shape, Solid, Volume};

use crate::render_scenes::{With, cuboid, empty, placed, render_on, software_vulkan, solids, sphere, view, volume};

const MATERIALS: [&str; 4] = ["water", "bone_cortical", "nitinol", "steel_316l"];
/// 60 mm of tissue from depth 570 to 630, wider than the view.
const SLAB_MM: f64 = 60.0;
const MIDDLE: DVec3 = DVec3::new(0.0, 0.0, 600.0);

fn slab_volume(class_materials: &[usize], f: impl Fn([usize; 3]) -> (u8, f32)) -> Volume {
    let size = [10, 10, 30];
    volume(size, placed(size, MIDDLE, DVec3::new(20.0, 20.0, 2.0), DQuat::IDENTITY), class_materials, f)
}

fn tissue() -> Matter {
    Matter::Volume(Arc::new(slab_volume(&[0], |_| (1, 1.0))))
}

fn ray(column: f64, row: f64) -> DVec3 {
    view().intrinsics.unproject(DVec2::new(column, row))
}

/// A rod or tube along y through `centre`.
fn along_y(centre: DVec3, radius_mm: f64, inner_radius_mm: f64, material: usize, density: f64) -> Solid {
    let rotation = DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2);
    let shape = Shape::Cylinder { length_mm: 400.0, radius_mm, inner_radius_mm };
    Solid {
        shape,
        lps_from_local: Rigid { rotation, translation_mm: centre - DVec3::Y * 200.0 },
        material,
        density_g_per_cm3: density,
    }
}

/// Chord (mm) of a cylinder along y through `centre`: a circle's in the x–z plane, longer by the ray's tilt.
fn cylinder_mm(d: DVec3, centre: DVec3, radius: f64) -> f64 {
    let in_plane = d.x.hypot(d.z);
    let aside = (centre.x * d.z - centre.z * d.x).abs() / in_plane;
    if aside < radius { 2.0 * (radius * radius - aside * aside).sqrt() / in_plane * d.length() } else { 0.0 }
}

/// Depth range (mm of path) of a sphere.
fn sphere_range(d: DVec3, centre: DVec3, radius: f64) -> [f64; 2] {
    let unit = d.normalize();
    let along = centre.dot(unit);
    let aside = (centre - unit * along).length();
    let half = (radius * radius - aside * aside).max(0.0).sqrt();
    [along - half, along + half]
}

fn shared(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[1].min(b[1]) - a[0].max(b[0])).max(0.0)
}

fn slab_range(d: DVec3) -> [f64; 2] {
    [570.0 * d.length(), 630.0 * d.length()]
}

/// A cube of half edge `half` about `centre`.
fn cube_mesh(centre: DVec3, half: f64, material: usize, density_g_per_cm3: f64) -> Mesh {
    let corner = |bits: u32| DVec3::new(f64::from(bits & 1), f64::from(bits >> 1 & 1), f64::from(bits >> 2)) * 2.0 - 1.0;
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    Mesh {
        vertices_lps_mm: (0..8).map(|bits| centre + corner(bits) * half).collect(),
        triangles: quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect(),
        material,
        density_g_per_cm3,
    }
}

/// Every ray of `scene` against `expected` (mm by scene material) on the reference, the CPU executor, and the shaders.
fn check(what: &str, scene: &Scene, shaders: bool, densities: &[f64], expected: impl Fn(DVec3) -> Vec<f64>) {
    let view = view();
    let count = scene.materials.len();
    let formula: Vec<Vec<f64>> = (0..96 * 96)
        .map(|pixel| {
            expected(ray((pixel % 96) as f64, (pixel / 96) as f64))
                .iter()
                .zip(densities)
                .map(|(mm, rho)| 0.1 * mm * rho)
                .collect()
        })
        .collect();
    let far = |found: &dyn Fn(usize, usize) -> f64, changed: f64| {
        let mut errors: Vec<f64> = (0..96 * 96)
            .map(|pixel| (0..count).map(|m| (found(pixel, m) - changed * formula[pixel][m]).abs()).fold(0.0, f64::max))
            .collect();
        errors.sort_unstable_by(f64::total_cmp);
        (errors[96 * 96 - 1], errors[96 * 96 - 10])
    };
    for material in 0..count {
        let seen = formula.iter().filter(|areas| areas[material] > 0.0).count();
        assert!(seen > 100, "{what}: material {material} is seen on {seen} rays");
    }
    let traced = trace(scene, &view, false).expect("good");
    let (worst, _) = far(&|pixel, m| traced.g_per_cm2[pixel * count + m], 1.0);
    assert!(worst < 1e-9, "{what}: the reference errs by {worst:e} g/cm2");
    let pages = |rendered: &Rendered| -> Vec<Vec<f32>> { rendered.pages.iter().map(|page| page.pixels.clone()).collect() };
    let cpu = pages(&render_on(DeviceChoice::Cpu, scene, Quantity::AreaDensity));
    let (worst, _) = far(&|pixel, m| f64::from(cpu[m][pixel]), 1.0);
    assert!(worst < 2e-6, "{what}: the CPU executor errs by {worst:e} g/cm2");
    assert!(far(&|pixel, m| f64::from(cpu[m][pixel]), 1.001).0 > 1e-4, "{what}: the control");
    assert_eq!(wgsl::unsupported(scene).is_none(), shaders, "{what}");
    if !shaders {
        return;
    }
    let Some(mut vulkan) = software_vulkan() else { return };
    let options = Options { quantity: Quantity::AreaDensity, ..Options::default() };
    let gpu = vulkan.render(scene, &options).expect("renders");
    assert_eq!(gpu.plan["executor"], "wgsl", "{what}: {:?}", gpu.notes);
    let gpu = pages(&gpu);
    // In f32 a ray that grazes a tool may miss it or not: the worst ten rays are those.
    let (worst, most) = far(&|pixel, m| f64::from(gpu[m][pixel]), 1.0);
    println!("{what}: shaders err by {most:.1e} g/cm2, {worst:.1e} where rays graze");
    assert!(most < 5e-5 && worst < 5e-3, "{what}: {most:e} {worst:e}");
}

#[test]
fn a_tool_in_tissue() {
    let scene = empty(&["water", "steel_316l"]).with(tissue()).with(solids(&[along_y(MIDDLE, 3.0, 0.0, 1, 8.0)]));
    check("rod", &scene, true, &[1.0, 8.0], |d| {
        let rod = cylinder_mm(d, MIDDLE, 3.0);
        vec![SLAB_MM * d.length() - rod, rod]
    });
}

#[test]
fn a_hollow_tool_displaces_with_its_wall_only() {
    let scene = empty(&["water", "nitinol"]).with(tissue()).with(solids(&[along_y(MIDDLE, 3.0, 2.0, 1, 6.45)]));
    check("tube", &scene, true, &[1.0, 6.45], |d| {
        let wall = cylinder_mm(d, MIDDLE, 3.0) - cylinder_mm(d, MIDDLE, 2.0);
        vec![SLAB_MM * d.length() - wall, wall]
    });
}

#[test]
fn a_tool_over_a_tool() {
    // Tube, rod in its lumen, and a bead that takes both within it: concentric, so that spans nest.
    let tools = [along_y(MIDDLE, 8.0, 6.0, 2, 6.45), along_y(MIDDLE, 4.0, 0.0, 3, 8.0), sphere(MIDDLE, 7.0, 1, 1.92)];
    let scene = empty(&MATERIALS).with(tissue()).with(solids(&tools[..2])).with(solids(&tools[2..]));
    check("tools", &scene, true, &[1.0, 1.92, 6.45, 8.0], |d| {
        let bead = sphere_range(d, MIDDLE, 7.0);
        let middle = MIDDLE.z * d.z / (d.x * d.x + d.z * d.z) * d.length();
        let range = |radius: f64| {
            let half = 0.5 * cylinder_mm(d, MIDDLE, radius);
            [middle - half, middle + half]
        };
        let outside = |radius: f64| {
            let chord = range(radius);
            chord[1] - chord[0] - shared(chord, bead)
        };
        let (rod, tube) = (outside(4.0), outside(8.0) - outside(6.0));
        let bead = bead[1] - bead[0];
        vec![SLAB_MM * d.length() - rod - tube - bead, bead, tube, rod]
    });
}

#[test]
fn a_tool_partly_outside_the_ct() {
    let centre = DVec3::new(5.0, -4.0, 628.0);
    let scene = empty(&["water", "steel_316l"]).with(tissue()).with(solids(&[sphere(centre, 9.0, 1, 8.0)]));
    check("half out", &scene, true, &[1.0, 8.0], |d| {
        let ball = sphere_range(d, centre, 9.0);
        vec![SLAB_MM * d.length() - shared(ball, slab_range(d)), ball[1] - ball[0]]
    });
}

#[test]
fn two_volumes_on_one_grid() {
    // The second fills the slices from 10 to 19 (590 to 610 mm): its field reaches to the centres of the slices beside them.
    let second = slab_volume(&[1], |[_, _, k]| if (10..20).contains(&k) { (1, 1.92) } else { (0, 0.0) });
    let scene = empty(&["water", "bone_cortical"]).with(tissue()).with(Matter::Volume(Arc::new(second)));
    check("volumes", &scene, false, &[1.0, f64::from(1.92f32)], |d| vec![(SLAB_MM - 22.0) * d.length(), 20.0 * d.length()]);
}

#[test]
fn a_mesh_tool_in_the_ct() {
    let mesh = cube_mesh(MIDDLE + DVec3::new(1.3, -2.1, 0.0), 7.0, 1, 4.5);
    let scene = empty(&["water", "titanium"]).with(tissue()).with(Matter::Mesh(Arc::new(mesh)));
    check("mesh", &scene, true, &[1.0, 4.5], |d| {
        let (centre, half) = (MIDDLE + DVec3::new(1.3, -2.1, 0.0), 7.0);
        let (mut from, mut to) = (0.0f64, f64::INFINITY);
        for axis in 0..3 {
            let (a, b) = ((centre[axis] - half) / d[axis], (centre[axis] + half) / d[axis]);
            (from, to) = (from.max(a.min(b)), to.min(a.max(b)));
        }
        let chord = (to - from).max(0.0) * d.length();
        vec![SLAB_MM * d.length() - chord, chord]
    });
}

#[test]
fn kept_air_gives_way_to_everything() {
    // Slices 0 to 14 are air, the rest water; an earlier box lies in the air, a later ball across both.
    let half = slab_volume(&[0, 1], |[_, _, k]| if k < 15 { (1, 0.0012) } else { (2, 1.0) });
    let centre = DVec3::new(-3.0, 2.0, 600.0);
    let scene = empty(&["air", "water", "steel_316l", "pmma"])
        .with(solids(&[cuboid(DVec3::new(0.0, 0.0, 580.0), DVec3::new(200.0, 200.0, 4.0), 3, 1.19)]))
        .with(Matter::Volume(Arc::new(half)))
        .with(solids(&[sphere(centre, 12.0, 2, 8.0)]));
    let density = f64::from(0.0012f32);
    check("air", &scene, false, &[density, 1.0, 8.0, 1.19], |d| {
        let unit = d.length();
        let ball = sphere_range(d, centre, 12.0);
        // In the slice between the last air centre (599) and the first of water (601) both share a cell that counts as matter.
        let water_half = |from: f64, to: f64| shared(ball, [from * unit, to * unit]);
        let plate = [576.0 * unit, 584.0 * unit];
        let air = 29.0 * unit - water_half(570.0, 599.0) - (8.0 * unit - shared(ball, plate));
        // The mixed cell: air falls from 1 to 0, water rises from 0 to 1, over what the ball leaves of it.
        let ramp = |from: f64, to: f64| 0.5 * ((to - 599.0).powi(2) - (from - 599.0).powi(2)) / 2.0;
        let (mut rising, mut length) = (ramp(599.0, 601.0), 2.0);
        let (b0, b1) = ((ball[0] / unit).clamp(599.0, 601.0), (ball[1] / unit).clamp(599.0, 601.0));
        if b1 > b0 {
            rising -= ramp(b0, b1);
            length -= b1 - b0;
        }
        let water = rising * unit + 29.0 * unit - water_half(601.0, 630.0);
        vec![air + (length - rising) * unit, water, ball[1] - ball[0], 8.0 * unit - shared(ball, plate)]
    });
}

/// Error of −ln I at 60 keV when Eq. 5's overlap is resampled on the tool's own grid, against masking along the ray.
#[test]
fn a_resampled_overlap_errs_by_its_grid() {
    let size = [30, 30, 30];
    let turn = DQuat::from_scaled_axis(DVec3::new(0.2, -0.5, 0.3));
    let ct = volume(size, placed(size, MIDDLE, DVec3::splat(2.0), turn), &[0, 1], |[i, j, k]| {
        if (i / 4 + j / 4 + k / 4) % 3 == 0 { (2, 1.8) } else { (1, 1.0) }
    });
    let rotation = DQuat::from_scaled_axis(DVec3::new(0.9, 0.4, -0.2));
    let tube = Solid {
        shape: Shape::Cylinder { length_mm: 30.0, radius_mm: 3.0, inner_radius_mm: 2.0 },
        lps_from_local: Rigid { rotation, translation_mm: MIDDLE - DMat3::from_quat(rotation).z_axis * 15.0 },
        material: 2,
        density_g_per_cm3: 6.45,
    };
    let scene = empty(&["water", "bone_cortical", "nitinol"]).with(Matter::Volume(Arc::new(ct))).with(solids(&[tube]));
    let mu: Vec<f64> =
        scene.materials.iter().map(|material| material.attenuation(60.0).expect("tabulated").total_cm2_per_g).collect();
    let view = view();
    let exact = trace(&scene, &view, true).expect("good");
    let mut table = Vec::new();
    for grid_mm in [2.0, 1.0, 0.5, 0.25] {
        let density = overlap_by_resampling(&scene, &view, grid_mm).expect("fits");
        let paths = density.g_per_cm2.chunks_exact(3);
        let errors = paths.zip(&exact.line_integral).filter_map(|(paths, expected)| {
            let found: f64 = paths.iter().zip(&mu).map(|(path, mu)| f64::from(*path) * mu).sum();
            // Rays that meet the tool.
            (paths[2] > 0.0).then(|| (found - expected).abs() / expected.max(1.0))
        });
        let mut errors: Vec<f64> = errors.collect();
        errors.sort_unstable_by(f64::total_cmp);
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        table.push((grid_mm, rms, errors[errors.len() - 1]));
        println!(
            "overlap resampled at {grid_mm} mm: rms {rms:.1e}, worst {:.1e} of max(1, L), {} rays",
            table[table.len() - 1].2,
            errors.len()
        );
        assert!(errors.len() > 400);
    }
    let cpu = render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral);
    let masked = cpu.pages[0].pixels.iter().zip(&exact.line_integral);
    let masked = masked.map(|(a, b)| (f64::from(*a) - b).abs() / b.max(1.0)).fold(0.0, f64::max);
    println!("masked along the ray: worst {masked:.1e}");
    assert!(masked < 5e-6, "exact masking has no grid: {masked:e}");
    assert!(table[0].1 > 1e-3 && table[0].2 > 1e-2, "{table:?}");
    assert!(table.windows(2).all(|pair| pair[1].1 < 0.8 * pair[0].1), "it shrinks with the spacing: {table:?}");
}

#[test]
fn a_resampled_overlap_needs_one_ct_and_shapes() {
    let tool = solids(&[sphere(MIDDLE, 3.0, 0, 8.0)]);
    let view = view();
    let mut cases = 0;
    for (scene, grid_mm, words) in [
        (empty(&["water"]), 1.0, "empty"),
        (empty(&["water"]).with(tool.clone()), 1.0, "CT as the first"),
        (empty(&["water"]).with(tissue()), 1.0, "shapes of a tool"),
        (empty(&["water"]).with(tissue()).with(tissue()), 1.0, "shapes after"),
        (empty(&["water"]).with(tissue()).with(tool.clone()), 0.0, "grid_mm"),
        (empty(&["water"]).with(tissue()).with(tool.clone()), f64::NAN, "grid_mm"),
        (empty(&["water"]).with(tissue()).with(tool), 1e-6, "2e8"),
    ] {
        let error = overlap_by_resampling(&scene, &view, grid_mm).expect_err(words).to_string();
        assert!(error.contains(words), "{error}");
        cases += 1;
    }
    assert_eq!(cases, 7);
}

/// The CPU executor stands in for the shaders aloud where they cannot.
#[test]
fn what_has_no_shader_is_said() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let second = slab_volume(&[1], |[_, _, k]| if (10..20).contains(&k) { (1, 1.92) } else { (0, 0.0) });
    let scene = empty(&["water", "bone_cortical"]).with(tissue()).with(Matter::Volume(Arc::new(second)));
    let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let rendered = vulkan.render(&scene, &options).expect("renders");
    let cpu = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu").render(&scene, &options).expect("renders");
    assert_eq!(rendered.pages, cpu.pages);
    assert!(rendered.plan.to_string().contains("2 volumes, the shader takes one"), "{}", rendered.plan);
}

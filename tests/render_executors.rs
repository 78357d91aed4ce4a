//! The executors against the yardstick and each other, each with a control that must fail.

use std::f64::consts::PI;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::plan::Executor;
use sidecarm::render::{Options, Plan, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Mesh, Noise};

use crate::render_scenes::{With, cuboid, empty, placed, random, render_on, software_vulkan, solids, sphere, volume, worst};

fn with_density_scaled(scene: &Scene, factor: f64) -> Scene {
    let mut scene = scene.clone();
    for object in &mut scene.objects {
        match &mut object.matter {
            Matter::Volume(volume) => Arc::make_mut(volume).density_g_per_cm3.iter_mut().for_each(|rho| *rho *= factor as f32),
            Matter::Solids(solids) => solids.iter_mut().for_each(|solid| solid.density_g_per_cm3 *= factor),
            Matter::Mesh(mesh) => Arc::make_mut(mesh).density_g_per_cm3 *= factor,
            Matter::Parts(_) => {}
        }
    }
    scene
}

fn reference(scene: &Scene) -> Vec<f32> {
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let options = Options { quantity: Quantity::LineIntegral, reference: true, ..Options::default() };
    renderer.render(scene, &options).expect("renders").pages.remove(0).pixels
}

#[test]
fn the_fast_path_stays_within_its_stated_error_of_the_reference() {
    let mut cases = 0;
    for seed in 0..3 {
        let scene = random(seed);
        let expected = reference(&scene);
        assert!(expected.iter().any(|value| *value > 1.0), "seed {seed}: nothing to see");
        let cpu = render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral);
        let error = worst(&cpu.pages[0].pixels, &expected);
        println!("seed {seed}: cpu executor errs by {error:.1e} at most");
        assert!(error <= cpu.stated_error, "seed {seed}: {error:e}");
        let wrong = render_on(DeviceChoice::Cpu, &with_density_scaled(&scene, 1.01), Quantity::LineIntegral);
        assert!(worst(&wrong.pages[0].pixels, &expected) > 10.0 * cpu.stated_error, "the control");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

#[test]
fn the_shaders_agree_with_their_twins() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let mut cases = 0;
    for seed in 0..2 {
        let scene = random(seed);
        let cpu = render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral);
        let gpu = vulkan.render(&scene, &options).expect("renders");
        assert_eq!(gpu.plan["executor"], "wgsl", "{:?}", gpu.notes);
        let error = worst(&gpu.pages[0].pixels, &cpu.pages[0].pixels);
        println!("seed {seed}: shaders and twins differ by {error:.1e} at most");
        assert!(error <= Executor::Wgsl.stated_error(), "seed {seed}: {error:e}");
        let wrong = render_on(DeviceChoice::Cpu, &with_density_scaled(&scene, 1.01), Quantity::LineIntegral);
        assert!(worst(&gpu.pages[0].pixels, &wrong.pages[0].pixels) > Executor::Wgsl.stated_error(), "the control");
        cases += 1;
    }
    assert_eq!(cases, 2);
}

#[test]
fn every_pass_is_timed_by_the_device_where_it_has_a_clock() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let mut scene = random(1);
    scene.model.noise = Noise::Paper;
    let options = Options { quantity: Quantity::Intensity, ..Options::default() };
    let gpu = vulkan.render(&scene, &options).expect("renders");
    let passes: Vec<&str> = gpu.gpu_ms.iter().map(|(pass, _)| pass).collect();
    let total: f64 = gpu.gpu_ms.iter().map(|(_, ms)| ms).sum();
    println!("{:?}, wall {:?}", gpu.gpu_ms, gpu.stages.get("shaders"));
    if !passes.is_empty() {
        assert_eq!(passes, ["integrate_density", "attenuate_spectrum", "add_noise"]);
        let wall = gpu.stages.get("shaders").expect("timed");
        assert!(total > 0.0 && total <= wall, "{total} ms of {wall}: passes lie inside the submission");
    }
    let cpu = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
    assert_eq!(cpu.gpu_ms.iter().count(), 0, "no GPU, no GPU time");
}

#[test]
fn the_shaders_draw_the_same_noise_as_their_twin() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let mut scene =
        empty(&["steel_316l"]).with(solids(&[cuboid(DVec3::new(-45.0, 0.0, 600.0), DVec3::new(40.0, 40.0, 20.0), 0, 8.0)]));
    scene.model.noise = Noise::True;
    let options = Options { quantity: Quantity::Intensity, ..Options::default() };
    let mut cases = 0;
    for n0 in [50.0, 5e3, 5e5] {
        scene.beam.photons_per_pixel = n0;
        let cpu = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
        let gpu = vulkan.render(&scene, &options).expect("renders");
        // Half a photon tells one number from the next; f32 may round a uniform or an acceptance the other way now and then.
        let differ =
            cpu.pages[0].pixels.iter().zip(&gpu.pages[0].pixels).filter(|(a, b)| !(f64::from((*a - *b).abs()) < 0.5 / n0 + 1e-5));
        let share = differ.count() as f64 / cpu.pages[0].pixels.len() as f64;
        assert!(share < 5e-3, "N0 {n0}: {share}");
        cases += 1;
    }
    scene.model.seed = 2;
    let other = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
    let gpu = {
        scene.model.seed = 1;
        vulkan.render(&scene, &options).expect("renders")
    };
    let same = other.pages[0].pixels.iter().zip(&gpu.pages[0].pixels).filter(|(a, b)| (*a - *b).abs() < 1e-6).count();
    assert!(same < other.pages[0].pixels.len() / 2, "the control: another seed, other noise");
    assert_eq!(cases, 3);
}

#[test]
fn too_many_intervals_for_the_shader_fall_back_aloud() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let beads: Vec<_> = (0..40).map(|i| sphere(DVec3::new(0.0, 0.0, 400.0 + 10.0 * f64::from(i)), 4.0, 0, 1.0)).collect();
    let scene = empty(&["water"]).with(solids(&beads));
    let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let rendered = vulkan.render(&scene, &options).expect("renders");
    assert!(rendered.notes.iter().any(|note| note.contains("more intervals")), "{:?}", rendered.notes);
    assert_eq!(rendered.pages, render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral).pages);
}

/// A ball of `rings` × 2 `rings` facets.
fn mesh_ball(centre: DVec3, radius_mm: f64, rings: u32, material: usize, density_g_per_cm3: f64) -> Mesh {
    let around = 2 * rings;
    let at = |ring: u32, step: u32| {
        let (polar, azimuth) = (PI * f64::from(ring) / f64::from(rings), 2.0 * PI * f64::from(step % around) / f64::from(around));
        centre + radius_mm * DVec3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos())
    };
    let mut mesh = Mesh { vertices_lps_mm: vec![at(0, 0), at(rings, 0)], triangles: Vec::new(), material, density_g_per_cm3 };
    for ring in 1..rings {
        mesh.vertices_lps_mm.extend((0..around).map(|step| at(ring, step)));
    }
    let index = |ring: u32, step: u32| match ring {
        0 => 0,
        ring if ring == rings => 1,
        ring => 2 + (ring - 1) * around + step % around,
    };
    for ring in 0..rings {
        for step in 0..around {
            let (a, b, c, d) = (index(ring, step), index(ring + 1, step), index(ring + 1, step + 1), index(ring, step + 1));
            mesh.triangles.extend([[a, b, c], [a, c, d]].into_iter().filter(|[x, y, z]| x != y && y != z && z != x));
        }
    }
    mesh
}

#[test]
fn meshes_of_thousands_of_triangles_are_one_to_shaders_and_twins() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let options = Options { quantity: Quantity::AreaDensity, ..Options::default() };
    let tissue = random(1).objects.into_iter().find(|object| matches!(object.matter, Matter::Volume(_)));
    let mut scene = empty(&random(1).materials.iter().map(|material| material.name.as_str()).collect::<Vec<_>>());
    let centre = DVec3::new(2.0, -3.0, 600.0);
    // Displaced by the CT, displacing it, and one in the other; the poles of the balls lie on the grid of the pixels.
    scene = scene.with(Matter::Mesh(Arc::new(mesh_ball(centre, 30.0, 12, 0, 0.8))));
    scene.objects.extend(tissue);
    scene = scene.with(Matter::Mesh(Arc::new(mesh_ball(centre, 14.0, 60, 1, 4.5)))).with(Matter::Mesh(Arc::new(mesh_ball(
        centre + DVec3::new(5.0, 0.0, 0.0),
        6.0,
        25,
        0,
        2.0,
    ))));
    for shift in [0.0, 7.0, -4.0] {
        if let Some(view) = &mut scene.view {
            view.camera_from_lps.translation_mm.x += shift;
        }
        let cpu = render_on(DeviceChoice::Cpu, &scene, Quantity::AreaDensity);
        let gpu = vulkan.render(&scene, &options).expect("renders");
        assert_eq!(gpu.plan["executor"], "wgsl", "{:?}", gpu.notes);
        for (page, (gpu, cpu)) in gpu.pages.iter().zip(&cpu.pages).enumerate() {
            let mut errors: Vec<f32> = gpu.pixels.iter().zip(&cpu.pixels).map(|(a, b)| (a - b).abs()).collect();
            errors.sort_unstable_by(f32::total_cmp);
            let (most, worst) = (errors[errors.len() - 11], errors[errors.len() - 1]);
            println!("page {page}: shaders and twins differ by {most:.1e} g/cm2, {worst:.1e} where rays graze");
            assert!(most < 5e-5 && worst < 5e-2, "page {page}: {most:e} {worst:e}");
        }
        let seen = cpu.pages[1].pixels.iter().filter(|path| **path > 1.0).count();
        assert!(seen > 100, "{seen} rays meet the tool");
    }
}

#[test]
fn one_renderer_serves_many_views_and_scenes() {
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let (a, b) = (random(1), random(2));
    let first = renderer.render(&a, &options).expect("renders");
    let other = renderer.render(&b, &options).expect("renders");
    assert_ne!(first.pages, other.pages);
    assert_eq!(renderer.render(&a, &options).expect("renders").pages, first.pages);
}

#[test]
fn a_logged_plan_gives_the_same_bytes_and_refuses_another_scene() {
    let mut scene = random(3);
    scene.model.noise = Noise::True;
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let first = renderer.render(&scene, &Options { frame_index: 4, ..Options::default() }).expect("renders");
    let plan: Plan = serde_json::from_str(&first.plan.to_string()).expect("a plan survives JSON");
    let again = renderer.render(&scene, &Options { plan: Some(plan.clone()), ..Options::default() }).expect("renders");
    assert_eq!(first.pages, again.pages);
    let elsewhere = empty(&["water"]).with(solids(&[sphere(DVec3::new(0.0, 0.0, 600.0), 9.0, 0, 1.0)]));
    let error = renderer.render(&elsewhere, &Options { plan: Some(plan), ..Options::default() }).expect_err("another scene");
    assert!(error.to_string().contains("materials"), "{error}");
}

#[test]
fn two_volumes_on_one_ray_displace_in_order() {
    let size = [20, 20, 20];
    let at = |z: f64, class: usize| {
        let grid =
            volume(size, placed(size, DVec3::new(0.0, 0.0, z), DVec3::splat(2.0), DQuat::from_rotation_x(0.2)), &[class], |_| {
                (1, 1.0)
            });
        Matter::Volume(Arc::new(grid))
    };
    let scene = empty(&["water", "pmma"]).with(at(600.0, 0)).with(at(610.0, 1));
    let error = worst(&render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral).pages[0].pixels, &reference(&scene));
    assert!(error < 2e-5, "{error:e}");
}

//! The executors against the yardstick and each other, each with a control that must fail.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::plan::Executor;
use sidecarm::render::{Options, Plan, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Noise};

use crate::render_scenes::{With, cuboid, empty, placed, random, render_on, software_vulkan, solids, sphere, volume, worst};

fn with_density_scaled(scene: &Scene, factor: f64) -> Scene {
    let mut scene = scene.clone();
    for object in &mut scene.objects {
        match &mut object.matter {
            Matter::Volume(volume) => Arc::make_mut(volume).density_g_per_cm3.iter_mut().for_each(|rho| *rho *= factor as f32),
            Matter::Solids(solids) => solids.iter_mut().for_each(|solid| solid.density_g_per_cm3 *= factor),
            Matter::Mesh(mesh) => Arc::make_mut(mesh).density_g_per_cm3 *= factor,
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
    for seed in 0..5 {
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
    assert_eq!(cases, 5);
}

#[test]
fn the_shaders_agree_with_their_twins() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let mut cases = 0;
    for seed in 0..3 {
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
    assert_eq!(cases, 3);
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

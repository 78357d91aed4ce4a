//! Many views through one scene: what a GPU is given together, and what it sends back.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use sidecarm::geometry::View;
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::plan::Executor;
use sidecarm::render::{Goal, Options, Plan, Quantity, Rendered, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Noise};

use crate::render_scenes::{With, empty, placed, random, software_vulkan, solids, sphere, volume, worst};

/// The scene's own view and others beside it.
fn views(scene: &Scene, count: usize) -> Vec<View> {
    let shifted = |index: usize| {
        let mut view = scene.view.expect("a view");
        view.camera_from_lps.translation_mm += DVec3::new(3.0 * index as f64, -2.0 * index as f64, 0.0);
        view
    };
    (0..count).map(shifted).collect()
}

/// A quarter of the pixels, in the middle.
fn small(mut scene: Scene) -> Scene {
    let view = scene.view.as_mut().expect("a view");
    view.size_px = [48, 48];
    (view.intrinsics.cx, view.intrinsics.cy) = (23.5, 23.5);
    scene
}

fn all(renderer: &mut Renderer, scene: &Scene, views: &[View], options: &Options) -> Vec<Rendered> {
    let mut found = Vec::new();
    let mut take = |index, rendered| {
        assert_eq!(index, found.len(), "in order");
        found.push(rendered);
    };
    renderer.render_views(scene, views, options, &mut take).expect("renders");
    found
}

/// Views together against the same ones, one at a time, by the same plan.
fn together_as_one_by_one(renderer: &mut Renderer, scene: &Scene, quantity: Quantity) {
    // More than are submitted together.
    let views = views(scene, 9);
    let options = Options { quantity, frame_index: 5, ..Options::default() };
    let together = all(renderer, scene, &views, &options);
    assert_eq!(together.len(), 9);
    assert_ne!(together[0].pages, together[1].pages, "the control: views differ");
    for (index, (view, rendered)) in views.iter().zip(&together).enumerate() {
        let plan: Plan = serde_json::from_value(rendered.plan.clone()).expect("a plan");
        assert_eq!(plan.frame_index, 5 + index as u32);
        let scene = Scene { view: Some(*view), ..scene.clone() };
        let alone = renderer.render(&scene, &Options { plan: Some(plan), ..options.clone() }).expect("renders");
        assert_eq!(alone.pages, rendered.pages, "view {index}");
        assert_eq!(alone.valid, rendered.valid, "view {index}");
    }
}

#[test]
fn views_together_are_views_one_by_one() {
    let mut cpu = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let mut scene = small(random(2));
    scene.model.noise = Noise::True;
    together_as_one_by_one(&mut cpu, &scene, Quantity::Intensity);
    let Some(mut vulkan) = software_vulkan() else { return };
    together_as_one_by_one(&mut vulkan, &scene, Quantity::Intensity);
    scene.model.noise = Noise::Off;
    together_as_one_by_one(&mut vulkan, &scene, Quantity::LineIntegral);
    together_as_one_by_one(&mut vulkan, &scene, Quantity::AreaDensity);
    let mut small = views(&scene, 2);
    small[1].size_px = [8, 8];
    let refused = vulkan.render_views(&scene, &small, &Options::default(), &mut |_, _| ());
    assert!(refused.expect_err("another size").to_string().contains("size_px"));
}

#[test]
fn only_what_is_asked_for_comes_back() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let mut scene = random(1);
    let pixels = scene.view.expect("a view").size_px.iter().map(|n| u64::from(*n)).product::<u64>();
    let mut per_pixel = |scene: &Scene, quantity| {
        let rendered = vulkan.render(scene, &Options { quantity, ..Options::default() }).expect("renders");
        assert_eq!(rendered.plan["executor"], "wgsl", "{:?}", rendered.notes);
        rendered.read_back_bytes as f64 / pixels as f64
    };
    // Four bytes a value, a bit a pixel for validity, a few words more.
    let close = |found: f64, values: f64| (found - 4.0 * values - 0.125).abs() < 0.1;
    scene.model.noise = Noise::Off;
    assert!(close(per_pixel(&scene, Quantity::LineIntegral), 1.0));
    let materials = scene.materials.len() as f64;
    assert!(close(per_pixel(&scene, Quantity::AreaDensity), materials));
    scene.model.noise = Noise::True;
    assert!(close(per_pixel(&scene, Quantity::Intensity), 5.0));
    let counted = Options { quantity: Quantity::LineIntegral, count_non_finite: true, ..Options::default() };
    scene.model.noise = Noise::Off;
    let rendered = vulkan.render(&scene, &counted).expect("renders");
    assert!(close(rendered.read_back_bytes as f64 / pixels as f64, 1.0 + materials));
    let cpu = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu").render(&scene, &counted).expect("renders");
    assert_eq!(cpu.read_back_bytes, 0);
}

fn ball(radius_mm: f64) -> Scene {
    let mut scene = empty(&["bone_cortical", "water"]).with(solids(&[
        sphere(DVec3::new(5.0, 0.0, 600.0), radius_mm, 0, 1.9),
        sphere(DVec3::new(-15.0, 5.0, 610.0), 0.5 * radius_mm, 1, 1.0),
    ]));
    scene.beam.spectrum = sidecarm::scene::physics::Spectrum::tungsten(100.0, 12.0, &[]).expect("a spectrum");
    scene
}

#[test]
fn paths_beyond_those_of_the_plan_come_back_and_are_evaluated_in_full() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let goal = Some(Goal::MaxError(2e-3));
    let options = Options { quantity: Quantity::LineIntegral, goal, ..Options::default() };
    let (thin, thick) = (ball(8.0), ball(60.0));
    let plan = vulkan.plan(&thin, &options).expect("plans");
    let nodes = plan.energy_nodes.len();
    assert!(!plan.fitted_up_to_g_per_cm2.is_empty() && nodes < 12, "{nodes} fitted up to {:?}", plan.fitted_up_to_g_per_cm2);
    let logged = Options { plan: Some(plan.clone()), ..options.clone() };
    let within = vulkan.render(&thin, &logged).expect("renders");
    let beyond = vulkan.render(&thick, &logged).expect("renders");
    assert!(beyond.read_back_bytes > 2 * within.read_back_bytes, "the paths came back");
    let reference = Options { reference: true, ..options.clone() };
    let expected = vulkan.render(&thick, &reference).expect("renders");
    let error = worst(&beyond.pages[0].pixels, &expected.pages[0].pixels);
    assert!(error < Executor::Wgsl.stated_error(), "{error:e}");
    // The control: the plan's few energies do not hold there.
    let believed = Plan { fitted_up_to_g_per_cm2: Vec::new(), ..plan };
    let wrong = vulkan.render(&thick, &Options { plan: Some(believed), ..options }).expect("renders");
    let error = worst(&wrong.pages[0].pixels, &expected.pages[0].pixels);
    assert!(error > Executor::Wgsl.stated_error(), "{error:e}");
}

#[test]
fn nothing_of_the_last_view_is_left_in_the_next() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let crowded = small(random(4));
    let sparse = Scene { view: crowded.view, ..ball(12.0) };
    let first = vulkan.render(&sparse, &options).expect("renders");
    for between in [&crowded, &small(random(5))] {
        vulkan.render(between, &options).expect("renders");
        let again = vulkan.render(&sparse, &options).expect("renders");
        assert_eq!(first.pages, again.pages);
        assert_eq!(first.valid, again.valid);
    }
}

/// A truncated scan, a ball that it displaces and a tool that displaces both.
fn layered() -> Scene {
    let size = [30, 26, 61];
    let turn = DQuat::from_rotation_y(0.5) * DQuat::from_rotation_x(0.7);
    let affine = placed(size, DVec3::new(0.0, 0.0, 600.0), DVec3::new(1.5, 1.7, 1.2), turn);
    // Cut at one face, and there on one side.
    let border = |[i, j, k]: [usize; 3]| [0, 29].contains(&i) || [0, 25].contains(&j) || k == 60 || (k == 0 && i >= 15);
    let mut scan = volume(size, affine, &[0, 1], |[i, j, k]| match (i + 2 * j + 3 * k) % 40 {
        n if n < 12 || border([i, j, k]) => (0, 0.0),
        n if n < 30 => (1, 1.0 + 0.01 * k as f32),
        _ => (2, 1.8),
    });
    scan.truncated_at_faces = true;
    empty(&["water", "bone_cortical", "steel_316l"])
        .with(solids(&[sphere(DVec3::new(6.0, 5.0, 590.0), 15.0, 0, 0.7)]))
        .with(Matter::Volume(Arc::new(scan)))
        .with(solids(&[sphere(DVec3::new(-5.0, 3.0, 605.0), 6.0, 2, 8.0)]))
}

#[test]
fn a_volume_in_parts_is_the_volume() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let options = Options { quantity: Quantity::AreaDensity, ..Options::default() };
    let scene = layered();
    let whole = vulkan.render(&scene, &options).expect("renders");
    assert_eq!(whole.plan["executor"], "wgsl", "{:?}", whole.notes);
    let slice_bytes = 31 * 27 * 6;
    for slices in [50, 20, 0] {
        vulkan.limit_gpu_memory(slices * slice_bytes);
        let parts = vulkan.render(&scene, &options).expect("renders");
        for (whole, parts) in whole.pages.iter().zip(&parts.pages) {
            assert!(worst(&parts.pixels, &whole.pixels) < 5e-6, "{slices} slices");
        }
        let differ = whole.valid.pixels.iter().zip(&parts.valid.pixels).filter(|(a, b)| a != b).count();
        assert!(differ <= 2, "{slices} slices: {differ} pixels");
        let passes = parts.gpu_ms.iter().count();
        println!("{slices} slices: {:?} {passes}", parts.gpu_ms);
    }
    let valid = whole.valid.pixels.iter().filter(|valid| **valid == 1).count();
    assert!(valid > 500 && valid < whole.valid.pixels.len() - 500, "{valid}");
    // The control: without the last slices of the volume the image differs.
    let mut shorter = scene.clone();
    for object in &mut shorter.objects {
        if let Matter::Volume(scan) = &mut object.matter {
            let scan = Arc::make_mut(scan);
            let slice = scan.size[0] * scan.size[1];
            let cut = scan.class.len() - 8 * slice;
            scan.class[cut..].fill(0);
            scan.density_g_per_cm3[cut..].fill(0.0);
        }
    }
    let missing = vulkan.render(&shorter, &options).expect("renders");
    let differs = |page: usize| worst(&missing.pages[page].pixels, &whole.pages[page].pixels);
    assert!((0..2).any(|page| differs(page) > 1e-2), "{} {}", differs(0), differs(1));
    let views = views(&scene, 3);
    let line = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let in_parts = all(&mut vulkan, &scene, &views, &line);
    vulkan.limit_gpu_memory(u64::MAX);
    for (parts, whole) in in_parts.iter().zip(all(&mut vulkan, &scene, &views, &line)) {
        assert!(worst(&parts.pages[0].pixels, &whole.pages[0].pixels) < 5e-6);
    }
}

//! Many views through one scene: what a GPU is given together, and what it sends back.

use glam::DVec3;
use sidecarm::geometry::View;
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::plan::Executor;
use sidecarm::render::{Goal, Options, Plan, Quantity, Rendered, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::Noise;

use crate::render_scenes::{With, empty, random, software_vulkan, solids, sphere, worst};

/// The scene's own view and others beside it.
fn views(scene: &Scene, count: usize) -> Vec<View> {
    let shifted = |index: usize| {
        let mut view = scene.view.expect("a view");
        view.camera_from_lps.translation_mm += DVec3::new(3.0 * index as f64, -2.0 * index as f64, 0.0);
        view
    };
    (0..count).map(shifted).collect()
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
    let views = views(scene, 11);
    let options = Options { quantity, frame_index: 5, ..Options::default() };
    let together = all(renderer, scene, &views, &options);
    assert_eq!(together.len(), 11);
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
    let mut scene = random(2);
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
    let crowded = random(4);
    let sparse = Scene { view: crowded.view, ..ball(12.0) };
    let first = vulkan.render(&sparse, &options).expect("renders");
    for between in [&crowded, &random(5)] {
        vulkan.render(between, &options).expect("renders");
        let again = vulkan.render(&sparse, &options).expect("renders");
        assert_eq!(first.pages, again.pages);
        assert_eq!(first.valid, again.valid);
    }
}

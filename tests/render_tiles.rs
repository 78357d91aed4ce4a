//! Where pixels are skipped: tiles that hold an outline, metal or a strong bend are cast in full, and the stated error covers the rest.

use std::sync::Arc;

use glam::{DQuat, DVec2, DVec3};
use sidecarm::geometry::{Rigid, View};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::achieved::Achieved;
use sidecarm::render::before_panel::before_panel;
use sidecarm::render::meshes::MadeMesh;
use sidecarm::render::outline::outlined;
use sidecarm::render::plan::{Plan, Sampling};
use sidecarm::render::prepared::Prepared;
use sidecarm::render::{Goal, Options, Quantity, Renderer, trade};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Mesh, Shape, Solid};
use sidecarm::scene::optics::{Field, Heel, Towards};
use sidecarm::scene::physics::{Material, Spectrum};

use crate::render_scenes::{With, cuboid, empty, placed, solids, spectrum, sphere, volume, worst};

const MATERIALS: [&str; 5] = ["soft_tissue", "bone_cortical", "steel_316l", "titanium", "water"];
const MIDDLE: DVec3 = DVec3::new(0.0, 0.0, 600.0);
const QUANTITY: Quantity = Quantity::LineIntegral;

/// A body of tissue and bone at 110 kV, 160 × 128 pixels of 0.7 mm in it; `metal` marks voxels of an implant.
fn body(metal: impl Fn([usize; 3]) -> bool) -> Scene {
    let filled = |[i, j, k]: [usize; 3]| {
        let x = DVec3::new(i as f64, j as f64, k as f64) / 40.0 - 0.5;
        let wobble = 0.02 * ((i * 7 + j * 13 + k * 5) % 11) as f32 / 11.0;
        match x.length() {
            _ if metal([i, j, k]) => (3, 4.5),
            r if r < 0.2 => (2, 1.7 + wobble),
            r if r < 0.45 => (1, 1.02 + wobble),
            _ => (0, 0.0),
        }
    };
    let turn = DQuat::from_scaled_axis(DVec3::new(0.3, 0.5, 0.2));
    let ct = volume([40; 3], placed([40; 3], MIDDLE, DVec3::splat(3.0), turn), &[0, 1, 3], filled);
    let mut scene = empty(&MATERIALS).with(Matter::Volume(Arc::new(ct)));
    scene.beam.spectrum = Spectrum::tungsten(110.0, 12.0, &[(Material::parse("Al").expect("known"), 3.0)]).expect("inside");
    let mut view = scene.view.expect("has one");
    view.size_px = [160, 128];
    (view.intrinsics.cx, view.intrinsics.cy) = (79.5, 63.5);
    scene.view = Some(view);
    scene
}

fn rod(from: DVec3, to: DVec3, radius_mm: f64, inner_radius_mm: f64) -> Solid {
    let rotation = DQuat::from_rotation_arc(DVec3::Z, (to - from).normalize());
    Solid {
        shape: Shape::Cylinder { length_mm: from.distance(to), radius_mm, inner_radius_mm },
        lps_from_local: Rigid { rotation, translation_mm: from },
        material: 2,
        density_g_per_cm3: 8.0,
    }
}

/// A thin slanted plate of triangles, such as a plate of bone surgery is.
fn plate() -> Matter {
    let corner = |i: usize| DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64) - 0.5;
    let turn = DQuat::from_scaled_axis(DVec3::new(0.2, 0.4, 0.9));
    let vertices_lps_mm = (0..8).map(|i| MIDDLE + turn * (corner(i) * DVec3::new(45.0, 6.0, 0.8))).collect();
    let quads = [[0u32, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
    Matter::Mesh(Arc::new(Mesh { vertices_lps_mm, triangles, material: 3, density_g_per_cm3: 4.5 }))
}

fn none(_: [usize; 3]) -> bool {
    false
}

fn cases() -> Vec<(&'static str, Scene)> {
    let across = |radius, inner| {
        let (from, to) = (MIDDLE + DVec3::new(-60.0, -21.0, 8.0), MIDDLE + DVec3::new(60.0, 30.0, -5.0));
        solids(&[rod(from, to, radius, inner)])
    };
    let mut shaped = body(none).with(across(0.8, 0.0));
    shaped.beam.shape.heel = Some(Heel { tube_kvp: 110.0, anode_angle_deg: 12.0, anode_towards: Towards::PlusColumn });
    shaped.beam.shape.field = Some(Field::Circle { diameter_mm: 110.0, centre_mm: DVec2::new(4.0, -3.0) });
    let mut twice = body(none);
    let Matter::Volume(first) = &twice.objects[0].matter else { panic!("a volume") };
    let mut second = (**first).clone();
    second.lps_from_voxel.translation += DVec3::new(30.0, 10.0, -60.0);
    twice = twice.with(Matter::Volume(Arc::new(second)));
    vec![
        ("a wire", body(none).with(across(0.8, 0.0))),
        ("a wire thinner than a pixel", body(none).with(across(0.1, 0.0))),
        ("a tube", body(none).with(across(6.0, 5.0))),
        ("a ball wider than tiles", body(none).with(solids(&[sphere(MIDDLE, 25.0, 3, 4.5)]))),
        ("a table", body(none).with(solids(&[cuboid(MIDDLE + DVec3::X * 31.0, DVec3::new(4.0, 200.0, 80.0), 4, 1.0)]))),
        ("a mesh", body(none).with(plate())),
        ("a pin in the CT", body(|[i, j, k]| i == 23 && j == 19 && k > 4 && k < 36)),
        ("heel and field", shaped),
        ("two volumes", twice),
        ("nothing else", body(none)),
    ]
}

fn cpu() -> Renderer {
    Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu")
}

fn truth(renderer: &mut Renderer, scene: &Scene) -> Vec<f32> {
    let options = Options { quantity: QUANTITY, reference: true, ..Options::default() };
    renderer.render(scene, &options).expect("renders").pages.remove(0).pixels
}

fn by(renderer: &mut Renderer, scene: &Scene, plan: &Plan, truth: &[f32]) -> Achieved {
    let options = Options { quantity: QUANTITY, plan: Some(plan.clone()), ..Options::default() };
    let rendered = renderer.render(scene, &options).expect("renders");
    Achieved::of(&rendered.pages[0].pixels, truth, 0.0)
}

/// A 1.6 mm wire across a pelvis, with 15 ms to spend, was stated to be off by 9.8e-2 and was off by 4.6e-1: thirty-six pilot blocks had
/// not met it. The control: plans for wires and tubes without their full tiles are what went wrong.
#[test]
fn the_stated_error_holds_where_pixels_are_skipped() {
    let explicit = |step_px| Goal::Explicit { sampling: Sampling::ExactSlabs, energies: Some(1e-4), step_px };
    let (mut skipped, mut broken) = (0, 0);
    for (index, (name, scene)) in cases().into_iter().enumerate() {
        let mut renderer = cpu();
        let truth = truth(&mut renderer, &scene);
        // The coarsest for all of them; for a time, and finer, by turns.
        for goal in [explicit(4), if index % 2 == 0 { Goal::BudgetMs(1e-3) } else { explicit(2) }] {
            let options = Options { quantity: QUANTITY, goal: Some(goal), ..Options::default() };
            let plan = renderer.plan(&scene, &options).expect("a plan");
            let achieved = by(&mut renderer, &scene, &plan, &truth);
            println!("{name}, {goal:?}: stated {:.1e}, {achieved:?}", plan.stated_error);
            // What meets a budget hangs on what this machine takes; where nothing does, what is fastest may skip nothing.
            let is_told = !matches!(goal, Goal::BudgetMs(_));
            assert!(!is_told || plan.step_px > 1 && plan.full_tiles.is_some(), "{name}, {goal:?}: pixels are skipped");
            assert!(achieved.error <= plan.stated_error, "{name}, {goal:?}: stated {:.1e}, {achieved:?}", plan.stated_error);
            skipped += usize::from(plan.step_px > 1);
            if goal == explicit(4) && index < 4 {
                let without = by(&mut renderer, &scene, &Plan { full_tiles: None, ..plan.clone() }, &truth);
                println!("{name}: without full tiles {without:?}");
                broken += usize::from(!(without.error <= plan.stated_error));
            }
        }
    }
    assert!(skipped >= 15, "{skipped}");
    assert!(broken >= 2, "{broken} of 4");
}

#[test]
fn full_tiles_are_cast_as_if_nothing_was_skipped() {
    let (_, scene) = cases().remove(0);
    let mut renderer = cpu();
    let explicit = |step_px| Some(Goal::Explicit { sampling: Sampling::ExactSlabs, energies: None, step_px });
    let mut page = |goal| {
        let options = Options { quantity: QUANTITY, goal, ..Options::default() };
        let plan = renderer.plan(&scene, &options).expect("a plan");
        let rendered = renderer.render(&scene, &Options { plan: Some(plan.clone()), ..options }).expect("renders");
        (rendered.pages[0].pixels.clone(), plan)
    };
    let ((all, _), (some, plan)) = (page(explicit(1)), page(explicit(4)));
    let tiles = plan.full_tiles.expect("some are full");
    let (mut full, mut differ) = (0, 0);
    for (pixel, (a, b)) in all.iter().zip(&some).enumerate() {
        let place = [pixel as u32 % 160, pixel as u32 / 160];
        if tiles.is_full_at(place) {
            assert_eq!(a, b, "{place:?}");
            full += 1;
        } else {
            differ += usize::from(a != b);
        }
    }
    assert!(full > 1000 && differ > 1000, "{full} pixels in full tiles, {differ} others differ");
}

#[test]
fn outlines_are_found_wherever_paths_begin() {
    let mut pixels = 0;
    for (name, scene) in cases().into_iter().filter(|(name, _)| !matches!(*name, "two volumes" | "a pin in the CT")) {
        let mut scene = scene;
        scene.objects.remove(0);
        let view: View = scene.view.expect("has one");
        let no_volume = |_: &Arc<_>, _: &str| unreachable!("there is none");
        let prepared = Prepared::new(&scene, view, no_volume, |mesh| Arc::new(MadeMesh::new(mesh))).expect("sound");
        let tiles = outlined(&prepared);
        let options = Options { quantity: Quantity::AreaDensity, ..Options::default() };
        let rendered = cpu().render(&scene, &options).expect("renders");
        let path = |u: usize, v: usize| rendered.pages.iter().map(|page| *page.at(u, v)).sum::<f32>();
        for v in 0..127 {
            for u in 0..159 {
                // What is cast next to it decides what an interpolated pixel gets.
                let edge = [(u + 1, v), (u, v + 1)].iter().any(|(x, y)| (path(u, v) > 0.0) != (path(*x, *y) > 0.0));
                assert!(!edge || tiles.is_full_at([u as u32, v as u32]), "{name}: an outline at ({u}, {v})");
                pixels += usize::from(edge);
            }
        }
        let full = tiles.pixels() / (160.0 * 128.0);
        assert!(full < 0.8 || name == "nothing else", "{name}: {full} of the image is full");
    }
    assert!(pixels > 500, "{pixels} pixels of outlines");
}

/// A shape listed before the CT was walked cell by cell, while the plan said slabs and a seventh of the time.
#[test]
fn what_a_ct_displaces_leaves_it_in_slabs_and_the_plan_says_what_is_looked_at() {
    let water = solids(&[cuboid(MIDDLE + DVec3::Z * 20.0, DVec3::new(40.0, 30.0, 12.0), 4, 1.0)]);
    let mut scene = body(none);
    let ct = scene.objects.remove(0).matter;
    let scene = scene.with(water).with(plate()).with(ct).with(solids(&[rod(MIDDLE - DVec3::Y * 70.0, MIDDLE, 1.0, 0.0)]));
    let mut renderer = cpu();
    let options = Options { quantity: Quantity::AreaDensity, goal: Some(Goal::MaxError(1e-5)), ..Options::default() };
    let plan = renderer.plan(&scene, &options).expect("a plan");
    assert_eq!(plan.sampling, Sampling::ExactSlabs);
    let text = plan.explain();
    assert!(text.contains("looked at one by one"), "{text}");
    let fast = renderer.render(&scene, &options).expect("renders");
    let slow = renderer.render(&scene, &Options { reference: true, ..options.clone() }).expect("renders");
    for (fast, slow) in fast.pages.iter().zip(&slow.pages) {
        assert!(worst(&fast.pixels, &slow.pixels) < 2e-5);
    }
    // The control: displaced the other way round it is another image.
    let mut other = scene.clone();
    other.objects.swap(0, 2);
    let other = renderer.render(&other, &options).expect("renders");
    assert!(worst(&other.pages[0].pixels, &slow.pages[0].pixels) > 1e-2);
}

#[test]
fn rays_through_two_volumes_are_said_and_reckoned_to_be_walked() {
    let (_, twice) = cases().remove(8);
    let mut once = twice.clone();
    once.objects.pop();
    let mut renderer = cpu();
    let options = Options { quantity: QUANTITY, goal: Some(Goal::MaxError(1e-3)), ..Options::default() };
    let mut plan = |scene: &Scene| renderer.plan(scene, &options).expect("a plan");
    let (one, two) = (plan(&once), plan(&twice));
    let (one_ms, two_ms) = (one.typical_ms.expect("a model"), two.typical_ms.expect("a model"));
    assert!(two.explain().contains("another volume"), "{}", two.explain());
    assert!(!one.explain().contains("another volume"), "{}", one.explain());
    assert!(two_ms > 3.0 * one_ms, "{two_ms} ms and {one_ms} ms");
}

#[test]
fn a_budget_that_cannot_be_met_says_so() {
    let (_, scene) = cases().remove(0);
    let mut renderer = cpu();
    let mut plan = |ms| {
        let options = Options { quantity: QUANTITY, goal: Some(Goal::BudgetMs(ms)), ..Options::default() };
        renderer.plan(&scene, &options).expect("a plan")
    };
    assert!(plan(1e-3).explain().contains("cannot be met"));
    let ample = plan(1e6);
    assert!(!ample.explain().contains("cannot be met") && ample.step_px == 1);
}

#[test]
fn what_was_fitted_while_waiting_serves_other_views_and_a_kept_plan_many() {
    let (_, scene) = cases().remove(0);
    let mut renderer = cpu();
    let view = scene.view.expect("has one");
    let options = Options { quantity: QUANTITY, ..Options::default() };
    let warmed = renderer.warm(&scene, view, &options).expect("warms");
    assert!(warmed.get("plan").is_some_and(|ms| ms > 0.0), "{warmed:?}");
    let seen = |index: u32| {
        let mut view = view;
        view.camera_from_lps.translation_mm += DVec3::new(2.0, -1.0, 4.0) * f64::from(index);
        view.camera_from_lps.rotation = DQuat::from_rotation_y(0.02 * f64::from(index)) * view.camera_from_lps.rotation;
        scene.with_view(view)
    };
    let first = renderer.plan(&seen(0), &options).expect("a plan");
    assert!(first.energy_nodes.iter().all(|node| node.fitted.is_some()), "fitted");
    for index in 1..5 {
        assert_eq!(renderer.plan(&seen(index), &options).expect("a plan").energy_nodes, first.energy_nodes, "view {index}");
    }
    // One plan for small images from elsewhere: every pixel cast, nothing planned.
    let goal = Some(Goal::MaxError(1e-2));
    let whole = renderer.plan(&seen(0), &Options { goal, ..options.clone() }).expect("a plan").whole();
    for index in 0..4 {
        let mut scene = seen(index);
        scene.view = scene.view.map(|view| View { size_px: [80, 64], ..view });
        let plan = Some(Plan { size_px: [80, 64], ..whole.clone() });
        let rendered = renderer.render(&scene, &Options { plan, ..options.clone() }).expect("renders");
        assert!(rendered.stages.get("plan").is_none() && rendered.plan["step_px"] == 1, "{:?}", rendered.stages);
        let expected = truth(&mut renderer, &scene);
        let achieved = Achieved::of(&rendered.pages[0].pixels, &expected, 0.0);
        assert!(achieved.error <= 1e-2, "{index}: {achieved:?}");
    }
}

/// Blur and collimation once hid from `trade` what its plans were off by, or made the thin yardstick another image.
#[test]
fn trade_judges_before_the_panel_and_says_so() {
    let (_, mut plain) = cases().remove(0);
    plain.view = plain.view.map(|view| View { size_px: [40, 32], ..view });
    // Few energies, which need no fit.
    plain.beam.spectrum = spectrum(&[(40.0, 1.0), (60.0, 2.0), (90.0, 1.0)]);
    let mut panelled = plain.clone();
    panelled.detector.panel.blur_fwhm_mm = 4.0;
    panelled.beam.shape.field = Some(Field::Circle { diameter_mm: 30.0, centre_mm: DVec2::ZERO });
    let sweep = |scene: &Scene| trade::sweep(scene, &mut cpu(), &Reporter::silent()).expect("measures");
    let (with, without) = (sweep(&panelled), sweep(&plain));
    assert!(with.judged.contains("before the panel") && with.judged.contains("left out"), "{}", with.judged);
    assert!(!without.judged.contains("left out") && with.table().contains("before the panel"));
    let errors = |trade: &trade::Trade| {
        let row = |row: &trade::Row| format!("{:?} {} {} {:e}", row.sampling, row.energies, row.step_px, row.achieved.error);
        let mut rows: Vec<String> = trade.rows.iter().map(row).collect();
        rows.sort();
        rows
    };
    assert_eq!(errors(&with), errors(&without));
    assert!(with.rows.len() > 5);
    // The control: with its panel it is another image.
    let blurred = truth(&mut cpu(), &panelled);
    assert!(worst(&truth(&mut cpu(), &before_panel(&panelled)), &blurred) > 1e-2);
}

//! What a reader can check by hand: chords, slabs, hardening, displacement, cells.

use std::sync::Arc;

use glam::{DAffine3, DQuat, DVec2, DVec3};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::{Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Formation, Matter, Response, Shape, Solid};
use sidecarm::scene::physics::{Material, Spectrum};

use crate::render_scenes::{
    With, cuboid, empty, line_integral, obliquity, placed, render_on, software_vulkan, solid, solids, spectrum, sphere, view,
    volume,
};

fn mu_per_mm(material: &str, energy_kev: f64, density: f64) -> f64 {
    0.1 * density * Material::parse(material).expect("known").attenuation(energy_kev).expect("inside").total_cm2_per_g
}

/// Chord of the ray through pixel (column, row) with a sphere.
fn chord_mm(centre: DVec3, radius: f64, column: f64, row: f64) -> f64 {
    let direction = view().intrinsics.unproject(DVec2::new(column, row)).normalize();
    let off = centre - direction * centre.dot(direction);
    2.0 * (radius * radius - off.length_squared()).max(0.0).sqrt()
}

#[test]
fn a_sphere_attenuates_by_its_chord() {
    let centre = DVec3::new(5.0, -3.0, 600.0);
    let scene = empty(&["water"]).with(solids(&[sphere(centre, 20.0, 0, 1.0)]));
    let mu = mu_per_mm("water", 60.0, 1.0);
    let cpu = line_integral(&scene);
    let mut images = vec![(cpu, 5e-6)];
    if let Some(mut vulkan) = software_vulkan() {
        let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
        images.push((vulkan.render(&scene, &options).expect("renders").pages.remove(0), 5e-4));
    }
    for (image, tolerance) in images {
        let mut inside = 0;
        for row in 0..96 {
            for column in 0..96 {
                let expected = mu * chord_mm(centre, 20.0, column as f64, row as f64);
                let found = f64::from(*image.at(column, row));
                assert!((found - expected).abs() < tolerance, "({column}, {row}): {found} and {expected}");
                inside += usize::from(expected > 0.0);
            }
        }
        assert!(inside > 1000);
    }
}

#[test]
fn twenty_centimetres_of_steel_let_fifty_one_nepers_through() {
    let mut scene =
        empty(&["steel_316l"]).with(solids(&[cuboid(DVec3::new(0.0, 0.0, 600.0), DVec3::new(500.0, 500.0, 100.0), 0, 8.0)]));
    scene.beam.spectrum = Spectrum::tungsten(120.0, 12.0, &[(Material::parse("Al").expect("known"), 4.3)]).expect("inside");
    let view = view();
    // Summed in f64 with the same table.
    let bins = &scene.beam.spectrum.bins;
    let mean: f64 = bins.iter().map(|bin| bin.fluence * bin.energy_kev).sum();
    let path = 200.0 * obliquity(&view, 47.0, 47.0);
    let transmitted: f64 = bins
        .iter()
        .map(|bin| bin.fluence * bin.energy_kev / mean * (-mu_per_mm("steel_316l", bin.energy_kev, 8.0) * path).exp())
        .sum();
    let expected = -transmitted.ln();
    assert!((expected - 51.47).abs() < 0.3, "{expected}");
    let found = f64::from(*line_integral(&scene).at(47, 47));
    assert!(((found - expected) / expected).abs() < 5e-6, "{found} and {expected}");
    let intensity = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
    assert!(intensity.pages[0].pixels.iter().all(|value| value.is_finite()));
}

#[test]
fn two_energies_harden() {
    let mut scene =
        empty(&["water"]).with(solids(&[cuboid(DVec3::new(0.0, 0.0, 600.0), DVec3::new(500.0, 500.0, 50.0), 0, 1.0)]));
    scene.beam.spectrum = spectrum(&[(40.0, 0.6), (80.0, 0.4)]);
    let path = 100.0 * obliquity(&view(), 10.0, 80.0);
    let (t40, t80) = ((-mu_per_mm("water", 40.0, 1.0) * path).exp(), (-mu_per_mm("water", 80.0, 1.0) * path).exp());
    let mut cases = 0;
    for (response, expected) in [
        (Response::Energy, (0.6 * 40.0 * t40 + 0.4 * 80.0 * t80) / (0.6 * 40.0 + 0.4 * 80.0)),
        (Response::Counting, 0.6 * t40 + 0.4 * t80),
    ] {
        scene.detector.response = response;
        let found = f64::from(*render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity).pages[0].at(10, 80));
        assert!((found / expected - 1.0).abs() < 1e-5, "{response:?}: {found} and {expected}");
        cases += 1;
    }
    assert_eq!(cases, 2);
    scene.model.formation = Formation::Naive;
    let kappa = 0.6 * mu_per_mm("water", 40.0, 1.0) + 0.4 * mu_per_mm("water", 80.0, 1.0);
    let found = f64::from(*line_integral(&scene).at(10, 80));
    assert!((found - kappa * path).abs() < 1e-4, "Eq. 8");
}

#[test]
fn counts_fall_with_the_third_power_of_obliquity() {
    let mut scene = empty(&["water"]);
    scene.detector.gain = 2.0;
    scene.detector.offset = 7.0;
    let counts = &render_on(DeviceChoice::Cpu, &scene, Quantity::Counts).pages[0];
    let expected = 2.0 * 5e5 * 60.0 * obliquity(&view(), 0.0, 95.0).powi(-3) + 7.0;
    assert!((f64::from(*counts.at(0, 95)) / expected - 1.0).abs() < 1e-6);
}

fn areas(scene: &sidecarm::scene::Scene, column: usize, row: usize) -> Vec<f64> {
    render_on(DeviceChoice::Cpu, scene, Quantity::AreaDensity).pages.iter().map(|page| f64::from(*page.at(column, row))).collect()
}

#[test]
fn later_objects_displace_earlier_ones_and_lumens_nothing() {
    let centre = DVec3::new(0.0, 0.0, 600.0);
    let water = cuboid(centre, DVec3::splat(30.0), 0, 1.0);
    let across = |shape: Shape, material: usize, density: f64| Solid {
        lps_from_local: sidecarm::geometry::Rigid {
            rotation: DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2),
            translation_mm: centre - DVec3::X * 20.0,
        },
        ..solid(shape, DVec3::ZERO, material, density)
    };
    let tube = across(Shape::Cylinder { length_mm: 40.0, radius_mm: 3.0, inner_radius_mm: 2.0 }, 1, 6.45);
    let rod = across(Shape::Cylinder { length_mm: 40.0, radius_mm: 1.0, inner_radius_mm: 0.0 }, 2, 8.0);
    let big = sphere(centre, 10.0, 2, 8.0);
    let materials = ["water", "nitinol", "steel_316l"];
    // The central ray lies half a pixel off the axis, 0.3 mm at the object: chords of circles at that offset.
    let off = 0.3f64;
    let circle = |radius: f64| 2.0 * (radius * radius - off * off).sqrt();
    let ray = obliquity(&view(), 47.0, 47.0);
    let mut cases = 0;
    for (scene, mm) in [
        (
            empty(&materials).with(solids(std::slice::from_ref(&water))).with(solids(std::slice::from_ref(&tube))),
            [60.0 - circle(3.0) + circle(2.0), circle(3.0) - circle(2.0), 0.0],
        ),
        (
            empty(&materials).with(solids(std::slice::from_ref(&water))).with(solids(&[tube.clone(), rod.clone()])),
            [60.0 - circle(3.0) + circle(2.0) - circle(1.0), circle(3.0) - circle(2.0), circle(1.0)],
        ),
        // Tool over tool: the later sphere takes everything within it.
        (
            empty(&materials)
                .with(solids(std::slice::from_ref(&water)))
                .with(solids(std::slice::from_ref(&tube)))
                .with(solids(&[big])),
            [40.0, 0.0, 20.0],
        ),
        // Order matters: water last buries the tube.
        (empty(&materials).with(solids(&[tube])).with(solids(&[water])), [60.0, 0.0, 0.0]),
    ] {
        let found = areas(&scene, 47, 47);
        for (material, density) in [(0, 1.0), (1, 6.45), (2, 8.0)] {
            let expected = 0.1 * density * mm[material];
            assert!(
                (found[material] - expected).abs() < 2e-3 * density * ray,
                "case {cases}: material {material}: {} and {expected}",
                found[material]
            );
        }
        cases += 1;
    }
    assert_eq!(cases, 4);
}

#[test]
fn a_tool_displaces_the_ct_exactly() {
    let size = [40, 40, 40];
    let centre = DVec3::new(0.0, 0.0, 600.0);
    let turn = DQuat::from_scaled_axis(DVec3::new(0.3, -0.4, 0.2));
    let voxels = Arc::new(volume(size, placed(size, centre, DVec3::splat(1.5), turn), &[0], |_| (1, 1.0)));
    let bead = sphere(centre, 5.0, 1, 8.0);
    let alone = areas(&empty(&["water", "steel_316l"]).with(Matter::Volume(voxels.clone())), 47, 47);
    let both = areas(
        &empty(&["water", "steel_316l"]).with(Matter::Volume(voxels.clone())).with(solids(std::slice::from_ref(&bead))),
        47,
        47,
    );
    let chord = chord_mm(centre, 5.0, 47.0, 47.0);
    assert!((both[1] - 0.1 * 8.0 * chord).abs() < 1e-5);
    assert!((alone[0] - both[0] - 0.1 * chord).abs() < 1e-5, "{} - {} and {}", alone[0], both[0], 0.1 * chord);
    let buried = areas(&empty(&["water", "steel_316l"]).with(solids(&[bead])).with(Matter::Volume(voxels)), 47, 47);
    assert_eq!(buried[1], 0.0, "the CT comes later and has matter everywhere");
    assert!((buried[0] - alone[0]).abs() < 1e-6);
}

#[test]
fn homogeneous_volumes_are_boxes_however_they_lie() {
    let centre = DVec3::new(1.0, 2.0, 600.0);
    let turn = DQuat::from_scaled_axis(DVec3::new(0.5, 0.3, -0.7));
    let mut cases = 0;
    for (size, spacing, turn) in [
        ([1, 1, 1], DVec3::splat(30.0), DQuat::IDENTITY),
        ([1, 1, 1], DVec3::new(20.0, 30.0, 40.0), turn),
        ([17, 9, 33], DVec3::new(1.0, -2.0, 0.7), turn),
        ([40, 2, 3], DVec3::new(-0.5, 10.0, 10.0), DQuat::IDENTITY),
        ([100, 100, 5], DVec3::new(0.25, 0.25, 5.0), turn),
    ] {
        let grid = volume(size, placed(size, centre, spacing, turn), &[0], |_| (1, 1.25));
        let half = spacing.abs() * DVec3::from_array(size.map(|n| 0.5 * n as f64));
        let mut block = cuboid(centre, half, 0, 1.25);
        block.lps_from_local.rotation = turn;
        let as_volume = line_integral(&empty(&["water"]).with(Matter::Volume(Arc::new(grid))));
        let as_box = line_integral(&empty(&["water"]).with(solids(&[block])));
        assert!(as_box.pixels.iter().any(|value| *value > 0.1));
        let worst = crate::render_scenes::worst(&as_volume.pixels, &as_box.pixels);
        assert!(worst < 2e-5, "{size:?}: {worst:e}");
        cases += 1;
    }
    assert_eq!(cases, 5);
}

#[test]
fn a_linear_field_is_integrated_exactly() {
    // ρ = 1 + 0.02 z voxels along the central ray; inside the voxel centres the interpolant is that line.
    let size = [9, 9, 51];
    let affine =
        DAffine3::from_translation(DVec3::new(-4.0 * 3.0, -4.0 * 3.0, 575.0)) * DAffine3::from_scale(DVec3::new(3.0, 3.0, 1.0));
    let scene =
        empty(&["water"]).with(Matter::Volume(Arc::new(volume(size, affine, &[0], |[_, _, k]| (1, 1.0 + 0.02 * k as f32)))));
    let ray = obliquity(&view(), 47.0, 47.0);
    // Trapezoid between the centres, constant over the outer half voxels.
    let expected = 0.1 * ray * (50.0 * 1.5 + 0.5 * 1.0 + 0.5 * 2.0);
    let found = areas(&scene, 47, 47)[0];
    assert!((found - expected).abs() < 1e-5, "{found} and {expected}");
}

#[test]
fn a_source_inside_sees_only_what_lies_ahead() {
    let scene = empty(&["water"]).with(solids(&[sphere(DVec3::ZERO, 50.0, 0, 1.0)]));
    assert!((areas(&scene, 47, 47)[0] - 5.0).abs() < 1e-4);
    let size = [50, 50, 50];
    let grid = volume(size, placed(size, DVec3::ZERO, DVec3::splat(2.0), DQuat::IDENTITY), &[0], |_| (1, 1.0));
    let scene = empty(&["water"]).with(Matter::Volume(Arc::new(grid)));
    assert!((areas(&scene, 47, 47)[0] - 5.0 * obliquity(&view(), 47.0, 47.0)).abs() < 1e-4);
    // The detector inside the matter: what lies beyond is not seen.
    let scene = empty(&["water"]).with(solids(&[cuboid(DVec3::new(0.0, 0.0, 1000.0), DVec3::splat(100.0), 0, 1.0)]));
    assert!((areas(&scene, 47, 47)[0] - 10.0 * obliquity(&view(), 47.0, 47.0)).abs() < 1e-4);
}

#[test]
fn a_scan_that_cuts_matter_invalidates_the_rays_that_miss_some() {
    let size = [30, 30, 30];
    let centre = DVec3::new(0.0, 0.0, 600.0);
    let matter = |[_, j, _]: [usize; 3]| if j < 10 { (1, 1.0) } else { (0, 0.0) };
    let mut grid = volume(size, placed(size, centre, DVec3::splat(1.0), DQuat::IDENTITY), &[0], matter);
    grid.truncated_at_faces = true;
    let rendered = render_on(DeviceChoice::Cpu, &empty(&["water"]).with(Matter::Volume(Arc::new(grid))), Quantity::LineIntegral);
    let share = rendered.valid.pixels.iter().filter(|valid| **valid == 0).count() as f64 / (96.0 * 96.0);
    assert_eq!(*rendered.valid.at(47, 25), 0, "through matter at the front face");
    assert_eq!(*rendered.valid.at(47, 70), 1, "through air");
    assert_eq!(*rendered.valid.at(2, 25), 0, "beside the volume, where its tissue goes on");
    assert_eq!(*rendered.valid.at(2, 90), 1, "past the volume, beside its air");
    assert!(share > 0.15 && share < 0.45, "{share}");
    assert!(rendered.notes.iter().any(|note| note.contains("scan cut off")), "{:?}", rendered.notes);
}

#[test]
fn an_empty_image_says_why() {
    let at = |centre: DVec3| empty(&["water"]).with(solids(&[sphere(centre, 20.0, 0, 1.0)]));
    let mut cases = 0;
    for (scene, words) in [
        (empty(&["water"]), "no matter"),
        (at(DVec3::new(0.0, 0.0, -600.0)), "behind the source"),
        (at(DVec3::new(0.0, 0.0, 1500.0)), "behind the detector"),
        (at(DVec3::new(400.0, 10.0, 600.0)), "outside 96 x 96"),
        (empty(&["water"]).with(solids(&[sphere(DVec3::new(-0.3, 0.0, 0.6), 0.02, 0, 1.0)])), "pixel"),
    ] {
        let notes = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity).notes;
        assert!(notes.iter().any(|note| note.contains("image is empty") && note.contains(words)), "{words}: {notes:?}");
        cases += 1;
    }
    // One of many pictures beside the one that is wanted warns nobody.
    for (beside, warnings) in [(false, 1), (true, 0)] {
        let reporter = Reporter::silent();
        let mut renderer = Renderer::new(DeviceChoice::Cpu, &reporter).expect("a renderer");
        let options = Options { beside, ..Options::default() };
        renderer.render(&at(DVec3::new(0.0, 0.0, 1500.0)), &options).expect("an image");
        assert_eq!(reporter.warnings().len(), warnings, "{:?}", reporter.warnings());
    }
    // An off-centre camera: metres for millimetres, RAS for LPS.
    let mut scene = empty(&["water"]).with(solids(&[sphere(DVec3::new(0.1, -0.05, 0.3), 0.02, 0, 1.0)]));
    let mut moved = view();
    moved.camera_from_lps.translation_mm = DVec3::new(-100.0, 50.0, 300.0);
    scene.view = Some(moved);
    let notes = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity).notes;
    assert!(notes.iter().any(|note| note.contains("metres")), "{notes:?}");
    let mut scene = empty(&["water"]).with(solids(&[sphere(DVec3::new(-100.0, 50.0, 300.0), 20.0, 0, 1.0)]));
    scene.view = Some(moved);
    let notes = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity).notes;
    assert!(notes.iter().any(|note| note.contains("RAS and LPS")), "{notes:?}");
    assert_eq!(cases, 5);
}

/// Behind a metre of steel the intensity is 0 in a f32, the line integral is not: the zeros were silent.
#[test]
fn intensities_too_small_for_a_float_are_counted() {
    let behind = |half_mm: f64| {
        let plate = cuboid(DVec3::new(0.0, 0.0, 600.0), DVec3::new(900.0, 900.0, half_mm), 0, 8.0);
        empty(&["steel_316l"]).with(solids(&[plate]))
    };
    let said = |scene: &Scene, quantity: Quantity| {
        let reporter = Reporter::silent();
        let mut renderer = Renderer::new(DeviceChoice::Cpu, &reporter).expect("a renderer");
        let rendered = renderer.render(scene, &Options { quantity, ..Options::default() }).expect("an image");
        let zeros = rendered.pages[0].pixels.iter().filter(|value| **value == 0.0).count();
        let words = format!("{zeros} pixels are 0 because their intensity is below the smallest 32-bit float");
        let said = reporter.warnings().get("underflow").map(|counted| counted.latest.clone());
        (zeros, said.is_some_and(|said| said.starts_with(&words) && rendered.notes.contains(&said)))
    };
    assert_eq!(said(&behind(10.0), Quantity::Intensity), (0, false), "the control");
    let (zeros, warned) = said(&behind(500.0), Quantity::Intensity);
    assert!(zeros > 0 && warned, "{zeros} zeros");
    assert_eq!(said(&behind(500.0), Quantity::LineIntegral), (0, false));
}

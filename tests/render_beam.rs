//! Heel, bow-tie, collimation and focal spot against formulas by hand and the yardstick; each test has a control that must fail.

use glam::{DVec2, DVec3};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::{Options, Quantity, Rendered, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Noise, Response};
use sidecarm::scene::optics::{Axis, BowTie, Field, Heel, Scintillator, Towards};
use sidecarm::scene::physics::{Material, Spectrum};

use crate::render_scenes::{With, cuboid, empty, render_on, software_vulkan, solids, spectrum, worst};

fn cpu(scene: &Scene, quantity: Quantity) -> Rendered {
    render_on(DeviceChoice::Cpu, scene, quantity)
}

fn yardstick(scene: &Scene, quantity: Quantity) -> Rendered {
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    renderer.render(scene, &Options { quantity, reference: true, ..Options::default() }).expect("renders")
}

fn material(name: &str) -> Material {
    Material::parse(name).expect("known")
}

fn mu_per_mm(name: &str, kev: f64) -> f64 {
    let material = material(name);
    0.1 * material.nominal_density_g_per_cm3().expect("nominal") * material.attenuation(kev).expect("inside").total_cm2_per_g
}

/// 5 to 40 mm of aluminium over 2.5 degrees to either side.
pub fn bowtie() -> BowTie {
    let aluminium = material("aluminium");
    let density_g_per_cm3 = aluminium.nominal_density_g_per_cm3().expect("nominal");
    let thickness_mm = vec![[-2.5, 40.0], [0.0, 5.0], [2.5, 30.0]];
    BowTie { material: aluminium, density_g_per_cm3, axis: Axis::Column, thickness_mm }
}

fn heel(anode_angle_deg: f64, anode_towards: Towards) -> Heel {
    Heel { tube_kvp: 110.0, anode_angle_deg, anode_towards }
}

/// 100 mm of water in front of the whole detector, wide enough for oblique rays.
fn water() -> Scene {
    empty(&["water"]).with(solids(&[cuboid(DVec3::new(0.0, 0.0, 600.0), DVec3::new(600.0, 600.0, 50.0), 0, 1.0)]))
}

fn tungsten() -> Spectrum {
    Spectrum::tungsten(110.0, 12.0, &[(material("aluminium"), 3.0)]).expect("inside")
}

/// The view, off the axis: columns from 3 to 14 degrees.
fn off_axis(mut scene: Scene) -> Scene {
    let view = scene.view.as_mut().expect("has one");
    view.intrinsics.cx = -50.0;
    view.intrinsics.fx = 600.0;
    view.intrinsics.fy = 600.0;
    scene
}

fn ray(scene: &Scene, pixel: usize) -> DVec3 {
    let view = scene.view.expect("has one");
    view.intrinsics.unproject(DVec2::new((pixel % 96) as f64, (pixel / 96) as f64))
}

#[test]
fn a_bowtie_attenuates_counts_and_cancels_in_the_intensity_of_one_energy() {
    let mut scene = water();
    let bare = cpu(&scene, Quantity::LineIntegral);
    scene.beam.shape.bowtie = Some(bowtie());
    let shaped = cpu(&scene, Quantity::LineIntegral);
    assert!(worst(&shaped.pages[0].pixels, &bare.pages[0].pixels) < 2e-6, "60 keV alone cannot harden");
    scene.objects.clear();
    let counts = cpu(&scene, Quantity::Counts);
    let mut deepest = 0.0f64;
    for (pixel, found) in counts.pages[0].pixels.iter().enumerate() {
        let ray = ray(&scene, pixel);
        let angle_deg = (ray.x).atan().to_degrees();
        let thickness_mm = if angle_deg < 0.0 { (5.0 - 14.0 * angle_deg).min(40.0) } else { (5.0 + 10.0 * angle_deg).min(30.0) };
        let out_of_plane = (1.0 + ray.y * ray.y / (1.0 + ray.x * ray.x)).sqrt();
        let depth = mu_per_mm("aluminium", 60.0) * (thickness_mm * out_of_plane - 5.0);
        let expected = 5e5 * 60.0 * ray.length().powi(-3) * (-depth).exp();
        assert!((f64::from(*found) / expected - 1.0).abs() < 3e-6, "pixel {pixel}: {found} and {expected}");
        deepest = deepest.max(depth);
    }
    assert!(deepest > 2.0, "the control: {deepest} nepers at the edge would not be overlooked");
}

#[test]
fn a_bowtie_hardens_what_passes_it() {
    let mut scene = water();
    scene.beam.spectrum = spectrum(&[(30.0, 3.0), (90.0, 1.0)]);
    let bare = cpu(&scene, Quantity::LineIntegral);
    scene.beam.shape.bowtie = Some(bowtie());
    let found = cpu(&scene, Quantity::LineIntegral);
    for pixel in [0usize, 47, 95, 48 * 96, 48 * 96 + 48, 95 * 96 + 95] {
        let ray = ray(&scene, pixel);
        let aluminium_mm = bowtie().area_density(ray) / bowtie().density_g_per_cm3 * 10.0;
        // Equal weights 3·30 and 1·90.
        let left = |kev: f64| (-mu_per_mm("aluminium", kev) * aluminium_mm).exp();
        let through = |kev: f64| left(kev) * (-mu_per_mm("water", kev) * 100.0 * ray.length()).exp();
        let expected = -((through(30.0) + through(90.0)) / (left(30.0) + left(90.0))).ln();
        let value = f64::from(found.pages[0].pixels[pixel]);
        assert!((value - expected).abs() < 5e-6, "pixel {pixel}: {value} and {expected}");
        assert!((f64::from(bare.pages[0].pixels[pixel]) - expected).abs() > 0.02, "the control, pixel {pixel}");
    }
}

#[test]
fn heel_bowtie_and_scintillator_agree_with_the_yardstick() {
    let mut cases = 0;
    for (towards, axis, response) in [
        (Towards::PlusColumn, Axis::Column, Response::Energy),
        (Towards::MinusColumn, Axis::Row, Response::Counting),
        (Towards::PlusRow, Axis::Column, Response::Energy),
    ] {
        let mut scene = off_axis(water());
        let view = scene.view.as_mut().expect("has one");
        view.size_px = [24, 24];
        view.intrinsics = view.intrinsics.binned(4.0);
        scene.detector.pitch_mm = 4.0;
        scene.beam.spectrum = tungsten();
        scene.detector.response = response;
        let csi = material("csi");
        scene.detector.panel.scintillator = Some(Scintillator { material: csi, density_g_per_cm3: 4.51, thickness_mm: 0.6 });
        scene.beam.shape.heel = Some(heel(12.0, towards));
        scene.beam.shape.bowtie = Some(BowTie { axis, ..bowtie() });
        let line = cpu(&scene, Quantity::LineIntegral);
        let expected = yardstick(&scene, Quantity::LineIntegral);
        let error = worst(&line.pages[0].pixels, &expected.pages[0].pixels);
        assert!(error <= line.stated_error, "{towards:?}: {error:e}");
        let counts = cpu(&scene, Quantity::Counts).pages.remove(0).pixels;
        let view = scene.view.expect("has one");
        let literal = sidecarm::render::reference::render(&scene, &view, Quantity::Counts).expect("renders").remove(0).pixels;
        let errors: Vec<f64> = counts.iter().zip(&literal).map(|(a, b)| (f64::from(*a) / b - 1.0).abs()).collect();
        let largest = errors.iter().copied().fold(0.0, f64::max);
        println!("{towards:?}: line integrals differ by {error:.1e}, counts by {largest:.1e}");
        assert!(largest < 2e-5, "{towards:?}: {largest:e}");
        scene.beam.shape.heel = Some(heel(13.0, towards));
        let other = cpu(&scene, Quantity::LineIntegral);
        assert!(worst(&other.pages[0].pixels, &expected.pages[0].pixels) > 10.0 * line.stated_error, "the control: 13 degrees");
        scene.beam.shape.heel = Some(heel(12.0, towards));
        scene.detector.panel.scintillator = None;
        let other = cpu(&scene, Quantity::LineIntegral);
        assert!(worst(&other.pages[0].pixels, &expected.pages[0].pixels) > 1e-3, "the control: no scintillator");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

#[test]
fn the_heel_is_the_tables_at_the_take_off_angle() {
    let mut scene = off_axis(empty(&["water"]));
    scene.detector.response = Response::Counting;
    scene.beam.spectrum = Spectrum::tungsten(110.0, 13.0, &[]).expect("inside");
    let photons = |angle: f64| -> f64 {
        Spectrum::tungsten_output(110.0, angle, &[]).expect("inside").bins.iter().map(|bin| bin.fluence).sum()
    };
    let counts = |scene: &Scene| cpu(scene, Quantity::Counts).pages.remove(0).pixels;
    let plain = counts(&scene);
    let mut cases = 0;
    for (towards, sign) in [(Towards::PlusColumn, -1.0), (Towards::MinusColumn, 1.0)] {
        scene.beam.shape.heel = Some(heel(13.0, towards));
        let found = counts(&scene);
        for column in [0usize, 11, 23] {
            // The row nearest to the principal point: rays in the plane of anode and cathode, to 0.05 degrees.
            let pixel = 47 * 96 + column;
            let angle_deg = 13.0 + sign * ray(&scene, pixel).x.atan().to_degrees();
            assert!((6.0..20.0).contains(&angle_deg), "{angle_deg}");
            let expected = photons(angle_deg) / photons(13.0);
            let ratio = f64::from(found[pixel] / plain[pixel]);
            assert!((ratio / expected - 1.0).abs() < 1e-4, "{towards:?} {angle_deg}: {ratio} and {expected}");
            assert!((ratio - 1.0).abs() > 0.05, "the control: the heel is seen");
            cases += 1;
        }
    }
    assert_eq!(cases, 6);
    scene.beam.shape.heel = Some(heel(6.0, Towards::PlusColumn));
    let steep = cpu(&scene, Quantity::Intensity);
    let dark = steep.pages[0].pixels.iter().filter(|value| **value == 0.0).count();
    assert!(dark > 1000 && steep.valid.pixels.iter().filter(|valid| **valid == 0).count() == dark, "{dark} behind the heel");
    assert!(steep.notes.iter().any(|note| note.contains("extrapolated")), "{:?}", steep.notes);
    assert!(steep.pages[0].pixels.iter().all(|value| *value == 0.0 || *value == 1.0));
}

#[test]
fn a_field_is_open_inside_and_dark_outside() {
    let mut scene = water();
    let bare = cpu(&scene, Quantity::LineIntegral);
    scene.beam.shape.field = Some(Field::Circle { diameter_mm: 60.0, centre_mm: DVec2::new(3.3, -2.1) });
    scene.detector.offset = 7.0;
    let [intensity, line, counts] = [Quantity::Intensity, Quantity::LineIntegral, Quantity::Counts].map(|q| cpu(&scene, q));
    let (mut inside, mut outside, mut area) = (0, 0, 0.0);
    for pixel in 0..96 * 96 {
        let distance = (ray(&scene, pixel) * 1000.0).truncate().distance(DVec2::new(3.3, -2.1));
        let open = f64::from(intensity.pages[0].pixels[pixel]) / f64::from(-bare.pages[0].pixels[pixel]).exp();
        area += open;
        let [line, counts] = [&line, &counts].map(|rendered| rendered.pages[0].pixels[pixel]);
        if distance < 29.2 {
            assert_eq!((line, intensity.valid.pixels[pixel]), (bare.pages[0].pixels[pixel], 1));
            inside += 1;
        } else if distance > 30.8 {
            assert_eq!((intensity.pages[0].pixels[pixel], counts, intensity.valid.pixels[pixel]), (0.0, 7.0, 0));
            assert!((f64::from(line) - 1e6f64.ln()).abs() < 1e-5, "−ln 1/(2·5e5): {line}");
            outside += 1;
        } else {
            assert!(line.is_finite() && (-1e-6..=1.0 + 1e-6).contains(&open));
        }
    }
    assert!(inside > 2000 && outside > 6000);
    let expected = std::f64::consts::PI * 900.0;
    assert!((area / expected - 1.0).abs() < 1e-3, "{area} and {expected} px²");
    assert!((area / (std::f64::consts::PI * 30.5 * 30.5) - 1.0).abs() > 1e-2, "the control: half a millimetre more");
    assert!(intensity.notes.iter().any(|note| note.contains("outside the field")), "{:?}", intensity.notes);
}

#[test]
fn fields_of_every_shape_have_their_area() {
    let side = DVec2::new(40.0, 25.0);
    let corners =
        |size: DVec2| [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)].map(|(x, y)| size * DVec2::new(x, y)).to_vec();
    let centre_mm = DVec2::new(4.0, -3.0);
    let turned = Field::Rectangle { size_mm: side, centre_mm, rotation_deg: 30.0 };
    let turn = |corner: &DVec2| DVec2::from_angle(30f64.to_radians()).rotate(*corner) + centre_mm;
    let same = Field::Polygon { corners_mm: corners(side).iter().map(turn).collect() };
    let area = |field: &Field| -> (f64, Vec<f32>) {
        let mut scene = empty(&["water"]);
        scene.beam.shape.field = Some(field.clone());
        let page = cpu(&scene, Quantity::Intensity).pages.remove(0).pixels;
        (page.iter().map(|open| f64::from(*open)).sum(), page)
    };
    let (rectangle, polygon) = (area(&turned), area(&same));
    assert!((rectangle.0 / 1000.0 - 1.0).abs() < 2e-3, "{}", rectangle.0);
    assert_eq!(rectangle.1, polygon.1, "the same opening in other words");
    let mirrored = Field::Rectangle { size_mm: side, centre_mm, rotation_deg: -30.0 };
    assert_ne!(area(&mirrored).1, rectangle.1, "the control: turned the other way");
}

#[test]
fn a_focal_spot_draws_an_edge_as_wide_as_the_magnification_says() {
    // An opaque half-plane, its edge between columns 47 and 48 at half the way: the spot is drawn at its own size.
    let lead = cuboid(DVec3::new(-100.0, 0.0, 500.0), DVec3::new(100.0, 400.0, 10.0), 0, 1e4);
    let mut scene = empty(&["lead"]).with(solids(&[lead]));
    let fwhm_mm = 8.0;
    scene.beam.shape.focal_spot_mm = [fwhm_mm, 2.0];
    let edge = cpu(&scene, Quantity::Intensity);
    let row: Vec<f64> = (0..96).map(|column| f64::from(*edge.pages[0].at(column, 40))).collect();
    let steps: Vec<(f64, f64)> = (1..96).map(|column| (column as f64 - 0.5, row[column] - row[column - 1])).collect();
    let sum: f64 = steps.iter().map(|(_, step)| step).sum();
    let mean = steps.iter().map(|(at, step)| at * step).sum::<f64>() / sum;
    let variance = steps.iter().map(|(at, step)| (at - mean).powi(2) * step).sum::<f64>() / sum;
    // The middle of the scene's bounds is 500 mm away: 1000/500 − 1 = 1 times as wide, in pixels of 1 mm.
    let expected = (fwhm_mm / 2.354_820_045).powi(2);
    assert!((sum - 1.0).abs() < 1e-6 && (mean - 47.5).abs() < 1e-4, "{sum} {mean}");
    assert!((variance / expected - 1.0).abs() < 1e-4, "σ² = {variance} and {expected} px²");
    assert!((variance / (fwhm_mm * 1.02 / 2.354_820_045).powi(2) - 1.0).abs() > 1e-2, "the control: 2 % wider");
    let quarter = (row[47] - 0.5).abs();
    assert!(quarter < 0.07 && row[40] < 0.03 && row[55] > 0.97, "{row:?}");
    // What lies on the detector is drawn sharp.
    let lead = cuboid(DVec3::new(-100.0, 0.0, 999.0), DVec3::new(100.0, 400.0, 0.9), 0, 1e5);
    let mut contact = empty(&["lead"]).with(solids(&[lead]));
    contact.beam.shape.focal_spot_mm = [fwhm_mm, 2.0];
    let page = cpu(&contact, Quantity::Intensity).pages.remove(0);
    assert!(*page.at(46, 40) < 1e-3 && *page.at(49, 40) > 0.999);
}

#[test]
fn shaders_and_twins_shape_the_beam_alike() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let mut scene = off_axis(water());
    scene.beam.spectrum = tungsten();
    scene.beam.shape.heel = Some(heel(12.0, Towards::PlusColumn));
    scene.beam.shape.bowtie = Some(bowtie());
    scene.beam.shape.focal_spot_mm = [0.6, 0.6];
    scene.beam.shape.field = Some(Field::Circle { diameter_mm: 150.0, centre_mm: DVec2::new(90.0, 0.0) });
    scene.detector.panel.blur_fwhm_mm = 1.5;
    let mut cases = 0;
    for (noise, quantity) in [(Noise::Off, Quantity::LineIntegral), (Noise::True, Quantity::Intensity)] {
        scene.model.noise = noise;
        let twin = cpu(&scene, quantity);
        let shaders = vulkan.render(&scene, &Options { quantity, ..Options::default() }).expect("renders");
        assert_eq!(shaders.plan["executor"], "wgsl", "{:?}", shaders.notes);
        assert_eq!(shaders.valid.pixels, twin.valid.pixels);
        let error = worst(&shaders.pages[0].pixels, &twin.pages[0].pixels);
        // With noise, f32 may tip a number by one photon here and there.
        let limit = if noise == Noise::Off { shaders.stated_error } else { 5e-3 };
        assert!(error <= limit, "{quantity:?}: {error:e}");
        scene.beam.shape.heel = None;
        assert!(worst(&cpu(&scene, quantity).pages[0].pixels, &twin.pages[0].pixels) > limit, "the control: {quantity:?}");
        scene.beam.shape.heel = Some(heel(12.0, Towards::PlusColumn));
        cases += 1;
    }
    assert_eq!(cases, 2);
}

//! Scintillator, grid, blur, saturation and digits against formulas by hand; each test has a control that must fail.

use glam::{DVec2, DVec3};
use sidecarm::gpu::DeviceChoice;
use sidecarm::image::Image;
use sidecarm::render::blur::{blur, gaussian_kernel};
use sidecarm::render::{Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Noise, ReadoutNoise, Response};
use sidecarm::scene::optics::{Axis, BowTie, Field, Grid, Heel, Scintillator, Towards};
use sidecarm::scene::physics::{Material, Spectrum};

use crate::render_scenes::{With, cuboid, empty, render_on, solids, spectrum};

fn page(scene: &Scene, quantity: Quantity) -> Image<f32> {
    render_on(DeviceChoice::Cpu, scene, quantity).pages.remove(0)
}

fn layer(thickness_mm: f64) -> Scintillator {
    Scintillator { material: Material::parse("csi").expect("known"), density_g_per_cm3: 4.51, thickness_mm }
}

fn absorbed(kev: f64, thickness_mm: f64) -> f64 {
    let mu = Material::parse("csi").expect("known").attenuation(kev).expect("inside").total_cm2_per_g;
    1.0 - (-0.1 * 4.51 * mu * thickness_mm).exp()
}

fn variance(image: &Image<f32>) -> f64 {
    let n = image.pixels.len() as f64;
    let mean = image.pixels.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    image.pixels.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / n
}

#[test]
fn blur_is_gaussian_its_moments_are_exact_and_it_adds_up() {
    let mut cases = 0;
    for sigma in [0.02, 0.2, 0.5, 1.0, 3.0, 12.0, 40.0] {
        let t: f64 = sigma * sigma;
        let kernel = gaussian_kernel(t);
        let both = |f: fn(f64) -> f64| -> f64 { kernel.iter().enumerate().skip(1).map(|(n, w)| 2.0 * w * f(n as f64)).sum() };
        assert!((kernel[0] + both(|_| 1.0) - 1.0).abs() < 1e-14);
        assert!((both(|n| n * n) / t - 1.0).abs() < 1e-8, "σ = {sigma}: {}", both(|n| n * n));
        assert!(kernel.windows(2).all(|pair| pair[0] >= pair[1] && pair[1] >= 0.0));
        cases += 1;
    }
    assert_eq!(cases, 7);
    // The normal distribution's density at 0, 1 and 2 standard deviations, from tables.
    let kernel = gaussian_kernel(1.0);
    for (n, density) in [0.398_942_280, 0.241_970_725, 0.053_990_967].into_iter().enumerate() {
        assert!((kernel[n] - density).abs() < 1e-7, "{kernel:?}");
    }
    // 1.682 px wide at half maximum: one pixel off the middle it has fallen as far as the Gaussian has, but for the 0.3 % by which the width
    // of so narrow a one is corrected.
    let sigma: f64 = 1.682 / 2.354_820_045;
    let kernel = gaussian_kernel(sigma * sigma);
    let ratio = (-0.5 / (sigma * sigma)).exp();
    assert!((kernel[1] / kernel[0] / ratio - 1.0).abs() < 2e-3, "{kernel:?}");
    let point = || -> Vec<f64> { (0..41 * 33).map(|i| f64::from(i == 16 * 41 + 20)).collect() };
    let (mut twice, mut once) = (point(), point());
    blur(&mut twice, [41, 33], [1.2, 0.9]);
    blur(&mut twice, [41, 33], [1.6, 1.2]);
    blur(&mut once, [41, 33], [2.0, 1.5]);
    // On a raster Gaussians add up but for aliases; of the narrowest, σ = 0.9 px, exp(−π² σ²) = 3e-4 of its highest frequency is folded back.
    let distance = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(distance(&twice, &once) < 1e-5, "variances add up: {:e}", distance(&twice, &once));
    let mut wider = point();
    blur(&mut wider, [41, 33], [2.02, 1.5]);
    assert!(distance(&wider, &once) > 1e-4, "the control");
}

#[test]
fn flat_stays_flat_and_nothing_is_lost_at_the_border() {
    for size in [[1usize, 1usize], [2, 3], [17, 1], [40, 30]] {
        let mut flat = vec![0.7; size[0] * size[1]];
        blur(&mut flat, size, [5.0, 3.0]);
        assert!(flat.iter().all(|value| (value - 0.7).abs() < 1e-13), "{size:?}");
        let mut corner: Vec<f64> = (0..size[0] * size[1]).map(|i| f64::from(i == 0)).collect();
        blur(&mut corner, size, [5.0, 3.0]);
        assert!((corner.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{size:?}");
    }
}

#[test]
fn a_scintillator_weighs_energies_by_what_it_absorbs() {
    let mut scene =
        empty(&["water"]).with(solids(&[cuboid(DVec3::new(0.0, 0.0, 600.0), DVec3::new(600.0, 600.0, 50.0), 0, 1.0)]));
    scene.beam.spectrum = spectrum(&[(30.0, 0.5), (90.0, 0.5)]);
    scene.beam.photons_per_pixel = 1e4;
    scene.detector.panel.scintillator = Some(layer(0.4));
    let water = |kev: f64| Material::parse("water").expect("known").attenuation(kev).expect("inside").total_cm2_per_g;
    let mut cases = 0;
    for response in [Response::Energy, Response::Counting] {
        scene.detector.response = response;
        let r = |kev: f64| absorbed(kev, 0.4) * if response == Response::Energy { kev } else { 1.0 };
        let view = scene.view.expect("has one");
        let ray = view.intrinsics.unproject(DVec2::new(10.0, 20.0));
        let t = |kev: f64| (-water(kev) * 10.0 * ray.length()).exp();
        let expected = (r(30.0) * t(30.0) + r(90.0) * t(90.0)) / (r(30.0) + r(90.0));
        let found = f64::from(*page(&scene, Quantity::Intensity).at(10, 20));
        assert!((found / expected - 1.0).abs() < 3e-6, "{response:?}: {found} and {expected}");
        let counts = f64::from(*page(&scene, Quantity::Counts).at(10, 20));
        let expected = 1e4 * ray.length().powi(-3) * 0.5 * (r(30.0) * t(30.0) + r(90.0) * t(90.0));
        assert!((counts / expected - 1.0).abs() < 3e-6, "{response:?}: {counts} and {expected}");
        let mut all = scene.clone();
        all.detector.panel.scintillator = None;
        assert!((f64::from(*page(&all, Quantity::Counts).at(10, 20)) / expected - 1.0).abs() > 0.1, "the control");
        cases += 1;
    }
    assert_eq!(cases, 2);
}

#[test]
fn undetected_photons_make_noise() {
    let mut scene = empty(&["water"]);
    scene.beam.spectrum = spectrum(&[(30.0, 0.5), (90.0, 0.5)]);
    scene.beam.photons_per_pixel = 1e4;
    scene.model.noise = Noise::True;
    let tolerance = 5.0 * (2.0f64 / 9216.0).sqrt() + 0.004;
    let mut cases = 0;
    for (response, thickness_mm, grid) in
        [(Response::Energy, 0.2, 1.0), (Response::Energy, 0.6, 0.7), (Response::Counting, 0.2, 0.7)]
    {
        scene.detector.response = response;
        scene.detector.panel.scintillator = Some(layer(thickness_mm));
        scene.detector.panel.grid = Some(Grid { primary_transmission: grid, strips: None });
        let n = [30.0, 90.0].map(|kev| 0.5 * 1e4 * grid * absorbed(kev, thickness_mm));
        let e = if response == Response::Energy { [30.0, 90.0] } else { [1.0, 1.0] };
        // Compound Poisson: relative variance Σ n e² / (Σ n e)².
        let expected = (n[0] * e[0] * e[0] + n[1] * e[1] * e[1]) / (n[0] * e[0] + n[1] * e[1]).powi(2);
        let found = variance(&page(&scene, Quantity::Intensity));
        assert!((found / expected - 1.0).abs() < tolerance, "{response:?}: {found} and {expected}");
        let without_layer = 1.0 / (1e4 * grid) * (4500.0 / 3600.0);
        assert!((found / without_layer - 1.0).abs() > 1.5 * tolerance || response == Response::Counting, "the control");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

#[test]
fn the_scintillator_blurs_the_signal_and_correlates_the_noise() {
    let lead = cuboid(DVec3::new(-100.0, 0.0, 500.0), DVec3::new(100.0, 400.0, 10.0), 0, 1e4);
    let mut scene = empty(&["lead"]).with(solids(&[lead]));
    let (fwhm_mm, t) = (3.0, (3.0f64 / 2.354_820_045).powi(2));
    scene.detector.panel.blur_fwhm_mm = fwhm_mm;
    let edge = page(&scene, Quantity::Intensity);
    let steps: Vec<(f64, f64)> =
        (1..96).map(|c| (c as f64 - 48.0, f64::from(*edge.at(c, 9)) - f64::from(*edge.at(c - 1, 9)))).collect();
    let found: f64 = steps.iter().map(|(at, step)| at * at * step).sum();
    assert!((found / t - 1.0).abs() < 1e-4, "σ² = {found} and {t} px²");
    scene.objects.clear();
    scene.model.noise = Noise::True;
    scene.beam.photons_per_pixel = 1e4;
    let noisy = page(&scene, Quantity::Intensity);
    // Blurred white noise has the autocovariance G_2t(n) G_2t(m).
    let twice = gaussian_kernel(2.0 * t);
    let relative = variance(&noisy) * 1e4 / twice[0].powi(2);
    // The blur leaves 9216 / (4π t) independent numbers.
    let tolerance = 5.0 * (2.0 * 4.0 * std::f64::consts::PI * t / 9216.0).sqrt();
    assert!((relative - 1.0).abs() < tolerance, "{relative}");
    let mut sharp = scene.clone();
    sharp.detector.panel.blur_fwhm_mm = 0.0;
    assert!(variance(&page(&sharp, Quantity::Intensity)) * 1e4 / twice[0].powi(2) > 10.0, "the control: without blur");
    let mean = noisy.pixels.iter().map(|v| f64::from(*v)).sum::<f64>() / 9216.0;
    for distance in [1usize, 2] {
        let mut sum = 0.0;
        for row in 0..96 {
            for column in distance..96 {
                sum += (f64::from(*noisy.at(column, row)) - mean) * (f64::from(*noisy.at(column - distance, row)) - mean);
            }
        }
        let found = sum / (96.0 * (96 - distance) as f64) / variance(&noisy);
        let expected = twice[distance] / twice[0];
        assert!((found - expected).abs() < 0.06, "neighbour {distance}: {found} and {expected}");
    }
}

#[test]
fn counts_are_whole_clipped_and_saturated() {
    let mut scene =
        empty(&["water"]).with(solids(&[cuboid(DVec3::new(-50.0, 0.0, 600.0), DVec3::new(50.0, 600.0, 50.0), 0, 1.0)]));
    scene.detector.response = Response::Counting;
    scene.beam.photons_per_pixel = 1000.0;
    let smooth = page(&scene, Quantity::Counts);
    scene.detector.panel.bits = Some(16);
    let whole = page(&scene, Quantity::Counts);
    assert!(whole.pixels.iter().zip(&smooth.pixels).all(|(a, b)| a.fract() == 0.0 && (a - b).abs() <= 0.5));
    assert!(smooth.pixels.iter().any(|value| value.fract() != 0.0), "the control");
    scene.detector.panel.bits = Some(9);
    let nine = render_on(DeviceChoice::Cpu, &scene, Quantity::Counts);
    let full = smooth.pixels.iter().filter(|value| **value >= 510.5).count();
    assert!(full > 2000 && nine.pages[0].pixels.iter().filter(|value| **value == 511.0).count() == full);
    assert!(nine.notes.iter().any(|note| note.contains(&format!("{full} pixels are saturated at 511"))), "{:?}", nine.notes);
    // 0.9 · 511 / 1000: what saturates nearly everything was a note among others.
    let warned = |scene: &Scene| {
        let reporter = Reporter::silent();
        let mut renderer = Renderer::new(DeviceChoice::Cpu, &reporter).expect("device");
        let rendered = renderer.render(scene, &Options { quantity: Quantity::Counts, ..Options::default() }).expect("renders");
        let words = reporter.warnings().get("saturated").map(|warning| warning.latest.clone());
        assert!(words.iter().all(|words| rendered.notes.contains(words)), "{words:?}: {:?}", rendered.notes);
        words
    };
    assert!(warned(&scene).is_some_and(|words| words.ends_with(": a detector.gain of 4.6e-1 fits, it is 1")));
    scene.detector.gain = 0.46;
    assert_eq!(warned(&scene), None, "the gain that fits");
    scene.detector.gain = 1.0;
    scene.detector.panel.bits = None;
    scene.detector.panel.saturation = Some(0.5);
    (scene.detector.gain, scene.detector.offset) = (2.0, 10.0);
    let half = render_on(DeviceChoice::Cpu, &scene, Quantity::Counts);
    let highest = half.pages[0].pixels.iter().copied().fold(0.0f32, f32::max);
    assert!((highest - 1010.0).abs() < 1e-2, "2 · 0.5 · 1000 + 10: {highest}");
    assert!(half.notes.iter().any(|note| note.contains("saturated at 1010")), "{:?}", half.notes);
    let intensity = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
    assert!(intensity.pages[0].pixels.contains(&1.0), "saturation acts on counts only");
    let why =
        &intensity.plan["choices"].as_array().expect("a list").iter().find(|c| c["what"] == "saturation").expect("listed")["why"];
    assert!(why.as_str().expect("text").contains("counts only"), "{why}");
    scene.detector.panel.bits = Some(8);
    scene.detector.offset = -5000.0;
    let below = render_on(DeviceChoice::Cpu, &scene, Quantity::Counts);
    assert!(below.pages[0].pixels.iter().all(|value| *value == 0.0));
    assert!(below.notes.iter().any(|note| note.contains("9216 pixels are at 0 counts")), "{:?}", below.notes);
}

/// Everything at once.
fn full_chain() -> Scene {
    let aluminium = Material::parse("aluminium").expect("known");
    let mut scene = empty(&["water"]).with(solids(&[cuboid(DVec3::new(20.0, 0.0, 600.0), DVec3::new(40.0, 30.0, 50.0), 0, 1.0)]));
    scene.beam.spectrum = Spectrum::tungsten(110.0, 12.0, &[(aluminium.clone(), 3.0)]).expect("inside");
    scene.beam.photons_per_pixel = 2e3;
    scene.beam.shape.bowtie = Some(BowTie {
        material: aluminium,
        density_g_per_cm3: 2.699,
        axis: Axis::Row,
        thickness_mm: vec![[-2.0, 9.0], [0.0, 1.0], [2.0, 9.0]],
    });
    scene.beam.shape.heel = Some(Heel { tube_kvp: 110.0, anode_angle_deg: 12.0, anode_towards: Towards::MinusColumn });
    scene.beam.shape.field = Some(Field::Circle { diameter_mm: 80.0, centre_mm: DVec2::ZERO });
    scene.beam.shape.focal_spot_mm = [1.0, 1.4];
    let panel = &mut scene.detector.panel;
    panel.scintillator = Some(layer(0.5));
    panel.blur_fwhm_mm = 1.2;
    panel.grid = Some(Grid { primary_transmission: 0.7, strips: None });
    panel.saturation = Some(1.1);
    panel.bits = Some(16);
    scene.detector.crosstalk = vec![vec![0.0, 0.05, 0.0], vec![0.05, 0.8, 0.05], vec![0.0, 0.05, 0.0]];
    scene.detector.readout_noise = Some(ReadoutNoise { sigma: 0.004, row_correlation: 0.4 });
    scene.model.noise = Noise::True;
    scene
}

#[test]
fn an_image_does_not_depend_on_threads() {
    let scene = full_chain();
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    // What this machine costs is measured for a number of threads and kept in the user's folder: not for those of a test.
    renderer.plan(&scene, &Options::default()).expect("a plan");
    let mut page = |scene: &Scene, quantity: Quantity| {
        let rendered = renderer.render(scene, &Options { quantity, ..Options::default() });
        rendered.expect("renders").pages.remove(0)
    };
    let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("pool");
    let mut cases = 0;
    for quantity in [Quantity::Intensity, Quantity::LineIntegral, Quantity::Counts] {
        let one = pool(1).install(|| page(&scene, quantity));
        assert!(one.pixels.iter().all(|value| value.is_finite()));
        for threads in [2, 5] {
            let many = pool(threads).install(|| page(&scene, quantity));
            let bits = |image: &Image<f32>| image.pixels.iter().map(|value| value.to_bits()).collect::<Vec<u32>>();
            assert_eq!(bits(&one), bits(&many), "{quantity:?} on {threads} threads");
        }
        let mut other = scene.clone();
        other.model.seed = 2;
        assert_ne!(one.pixels, page(&other, quantity).pixels, "the control: another seed");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

#[test]
fn every_ingredient_is_listed() {
    let choices = |scene: &Scene| -> Vec<(String, bool, String)> {
        let rendered = render_on(DeviceChoice::Cpu, scene, Quantity::Counts);
        let list = rendered.plan["choices"].as_array().expect("a list").clone();
        let text = |choice: &serde_json::Value, key: &str| choice[key].as_str().expect("text").to_owned();
        list.iter().map(|c| (text(c, "what"), c["modelled"].as_bool().expect("yes or no"), text(c, "why"))).collect()
    };
    let ingredients = [
        "bow-tie",
        "heel effect",
        "collimation",
        "blur of the focal spot",
        "scintillator",
        "antiscatter grid",
        "blur of the scintillator",
        "saturation",
        "digits",
    ];
    let (full, bare) = (choices(&full_chain()), choices(&empty(&["water"])));
    for name in ingredients {
        let of = |list: &[(String, bool, String)]| list.iter().find(|(what, ..)| what == name).cloned().expect("listed");
        assert!(of(&full).1, "{name}: {:?}", of(&full));
        assert!(!of(&bare).1 && of(&bare).2 == "not given", "{name}: {:?}", of(&bare));
    }
}

#[test]
fn numbers_that_make_no_sense_are_refused_by_the_renderer_too() {
    type Change = fn(&mut Scene);
    let changes: [(&str, Change); 8] = [
        ("beam.focal_spot_mm", |s| s.beam.shape.focal_spot_mm = [f64::NAN, 1.0]),
        ("beam.field.circle.diameter_mm", |s| {
            s.beam.shape.field = Some(Field::Circle { diameter_mm: f64::NAN, centre_mm: DVec2::ZERO });
        }),
        ("beam.bowtie.thickness_mm", |s| s.beam.shape.bowtie.as_mut().expect("there").thickness_mm[0][1] = -1.0),
        ("detector.blur_fwhm_mm", |s| s.detector.panel.blur_fwhm_mm = -0.1),
        ("detector.saturation", |s| s.detector.panel.saturation = Some(0.0)),
        ("detector.bits", |s| s.detector.panel.bits = Some(40)),
        ("detector.scintillator.thickness_mm", |s| s.detector.panel.scintillator = Some(layer(f64::INFINITY))),
        ("detector.grid.primary_transmission", |s| {
            s.detector.panel.grid = Some(Grid { primary_transmission: 0.0, strips: None })
        }),
    ];
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    assert!(renderer.render(&full_chain(), &Options::default()).is_ok(), "unchanged it renders");
    for (key, change) in changes {
        let mut scene = full_chain();
        change(&mut scene);
        let error = renderer.render(&scene, &Options::default()).expect_err(key).to_string();
        assert!(error.starts_with(key) && !error.contains('\n'), "{key}: {error}");
    }
}

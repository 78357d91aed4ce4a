//! Extremes of DESIGN §10, matter and numbers: every case on the CPU executor and the shaders against the reference, every page finite.

use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::reference::trace;
use sidecarm::render::{Options, Quantity, Rendered, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Mesh, Noise, Response, Shape};
use sidecarm::scene::physics::{Material, Spectrum};
use sidecarm::scene::{self, Scene};

use crate::render_beam::bowtie;
use crate::render_scenes::{
    With, cuboid, empty, obliquity, placed, render_on, software_vulkan, solid, solids, spectrum, sphere, volume, worst,
};

pub const QUANTITIES: [Quantity; 4] = [Quantity::Intensity, Quantity::LineIntegral, Quantity::Counts, Quantity::AreaDensity];

/// A 24×24 view of the same field, so that cases stay quick; `f` changes it.
pub fn small(mut scene: Scene) -> Scene {
    let view = scene.view.as_mut().expect("has one");
    view.size_px = [24, 24];
    view.intrinsics = view.intrinsics.binned(4.0);
    scene.detector.pitch_mm *= 4.0;
    scene
}

/// Executors to try: the CPU, and the shaders where there is a software Vulkan.
pub fn executors() -> Vec<(&'static str, Renderer)> {
    let cpu = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let mut all = vec![("cpu", cpu)];
    all.extend(software_vulkan().map(|renderer| ("software vulkan", renderer)));
    all
}

fn finite(rendered: &Rendered) -> bool {
    rendered.pages.iter().all(|page| page.pixels.iter().all(|value| value.is_finite()))
}

/// Renders every quantity on every executor: all finite, none counted, line integrals within the stated error of the reference.
/// Returns the reference's line integrals.
pub fn judge(what: &str, scene: &Scene, executors: &mut [(&'static str, Renderer)]) -> Vec<f64> {
    let view = scene.view.expect("has one");
    let reference = trace(scene, &view, true).expect("good");
    assert!(reference.line_integral.iter().all(|value| value.is_finite()), "{what}: the reference");
    let expected: Vec<f32> = reference.line_integral.iter().map(|value| *value as f32).collect();
    for (name, renderer) in executors {
        for quantity in QUANTITIES {
            let options = Options { quantity, count_non_finite: true, ..Options::default() };
            let rendered = renderer.render(scene, &options).unwrap_or_else(|error| panic!("{what} on {name}: {error}"));
            assert!(finite(&rendered), "{what} on {name}: {quantity:?} is not finite");
            assert_eq!(rendered.non_finite.expect("asked for").total(), 0, "{what} on {name}: {:?}", rendered.non_finite);
            if quantity == Quantity::LineIntegral {
                let error = worst(&rendered.pages[0].pixels, &expected);
                assert!(error <= rendered.stated_error, "{what} on {name}: {error:e}, stated {:e}", rendered.stated_error);
                let shifted: Vec<f32> = expected.iter().map(|value| value + 2e-3 * value.max(1.0)).collect();
                assert!(worst(&rendered.pages[0].pixels, &shifted) > rendered.stated_error, "{what} on {name}: the control");
            }
        }
    }
    reference.line_integral
}

fn tube_120() -> Spectrum {
    Spectrum::tungsten(120.0, 12.0, &[(Material::parse("aluminium").expect("known"), 4.3)]).expect("inside the tables")
}

fn steel(thickness_mm: f64) -> Scene {
    let slab = cuboid(DVec3::new(0.0, 0.0, 600.0), DVec3::new(900.0, 900.0, 0.5 * thickness_mm), 0, 8.0);
    let mut scene = small(empty(&["steel_316l"]).with(solids(&[slab])));
    scene.beam.spectrum = tube_120();
    // A pixel's centre on the axis: there the path is the thickness.
    let k = &mut scene.view.as_mut().expect("has one").intrinsics;
    (k.cx, k.cy) = (12.0, 12.0);
    scene
}

#[test]
fn twenty_centimetres_of_steel() {
    let scene = steel(200.0);
    let line = judge("20 cm of steel", &scene, &mut executors());
    assert!((line[12 * 24 + 12] - 51.474).abs() < 5e-3, "{}", line[12 * 24 + 12]);
    assert!(line.iter().all(|value| *value < 51.6));
    let mut counting = scene;
    counting.detector.response = Response::Counting;
    assert!(
        judge("counting", &counting, &mut executors())[12 * 24 + 12] > 51.6,
        "the control: photons weigh otherwise than energy"
    );
}

#[test]
fn zero_expected_photons() {
    let mut executors = executors();
    // A metre of steel: e^-244 of the photons; one photon a pixel.
    let mut scene = steel(1000.0);
    scene.beam.photons_per_pixel = 1.0;
    let line = judge("a metre of steel", &scene, &mut executors);
    assert!(line[12 * 24 + 12] > 200.0, "{}", line[12 * 24 + 12]);
    for noise in [Noise::Paper, Noise::True] {
        scene.model.noise = noise;
        for (name, renderer) in &mut executors {
            for quantity in QUANTITIES {
                let options = Options { quantity, count_non_finite: true, ..Options::default() };
                let rendered = renderer.render(&scene, &options).expect("renders");
                let page = &rendered.pages[0].pixels;
                assert!(
                    finite(&rendered) && rendered.non_finite.expect("asked for").total() == 0,
                    "{noise:?} on {name}: {quantity:?}"
                );
                match quantity {
                    Quantity::Intensity | Quantity::Counts => {
                        assert!(page.iter().all(|value| *value == 0.0), "{name}: nothing arrives")
                    }
                    // The stated floor: −ln 1/(2 N0).
                    Quantity::LineIntegral => assert!(page.iter().all(|value| (value - 2f32.ln()).abs() < 1e-6), "{name}"),
                    Quantity::AreaDensity => assert!(page.iter().all(|value| *value > 700.0), "{name}: free of noise"),
                }
            }
        }
    }
}

#[test]
fn one_photon_to_a_thousand_million() {
    let mut scene =
        empty(&["water"]).with(solids(&[cuboid(DVec3::new(0.0, 0.0, 600.0), DVec3::new(400.0, 400.0, 10.0), 0, 1.0)]));
    scene.beam.spectrum = spectrum(&[(60.0, 1.0)]);
    scene.model.noise = Noise::True;
    scene.detector.crosstalk = vec![vec![1.0]];
    let clean = render_on(
        DeviceChoice::Cpu,
        &{
            let mut clean = scene.clone();
            clean.model.noise = Noise::Off;
            clean
        },
        Quantity::Intensity,
    );
    let clean: Vec<f64> = clean.pages[0].pixels.iter().map(|value| f64::from(*value)).collect();
    let mut cases = 0;
    for n0 in [1.0, 1e3, 1e6, 1e9] {
        scene.beam.photons_per_pixel = n0;
        for (name, renderer) in &mut executors() {
            let image = renderer.render(&scene, &Options { count_non_finite: true, ..Options::default() }).expect("renders");
            assert!(finite(&image) && image.non_finite.expect("asked for").total() == 0, "{name} at {n0}");
            // One energy: (I − Ī)/√(Ī/N₀(u)) has mean 0 and variance 1 whatever N₀.
            let view = scene.view.expect("has one");
            let z = |(pixel, (found, mean)): (usize, (&f32, &f64))| {
                let falls = obliquity(&view, (pixel % 96) as f64, (pixel / 96) as f64).powi(-3);
                (f64::from(*found) - mean) / (mean / (n0 * falls)).sqrt()
            };
            let z: Vec<f64> = image.pages[0].pixels.iter().zip(&clean).enumerate().map(z).collect();
            let n = z.len() as f64;
            let (mean, variance) = (z.iter().sum::<f64>() / n, z.iter().map(|z| z * z).sum::<f64>() / n);
            // f32 pages round intensities near 1 to 6e-8, which is 2e-3 σ at 1e9 photons; a Poisson of mean 0.7 has kurtosis 4.5.
            assert!(mean.abs() < 5.0 / n.sqrt() + 2e-3, "{name} at {n0}: mean {mean}");
            assert!((variance - 1.0).abs() < 5.0 * (4.0 / n).sqrt(), "{name} at {n0}: variance {variance}");
            assert!((variance - 2.0).abs() > 0.5, "the control");
            cases += 1;
        }
    }
    assert!(cases >= 4);
}

fn robot(angles_deg: [f64; 5]) -> Scene {
    let text = serde_json::json!({
        "objects": [{"box": {"centre_lps_mm": [0, 0, 600], "size_mm": [90, 90, 40], "material": "water"}},
                    {"robot": {"model": "calibration/robot/cdm.json", "control_angles_deg": angles_deg,
                               "lps_from_base": [[0, 0, 1, 0], [0, 1, 0, -15], [-1, 0, 0, 600], [0, 0, 0, 1]]}}],
        "view": {"size_px": [64, 64], "intrinsics": [[1500, 0, 31.5], [0, 1500, 31.5], [0, 0, 1]],
                 "camera_from_lps": [[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 0.7}});
    scene::load_text(&text.to_string(), Path::new("SCENE.json"), true, &Reporter::silent()).expect("loads")
}

#[test]
fn the_robot_straight_and_at_its_bending_limit() {
    let mut executors = executors();
    let straight = judge("straight", &robot([0.0; 5]), &mut executors);
    let (most, least) =
        (judge("limit", &robot([7.9; 5]), &mut executors), judge("other limit", &robot([-7.9; 5]), &mut executors));
    let beyond = judge("beyond the limit", &robot([40.0; 5]), &mut executors);
    assert!(straight.iter().any(|value| *value > 1.5), "the robot is seen");
    assert!(most.iter().zip(&straight).any(|(a, b)| (a - b).abs() > 0.3), "it bends");
    assert_eq!(most, beyond, "clamped at the limit");
    assert!(most.iter().zip(&least).any(|(a, b)| (a - b).abs() > 1e-3), "towards the source is not away from it");
}

#[test]
fn tools_outside_over_each_other_and_hollow() {
    let mut executors = executors();
    let size = [20, 20, 20];
    let centre = DVec3::new(0.0, 0.0, 600.0);
    let ct =
        Matter::Volume(Arc::new(volume(size, placed(size, centre, DVec3::splat(2.0), DQuat::IDENTITY), &[0], |[i, j, k]| {
            (1, 0.8 + 0.02 * ((i * 7 + j * 3 + k) % 20) as f32)
        })));
    let base = small(empty(&["water", "nitinol", "steel_316l"])).with(ct);
    let alone = judge("no tool", &base, &mut executors);
    let outside =
        base.clone().with(solids(&[sphere(DVec3::new(900.0, 0.0, 600.0), 9.0, 1, 6.45), sphere(centre * 3.0, 9.0, 2, 8.0)]));
    assert_eq!(judge("tool wholly outside the view", &outside, &mut executors), alone);
    let beside = base.clone().with(solids(&[sphere(DVec3::new(0.0, 0.0, 500.0), 9.0, 1, 6.45)]));
    assert!(judge("tool outside the CT", &beside, &mut executors).iter().zip(&alone).all(|(a, b)| a >= b));
    let tube = |radius_mm: f64, inner_radius_mm: f64, material: usize| {
        solid(Shape::Cylinder { length_mm: 40.0, radius_mm, inner_radius_mm }, centre - DVec3::Z * 20.0, material, 6.45)
    };
    let hollow = judge("hollow, along the rays", &base.clone().with(solids(&[tube(9.0, 8.0, 1)])), &mut executors);
    assert!(hollow.iter().zip(&alone).any(|(a, b)| (a - b).abs() > 1.0));
    let over = base.with(solids(&[tube(9.0, 8.0, 1)])).with(solids(&[tube(8.5, 0.0, 2)])).with(solids(&[tube(8.7, 4.0, 1)]));
    assert!(judge("tool over tool over tool", &over, &mut executors).iter().zip(&hollow).any(|(a, b)| (a - b).abs() > 1.0));
}

#[test]
fn a_poisoned_volume_is_counted_pass_by_pass() {
    let size = [8, 8, 8];
    let mut poisoned =
        volume(size, placed(size, DVec3::new(0.0, 0.0, 600.0), DVec3::splat(4.0), DQuat::IDENTITY), &[0], |_| (1, 1.0));
    let healthy = small(empty(&["water"])).with(Matter::Volume(Arc::new(poisoned.clone())));
    judge("healthy", &healthy, &mut executors());
    let middle = poisoned.index(4, 4, 4);
    poisoned.density_g_per_cm3[middle] = f32::NAN;
    let mut scene = small(empty(&["water"])).with(Matter::Volume(Arc::new(poisoned)));
    scene.model.noise = Noise::True;
    let mut cases = 0;
    for (name, renderer) in &mut executors() {
        let options = Options { quantity: Quantity::LineIntegral, count_non_finite: true, ..Options::default() };
        let rendered = renderer.render(&scene, &options).expect("renders");
        let counts = rendered.non_finite.expect("asked for");
        println!("{name}: {counts:?}");
        assert!(counts.integrate_density > 0 && counts.integrate_density < 24 * 24, "{name}: {counts:?}");
        assert!(counts.attenuate_spectrum > 0 && counts.add_noise > 0 && counts.detect > 0, "{name}: {counts:?}");
        // Without noise nothing stands between the NaN and the page.
        let mut clean = scene.clone();
        clean.model.noise = Noise::Off;
        let counts = renderer.render(&clean, &options).expect("renders").non_finite.expect("asked for");
        assert!(counts.detect > 0 && counts.add_noise == 0, "{name}: {counts:?}");
        // A bow-tie attenuates in place of the plain pass.
        clean.beam.shape.bowtie = Some(bowtie());
        let counts = renderer.render(&clean, &options).expect("renders").non_finite.expect("asked for");
        assert!(counts.attenuate_spectrum > 0 && counts.detect > 0, "{name}, bow-tie: {counts:?}");
        let unasked = renderer.render(&scene, &Options { count_non_finite: false, ..options }).expect("renders");
        assert_eq!(unasked.non_finite, None);
        cases += 1;
    }
    assert!(cases >= 1);
    // The counts reach the file.
    let folder = tempfile::tempdir().expect("folder");
    let mut cpu = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let rendered = cpu.render(&scene, &Options { count_non_finite: true, ..Options::default() }).expect("renders");
    let out = folder.path().join("drr.tif");
    sidecarm::render::write_image(&out, &rendered, &scene).expect("writes");
    let text = std::fs::read_to_string(folder.path().join("drr.tif.json")).expect("beside it");
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert!(json["non_finite"]["integrate_density"].as_u64().expect("a count") > 0, "{json}");
}

/// A focal spot exactly on a corner, an edge or a face of a mesh: at a corner the fast path lost the mesh to a quarter of the rays, by up to 17.5
/// nepers, in silence.
#[test]
fn a_source_on_a_mesh_loses_nothing_of_it() {
    let corner = |n: usize| DVec3::new((n & 1) as f64, (n >> 1 & 1) as f64, (n >> 2) as f64) * 40.0;
    let quads = [[0u32, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let cube: Vec<[u32; 3]> = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
    let tetrahedron = vec![[0u32, 2, 1], [0, 1, 4], [0, 4, 2], [1, 2, 4]];
    // No face holds a ray, and rays run along x as well, by which corners are ordered.
    let lps_from_camera = DQuat::from_scaled_axis(DVec3::new(-0.83, 0.91, 0.17));
    let (mut executors, mut cases, mut deep) = (executors(), 0, 0);
    for triangles in [cube, tetrahedron] {
        let [a, b, c] = triangles[0].map(|index| corner(index as usize));
        for source in [a, b, c, a.midpoint(b), b.lerp(c, 0.25), (a + b + c) / 3.0] {
            let vertices_lps_mm = (0..8).map(|n| corner(n) - source).collect();
            let mesh = Mesh { vertices_lps_mm, triangles: triangles.clone(), material: 0, density_g_per_cm3: 1.0 };
            let mut scene = small(empty(&["water"]).with(Matter::Mesh(Arc::new(mesh))));
            // Rays to all sides.
            let view = scene.view.as_mut().expect("has one");
            view.camera_from_lps.rotation = lps_from_camera.inverse();
            let narrower = view.intrinsics.fx / 10.0;
            (view.intrinsics.fx, view.intrinsics.fy) = (10.0, 10.0);
            scene.detector.pitch_mm *= narrower;
            let line = judge(&format!("source at {source}"), &scene, &mut executors);
            deep += line.iter().filter(|line| **line > 0.1).count();
            cases += 1;
        }
    }
    assert!(cases == 12 && deep > 1500, "{deep} rays through the meshes in {cases} cases");
}

//! The Monte Carlo as a whole against what must hold whatever the scene: the ray caster, energy, symmetry, seeds and threads, and one way of
//! scoring against the other.

use glam::{DVec2, DVec3};
use sidecarm::geometry::{Rigid, View};
use sidecarm::image::Image;
use sidecarm::render::Quantity;
use sidecarm::render::reference;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Response, Shape, Solid};
use sidecarm::scene::optics::{Axis, BowTie, Field, Heel, Scintillator, Towards};
use sidecarm::scene::physics::{Material, Spectrum};
use sidecarm::transport::{Estimator, Page, ScatterImage, Simulation, TransportError};

use crate::transport_scenes::{cuboid, histories, is_chance, mixed, run, scene_of, slab, total, view, z_squared};

const GRID: [usize; 2] = [16, 12];

/// The yardstick's intensity, averaged over 16 × 16 rays in each pixel of the transport's raster.
fn cast(scene: &Scene, view: &View) -> Image<f64> {
    const RAYS: usize = 16;
    let factor = f64::from(view.size_px[0]) / (GRID[0] * RAYS) as f64;
    let fine = View {
        size_px: GRID.map(|n| (n * RAYS) as u32),
        intrinsics: view.intrinsics.binned(factor),
        camera_from_lps: view.camera_from_lps,
    };
    let mut scene = scene.clone();
    scene.detector.pitch_mm *= factor;
    let rays = reference::render(&scene, &fine, Quantity::Intensity).expect("renders").remove(0);
    let mean = |pixel: usize| {
        let (column, row) = (pixel % GRID[0], pixel / GRID[0]);
        (0..RAYS * RAYS).map(|n| rays.at(column * RAYS + n % RAYS, row * RAYS + n / RAYS)).sum::<f64>() / (RAYS * RAYS) as f64
    };
    Image { width: GRID[0], height: GRID[1], pixels: (0..GRID[0] * GRID[1]).map(mean).collect() }
}

fn primary(found: &ScatterImage) -> (&Image<f64>, &Image<f64>) {
    (&found.pages[Page::Primary as usize], &found.errors[Page::Primary as usize])
}

/// The yardstick's own mean over a pixel is good to a per cent where edges of steel cross it. Pixels below `darkest` have too few photons for
/// a normal distribution and are left out.
fn against_caster(scene: &Scene, view: &View, found: &ScatterImage, darkest: f64) -> (f64, usize) {
    let (page, error) = primary(found);
    let cast = cast(scene, view);
    let is_dark: Vec<bool> = cast.pixels.iter().map(|value| *value < darkest).collect();
    let bright = |image: &Image<f64>| {
        let kept = image.pixels.iter().zip(&is_dark).filter(|(_, dark)| !**dark).map(|(value, _)| *value);
        let pixels: Vec<f64> = kept.collect();
        Image { width: pixels.len(), height: 1, pixels }
    };
    z_squared(&bright(page), &bright(error), &bright(&cast), &bright(&cast.map(|value| 0.01 * value + 1e-5)))
}

#[test]
fn the_primary_is_the_ray_caster_s_image() {
    let (scene, view) = (mixed(), view(160, 120, 1000.0));
    for (estimator, count, darkest) in [(Estimator::Expected, 200_000, 0.0), (Estimator::Analogue, 1_000_000, 0.005)] {
        let image = run(&scene, &view, histories(count, 3, GRID, estimator));
        let found = against_caster(&scene, &view, &image, darkest);
        assert!(is_chance(found) && found.1 > 120, "{estimator:?}: {found:?}");
    }
    // The control: everything 4 % denser in one of the two.
    let mut denser = scene.clone();
    for object in &mut denser.objects {
        if let Matter::Solids(solids) = &mut object.matter {
            solids.iter_mut().for_each(|solid| solid.density_g_per_cm3 *= 1.04);
        }
    }
    let image = run(&denser, &view, histories(200_000, 3, GRID, Estimator::Expected));
    let off = against_caster(&scene, &view, &image, 0.0);
    assert!(!is_chance(off), "control: {off:?}");
}

#[test]
fn the_primary_is_right_for_tubes_spectra_and_counting_panels() {
    let mut scene = mixed();
    scene.beam.spectrum = Spectrum::tungsten(90.0, 12.0, &[(Material::parse("aluminium").expect("known"), 3.0)]).expect("inside");
    scene.beam.shape.heel = Some(Heel { tube_kvp: 90.0, anode_angle_deg: 12.0, anode_towards: Towards::PlusColumn });
    scene.beam.shape.bowtie = Some(BowTie {
        material: Material::parse("aluminium").expect("known"),
        density_g_per_cm3: 2.7,
        axis: Axis::Row,
        thickness_mm: vec![[-4.0, 12.0], [0.0, 1.0], [4.0, 12.0]],
    });
    scene.detector.response = Response::Counting;
    scene.detector.panel.scintillator =
        Some(Scintillator { material: Material::parse("CsI").expect("a formula"), density_g_per_cm3: 4.51, thickness_mm: 0.3 });
    let view = view(160, 120, 1000.0);
    let image = run(&scene, &view, histories(150_000, 3, GRID, Estimator::Expected));
    let found = against_caster(&scene, &view, &image, 0.0);
    assert!(is_chance(found), "{found:?}");
    // The control: the anode on the other side.
    scene.beam.shape.heel = Some(Heel { tube_kvp: 90.0, anode_angle_deg: 12.0, anode_towards: Towards::MinusRow });
    scene.beam.shape.bowtie = None;
    let found = against_caster(&scene, &view, &image, 0.0);
    assert!(!is_chance(found), "control: {found:?}");
}

#[test]
fn nothing_in_the_beam_is_one_everywhere_and_no_scatter() {
    // So near that the corners get half of what the middle gets.
    let view = view(160, 120, 150.0);
    let ones = Image::filled(GRID[0], GRID[1], 1.0);
    let mut cases = 0;
    for spot_mm in [0.0, 0.5] {
        let mut empty = scene_of(&[], vec![]);
        empty.beam.shape.focal_spot_mm = [spot_mm; 2];
        let found = run(&empty, &view, histories(400_000, 5, GRID, Estimator::Analogue));
        let (page, error) = primary(&found);
        let none = ones.map(|_| 0.0);
        assert!(is_chance(z_squared(page, error, &ones, &none)));
        assert!(!is_chance(z_squared(page, error, &ones.map(|one| 0.97 * one), &none)), "control");
        assert!(found.scatter.pixels.iter().all(|value| *value == 0.0));
        cases += 1;
    }
    assert_eq!(cases, 2);
}

/// A field leaves its share of every pixel open, whatever its shape, and scatter reaches beyond it.
#[test]
fn a_field_closes_the_primary_and_not_the_scatter() {
    let view = view(160, 120, 1000.0);
    let square = [[-50.0, -40.0], [50.0, -40.0], [50.0, 40.0], [-50.0, 40.0]].map(DVec2::from_array).to_vec();
    let fields = [
        Field::Rectangle { size_mm: DVec2::new(100.0, 80.0), centre_mm: DVec2::ZERO, rotation_deg: 0.0 },
        Field::Rectangle { size_mm: DVec2::new(80.0, 100.0), centre_mm: DVec2::ZERO, rotation_deg: 90.0 },
        Field::Polygon { corners_mm: square },
    ];
    let mut found = Vec::new();
    for field in fields {
        let mut scene = slab();
        scene.beam.shape.field = Some(field);
        let image = run(&scene, &view, histories(100_000, 7, GRID, Estimator::Expected));
        let (open, closed) = ([8, 6], [1, 1]);
        let at = |image: &Image<f64>, [column, row]: [usize; 2]| *image.at(column, row);
        assert!((at(primary(&image).0, open) / 0.016_27 - 1.0).abs() < 0.1, "{}", at(primary(&image).0, open));
        assert_eq!(at(primary(&image).0, closed), 0.0);
        assert!(at(&image.scatter, closed) > 0.0 && at(&image.scatter, closed) < at(&image.scatter, open));
        found.push(image);
    }
    let [a, b, c] = found.as_slice() else { panic!("three fields") };
    for other in [b, c] {
        assert!((primary(a).0.pixels.iter().sum::<f64>() / primary(other).0.pixels.iter().sum::<f64>() - 1.0).abs() < 0.02);
    }
}

/// Both ways of scoring have the same expectation, page by page and pixel by pixel, also where the detector touches the body.
#[test]
fn expected_scoring_is_unbiased_against_counting() {
    let mut cases = 0;
    for (name, scene, view) in [("mixed", mixed(), view(160, 120, 1000.0)), ("touching", slab(), view(160, 120, 801.0))] {
        let expected = run(&scene, &view, histories(150_000, 11, [8, 6], Estimator::Expected));
        let analogue = run(&scene, &view, histories(600_000, 12, [8, 6], Estimator::Analogue));
        for page in Page::ALL {
            let index = page as usize;
            let (e, e_error) = (&expected.pages[index], &expected.errors[index]);
            let (a, a_error) = (&analogue.pages[index], &analogue.errors[index]);
            let ((x, sx), (y, sy)) = (total(e, e_error), total(a, a_error));
            assert!(x > 0.0 && ((x - y) / sx.hypot(sy)).abs() < 4.5, "{name}, {page:?}: {x} ± {sx}, {y} ± {sy}");
            let pixels = z_squared(e, e_error, a, a_error);
            assert!(is_chance(pixels), "{name}, {page:?}: {pixels:?}");
            if page == Page::Multiple {
                assert!(!is_chance(z_squared(&e.map(|v| 1.6 * v), e_error, a, a_error)), "control: {name}, {page:?}");
            }
            cases += 1;
        }
    }
    assert_eq!(cases, 8);
}

#[test]
fn no_energy_is_lost_or_made() {
    for (scene, estimator) in [(mixed(), Estimator::Analogue), (slab(), Estimator::Expected)] {
        let found = run(&scene, &view(160, 120, 1000.0), histories(50_000, 1, GRID, estimator));
        let absorbed: f64 = found.absorbed_kev.iter().map(|estimate| estimate.mean).sum();
        let sum = absorbed + found.detected_kev + found.escaped_kev;
        assert!((found.started_kev - 60.0).abs() < 1e-9 && (sum / 60.0 - 1.0).abs() < 1e-9, "{sum}");
        assert!(absorbed > 1.0 && found.detected_kev > 0.1 && found.escaped_kev > 1.0);
    }
}

/// Dose is energy over mass: masses are those of the shapes, what is displaced not counted; over them comes back what was absorbed; and the photons
/// of an exposure are those that its pixels ask for.
#[test]
fn the_dose_is_what_is_absorbed_over_the_mass_that_is_there() {
    let ball = Solid {
        shape: Shape::Ellipsoid { semi_axes_mm: DVec3::splat(20.0) },
        lps_from_local: Rigid::translation(DVec3::new(3.0, -2.0, 690.0)),
        material: 1,
        density_g_per_cm3: 8.0,
    };
    let body = cuboid([0.0, 0.0, 700.0], [200.0, 200.0, 200.0], 0, 1.0);
    let mut scene = scene_of(&["water", "steel_316l"], vec![Matter::Solids(vec![body]), Matter::Solids(vec![ball])]);
    scene.beam.photons_per_pixel = 1e5;
    let view = view(160, 120, 1000.0);
    let asked = histories(50_000, 1, [4, 3], Estimator::Expected);
    let simulation = Simulation::new(&scene, &view, asked).expect("transports");
    let ball_cm3 = 4.0 / 3.0 * std::f64::consts::PI * 2.0_f64.powi(3);
    for (mass, truth_g) in simulation.masses_g().iter().zip([8000.0 - ball_cm3, 8.0 * ball_cm3]) {
        let off_g = (mass.mean - truth_g).abs();
        assert!(off_g < 2e-3 * truth_g && off_g < 4.5 * mass.standard_error, "{mass:?} of {truth_g}");
    }
    let mut tally = simulation.tally();
    simulation.advance(&mut tally, simulation.batches());
    let image = simulation.image(&tally);
    let json = simulation.describe(&image, &scene, "a processor");
    let mean = |key: &str, material: &str| json[key][material]["mean"].as_f64().expect("a number");
    let joules = |material: &&str| mean("dose_gy_per_history", material) * 1e-3 * mean("mass_g", material);
    let kev = ["water", "steel_316l"].iter().map(joules).sum::<f64>() / 1.602_176_634e-16;
    let absorbed_kev = image.started_kev - image.detected_kev - image.escaped_kev;
    assert!((kev / absorbed_kev - 1.0).abs() < 1e-8, "{kev} of {absorbed_kev}");
    // Pixels of 1 mm²: as many photons as they ask for, but for the obliquity of the outer ones.
    let photons = json["exposure"]["photons"].as_f64().expect("a number");
    assert!((0.99..0.999).contains(&(photons / (1e5 * 160.0 * 120.0))), "{photons}");
    let dose_gy = json["exposure"]["dose_gy"]["water"]["mean"].as_f64().expect("a number");
    assert!((dose_gy / photons / mean("dose_gy_per_history", "water") - 1.0).abs() < 1e-9, "{dose_gy}");
    // Some 20 keV of each of 2e9 photons in 8 kg.
    assert!((1e-7..5e-6).contains(&dose_gy), "{dose_gy}");
    let photons_of = |change: &dyn Fn(&mut Scene)| {
        let mut changed = scene.clone();
        change(&mut changed);
        Simulation::new(&changed, &view, asked).expect("transports").histories_of_exposure(1e5)
    };
    let half = Field::Rectangle { size_mm: DVec2::new(80.0, 60.0), centre_mm: DVec2::ZERO, rotation_deg: 0.0 };
    let share = photons_of(&|scene| scene.beam.shape.field = Some(half.clone())) / photons;
    assert!((0.25..0.252).contains(&share), "a quarter of the field: {share}");
    // 5 mm of aluminium let pass 0.69 of 60 keV: so many more start for as many behind it.
    let bowtie = BowTie {
        material: Material::parse("aluminium").expect("known"),
        density_g_per_cm3: 2.7,
        axis: Axis::Row,
        thickness_mm: vec![[-40.0, 5.0], [40.0, 5.0]],
    };
    let share = photons_of(&|scene| scene.beam.shape.bowtie = Some(bowtie.clone())) / photons;
    assert!((1.40..1.50).contains(&share), "{share}");
}

#[test]
fn a_symmetric_scene_gives_a_symmetric_image_and_a_shifted_one_does_not() {
    let asymmetry = |scene: &Scene| {
        let found = run(scene, &view(200, 200, 1000.0), histories(200_000, 2, [10, 10], Estimator::Expected));
        let mirrored = |image: &Image<f64>| Image {
            width: 10,
            height: 10,
            pixels: (0..100).map(|n| *image.at(9 - n % 10, 9 - n / 10)).collect(),
        };
        let (image, error) = (&found.scatter, &found.scatter_error);
        z_squared(image, error, &mirrored(image), &mirrored(error))
    };
    assert!(is_chance(asymmetry(&slab())));
    let shifted = Matter::Solids(vec![cuboid([60.0, 0.0, 700.0], [150.0, 400.0, 200.0], 0, 1.0)]);
    assert!(!is_chance(asymmetry(&scene_of(&["water"], vec![shifted]))), "control");
}

/// Turning room, scene and camera together changes nothing but the draw.
#[test]
fn the_frame_of_the_room_does_not_matter() {
    let (straight, view) = (mixed(), view(160, 120, 1000.0));
    let turn = Rigid {
        rotation: glam::DQuat::from_scaled_axis(DVec3::new(0.4, -0.9, 0.3)),
        translation_mm: DVec3::new(20.0, -300.0, 77.0),
    };
    let mut turned = straight.clone();
    for object in &mut turned.objects {
        match &mut object.matter {
            Matter::Solids(solids) => solids.iter_mut().for_each(|solid| solid.lps_from_local = turn * solid.lps_from_local),
            Matter::Mesh(mesh) => {
                let mesh = std::sync::Arc::make_mut(mesh);
                mesh.vertices_lps_mm.iter_mut().for_each(|vertex| *vertex = turn.transform_point(*vertex));
            }
            Matter::Volume(volume) => {
                let volume = std::sync::Arc::make_mut(volume);
                let affine = glam::DAffine3::from_rotation_translation(turn.rotation, turn.translation_mm);
                volume.lps_from_voxel = affine * volume.lps_from_voxel;
            }
            Matter::Parts(_) => {}
        }
    }
    let turned_view = View { camera_from_lps: view.camera_from_lps * turn.inverse(), ..view };
    let here = run(&straight, &view, histories(100_000, 21, GRID, Estimator::Expected));
    let there = run(&turned, &turned_view, histories(100_000, 22, GRID, Estimator::Expected));
    assert!(is_chance(z_squared(&here.scatter, &here.scatter_error, &there.scatter, &there.scatter_error)));
    let (page, error) = (primary(&here), primary(&there));
    assert!(is_chance(z_squared(page.0, page.1, error.0, error.1)));
    let astray = run(&turned, &view, histories(100_000, 22, GRID, Estimator::Expected));
    assert!(!is_chance(z_squared(page.0, page.1, primary(&astray).0, primary(&astray).1)), "control");
}

#[test]
fn threads_do_not_matter_and_seeds_do() {
    let (scene, view) = (mixed(), view(160, 120, 1000.0));
    let with = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(|| run(&scene, &view, histories(60_000, seed, GRID, Estimator::Expected)))
    };
    let one = with(1, 1);
    assert!(one == with(2, 1) && one == with(3, 1), "bit for bit");
    assert!(one != with(2, 2), "control");
}

#[test]
fn a_run_stops_at_the_precision_that_is_asked_for() {
    let view = view(160, 120, 1000.0);
    let mut wanted = histories(4_000_000, 1, [4, 3], Estimator::Expected);
    wanted.rel_error = Some(0.01);
    let found = run(&slab(), &view, wanted);
    assert!(found.relative_error <= 0.01 && found.histories < 4_000_000, "{} {}", found.relative_error, found.histories);
    let short = run(&slab(), &view, histories(8192, 1, [4, 3], Estimator::Expected));
    assert!(short.relative_error > 0.01 && short.histories == 8192, "control");
}

/// The spread that is stated is the spread that there is: 24 seeds, every pixel.
#[test]
fn standard_errors_are_those_of_repetition() {
    let (scene, view) = (slab(), view(160, 120, 1000.0));
    let runs: Vec<ScatterImage> =
        (100..124).map(|seed| run(&scene, &view, histories(16_384, seed, [4, 3], Estimator::Expected))).collect();
    let count = runs.len() as f64;
    let (mut stated, mut seen) = (0.0, 0.0);
    for pixel in 0..12 {
        let mean = runs.iter().map(|run| run.scatter.pixels[pixel]).sum::<f64>() / count;
        seen += runs.iter().map(|run| (run.scatter.pixels[pixel] - mean).powi(2)).sum::<f64>() / (count - 1.0);
        stated += runs.iter().map(|run| run.scatter_error.pixels[pixel].powi(2)).sum::<f64>() / count;
    }
    // 12 pixels of 23 degrees of freedom: the ratio's standard deviation is 9 % where pixels are independent.
    assert!((stated / seen).ln().abs() < 0.35, "{}", stated / seen);
}

#[test]
fn what_cannot_be_transported_is_refused_in_words() {
    let good = view(160, 120, 1000.0);
    let refused = |scene: &Scene, view: &View, histories| match Simulation::new(scene, view, histories) {
        Ok(_) => panic!("transported"),
        Err(error) => error,
    };
    let plain = histories(1000, 1, GRID, Estimator::Expected);
    let mut scene = slab();
    scene.detector.pitch_mm = f64::NAN;
    assert!(matches!(refused(&scene, &good, plain), TransportError::DetectorDistance { .. }));
    let mut scene = slab();
    scene.model.formation = sidecarm::scene::model::Formation::Naive;
    assert!(matches!(refused(&scene, &good, plain), TransportError::Naive));
    let mut scene = slab();
    if let Matter::Solids(solids) = &mut scene.objects[0].matter {
        solids[0].density_g_per_cm3 = f64::NAN;
    }
    assert!(refused(&scene, &good, plain).to_string().contains("objects[0]"));
    let none = sidecarm::transport::Histories { count: 0, ..plain };
    assert!(matches!(refused(&slab(), &good, none), TransportError::Histories { .. }));
    let nan = sidecarm::transport::Histories { rel_error: Some(f64::NAN), ..plain };
    assert!(matches!(refused(&slab(), &good, nan), TransportError::RelError { .. }));
    let flat = sidecarm::transport::Histories { grid_px: [0, 12], ..plain };
    assert!(matches!(refused(&slab(), &good, flat), TransportError::Grid { .. }));
}

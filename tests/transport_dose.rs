//! Maps of the dose: against the exponential of a pencil beam, against what stays in all, and as files.

use glam::{DAffine3, DMat3, DVec2, DVec3};
use sidecarm::image::sha256_file;
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Scene, Shape, Solid, Volume};
use sidecarm::scene::optics::Field;
use sidecarm::scene::physics::{Material, Spectrum};
use sidecarm::scene::{self, read_volume};
use sidecarm::transport::{Checkpoint, DoseMap, Estimator, Histories, MOST_DOSE_VOXELS, Simulation, Tally};

use crate::log_lab::{sidecarm, text};
use crate::scene_support::{Dice, random_volume, volume};
use crate::transport_command::SCENE;
use crate::transport_scenes::{cuboid, histories, is_chance, mixed, scene_of, view};

const JOULES_OF_KEV: f64 = 1.602_176_634e-16;

/// All histories of `asked`, and their map of at most so many voxels.
fn mapped(scene: &Scene, asked: Histories, most_voxels: usize) -> (Tally, DoseMap) {
    let simulation = Simulation::new(scene, &view(160, 120, 1000.0), asked).expect("transports").with_dose(scene, most_voxels);
    let mut tally = simulation.tally();
    simulation.advance(&mut tally, simulation.batches());
    let map = simulation.dose_map(&tally).expect("asked for");
    (tally, map)
}

/// 30 keV along a thread of water so thin that what is scattered leaves it: what stays between two depths is what interacts there, exp(−μa) −
/// exp(−μb) of the photons, times what a first interaction leaves.
#[test]
fn a_pencil_beam_leaves_its_dose_by_the_exponential() {
    const SLICES: usize = 20;
    let thread = Volume {
        size: [1, 1, SLICES],
        lps_from_voxel: DAffine3 {
            matrix3: DMat3::from_diagonal(DVec3::new(0.2, 0.2, 5.0)),
            translation: DVec3::new(0.0, 0.0, 602.5),
        },
        density_g_per_cm3: vec![1.0; SLICES],
        class: vec![1; SLICES],
        class_materials: vec![0],
        truncated_at_faces: true,
        unknown: Vec::new(),
    };
    let mut scene = scene_of(&["water"], vec![volume(thread)]);
    scene.beam.spectrum = Spectrum::mono(30.0).expect("inside");
    scene.beam.shape.field = Some(Field::Circle { diameter_mm: 0.05, centre_mm: DVec2::ZERO });
    let (tally, map) = mapped(&scene, histories(400_000, 1, [4, 3], Estimator::Analogue), MOST_DOSE_VOXELS);
    assert_eq!(map.grid.size, [1, 1, SLICES]);
    let water = Material::parse("water").expect("known").attenuation(30.0).expect("inside");
    let between = |slice: usize, per_mm: f64| (-per_mm * 5.0 * slice as f64).exp() - (-per_mm * 5.0 * (slice + 1) as f64).exp();
    let found: Vec<_> = (0..SLICES).map(|slice| tally.deposited(slice)).collect();
    let all: f64 = found.iter().map(|stayed| stayed.mean).sum();
    let z_squared = |scale: f64| {
        let per_mm = scale * 0.1 * water.total_cm2_per_g;
        let whole: f64 = (0..SLICES).map(|slice| between(slice, per_mm)).sum();
        let off = |slice: usize| (found[slice].mean - all * between(slice, per_mm) / whole) / found[slice].standard_error;
        ((0..SLICES).map(|slice| off(slice).powi(2)).sum::<f64>(), SLICES)
    };
    assert!(is_chance(z_squared(1.0)), "{:?}", z_squared(1.0));
    assert!(!is_chance(z_squared(1.07)), "the control: {:?}", z_squared(1.07));
    // Absorption leaves all of 30 keV, a Compton scattering 1.65 of it on average; of 2e-4 g.
    let leaves_kev = (30.0 * water.photo_cm2_per_g + 1.65 * water.compton_cm2_per_g) / water.total_cm2_per_g;
    let (dose, mass) = (map.dose_gy[0], map.mass_g[0]);
    let truth_gy = leaves_kev * between(0, 0.1 * water.total_cm2_per_g) * JOULES_OF_KEV / 2e-7;
    assert!((mass.mean / 2e-4 - 1.0).abs() < 1e-9 && mass.standard_error < 1e-12, "{mass:?}");
    assert!((dose.mean / truth_gy - 1.0).abs() < 0.04, "{dose:?}, {truth_gy:e} Gy");
}

/// Whatever stays is in a voxel or outside the map, and over the masses it comes back; and asking for a map changes nothing else.
#[test]
fn a_map_holds_all_energy_that_stays() {
    let scene = mixed();
    let asked = histories(50_000, 1, [4, 3], Estimator::Expected);
    let (tally, map) = mapped(&scene, asked, MOST_DOSE_VOXELS);
    let simulation = Simulation::new(&scene, &view(160, 120, 1000.0), asked).expect("transports");
    let mut plain = simulation.tally();
    simulation.advance(&mut plain, simulation.batches());
    assert!(simulation.image(&plain) == simulation.image(&tally) && simulation.dose_map(&plain).is_none());
    let stays: f64 = simulation.image(&tally).absorbed_kev.iter().map(|absorbed| absorbed.mean).sum();
    let booked = map.inside_kev + map.massless_kev + map.outside_kev;
    assert!((booked / stays - 1.0).abs() < 1e-9, "{booked} of {stays}");
    assert!(map.inside_kev > 0.1 && map.outside_kev > 0.1, "{} {}", map.inside_kev, map.outside_kev);
    let joules: f64 = map.dose_gy.iter().zip(&map.mass_g).map(|(dose, mass)| dose.mean * 1e-3 * mass.mean).sum();
    assert!((joules / JOULES_OF_KEV / map.inside_kev - 1.0).abs() < 1e-9, "{joules:e}");
}

/// A steel ball in water: the map's masses add up to theirs, and a voxel of water alone is known exactly.
#[test]
fn the_masses_of_a_map_are_those_of_the_scene() {
    let ball = Solid {
        shape: Shape::Ellipsoid { semi_axes_mm: DVec3::splat(20.0) },
        material: 1,
        density_g_per_cm3: 8.0,
        ..cuboid([3.0, -2.0, 690.0], [1.0; 3], 1, 8.0)
    };
    let body = cuboid([0.0, 0.0, 700.0], [200.0; 3], 0, 1.0);
    let scene = scene_of(&["water", "steel_316l"], vec![Matter::Solids(vec![body]), Matter::Solids(vec![ball])]);
    let (_, map) = mapped(&scene, histories(8192, 1, [4, 3], Estimator::Analogue), 4096);
    assert_eq!(map.grid.size, [16; 3]);
    let ball_cm3 = 4.0 / 3.0 * std::f64::consts::PI * 2.0_f64.powi(3);
    let (sum, variance) =
        map.mass_g.iter().fold((0.0, 0.0), |(sum, variance), mass| (sum + mass.mean, variance + mass.standard_error.powi(2)));
    let truth_g = 8000.0 + 7.0 * ball_cm3;
    assert!((sum - truth_g).abs() < 4.5 * variance.sqrt() && variance.sqrt() < 5e-3 * truth_g, "{sum} ± {}", variance.sqrt());
    let voxel_g = 1e-3 * map.grid.spacing_mm()[0].powi(3);
    assert!((map.mass_g[0].mean / voxel_g - 1.0).abs() < 1e-9 && map.mass_g[0].standard_error < 1e-6, "{:?}", map.mass_g[0]);
    assert!((map.massless_kev, map.outside_kev) == (0.0, 0.0), "cubes cover all");
}

/// Voxels that are put together hold what theirs hold.
#[test]
fn a_coarse_map_is_the_sum_of_a_fine_one() {
    let lps_from_voxel = DAffine3::from_translation(DVec3::new(-44.0, -40.0, 650.0)) * DAffine3::from_scale(DVec3::splat(8.0));
    let ct = random_volume(&mut Dice::new(3), [12, 11, 10], lps_from_voxel);
    let scene = scene_of(&["water", "bone_cortical"], vec![volume(ct)]);
    let asked = histories(40_000, 1, [4, 3], Estimator::Analogue);
    let ((fine_tally, fine), (coarse_tally, coarse)) = (mapped(&scene, asked, MOST_DOSE_VOXELS), mapped(&scene, asked, 200));
    assert_eq!((fine.grid.size, coarse.grid.size), ([12, 11, 10], [6, 6, 5]));
    let mut sums = vec![0.0; coarse.grid.voxels()];
    for voxel in 0..fine.grid.voxels() {
        let into = fine.grid.coordinates(voxel).map(|n| n / 2);
        sums[coarse.grid.index(into)] += fine_tally.deposited(voxel).mean;
    }
    let mut hit = 0;
    for (voxel, sum) in sums.iter().enumerate() {
        let found = coarse_tally.deposited(voxel).mean;
        assert!((found - sum).abs() < 1e-9 * sum.max(1e-6), "{voxel}: {found} of {sum}");
        hit += usize::from(*sum > 0.0);
    }
    assert!(hit > 100, "{hit}");
}

/// The files: a volume that any reader takes, its errors, and what they are; an interrupted run goes on with its map.
#[test]
fn the_command_writes_a_map_and_goes_on_with_it() {
    let folder = tempfile::tempdir().expect("folder");
    let [path, out, dose] = ["scene.json", "scatter.tif", "dose.nii.gz"].map(|name| folder.path().join(name));
    std::fs::write(&path, SCENE.replace("[200, 200, 200]", "[44, 40, 44]")).expect("writes");
    let plain = ["scatter", text(&path), "--out", text(&out), "--grid-px", "64x48", "--device", "cpu", "--histories", "400000"];
    let with_map = [&plain[..], &["--dose", text(&dose), "--json"]].concat();
    let ran = sidecarm(&with_map);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let files = ["dose.nii.gz", "dose.nii.gz.error.nii.gz", "dose.nii.gz.json"].map(|name| folder.path().join(name));
    let [map, errors] = [&files[0], &files[1]].map(|file| read_volume(file, &Reporter::silent()).expect("a volume"));
    assert_eq!((map.size, errors.size, map.spacing_mm), ([44, 40, 44], [44, 40, 44], [1.0; 3]));
    let first = map.lps_from_voxel.translation;
    assert!(first.distance(DVec3::new(-21.5, -19.5, -21.5)) < 1e-5, "{first}");
    assert!(map.values.iter().chain(&errors.values).all(|gy| gy.is_finite() && *gy >= 0.0));
    let said: serde_json::Value = serde_json::from_slice(&std::fs::read(&files[2]).expect("beside it")).expect("JSON");
    let number =
        |pointer: &str| said.pointer(pointer).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{pointer}: {said}"));
    let largest = map.values.iter().copied().fold(0.0, f32::max);
    assert!((f64::from(largest) / number("/largest_gy") - 1.0).abs() < 1e-6 && largest > 0.0, "{largest}");
    let at = map.values.iter().position(|gy| *gy == largest).expect("it is one of them");
    assert!((f64::from(errors.values[at]) / number("/largest_standard_error_gy") - 1.0).abs() < 1e-6, "{}", errors.values[at]);
    // In all, per photon: dose times mass is what stays.
    let kev = number("/mean_gy") * number("/per_history") * 1e-3 * number("/mass_g") / JOULES_OF_KEV;
    assert!((kev / number("/energy_kev_per_history/inside") - 1.0).abs() < 1e-9, "{kev}");
    let absorbed = ran.json()["energy_kev_per_history"]["absorbed"].clone();
    let stays: f64 = ["water", "titanium"].iter().map(|name| absorbed[name]["mean"].as_f64().expect("a number")).sum();
    let part = |part: &&str| number(&format!("/energy_kev_per_history/{part}"));
    let booked: f64 = ["inside", "massless", "outside"].iter().map(part).sum();
    assert!((booked / stays - 1.0).abs() < 1e-9 && stays > 1.0, "{booked} of {stays}");
    assert_eq!(sidecarm(&["info", text(&files[0]), "--json"]).code, Some(0));

    // What a run leaves that is stopped after its first step.
    let straight = files.clone().map(|file| std::fs::read(file).expect("reads"));
    let scene = scene::load(&path, true, &Reporter::silent()).expect("loads");
    let histories = Histories { count: 400_000, seed: 7, grid_px: [64, 48], ..Histories::default() };
    let simulation = Simulation::new(&scene, &scene.view.expect("a view"), histories).expect("prepares");
    let simulation = simulation.with_dose(&scene, MOST_DOSE_VOXELS);
    let mut tally = simulation.tally();
    simulation.advance(&mut tally, simulation.batches_at_once());
    let inputs: Vec<String> = std::iter::once(sha256_file(&path).expect("hashes"))
        .chain(scene.inputs.iter().map(|input| input.sha256.clone()))
        .collect();
    let checkpoint = folder.path().join("scatter.tif.checkpoint");
    Checkpoint::new(&histories, "cpu", &inputs, &tally).write(&checkpoint).expect("writes");
    let without = sidecarm(&plain);
    let words = "the dose map is of 77440 voxels there and none here";
    assert!(without.code == Some(1) && without.stderr.contains(words), "{}", without.stderr);
    let again = sidecarm(&with_map);
    assert!(again.code == Some(0) && again.stderr.contains("going on after"), "{}", again.stderr);
    assert!(files.map(|file| std::fs::read(file).expect("reads")) == straight, "bit for bit");
}

#[test]
fn a_map_that_cannot_be_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let [path, out] = ["scene.json", "scatter.tif"].map(|name| folder.path().join(name));
    std::fs::write(&path, SCENE).expect("writes");
    let run = |more: &[&str]| {
        let base = ["scatter", text(&path), "--out", text(&out), "--histories", "10", "--device", "cpu"];
        sidecarm(&[&base[..], more].concat())
    };
    let tiff = folder.path().join("dose.tif");
    let usage = run(&["--dose", text(&tiff)]);
    assert!(usage.code == Some(2) && usage.stderr.contains(".nii.gz"), "{}", usage.stderr);
    let volume = folder.path().join("dose.nii");
    let start = SCENE.find("[{").expect("objects");
    let end = SCENE.find("\"view\"").expect("a view");
    std::fs::write(&path, format!("{}[],\n{}", &SCENE[..start], &SCENE[end..])).expect("writes");
    let empty = run(&["--dose", text(&volume)]);
    assert!(empty.code == Some(1) && empty.stderr.contains("no matter"), "{}", empty.stderr);
    assert!(!volume.exists() && !out.exists());
    // The control: a block has a dose; after one batch its error is all of it, and not none.
    std::fs::write(&path, SCENE.replace("[200, 200, 200]", "[44, 40, 44]")).expect("writes");
    let block = run(&["--dose", text(&volume)]);
    assert_eq!(block.code, Some(0), "{}", block.stderr);
    let files = [volume, folder.path().join("dose.nii.error.nii.gz")];
    let [map, errors] = files.map(|file| read_volume(&file, &Reporter::silent()).expect("a volume").values);
    assert!(map == errors && map.iter().any(|gy| *gy > 0.0));
}

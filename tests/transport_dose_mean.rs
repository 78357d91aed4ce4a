//! How well the mean of a map of the dose is known, and beams whose photons cannot be counted.

use sidecarm::scene::model::Matter;
use sidecarm::scene::optics::{Axis, BowTie};
use sidecarm::scene::physics::{Material, Spectrum};
use sidecarm::transport::{BATCH, Estimator, Simulation, TransportError};

use crate::transport_scenes::{cuboid, histories, scene_of, view};

/// Runs of other seeds, and voxels of their maps.
const SEEDS: u64 = 32;
const VOXELS: usize = 4096;

/// A photon that ends in one voxel ends in no other: errors of voxels, added up as if they knew nothing of each other, are several times that of
/// their sum.
#[test]
fn the_error_of_a_mean_dose_is_what_seeds_spread_by() {
    let body = cuboid([0.0, 0.0, 700.0], [200.0; 3], 0, 1.0);
    let mut scene = scene_of(&["water"], vec![Matter::Solids(vec![body])]);
    scene.beam.spectrum = Spectrum::mono(20.0).expect("inside");
    let view = view(160, 120, 1000.0);
    let run = |seed: u64| {
        let asked = histories(5 * BATCH, seed, [4, 3], Estimator::Analogue);
        let simulation = Simulation::new(&scene, &view, asked).expect("transports").with_dose(&scene, VOXELS);
        let mut tally = simulation.tally();
        simulation.advance(&mut tally, simulation.batches());
        (simulation, tally)
    };
    let (mut means, mut variance, mut of_voxels) = (Vec::new(), 0.0, 0.0);
    for seed in 1..=SEEDS {
        let (_, tally) = run(seed);
        let (within, voxels) = (tally.deposited_within(), tally.dose_voxels().expect("a map"));
        means.push(within.mean);
        variance += within.standard_error.powi(2) / SEEDS as f64;
        of_voxels += (0..voxels).map(|voxel| tally.deposited(voxel).standard_error.powi(2)).sum::<f64>() / SEEDS as f64;
    }
    let mean = means.iter().sum::<f64>() / SEEDS as f64;
    let spread = (means.iter().map(|found| (found - mean).powi(2)).sum::<f64>() / (SEEDS - 1) as f64).sqrt();
    // Known to a seventh: of 31 degrees of freedom, and of 32 times 4.
    let ratios = [variance, of_voxels].map(|variance| spread / variance.sqrt());
    assert!((0.6..1.6).contains(&ratios[0]), "{ratios:?}");
    assert!(ratios[1] < 0.55, "the control: {ratios:?}");

    // As it is told: the mass is known better.
    let folder = tempfile::tempdir().expect("folder");
    let (simulation, tally) = run(1);
    let map = simulation.dose_map(&tally).expect("asked for");
    let said = map.write(&folder.path().join("dose.nii"), &scene, (&simulation, &tally, "cpu")).expect("writes");
    let number = |key: &str| said[key].as_f64().unwrap_or_else(|| panic!("{key}: {said}"));
    let (within, relative) = (tally.deposited_within(), number("mean_standard_error_gy") / number("mean_gy"));
    assert!((relative * within.mean / within.standard_error - 1.0).abs() < 0.05, "{relative}, {within:?}");
}

/// The photons of an exposure were infinite, and so was every dose.
#[test]
fn a_beam_without_a_photon_on_the_principal_ray_is_refused() {
    let mut scene = scene_of(&["water"], vec![]);
    let mut begun = |centre_mm: f64| {
        scene.beam.shape.bowtie = Some(BowTie {
            material: Material::parse("steel_316l").expect("known"),
            density_g_per_cm3: 8.0,
            axis: Axis::Row,
            thickness_mm: vec![[-1.0, 5000.0], [0.0, centre_mm], [1.0, 5000.0]],
        });
        let asked = histories(BATCH, 1, [4, 3], Estimator::Expected);
        Simulation::new(&scene, &view(160, 120, 1000.0), asked).map(|simulation| simulation.histories_of_exposure(1.0))
    };
    let dark = begun(5000.0);
    assert!(matches!(dark, Err(TransportError::DarkPrincipalRay)), "{dark:?}");
    let lit = begun(0.0);
    assert!(lit.as_ref().is_ok_and(|photons| photons.is_finite() && *photons > 0.0), "the control: {lit:?}");
}

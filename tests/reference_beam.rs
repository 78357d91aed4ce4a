//! The reference's energy sums against numbers from elsewhere and formulas by hand.

use glam::{DAffine3, DVec3};
use sidecarm::geometry::Rigid;
use sidecarm::render::Quantity;
use sidecarm::render::reference;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Formation, Matter, Response, Shape, Volume};
use sidecarm::scene::physics::{Bin, Material, Spectrum};

use super::scene_support::{scene, solid, view, volume};

fn slab(material: &str, thickness_mm: f64) -> Scene {
    let half_size_mm = DVec3::new(500.0, 500.0, 0.5 * thickness_mm);
    let mut slab = solid(Shape::Cuboid { half_size_mm }, Rigid::IDENTITY, 0);
    slab.density_g_per_cm3 = Material::parse(material).expect("known").nominal_density_g_per_cm3().expect("nominal");
    scene(&[material], vec![Matter::Solids(vec![slab])])
}

fn tube_120() -> Spectrum {
    Spectrum::tungsten(120.0, 12.0, &[(Material::parse("aluminium").expect("known"), 4.3)]).expect("inside the tables")
}

#[test]
fn twenty_centimetres_of_steel_are_51_474_nepers() {
    let mut steel = slab("steel_316l", 200.0);
    steel.beam.spectrum = tube_120();
    let found = reference::line_integral(&steel, &[160.0]).expect("tabulated");
    // Another program's tables: xraylib and SpekPy on one-keV bins.
    assert!((found - 51.474).abs() < 0.02, "{found}");
    steel.detector.response = Response::Counting;
    let counting = reference::line_integral(&steel, &[160.0]).expect("tabulated");
    assert!(counting > found + 0.1, "counting weighs the hard end less: {counting}");
}

#[test]
fn half_a_metre_of_air_in_a_ct_is_exactly_one() {
    let made = Volume {
        size: [4, 4, 4],
        lps_from_voxel: DAffine3::from_scale_rotation_translation(
            DVec3::splat(128.0),
            glam::DQuat::IDENTITY,
            DVec3::splat(-192.0),
        ),
        density_g_per_cm3: vec![0.0; 64],
        class: vec![0; 64],
        class_materials: Vec::new(),
        truncated_at_faces: true,
        unknown: Vec::new(),
    };
    let mut air = scene(&[], vec![volume(made)]);
    air.beam.spectrum = tube_120();
    let intensity = reference::render(&air, &view(600.0), Quantity::Intensity).expect("good");
    assert!(intensity[0].pixels.iter().all(|x| *x == 1.0));
}

#[test]
fn one_energy_is_beer_and_lambert_two_energies_harden() {
    let mut water = slab("water", 200.0);
    let mu = |kev: f64| Material::parse("water").expect("known").attenuation(kev).expect("tabulated").total_cm2_per_g;
    assert!((reference::line_integral(&water, &[20.0]).expect("tabulated") - 20.0 * mu(60.0)).abs() < 1e-12);
    let bins = vec![Bin { energy_kev: 30.0, fluence: 3.0 }, Bin { energy_kev: 90.0, fluence: 1.0 }];
    water.beam.spectrum = Spectrum { bins };
    // Energy response: weights 3·30 and 1·90, that is a half each.
    let expected = -(0.5 * (-20.0 * mu(30.0)).exp() + 0.5 * (-20.0 * mu(90.0)).exp()).ln();
    let found = reference::line_integral(&water, &[20.0]).expect("tabulated");
    assert!((found - expected).abs() < 1e-12, "{found} {expected}");
    let mean = 0.5 * 20.0 * (mu(30.0) + mu(90.0));
    assert!(mean - found > 0.5, "without hardening it would be {mean}");
}

#[test]
fn thousands_of_nepers_have_no_floor() {
    let lead = slab("lead", 200.0);
    let found = reference::line_integral(&lead, &[1e5]).expect("tabulated");
    assert!(found.is_finite() && found > 1e5, "{found}");
}

#[test]
fn obliquity_is_in_counts_and_not_in_intensity() {
    let mut water = slab("water", 0.001);
    water.objects.clear();
    let mut oblique = view(600.0);
    oblique.intrinsics.cx = -2000.0;
    let counts = reference::render(&water, &oblique, Quantity::Counts).expect("good");
    let intensity = reference::render(&water, &oblique, Quantity::Intensity).expect("good");
    assert!(intensity[0].pixels.iter().all(|x| *x == 1.0));
    let tangent = [2000.0 / 5000.0, 23.5 / 5000.0];
    let cosine = (1.0_f64 + tangent[0] * tangent[0] + tangent[1] * tangent[1]).powf(-0.5);
    let expected = 5e5 * 60.0 * cosine.powi(3);
    assert!((counts[0].pixels[0] / expected - 1.0).abs() < 1e-12, "{} {expected}", counts[0].pixels[0]);
    assert!(cosine.powi(3) < 0.82);
}

#[test]
fn naive_formation_has_one_coefficient_for_everything() {
    let mut two = scene(&["water", "bone_cortical"], Vec::new());
    two.model.formation = Formation::Naive;
    two.beam.spectrum = Spectrum { bins: vec![Bin { energy_kev: 40.0, fluence: 1.0 }, Bin { energy_kev: 80.0, fluence: 3.0 }] };
    let mu = |name: &str, kev: f64| Material::parse(name).expect("known").attenuation(kev).expect("tabulated").total_cm2_per_g;
    let kappa = 0.5
        * (0.25 * mu("water", 40.0)
            + 0.75 * mu("water", 80.0)
            + 0.25 * mu("bone_cortical", 40.0)
            + 0.75 * mu("bone_cortical", 80.0));
    let found = reference::line_integral(&two, &[3.0, 4.0]).expect("tabulated");
    assert!((found - kappa * 7.0).abs() < 1e-12, "{found}");
}

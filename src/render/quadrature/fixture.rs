//! Real bins for the tests; the one place that knows where they come from.

use crate::scene::physics::{Material, Spectrum};

/// Bins of a 120 kV-like beam (`kvp` 40, 80, 120 or 140; 4.3 mm Al), photon fractions, and mass attenuations by material.
pub struct Fixture {
    pub energies_kev: Vec<f64>,
    pub photons: Vec<f64>,
    pub cm2_per_g: Vec<Vec<f64>>,
}

/// `materials` by name.
pub fn fixture(kvp: u32, materials: &[&str]) -> Fixture {
    let aluminium = Material::parse("aluminium").expect("known");
    let spectrum = Spectrum::tungsten(f64::from(kvp), 12.0, &[(aluminium, 4.3)]).expect("inside");
    let energies_kev: Vec<f64> = spectrum.bins.iter().map(|bin| bin.energy_kev).collect();
    let row = |name: &&str| {
        let material = Material::parse(name).expect("known");
        energies_kev.iter().map(|kev| material.attenuation(*kev).expect("inside").total_cm2_per_g).collect()
    };
    Fixture {
        photons: spectrum.bins.iter().map(|bin| bin.fluence).collect(),
        cm2_per_g: materials.iter().map(row).collect(),
        energies_kev,
    }
}

/// A named scene: tube voltage, whether the detector counts, materials with their largest g/cm².
pub type Case = (&'static str, u32, bool, &'static [(&'static str, f64)]);

/// g/cm² = mm / 10 × g/cm³.
pub const CASES: &[Case] = &[
    ("tissue 400", 120, false, &[("soft_tissue", 42.4)]),
    ("tissue 400, bone 80", 120, false, &[("soft_tissue", 42.4), ("bone_cortical", 15.36)]),
    (
        "tissue 300, bone 50, steel 5, nitinol 6",
        120,
        false,
        &[("soft_tissue", 31.8), ("bone_cortical", 9.6), ("steel_316l", 4.0), ("nitinol", 3.87)],
    ),
    (
        "tissue 400, bone 80, steel 20, nitinol 10",
        120,
        false,
        &[("soft_tissue", 42.4), ("bone_cortical", 15.36), ("steel_316l", 16.0), ("nitinol", 6.45)],
    ),
    ("tissue 400, bone 80, steel 20", 120, false, &[("soft_tissue", 42.4), ("bone_cortical", 15.36), ("steel_316l", 16.0)]),
    ("the same three, counting", 120, true, &[("soft_tissue", 42.4), ("bone_cortical", 15.36), ("steel_316l", 16.0)]),
    ("the same three, 40 kV", 40, false, &[("soft_tissue", 42.4), ("bone_cortical", 15.36), ("steel_316l", 16.0)]),
    ("the same three, 80 kV", 80, false, &[("soft_tissue", 42.4), ("bone_cortical", 15.36), ("steel_316l", 16.0)]),
    ("the same three, 140 kV", 140, false, &[("soft_tissue", 42.4), ("bone_cortical", 15.36), ("steel_316l", 16.0)]),
    ("water 300, lead 2", 120, false, &[("water", 30.0), ("lead", 2.27)]),
    ("water 300, iodine 0.3 g/cm2", 120, false, &[("water", 30.0), ("I", 0.3)]),
    ("tissue 300, bone 50, iodine 0.3 g/cm2", 120, false, &[("soft_tissue", 31.8), ("bone_cortical", 9.6), ("I", 0.3)]),
    ("water 300, tungsten 1", 120, false, &[("water", 30.0), ("W", 1.93)]),
    ("water 300, Gd 0.3 g/cm2, CsI 1", 120, false, &[("water", 30.0), ("Gd", 0.3), ("CsI", 0.451)]),
    ("steel 200", 120, false, &[("steel_316l", 160.0)]),
    (
        "tissue 300, bone 50, lead 2, W 1, I 0.3",
        120,
        false,
        &[("soft_tissue", 31.8), ("bone_cortical", 9.6), ("lead", 2.27), ("W", 1.93), ("I", 0.3)],
    ),
    (
        "eight materials",
        120,
        false,
        &[
            ("soft_tissue", 31.8),
            ("bone_cortical", 9.6),
            ("steel_316l", 4.0),
            ("nitinol", 3.87),
            ("titanium", 4.54),
            ("pmma", 6.0),
            ("aluminium", 5.4),
            ("copper", 2.7),
        ],
    ),
];

/// Bins of a case: fixture, signal weights, squares, largest.
pub fn bins_of(case: &Case) -> (Fixture, Vec<f64>, Vec<f64>, Vec<f64>) {
    let (_, kvp, counting, materials) = case;
    let names: Vec<&str> = materials.iter().map(|(name, _)| *name).collect();
    let fixture = fixture(*kvp, &names);
    let response = |energy: &f64| if *counting { 1.0 } else { *energy };
    let signal: Vec<f64> = fixture.photons.iter().zip(&fixture.energies_kev).map(|(p, e)| p * response(e)).collect();
    let squares = signal.iter().zip(&fixture.energies_kev).map(|(s, e)| s * response(e)).collect();
    let sum: f64 = signal.iter().sum();
    let largest = materials.iter().map(|(_, largest)| *largest).collect();
    (fixture, signal.iter().map(|s| s / sum).collect(), squares, largest)
}

//! The Monte Carlo's samplers against the formulas they stand for, with the shipped tables of S and F read by the tests themselves.

use sidecarm::scene::physics::{Material, atomic_weight, form_factors};
use sidecarm::transport::{Compton, Rayleigh, Stream, energy_ratio};

const BINS: usize = 40;
const DRAWS: u32 = 1_000_000;

/// χ² with 39 degrees of freedom exceeds this with a probability of 1e-5.
const CHI_SQUARED_39: f64 = 88.0;

fn material(name: &str) -> Material {
    Material::parse(name).expect("known")
}

/// Σ wᵢ/Aᵢ g(Zᵢ).
fn over_atoms(material: &Material, of: impl Fn(u8) -> f64) -> f64 {
    material.composition.iter().map(|(z, fraction)| fraction / atomic_weight(*z).expect("an element") * of(*z)).sum()
}

/// sin(θ/2)/λ, 1/Å.
fn momentum(energy_kev: f64, cosine: f64) -> f64 {
    energy_kev / 12.398_419_8 * (0.5 * (1.0 - cosine)).sqrt()
}

/// Klein and Nishina's cross section per solid angle of a free electron, in units of r_e²/2.
fn klein_nishina(energy_kev: f64, cosine: f64) -> f64 {
    let ratio = 1.0 / (1.0 + energy_kev / 510.998_95 * (1.0 - cosine));
    ratio * ratio * (ratio + 1.0 / ratio - (1.0 - cosine * cosine))
}

fn compton_by_angle(material: &Material, energy_kev: f64, cosine: f64) -> f64 {
    let bound = |z| form_factors(z).expect("tabulated").incoherent(momentum(energy_kev, cosine));
    klein_nishina(energy_kev, cosine) * over_atoms(material, bound)
}

fn rayleigh_by_angle(material: &Material, energy_kev: f64, cosine: f64) -> f64 {
    let square = |z| form_factors(z).expect("tabulated").form(momentum(energy_kev, cosine)).powi(2);
    (1.0 + cosine * cosine) * over_atoms(material, square)
}

/// ∫ f(c) dc between two cosines by Simpson's rule in √(1 − c), in which forward peaks are smooth.
fn integral(from: f64, to: f64, f: impl Fn(f64) -> f64) -> f64 {
    let (low, high) = ((1.0 - to).max(0.0).sqrt(), (1.0 - from).sqrt());
    let count = 200;
    let step = (high - low) / f64::from(count);
    let term = |n: i32| {
        let root = low + f64::from(n) * step;
        let weight = if n == 0 || n == count {
            1.0
        } else if n % 2 == 1 {
            4.0
        } else {
            2.0
        };
        weight * f(1.0 - root * root) * 2.0 * root
    };
    step / 3.0 * (0..=count).map(term).sum::<f64>()
}

/// χ² of drawn cosines against a density by angle; bins of equal width in √(1 − c).
fn chi_squared(mut draw: impl FnMut() -> f64, density: impl Fn(f64) -> f64 + Copy) -> f64 {
    let edge = |n: usize| 1.0 - 2.0 * (n as f64 / BINS as f64).powi(2);
    let total = integral(-1.0, 1.0, density);
    let mut counts = [0.0; BINS];
    for _ in 0..DRAWS {
        let cosine = draw();
        assert!((-1.0..=1.0).contains(&cosine));
        counts[(((0.5 * (1.0 - cosine)).sqrt() * BINS as f64) as usize).min(BINS - 1)] += 1.0;
    }
    let expected = |n: usize| f64::from(DRAWS) * integral(edge(n + 1), edge(n), density) / total;
    let rows: Vec<(f64, f64)> = counts.iter().enumerate().map(|(n, count)| (*count, expected(n))).collect();
    assert!(rows.iter().filter(|(_, expected)| *expected > 20.0).count() > 10);
    rows.iter().filter(|(_, expected)| *expected > 20.0).map(|(count, expected)| (count - expected).powi(2) / expected).sum()
}

#[test]
fn compton_angles_follow_klein_and_nishina_times_s() {
    let mut cases = 0;
    for (name, energy_kev) in [("water", 60.0), ("water", 15.5), ("bone_cortical", 40.0), ("titanium", 118.7)] {
        let (material, mut stream) = (material(name), Stream::new(1, cases));
        let compton = Compton::new(&material).expect("tabulated");
        let found = chi_squared(|| compton.cosine(energy_kev, &mut stream), |c| compton_by_angle(&material, energy_kev, c));
        assert!(found < CHI_SQUARED_39, "{name} at {energy_kev} keV: {found}");
        let free = chi_squared(|| compton.cosine(energy_kev, &mut stream), |c| klein_nishina(energy_kev, c));
        assert!(free > CHI_SQUARED_39, "control: free electrons are told apart in {name} at {energy_kev} keV: {free}");
        cases += 1;
    }
    assert_eq!(cases, 4);
}

#[test]
fn rayleigh_angles_follow_thomson_times_f_squared() {
    let mut cases = 0;
    for (name, energy_kev) in [("water", 60.0), ("water", 15.5), ("bone_cortical", 40.0), ("titanium", 118.7)] {
        let (material, mut stream) = (material(name), Stream::new(2, cases));
        let rayleigh = Rayleigh::new(&material).expect("tabulated");
        let found = chi_squared(|| rayleigh.cosine(energy_kev, &mut stream), |c| rayleigh_by_angle(&material, energy_kev, c));
        assert!(found < CHI_SQUARED_39, "{name} at {energy_kev} keV: {found}");
        let other =
            chi_squared(|| rayleigh.cosine(energy_kev, &mut stream), |c| rayleigh_by_angle(&material, 1.02 * energy_kev, c));
        assert!(other > CHI_SQUARED_39, "control: 2 % of energy are told apart in {name} at {energy_kev} keV: {other}");
        cases += 1;
    }
    assert_eq!(cases, 4);
}

/// Scattered energies of 60 keV in water, from 48.6 keV up: the density by energy is that by angle over dE'/dc = E'²/511 keV.
#[test]
fn compton_energies_follow_from_the_angles() {
    let (water, energy_kev, mut stream) = (material("water"), 60.0, Stream::new(3, 0));
    let compton = Compton::new(&water).expect("tabulated");
    let least = energy_kev * energy_ratio(energy_kev, -1.0);
    assert!((least - 60.0 / (1.0 + 120.0 / 510.998_95)).abs() < 1e-9);
    let mut chi_squared = |shift_kev: f64| {
        let by_energy = |kept_kev: f64| {
            let cosine = (1.0 - 510.998_95 * (1.0 / kept_kev - 1.0 / energy_kev)).clamp(-1.0, 1.0);
            compton_by_angle(&water, energy_kev, cosine) * 510.998_95 / (kept_kev * kept_kev)
        };
        let width = (energy_kev - least) / BINS as f64;
        let of_bin =
            |n: usize| (0..100).map(|i| by_energy(least + width * (n as f64 + (f64::from(i) + 0.5) / 100.0))).sum::<f64>();
        let expected: Vec<f64> = (0..BINS).map(of_bin).collect();
        let mut counts = [0.0; BINS];
        for _ in 0..DRAWS {
            let kept_kev = energy_kev * energy_ratio(energy_kev, compton.cosine(energy_kev, &mut stream)) + shift_kev;
            counts[((kept_kev - least) / width).clamp(0.0, BINS as f64 - 1.0) as usize] += 1.0;
        }
        let scale = f64::from(DRAWS) / expected.iter().sum::<f64>();
        counts.iter().zip(&expected).map(|(n, e): (&f64, &f64)| (n - e * scale).powi(2) / (e * scale)).sum::<f64>()
    };
    let (right, shifted) = (chi_squared(0.0), chi_squared(0.05));
    assert!(right < CHI_SQUARED_39, "{right}");
    assert!(shifted > CHI_SQUARED_39, "control: 50 eV are told apart: {shifted}");
}

/// The tables' cross sections and the angular functions come from one source, so that their integrals agree: within 0.6 % for tissue.
#[test]
fn the_integral_over_all_angles_is_the_tables_cross_section() {
    let (mut cases, mut controls) = (0, 0);
    for name in ["water", "soft_tissue", "bone_cortical", "pmma", "aluminium"] {
        let material = material(name);
        let electrons_per_g = 6.022_140_76e23 * over_atoms(&material, f64::from);
        let (compton, rayleigh) = (Compton::new(&material).expect("tabulated"), Rayleigh::new(&material).expect("tabulated"));
        for energy_kev in [15.0, 20.0, 40.0, 60.0, 90.0, 120.0] {
            let table = material.attenuation(energy_kev).expect("inside");
            let found = 1e-24 * compton.barn_per_electron(energy_kev) * electrons_per_g / table.compton_cm2_per_g;
            assert!((found - 1.0).abs() < 0.006, "Compton in {name} at {energy_kev} keV: {found}");
            let coherent = rayleigh.cm2_per_g(energy_kev) / table.rayleigh_cm2_per_g;
            assert!((coherent - 1.0).abs() < 0.006, "Rayleigh in {name} at {energy_kev} keV: {coherent}");
            // The control: 3 keV off is seen.
            let off = rayleigh.cm2_per_g(energy_kev + 3.0) / table.rayleigh_cm2_per_g;
            controls += usize::from((off - 1.0).abs() > 0.006);
            cases += 1;
        }
    }
    assert_eq!((cases, controls), (30, 30));
}

/// Water at 60 keV, known values.
#[test]
fn mean_cosines_in_water_are_the_known_ones() {
    let (water, mut stream) = (material("water"), Stream::new(4, 0));
    let (compton, rayleigh) = (Compton::new(&water).expect("tabulated"), Rayleigh::new(&water).expect("tabulated"));
    let mean = |mut draw: Box<dyn FnMut() -> f64 + '_>| (0..DRAWS).map(|_| draw()).sum::<f64>() / f64::from(DRAWS);
    let found = mean(Box::new(|| compton.cosine(60.0, &mut stream)));
    assert!((found - 0.0555).abs() < 0.003, "Compton: {found}");
    let found = mean(Box::new(|| rayleigh.cosine(60.0, &mut stream)));
    assert!((found - 0.8855).abs() < 0.002, "Rayleigh: {found}");
    let found = mean(Box::new(|| rayleigh.cosine(55.0, &mut stream)));
    assert!((found - 0.8855).abs() > 0.002, "control: 5 keV less is seen: {found}");
}

/// What weighs directions against each other is what draws them.
#[test]
fn densities_integrate_to_one_and_are_those_of_the_samplers() {
    let mut cases = 0;
    for (name, energy_kev) in [("water", 20.0), ("water", 60.3), ("steel_316l", 81.1)] {
        let material = material(name);
        let (compton, rayleigh) = (Compton::new(&material).expect("tabulated"), Rayleigh::new(&material).expect("tabulated"));
        let over_sphere = |f: &dyn Fn(f64) -> f64| std::f64::consts::TAU * integral(-1.0, 1.0, f);
        let (one, another) =
            (over_sphere(&|c| compton.density(energy_kev, c)), over_sphere(&|c| rayleigh.density(energy_kev, c)));
        assert!((one - 1.0).abs() < 1e-3 && (another - 1.0).abs() < 3e-3, "{name} at {energy_kev} keV: {one} {another}");
        let mut stream = Stream::new(5, cases);
        let found = chi_squared(|| rayleigh.cosine(energy_kev, &mut stream), |c| rayleigh_by_angle(&material, energy_kev, c));
        assert!(found < CHI_SQUARED_39, "{name}: {found}");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

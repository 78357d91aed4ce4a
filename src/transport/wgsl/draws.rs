//! Angles and energies that the shader draws, against the formulas they stand for: its functions alone, driven by a kernel of their own.

use glam::DVec3;

use super::kernel::Kernel;
use super::layout::Job;
use super::pack::Packed;
use crate::geometry::{Intrinsics, Rigid, View};
use crate::scene::model::{Matter, Shape};
use crate::scene::physics::{Material, atomic_weight, form_factors};
use crate::transport::fixture::{scene, solid};
use crate::transport::{Histories, Simulation};

/// Scatterings of one invocation, and invocations: a million of each case.
const EACH: u32 = 256;
const INVOCATIONS: u32 = 4096;
const BINS: usize = 40;
/// χ² with 39 degrees of freedom exceeds this with a probability of 1e-5.
const CHI_SQUARED_39: f64 = 88.0;
const MATERIALS: [&str; 3] = ["water", "bone_cortical", "titanium"];
/// Places among [`MATERIALS`], and keV.
const CASES: [(u32, f64); 4] = [(0, 60.0), (0, 15.5), (1, 40.0), (2, 118.7)];

/// Cosine, then what a photon keeps of its energy in Compton scattering. Of the job it takes the energy from where the source's distance is, the
/// material from the first history, and Rayleigh scattering where photons would count as they arrive.
const KERNEL: &str = "
@compute @workgroup_size(64)
fn draw_scatterings(@builtin(global_invocation_id) id: vec3<u32>) {
    open_history(vec2<u32>(id.x, job.first.y));
    let energy_kev = job.source.w;
    for (var n = 0u; n < job.each; n += 1u) {
        var cosine: f32;
        if job.analogue == 0u {
            cosine = compton_cosine(job.first.x, energy_kev);
        } else {
            cosine = rayleigh_cosine(job.first.x, energy_kev);
        }
        let at = 2u * (id.x * job.each + n);
        atomicStore(&sums[at], bitcast<u32>(cosine));
        atomicStore(&sums[at + 1u], bitcast<u32>(energy_kev * energy_ratio(energy_kev, 1.0 - cosine)));
    }
    if given_up { atomicAdd(&trouble[cause], 1u); }
}
";

/// The kernel and its tables.
struct Draws {
    kernel: Kernel,
    packed: Packed,
}

impl Draws {
    /// `None` (said) where there is no software Vulkan.
    fn new() -> Option<Self> {
        let kernel = Kernel::new("draw_scatterings", KERNEL)?;
        let ball = solid(Shape::Ellipsoid { semi_axes_mm: DVec3::splat(50.0) }, 600.0 * DVec3::Z, DVec3::ZERO, 0, 1.0);
        let scene = scene(&MATERIALS, vec![Matter::Solids(vec![ball])]);
        let intrinsics = Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 199.5, cy: 149.5 };
        let view = View { size_px: [400, 300], intrinsics, camera_from_lps: Rigid::IDENTITY };
        let simulation = Simulation::new(&scene, &view, Histories::default()).expect("good");
        Some(Self { kernel, packed: Packed::new(simulation.world()) })
    }

    /// Cosines and kept energies, keV, of case `number`.
    fn drawn(&self, number: usize, is_rayleigh: bool) -> Vec<[f64; 2]> {
        let (material, energy_kev) = CASES[number];
        let job = Job {
            source: [0.0, 0.0, 0.0, energy_kev as f32],
            first: [material, number as u32],
            each: EACH,
            analogue: u32::from(is_rayleigh),
            seed: [7, u32::from(is_rayleigh)],
            ..self.packed.job
        };
        let inputs: [(u32, &[u8]); 3] = [
            (0, bytemuck::bytes_of(&job)),
            (1, bytemuck::cast_slice(&self.packed.numbers)),
            (2, bytemuck::cast_slice(&self.packed.indices)),
        ];
        let outputs = [(7, 8 * u64::from(EACH * INVOCATIONS)), (8, super::TROUBLE_BYTES)];
        let words = self.kernel.run(&inputs, &outputs, INVOCATIONS / 64);
        let (values, given_up) = words.split_at((2 * EACH * INVOCATIONS) as usize);
        assert!(given_up.iter().all(|count| *count == 0), "{given_up:?}");
        values.as_chunks::<2>().0.iter().map(|pair| pair.map(|word| f64::from(f32::from_bits(word)))).collect()
    }
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

/// χ² of `places`, 0 to 1, over bins of equal width, each of which expects its part of the sum of `parts`.
fn chi_squared(places: impl Iterator<Item = f64>, parts: &[f64]) -> f64 {
    let (mut counts, mut all) = (vec![0.0_f64; parts.len()], 0.0);
    for place in places {
        assert!((-1e-4..=1.0 + 1e-4).contains(&place), "{place}");
        let bin = (place * parts.len() as f64).clamp(0.0, parts.len() as f64 - 1.0);
        counts[bin as usize] += 1.0;
        all += 1.0;
    }
    let sum: f64 = parts.iter().sum();
    let rows: Vec<(f64, f64)> = counts.into_iter().zip(parts.iter().map(|part| all * part / sum)).collect();
    let told = || rows.iter().filter(|(_, expected)| *expected > 20.0);
    assert!(told().count() > 10);
    told().map(|(count, expected)| (count - expected).powi(2) / expected).sum()
}

/// χ² of drawn cosines against a density by angle, over √((1 − c)/2), in which forward peaks are smooth.
fn by_angle(drawn: &[[f64; 2]], density: impl Fn(f64) -> f64) -> f64 {
    // dc is proportional to the place itself.
    let part = |bin: usize| {
        let inner = |n: i32| (bin as f64 + (f64::from(n) + 0.5) / 200.0) / BINS as f64;
        (0..200).map(|n| density(1.0 - 2.0 * inner(n).powi(2)) * inner(n)).sum::<f64>()
    };
    let parts: Vec<f64> = (0..BINS).map(part).collect();
    chi_squared(drawn.iter().map(|[cosine, _]| (0.5 * (1.0 - cosine)).max(0.0).sqrt()), &parts)
}

/// χ² of energies kept, keV, `shift_kev` above them: the density by energy is that by angle over dE'/dc = E'²/511 keV.
fn by_energy(drawn: &[[f64; 2]], material: &Material, energy_kev: f64, shift_kev: f64) -> f64 {
    let least = energy_kev / (1.0 + 2.0 * energy_kev / 510.998_95);
    let width = energy_kev - least;
    let density = |kept_kev: f64| {
        let cosine = (1.0 - 510.998_95 * (1.0 / kept_kev - 1.0 / energy_kev)).clamp(-1.0, 1.0);
        compton_by_angle(material, energy_kev, cosine) / (kept_kev * kept_kev)
    };
    let part = |bin: usize| {
        let inner = |n: i32| least + width * (bin as f64 + (f64::from(n) + 0.5) / 200.0) / BINS as f64;
        (0..200).map(|n| density(inner(n))).sum::<f64>()
    };
    let parts: Vec<f64> = (0..BINS).map(part).collect();
    // What only the shift puts beyond the end is left out of the control; what was drawn there fails, few though they may be.
    let is_moved_out = |kept_kev: f64| kept_kev <= energy_kev && kept_kev + shift_kev > energy_kev;
    let counted = drawn.iter().map(|[_, kept_kev]| *kept_kev).filter(|kept_kev| !is_moved_out(*kept_kev));
    chi_squared(counted.map(|kept_kev| (kept_kev + shift_kev - least) / width), &parts)
}

#[test]
fn compton_angles_and_energies_of_the_shader_follow_klein_and_nishina_times_s() {
    let Some(draws) = Draws::new() else { return };
    let mut cases = 0;
    for (number, (place, energy_kev)) in CASES.into_iter().enumerate() {
        let name = MATERIALS[place as usize];
        let material = Material::parse(name).expect("known");
        let drawn = draws.drawn(number, false);
        let found = by_angle(&drawn, |cosine| compton_by_angle(&material, energy_kev, cosine));
        let free = by_angle(&drawn, |cosine| klein_nishina(energy_kev, cosine));
        let [kept, shifted] = [0.0, 1e-3 * energy_kev].map(|shift_kev| by_energy(&drawn, &material, energy_kev, shift_kev));
        println!("{name} at {energy_kev} keV: angles {found:.0}, energies {kept:.0}; controls {free:.0}, {shifted:.0}");
        assert!(found < CHI_SQUARED_39 && kept < CHI_SQUARED_39, "{name} at {energy_kev} keV: {found} {kept}");
        assert!(free > CHI_SQUARED_39, "control: free electrons are told apart in {name} at {energy_kev} keV: {free}");
        assert!(shifted > CHI_SQUARED_39, "control: a thousandth of {energy_kev} keV is told apart in {name}: {shifted}");
        cases += 1;
    }
    assert_eq!(cases, 4);
}

#[test]
fn rayleigh_angles_of_the_shader_follow_thomson_times_f_squared() {
    let Some(draws) = Draws::new() else { return };
    let mut cases = 0;
    for (number, (place, energy_kev)) in CASES.into_iter().enumerate() {
        let name = MATERIALS[place as usize];
        let material = Material::parse(name).expect("known");
        let drawn = draws.drawn(number, true);
        let [found, other] =
            [1.0, 1.02].map(|times| by_angle(&drawn, |cosine| rayleigh_by_angle(&material, times * energy_kev, cosine)));
        println!("{name} at {energy_kev} keV: {found:.0}; control {other:.0}");
        assert!(found < CHI_SQUARED_39, "{name} at {energy_kev} keV: {found}");
        assert!(other > CHI_SQUARED_39, "control: 2 % of energy are told apart in {name} at {energy_kev} keV: {other}");
        cases += 1;
    }
    assert_eq!(cases, 4);
}

use super::fixture::{CASES, Case, Fixture, bins_of};
use super::*;

/// Knuth's 64-bit linear congruential generator: another sequence than the module's own.
struct Lcg(u64);

impl Lcg {
    /// Uniform in [0, 1).
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    /// A length up to `largest`: none, all, uniform or logarithmic.
    fn length(&mut self, largest: f64) -> f64 {
        let (kind, u) = (self.next(), self.next());
        largest
            * if kind < 0.15 {
                0.0
            } else if kind < 0.3 {
                1.0
            } else if kind < 0.65 {
                u
            } else {
                1e-4f64.powf(u)
            }
    }
}

fn energy_bins<'a>(fixture: &'a Fixture, signal: &'a [f64], squares: Option<&'a [f64]>) -> EnergyBins<'a> {
    EnergyBins {
        energies_kev: &fixture.energies_kev,
        signal_weights: signal,
        noise_weights: squares.map(|squares| NoiseWeights { photons: &fixture.photons, squares }),
        cm2_per_g: &fixture.cm2_per_g,
    }
}

fn whole(largest_g_per_cm2: &[f64]) -> Region<'_> {
    Region { largest_g_per_cm2, largest_line_integral: None }
}

fn case(name: &str) -> &'static Case {
    CASES.iter().find(|case| case.0 == name).expect(name)
}

/// −ln Σ w exp(−μ·L), term by term; `mu(term, material)`.
fn line_integral(weights: &[f64], mu: impl Fn(usize, usize) -> f64, path: &[f64]) -> f64 {
    let depth = |term: usize| -> f64 { path.iter().enumerate().map(|(m, length)| mu(term, m) * length).sum() };
    let depths: Vec<f64> = (0..weights.len()).map(depth).collect();
    let smallest = depths.iter().zip(weights).filter(|(_, w)| **w > 0.0).map(|(d, _)| *d).fold(f64::INFINITY, f64::min);
    let (total, sum) = depths.iter().zip(weights).fold((0.0, 0.0), |(t, s), (d, w)| (t + w, s + w * (smallest - d).exp()));
    smallest - (sum / total).ln()
}

/// Error of the nodes' sum that `weight` picks against the bins' `weights`.
fn error(fixture: &Fixture, weights: &[f64], nodes: &[QuadratureNode], weight: fn(&QuadratureNode) -> f64, path: &[f64]) -> f64 {
    let exact = line_integral(weights, |k, m| fixture.cm2_per_g[m][k], path);
    let node_weights: Vec<f64> = nodes.iter().map(weight).collect();
    (line_integral(&node_weights, |n, m| nodes[n].cm2_per_g[m], path) - exact).abs() / exact.max(1.0)
}

/// The worst error over `count` random paths, then climbed from the worst of them by random steps.
fn worst_error(largest: &[f64], count: usize, error: impl Fn(&[f64]) -> f64) -> f64 {
    let mut random = Lcg(20_261_121);
    let mut worst: Vec<(f64, Vec<f64>)> = Vec::new();
    for _ in 0..count {
        let path: Vec<f64> = largest.iter().map(|largest| random.length(*largest)).collect();
        worst.push((error(&path), path));
    }
    worst.sort_by(|a, b| b.0.total_cmp(&a.0));
    worst.truncate(8);
    for (found, path) in &mut worst {
        for step in 0..300 {
            let reach = 0.3 * 0.98f64.powi(step);
            let stepped: Vec<f64> = path
                .iter()
                .zip(largest)
                .map(|(length, most)| {
                    let u = 2.0 * random.next() - 1.0;
                    (length * (1.0 + reach * u) + 0.01 * reach * most * (random.next() - 0.5)).clamp(0.0, *most)
                })
                .collect();
            let trial = error(&stepped);
            if trial > *found {
                (*found, *path) = (trial, stepped);
            }
        }
    }
    worst.iter().map(|(found, _)| *found).fold(0.0, f64::max)
}

/// Most nodes at 1e-2, 1e-3, 1e-4 (PHYSICS: 4, 6, 7 for the fourth, of free energies).
const MOST: &[(&str, [usize; 3])] = &[
    ("tissue 400", [2, 3, 4]),
    ("tissue 400, bone 80", [3, 4, 5]),
    ("tissue 300, bone 50, steel 5, nitinol 6", [4, 5, 6]),
    ("tissue 400, bone 80, steel 20, nitinol 10", [4, 6, 7]),
    ("tissue 400, bone 80, steel 20", [4, 5, 7]),
    ("the same three, counting", [4, 5, 7]),
    ("the same three, 40 kV", [4, 5, 7]),
    ("the same three, 80 kV", [4, 5, 7]),
    ("the same three, 140 kV", [4, 5, 7]),
    ("water 300, lead 2", [3, 5, 8]),
    ("water 300, iodine 0.3 g/cm2", [3, 4, 7]),
    ("tissue 300, bone 50, iodine 0.3 g/cm2", [4, 5, 7]),
    ("water 300, tungsten 1", [3, 6, 9]),
    ("water 300, Gd 0.3 g/cm2, CsI 1", [3, 6, 9]),
    ("steel 200", [4, 6, 8]),
    ("tissue 300, bone 50, lead 2, W 1, I 0.3", [8, 11, 99]),
    ("eight materials", [4, 6, 7]),
];

#[test]
fn few_nodes_suffice_and_their_bound_holds_on_paths_never_seen() {
    let tolerances = [1e-2, 1e-3, 1e-4];
    let mut cases = 0;
    for (name, most) in MOST {
        let (fixture, signal, _, largest) = bins_of(case(name));
        for (tolerance, most) in tolerances.into_iter().zip(most) {
            let found =
                fit(&energy_bins(&fixture, &signal, None), &whole(&largest), Tolerance::of_signal(tolerance)).expect("valid");
            let Some(quadrature) = found else {
                assert!(*most > MOST_NODES, "{name} at {tolerance}: none");
                continue;
            };
            let nodes = &quadrature.nodes;
            let worst = worst_error(&largest, 5_000, |path| error(&fixture, &signal, nodes, |n| n.signal_weight, path));
            println!("{name:45} {tolerance:.0e} {:2} nodes, bound {:.2e}, seen {worst:.2e}", nodes.len(), quadrature.bound);
            assert!(worst <= quadrature.bound && quadrature.bound <= tolerance, "{name}: {worst} {}", quadrature.bound);
            assert!(nodes.len() <= *most, "{name} at {tolerance}: {} nodes", nodes.len());
            cases += 1;
        }
    }
    assert_eq!(cases, 3 * MOST.len() - 1);
}

#[test]
fn weights_of_the_noise_hold_as_well() {
    for name in ["tissue 400, bone 80, steel 20, nitinol 10", "the same three, counting", "water 300, lead 2", "steel 200"] {
        let (fixture, signal, squares, largest) = bins_of(case(name));
        for tolerance in [1e-2, 1e-3] {
            let bins = energy_bins(&fixture, &signal, Some(&squares));
            let quadrature = fit(&bins, &whole(&largest), Tolerance::of_signal(tolerance)).expect("valid").expect("found");
            let sum = |weight: fn(&QuadratureNode) -> f64| -> f64 { quadrature.nodes.iter().map(weight).sum() };
            assert!(
                (sum(|n| n.photon_weight) / fixture.photons.iter().sum::<f64>() - 1.0).abs() < 1e-12,
                "air keeps its photons"
            );
            assert!((sum(|n| n.square_weight) / squares.iter().sum::<f64>() - 1.0).abs() < 1e-12);
            let photons = |path: &[f64]| error(&fixture, &fixture.photons, &quadrature.nodes, |n| n.photon_weight, path);
            let squared = |path: &[f64]| error(&fixture, &squares, &quadrature.nodes, |n| n.square_weight, path);
            let worst = worst_error(&largest, 20_000, photons).max(worst_error(&largest, 20_000, squared));
            println!("{name}: {} nodes, noise bound {:.2e}, seen {worst:.2e}", quadrature.nodes.len(), quadrature.noise_bound);
            assert!(worst <= quadrature.noise_bound && quadrature.noise_bound <= 0.01, "{worst} {}", quadrature.noise_bound);
        }
    }
}

/// Negative control of the bound: nodes that know nothing of lead must be caught by the same measure.
#[test]
fn nodes_fitted_without_lead_break_their_bound_behind_lead() {
    let (fixture, signal, _, largest) = bins_of(case("water 300, lead 2"));
    let bins = energy_bins(&fixture, &signal, None);
    let without = fit(&bins, &whole(&[largest[0], 0.0]), Tolerance::of_signal(1e-3)).expect("valid").expect("found");
    let judge =
        |largest: &[f64]| worst_error(largest, 2000, |path| error(&fixture, &signal, &without.nodes, |n| n.signal_weight, path));
    assert!(judge(&[largest[0], 0.0]) <= without.bound, "water alone is within the bound");
    assert!(judge(&largest) > 20.0 * without.bound, "{} {}", judge(&largest), without.bound);
}

#[test]
fn one_energy_is_one_exact_node() {
    for noise in [false, true] {
        let attenuation = [vec![0.2], vec![5.0]];
        let noise_weights = noise.then_some(NoiseWeights { photons: &[3.0], squares: &[7.0] });
        let bins = EnergyBins { energies_kev: &[60.0], signal_weights: &[1.0], noise_weights, cm2_per_g: &attenuation };
        let quadrature = fit(&bins, &whole(&[40.0, 2.0]), Tolerance::of_signal(1e-9)).expect("valid").expect("found");
        let [node] = quadrature.nodes.as_slice() else { panic!("{} nodes", quadrature.nodes.len()) };
        assert_eq!((node.energy_kev, node.signal_weight, node.cm2_per_g.as_slice()), (60.0, 1.0, [0.2, 5.0].as_slice()));
        assert_eq!((node.photon_weight, node.square_weight), if noise { (3.0, 7.0) } else { (0.0, 0.0) });
        assert!(quadrature.bound < 1e-15, "{}", quadrature.bound);
    }
}

#[test]
fn few_occupied_bins_are_taken_as_they_are() {
    let (fixture, ..) = bins_of(case("water 300, lead 2"));
    let mut lines = vec![0.0; fixture.energies_kev.len()];
    (lines[54], lines[84], lines[82]) = (0.5, 0.3, 0.2); // 59.5, 89.5 and 87.5 keV: about lead's K edge at 88
    let found = fit(&energy_bins(&fixture, &lines, None), &whole(&[30.0, 2.27]), Tolerance::of_signal(1e-8)).expect("valid");
    let energies: Vec<f64> = found.expect("found").nodes.iter().map(|node| node.energy_kev).collect();
    assert_eq!(energies, [59.5, 87.5, 89.5]);
}

#[test]
fn with_nothing_in_the_beam_one_node_does() {
    let (fixture, signal, squares, _) = bins_of(case("water 300, lead 2"));
    let bins = energy_bins(&fixture, &signal, Some(&squares));
    let quadrature = fit(&bins, &whole(&[0.0, 0.0]), Tolerance::of_signal(1e-6)).expect("valid").expect("found");
    assert_eq!((quadrature.nodes.len(), quadrature.bound), (1, 0.0));
    assert!(quadrature.nodes[0].cm2_per_g.iter().all(|mu| *mu > 0.0), "still attenuates what was not expected");
}

#[test]
fn nodes_extrapolate_like_a_spectrum() {
    for case in CASES {
        let (fixture, signal, _, largest) = bins_of(case);
        let found = fit(&energy_bins(&fixture, &signal, None), &whole(&largest), Tolerance::of_signal(1e-2)).expect("valid");
        let quadrature = found.expect("found");
        assert!((quadrature.nodes.iter().map(|n| n.signal_weight).sum::<f64>() - 1.0).abs() < 1e-12);
        assert!(quadrature.nodes.iter().all(|node| node.signal_weight > 0.0 && node.cm2_per_g.iter().all(|mu| *mu > 0.0)));
        assert!(quadrature.line_integral(&vec![0.0; largest.len()]).abs() < 1e-12, "air is air");
        let mut last = 0.0;
        for scale in [0.5, 1.0, 10.0, 1e3, 1e6] {
            let path: Vec<f64> = largest.iter().map(|length| length * scale).collect();
            let line = quadrature.line_integral(&path);
            assert!(line.is_finite() && line > last, "{}: {line} at {scale}", case.0);
            last = line;
        }
    }
}

#[test]
fn what_is_out_of_reach_costs_no_nodes() {
    let (fixture, signal, _, largest) = bins_of(case("steel 200"));
    let bins = energy_bins(&fixture, &signal, None);
    let nodes_within = |largest_line_integral: Option<f64>| {
        let region = Region { largest_g_per_cm2: &largest, largest_line_integral };
        fit(&bins, &region, Tolerance::of_signal(1e-3)).expect("valid").expect("found")
    };
    let (all, near) = (nodes_within(None), nodes_within(Some(7.0)));
    assert!(near.nodes.len() < all.nodes.len(), "{} {}", near.nodes.len(), all.nodes.len());
    let within = |path: &[f64]| line_integral(&signal, |k, m| fixture.cm2_per_g[m][k], path) <= 7.0;
    let masked = |path: &[f64]| if within(path) { error(&fixture, &signal, &near.nodes, |n| n.signal_weight, path) } else { 0.0 };
    assert!(worst_error(&largest, 20_000, masked) <= near.bound);
}

#[test]
fn the_same_input_gives_the_same_bits() {
    let (fixture, signal, squares, largest) = bins_of(case("tissue 400, bone 80, steel 20"));
    let once = || fit(&energy_bins(&fixture, &signal, Some(&squares)), &whole(&largest), Tolerance::of_signal(1e-3));
    assert_eq!(once(), once());
}

#[test]
fn nonsense_is_refused() {
    let attenuation = [vec![0.2, 0.1]];
    let good =
        EnergyBins { energies_kev: &[50.0, 60.0], signal_weights: &[0.5, 0.5], noise_weights: None, cm2_per_g: &attenuation };
    let one_percent = Tolerance::of_signal(0.01);
    assert!(fit(&good, &whole(&[1.0]), one_percent).is_ok());
    for region in [whole(&[f64::NAN]), whole(&[-1.0]), whole(&[f64::INFINITY])] {
        assert!(matches!(fit(&good, &region, one_percent), Err(QuadratureError::Value { .. })));
    }
    assert!(matches!(fit(&good, &whole(&[1.0, 1.0]), one_percent), Err(QuadratureError::Length { found: 2, expected: 1, .. })));
    let empty = EnergyBins { signal_weights: &[0.0, 0.0], ..good };
    assert!(matches!(fit(&empty, &whole(&[1.0]), one_percent), Err(QuadratureError::Empty { .. })));
    let broken = EnergyBins { signal_weights: &[0.5, f64::NAN], ..good };
    assert!(matches!(fit(&broken, &whole(&[1.0]), one_percent), Err(QuadratureError::Value { index: 1, .. })));
    let attenuations = vec![vec![0.2, 0.1]; 9];
    let many = EnergyBins { cm2_per_g: &attenuations, ..good };
    assert!(matches!(fit(&many, &whole(&[1.0; 9]), one_percent), Err(QuadratureError::Materials { found: 9 })));
    let unmeetable = Tolerance { signal: f64::NAN, noise: 0.01 };
    let (fixture, signal, _, largest) = bins_of(case("tissue 400"));
    assert_eq!(
        fit(&energy_bins(&fixture, &signal, None), &whole(&largest), unmeetable),
        Ok(None),
        "a tolerance of NaN is never met"
    );
}

//! Noise is distributed as it should be, and depends on nothing but its keys; each test has a control that must fail.

use sidecarm::gpu::DeviceChoice;
use sidecarm::random::{Purpose, Stream};
use sidecarm::render::cpu::add_noise::{add_noise, poisson};
use sidecarm::render::{Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Detector, Model, Noise, ReadoutNoise, Response};

use crate::render_scenes::{empty, render_on, software_vulkan, spectrum};

const DRAWS: u32 = 200_000;

fn draws(expected: f64) -> Vec<f64> {
    (0..DRAWS).map(|pixel| poisson(expected, &mut Stream::new(11, 0, pixel, Purpose::QuantumNoise))).collect()
}

fn ln_factorial(k: f64) -> f64 {
    (1..=k as u64).map(|i| (i as f64).ln()).sum()
}

/// Pearson's χ² over cells that expect at least 20, and the cells' number less one.
fn chi_square(sample: &[f64], expected: f64) -> (f64, usize) {
    let total = sample.len() as f64;
    let highest = (expected + 12.0 * expected.sqrt() + 12.0) as usize;
    let mut seen = vec![0.0; highest + 1];
    sample.iter().for_each(|k| seen[(*k as usize).min(highest)] += 1.0);
    let (mut chi, mut cells) = (0.0, 0);
    let (mut observed, mut wanted) = (0.0, 0.0);
    let mut left = total;
    // In logarithms: e^−1001 is no double.
    let mut ln_probability = -expected;
    for (k, count) in seen.iter().enumerate() {
        observed += count;
        wanted += total * ln_probability.exp();
        ln_probability += (expected / (k as f64 + 1.0)).ln();
        if wanted >= 20.0 && left - wanted >= 20.0 {
            chi += (observed - wanted).powi(2) / wanted;
            cells += 1;
            left -= wanted;
            (observed, wanted) = (0.0, 0.0);
        }
    }
    chi += (observed - left).powi(2) / left;
    (chi, cells)
}

/// χ² minus its degrees of freedom in standard deviations; about normal.
fn excess(sample: &[f64], expected: f64) -> f64 {
    let (chi, freedom) = chi_square(sample, expected);
    assert!(freedom >= 1);
    (chi - freedom as f64) / (2.0 * freedom as f64).sqrt()
}

#[test]
fn small_numbers_follow_the_poisson_law() {
    let mut cases = 0;
    for expected in [1e-3, 0.03, 0.7, 3.0, 9.9, 10.1, 30.0, 200.0, 999.0, 1001.0] {
        let sample = draws(expected);
        let found = excess(&sample, expected);
        assert!(found.abs() < 5.0, "λ = {expected}: χ² is {found:.1} σ off");
        let control = excess(&sample, expected * (1.0 + 14.0 / (f64::from(DRAWS) * expected).sqrt()));
        assert!(control > 5.0, "λ = {expected}: the control passes with {control:.1} σ");
        cases += 1;
    }
    assert_eq!(cases, 10);
}

#[test]
fn tiny_numbers_keep_their_mean() {
    // λ = 1e-6: among 2e7 draws 20 ones are expected, σ = 4.5.
    let ones: f64 = (0..20_000_000u32).map(|pixel| poisson(1e-6, &mut Stream::new(5, 1, pixel, Purpose::QuantumNoise))).sum();
    assert!((ones - 20.0).abs() < 5.0 * 20f64.sqrt(), "{ones}");
    assert_eq!(poisson(0.0, &mut Stream::new(1, 0, 0, Purpose::QuantumNoise)), 0.0);
    assert_eq!(poisson(f64::NAN, &mut Stream::new(1, 0, 0, Purpose::QuantumNoise)), 0.0);
}

#[test]
fn large_numbers_have_the_right_moments() {
    let mut cases = 0;
    for expected in [2e3, 1e5, 1e8] {
        let sample = draws(expected);
        let n = sample.len() as f64;
        let mean = sample.iter().sum::<f64>() / n;
        let moment = |power: i32| sample.iter().map(|k| ((k - expected) / expected.sqrt()).powi(power)).sum::<f64>() / n;
        assert!(((mean - expected) / (expected / n).sqrt()).abs() < 5.0, "λ = {expected}: mean {mean}");
        assert!((moment(2) - 1.0).abs() < 5.0 * (2.0 / n).sqrt(), "λ = {expected}: variance {}", moment(2));
        assert!((moment(3) - 1.0 / expected.sqrt()).abs() < 5.0 * (15.0 / n).sqrt(), "λ = {expected}: skewness {}", moment(3));
        cases += 1;
    }
    assert_eq!(cases, 3);
}

/// The first k of a table, and P(X ≤ k), P(X ≤ k + 1), … from there: twelve σ to either side of the mode, by recurrence from Stirling's ln k!.
fn cumulative(expected: f64) -> (f64, Vec<f64>) {
    let reach = 12.0 * expected.sqrt() + 30.0;
    let (first, mode) = ((expected - reach).floor().max(0.0), expected.floor());
    let last = expected.floor() + reach.ceil();
    let ln_factorial = if mode < 100.0 {
        ln_factorial(mode)
    } else {
        (mode + 0.5) * mode.ln() - mode + 0.5 * std::f64::consts::TAU.ln() + 1.0 / (12.0 * mode) - 1.0 / (360.0 * mode.powi(3))
    };
    let at_mode = (mode * expected.ln() - expected - ln_factorial).exp();
    let below = (mode - first) as usize;
    let mut probability = vec![at_mode; (last - first) as usize + 1];
    (0..below).rev().for_each(|i| probability[i] = probability[i + 1] * (first + i as f64 + 1.0) / expected);
    (below + 1..probability.len()).for_each(|i| probability[i] = probability[i - 1] * expected / (first + i as f64));
    let mut sum = 0.0;
    probability.iter_mut().for_each(|p| {
        sum += *p;
        *p = sum;
    });
    // ln k! − k ln λ + λ cancels to a few 1e-7 at λ = 1e8.
    assert!((sum - 1.0).abs() < 1e-5, "λ = {expected}: probabilities add up to {sum}");
    (first, probability.iter().map(|p| p / sum).collect())
}

/// Kolmogorov's distance between a sample and the Poisson law.
fn distance(sample: &[f64], expected: f64) -> f64 {
    let (first, law) = cumulative(expected);
    let mut counts = vec![0.0; law.len()];
    sample.iter().for_each(|k| counts[(k - first).clamp(0.0, law.len() as f64 - 1.0) as usize] += 1.0);
    let (mut seen, mut largest) = (0.0, 0.0f64);
    for (count, law) in counts.iter().zip(&law) {
        seen += count / sample.len() as f64;
        largest = largest.max((seen - law).abs());
    }
    largest
}

/// Distance that a sample of `n` exceeds once in a million, √(½ ln 2e6 / n), plus Cornish–Fisher's own.
fn limit(n: usize) -> f64 {
    (0.5 * 2e6f64.ln() / n as f64).sqrt() + 1.2e-5
}

#[test]
fn the_cumulative_distribution_agrees_from_a_millionth_to_a_hundred_million() {
    let mut cases = 0;
    for expected in [1e-6, 1e-4, 0.02, 0.5, 2.0, 9.99, 10.01, 50.0, 300.0, 999.9, 1000.5, 1e4, 1e5, 1e6, 1e7, 1e8] {
        let sample = draws(expected);
        let found = distance(&sample, expected);
        assert!(found < limit(sample.len()), "λ = {expected}: {found:.1e}");
        // A mean that is off by 4 % of the standard deviation, or for rare events by as much as six of them in the whole sample.
        let shift = (0.04 * expected.sqrt()).max(1.8e-2 * (1.0 - expected).max(0.0));
        let control = distance(&sample, expected + shift);
        assert!(control > limit(sample.len()), "λ = {expected}: the control passes with {control:.1e}");
        cases += 1;
    }
    assert_eq!(cases, 16);
}

#[test]
fn a_plain_gaussian_would_be_found_out_at_a_thousand() {
    let n = 4_000_000u32;
    let mean = 1000.5f64;
    let stream = |pixel: u32| Stream::new(21, 0, pixel, Purpose::QuantumNoise);
    let good: Vec<f64> = (0..n).map(|pixel| poisson(mean, &mut stream(pixel))).collect();
    let gaussian: Vec<f64> = (0..n).map(|pixel| (mean + mean.sqrt() * stream(pixel).normal()).round()).collect();
    let (found, control) = (distance(&good, mean), distance(&gaussian, mean));
    println!("Kolmogorov distance {found:.1e}, of a plain Gaussian {control:.1e}, limit {:.1e}", limit(n as usize));
    assert!(found < limit(n as usize) && control > limit(n as usize));
    assert!(
        excess(&good, mean).abs() < 5.0 && excess(&gaussian, mean) > 5.0,
        "{} {}",
        excess(&good, mean),
        excess(&gaussian, mean)
    );
}

/// The shader's photon numbers at one mean, read back from counting pixels in parallel light.
fn shader_numbers(renderer: &mut Renderer, expected: f64, frames: u32) -> Vec<f64> {
    let mut scene = empty(&["water"]);
    let view = scene.view.as_mut().expect("has one");
    view.size_px = [512, 400];
    (view.intrinsics.fx, view.intrinsics.fy) = (1e7, 1e7);
    scene.detector.pitch_mm = 1e-4;
    scene.detector.response = Response::Counting;
    scene.beam.photons_per_pixel = expected;
    scene.model.noise = Noise::True;
    let frame = |frame_index: u32| {
        let options = Options { quantity: Quantity::Intensity, frame_index, ..Options::default() };
        let rendered = renderer.render(&scene, &options).expect("renders");
        assert_eq!(rendered.plan["executor"], "wgsl", "{:?}", rendered.notes);
        rendered.pages[0].pixels.iter().map(|value| (f64::from(*value) * expected).round()).collect::<Vec<f64>>()
    };
    (0..frames).flat_map(frame).collect()
}

#[test]
fn the_shader_draws_from_the_poisson_law_as_well() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let mut cases = 0;
    for expected in [1e-3, 0.05, 0.7, 3.0, 9.9, 10.1, 60.0, 300.0, 999.0, 1001.0, 1e4, 1e5] {
        let sample = shader_numbers(&mut vulkan, expected, 1);
        let (found, limit) = (distance(&sample, expected), limit(sample.len()));
        assert!(found < limit, "λ = {expected}: {found:.1e}");
        let shift = (0.04 * expected.sqrt()).max(1.8e-2 * (1.0 - expected).max(0.0));
        assert!(distance(&sample, expected + shift) > limit, "λ = {expected}: the control");
        if expected < 1e4 {
            let found = excess(&sample, expected);
            assert!(found.abs() < 5.0, "λ = {expected}: χ² is {found:.1} σ off");
        }
        cases += 1;
    }
    assert_eq!(cases, 12);
    // Rare photons: 2.05e6 pixels expect 20.5 at λ = 1e-5.
    let ones: f64 = shader_numbers(&mut vulkan, 1e-5, 10).iter().sum();
    assert!((ones - 20.48).abs() < 5.0 * 20.48f64.sqrt(), "{ones}");
    for expected in [1e7f64, 1e8] {
        // f32 intensities near 1 resolve 6e-4 σ at 1e8.
        let sample = shader_numbers(&mut vulkan, expected, 1);
        let n = sample.len() as f64;
        let moment = |power: i32| sample.iter().map(|k| ((k - expected) / expected.sqrt()).powi(power)).sum::<f64>() / n;
        assert!(moment(1).abs() < 5.0 / n.sqrt() && (moment(2) - 1.0).abs() < 5.0 * (2.0 / n).sqrt(), "λ = {expected}");
    }
}

#[test]
fn noise_depends_on_its_keys_only() {
    let expected: Vec<f32> = (0..50_000).map(|i| (i % 3000) as f32 * 0.5).collect();
    let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("pool");
    let one = pool(1).install(|| add_noise(&expected, 7, 3));
    assert_eq!(one, pool(5).install(|| add_noise(&expected, 7, 3)));
    assert_ne!(one, add_noise(&expected, 7, 4), "the frame is a key");
    assert_ne!(one, add_noise(&expected, 8, 3), "the seed is a key");
}

fn moments(values: &[f32]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    (mean, values.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / n)
}

#[test]
fn an_image_has_the_variance_of_its_mode() {
    let mut scene = empty(&["water"]);
    // 96×96 pixels at 1/1000 of the distance: obliquity stays within 0.7 %.
    scene.beam.spectrum = spectrum(&[(30.0, 0.5), (90.0, 0.5)]);
    scene.beam.photons_per_pixel = 1e4;
    let pixels = 96.0f64 * 96.0;
    let (mean_kev, mean_square) = (60.0, 0.5 * (900.0 + 8100.0));
    let mut cases = 0;
    for (noise, response, factor) in [
        (Noise::Paper, Response::Energy, 1.0),
        (Noise::True, Response::Energy, mean_square / (mean_kev * mean_kev)),
        (Noise::True, Response::Counting, 1.0),
    ] {
        scene.model.noise = noise;
        scene.detector.response = response;
        let image = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
        let (mean, variance) = moments(&image.pages[0].pixels);
        let relative = variance * 1e4 / factor;
        assert!((mean - 1.0).abs() < 5.0 * (factor / 1e4 / pixels).sqrt(), "{noise:?}: mean {mean}");
        assert!((relative - 1.0).abs() < 5.0 * (2.0 / pixels).sqrt() + 0.004, "{noise:?} {response:?}: {relative}");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

/// Mean and deviate of a pixel's photons, apart in f32, came out as 2.9999981 of them, or −1.1e-6; whoever draws them.
#[test]
fn a_counting_panel_reads_whole_numbers() {
    let mut scene = empty(&["water"]);
    (scene.model.noise, scene.detector.response) = (Noise::True, Response::Counting);
    let devices = std::iter::once(Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("a CPU")).chain(software_vulkan());
    let is_whole = |value: &f32| value.fract() == 0.0 && value.is_sign_positive();
    let mut cases = 0;
    for mut renderer in devices {
        let mut counts = |scene: &Scene| {
            let options = Options { quantity: Quantity::Counts, ..Options::default() };
            renderer.render(scene, &options).expect("renders").pages.remove(0).pixels
        };
        for photons in [0.3, 3.0, 2e3] {
            scene.beam.photons_per_pixel = photons;
            let noisy = counts(&scene);
            let expected = moments(&counts(&Scene { model: Model { noise: Noise::Off, ..scene.model }, ..scene.clone() })).0;
            assert!(noisy.iter().all(is_whole), "{photons}: {:?}", noisy.iter().find(|value| !is_whole(value)));
            let (mean, variance) = moments(&noisy);
            let pixels = noisy.len() as f64;
            assert!((mean - expected).abs() < 5.0 * (expected / pixels).sqrt(), "{photons}: {mean} of {expected}");
            // Of a Poisson variate's variance the variance is 2 λ² + λ over their number.
            let off = 5.0 * ((2.0 * expected * expected + expected) / pixels).sqrt() + 0.01 * expected;
            assert!((variance - expected).abs() < off, "{photons}: variance {variance}");
            cases += 1;
        }
        // The controls: pixels that share their photons, and a panel that sums energies.
        scene.beam.photons_per_pixel = 3.0;
        let shared = vec![vec![0.0, 0.1, 0.0], vec![0.1, 0.6, 0.1], vec![0.0, 0.1, 0.0]];
        for control in [
            Scene { detector: Detector { crosstalk: shared, ..scene.detector.clone() }, ..scene.clone() },
            Scene {
                detector: Detector { response: Response::Energy, gain: 1.0 / 61.0, ..scene.detector.clone() },
                ..scene.clone()
            },
        ] {
            assert!(!counts(&control).iter().all(is_whole));
        }
    }
    assert!(cases >= 3);
}

/// Correlation with the right-hand and the lower neighbour.
fn correlation(image: &sidecarm::image::Image<f32>) -> (f64, f64) {
    let (mean, variance) = moments(&image.pixels);
    let product = |dc: usize, dr: usize| {
        let mut sum = 0.0;
        let mut count = 0.0;
        for row in 0..image.height - dr {
            for column in 0..image.width - dc {
                sum += (f64::from(*image.at(column, row)) - mean) * (f64::from(*image.at(column + dc, row + dr)) - mean);
                count += 1.0;
            }
        }
        sum / count / variance
    };
    (product(1, 0), product(0, 1))
}

#[test]
fn crosstalk_and_readout_correlate_as_they_say() {
    let mut scene = empty(&["water"]);
    scene.model.noise = Noise::True;
    scene.beam.photons_per_pixel = 1e4;
    let tolerance = 5.0 / 96.0;
    let plain = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
    let (right, below) = correlation(&plain.pages[0]);
    assert!(right.abs() < tolerance && below.abs() < tolerance, "independent: {right}, {below}");
    scene.detector.crosstalk = vec![vec![0.0, 0.1, 0.0], vec![0.1, 0.6, 0.1], vec![0.0, 0.1, 0.0]];
    let (right, below) = correlation(&render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity).pages[0]);
    // Σ k(x) k(x + 1) / Σ k²: 2·0.6·0.1 / (0.36 + 0.04).
    let expected = 0.12 / 0.40;
    assert!((right - expected).abs() < tolerance && (below - expected).abs() < tolerance, "{right}, {below} and {expected}");
    scene.detector.crosstalk = Vec::new();
    scene.beam.photons_per_pixel = 1e9;
    scene.detector.readout_noise = Some(ReadoutNoise { sigma: 0.01, row_correlation: 0.5 });
    let image = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity);
    let (right, below) = correlation(&image.pages[0]);
    assert!((right - 0.5).abs() < tolerance && below.abs() < tolerance, "{right}, {below}");
    assert!((moments(&image.pages[0].pixels).1.sqrt() / 0.01 - 1.0).abs() < 0.06);
}

#[test]
fn a_noisy_line_integral_has_a_stated_floor() {
    let mut scene = empty(&["water"]);
    scene.model.noise = Noise::True;
    scene.beam.photons_per_pixel = 1.0;
    let image = render_on(DeviceChoice::Cpu, &scene, Quantity::LineIntegral);
    let highest = image.pages[0].pixels.iter().copied().fold(f32::MIN, f32::max);
    assert!((f64::from(highest) - 2f64.ln()).abs() < 1e-6, "−ln 1/(2·1): {highest}");
    assert!(image.notes.iter().any(|note| note.contains("1/(2 N0)")), "{:?}", image.notes);
}

#[test]
fn correlations_are_measured_on_a_quarter_of_a_million_pixels() {
    let mut scene = empty(&["water"]);
    let view = scene.view.as_mut().expect("has one");
    view.size_px = [512, 512];
    (view.intrinsics.fx, view.intrinsics.fy) = (1e7, 1e7);
    scene.detector.pitch_mm = 1e-4;
    scene.model.noise = Noise::True;
    scene.beam.photons_per_pixel = 1e9;
    let tolerance = 5.0 / 512.0;
    let mut cases = 0;
    for rho in [0.0, 0.2, 0.5, 0.9] {
        scene.detector.readout_noise = Some(ReadoutNoise { sigma: 0.01, row_correlation: rho });
        let image = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity).pages.remove(0);
        let (right, below) = correlation(&image);
        // Correlated samples tell less: 1 + 2ρ²/(1 − ρ²) times the variance of their own variance.
        let wider = tolerance * ((1.0 + rho * rho) / (1.0 - rho * rho)).sqrt();
        assert!((right - rho).abs() < tolerance && below.abs() < wider, "ρ = {rho}: {right}, {below}");
        assert!((moments(&image.pixels).1 / 1e-4 - 1.0).abs() < 2.0 * wider, "ρ = {rho}: variance");
        assert!((right - rho - 0.03).abs() > tolerance, "the control: 0.03 more");
        cases += 1;
    }
    scene.detector.readout_noise = None;
    scene.beam.photons_per_pixel = 1e4;
    // The kernel of a panel with neighbour correlation 0.20.
    let (side, centre) = (0.071, 1.0 - 4.0 * 0.071);
    scene.detector.crosstalk = vec![vec![0.0, side, 0.0], vec![side, centre, side], vec![0.0, side, 0.0]];
    let image = render_on(DeviceChoice::Cpu, &scene, Quantity::Intensity).pages.remove(0);
    let power = centre * centre + 4.0 * side * side;
    let (right, below) = correlation(&image);
    let expected = 2.0 * centre * side / power;
    assert!((right - expected).abs() < tolerance && (below - expected).abs() < tolerance, "{right} {below} {expected}");
    assert!((moments(&image.pixels).1 * 1e4 / power - 1.0).abs() < 3.0 * tolerance, "the kernel takes noise away");
    assert!((moments(&image.pixels).1 * 1e4 - 1.0).abs() > 0.2, "the control: white noise");
    assert_eq!(cases, 4);
}

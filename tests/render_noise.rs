//! Noise is distributed as it should be, and depends on nothing but its keys; each test has a control that must fail.

use sidecarm::gpu::DeviceChoice;
use sidecarm::random::{Purpose, Stream};
use sidecarm::render::Quantity;
use sidecarm::render::cpu::add_noise::{add_noise, poisson};
use sidecarm::scene::model::{Noise, ReadoutNoise, Response};

use crate::render_scenes::{empty, render_on, spectrum};

const DRAWS: u32 = 200_000;

fn draws(expected: f64) -> Vec<f64> {
    (0..DRAWS).map(|pixel| poisson(expected, &mut Stream::new(11, 0, pixel, Purpose::QuantumNoise))).collect()
}

fn ln_factorial(k: f64) -> f64 {
    (1..=k as u64).map(|i| (i as f64).ln()).sum()
}

/// P(X ≤ k) by summing from the mode's neighbourhood.
fn cdf(expected: f64, up_to: u64) -> f64 {
    (0..=up_to).map(|k| (k as f64 * expected.ln() - expected - ln_factorial(k as f64)).exp()).sum::<f64>().min(1.0)
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

#[test]
fn the_cumulative_distribution_agrees_where_the_method_changes() {
    let expected = 1000.5;
    let sample = draws(expected);
    // The limit is the 1e-6 point of Kolmogorov's distribution plus Cornish–Fisher's own distance.
    let limit = 2.7 / f64::from(DRAWS).sqrt() + 1.2e-5;
    let distance = |expected: f64| {
        let quantiles = [920u64, 960, 980, 1000, 1020, 1040, 1080];
        let at = |k: u64| sample.iter().filter(|x| **x <= k as f64).count() as f64 / f64::from(DRAWS);
        quantiles.iter().map(|k| (at(*k) - cdf(expected, *k)).abs()).fold(0.0, f64::max)
    };
    assert!(distance(expected) < limit, "{} and {limit}", distance(expected));
    assert!(distance(expected + 1.0) > limit, "the control");
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

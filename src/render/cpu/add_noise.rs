//! Twin of `shaders/add_noise.wgsl`: Poisson deviates of each pixel's photon number, keyed by (seed, frame, pixel).

use rayon::prelude::*;

use crate::random::{Purpose, Stream};

/// Below: sequential inversion.
const INVERSION_BELOW: f64 = 10.0;
/// Above: Cornish–Fisher; its Kolmogorov distance is 1.2e-5 here and falls.
const CORNISH_FISHER_ABOVE: f64 = 1000.0;

/// Poisson(λ) − λ for each pixel's λ.
#[must_use]
pub fn add_noise(expected: &[f32], seed: u64, frame: u32) -> Vec<f32> {
    let deviate = |(pixel, expected): (usize, &f32)| {
        let mut stream = Stream::new(seed, frame, pixel as u32, Purpose::QuantumNoise);
        let expected = f64::from(*expected);
        (poisson(expected, &mut stream) - expected) as f32
    };
    expected.par_iter().enumerate().with_min_len(1024).map(deviate).collect()
}

/// A Poisson deviate of mean `expected`, from 0 to 1e9; 0 for 0 and for NaN.
#[must_use]
pub fn poisson(expected: f64, stream: &mut Stream) -> f64 {
    if !(expected > 0.0) {
        0.0
    } else if expected < INVERSION_BELOW {
        by_inversion(expected, stream)
    } else if expected < CORNISH_FISHER_ABOVE {
        by_transformed_rejection(expected, stream)
    } else {
        let z = stream.normal();
        (expected + expected.sqrt() * z + (z * z - 1.0) / 6.0).round().max(0.0)
    }
}

/// The uniform is read as P(X ≥ k), so that small λ keep all 32 bits: P(X ≥ 1) = 1 − e^−λ is formed by `expm1`.
fn by_inversion(expected: f64, stream: &mut Stream) -> f64 {
    let survival = stream.uniform();
    let mut tail = -(-expected).exp_m1();
    let mut probability = (-expected).exp();
    let mut k = 0.0;
    while survival < tail && k < 100.0 {
        k += 1.0;
        probability *= expected / k;
        tail -= probability;
    }
    k
}

/// Hörmann 1993, "The transformed rejection method for generating Poisson random variables", algorithm PTRS; the acceptance test is
/// in deviance form, which f32 can evaluate as well.
fn by_transformed_rejection(expected: f64, stream: &mut Stream) -> f64 {
    let b = 0.931 + 2.53 * expected.sqrt();
    let a = -0.059 + 0.02483 * b;
    let inverse_alpha = 1.1239 + 1.1328 / (b - 3.4);
    let v_r = 0.9277 - 3.6224 / (b - 2.0);
    // Each round accepts with a probability above 0.8; 64 rounds never fail in practice and bound the loop.
    for _ in 0..64 {
        let u = stream.uniform() - 0.5;
        let v = stream.uniform();
        let us = 0.5 - u.abs();
        let k = ((2.0 * a / us + b) * u + expected + 0.43).floor();
        if us >= 0.07 && v <= v_r {
            return k;
        }
        if k < 0.0 || (us < 0.013 && v > us) {
            continue;
        }
        if (v * inverse_alpha / (a / (us * us) + b)).ln() <= log_probability(k, expected) {
            return k;
        }
    }
    expected.round()
}

/// ln of λᵏ e^−λ / k!, as −D − ½ ln 2πk − δ(k) with the deviance D = k ln(k/λ) + λ − k and Stirling's correction δ.
fn log_probability(k: f64, expected: f64) -> f64 {
    if k < 0.5 {
        return -expected;
    }
    let x = (k - expected) / expected;
    let deviance = expected * ((1.0 + x) * x.ln_1p() - x);
    let stirling = (1.0 / 12.0 - (1.0 / 360.0 - (1.0 / 1260.0 - 1.0 / (1680.0 * k * k)) / (k * k)) / (k * k)) / k;
    -deviance - 0.5 * (std::f64::consts::TAU * k).ln() - stirling
}

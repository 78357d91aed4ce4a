//! The radial profile of a sphere's shadow after blur, tabulated once.
//!
//! With ρ the distance from the centre in units of the radius, the chord of a unit sphere is s(ρ) = √(1 − ρ²). An image that shows
//! transmission, or a display curve that saturates, flattens it: g_k(ρ) = (1 − e^(−k s))/(1 − e^(−k)), with g_0 = s. Blur by a Gaussian
//! of standard deviation β (in radii) turns g into
//!     G(ρ) = ∫₀¹ g(t) t/β² · exp(−(t − ρ)²/2β²) · I₀ₑ(t ρ/β²) dt,
//! I₀ₑ being the exponentially scaled Bessel function; t = sin θ removes the infinite slope at the rim.

use std::sync::OnceLock;

/// Shapes of the unblurred profile: chord, transmission of about three nepers, almost a disc.
pub const SHAPES: [f64; 3] = [0.0, 3.0, 9.0];

const RHO_STEP: f64 = 1.0 / 40.0;
const RHO_COUNT: usize = 181;
const BETA_FIRST: f64 = 0.025;
const BETA_RATIO: f64 = 1.25;
const BETA_COUNT: usize = 20;
/// The Gaussian is nothing so far from its middle.
const REACH_BETAS: f64 = 6.0;

/// Value and derivatives of a profile.
#[derive(Clone, Copy, Debug, Default)]
pub struct Value {
    /// G.
    pub value: f64,
    /// ∂G/∂ρ.
    pub by_rho: f64,
    /// ∂G/∂ ln β.
    pub by_ln_beta: f64,
}

type Table = Vec<f64>;

fn tables() -> &'static [Table] {
    static TABLES: OnceLock<Vec<Table>> = OnceLock::new();
    TABLES.get_or_init(|| SHAPES.iter().map(|&k| tabulate(k)).collect())
}

/// The profile of one shape and blur, ready for many distances.
#[derive(Clone)]
pub struct Profile {
    /// At the table's distances, with one more before the first: it is even about 0.
    value: [f64; RHO_COUNT + 1],
    by_ln_beta: [f64; RHO_COUNT + 1],
    /// Steps of the table from which on the profile is nothing.
    end: f64,
}

impl Profile {
    /// Shape index `shape`, blur `beta` in radii (clamped to the table).
    pub fn new(shape: usize, beta: f64) -> Self {
        let table = &tables()[shape];
        let y = ((beta / BETA_FIRST).ln() / BETA_RATIO.ln()).clamp(0.0, (BETA_COUNT - 1) as f64 - 1e-9);
        let row = (y as usize).min(BETA_COUNT - 2);
        let line = |row: usize| &table[row * RHO_COUNT..(row + 1) * RHO_COUNT];
        let (low, high, fraction) = (line(row), line(row + 1), y - row as f64);
        // Linear along ln β.
        let between = |n: usize| {
            let at = if n == 0 { 1 } else { n - 1 };
            (low[at] + fraction * (high[at] - low[at]), (high[at] - low[at]) * (1.0 / LN_BETA_RATIO))
        };
        let reach = 1.0 + REACH_BETAS * BETA_FIRST * BETA_RATIO.powi(row as i32 + 1);
        let end = (reach / RHO_STEP + 3.0).min((RHO_COUNT - 3) as f64);
        Self { value: std::array::from_fn(|n| between(n).0), by_ln_beta: std::array::from_fn(|n| between(n).1), end }
    }

    /// G and its derivatives at distance `rho`, in radii.
    #[inline]
    pub fn at(&self, rho: f64) -> Value {
        let x = rho * (1.0 / RHO_STEP);
        if !(x < self.end) {
            return Value::default();
        }
        let i = x as usize;
        let f = x - i as f64;
        // Catmull–Rom along ρ.
        let cubic = |line: &[f64; RHO_COUNT + 1]| {
            let [a, b, c, d] = [line[i], line[i + 1], line[i + 2], line[i + 3]];
            (b, 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d, 0.5 * (d - a) + 1.5 * (b - c))
        };
        let (value, p, q, r) = cubic(&self.value);
        let (blur, blur_p, blur_q, blur_r) = cubic(&self.by_ln_beta);
        Value {
            value: value + f * (p + f * (q + f * r)),
            by_rho: (p + f * (2.0 * q + 3.0 * f * r)) * (1.0 / RHO_STEP),
            by_ln_beta: blur + f * (blur_p + f * (blur_q + f * blur_r)),
        }
    }
}

/// ln of the table's ratio.
const LN_BETA_RATIO: f64 = 0.223_143_551_314_209_76;

fn tabulate(k: f64) -> Table {
    const NODES: usize = 240;
    // Midpoint rule in θ; the integrand is smooth and the narrowest Gaussian spans several nodes.
    let step = std::f64::consts::FRAC_PI_2 / NODES as f64;
    let nodes: Vec<(f64, f64)> = (0..NODES)
        .map(|n| {
            let (sin, cos) = ((n as f64 + 0.5) * step).sin_cos();
            let g = if k == 0.0 { cos } else { (1.0 - (-k * cos).exp()) / (1.0 - (-k).exp()) };
            (sin, g * sin * cos * step)
        })
        .collect();
    let mut table = vec![0.0; RHO_COUNT * BETA_COUNT];
    for row in 0..BETA_COUNT {
        let beta = BETA_FIRST * BETA_RATIO.powi(row as i32);
        let inverse = 1.0 / (beta * beta);
        for column in 0..RHO_COUNT {
            let rho = column as f64 * RHO_STEP;
            table[row * RHO_COUNT + column] = nodes
                .iter()
                .filter(|(t, _)| (t - rho).abs() < REACH_BETAS * beta)
                .map(|(t, weight)| {
                    weight * inverse * (-0.5 * (t - rho).powi(2) * inverse).exp() * bessel_i0_scaled(t * rho * inverse)
                })
                .sum();
        }
    }
    table
}

/// e^(−x) I₀(x) for x ≥ 0 (Abramowitz & Stegun 9.8.1 and 9.8.2, relative error below 2e-7).
fn bessel_i0_scaled(x: f64) -> f64 {
    if x < 3.75 {
        let t = (x / 3.75).powi(2);
        let series = 1.0
            + t * (3.515_622_9 + t * (3.089_942_4 + t * (1.206_749_2 + t * (0.265_973_2 + t * (0.036_076_8 + t * 0.004_581_3)))));
        (-x).exp() * series
    } else {
        let t = 3.75 / x;
        let series = 0.398_942_28
            + t * (0.013_285_92
                + t * (0.002_253_19
                    + t * (-0.001_575_65
                        + t * (0.009_162_81
                            + t * (-0.020_577_06 + t * (0.026_355_37 + t * (-0.016_476_33 + t * 0.003_923_77)))))));
        series / x.sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blurred(shape: usize, rho: f64, beta: f64) -> Value {
        Profile::new(shape, beta).at(rho)
    }

    #[test]
    fn little_blur_leaves_the_chord() {
        for rho in [0.0, 0.3, 0.6, 0.8] {
            let chord = (1.0f64 - rho * rho).sqrt();
            assert!((blurred(0, rho, BETA_FIRST).value - chord).abs() < 3e-3, "{rho}");
        }
        assert!(blurred(0, 1.3, BETA_FIRST).value.abs() < 1e-6);
    }

    #[test]
    fn blur_keeps_the_integral() {
        for shape in 0..SHAPES.len() {
            let integral = |beta: f64| {
                (0..400).map(|n| (n as f64 + 0.5) * 0.01).map(|rho| blurred(shape, rho, beta).value * rho * 0.01).sum::<f64>()
            };
            assert!((integral(0.6) / integral(0.03) - 1.0).abs() < 5e-3, "{shape}");
        }
    }

    #[test]
    fn beyond_its_end_a_profile_is_nothing() {
        for (shape, beta) in [(0, 0.025), (1, 0.08), (2, 0.3), (0, 1.5)] {
            let profile = Profile::new(shape, beta);
            let first = profile.end as usize - 1;
            let beyond = profile.value[first.min(RHO_COUNT - 3)..].iter().chain(&profile.by_ln_beta[first.min(RHO_COUNT - 3)..]);
            assert!(beyond.clone().all(|value| *value == 0.0) || first >= RHO_COUNT - 5, "{shape} {beta}");
            assert!(profile.at((profile.end - 0.5) * RHO_STEP).value >= 0.0);
        }
        let narrow = Profile::new(0, 0.08);
        assert!(narrow.end < 70.0 && narrow.at(1.3).value > 0.0);
    }

    #[test]
    fn derivatives_are_differences() {
        let (rho, beta, h) = (0.83, 0.21, 1e-4);
        let v = blurred(0, rho, beta);
        let d = (blurred(0, rho + h, beta).value - blurred(0, rho - h, beta).value) / (2.0 * h);
        assert!((v.by_rho - d).abs() < 1e-3 * d.abs());
    }
}

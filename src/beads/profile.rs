//! The radial profile of a sphere's shadow after blur, tabulated once.
//!
//! With ρ the distance from the centre in units of the radius, the chord of a unit sphere is s(ρ) = √(1 − ρ²). Metal of k nepers in its
//! middle stops 1 − e^(−k s) of what comes, which as a share of what it stops in the middle is g_k(ρ) = (1 − e^(−k s))/(1 − e^(−k)), with
//! g_0 = s. Detector and focal spot blur what arrives, not its logarithm; by a Gaussian of standard deviation β (in radii) g becomes
//!     G_k(ρ; β) = ∫₀¹ g(t) t/β² · exp(−(t − ρ)²/2β²) · I₀ₑ(t ρ/β²) dt,
//! I₀ₑ being the exponentially scaled Bessel function; t = sin θ removes the infinite slope at the rim.
//!
//! The table has distances that grow with the blur, ρ/(1 + 1.5 β), so that as many hold a sharp rim and a wide halo. It is cubic along all
//! three of its axes: where blur hides the radius, a table of straight pieces would hold a fit at one of its corners.

use std::sync::OnceLock;

/// What is proportional to a pixel's value under a sphere, 0 beside it and 1 in the middle of one without blur.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// G_k: what metal of k nepers stops; the chord for k = 0, nearly a disc for 9.
    Flattened(f64),
    /// −ln(1 − (1 − e^(−k)) G_k)/k: its logarithm, taken after blur.
    Logarithm(f64),
}

/// Of images whose scale is not known: chord, transmission of about three nepers, almost a disc, and the logarithm of a deep shadow.
pub const SHAPES: [Shape; 4] = [Shape::Flattened(0.0), Shape::Flattened(3.0), Shape::Flattened(9.0), Shape::Logarithm(3.5)];

/// Most nepers that are told apart: of what is under thicker metal one quantum in a million arrives.
pub const MOST_NEPERS: f64 = 14.0;

/// Distances, in units of 1 + STRETCH · β radii.
const STEP: f64 = 1.0 / 40.0;
const COLUMNS: usize = 124;
const STRETCH: f64 = 1.5;
/// Rows are even in ln β, from one before the least blur to one after the largest.
const BETA_FIRST: f64 = 0.025;
const BETA_RATIO: f64 = 1.25;
const ROWS: usize = 26;
/// Knots are even in ln(1 + k/BEND), from one before 0 to one after the most.
const BEND: f64 = 1.5;
const KNOTS: usize = 9;
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
    /// ∂G/∂k of a flattened shape, where it is asked; 0 of a logarithm, whose k is fixed.
    pub by_nepers: f64,
}

/// Knot by knot, row by row.
type Table = Vec<f64>;

fn table() -> &'static Table {
    static TABLE: OnceLock<Table> = OnceLock::new();
    TABLE.get_or_init(tabulate)
}

/// Of four neighbours along an axis: the first, and the weights of their cubic (Catmull and Rom) and of its derivative by the axis' step.
struct Cubic {
    first: usize,
    weights: [f64; 4],
    slopes: [f64; 4],
}

impl Cubic {
    /// At `y` between the second and the last but one of `count`; beyond them as on them, without slope.
    fn at(y: f64, count: usize) -> Self {
        let last = (count - 2) as f64;
        let is_inside = y >= 1.0 && y <= last;
        // What is no number is on the second.
        let y = if y > 1.0 { y.min(last - 1e-9) } else { 1.0 };
        let f = y - y.floor();
        let weights = [
            f * (-0.5 + f * (1.0 - 0.5 * f)),
            1.0 + f * f * (1.5 * f - 2.5),
            f * (0.5 + f * (2.0 - 1.5 * f)),
            f * f * (0.5 * f - 0.5),
        ];
        let slopes = [-0.5 + f * (2.0 - 1.5 * f), f * (4.5 * f - 5.0), 0.5 + f * (4.0 - 4.5 * f), f * (1.5 * f - 1.0)];
        let slopes = if is_inside { slopes } else { [0.0; 4] };
        Self { first: y as usize - 1, weights, slopes }
    }
}

/// What a profile has at the table's distances, with one more before the first: it is even about 0.
type Line = [f64; COLUMNS + 1];

/// Of value, derivative by ln β and derivative by nepers; the last place is for vectors of four.
type Terms = [f64; 4];

/// The profile of one shape and blur, ready for many distances.
#[derive(Clone)]
pub struct Profile {
    /// Coefficients of the cubic (Catmull and Rom) from each of the table's distances to the next, constant term first.
    pieces: [[Terms; 4]; COLUMNS - 2],
    /// Steps of the table from which on the profile is nothing.
    end: f64,
    /// Steps of the table per radius.
    steps: f64,
    /// −∂ ln(steps)/∂ ln β.
    widens: f64,
}

impl Profile {
    /// Blur `beta` in radii; it and the nepers are clamped to the table. Without the derivative by nepers, which is of use where they are
    /// fitted.
    pub fn new(shape: Shape, beta: f64) -> Self {
        Self::summed(shape, beta, None)
    }

    /// The same with that derivative.
    pub fn with_nepers(shape: Shape, beta: f64) -> Self {
        Self::summed(shape, beta, matches!(shape, Shape::Flattened(_)).then_some([0.0; COLUMNS + 1]))
    }

    fn summed(shape: Shape, beta: f64, mut by_nepers: Option<Line>) -> Self {
        let (nepers, is_logarithm) = match shape {
            Shape::Flattened(nepers) => (nepers, false),
            Shape::Logarithm(nepers) => (nepers, true),
        };
        let row = Cubic::at((beta / BETA_FIRST).ln() * (1.0 / LN_BETA_RATIO) + 1.0, ROWS);
        let is_known = (0.0..=MOST_NEPERS).contains(&nepers);
        let nepers = nepers.clamp(0.0, MOST_NEPERS);
        let knot = Cubic::at((nepers / BEND).ln_1p() / knot_step() + 1.0, KNOTS);
        let per_neper = if is_known { 1.0 / (knot_step() * (nepers + BEND)) } else { 0.0 };
        let (mut value, mut by_ln_beta) = ([0.0; COLUMNS + 1], [0.0; COLUMNS + 1]);
        for i in 0..4 {
            for j in 0..4 {
                let start = ((knot.first + i) * ROWS + row.first + j) * COLUMNS;
                let line = &table()[start..start + COLUMNS];
                let own = knot.weights[i] * row.weights[j];
                let by_row = knot.weights[i] * row.slopes[j] * (1.0 / LN_BETA_RATIO);
                let by_knot = knot.slopes[i] * row.weights[j] * per_neper;
                for (sum, term) in value[1..].iter_mut().zip(line) {
                    *sum += own * term;
                }
                for (sum, term) in by_ln_beta[1..].iter_mut().zip(line) {
                    *sum += by_row * term;
                }
                if let Some(sums) = &mut by_nepers {
                    for (sum, term) in sums[1..].iter_mut().zip(line) {
                        *sum += by_knot * term;
                    }
                }
            }
        }
        if is_logarithm {
            take_logarithm(&mut value, &mut by_ln_beta, nepers);
        }
        for line in [&mut value, &mut by_ln_beta].into_iter().chain(&mut by_nepers) {
            line[0] = line[2];
        }
        let (least, most) = (beta_of_row(1), beta_of_row(ROWS - 2));
        let known = beta.clamp(least, most);
        let widens = if known == beta { STRETCH * known / (1.0 + STRETCH * known) } else { 0.0 };
        let widest = beta_of_row(row.first + 3);
        let reach = (1.0 + REACH_BETAS * widest) / (1.0 + STRETCH * widest);
        Self {
            pieces: pieces(&value, &by_ln_beta, by_nepers.as_ref()),
            end: (reach / STEP + 3.0).min((COLUMNS - 3) as f64),
            steps: 1.0 / (STEP * (1.0 + STRETCH * known)),
            widens,
        }
    }

    /// Value and derivatives at distance `rho`, in radii.
    // Always inline: where vectors are wide the terms are one.
    #[inline(always)]
    pub fn at(&self, rho: f64) -> Value {
        let x = rho * self.steps;
        if !(x < self.end) {
            return Value::default();
        }
        let i = x as usize;
        let f = x - i as f64;
        let [b, p, q, r] = &self.pieces[i];
        let by_step = p[0] + f * (2.0 * q[0] + 3.0 * f * r[0]);
        let terms: Terms = std::array::from_fn(|n| b[n] + f * (p[n] + f * (q[n] + f * r[n])));
        Value {
            value: terms[0],
            by_rho: by_step * self.steps,
            // At a fixed distance the table's own moves inwards as blur grows.
            by_ln_beta: terms[1] - by_step * x * self.widens,
            by_nepers: terms[2],
        }
    }
}

/// From G to the logarithm of what is left, over the nepers of the middle.
fn take_logarithm(value: &mut Line, by_ln_beta: &mut Line, nepers: f64) {
    let stopped = -(-nepers).exp_m1();
    for (value, by_ln_beta) in value[1..].iter_mut().zip(&mut by_ln_beta[1..]) {
        let left = (1.0 - stopped * *value).max(0.5 * (1.0 - stopped));
        *by_ln_beta *= stopped / (left * nepers);
        *value = -left.ln() / nepers;
    }
}

/// Catmull–Rom along ρ.
fn pieces(value: &Line, by_ln_beta: &Line, by_nepers: Option<&Line>) -> [[Terms; 4]; COLUMNS - 2] {
    let at = |n: usize| -> Terms { [value[n], by_ln_beta[n], by_nepers.map_or(0.0, |line| line[n]), 0.0] };
    std::array::from_fn(|i| {
        let [a, b, c, d] = std::array::from_fn(|n| at(i + n));
        [
            b,
            std::array::from_fn(|n| 0.5 * (c[n] - a[n])),
            std::array::from_fn(|n| a[n] - 2.5 * b[n] + 2.0 * c[n] - 0.5 * d[n]),
            std::array::from_fn(|n| 0.5 * (d[n] - a[n]) + 1.5 * (b[n] - c[n])),
        ]
    })
}

/// ln of the table's ratio.
const LN_BETA_RATIO: f64 = 0.223_143_551_314_209_76;

fn beta_of_row(row: usize) -> f64 {
    BETA_FIRST * BETA_RATIO.powi(row as i32 - 1)
}

fn knot_step() -> f64 {
    (MOST_NEPERS / BEND).ln_1p() / (KNOTS - 3) as f64
}

fn tabulate() -> Table {
    const NODES: usize = 320;
    // Midpoint rule in θ; the integrand is smooth and the narrowest Gaussian spans several nodes.
    let step = std::f64::consts::FRAC_PI_2 / NODES as f64;
    let nodes: Vec<(f64, f64)> = (0..NODES).map(|n| ((n as f64 + 0.5) * step).sin_cos()).collect();
    let stopped: Vec<Vec<f64>> = (0..KNOTS)
        .map(|knot| {
            let k = BEND * ((knot as f64 - 1.0) * knot_step()).exp_m1();
            let share = |cos: f64| if k == 0.0 { cos } else { (-k * cos).exp_m1() / (-k).exp_m1() };
            nodes.iter().map(|(sin, cos)| share(*cos) * sin * cos * step).collect()
        })
        .collect();
    let mut table = vec![0.0; KNOTS * ROWS * COLUMNS];
    for row in 0..ROWS {
        let beta = beta_of_row(row);
        let inverse = 1.0 / (beta * beta);
        for column in 0..COLUMNS {
            let rho = column as f64 * STEP * (1.0 + STRETCH * beta);
            for (n, (t, _)) in nodes.iter().enumerate().filter(|(_, (t, _))| (t - rho).abs() < REACH_BETAS * beta) {
                let gaussian = inverse * (-0.5 * (t - rho).powi(2) * inverse).exp() * bessel_i0_scaled(t * rho * inverse);
                for (knot, stopped) in stopped.iter().enumerate() {
                    table[(knot * ROWS + row) * COLUMNS + column] += stopped[n] * gaussian;
                }
            }
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

    fn blurred(shape: Shape, rho: f64, beta: f64) -> Value {
        Profile::with_nepers(shape, beta).at(rho)
    }

    #[test]
    fn little_blur_leaves_the_chord() {
        let chord = Shape::Flattened(0.0);
        for rho in [0.0, 0.3, 0.6, 0.8] {
            assert!((blurred(chord, rho, BETA_FIRST).value - (1.0f64 - rho * rho).sqrt()).abs() < 3e-3, "{rho}");
        }
        assert!(blurred(chord, 1.3, BETA_FIRST).value.abs() < 1e-6);
    }

    /// The mean of what a sphere stops, seen through a Gaussian about (ρ, 0), on a lattice over the disc.
    fn on_lattice(nepers: f64, rho: f64, beta: f64) -> f64 {
        const SIDE: i32 = 300;
        let place = |n: i32| (f64::from(n) + 0.5) / f64::from(SIDE);
        let share = |off2: f64| {
            let chord = (1.0 - off2).max(0.0).sqrt();
            if nepers == 0.0 { chord } else { (1.0 - (-nepers * chord).exp()) / (1.0 - (-nepers).exp()) }
        };
        let mut sum = 0.0;
        for row in -SIDE..SIDE {
            for column in -SIDE..SIDE {
                let (x, y) = (place(column), place(row));
                sum += share(x * x + y * y) * (-0.5 * ((x - rho).powi(2) + y * y) / (beta * beta)).exp();
            }
        }
        sum / (std::f64::consts::TAU * (beta * f64::from(SIDE)).powi(2))
    }

    #[test]
    fn the_table_is_the_blurred_sphere_and_that_of_other_metal_is_not() {
        let (mut cases, mut least_apart) = (0, f64::INFINITY);
        for nepers in [0.0, 0.3, 1.2, 3.0, 5.0, 9.0, 13.0] {
            for (rho, beta) in [(0.2, 0.06), (0.95, 0.13), (0.7, 0.37), (1.1, 0.37), (0.0, 0.8), (1.6, 0.8), (2.5, 1.9)] {
                let exact = on_lattice(nepers, rho, beta);
                let found = blurred(Shape::Flattened(nepers), rho, beta).value;
                assert!((found - exact).abs() < 2e-3, "{nepers} nepers at {rho}, blur {beta}: {found} for {exact}");
                if rho == 0.7 && nepers < 6.0 {
                    let other = blurred(Shape::Flattened(2.0 * nepers + 2.0), rho, beta).value;
                    least_apart = least_apart.min((other - exact).abs());
                }
                cases += 1;
            }
        }
        assert!(cases == 49 && least_apart > 2e-3, "{cases}, {least_apart}");
    }

    #[test]
    fn a_logarithm_is_taken_after_blur() {
        let nepers = 3.5f64;
        for (rho, beta) in [(0.0, 0.3), (0.9, 0.3), (1.3, 0.6)] {
            let left = 1.0 - (1.0 - (-nepers).exp()) * on_lattice(nepers, rho, beta);
            let found = blurred(Shape::Logarithm(nepers), rho, beta).value;
            assert!((found + left.ln() / nepers).abs() < 5e-3, "{rho} {beta}: {found}");
        }
    }

    #[test]
    fn blur_keeps_the_integral() {
        for nepers in [0.0, 3.0, 9.0] {
            let shape = Shape::Flattened(nepers);
            let integral = |beta: f64| {
                (0..400).map(|n| (n as f64 + 0.5) * 0.01).map(|rho| blurred(shape, rho, beta).value * rho * 0.01).sum::<f64>()
            };
            assert!((integral(0.6) / integral(0.03) - 1.0).abs() < 5e-3, "{nepers}");
        }
    }

    #[test]
    fn beyond_its_end_a_profile_is_nothing() {
        for shape in SHAPES {
            for beta in [0.025, 0.08, 0.3, 1.5, 3.4] {
                let profile = Profile::new(shape, beta);
                let last = profile.at((profile.end - 0.5) / profile.steps);
                assert!(last.value.abs() < 1e-5 && last.by_ln_beta.abs() < 1e-3, "{shape:?} {beta}: {last:?}");
                assert_eq!(profile.at((profile.end + 0.5) / profile.steps).value, 0.0);
                assert!(profile.at(f64::NAN).value == 0.0);
            }
        }
        let narrow = Profile::new(Shape::Flattened(0.0), 0.08);
        assert!(narrow.end < 70.0 && narrow.at(1.2).value > 0.0);
    }

    #[test]
    fn derivatives_are_differences() {
        let (h, mut cases) = (1e-4, 0);
        for (nepers, rho, beta) in [(1.3, 0.83, 0.21), (4.1, 0.4, 0.55), (9.4, 1.5, 0.9), (0.2, 1.1, 1.7)] {
            for is_logarithm in [false, true] {
                let shape = |nepers: f64| if is_logarithm { Shape::Logarithm(nepers) } else { Shape::Flattened(nepers) };
                let value = |nepers: f64, rho: f64, beta: f64| blurred(shape(nepers), rho, beta).value;
                let v = blurred(shape(nepers), rho, beta);
                let by_rho = (value(nepers, rho + h, beta) - value(nepers, rho - h, beta)) / (2.0 * h);
                let by_ln_beta = (value(nepers, rho, beta * (1.0 + h)) - value(nepers, rho, beta * (1.0 - h))) / (2.0 * h);
                assert!((v.by_rho - by_rho).abs() < 1e-3 * by_rho.abs() + 1e-5, "{nepers} {rho} {beta}: {v:?} {by_rho}");
                assert!((v.by_ln_beta - by_ln_beta).abs() < 1e-3 * by_ln_beta.abs() + 1e-5, "{v:?} {by_ln_beta}");
                let without = Profile::new(shape(nepers), beta).at(rho);
                let same = [without.value == v.value, without.by_rho == v.by_rho, without.by_ln_beta == v.by_ln_beta];
                assert!(same == [true; 3] && without.by_nepers == 0.0, "{v:?} {without:?}");
                if !is_logarithm {
                    let by_nepers = (value(nepers + h, rho, beta) - value(nepers - h, rho, beta)) / (2.0 * h);
                    assert!((v.by_nepers - by_nepers).abs() < 1e-3 * by_nepers.abs() + 1e-5, "{v:?} {by_nepers}");
                }
                cases += 1;
            }
        }
        assert_eq!(cases, 8);
    }
}

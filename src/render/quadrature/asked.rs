//! What nodes are fitted to, how well they are to do, and why that may be impossible.

/// Most materials in one fit.
pub const MOST_MATERIALS: usize = 8;

/// A spectrum in bins, as the signal sees it.
#[derive(Clone, Copy, Debug)]
pub struct EnergyBins<'a> {
    /// Energies of the bins, ascending.
    pub energies_kev: &'a [f64],
    /// φ_k r_k / Σ φ r; bins may be empty.
    pub signal_weights: &'a [f64],
    /// φ_k and φ_k r_k², in any scale, where noise is asked for.
    pub noise_weights: Option<NoiseWeights<'a>>,
    /// Mass attenuation: one slice a material, one value a bin.
    pub cm2_per_g: &'a [Vec<f64>],
}

/// Weights of the two further sums that noise needs.
#[derive(Clone, Copy, Debug)]
pub struct NoiseWeights<'a> {
    /// φ_k.
    pub photons: &'a [f64],
    /// φ_k r_k².
    pub squares: &'a [f64],
}

/// The paths an image can contain.
#[derive(Clone, Copy, Debug)]
pub struct Region<'a> {
    /// Largest area density of each material; any combination from 0 to these is expected.
    pub largest_g_per_cm2: &'a [f64],
    /// Combinations with a larger −ln I are out of reach.
    pub largest_line_integral: Option<f64>,
}

/// How large |Δ ln I| / max(1, −ln I) may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerance {
    /// Of the signal.
    pub signal: f64,
    /// Of Σ φ T and Σ φ r² T.
    pub noise: f64,
}

impl Tolerance {
    /// `signal`, and 1 % for the noise.
    #[must_use]
    pub fn of_signal(signal: f64) -> Self {
        Self { signal, noise: 0.01 }
    }
}

/// Why no nodes can be fitted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum QuadratureError {
    /// Slices disagree.
    #[error("{what}: {found} values, expected {expected}")]
    Length {
        /// Of what.
        what: &'static str,
        /// Found.
        found: usize,
        /// Expected.
        expected: usize,
    },
    /// A value is negative, infinite or not a number.
    #[error("{what}: {found} at {index}, expected a finite value of at least 0")]
    Value {
        /// Of what.
        what: &'static str,
        /// Where.
        index: usize,
        /// Found.
        found: f64,
    },
    /// Weights add up to nothing.
    #[error("{what}: sum {sum}, expected more than 0")]
    Empty {
        /// Of what.
        what: &'static str,
        /// Their sum.
        sum: f64,
    },
    /// Too many materials.
    #[error("materials: {found}, expected at most {MOST_MATERIALS}")]
    Materials {
        /// Found.
        found: usize,
    },
}

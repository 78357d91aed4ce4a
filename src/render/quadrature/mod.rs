//! Few exponentials instead of a whole spectrum: nodes fitted to the paths that an image can contain.
//!
//! Polychromatic attenuation is I(L) = Σ_k w_k exp(−Σ_m μ_m(E_k) L_m) over some hundred bins. On a bounded set of paths a handful of
//! terms of the same form does as well (an exponential-sum approximation; Lawson's reweighting brings it near the smallest worst
//! error). A node is not a photon energy: its attenuations are free in each material, which pays most where K edges lie in the spectrum,
//! but they stay between those of the bins. Weights are positive and add up to the bins' sum, so air is exact and no path gives NaN.

mod mixture;
mod bins;
mod paths;
mod bound;
mod fit;
mod search;
#[cfg(test)]
mod fixture;
#[cfg(test)]
mod tests;

use bins::Bins;

/// Most materials in one fit.
pub const MOST_MATERIALS: usize = 8;

/// Most nodes a fit tries.
pub const MOST_NODES: usize = 12;

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

/// One term.
#[derive(Clone, Debug, PartialEq)]
pub struct QuadratureNode {
    /// The energy whose attenuation is most like the node's, for people.
    pub energy_kev: f64,
    /// Share in Σ φ r T / Σ φ r.
    pub signal_weight: f64,
    /// Share in Σ φ T, in the scale of the bins' φ; 0 where noise was not asked for.
    pub photon_weight: f64,
    /// Share in Σ φ r² T, in the scale of the bins' φ r²; 0 where noise was not asked for.
    pub square_weight: f64,
    /// Mass attenuation of each material.
    pub cm2_per_g: Vec<f64>,
}

/// A spectrum in few terms, and how well they do.
#[derive(Clone, Debug, PartialEq)]
pub struct Quadrature {
    /// By ascending energy.
    pub nodes: Vec<QuadratureNode>,
    /// 1.4 times the worst |Δ ln I| / max(1, −ln I) found over the box.
    pub bound: f64,
    /// The same for Σ φ T and Σ φ r² T, the worse of them; 0 where noise was not asked for.
    pub noise_bound: f64,
    /// Paths that were judged.
    pub samples: usize,
}

impl Quadrature {
    /// Whether both bounds are within `tolerance`.
    #[must_use]
    pub fn meets(&self, tolerance: Tolerance) -> bool {
        self.bound <= tolerance.signal && self.noise_bound <= tolerance.noise
    }

    /// −ln of the nodes' signal along a path (g/cm² of each material).
    #[must_use]
    pub fn line_integral(&self, g_per_cm2: &[f64]) -> f64 {
        let depth = |node: &QuadratureNode| -> f64 { node.cm2_per_g.iter().zip(g_per_cm2).map(|(mu, length)| mu * length).sum() };
        let smallest = self.nodes.iter().map(depth).fold(f64::INFINITY, f64::min);
        let sum: f64 = self.nodes.iter().map(|node| node.signal_weight * (smallest - depth(node)).exp()).sum();
        smallest - sum.ln()
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

/// The fewest nodes, up to [`MOST_NODES`], whose bounds over `region` are within `tolerance`; none if there are none, and the image
/// then takes all bins. Deterministic: the same input gives the same bits.
///
/// # Errors
/// When slices disagree in length, a value is not finite or negative, or a sum of weights is empty.
pub fn fit(bins: &EnergyBins, region: &Region, tolerance: Tolerance) -> Result<Option<Quadrature>, QuadratureError> {
    Ok(search::fewest_nodes(&Bins::new(bins, region)?, tolerance))
}

/// The largest magnitude; NaN if any is.
fn worst(errors: impl Iterator<Item = f64>) -> f64 {
    errors.fold(0.0, |worst: f64, error| if error.is_nan() || worst.is_nan() { f64::NAN } else { worst.max(error.abs()) })
}

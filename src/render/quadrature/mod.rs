//! Few exponentials instead of a whole spectrum: nodes fitted to the paths that an image can contain.
//!
//! Polychromatic attenuation is I(L) = Σ_k w_k exp(−Σ_m μ_m(E_k) L_m) over some hundred bins. On a bounded set of paths a handful of
//! terms of the same form does as well (an exponential-sum approximation; Lawson's reweighting brings it near the smallest worst
//! error). A node is not a photon energy: its attenuations are free in each material, which pays most where K edges lie in the spectrum,
//! but they stay between those of the bins. Weights are positive and add up to the bins' sum, so air is exact and no path gives NaN.

mod asked;
mod found;
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

pub use asked::{EnergyBins, MOST_MATERIALS, NoiseWeights, QuadratureError, Region, Tolerance};
pub use found::{Quadrature, QuadratureNode};
pub use search::MOST_NODES;

use bins::Bins;

/// The fewest nodes, up to [`MOST_NODES`], whose bounds over `region` are within `tolerance`; none if there are none, and the image
/// then takes all bins. Deterministic: the same input gives the same bits.
///
/// # Errors
/// When slices disagree in length, a value is not finite or negative, or a sum of weights is empty.
pub fn fit(bins: &EnergyBins, region: &Region, tolerance: Tolerance) -> Result<Option<Quadrature>, QuadratureError> {
    Ok(search::fewest_nodes(&Bins::new(bins, region)?, tolerance))
}

//! A sum of exponentials over paths through matter: the spectrum's bins and the quadrature's nodes alike.

/// How many sums share the exponentials: signal, photons, squared response.
pub(super) const SUMS: usize = 3;

/// A bin that another outweighs by this much on every path is left out of the exact sum.
const NEGLIGIBLE: f64 = 1e-15;

/// Exponents this far below the largest are left out: e⁻⁸⁰ = 2e-35 of it.
const FAINT: f64 = 80.0;

/// Σ_k w_k exp(−Σ_m μ_km L_m) for up to [`SUMS`] sets of weights.
#[derive(Clone, Debug)]
pub(super) struct Mixture {
    pub materials: usize,
    /// Per term, one weight for each sum; each sum's weights add up to 1 (or are all 0 where the sum is not asked for).
    pub weights: Vec<[f64; SUMS]>,
    /// Term-major: `[term * materials + material]`.
    pub cm2_per_g: Vec<f64>,
}

impl Mixture {
    pub fn terms(&self) -> usize {
        self.weights.len()
    }

    pub fn attenuation(&self, term: usize) -> &[f64] {
        &self.cm2_per_g[term * self.materials..(term + 1) * self.materials]
    }

    /// −ln of each sum along `path`; NaN where a sum has no weights.
    // With d the smallest depth, Σ w exp(−depth) = exp(−d) Σ w exp(d − depth), which neither under- nor overflows.
    pub fn line_integrals(&self, path: &[f64], depths: &mut Vec<f64>) -> [f64; SUMS] {
        let smallest = self.depths(path, depths);
        let mut sums = [0.0; SUMS];
        for (depth, weights) in depths.iter().zip(&self.weights) {
            let below = depth - smallest;
            if below < FAINT {
                let factor = (-below).exp();
                for (sum, weight) in sums.iter_mut().zip(weights) {
                    *sum += weight * factor;
                }
            }
        }
        sums.map(|sum| if sum > 0.0 { smallest - sum.ln() } else { f64::NAN })
    }

    /// Fills `depths` with the terms' optical depths along `path` and returns the smallest.
    pub fn depths(&self, path: &[f64], depths: &mut Vec<f64>) -> f64 {
        depths.clear();
        let mut smallest = f64::INFINITY;
        for term in 0..self.terms() {
            let depth: f64 = self.attenuation(term).iter().zip(path).map(|(mu, length)| mu * length).sum();
            smallest = smallest.min(depth);
            depths.push(depth);
        }
        smallest
    }

    /// Without the terms that another outweighs everywhere: heavier by 1/[`NEGLIGIBLE`] and no better attenuated.
    pub fn without_negligible(self) -> Self {
        let outweighed = |term: usize| {
            (0..self.terms()).any(|other| {
                let heavier = self.weights[term].iter().zip(&self.weights[other]).all(|(w, o)| *w <= o * NEGLIGIBLE);
                heavier && other != term && self.attenuation(other).iter().zip(self.attenuation(term)).all(|(o, t)| o <= t)
            })
        };
        let kept: Vec<usize> = (0..self.terms()).filter(|term| !outweighed(*term)).collect();
        Self {
            materials: self.materials,
            weights: kept.iter().map(|term| self.weights[*term]).collect(),
            cm2_per_g: kept.iter().flat_map(|term| self.attenuation(*term).to_vec()).collect(),
        }
    }
}

/// The largest magnitude; NaN if any is.
pub(super) fn worst(errors: impl Iterator<Item = f64>) -> f64 {
    errors.fold(0.0, |worst: f64, error| if error.is_nan() || worst.is_nan() { f64::NAN } else { worst.max(error.abs()) })
}

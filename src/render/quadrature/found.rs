//! A spectrum in few terms.

use super::asked::Tolerance;

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

//! The beam and the materials as tables of f32 that both executors read.

use super::RenderError;
use super::plan_parts::{Fitted, Node, response};
use crate::scene::model::{Formation, Scene};
use crate::scene::physics::Bin;

/// Bins are padded to a multiple of this; padding has no weight.
pub const LANES: usize = 8;

/// Weights and attenuation per energy.
#[derive(Clone, Debug, Default)]
pub struct Bins {
    /// Bins with padding.
    pub padded: usize,
    /// φ r / Σ φ r.
    pub signal_weight: Vec<f32>,
    /// φ.
    pub photon_weight: Vec<f32>,
    /// φ r².
    pub square_weight: Vec<f32>,
    /// μ/ρ in cm²/g, by material, then by bin.
    pub cm2_per_g: Vec<f32>,
    /// Σ φ r: mean response in air.
    pub mean_response: f64,
    /// Σ φ r².
    pub mean_square_response: f64,
}

impl Bins {
    /// Tabulates `nodes` for the materials of `scene`; naive formation becomes one bin in which every material attenuates alike.
    ///
    /// # Errors
    /// When an energy is outside the tables, or no photon is left.
    pub fn new(scene: &Scene, nodes: &[Node]) -> Result<Self, RenderError> {
        if nodes.iter().any(|node| node.fitted.is_some()) {
            return Self::fitted(scene, nodes);
        }
        let total: f64 = nodes.iter().map(|node| node.fraction).sum();
        let mean_response: f64 = nodes.iter().map(|node| node.fraction * response(scene, node)).sum::<f64>() / total;
        let mean_square_response = nodes.iter().map(|node| node.fraction * response(scene, node).powi(2)).sum::<f64>() / total;
        if !(total > 0.0 && mean_response > 0.0) {
            return Err(RenderError::NoPhotons);
        }
        let rows: Vec<(f64, f64)> = match scene.model.formation {
            Formation::Deepdrr => nodes.iter().map(|node| (node.fraction / total, response(scene, node))).collect(),
            Formation::Naive => vec![(1.0, mean_response)],
        };
        let padded = rows.len().div_ceil(LANES) * LANES;
        let column = |f: &dyn Fn(f64, f64) -> f64| {
            let mut values: Vec<f32> = rows.iter().map(|(fraction, r)| f(*fraction, *r) as f32).collect();
            values.resize(padded, 0.0);
            values
        };
        let signal_weight = column(&|fraction, r| fraction * r / mean_response);
        let photon_weight = column(&|fraction, _| fraction);
        let square_weight = column(&|fraction, r| fraction * r * r);
        let mut cm2_per_g = Vec::with_capacity(padded * scene.materials.len());
        let kappa = if scene.model.formation == Formation::Naive { naive_kappa(scene, nodes, total)? } else { 0.0 };
        for material in &scene.materials {
            let start = cm2_per_g.len();
            match scene.model.formation {
                Formation::Naive => cm2_per_g.push(kappa as f32),
                Formation::Deepdrr => {
                    for node in nodes {
                        cm2_per_g.push(material.attenuation(node.energy_kev)?.total_cm2_per_g as f32);
                    }
                }
            }
            // Padding repeats the last value: it has no weight, and must not become the smallest depth.
            let last = cm2_per_g.last().copied().unwrap_or(0.0);
            cm2_per_g.resize(start + padded, last);
        }
        Ok(Self { padded, signal_weight, photon_weight, square_weight, cm2_per_g, mean_response, mean_square_response })
    }
}

impl Bins {
    /// The terms of a fit in place of bins; the means in air are those of the whole spectrum.
    fn fitted(scene: &Scene, nodes: &[Node]) -> Result<Self, RenderError> {
        let whole = Self::new(scene, &whole_spectrum(scene))?;
        let padded = nodes.len().div_ceil(LANES) * LANES;
        let column = |f: &dyn Fn(&Node, &Fitted) -> f64| {
            let pairs = nodes.iter().filter_map(|node| Some((node, node.fitted.as_ref()?)));
            let mut values: Vec<f32> = pairs.map(|(node, fitted)| f(node, fitted) as f32).collect();
            values.resize(padded, 0.0);
            values
        };
        let mut cm2_per_g = Vec::with_capacity(padded * scene.materials.len());
        for material in 0..scene.materials.len() {
            let mut row = column(&|_, fitted| fitted.cm2_per_g.get(material).copied().unwrap_or(f64::NAN));
            let last = row.get(nodes.len().saturating_sub(1)).copied().unwrap_or(0.0);
            row.iter_mut().skip(nodes.len()).for_each(|value| *value = last);
            cm2_per_g.extend_from_slice(&row);
        }
        Ok(Self {
            padded,
            signal_weight: column(&|_, fitted| fitted.signal_share),
            photon_weight: column(&|node, _| node.fraction),
            square_weight: column(&|_, fitted| fitted.square_share * whole.mean_square_response),
            cm2_per_g,
            mean_response: whole.mean_response,
            mean_square_response: whole.mean_square_response,
        })
    }
}

/// The spectrum as the panel detects it: φ times the absorption of the scintillator, Σ = 1; the beam's own for naive formation.
#[must_use]
pub fn detected_bins(scene: &Scene) -> Vec<Bin> {
    let bins = &scene.beam.spectrum.bins;
    let Some(scintillator) = scene.detector.panel.scintillator.as_ref().filter(|_| scene.model.formation == Formation::Deepdrr)
    else {
        return bins.clone();
    };
    // Outside the tables the share is NaN, which the sum over the spectrum refuses.
    let detected = |bin: &Bin| bin.fluence * scintillator.absorption(bin.energy_kev).unwrap_or(f64::NAN);
    let total: f64 = bins.iter().map(detected).sum();
    bins.iter().map(|bin| Bin { energy_kev: bin.energy_kev, fluence: detected(bin) / total }).collect()
}

/// Every bin in which photons are detected.
#[must_use]
pub fn whole_spectrum(scene: &Scene) -> Vec<Node> {
    // NaN stays in, to be seen.
    let bins = detected_bins(scene).into_iter().filter(|bin| !(bin.fluence <= 0.0));
    bins.map(|bin| Node { energy_kev: bin.energy_kev, fraction: bin.fluence, fitted: None }).collect()
}

/// κ of Eq. 8: mean over the scene's materials of Σ φ (μ/ρ).
fn naive_kappa(scene: &Scene, nodes: &[Node], total: f64) -> Result<f64, RenderError> {
    let mut sum = 0.0;
    for material in &scene.materials {
        for node in nodes {
            sum += node.fraction / total * material.attenuation(node.energy_kev)?.total_cm2_per_g;
        }
    }
    Ok(sum / scene.materials.len().max(1) as f64)
}

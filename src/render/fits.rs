//! Energies fitted to spectra: made once for a region of paths, used for every view whose paths lie in it.

use super::RenderError;
use super::pilot::Pilot;
use super::plan_parts::{Fitted, Node, response};
use super::quadrature::{self, NoiseWeights, Quadrature, QuadratureNode, Tolerance};
use super::spectrum::whole_spectrum;
use crate::scene::model::Scene;

/// Fits that were made, or tried in vain.
#[derive(Debug, Default)]
pub struct Fits {
    made: Vec<Fit>,
    /// Fits are made for paths this many times those that the scene needs, so that they serve other views as well; 0 and 1 are the same.
    pub room: f64,
    /// How many were made or tried, also those that are forgotten.
    pub tried: usize,
}

/// What is fitted.
#[derive(Clone, Copy, Debug)]
pub struct Wish<'s> {
    /// The scene, for its spectrum and materials.
    pub scene: &'s Scene,
    /// Whether noise needs its sums.
    pub noise: bool,
}

/// A fit that was made, or tried in vain.
#[derive(Clone, Debug)]
struct Fit {
    key: Key,
    /// Paths that it covers, g/cm² by material.
    largest_g_per_cm2: Vec<f64>,
    quadrature: Option<Quadrature>,
}

/// What a fit depends on, apart from the paths.
#[derive(Clone, Debug, PartialEq)]
struct Key {
    spectrum: Vec<(f64, f64)>,
    materials: Vec<String>,
    tolerance: f64,
    noise: bool,
}

/// A fit for paths longer than so many times what is needed is not taken: it has more nodes than it must.
const MOST_ROOM: f64 = 8.0;

impl Fit {
    /// Whether it says what a fit for paths up to `needed` would: what holds for all paths of a box holds for those of a smaller one, and what
    /// cannot be had there cannot be had in a larger one.
    fn answers(&self, needed: &[f64]) -> bool {
        let mut pairs = self.largest_g_per_cm2.iter().zip(needed);
        match self.quadrature {
            Some(_) => pairs.all(|(has, needs)| has >= needs && (*needs == 0.0 || *has <= MOST_ROOM * needs)),
            None => pairs.all(|(has, needs)| has <= needs),
        }
    }
}

impl Fits {
    /// Nodes fitted to the spectrum and to paths at least a half longer than the pilot rays', and those paths; `None` where none meet
    /// `tolerance`.
    ///
    /// # Errors
    /// When attenuation is not tabulated.
    pub fn get(&mut self, wish: &Wish, pilot: &Pilot, tolerance: f64) -> Result<Option<(Quadrature, Vec<f64>)>, RenderError> {
        let scene = wish.scene;
        let nodes = whole_spectrum(scene);
        let key = Key {
            spectrum: nodes.iter().map(|node| (node.energy_kev, node.fraction * response(scene, node))).collect(),
            materials: scene.materials.iter().map(|material| material.name.clone()).collect(),
            tolerance,
            noise: wish.noise,
        };
        let needed: Vec<f64> = pilot.largest_g_per_cm2.iter().map(|largest| PATHS_MARGIN * largest).collect();
        if let Some(fit) = self.made.iter().find(|fit| fit.key == key && fit.answers(&needed)) {
            return Ok(fit.quadrature.clone().map(|quadrature| (quadrature, fit.largest_g_per_cm2.clone())));
        }
        self.tried += 1;
        let largest_g_per_cm2 = region(&needed, self.room.max(1.0));
        let energies_kev: Vec<f64> = nodes.iter().map(|node| node.energy_kev).collect();
        let weights =
            |power: i32| -> Vec<f64> { nodes.iter().map(|node| node.fraction * response(scene, node).powi(power)).collect() };
        let (photons, signal, squares) = (weights(0), weights(1), weights(2));
        let mut cm2_per_g = Vec::new();
        for material in &scene.materials {
            let row: Result<Vec<f64>, _> =
                energies_kev.iter().map(|kev| material.attenuation(*kev).map(|found| found.total_cm2_per_g)).collect();
            cm2_per_g.push(row?);
        }
        let noise_weights = key.noise.then_some(NoiseWeights { photons: &photons, squares: &squares });
        let spectrum =
            quadrature::EnergyBins { energies_kev: &energies_kev, signal_weights: &signal, noise_weights, cm2_per_g: &cm2_per_g };
        let box_ = quadrature::Region { largest_g_per_cm2: &largest_g_per_cm2, largest_line_integral: None };
        let wanted = Tolerance::of_signal(tolerance);
        // What cannot be fitted is evaluated bin by bin.
        let fit = quadrature::fit(&spectrum, &box_, wanted)
            .ok()
            .flatten()
            .filter(|fit| fit.meets(wanted) && fit.nodes.len() < nodes.len());
        if self.made.len() >= 64 {
            self.made.remove(0);
        }
        self.made.push(Fit { key, largest_g_per_cm2: largest_g_per_cm2.clone(), quadrature: fit.clone() });
        Ok(fit.map(|fit| (fit, largest_g_per_cm2)))
    }
}

/// A fit covers paths so many times the pilot rays'.
const PATHS_MARGIN: f64 = 1.5;

/// Paths that a fit is made for: `room` times those that are needed, rounded up so that neighbouring views share fits.
fn region(needed: &[f64], room: f64) -> Vec<f64> {
    let grow = |largest: &f64| if *largest > 0.0 { 1.25f64.powf((room * largest).max(0.1).log(1.25).ceil()) } else { 0.0 };
    needed.iter().map(grow).collect()
}

/// The nodes of a fit as plans have them.
#[must_use]
pub fn nodes_of(fit: &Quadrature) -> Vec<Node> {
    // Where no noise is asked for, photons are not fitted; signal over energy is near enough for people to read.
    let photon =
        |node: &QuadratureNode| if node.photon_weight > 0.0 { node.photon_weight } else { node.signal_weight / node.energy_kev };
    let signal: f64 = fit.nodes.iter().map(|node| node.signal_weight).sum();
    let photons: f64 = fit.nodes.iter().map(photon).sum();
    let squares: f64 = fit.nodes.iter().map(|node| node.square_weight).sum();
    fit.nodes
        .iter()
        .map(|node| Node {
            energy_kev: node.energy_kev,
            fraction: photon(node) / photons,
            fitted: Some(Fitted {
                signal_share: node.signal_weight / signal,
                square_share: if squares > 0.0 { node.square_weight / squares } else { 0.0 },
                cm2_per_g: node.cm2_per_g.clone(),
            }),
        })
        .collect()
}

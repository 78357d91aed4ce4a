//! The fewest nodes that meet a tolerance: fit, exchange, judge, one node more.

use super::asked::Tolerance;
use super::bins::Bins;
use super::bound::{errors, worst_nearby};
use super::fit::{Nodes, Problem, refine};
use super::found::{Quadrature, QuadratureNode};
use super::mixture::{Mixture, SUMS, worst};
use super::paths::Paths;

/// Most nodes a fit tries.
pub const MOST_NODES: usize = 12;

/// The judged worst error is multiplied by this to give the bound.
const MARGIN: f64 = 1.4;

/// The worst error a fit stops at, as a part of the tolerance: a little below 1 / [`MARGIN`].
const GOAL: f64 = 0.69;

/// Quasi-random paths that are judged, beside grid, axes and planes.
const JUDGED: usize = 2500;

/// Paths exchanged into the fit at a time, and how often.
const EXCHANGED: usize = 12;
const EXCHANGES: usize = 4;

/// How often a fit that is good enough but judged otherwise is tightened, and by how much.
const ATTEMPTS: usize = 3;
const TIGHTER: f64 = 0.6;

/// As [`super::fit`].
pub(super) fn fewest_nodes(bins: &Bins, tolerance: Tolerance) -> Option<Quadrature> {
    let materials = bins.active.len();
    if materials == 0 {
        return Some(nothing_in_the_beam(bins));
    }
    let mut search = Search {
        bins,
        tolerance,
        fitted: bins.reach.for_fitting(&bins.mixture, 80 + 40 * materials),
        candidates: bins.reach.candidates(&bins.mixture, 300 + 200 * materials),
        judged: None,
    };
    let importance = search.importance();
    let mut fewer: Option<Nodes> = None;
    for count in 1..=MOST_NODES {
        if bins.mixture.terms() <= count {
            let quadrature = search.judge(&bins.mixture);
            return quadrature.meets(tolerance).then_some(quadrature);
        }
        let mut closest: Option<(Nodes, f64)> = None;
        let groups = grouped(&bins.mixture, &importance, count);
        for start in [Some(groups), fewer.map(|nodes| split(nodes, materials))].into_iter().flatten() {
            let (nodes, error, quadrature) = search.attempt(&start);
            if quadrature.is_some() {
                return quadrature;
            }
            if closest.as_ref().is_none_or(|(_, least)| error < *least) {
                closest = Some((nodes, error));
            }
        }
        fewer = closest.map(|(nodes, _)| nodes);
    }
    None
}

/// One node: with nothing in the beam every sum is its air value.
fn nothing_in_the_beam(bins: &Bins) -> Quadrature {
    let mean = mean_energy(bins);
    let node = node_of(bins, mean, [1.0; SUMS], &[]);
    Quadrature { nodes: vec![node], bound: 0.0, noise_bound: 0.0, samples: 1 }
}

struct Search<'a> {
    bins: &'a Bins<'a>,
    tolerance: Tolerance,
    fitted: Paths,
    candidates: Paths,
    judged: Option<Paths>,
}

impl Search<'_> {
    fn problem<'p>(&'p self, sum: usize, goal: f64) -> Problem<'p> {
        Problem { paths: &self.fitted, sum, ln_bounds: &self.bins.ln_bounds, attenuation_free: sum == 0, goal }
    }

    /// Fits from `start`, to a tighter goal as long as the judgement asks for it. Returns the nodes, their worst error over the paths
    /// of the fit, and the quadrature if it is within the tolerance.
    fn attempt(&mut self, start: &Nodes) -> (Nodes, f64, Option<Quadrature>) {
        let mut goal = GOAL * self.tolerance.signal;
        let (mut nodes, mut error) = self.fit(start, goal);
        for _ in 0..ATTEMPTS {
            if !(error * MARGIN <= self.tolerance.signal) {
                break;
            }
            let quadrature = self.judge(&self.with_noise(&nodes));
            if quadrature.meets(self.tolerance) {
                return (nodes, error, Some(quadrature));
            }
            // Missed where the fit does not look, or by the noise, whose weights gain from better placed nodes.
            goal = TIGHTER * error.min(goal);
            let (tighter, lower) = self.fit(&nodes, goal);
            if !(lower < error) {
                break;
            }
            (nodes, error) = (tighter, lower);
        }
        (nodes, error, None)
    }

    /// Refines `start`, taking the worst candidate paths into the fit as long as they miss the tolerance. Returns the nodes and their
    /// worst error over both sets of paths.
    fn fit(&mut self, start: &Nodes, goal: f64) -> (Nodes, f64) {
        let materials = self.bins.active.len();
        let (mut nodes, mut fitted) = refine(&self.problem(0, goal), start, materials);
        let mut best = (nodes.clone(), f64::INFINITY);
        for exchange in 0..=EXCHANGES {
            let errors = errors(&nodes.mixture(materials), &self.candidates, 1);
            let error = worst(errors.iter().map(|e| e[0])).max(fitted);
            if error < best.1 {
                best = (nodes.clone(), error);
            }
            let limit = goal * GOAL.recip() / MARGIN;
            if exchange == EXCHANGES || !(fitted <= limit) || error <= limit {
                break;
            }
            let mut order: Vec<usize> = (0..errors.len()).collect();
            order.sort_by(|a, b| errors[*b][0].abs().total_cmp(&errors[*a][0].abs()));
            for index in order.into_iter().take(EXCHANGED) {
                self.fitted.take(&self.candidates, index);
            }
            (nodes, fitted) = refine(&self.problem(0, goal), &nodes, materials);
        }
        best
    }

    /// Fits the weights of the other sums to the same attenuations.
    fn with_noise(&self, nodes: &Nodes) -> Mixture {
        let mut mixture = nodes.mixture(self.bins.active.len());
        for sum in 1..self.bins.sums {
            let (of_sum, _) = refine(&self.problem(sum, 0.1 * self.tolerance.noise), nodes, mixture.materials);
            for (weights, weight) in mixture.weights.iter_mut().zip(&of_sum.weights) {
                weights[sum] = *weight;
            }
        }
        mixture
    }

    /// Judges `mixture` on paths that no fit has seen.
    fn judge(&mut self, mixture: &Mixture) -> Quadrature {
        let bins = self.bins;
        let judged = self.judged.get_or_insert_with(|| bins.reach.for_judging(&bins.mixture, JUDGED));
        let errors = errors(mixture, judged, bins.sums);
        let bound_of = |sum: usize| {
            let tolerance = if sum == 0 { self.tolerance.signal } else { self.tolerance.noise };
            MARGIN * worst_nearby(bins, mixture, judged, &errors, sum, tolerance / MARGIN)
        };
        let mut nodes: Vec<QuadratureNode> = (0..mixture.terms())
            .map(|term| {
                let attenuation = mixture.attenuation(term);
                node_of(bins, nearest_bin(bins, attenuation), mixture.weights[term], attenuation)
            })
            .collect();
        nodes.sort_by(|a, b| a.energy_kev.total_cmp(&b.energy_kev));
        Quadrature { nodes, bound: bound_of(0), noise_bound: worst((1..bins.sums).map(bound_of)), samples: judged.len() }
    }

    /// How much each bin matters over the fitted paths: its mean share in the signal.
    fn importance(&self) -> Vec<f64> {
        let bins = &self.bins.mixture;
        let mut importance = vec![0.0; bins.terms()];
        let mut depths = Vec::new();
        for index in 0..self.fitted.len() {
            bins.depths(self.fitted.path(index), &mut depths);
            let line_integral = self.fitted.exact[index][0];
            for ((sum, depth), weights) in importance.iter_mut().zip(&depths).zip(&bins.weights) {
                *sum += weights[0] * (line_integral - depth).exp();
            }
        }
        importance
    }
}

/// Neighbouring bins in `count` groups of equal importance, lumped to their weights and importance-weighted mean attenuations.
fn grouped(bins: &Mixture, importance: &[f64], count: usize) -> Nodes {
    let total: f64 = importance.iter().sum();
    let mut groups = vec![(0.0, 0.0, vec![0.0; bins.materials]); count];
    let mut below = 0.0;
    for (term, share) in importance.iter().enumerate() {
        let group = (((below + 0.5 * share) / total * count as f64) as usize).min(count - 1);
        below += share;
        let (weight, sum, attenuation) = &mut groups[group];
        *weight += bins.weights[term][0];
        *sum += share;
        attenuation.iter_mut().zip(bins.attenuation(term)).for_each(|(mean, mu)| *mean += share * mu);
    }
    groups.retain(|(weight, sum, _)| *weight > 0.0 && *sum > 0.0);
    Nodes {
        weights: groups.iter().map(|(weight, ..)| *weight).collect(),
        cm2_per_g: groups.iter().flat_map(|(_, sum, attenuation)| attenuation.iter().map(move |mu| mu / sum)).collect(),
    }
}

/// One node more: the heaviest in two, a quarter up and down in attenuation.
fn split(mut nodes: Nodes, materials: usize) -> Nodes {
    let heaviest = (0..nodes.weights.len()).fold(0, |best, n| if nodes.weights[n] > nodes.weights[best] { n } else { best });
    nodes.weights[heaviest] *= 0.5;
    nodes.weights.push(nodes.weights[heaviest]);
    let range = heaviest * materials..(heaviest + 1) * materials;
    let softer: Vec<f64> = nodes.cm2_per_g[range.clone()].iter().map(|mu| mu * 0.8).collect();
    nodes.cm2_per_g[range].iter_mut().for_each(|mu| *mu *= 1.25);
    nodes.cm2_per_g.extend(softer);
    nodes
}

fn mean_energy(bins: &Bins) -> f64 {
    let source = bins.source;
    let (weighted, sum) = source
        .energies_kev
        .iter()
        .zip(source.signal_weights)
        .fold((0.0, 0.0), |(weighted, sum), (energy, weight)| (weighted + energy * weight, sum + weight));
    weighted / sum
}

/// Energy of the occupied bin whose attenuation is most like `attenuation`: least squares of logarithms.
fn nearest_bin(bins: &Bins, attenuation: &[f64]) -> f64 {
    let source = bins.source;
    let distance = |k: usize| -> f64 {
        let of_material = |(mu, m): (&f64, &usize)| (mu.max(1e-12) / source.cm2_per_g[*m][k].max(1e-12)).ln().powi(2);
        attenuation.iter().zip(&bins.active).map(of_material).sum()
    };
    (0..source.energies_kev.len())
        .filter(|k| source.signal_weights[*k] > 0.0)
        .min_by(|a, b| distance(*a).total_cmp(&distance(*b)))
        .map_or(0.0, |k| source.energies_kev[k])
}

/// A node in the caller's materials and scales; materials that cannot lie in the beam are given their attenuation at `energy_kev`.
fn node_of(bins: &Bins, energy_kev: f64, weights: [f64; SUMS], attenuation: &[f64]) -> QuadratureNode {
    let source = bins.source;
    let nearest = (0..source.energies_kev.len())
        .min_by(|a, b| (source.energies_kev[*a] - energy_kev).abs().total_cmp(&(source.energies_kev[*b] - energy_kev).abs()));
    let mut cm2_per_g: Vec<f64> = source.cm2_per_g.iter().map(|mu| nearest.map_or(0.0, |k| mu[k])).collect();
    for (m, mu) in bins.active.iter().zip(attenuation) {
        cm2_per_g[*m] = *mu;
    }
    let [signal_weight, photon_weight, square_weight] = [0, 1, 2].map(|sum| weights[sum] * bins.totals[sum]);
    QuadratureNode { energy_kev, signal_weight, photon_weight, square_weight, cm2_per_g }
}

//! Levenberg–Marquardt on the nodes' logarithms, reweighted toward the smallest worst error.

use nalgebra::{DMatrix, DVector};

use super::mixture::{Mixture, SUMS, worst};
use super::paths::Paths;

/// Nodes as the fit moves them: W_n = exp(a_n) / Σ exp(a) and M_nm = exp(b_nm), so that weights are positive and air is exact.
#[derive(Clone, Debug)]
struct Parameters {
    nodes: usize,
    materials: usize,
    /// a_1 … a_N, then b node-major.
    values: DVector<f64>,
}

/// What the fit may change and what it aims at.
pub(super) struct Problem<'a> {
    pub paths: &'a Paths,
    /// Which of the sums.
    pub sum: usize,
    /// Smallest and largest ln cm²/g of the bins, by material: nodes stay between them, so they extrapolate like a spectrum.
    pub ln_bounds: &'a [(f64, f64)],
    /// Attenuations too, or the weights only.
    pub attenuation_free: bool,
    /// The worst error to stop at.
    pub goal: f64,
}

/// Nodes' weights for one sum and their attenuations.
#[derive(Clone, Debug)]
pub(super) struct Nodes {
    pub weights: Vec<f64>,
    pub cm2_per_g: Vec<f64>,
}

impl Nodes {
    /// As a mixture whose sums all carry these weights.
    pub fn mixture(&self, materials: usize) -> Mixture {
        Mixture { materials, weights: self.weights.iter().map(|w| [*w; SUMS]).collect(), cm2_per_g: self.cm2_per_g.clone() }
    }
}

/// Residuals at one point, and what their derivatives need.
struct State {
    parameters: Parameters,
    /// (−ln node sum + ln bin sum) / max(1, −ln bin sum) a path.
    errors: Vec<f64>,
    /// Share of each node in the sum, path-major.
    shares: Vec<f64>,
    weights: Vec<f64>,
    cm2_per_g: Vec<f64>,
}

impl State {
    fn new(problem: &Problem, parameters: Parameters) -> Self {
        let (nodes, materials) = (parameters.nodes, parameters.materials);
        let (logits, logs) = parameters.values.as_slice().split_at(nodes);
        let largest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = logits.iter().map(|a| (a - largest).exp()).sum();
        let weights: Vec<f64> = logits.iter().map(|a| (a - largest).exp() / sum).collect();
        let cm2_per_g: Vec<f64> = logs.iter().map(|b| b.exp()).collect();
        let paths = problem.paths;
        let mut shares = vec![0.0; paths.len() * nodes];
        let mut errors = Vec::with_capacity(paths.len());
        for (index, shares) in shares.chunks_exact_mut(nodes).enumerate() {
            let path = paths.path(index);
            let mut smallest = f64::INFINITY;
            for (share, attenuation) in shares.iter_mut().zip(cm2_per_g.chunks_exact(materials)) {
                *share = attenuation.iter().zip(path).map(|(mu, length)| mu * length).sum();
                smallest = smallest.min(*share);
            }
            let mut sum = 0.0;
            for (share, weight) in shares.iter_mut().zip(&weights) {
                *share = weight * (smallest - *share).exp();
                sum += *share;
            }
            shares.iter_mut().for_each(|share| *share /= sum);
            let exact = paths.exact[index][problem.sum];
            errors.push((smallest - sum.ln() - exact) / exact.max(1.0));
        }
        Self { parameters, errors, shares, weights, cm2_per_g }
    }

    fn cost(&self, emphasis: &[f64]) -> f64 {
        self.errors.iter().zip(emphasis).map(|(error, v)| v * error * error).sum()
    }

    fn worst(&self) -> f64 {
        worst(self.errors.iter().copied())
    }

    /// Normal equations: JᵀVJ and JᵀVe.
    // With p_n a node's share, g = −ln Σ W exp(−M·L): ∂g/∂a_n = W_n − p_n and ∂g/∂b_nm = p_n M_nm L_m.
    fn normal_equations(&self, problem: &Problem, emphasis: &[f64]) -> (DMatrix<f64>, DVector<f64>) {
        let Parameters { nodes, materials, .. } = self.parameters;
        let free = if problem.attenuation_free { nodes * (1 + materials) } else { nodes };
        let paths = problem.paths;
        let mut jacobian = DMatrix::zeros(free, paths.len());
        let mut errors = DVector::zeros(paths.len());
        for (index, shares) in self.shares.chunks_exact(nodes).enumerate() {
            let root = emphasis[index].sqrt();
            let scale = root / paths.exact[index][problem.sum].max(1.0);
            errors[index] = root * self.errors[index];
            let mut column = jacobian.column_mut(index);
            for node in 0..nodes {
                column[node] = scale * (self.weights[node] - shares[node]);
            }
            if problem.attenuation_free {
                let path = paths.path(index);
                for (node, share) in shares.iter().enumerate() {
                    for (material, length) in path.iter().enumerate() {
                        let at = node * materials + material;
                        column[nodes + at] = scale * share * self.cm2_per_g[at] * length;
                    }
                }
            }
        }
        let gradient = &jacobian * &errors;
        let transposed = jacobian.transpose();
        (jacobian * transposed, gradient)
    }

    fn nodes(&self) -> Nodes {
        Nodes { weights: self.weights.clone(), cm2_per_g: self.cm2_per_g.clone() }
    }
}

/// Rounds of reweighting.
const ROUNDS: usize = 24;

/// Most steps before the first reweighting, and after each.
const FIRST_STEPS: usize = 200;
const STEPS: usize = 6;

/// After these steps a root mean square error this many times the goal ends the descent: too few nodes.
const LOOK: usize = 40;
const HOPELESS: f64 = 6.0;

/// A step that lowers the cost by less than this part of it is the last.
const STALLED: f64 = 1e-4;

/// Refines `start` and returns the best nodes met, with their worst error over the problem's paths.
pub(super) fn refine(problem: &Problem, start: &Nodes, materials: usize) -> (Nodes, f64) {
    let nodes = start.weights.len();
    let logs = start.weights.iter().map(|w| w.max(1e-12).ln()).chain(start.cm2_per_g.iter().map(|mu| mu.max(1e-12).ln()));
    let values = DVector::from_iterator(nodes * (1 + materials), logs);
    let mut state = State::new(problem, Parameters { nodes, materials, values });
    let mut best = (state.nodes(), state.worst());
    let count = problem.paths.len() as f64;
    let mut emphasis = vec![1.0 / count; problem.paths.len()];
    let mut damping = 1e-2;
    for round in 0..ROUNDS {
        let steps = if round == 0 { FIRST_STEPS } else { STEPS };
        state = descend(problem, state, &emphasis, steps, &mut damping);
        let worst = state.worst();
        if !(worst >= best.1) {
            best = (state.nodes(), worst);
        }
        // The emphasised mean square of a minimiser cannot exceed the least possible worst square, so more rounds are in vain.
        if !(best.1 > problem.goal) || state.cost(&emphasis).sqrt() > 1.15 * problem.goal {
            break;
        }
        // Lawson's reweighting, tempered: emphasis grows with the error.
        let mut sum = 0.0;
        for (v, error) in emphasis.iter_mut().zip(&state.errors) {
            *v *= 0.02 + error.abs() / worst;
            sum += *v;
        }
        emphasis.iter_mut().for_each(|v| *v = (*v / sum).max(1e-6 / count));
    }
    best
}

/// Up to `steps` accepted steps downhill.
fn descend(problem: &Problem, mut state: State, emphasis: &[f64], steps: usize, damping: &mut f64) -> State {
    let mut cost = state.cost(emphasis);
    for step in 0..steps {
        let (mut hessian, mut gradient) = state.normal_equations(problem, emphasis);
        hold_at_bounds(problem, &state.parameters, &mut hessian, &mut gradient);
        let floor = 1e-12 * hessian.diagonal().max().max(1e-300);
        let before = cost;
        for _ in 0..8 {
            let mut damped = hessian.clone();
            for index in 0..damped.nrows() {
                damped[(index, index)] += *damping * hessian[(index, index)] + floor;
            }
            let trial = damped.cholesky().map(|factor| factor.solve(&gradient)).map(|step| {
                let mut parameters = state.parameters.clone();
                for (index, change) in step.iter().enumerate() {
                    parameters.values[index] -= change.clamp(-2.0, 2.0);
                }
                keep_inside(problem, &mut parameters);
                State::new(problem, parameters)
            });
            let trial_cost = trial.as_ref().map_or(f64::NAN, |trial| trial.cost(emphasis));
            match trial {
                Some(trial) if trial_cost < cost => {
                    (state, cost) = (trial, trial_cost);
                    *damping = (*damping * 0.2).max(1e-10);
                    break;
                }
                _ => *damping = (*damping * 6.0).min(1e8),
            }
        }
        let hopeless = step >= LOOK && cost.sqrt() > HOPELESS * problem.goal;
        if hopeless || !(cost < before * (1.0 - STALLED)) || !(state.worst() > problem.goal) {
            break;
        }
    }
    state
}

/// Takes the attenuations that lie on a bound and press against it out of the normal equations.
fn hold_at_bounds(problem: &Problem, parameters: &Parameters, hessian: &mut DMatrix<f64>, gradient: &mut DVector<f64>) {
    for index in parameters.nodes..gradient.len() {
        let (low, high) = problem.ln_bounds[(index - parameters.nodes) % parameters.materials];
        let b = parameters.values[index];
        if (b >= high && gradient[index] < 0.0) || (b <= low && gradient[index] > 0.0) {
            hessian.row_mut(index).fill(0.0);
            hessian.column_mut(index).fill(0.0);
            hessian[(index, index)] = 1.0;
            gradient[index] = 0.0;
        }
    }
}

/// Clamps the attenuations to those of the bins and the weights to what f32 can hold.
fn keep_inside(problem: &Problem, parameters: &mut Parameters) {
    let nodes = parameters.nodes;
    let (logits, logs) = parameters.values.as_mut_slice().split_at_mut(nodes);
    let largest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    logits.iter_mut().for_each(|a| *a = (*a - largest).max(-30.0));
    for (index, b) in logs.iter_mut().enumerate() {
        let (low, high) = problem.ln_bounds[index % parameters.materials];
        *b = b.clamp(low, high);
    }
}

//! All residuals at one state, in flat memory.

use super::block::State;
use super::loss::Loss;
use super::problem::Problem;
use super::residual::Evaluation;

/// What a residual without a prediction costs: more than any that has one.
const WITHOUT_PREDICTION: f64 = 1e12;

/// How the normal equations weigh a residual with a loss ρ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Weighing {
    /// ρ′ W: steps from afar, where the loss bends down.
    Slope,
    /// ρ′ W + 2 ρ″ W r rᵀ W, the second derivative of the cost: steps near the end, and the information there. Where it would not be
    /// positive, a little is left (Triggs et al. 2000, §4.3).
    Curvature,
    /// ρ′² W C W with the noise C: how the right side scatters.
    Spread,
}

/// Share of ρ′ W that a bending loss leaves along r, at least.
const LEFT: f64 = 0.1;

/// Where a residual's numbers lie.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    /// Numbers observed.
    pub n: usize,
    /// First of the offsets.
    pub offset: usize,
    /// First of the n×n matrices.
    pub square: usize,
    /// First of its blocks in `Plan::parts`, and how many.
    pub first: usize,
    pub count: usize,
}

/// The places of all residuals and blocks.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub slots: Vec<Slot>,
    /// Block of each part.
    pub parts: Vec<usize>,
    /// First number of each part's Jacobian, `None` for a constant block.
    pub starts: Vec<Option<usize>>,
    raw_widths: Vec<usize>,
    /// First column of each block.
    pub columns: Vec<usize>,
    /// Columns that are not eliminated; they come first.
    pub kept: usize,
    pub total: usize,
    offsets: usize,
    squares: usize,
    jacobians: usize,
}

impl Plan {
    pub fn new(problem: &Problem) -> Self {
        let (columns, kept) = problem.columns_of();
        let mut plan = Self {
            slots: Vec::with_capacity(problem.residuals.len()),
            parts: Vec::new(),
            starts: Vec::new(),
            raw_widths: Vec::new(),
            columns,
            kept,
            total: problem.columns(),
            offsets: 0,
            squares: 0,
            jacobians: 0,
        };
        for (residual, _) in &problem.residuals {
            let (n, blocks) = (residual.dimension(), residual.blocks());
            plan.slots.push(Slot { n, offset: plan.offsets, square: plan.squares, first: plan.parts.len(), count: blocks.len() });
            plan.offsets += n;
            plan.squares += n * n;
            for id in blocks {
                let block = &problem.blocks[id.0];
                plan.parts.push(id.0);
                plan.raw_widths.push(block.raw_width);
                plan.starts.push((block.width > 0).then_some(plan.jacobians));
                plan.jacobians += if block.width > 0 { n * block.raw_width } else { 0 };
            }
        }
        plan
    }
}

/// Offsets, weights and Jacobians of all residuals at one state; Jacobians by free directions, column-major.
#[derive(Clone, Debug)]
pub(super) struct Linearisation {
    pub offset: Vec<f64>,
    pub information: Vec<f64>,
    pub noise: Vec<f64>,
    pub own_noise: Vec<bool>,
    pub jacobian: Vec<f64>,
    /// rᵀ W r of each residual; infinite where it has no prediction.
    pub chi2: Vec<f64>,
    raw: Vec<f64>,
}

impl Linearisation {
    pub fn new(plan: &Plan) -> Self {
        Self {
            offset: vec![0.0; plan.offsets],
            information: vec![0.0; plan.squares],
            noise: vec![0.0; plan.squares],
            own_noise: vec![false; plan.slots.len()],
            jacobian: vec![0.0; plan.jacobians],
            chi2: vec![0.0; plan.slots.len()],
            raw: Vec::new(),
        }
    }

    /// Evaluates every residual at `state`.
    pub fn fill(&mut self, problem: &Problem, plan: &Plan, state: &State) {
        for numbers in [&mut self.offset, &mut self.information, &mut self.noise, &mut self.jacobian] {
            numbers.fill(0.0);
        }
        for (i, ((residual, _), slot)) in problem.residuals.iter().zip(&plan.slots).enumerate() {
            self.own_noise[i] = false;
            let (own, square) = (slot.offset..slot.offset + slot.n, slot.square..slot.square + slot.n * slot.n);
            let parts = slot.first..slot.first + slot.count;
            let mut out = Evaluation {
                offset: &mut self.offset[own.clone()],
                information: &mut self.information[square.clone()],
                noise: &mut self.noise[square],
                own_noise: &mut self.own_noise[i],
                starts: &plan.starts[parts.clone()],
                widths: &plan.raw_widths[parts.clone()],
                jacobian: &mut self.jacobian,
            };
            let predicted = residual.evaluate(state, &mut out);
            let chi2 = square_of(&self.offset[own], &self.information[slot.square..], slot.n);
            self.chi2[i] = if predicted && chi2.is_finite() { chi2 } else { f64::INFINITY };
            for part in parts {
                self.along_directions(problem, plan, part, slot.n);
            }
        }
    }

    /// Turns a part's Jacobian by raw numbers into one by free directions, in place.
    fn along_directions(&mut self, problem: &Problem, plan: &Plan, part: usize, n: usize) {
        let block = &problem.blocks[plan.parts[part]];
        let (Some(start), Some(b)) = (plan.starts[part], &block.directions) else { return };
        let raw = start..start + n * block.raw_width;
        self.raw.clear();
        self.raw.extend_from_slice(&self.jacobian[raw.clone()]);
        self.jacobian[raw].fill(0.0);
        for (number, direction, share) in b {
            for i in 0..n {
                self.jacobian[start + direction * n + i] += share * self.raw[number * n + i];
            }
        }
    }

    /// Σ ρ(χ²) with the weights of `weighing`, without the residual `without`.
    pub fn cost(&self, problem: &Problem, plan: &Plan, weighing: &Self, without: Option<usize>) -> f64 {
        let mut sum = 0.0;
        for (i, ((_, loss), slot)) in problem.residuals.iter().zip(&plan.slots).enumerate() {
            if without == Some(i) {
                continue;
            }
            sum += if self.chi2[i].is_finite() && weighing.chi2[i].is_finite() {
                let own = &self.offset[slot.offset..slot.offset + slot.n];
                loss.cost(square_of(own, &weighing.information[slot.square..], slot.n))
            } else if self.chi2[i].is_finite() {
                loss.cost(self.chi2[i])
            } else {
                WITHOUT_PREDICTION
            };
        }
        sum
    }

    /// The first residual whose offset is NaN or infinite.
    pub fn offset_not_finite(&self, plan: &Plan) -> Option<usize> {
        plan.slots.iter().position(|slot| !self.offset[slot.offset..slot.offset + slot.n].iter().all(|x| x.is_finite()))
    }

    /// What residual `i` adds between its Jacobians, n×n.
    pub fn weights(&self, problem: &Problem, i: usize, slot: &Slot, weighing: Weighing, out: &mut Vec<f64>) {
        let n = slot.n;
        let information = &self.information[slot.square..slot.square + n * n];
        let (loss, chi2) = (problem.residuals[i].1, self.chi2[i]);
        let weight = if loss == Loss::None { 1.0 } else { loss.weight(chi2) };
        out.clear();
        match weighing {
            Weighing::Spread if self.own_noise[i] => {
                let noise = &self.noise[slot.square..slot.square + n * n];
                let entry = |r: usize, s: usize| -> f64 {
                    let along = |a: usize| -> f64 { (0..n).map(|b| noise[a * n + b] * information[s * n + b]).sum() };
                    (0..n).map(|a| information[r * n + a] * along(a)).sum()
                };
                out.extend((0..n * n).map(|k| weight * weight * entry(k / n, k % n)));
            }
            Weighing::Spread => out.extend(information.iter().map(|w| weight * weight * w)),
            Weighing::Slope | Weighing::Curvature => out.extend(information.iter().map(|w| weight * w)),
        }
        if weighing == Weighing::Curvature && loss != Loss::None {
            let bend = (-2.0 * loss.bend(chi2)).min((1.0 - LEFT) * weight / chi2.max(f64::MIN_POSITIVE));
            let offset = &self.offset[slot.offset..slot.offset + n];
            let pull = |r: usize| -> f64 { (0..n).map(|s| information[r * n + s] * offset[s]).sum() };
            for r in 0..n {
                for s in 0..n {
                    out[r * n + s] -= bend * pull(r) * pull(s);
                }
            }
        }
    }

    /// The share with which residual `i` counts: ρ′, or nothing where it has no prediction.
    pub fn weight(&self, problem: &Problem, i: usize) -> f64 {
        if self.chi2[i].is_finite() { problem.residuals[i].1.weight(self.chi2[i]) } else { 0.0 }
    }
}

/// rᵀ W r.
pub(super) fn square_of(r: &[f64], w: &[f64], n: usize) -> f64 {
    let mut sum = 0.0;
    for i in 0..n {
        for j in 0..n {
            sum += r[i] * w[i * n + j] * r[j];
        }
    }
    sum
}

//! All residuals at one state, in flat memory.

use super::block::State;
use super::problem::Problem;
use super::residual::Evaluation;

/// What a residual without a prediction costs: more than any that has one.
const WITHOUT_PREDICTION: f64 = 1e12;

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
            plan.slots.push(Slot {
                n,
                offset: plan.offsets,
                square: plan.squares,
                first: plan.parts.len(),
                count: blocks.len(),
            });
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

/// Offsets, weights and Jacobians of all residuals at one state; Jacobians by free directions, row-major.
#[derive(Clone, Debug)]
pub(super) struct Linearisation {
    pub offset: Vec<f64>,
    pub information: Vec<f64>,
    pub noise: Vec<f64>,
    pub own_noise: Vec<bool>,
    pub jacobian: Vec<f64>,
    /// rᵀ W r of each residual; infinite where it has no prediction.
    pub chi2: Vec<f64>,
    row: Vec<f64>,
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
            row: Vec::new(),
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
        for i in 0..n {
            self.row.clear();
            self.row.extend_from_slice(&self.jacobian[start + i * block.raw_width..start + (i + 1) * block.raw_width]);
            for k in 0..block.width {
                // There are no more directions than numbers, so row i ends before row i + 1 of the raw matrix begins.
                self.jacobian[start + i * block.width + k] = self.row.iter().enumerate().map(|(r, x)| x * b[(r, k)]).sum();
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

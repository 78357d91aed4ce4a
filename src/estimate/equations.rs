//! The normal equations H δ = g, H = Σ w JᵀWJ, g = Σ w JᵀWr, with the eliminated blocks kept apart.

use nalgebra::{DMatrix, DVector};

use super::linearisation::{Linearisation, Plan, Weighing};
use super::problem::Problem;

/// An eliminated block's part: its own square, its rows against the kept columns, its right side.
#[derive(Clone, Debug)]
pub(super) struct Apart {
    /// First column among all.
    pub column: usize,
    pub own: DMatrix<f64>,
    pub cross: DMatrix<f64>,
    pub right: DVector<f64>,
}

#[derive(Clone, Debug)]
pub(super) struct Equations {
    pub kept: DMatrix<f64>,
    pub right: DVector<f64>,
    pub apart: Vec<Apart>,
    /// Index into `apart` of each block.
    which: Vec<Option<usize>>,
    total: usize,
    /// Of one residual: n×n weights, n pulls, weights times a Jacobian.
    weights: Vec<f64>,
    pulled: Vec<f64>,
    weighed: Vec<f64>,
}

impl Equations {
    pub fn new(problem: &Problem, plan: &Plan) -> Self {
        let mut which = vec![None; problem.blocks.len()];
        let mut apart = Vec::new();
        for (n, block) in problem.blocks.iter().enumerate() {
            if block.eliminated && block.width > 0 {
                which[n] = Some(apart.len());
                apart.push(Apart {
                    column: plan.columns[n],
                    own: DMatrix::zeros(block.width, block.width),
                    cross: DMatrix::zeros(block.width, plan.kept),
                    right: DVector::zeros(block.width),
                });
            }
        }
        Self {
            kept: DMatrix::zeros(plan.kept, plan.kept),
            right: DVector::zeros(plan.kept),
            apart,
            which,
            total: plan.total,
            weights: Vec::new(),
            pulled: Vec::new(),
            weighed: Vec::new(),
        }
    }

    /// Sums up all residuals but `without`.
    pub fn assemble(
        &mut self,
        problem: &Problem,
        plan: &Plan,
        linear: &Linearisation,
        without: Option<usize>,
        weighing: Weighing,
    ) {
        self.kept.fill(0.0);
        self.right.fill(0.0);
        for part in &mut self.apart {
            part.own.fill(0.0);
            part.cross.fill(0.0);
            part.right.fill(0.0);
        }
        for (i, slot) in plan.slots.iter().enumerate() {
            let weight = linear.weight(problem, i);
            if without == Some(i) || weight == 0.0 {
                continue;
            }
            let n = slot.n;
            linear.weights(problem, i, slot, weighing, &mut self.weights);
            self.pulled.clear();
            for r in 0..n {
                let row = &linear.information[slot.square + r * n..slot.square + (r + 1) * n];
                self.pulled.push(weight * dot(row, &linear.offset[slot.offset..slot.offset + n]));
            }
            for b in slot.first..slot.first + slot.count {
                let Some(start) = plan.starts[b] else { continue };
                let (block, width) = (plan.parts[b], problem.blocks[plan.parts[b]].width);
                let jacobian = &linear.jacobian[start..start + n * width];
                // Weights times J of this block, column by column: the weights are symmetric.
                self.weighed.clear();
                for column in jacobian.chunks_exact(n) {
                    self.weighed.extend(self.weights.chunks_exact(n).map(|row| dot(row, column)));
                }
                let right = match self.which[block] {
                    None => &mut self.right.as_mut_slice()[plan.columns[block]..],
                    Some(e) => self.apart[e].right.as_mut_slice(),
                };
                for (sum, column) in right.iter_mut().zip(jacobian.chunks_exact(n)) {
                    *sum += dot(column, &self.pulled);
                }
                for a in slot.first..=b {
                    let Some(start) = plan.starts[a] else { continue };
                    let (other, other_width) = (plan.parts[a], problem.blocks[plan.parts[a]].width);
                    let left = &linear.jacobian[start..start + n * other_width];
                    let (row, column) = (plan.columns[other], plan.columns[block]);
                    // Of the symmetric squares only the lower triangle is summed.
                    match (self.which[other], self.which[block]) {
                        (None, None) if row > column => add(&mut self.kept, (row, column), left, &self.weighed, n, false),
                        (None, None) => add(&mut self.kept, (column, row), &self.weighed, left, n, other == block),
                        (Some(e), Some(_)) => add(&mut self.apart[e].own, (0, 0), &self.weighed, left, n, true),
                        (Some(e), None) => add(&mut self.apart[e].cross, (0, column), left, &self.weighed, n, false),
                        (None, Some(e)) => add(&mut self.apart[e].cross, (0, row), &self.weighed, left, n, false),
                    }
                }
            }
        }
        self.kept.fill_upper_triangle_with_lower_triangle();
        for part in &mut self.apart {
            part.own.fill_upper_triangle_with_lower_triangle();
        }
    }

    /// The step with every diagonal entry enlarged by the share `damping`, one number per column; `None` where that is not positive
    /// definite or not finite.
    pub fn step(&self, damping: f64) -> Option<DVector<f64>> {
        // A column that nothing depends on stays where it is.
        let enlarge = |m: &mut DMatrix<f64>, own: &DMatrix<f64>| {
            for n in 0..own.nrows() {
                m[(n, n)] = if own[(n, n)] > 0.0 { m[(n, n)] + damping * own[(n, n)] } else { 1.0 };
            }
        };
        let (mut reduced, mut right) = (self.kept.clone(), self.right.clone());
        enlarge(&mut reduced, &self.kept);
        let mut solved = Vec::with_capacity(self.apart.len());
        for part in &self.apart {
            let mut own = part.own.clone();
            enlarge(&mut own, &part.own);
            let factor = own.cholesky()?;
            let (gain, shift) = (factor.solve(&part.cross), factor.solve(&part.right));
            reduced -= part.cross.transpose() * &gain;
            right -= part.cross.transpose() * &shift;
            solved.push((gain, shift));
        }
        let kept = reduced.cholesky()?.solve(&right);
        if self.apart.is_empty() {
            return kept.iter().all(|x| x.is_finite()).then_some(kept);
        }
        let mut step = DVector::zeros(self.total);
        step.rows_mut(0, kept.len()).copy_from(&kept);
        for (part, (gain, shift)) in self.apart.iter().zip(solved) {
            step.rows_mut(part.column, shift.len()).copy_from(&(shift - gain * &kept));
        }
        step.iter().all(|x| x.is_finite()).then_some(step)
    }

    /// g·δ: the square of the step in standard deviations when δ solves the undamped equations.
    pub fn along(&self, step: &DVector<f64>) -> f64 {
        let kept = self.right.len();
        let apart = self.apart.iter().map(|part| part.right.dot(&step.rows(part.column, part.right.len()))).sum::<f64>();
        self.right.dot(&step.rows(0, kept)) + apart
    }

    /// H over all columns.
    pub fn dense(&self) -> DMatrix<f64> {
        let mut all = DMatrix::zeros(self.total, self.total);
        let kept = self.kept.nrows();
        all.view_mut((0, 0), (kept, kept)).copy_from(&self.kept);
        for part in &self.apart {
            let width = part.own.nrows();
            all.view_mut((part.column, part.column), (width, width)).copy_from(&part.own);
            all.view_mut((part.column, 0), (width, kept)).copy_from(&part.cross);
            all.view_mut((0, part.column), (kept, width)).copy_from(&part.cross.transpose());
        }
        all
    }
}

/// Adds rowsᵀ·columns at `at`, both column-major with n numbers a column; of a square on the diagonal only the lower triangle.
fn add(to: &mut DMatrix<f64>, at: (usize, usize), rows: &[f64], columns: &[f64], n: usize, lower: bool) {
    let height = to.nrows();
    for (k, right) in columns.chunks_exact(n).enumerate() {
        let from = if lower { k } else { 0 };
        let start = (at.1 + k) * height + at.0 + from;
        let target = &mut to.as_mut_slice()[start..];
        for (sum, left) in target.iter_mut().zip(rows.chunks_exact(n).skip(from)) {
            *sum += dot(left, right);
        }
    }
}

/// Σ aᵢ bᵢ; a bead's image has two numbers.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    match (a, b) {
        ([a0, a1], [b0, b1]) => a0 * b0 + a1 * b1,
        _ => a.iter().zip(b).map(|(x, y)| x * y).sum(),
    }
}

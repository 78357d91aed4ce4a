//! The normal equations H δ = g, H = Σ w JᵀWJ, g = Σ w JᵀWr, with the eliminated blocks kept apart.

use nalgebra::{DMatrix, DVector};

use super::linearisation::{Linearisation, Plan};
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
            weighed: Vec::new(),
        }
    }

    /// Sums up all residuals but `without`.
    pub fn assemble(&mut self, problem: &Problem, plan: &Plan, linear: &Linearisation, without: Option<usize>) {
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
            let information = &linear.information[slot.square..slot.square + n * n];
            let offset = &linear.offset[slot.offset..slot.offset + n];
            for b in slot.first..slot.first + slot.count {
                let Some(start) = plan.starts[b] else { continue };
                let (block, width) = (plan.parts[b], problem.blocks[plan.parts[b]].width);
                let jacobian = &linear.jacobian[start..];
                // w W J of this block, n × width.
                self.weighed.clear();
                for r in 0..n {
                    for k in 0..width {
                        let sum: f64 = (0..n).map(|s| information[r * n + s] * jacobian[s * width + k]).sum();
                        self.weighed.push(weight * sum);
                    }
                }
                let weighed = &self.weighed;
                let right = |k: usize| (0..n).map(|r| weighed[r * width + k] * offset[r]).sum::<f64>();
                match self.which[block] {
                    None => (0..width).for_each(|k| self.right[plan.columns[block] + k] += right(k)),
                    Some(e) => (0..width).for_each(|k| self.apart[e].right[k] += right(k)),
                }
                for a in slot.first..=b {
                    let Some(start) = plan.starts[a] else { continue };
                    let (other, other_width) = (plan.parts[a], problem.blocks[plan.parts[a]].width);
                    let left = &linear.jacobian[start..];
                    let entry =
                        |j: usize, k: usize| (0..n).map(|r| left[r * other_width + j] * weighed[r * width + k]).sum::<f64>();
                    match (self.which[other], self.which[block]) {
                        (None, None) => {
                            let (rows, columns) = (plan.columns[other], plan.columns[block]);
                            for k in 0..width {
                                for j in 0..other_width {
                                    // Only the lower triangle is used.
                                    let (row, column) = (rows + j, columns + k);
                                    if row >= column || other != block {
                                        self.kept[(row.max(column), row.min(column))] += entry(j, k);
                                    }
                                }
                            }
                        }
                        (Some(e), Some(_)) => {
                            for k in 0..width {
                                for j in 0..other_width {
                                    self.apart[e].own[(j, k)] += entry(j, k);
                                }
                            }
                        }
                        (Some(e), None) => {
                            for k in 0..width {
                                for j in 0..other_width {
                                    self.apart[e].cross[(j, plan.columns[block] + k)] += entry(j, k);
                                }
                            }
                        }
                        (None, Some(e)) => {
                            for k in 0..width {
                                for j in 0..other_width {
                                    self.apart[e].cross[(k, plan.columns[other] + j)] += entry(j, k);
                                }
                            }
                        }
                    }
                }
            }
        }
        for column in 1..self.kept.ncols() {
            for row in 0..column {
                self.kept[(row, column)] = self.kept[(column, row)];
            }
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

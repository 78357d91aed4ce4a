//! Covariance of the free blocks, or the directions that nothing determines.

use nalgebra::{DMatrix, DVector};

use super::block::{BlockId, Kind};
use super::equations::Equations;
use super::error::{Direction, EstimateError};
use super::levenberg::Solved;
use super::linearisation::{Plan, Weighing};
use super::problem::Problem;

/// An entry of the inverse of the scaled information is at most the inverse of its smallest eigenvalue; beyond
/// this, double precision cannot tell the eigenvalue from zero.
const MOST_INFLATION: f64 = 1e12;

/// A function's derivative by some blocks: pairs of a block and a matrix, rows × six for a pose (ω, v about its centre), rows × all its
/// numbers for a vector.
pub type Rows<'a> = [(BlockId, &'a DMatrix<f64>)];

#[derive(Clone, Debug)]
struct Part {
    column: usize,
    width: usize,
    directions: Option<Vec<(usize, usize, f64)>>,
}

/// Of an eliminated block: H_ee⁻¹, and G = H_ee⁻¹ H_ek, with which it follows the kept columns.
#[derive(Clone, Debug)]
struct Follower {
    column: usize,
    own: DMatrix<f64>,
    gain: DMatrix<f64>,
}

/// Covariance of all free blocks.
#[derive(Clone, Debug)]
pub struct Covariance {
    parts: Vec<Part>,
    kept: DMatrix<f64>,
    followers: Vec<Follower>,
}

impl Covariance {
    pub(super) fn new(estimate: &Solved) -> Result<Self, EstimateError> {
        let (problem, plan, linear) = (estimate.problem, &estimate.plan, &estimate.linear);
        for (i, slot) in plan.slots.iter().enumerate() {
            let end = plan.slots.get(i + 1).map_or(plan.starts.len(), |next| next.first);
            let jacobians = plan.starts[slot.first..end].iter().flatten();
            let finite = jacobians.zip(&plan.parts[slot.first..end]).all(|(start, block)| {
                let size = slot.n * problem.blocks[*block].width;
                linear.jacobian[*start..*start + size].iter().all(|x| x.is_finite())
            });
            if !finite && estimate.without != Some(i) {
                return Err(EstimateError::NotFinite { residual: i });
            }
        }
        let parts: Vec<Part> = problem
            .blocks
            .iter()
            .zip(&plan.columns)
            .map(|(block, column)| Part { column: *column, width: block.width, directions: block.directions.clone() })
            .collect();
        let mut equations = Equations::new(problem, plan);
        equations.assemble(problem, plan, linear, estimate.without, Weighing::Curvature);
        // Full weights stand for the noise itself; discounted ones, or weights chosen otherwise, do not.
        if estimate.counted().any(|i| linear.own_noise[i] || linear.weight(problem, i) < 1.0) {
            let inverse = inverse(problem, plan, &equations.dense())?;
            let mut middle = Equations::new(problem, plan);
            middle.assemble(problem, plan, linear, estimate.without, Weighing::Spread);
            return Ok(Self { parts, kept: &inverse * middle.dense() * &inverse, followers: Vec::new() });
        }
        match Self::reduced(problem, plan, &parts, &equations) {
            Some(reduced) => Ok(reduced),
            // What the reduced equations cannot tell, the whole ones say in full.
            None => Ok(Self { parts, kept: inverse(problem, plan, &equations.dense())?, followers: Vec::new() }),
        }
    }

    fn reduced(problem: &Problem, plan: &Plan, parts: &[Part], equations: &Equations) -> Option<Self> {
        let mut reduced = equations.kept.clone();
        let mut followers = Vec::with_capacity(equations.apart.len());
        for part in &equations.apart {
            let own = scaled_inverse(&part.own, part.own.diagonal().as_slice())?;
            let gain = &own * &part.cross;
            reduced -= part.cross.transpose() * &gain;
            followers.push(Follower { column: part.column, own, gain });
        }
        let kept = scaled_inverse(&reduced, &typical(problem, plan, &equations.kept))?;
        Some(Self { parts: parts.to_vec(), kept, followers })
    }

    /// Covariance of some blocks together, in their free coordinates: (ω, v) of a pose in rad and mm, the free directions of a vector.
    /// Constant blocks have none.
    #[must_use]
    pub fn of(&self, blocks: &[BlockId]) -> DMatrix<f64> {
        let widths: Vec<usize> = blocks.iter().map(|id| self.parts[id.0].width).collect();
        let total = widths.iter().sum();
        let mut all = DMatrix::zeros(total, total);
        let mut row = 0;
        for (a, height) in blocks.iter().zip(&widths) {
            let mut column = 0;
            for (b, width) in blocks.iter().zip(&widths) {
                if *height > 0 && *width > 0 {
                    all.view_mut((row, column), (*height, *width)).copy_from(&self.between(*a, *b));
                }
                column += width;
            }
            row += height;
        }
        (&all + all.transpose()) * 0.5
    }

    /// Covariance of a function of the blocks, rows × rows, to first order.
    #[must_use]
    pub fn propagate(&self, rows: &Rows) -> DMatrix<f64> {
        let height = rows.first().map_or(0, |(_, m)| m.nrows());
        let blocks: Vec<BlockId> = rows.iter().map(|(id, _)| *id).collect();
        let free: Vec<DMatrix<f64>> = rows.iter().map(|(id, m)| self.along(*id, m)).collect();
        let mut by_free = DMatrix::zeros(height, free.iter().map(DMatrix::ncols).sum());
        let mut column = 0;
        for m in &free {
            by_free.view_mut((0, column), m.shape()).copy_from(m);
            column += m.ncols();
        }
        &by_free * self.of(&blocks) * by_free.transpose()
    }

    fn along(&self, id: BlockId, by_raw: &DMatrix<f64>) -> DMatrix<f64> {
        let part = &self.parts[id.0];
        match &part.directions {
            _ if part.width == 0 => DMatrix::zeros(by_raw.nrows(), 0),
            Some(b) => {
                let mut by_free = DMatrix::zeros(by_raw.nrows(), part.width);
                for (number, direction, share) in b {
                    by_free.column_mut(*direction).axpy(*share, &by_raw.column(*number), 1.0);
                }
                by_free
            }
            None => by_raw.clone(),
        }
    }

    fn between(&self, a: BlockId, b: BlockId) -> DMatrix<f64> {
        let (a, b) = (&self.parts[a.0], &self.parts[b.0]);
        let follower = |part: &Part| self.followers.iter().find(|f| f.column == part.column);
        let kept = |a: &Part, b: &Part| self.kept.view((a.column, b.column), (a.width, b.width));
        match (follower(a), follower(b)) {
            (None, None) => kept(a, b).into_owned(),
            (Some(f), None) => -(&f.gain * self.kept.columns(b.column, b.width)),
            (None, Some(g)) => -(self.kept.rows(a.column, a.width) * g.gain.transpose()),
            (Some(f), Some(g)) => {
                let mut joint = &f.gain * &self.kept * g.gain.transpose();
                if a.column == b.column {
                    joint += &f.own;
                }
                joint
            }
        }
    }
}

/// Information that is usual for each column of `h`: of a pose, the largest about any axis and the largest along any; else the column's
/// own. A turn about a row of beads has nothing but rounding on its own diagonal, and would look as good as any beside itself alone.
fn typical(problem: &Problem, plan: &Plan, h: &DMatrix<f64>) -> Vec<f64> {
    let mut usual: Vec<f64> = h.diagonal().iter().copied().collect();
    for (block, column) in problem.blocks.iter().zip(&plan.columns) {
        if block.width == 6 && matches!(block.kind, Kind::Pose { .. }) {
            for axes in usual[*column..*column + 6].chunks_exact_mut(3) {
                let most = axes.iter().copied().fold(0.0, f64::max);
                axes.fill(most);
            }
        }
    }
    usual
}

/// The inverse of `h`, scaled by the information `by` of each column; `None` where it is singular to double precision. The scale is that
/// of the information before anything was subtracted from it, so that what is left after cancellation shows.
fn scaled_inverse(h: &DMatrix<f64>, by: &[f64]) -> Option<DMatrix<f64>> {
    let scale: Vec<f64> = by.iter().map(|usual| usual.sqrt().recip()).collect();
    if !scale.iter().all(|s| s.is_finite()) {
        return None;
    }
    let mut unit = DMatrix::from_fn(h.nrows(), h.ncols(), |i, j| h[(i, j)] * scale[i] * scale[j]).cholesky()?.inverse();
    if !(0..unit.nrows()).all(|n| unit[(n, n)] < MOST_INFLATION) {
        return None;
    }
    for j in 0..unit.ncols() {
        for i in 0..unit.nrows() {
            unit[(i, j)] *= scale[i] * scale[j];
        }
    }
    Some(unit)
}

fn inverse(problem: &Problem, plan: &Plan, h: &DMatrix<f64>) -> Result<DMatrix<f64>, EstimateError> {
    let usual = typical(problem, plan, h);
    scaled_inverse(h, &usual).ok_or_else(|| undetermined(problem, plan, h, &usual))
}

/// The directions in which the scaled information vanishes.
fn undetermined(problem: &Problem, plan: &Plan, h: &DMatrix<f64>, usual: &[f64]) -> EstimateError {
    let columns = h.nrows();
    let scale: Vec<f64> = usual.iter().map(|usual| if *usual > 0.0 { usual.sqrt().recip() } else { 1.0 }).collect();
    let eigen = DMatrix::from_fn(columns, columns, |i, j| h[(i, j)] * scale[i] * scale[j]).symmetric_eigen();
    let mut order: Vec<usize> = (0..columns).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    let least = columns as f64 / MOST_INFLATION;
    let vanishing = order.iter().filter(|n| eigen.eigenvalues[**n] < least).count().max(1);
    let direction = |n: &usize| {
        let vector = eigen.eigenvectors.column(*n);
        let moved = DVector::from_fn(columns, |i, _| vector[i] * scale[i]);
        named(problem, plan, &moved)
    };
    EstimateError::Undetermined {
        rank: columns - vanishing,
        columns,
        directions: order.iter().take(vanishing).map(direction).collect(),
    }
}

fn named(problem: &Problem, plan: &Plan, moved: &DVector<f64>) -> Direction {
    let largest = moved.iter().copied().fold(0.0f64, |most, x| if x.abs() > most.abs() { x } else { most });
    let mut components = Vec::new();
    for (n, block) in problem.blocks.iter().enumerate() {
        for k in 0..block.width {
            let share = moved[plan.columns[n] + k] / largest;
            if share.abs() > 0.05 {
                components.push((BlockId(n), block.name, k, share));
            }
        }
    }
    Direction { components }
}

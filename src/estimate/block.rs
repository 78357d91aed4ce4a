//! Parameter blocks: what may be moved, and in which directions.

use glam::DVec3;
use nalgebra::DMatrix;

use super::motion::Motion;
use crate::geometry::Rigid;

/// A block of either kind, in the order in which blocks were made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct BlockId(pub(super) usize);

/// A pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoseBlock {
    pub(super) id: BlockId,
    pub(super) index: usize,
}

/// A vector of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VectorBlock {
    pub(super) id: BlockId,
    pub(super) first: usize,
    pub(super) len: usize,
}

impl PoseBlock {
    /// Its number among all blocks.
    #[must_use]
    pub fn id(&self) -> BlockId {
        self.id
    }
}

impl VectorBlock {
    /// Its number among all blocks.
    #[must_use]
    pub fn id(&self) -> BlockId {
        self.id
    }

    /// How many numbers it has, free or not.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether it has no numbers.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }
}

impl From<PoseBlock> for BlockId {
    fn from(block: PoseBlock) -> Self {
        block.id
    }
}

impl From<VectorBlock> for BlockId {
    fn from(block: VectorBlock) -> Self {
        block.id
    }
}

/// In which directions a vector block may move.
#[derive(Clone, Debug, PartialEq)]
pub enum Freedom {
    /// Nowhere.
    Constant,
    /// Every number by itself.
    All,
    /// These numbers, in this order.
    Only(Vec<usize>),
    /// Along the columns of this matrix (numbers × directions): numbers ← numbers + B δ.
    Along(DMatrix<f64>),
}

/// The values of all blocks.
#[derive(Clone, Debug, PartialEq)]
pub struct State {
    pub(super) motions: Vec<Motion>,
    pub(super) numbers: Vec<f64>,
}

impl State {
    /// A pose and its pivot.
    #[must_use]
    pub fn motion(&self, block: PoseBlock) -> &Motion {
        &self.motions[block.index]
    }

    /// A pose.
    #[must_use]
    pub fn pose(&self, block: PoseBlock) -> &Rigid {
        &self.motions[block.index].pose
    }

    /// The numbers of a vector block.
    #[must_use]
    pub fn vector(&self, block: VectorBlock) -> &[f64] {
        &self.numbers[block.first..block.first + block.len]
    }

    /// The first three numbers of a vector block.
    #[must_use]
    pub fn point(&self, block: VectorBlock) -> DVec3 {
        let at = self.vector(block);
        DVec3::new(at[0], at[1], at[2])
    }
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Kind {
    Pose { index: usize },
    Vector { first: usize, len: usize },
}

/// A block as the problem keeps it.
#[derive(Clone, Debug)]
pub(super) struct Block {
    pub name: &'static str,
    pub kind: Kind,
    /// Columns of ∂/∂: six of a pose, the numbers of a vector.
    pub raw_width: usize,
    /// Columns in the equations.
    pub width: usize,
    /// Raw from free, the entries that are not zero: (number, direction, share); `None`: the same.
    pub directions: Option<Vec<(usize, usize, f64)>>,
    pub eliminated: bool,
}

impl Block {
    /// Moves the block's values in `state` by `step`, one number per free direction.
    pub fn move_by(&self, state: &mut State, step: &[f64]) {
        if self.width == 0 {
            return;
        }
        match (self.kind, &self.directions) {
            (Kind::Pose { index }, _) => {
                if let Some(xi) = step.first_chunk() {
                    state.motions[index] = state.motions[index].moved(xi);
                }
            }
            (Kind::Vector { first, .. }, Some(directions)) => {
                for (number, direction, share) in directions {
                    state.numbers[first + number] += share * step[*direction];
                }
            }
            (Kind::Vector { first, len }, None) => {
                for (number, by) in state.numbers[first..first + len].iter_mut().zip(step) {
                    *number += by;
                }
            }
        }
    }

    /// Moves one raw coordinate of the block, free or not.
    pub fn nudge(&self, state: &mut State, coordinate: usize, by: f64) {
        match self.kind {
            Kind::Pose { index } => {
                let mut xi = [0.0; 6];
                xi[coordinate] = by;
                state.motions[index] = state.motions[index].moved(&xi);
            }
            Kind::Vector { first, .. } => state.numbers[first + coordinate] += by,
        }
    }
}

//! Blocks and residuals, put together.

use glam::DVec3;

use super::block::{Block, BlockId, Freedom, Kind, PoseBlock, State, VectorBlock};
use super::loss::Loss;
use super::motion::Motion;
use super::residual::Residual;
use crate::geometry::Rigid;

/// A least-squares problem and the state to start from.
pub struct Problem<'a> {
    pub(super) blocks: Vec<Block>,
    pub(super) start: State,
    pub(super) residuals: Vec<(Box<dyn Residual + 'a>, Loss)>,
}

impl Default for Problem<'_> {
    fn default() -> Self {
        Self::new()
    }
}

impl<'a> Problem<'a> {
    /// Nothing yet.
    #[must_use]
    pub fn new() -> Self {
        Self { blocks: Vec::new(), start: State { motions: Vec::new(), numbers: Vec::new() }, residuals: Vec::new() }
    }

    /// A pose `a_from_b` that moves about `pivot_mm` in `b`. `name` is what messages call it.
    pub fn pose(&mut self, name: &'static str, start: Rigid, pivot_mm: DVec3, free: bool) -> PoseBlock {
        let (id, index) = (BlockId(self.blocks.len()), self.start.motions.len());
        self.start.motions.push(Motion { pose: start, pivot_mm });
        let width = if free { 6 } else { 0 };
        self.blocks.push(Block { name, kind: Kind::Pose { index }, raw_width: 6, width, directions: None, eliminated: false });
        PoseBlock { id, index }
    }

    /// Numbers that move as `freedom` says.
    ///
    /// # Panics
    /// When `freedom` names a number that is not there, or has more directions than there are numbers.
    pub fn vector(&mut self, name: &'static str, start: &[f64], freedom: Freedom) -> VectorBlock {
        let (id, first, len) = (BlockId(self.blocks.len()), self.start.numbers.len(), start.len());
        self.start.numbers.extend_from_slice(start);
        let (width, directions) = match freedom {
            Freedom::Constant => (0, None),
            Freedom::All => (len, None),
            Freedom::Only(chosen) => {
                assert!(chosen.iter().all(|n| *n < len), "{name} has {len} numbers, {chosen:?} are to be free");
                (chosen.len(), Some(chosen.into_iter().enumerate().map(|(k, n)| (n, k, 1.0)).collect()))
            }
            Freedom::Along(b) => {
                assert!(b.nrows() == len && b.ncols() <= len, "{name} has {len} numbers, its directions are {:?}", b.shape());
                let entries = (0..b.ncols()).flat_map(|k| (0..len).map(move |n| (n, k)));
                let shares = entries.map(|(n, k)| (n, k, b[(n, k)])).filter(|(_, _, share)| *share != 0.0);
                (b.ncols(), Some(shares.collect()))
            }
        };
        let kind = Kind::Vector { first, len };
        self.blocks.push(Block { name, kind, raw_width: len, width, directions, eliminated: false });
        VectorBlock { id, first, len }
    }

    /// A vector block, wholly free, that is eliminated from the equations (Schur complement): for many small blocks none of which shares
    /// a residual with another such block, as bead places. The result is the same, only faster; blocks that do share one are kept.
    pub fn eliminated(&mut self, name: &'static str, start: &[f64]) -> VectorBlock {
        let block = self.vector(name, start, Freedom::All);
        self.blocks[block.id.0].eliminated = true;
        block
    }

    /// Adds a residual; its number counts from zero.
    pub fn add(&mut self, residual: impl Residual + 'a, loss: Loss) -> usize {
        let mut taken = false;
        for id in residual.blocks() {
            let block = &mut self.blocks[id.0];
            if block.eliminated {
                block.eliminated = !taken;
                taken = true;
            }
        }
        self.residuals.push((Box::new(residual), loss));
        self.residuals.len() - 1
    }

    /// The state to start from.
    #[must_use]
    pub fn start(&self) -> &State {
        &self.start
    }

    /// Sets the start of a pose.
    pub fn set_pose(&mut self, block: PoseBlock, pose: Rigid) {
        self.start.motions[block.index].pose = pose;
    }

    /// How many residuals there are.
    #[must_use]
    pub fn residual_count(&self) -> usize {
        self.residuals.len()
    }

    /// Unknowns: free directions of all blocks.
    #[must_use]
    pub fn columns(&self) -> usize {
        self.blocks.iter().map(|block| block.width).sum()
    }

    /// Gives every block its column: kept blocks first, in order, then the eliminated ones. Returns how many columns are kept.
    pub(super) fn columns_of(&self) -> (Vec<usize>, usize) {
        let mut columns = vec![0; self.blocks.len()];
        let (mut next, mut kept) = (0, 0);
        for eliminated in [false, true] {
            for (n, block) in self.blocks.iter().enumerate().filter(|(_, block)| block.eliminated == eliminated) {
                columns[n] = next;
                next += block.width;
            }
            if !eliminated {
                kept = next;
            }
        }
        (columns, kept)
    }

    /// The state after a step, one number per column.
    pub(super) fn moved(&self, state: &State, columns: &[usize], step: &[f64]) -> State {
        let mut next = state.clone();
        for (block, column) in self.blocks.iter().zip(columns) {
            block.move_by(&mut next, &step[*column..*column + block.width]);
        }
        next
    }
}

//! Why there is no estimate.

use super::block::BlockId;

/// A direction in parameter space, largest component ±1; only components above 5 % of it are listed.
#[derive(Clone, Debug, PartialEq)]
pub struct Direction {
    /// Block, its name, its free coordinate, and the component in the coordinate's own unit.
    pub components: Vec<(BlockId, &'static str, usize, f64)>,
}

impl std::fmt::Display for Direction {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (n, (block, name, coordinate, value)) in self.components.iter().take(6).enumerate() {
            let gap = if n == 0 { "" } else { ", " };
            write!(f, "{gap}{name}#{}[{coordinate}] {value:+.3}", block.0)?;
        }
        if self.components.len() > 6 {
            write!(f, " and {} more", self.components.len() - 6)?;
        }
        Ok(())
    }
}

/// Why there is no estimate.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EstimateError {
    /// The residuals say nothing about some direction.
    #[error(
        "{rank} of {columns} unknowns are determined; free to move: {}",
        directions.iter().map(ToString::to_string).collect::<Vec<_>>().join("; ")
    )]
    Undetermined {
        /// Directions that are determined.
        rank: usize,
        /// Unknowns.
        columns: usize,
        /// Directions that are not, least determined first.
        directions: Vec<Direction>,
    },
    /// A residual, its information or its Jacobian is NaN or infinite.
    #[error("residual {residual} is not finite at the start")]
    NotFinite {
        /// Number of the residual.
        residual: usize,
    },
    /// A residual has no prediction at the best state that was found.
    #[error("residual {residual} has no prediction at the solution: behind the focal spot?")]
    Infeasible {
        /// Number of the residual.
        residual: usize,
    },
    /// A residual that does not exist.
    #[error("residual {residual} was asked for, there are {count}")]
    NoSuchResidual {
        /// Number asked for.
        residual: usize,
        /// How many there are.
        count: usize,
    },
}
